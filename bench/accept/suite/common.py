"""What the tests of the suite share: names of the estimates, speeds in r/min, whole turns, transients, ripple.

Setpoints are shares of what the drive is rated for, and names of measurements say them in percent. Nothing here knows
whether the drive is simulated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple, ParamSpec

import numpy as np

from bench.findings.wiring import AS_SPECIFIED, Diagnosis, diagnose
from bench.rig.drive import Drive, DriveTripped
from bench.rig.needs import offers
from bench.rig.ratings import Ratings
from bench.signal.capture import F64, Capture
from bench.signal.limits import Limits
from bench.signal.units import RPM
from bench.signal.waveforms import EdgeOffsets, edge_offsets, hall_offset, thd_by_angle
from bench.signal.waveforms.harmonics import ORDER

if TYPE_CHECKING:
    from bench.accept.fixtures import Record

Measure = Callable[..., bool]
Figure = Callable[..., None]
"""What the fixtures `measure` and `figure` give."""

AVERAGE, PROPOSED, KALMAN = "average-speed", "vector-tracking", "edge-kalman"
"""The paper's two approaches, and what goes past them, as the drive calls them."""
WORDS = {AVERAGE: "average", PROPOSED: "proposed", KALMAN: "Kalman"}
"""The same in names of measurements."""
THETA = {AVERAGE: "theta_avg", PROPOSED: "theta_vt", KALMAN: "theta_ek"}
OMEGA = {AVERAGE: "omega_avg", PROPOSED: "omega_vt", KALMAN: "omega_ek"}


UNRATED = 10.0
"""r/min that any motor may turn at, whatever it is rated for."""
TURNS = ("parameter:n_p", "channel:status", "speed")
"""What a test needs that asks for r/min and looks at states."""
AVERAGED = ("channel:theta_avg", "channel:omega_avg", "observer:average-speed")
VECTOR = ("channel:theta_vt", "channel:omega_vt", "observer:vector-tracking")
CHANNELS = tuple(f"channel:{name}" for name in ("hall", "i_a", "i_d", "i_q"))
PAPER = (*TURNS, *AVERAGED, *VECTOR, "encoder", "feature:EDGES", *CHANNELS)
"""What the paper's experiments need, which compare its two approaches with the encoder."""


NEARLY_GONE = 0.025
"""Of the rated current: below it a current is called gone, several times what the sensors' noise makes."""
OVER = 1.25
"""How far a current may pass the one that is allowed: the current loop's overshoot, ripple and the sensors' errors."""
MEAN, STD, LARGEST = 2.5, 6.0, 20.0
"""Position error in deg that back-EMF and Hall sensors together reach on a healthy drive, from a few percent of the
rated speed on: mean (either sign), standard deviation, largest. The paper's Hall sensors alone have 7 deg rms.
"""


def held(name: str, within: float, about: str) -> Limits:
    """Limits of what is held at a setpoint, in % of it: to `within` %."""
    return Limits(name, "%", 100.0 - within, 100.0 + within, f"{about}, of the setpoint")


def errors(
    name: str = "{}", most: tuple[float, float, float] = (MEAN, STD, LARGEST), about: str = "", saturated: float = 0.0
) -> list[Limits]:
    """Limits of `measure_error`, in deg: of the mean, either sign, the standard deviation and the largest.

    `saturated`: by how much iron may have lowered the inductance, as a share.
    """
    mean, std, largest = most
    return [
        Limits(name.format("error_mean"), "deg", -mean, mean, f"mean position error{about}", plus=saturated),
        Limits(name.format("error_std"), "deg", None, std, f"standard deviation of the position error{about}"),
        Limits(name.format("error_max"), "deg", None, largest, f"largest position error{about}"),
    ]


def percent(share: float) -> int:
    """A share of a rating in names of measurements."""
    return round(100.0 * share)


def shares(load: float, speed: float) -> str:
    """A working point in words."""
    return f"{percent(load)} % of rated current, {percent(speed)} % of rated speed"


def own_angle(drive: Drive) -> str | None:
    """The angle source of tests that are about the drive: the proposed one, or what a drive without it uses."""
    return PROPOSED if offers(drive.node, PROPOSED) else None


Arguments = ParamSpec("Arguments")


def or_nan(measure: Callable[Arguments, float | None], *arguments: Arguments.args, **named: Arguments.kwargs) -> float:
    """What `measure` gives; NaN, which fails every limit, where that is None or the samples are unfit (ValueError)."""
    try:
        value = measure(*arguments, **named)
    except ValueError:
        return math.nan
    return math.nan if value is None else value


def ratio(value: float, to: float, floor: float) -> float:
    """`value / to`; what is smaller than `floor` is compared with that, since less of both is no worse."""
    return value / max(to, floor)


def rpm(capture: Capture, channel: str = "") -> F64:
    """A speed as mechanical r/min, shape (n,); by the encoder, else by the drive's estimate, unless named."""
    return capture[channel or capture.speed] / (capture.parameters["n_p"] * RPM)


def error_deg(capture: Capture, observer: str) -> F64:
    """Actual minus estimated angle of an approach in electrical degrees, shape (n,)."""
    return np.degrees(capture.position_error(THETA[observer]))


def measure_error(
    measure: Measure, capture: Capture, observer: str = PROPOSED, name: str = "{}", mean: bool = True
) -> float:
    """`error_mean` where wanted, `error_std` and `error_max` of an approach in electrical degrees; returns the second.

    `name`: how they are called, with {} in the place of those words.
    """
    error = error_deg(capture, observer)
    if mean:
        measure(name.format("error_mean"), error.mean(), capture)
    measure(name.format("error_std"), error.std(), capture)
    measure(name.format("error_max"), np.abs(error).max(), capture)
    return float(error.std())


def whole_turns(capture: Capture) -> Capture:
    """The part, from the first sample on, that is a whole number of mechanical turns; all of it if that is none.

    A mean over it is not biased by what repeats with every turn, such as the ripple of misplaced Hall sensors.
    """
    turns = np.abs(capture.theta - capture.theta[0]) / (math.tau * capture.parameters["n_p"])
    whole = math.floor(turns.max())
    if not whole:
        return capture
    return capture.between(capture.t[0], capture.t[int(np.argmax(turns >= whole)) - 1])


def ripple(capture: Capture, channel: str, period: float) -> float:
    """Standard deviation of a channel, in its unit, about its mean over the `period` s around each sample.

    Raises ValueError where the capture is no longer than that.
    """
    length = round(period * capture.measured_rate)
    if length >= len(capture):
        raise ValueError(f"{len(capture)} samples are not more than {period:g} s: take a longer stretch")
    values = capture[channel]
    mean = np.convolve(values, np.full(length, 1 / length), "valid")
    first = (length - 1) // 2
    return float((values[first : first + len(mean)] - mean).std())


def speed_error(capture: Capture, observer: str) -> float:
    """Standard deviation of the estimated speed less the encoder's, r/min."""
    return float((rpm(capture, OMEGA[observer]) - rpm(capture)).std())


class Transient(NamedTuple):
    """A transient, with what came before it, where it began, and the approach whose estimate it is seen by."""

    capture: Capture
    start: float  # device time, s
    observer: str = PROPOSED

    def part(self, first: float, last: float | None = None) -> Capture:
        """From `first` to `last` s after the start; without `last` to the end, in whole turns."""
        if last is None:
            return whole_turns(self.capture.between(self.start + first, self.capture.span[1]))
        return self.capture.between(self.start + first, self.start + last)


def from_reference(capture: Capture, speed_rpm: float, observer: str) -> Transient:
    """A transient that begins when the speed reference first leaves `speed_rpm`, upwards."""
    reference = rpm(capture, "omega_ref")
    return Transient(capture, float(capture.t[int(np.argmax(reference > speed_rpm + 1.0))]), observer)


SEEN = 3.0
"""How many times the speed at which the drive begins to look at the back-EMF a test takes that is about more."""
SLOW = 0.5
"""Of the rated speed: the most that a slow test takes for being `SEEN`."""


def speed_rpm(drive: Drive, rated: Ratings, share: float, seen: float = SEEN, most: float = SLOW) -> float:
    """A share of the rated speed in r/min; faster, up to the share `most`, where that is not `seen` times `omega_on`.

    The drive's parameter `omega_on` is the speed from which on its observer looks at the back-EMF: high for a motor of
    much resistance.
    """
    omega_e = seen * drive.parameters.get("omega_on", 0.0)
    return min(max(share * rated.speed_rpm, omega_e / drive.n_p / RPM), max(share, most) * rated.speed_rpm)


def within_voltage(drive: Drive, u_dc: float, current: float) -> float:
    """The speed in r/min at which a q current leaves a fifth of the linear modulation's voltage; 0 if it never does.

    By the drive's own R_s_hat, L_s_hat and psi_f_hat.
    """
    R_s, L_s, psi_f = (drive.parameters[name] for name in ("R_s_hat", "L_s_hat", "psi_f_hat"))
    u, drop, u_L = 0.8 * u_dc / math.sqrt(3.0), R_s * current, L_s * current
    square = psi_f * psi_f + u_L * u_L  # (psi_f omega + drop)^2 + (u_L omega)^2 = u^2
    root = (psi_f * drop) ** 2 + square * (u * u - drop * drop)
    return max(math.sqrt(max(root, 0.0)) - psi_f * drop, 0.0) / square / drive.n_p / RPM


def full_load(drive: Drive, rated: Ratings, u_dc: float, at_rpm: float) -> float:
    """The rated current in A, or the part of it that the voltage allows at a speed, in quarters."""
    quarters = [rated.current * k / 4.0 for k in (4, 3, 2)]
    return next((amps for amps in quarters if within_voltage(drive, u_dc, amps) > at_rpm), rated.current / 4.0)


def ramp(drive: Drive, speed_rpm: float) -> float:
    """Seconds that the drive's ramp takes to change its speed reference by `speed_rpm`; 0 if the drive does not say."""
    slope = drive.parameters.get("alpha_m_max", math.inf)
    return speed_rpm * RPM / slope if slope > 0.0 else 0.0


def electrical_turn(drive: Drive, speed_rpm: float) -> float:
    """Seconds that an electrical turn takes at a speed."""
    return 60.0 / (abs(speed_rpm) * drive.n_p)


def run_at(drive: Drive, record: Record, speed_rpm: float, seconds: float) -> None:
    """Start the drive on its own angle, ask for a speed, and wait `seconds` after the ramp's end."""
    drive.start(own_angle(drive))
    drive.speed(rpm=speed_rpm)
    record.wait(ramp(drive, speed_rpm) + seconds)


def around(
    record: Record,
    before: float,
    command: Callable[[], object],
    after: float,
    then: Callable[[], object] = lambda: None,
) -> Capture:
    """From `before` s before a command to `after` s after it.

    `then` is done before it is read, which takes long where the drive holds it: a load must not stay on meanwhile.
    """
    with record.stretch(before + after) as stretch:
        record.wait(before)
        command()
        record.wait(after)
    then()
    return stretch.capture


def loaded(record: Record, drive: Drive, amps: float, seconds: float, settling: float) -> Capture:
    """So many s at a q current, after `settling` s; where the drive's memory is read, the current is off meanwhile."""
    if not record.reads_memory:
        record.wait(settling)
        return record(seconds)
    drive.current(amps)
    record.wait(settling)
    return around(record, 0.0, lambda: None, seconds, then=lambda: drive.current(0.0))


def settle(record: Record, speed_rpm: float, within: float = 0.03, timeout: float = 5.0) -> bool:
    """Go on until the shaft has made two turns, each at `speed_rpm` to `within` of it in the mean.

    False when it has not within `timeout` s.
    """
    turn = 60.0 / abs(speed_rpm)
    good = 0
    for _ in range(math.ceil(timeout / turn)):
        off = abs(float(rpm(record.streamed(turn)).mean()) - speed_rpm)
        good = good + 1 if off <= within * abs(speed_rpm) else 0
        if good == 2:
            return True
    return False


def turn_both_ways(drive: Drive, rated: Ratings, record: Record, measure: Measure) -> tuple[list[Capture], EdgeOffsets]:
    """Turn at a tenth of the rated speed on the encoder, forwards and backwards; where the Hall edges lie by it.

    Measures `wiring_as_specified` first. Raises DriveTripped.
    """
    speed = 0.1 * rated.speed_rpm
    drive.start("encoder")
    with drive.may_trip(), record.stretch() as started:  # a drive may well trip over wrong wiring: name that first
        drive.speed(rpm=speed)
        record.wait(0.8)
    measure("wiring_as_specified", or_nan(lambda: _wiring_as_specified(started.capture, record)), started.capture)
    if drive.faults:
        raise DriveTripped(f"the drive tripped: {', '.join(drive.faults)}")
    turning = []
    for direction in (1, -1):
        drive.speed(rpm=direction * speed)
        assert settle(record, direction * speed), f"{direction * speed:g} r/min were not reached"
        turning.append(record(max(1.0, 5.0 * 60.0 / speed)))
    return turning, offsets_by_encoder(turning)


def offsets_by_encoder(turning: Sequence[Capture]) -> EdgeOffsets:
    """Where the Hall edges of all these captures lie by the encoder."""
    columns = [(run.theta_at_edges(), run.edges.hall_old, run.edges.hall_new) for run in turning]
    theta, old, new = (np.concatenate(column) for column in zip(*columns, strict=True))
    return edge_offsets(theta, old, new, hall_offset(turning[0].parameters))


def wiring_of(capture: Capture) -> Diagnosis:
    """Which wiring the Hall codes fit by the encoder. ValueError where too little is seen."""
    return diagnose(capture.theta - hall_offset(capture.parameters), capture["hall"].astype(np.int64))


def _wiring_as_specified(capture: Capture, record: Record) -> float:
    found = wiring_of(capture)
    record.note(
        f"Hall wiring: {found.best} (explains {found.share:.1%}), then {found.runner_up} ({found.runner_up_share:.1%})"
    )
    return float(found.best == AS_SPECIFIED)


def turns_for_thd(drive: Drive, speed_rpm: float) -> float:
    """Seconds in which there are whole mechanical turns with three electrical ones, and not too few samples."""
    return max(0.1, 1.1 * math.ceil(3.5 / drive.n_p) * 60.0 / speed_rpm)


def thd_of_current(capture: Capture) -> float:
    """THD (20) of i_a in %, by the electrical angle, of the harmonics that samples show; NaN without three periods."""
    step = float(np.abs(np.diff(capture.theta)).max())
    order = ORDER if step * ORDER < math.pi else max(2, math.ceil(math.pi / step) - 1)
    return or_nan(lambda: 100.0 * thd_by_angle(capture.theta, capture["i_a"], order).value)
