"""Whether the drive's parameters are those of its motor, and what it does when they are not."""

from __future__ import annotations

import math

import numpy as np

from bench.accept import (
    RATED_CURRENT,
    RATED_SPEED,
    Capture,
    Drive,
    Limits,
    Ratings,
    called,
    energises,
    limit,
    limits,
    must_be_yes,
    needs,
)
from bench.accept.fixtures import Record
from bench.accept.suite.common import (
    OVER,
    PROPOSED,
    SLOW,
    TURNS,
    VECTOR,
    Measure,
    errors,
    measure_error,
    offsets_by_encoder,
    rpm,
    run_at,
    settle,
    speed_rpm,
    thd_of_current,
    turn_both_ways,
    turns_for_thd,
    whole_turns,
)
from bench.accept.suite.events import current
from bench.accept.suite.tripping import angle_source
from bench.errors import BenchError
from bench.findings.late import Late, blame
from bench.rig.loads import Load, NodeLoad
from bench.signal.delays import delays
from bench.signal.trace import STATOR
from bench.signal.waveforms import FORWARD, REVERSE
from bench.signal.waveforms.sectors import NUMERALS

PHASES = ("channel:i_a", "channel:i_b", "channel:i_c")
REST = 0.01  # electrical rad/s below which the shaft is at rest, by what the drive says
PLACED_WITHIN = 15.0  # deg
FLAT = 1.0  # % THD: less says nothing
SPEED, LOAD = 1 / 6, 1 / 2  # of the rated speed and current

OFF = {"R_s_hat": 0.3, "L_s_hat": 0.2, "psi_f_hat": 0.1}  # shares
MISMATCHES = {
    f"{name}_{way}": (name, 1.0 + sign * share)
    for name, share in OFF.items()
    for way, sign in (("low", -1), ("high", 1))
}


@called("Wrong motor parameters")
@limits(
    *errors("nominal_{}", about=", with the drive's own parameters"),
    *(
        measured
        for name, (parameter, factor) in MISMATCHES.items()
        for measured in (
            Limits(f"{name}_shift_off", "deg", -1.5, 1.5, f"by {factor:g} {parameter}, from what it must be"),
            Limits(f"{name}_error_std", "deg", None, 8.0, f"with {factor:g} {parameter}"),
            Limits(f"{name}_error_max", "deg", None, 25.0, f"with {factor:g} {parameter}"),
        )
    ),
)
@limit("current_max", "A", hi=OVER, of=RATED_CURRENT, about="largest phase current of all")
@needs(*TURNS, *VECTOR, "encoder", "currents", "channel:i_q", "load")
@needs("parameter:R_s_hat", "parameter:L_s_hat", "parameter:psi_f_hat")
@energises(rated_speed=SLOW, rated_current=1)
def test_parameter_mismatch(drive: Drive, rated: Ratings, load: Load, record: Record, measure: Measure) -> None:
    """Resistance 30 %, inductance 20 % and flux linkage 10 % off, either way, at a sixth of the speed, half the load.

    An inductance that is dL too large adds w dL i to a back-EMF of w psi_f at right angles, and turns the mean error by
    atan(dL i / psi_f). Resistance and flux linkage change no angle.
    """
    speed = speed_rpm(drive, rated, SPEED)
    drive.start(PROPOSED)
    drive.speed(rpm=speed)
    settle(record, speed)
    load.torque(LOAD * rated.current * drive.torque_constant)
    settle(record, speed, within=0.005)
    L_s, psi_f = drive.parameters["L_s_hat"], drive.parameters["psi_f_hat"]

    def run_with(name: str) -> tuple[Capture, float]:
        run = whole_turns(record(0.25))
        error = run.position_error("theta_vt")
        if name == "nominal":
            measure_error(measure, run, name="nominal_{}")
        else:
            measure_error(measure, run, name=f"{name}_{{}}", mean=False)
        return run, math.degrees(error.mean())

    nominal, mean = run_with("nominal")
    runs = [nominal]
    for name, (parameter, factor) in MISMATCHES.items():
        own = drive.parameters[parameter]
        drive.set(parameter, factor * own)
        record.wait(0.1)
        run, shifted = run_with(name)
        dL = (factor - 1.0) * L_s if parameter == "L_s_hat" else 0.0
        expected = math.degrees(math.atan(dL * float(run["i_q"].mean()) / psi_f))
        measure(f"{name}_shift_off", shifted - mean - expected, nominal, run)
        drive.set(parameter, own)
        runs.append(run)
    measure("current_max", max(current(run).max() for run in runs), *runs)


@called("Hall edges")
@limits(
    *(
        Limits(
            f"delta_{sector}",
            "deg",
            -PLACED_WITHIN,
            PLACED_WITHIN,
            f"edge that opens sector {sector}",
            tells="Hall edge against encoder",
        )
        for sector in NUMERALS
    ),
    Limits("hysteresis", "deg", None, 3, "between an edge passed in reverse and forward, mean of the six"),
    Limits("edges_dropped", "", None, 0, "edges between sectors that are not neighbours"),
    must_be_yes("wiring_as_specified", "Hall codes and encoder agree on the specified wiring"),
)
@needs(*TURNS, "encoder", "observer:encoder", "channel:hall", "feature:EDGES")
@energises(rated_speed=1 / 10, rated_current=1 / 2)
def test_hall_edges(drive: Drive, rated: Ratings, record: Record, measure: Measure) -> None:
    """Where the Hall edges lie by the encoder, ideal minus actual: near enough for the drive to start.

    They stand where they were mounted, and jitter with the magnet; a Hall sector is 60 deg wide.
    """
    turning, offsets = turn_both_ways(drive, rated, record, measure)
    delta = np.degrees(offsets.mean)
    for s, sector in enumerate(NUMERALS):
        measure(f"delta_{sector}", delta[s].mean(), *turning)
    measure("hysteresis", (delta[:, REVERSE] - delta[:, FORWARD]).mean(), *turning)
    measure("edges_dropped", offsets.dropped, *turning)


@called("Back-EMF and encoder")
@limit("psi_f", "mV·s", about="back-EMF over electrical speed")
@limit("psi_f_deviation", "%", lo=-10, hi=10, about="measured less psi_f_hat", tells="flux linkage")
@limit("encoder_turns", "", lo=0.999, hi=1.001, about="electrical revolutions by encoder per one by Hall sensors")
@limit("edges_dropped", "", hi=0, about="Hall edges between sectors that are not neighbours")
@limit("u_dc", "V", about="mean voltage of the DC link")
@limit("u_dc_ripple", "%", hi=10, about="ripple of the DC link, peak to peak")
@needs(*TURNS, "encoder", "feature:EDGES", "channel:e_alpha", "channel:e_beta", "channel:u_dc", "parameter:psi_f_hat")
@energises(rated_speed=1 / 3, rated_current=1)
def test_back_emf_and_encoder(drive: Drive, rated: Ratings, record: Record, measure: Measure) -> None:
    """The flux linkage from the back-EMF at a third of the speed; direction and pole pairs of the encoder."""
    run_at(drive, record, rated.speed_rpm / 3, 0.6)
    run = record(0.4)
    omega = float(np.abs(run[run.speed]).mean())
    psi_f = np.hypot(run["e_alpha"], run["e_beta"]).mean() / omega if omega else math.nan
    measure("psi_f", 1e3 * psi_f, run)
    measure("psi_f_deviation", 100.0 * (psi_f / drive.parameters["psi_f_hat"] - 1.0), run)
    turns, dropped = _encoder_turns(run)
    measure("encoder_turns", turns, run)
    measure("edges_dropped", dropped, run)
    measure("u_dc", run["u_dc"].mean(), run)
    measure("u_dc_ripple", 100.0 * np.ptp(run["u_dc"]) / run["u_dc"].mean(), run)


@called("Delays between the angles")
@limit("encoder", "us", hi=30, about="delay of encoder against back-EMF; it appears in every error")
@limit("hall", "us", hi=50, about="delay of Hall edges against back-EMF", tells="delay of Hall edges")
@needs(*TURNS, "encoder", "feature:EDGES", *(f"channel:{name}" for name in STATOR))
@needs("parameter:R_s_hat", "parameter:L_s_hat")
@energises(rated_speed=1, rated_current=1)
def test_angles_are_of_one_time(drive: Drive, rated: Ratings, record: Record, measure: Measure) -> None:
    """Encoder, Hall edges and back-EMF at half and all of the speed, both directions, near no load: which is late.

    An encoder that is tau late makes every estimate seem to lead by omega tau. That is the bench's error, not the
    drive's: ERROR says so, with the reason.
    """
    speed = rated.speed_rpm
    run_at(drive, record, speed, 1.0)
    with record.stretch() as turning:
        for speed_rpm in (speed, speed / 2, -speed / 2, -speed):
            drive.speed(rpm=speed_rpm)
            record.wait(0.5)
    drive.stop()
    found = delays(turning.capture)
    late, words = blame(found)
    if late in (Late.ENCODER, Late.BOTH):
        raise BenchError(f"{words}; so much, times the speed, is the encoder's of every error against it")
    measure("encoder", 1e6 * abs(found.back_emf), turning.capture)
    measure("hall", 1e6 * abs(found.edges - found.back_emf), turning.capture)
    assert late is not Late.UNCLEAR, words


@called("Torque constant")
@limit("i_q_light", "A", hi=0.25, of=RATED_CURRENT, about="mean with light load: friction")
@limit(
    "torque_deviation", "%", lo=-12, hi=12, about="of the current that half the torque adds", tells="torque per ampere"
)
@limit("current_sum", "A", hi=0.02, of=RATED_CURRENT, about="mean of i_a + i_b + i_c under load, its size")
@needs(*TURNS, "encoder", "load", *PHASES, "channel:i_q", "parameter:psi_f_hat")
@energises(rated_speed=SLOW, rated_current=1)
def test_torque_constant(drive: Drive, rated: Ratings, load: Load, record: Record, measure: Measure) -> None:
    """The q current that a known load torque takes, above that of the friction: 1.5 n_p psi_f_hat is right."""
    speed, amperes = speed_rpm(drive, rated, SPEED), LOAD * rated.current
    run_at(drive, record, speed, 0.4)
    light = whole_turns(record(0.25))
    load.torque(amperes * drive.torque_constant)
    settle(record, speed, within=0.005)
    loaded = whole_turns(record(0.25))
    step = loaded["i_q"].mean() - light["i_q"].mean()
    measure("i_q_light", light["i_q"].mean(), light)
    measure("torque_deviation", 100.0 * (step / amperes - 1.0), light, loaded)
    measure("current_sum", abs((loaded["i_a"] + loaded["i_b"] + loaded["i_c"]).mean()), loaded)


@called("Current gain by torque and back-EMF")
@limit(
    "gain", "%", lo=-15, hi=15, about="of all current sensors, by a known torque and the back-EMF", tells="current gain"
)
@needs(*TURNS, "encoder", "load", "channel:i_q", "channel:e_alpha", "channel:e_beta", "parameter:psi_f_hat")
@energises(rated_speed=SLOW, rated_current=1)
def test_current_gain(drive: Drive, rated: Ratings, load: Load, record: Record, measure: Measure) -> None:
    """The q current that a known torque adds, against what it must be with the flux linkage that the back-EMF has.

    Unlike the torque constant it does not change with the magnets' temperature.
    """
    speed, amperes = speed_rpm(drive, rated, 1 / 3), LOAD * rated.current
    run_at(drive, record, speed, 0.4)
    light = whole_turns(record(0.25))
    load.torque(amperes * drive.torque_constant)
    settle(record, speed, within=0.005)
    loaded = whole_turns(record(0.25))
    psi_f = np.hypot(light["e_alpha"], light["e_beta"]).mean() / light[light.speed].mean()
    step = (loaded["i_q"].mean() - light["i_q"].mean()) * psi_f / drive.parameters["psi_f_hat"]
    measure("gain", 100.0 * (step / amperes - 1.0), light, loaded)


@called("Dead time learned")
@limit("thd_told_half", "%", about="THD (20) of i_a with half of dead_time_comp")
@limit("thd_learned", "%", about="the same once the drive has learned the rest")
@limit("ratio", "%", hi=120, about=f"the second to the first; one below {FLAT:g} % THD counts as that")
@needs(*TURNS, "encoder", "load.speed", "channel:i_a", "parameter:dead_time_comp", "parameter:dead_time_learn")
@energises(rated_speed=SLOW, rated_current=1)
def test_dead_time_learned(drive: Drive, rated: Ratings, load: NodeLoad, record: Record, measure: Measure) -> None:
    """A drive that can learn its dead time is told half of it: what it learns makes the current no less sinusoidal.

    At a tenth of the rated speed and three eighths of the rated current, where a dead time shows most.
    """
    speed = speed_rpm(drive, rated, 1 / 10)
    thd = {}
    drive.set("dead_time_comp", 0.5 * drive.parameters["dead_time_comp"])
    for name, learn, seconds in (("told_half", 0.0, 0.2), ("learned", 1.0, 3.0)):
        drive.set("dead_time_learn", learn)
        drive.start(angle_source(drive))
        load.speed(rpm=speed)
        drive.current(3 / 8 * rated.current)
        settle(record, speed)
        record.wait(seconds)
        run = record(turns_for_thd(drive, speed))
        drive.stop()
        thd[name] = thd_of_current(whole_turns(run)), run
        measure(f"thd_{name}", *thd[name])
    (before, half), (after, learned) = thd.values()
    measure("ratio", 100.0 * max(after, FLAT) / max(before, FLAT), half, learned)


@called("Offsets of the current sensors")
@limits(
    *(
        Limits(
            f"offset_{phase}",
            "A",
            -0.02,
            0.02,
            f"mean of i_{phase}, outputs off, shaft at rest",
            of=RATED_CURRENT,
            tells="offset of a current",
        )
        for phase in "abc"
    )
)
@limit("noise", "A", hi=0.01, of=RATED_CURRENT, about="largest standard deviation of the three")
@limit("sum_offset", "A", lo=-0.03, hi=0.03, of=RATED_CURRENT, about="mean of i_a + i_b + i_c")
@limit("speed", "r/min", hi=0.001, of=RATED_SPEED, about="largest by the drive's estimate: the shaft is at rest")
@needs(*TURNS, *PHASES)
@energises(rated_speed=1 / 30, rated_current=1)
def test_current_offsets(drive: Drive, rated: Ratings, record: Record, measure: Measure) -> None:
    """What the current sensors say where there is no current, after the drive has run."""
    run_at(drive, record, rated.speed_rpm / 30, 0.2)
    drive.stop()
    record.until(lambda: abs(record.latest(record.rig.speed_channel)) < REST, 5.0)
    record.wait(0.2)
    rest = record(0.2)
    phases = [rest["i_a"], rest["i_b"], rest["i_c"]]
    for phase, values in zip("abc", phases, strict=True):
        measure(f"offset_{phase}", values.mean(), rest)
    measure("noise", max(values.std() for values in phases), rest)
    measure("sum_offset", np.sum(phases, axis=0).mean(), rest)
    measure("speed", np.abs(rpm(rest)).max(), rest)


def _encoder_turns(run: Capture) -> tuple[float, int]:
    """Electrical turns by the encoder for one by the Hall sensors, over whole turns; and edges that join no neighbours.

    Positive where both turn the same way.
    """
    theta, offsets = run.theta_at_edges(), offsets_by_encoder([run])
    turns = (len(theta) - 1) // 6
    if turns < 1:
        return math.nan, offsets.dropped
    forwards = offsets.n[:, FORWARD].sum() > len(theta) / 2
    by_encoder = (theta[6 * turns] - theta[0]) / math.tau
    return (by_encoder if forwards else -by_encoder) / turns, offsets.dropped
