"""What a step does with a drive: outputs on and off, a made angle, voltages, currents, test signals, and windows.

Everything goes through the drive of a `Rig`, within the envelope that was announced, and the rig puts parameters back.
Beside that a stand looks at what flows: a voltage has no limit of its current, so each window that shows more than was
agreed to ends the step with the outputs off.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from bench.commission.analysis.dragged import Dragged
from bench.commission.analysis.hall_order import HallOrder
from bench.commission.gains import Limits
from bench.commission.meters import Ammeter, Reading
from bench.commission.outcome import Outcome, found_by
from bench.commission.quantity import USUAL, Converters, Quantity
from bench.commission.refusal import Refused
from bench.commission.window import Edges, Floats, Wave, Window
from bench.errors import BenchError, MemoryTooSmall
from bench.rig.drive import DriveTripped
from bench.rig.needs import offers
from bench.rig.rig import Rig
from bench.rig.rig import Stretch as Recorded
from bench.signal.capture import Capture
from bench.signal.position import unwrapped
from bench.signal.units import RPM
from protocol.descriptor import Channel
from protocol.signals import Status

NEED = "bench commission"
CHANNELS = ("i_a", "i_b", "i_c", "u_alpha", "u_beta", "u_dc", "theta_ctrl", "status")
WITH_ENCODER = "theta_enc"
TRIP = 1.6
"""Times the agreed current at which the drive itself trips meanwhile."""
BEYOND = 1.15
"""Times the agreed current above which a window ends the step."""
STOP_LOOK, LONGEST_STOP = 0.05, 20.0
"""s of a look at a shaft that is to come to rest, and for which it is waited for at most."""
NO_EDGE = 0.3
"""s without a Hall edge, after which a shaft without an encoder rests."""
STILL = 0.1
"""rad, electrical, by which the encoder of a shaft that rests may move in a look."""
FASTEST_TURN = math.tau
"""rad/s with which the made angle moves at rest."""
LATE = 0.04
"""s within which a slow link has brought a command."""
SEEN = 0.01
"""s of what a link has carried, that tell how much current flowed."""
COOLING = np.array([math.inf, 60.0, 30.0, 15.0, 8.0, 4.0])
"""s: times with which a winding may cool; which it is, the measurement of R tells."""
GENTLE = {"bw_current": 0.0, "R_s_hat": 0.0, "L_s_hat": 0.0, "psi_f_hat": 0.0, "dead_time_comp": 0.0}
"""Parameters that are as small as the drive allows while nothing is known: its current loop does next to nothing."""


def channels(rig: Rig) -> tuple[Channel, ...]:
    """What a commissioning streams: with the encoder, where the drive has one and the bench too."""
    node = rig.drive.node
    there = {channel.name for channel in node.descriptor.channels}
    encoder = (WITH_ENCODER,) if WITH_ENCODER in there and node.encoder else ()
    return node.channels([*CHANNELS, *encoder])


class Stretch:
    """What `Stand.stretch` has taken, once it has ended."""

    def __init__(self) -> None:
        self._take: Callable[[], Window | None] = lambda: None
        self._last: Window | None = None

    def taken(self, take: Callable[[], Window | None]) -> None:
        """It has ended: how its window is had."""
        self._take = take

    def until(self, look: Window) -> None:
        """What came after this look does not belong to it."""
        self._last = look

    @property
    def window(self) -> Window | None:
        """None where the drive's memory held nothing of it any more."""
        window = self._take()
        return window if window is None or self._last is None else window.until(self._last)


@dataclass(frozen=True)
class Turned:
    """What the dragged turn has shown, for the steps that follow."""

    dragged: Dragged | None
    """None without an encoder."""
    hall: HallOrder | None
    """How the Hall sensors answer, where their codes are right; None where they are not."""
    first: str
    """What has to be put right before the shaft may be spun; empty for nothing."""
    n_p: int | None = None
    """Pole pairs, by the encoder or by a person; None where nobody knows them."""
    share: float = 0.0
    """Of the current that drags, what it takes to turn the shaft."""


class Stand:
    """The drive of a prepared `rig`, with at most `i_max` A, peak, and what is known of it so far."""

    def __init__(
        self, rig: Rig, i_max: float, voltmeter: Reading | None = None, ammeter: Ammeter | None = None
    ) -> None:
        self.rig = rig
        self.i_max = i_max
        self.voltmeter, self.ammeter = voltmeter, ammeter
        self.converters: Converters = USUAL
        """What is known of the drive's own volts and amperes."""
        self.step = "prepare"
        """The step that is under way: what a refusal names."""
        self.T = 1.0 / rig.drive.node.identity.pwm_hz
        self.offsets: Floats = np.zeros(3)
        """A, of the three current sensors."""
        self.gains: Floats = np.ones(3)
        """Of the three current sensors, beside their mean."""
        self.noise = math.inf
        """A, standard deviation of a sample of one sensor; inf before it is known."""
        self.u_dc = 0.0
        self.R, self.L = math.nan, math.nan
        """Ohm and henry, as well as they are known; nan before the first current."""
        self.dead_time = 0.0
        """s, the effective one, once it is known."""
        self.heats: Floats = np.zeros(len(COOLING))
        """A2 s of the current's amplitude so far, as a winding keeps it that cools with each of the times COOLING."""
        self._kept: Recorded | None = None  # what the drive's memory keeps of this run
        self._heated = -1  # tick up to which it is counted
        self._asked = 0j  # A, i_d + j i_q that was last asked for
        self.outcomes: dict[str, Outcome] = {}
        """Of the steps so far, by name."""
        self.waves: tuple[Wave, ...] = ()
        """Of the inductance's step, for a second look once the inertia is known."""
        self.turned: Turned | None = None
        """What the dragged turn has shown."""
        self.pole_pairs: int | None = None
        """As they were told; None where nobody did."""
        self.by_hand = False
        """Whether a person may be asked to turn the shaft."""
        if rig.rate < rig.drive.node.identity.pwm_hz * (1 - 1e-9):
            raise BenchError(
                f"the link carries {rig.rate:g} samples a second of {len(rig.channels)} channels, and a commissioning "
                f"needs every PWM period ({rig.drive.node.identity.pwm_hz} Hz): use a faster link"
            )

    @property
    def u_linear(self) -> float:
        """V, the largest voltage vector without overmodulation."""
        return self.u_dc / math.sqrt(3.0)

    # -- parameters ---------------------------------------------------------------------------------------------

    def know_nothing(self) -> None:
        """Of a drive at rest: its loop gentle, its trip near the agreed current, its angle from no Hall sensor."""
        node, drive = self.rig.drive.node, self.rig.drive
        for name, least in GENTLE.items():
            if node.has_parameter(name):
                drive.set(name, max(least, node.parameter(name).lo))
        for name in ("dead_time_learn", "learn_edges", "inject", "load_angle_comp"):
            if node.has_parameter(name):
                drive.set(name, 0.0)
        if node.has_parameter("i_trip"):
            drive.set("i_trip", min(drive.parameters["i_trip"], TRIP * self.i_max))
        if offers(node, "encoder"):
            drive.observe("encoder")
        if not self.has_encoder and self.pole_pairs is not None:
            self.set(n_p=float(self.pole_pairs))  # by which Hall edges tell it the shaft's speed

    @property
    def has_encoder(self) -> bool:
        """Whether its angle is streamed."""
        return any(channel.name == WITH_ENCODER for channel in self.rig.channels)

    @property
    def found(self) -> dict[str, Quantity]:
        """What the steps have found, by name."""
        return found_by(self.outcomes.values())

    def compensate(self, L: float, bandwidth: float) -> None:
        """Of a drive at rest: its loop by R and this L, H, with a bandwidth in Hz, the dead time compensated."""
        self.set(
            R_s_hat=self.R, L_s_hat=L, bw_current=bandwidth, dead_time_hat=self.dead_time, dead_time_comp=1.0,
        )  # fmt: skip

    @property
    def limits(self) -> Limits:
        """What the drive works within, for its gains."""
        return Limits(self.i_max, self.rpm * RPM, self.u_dc, 1.0 / self.T)

    @property
    def rpm(self) -> float:
        """r/min of the shaft, the most that was agreed to and that the drive lets one ask for."""
        return min(self.rig.drive.envelope.rpm, self.rig.drive.parameters.get("omega_m_max", math.inf) / RPM)

    @property
    def held(self) -> bool:
        """Whether the drive's memory holds what the link is too slow for, Hall edges too."""
        return self.rig.full_rate is not None

    @property
    def holds(self) -> float:
        """s at every PWM period, of which it holds all; inf where the link carries them."""
        return math.inf if self.rig.full_rate is None else self.rig.full_rate.holds

    def allow_voltage(self, volts: float) -> None:
        """Of a drive at rest: the largest voltage that it takes from VOLTAGE and from a test signal."""
        allowed = self.rig.drive.node.parameter("u_test_max")
        self.rig.drive.set("u_test_max", min(volts, allowed.hi))

    def set(self, **values: float) -> None:
        """Parameters, within what the drive allows of each; the rig puts them back at its end."""
        for name, value in values.items():
            if self.rig.drive.node.has_parameter(name):
                allowed = self.rig.drive.node.parameter(name)
                self.rig.drive.set(name, min(max(value, allowed.lo), allowed.hi))

    # -- outputs ------------------------------------------------------------------------------------------------

    @contextmanager
    def running(self, angle: float | None = 0.0) -> Iterator[None]:
        """Within this the outputs are on, at a made angle (electrical rad) and no current; then they are off.

        `angle` None: at the encoder's, and the shaft is let go where it is faster than was agreed to.
        """
        drive = self.rig.drive
        self._kept = None
        try:
            if angle is not None:
                drive.set("forced", 1.0)  # before it starts: Hall sensors that are wrong may not trip it
            drive.start()
            with drive.node.unwaited():
                drive.current(0.0, 0.0)
                if angle is None:
                    drive.may_turn_freely(self.rpm)
                else:
                    self.turn_to(angle)
                yield
        finally:
            self._asked = 0j
            drive.stop()

    @contextmanager
    def naming(self, step: str) -> Iterator[None]:
        """Within this a drive that trips ends the step, and one whose memory is too small for it: Refused, with why."""
        self.step = step
        try:
            yield
        except DriveTripped as error:
            raise Refused(step, self._why_tripped(error)) from error
        except MemoryTooSmall as error:
            raise Refused(step, f"the link does not carry every PWM period, and {error}: use a faster link") from error

    def _why_tripped(self, error: DriveTripped) -> str:
        faults = self.rig.drive.faults
        hint = {
            "OVERCURRENT": "a winding has a short, the current loop is unstable, or the angle got lost",
            "UNDERVOLTAGE": "the supply limits its current, or is switched off",
            "OVERVOLTAGE": "the motor feeds the DC link, which nothing takes the energy of",
            "OVERSPEED": "the shaft is faster than was agreed to: agree to less current, or to more speed",
            "HALL": "the Hall codes came in no order: a wire without contact, or disturbances",
            "OVERLOAD": "the winding is not meant for this current: lower --current, or check i_cont and i2t_max",
        }
        reasons = [hint[name] for name in faults if name in hint]
        return f"{error}" + (f" ({'; '.join(reasons)})" if reasons else "")

    def turn_to(self, angle: float) -> None:
        """Move the made angle there, at rest, and wait until it is there."""
        drive = self.rig.drive
        drive.force_angle(angle)
        self._follow()
        there = math.remainder(angle, math.tau)
        near = lambda: abs(math.remainder(self.rig.latest("theta_ctrl") - there, math.tau)) < 2e-3  # noqa: E731
        if not self.rig.until(near, math.pi / FASTEST_TURN + 0.3):
            raise Refused(self.step, f"the drive's forced angle did not go to {math.degrees(there):.0f} deg")

    def drag(self, omega: float, slope: float) -> None:
        """Have the made angle turn, electrical rad/s, with a ramp of `slope`, rad/s2."""
        self._follow()
        self.rig.drive.force_speed(omega, slope)

    def voltage(self, u_d: float, u_q: float = 0.0) -> None:
        """Give the voltage, V, in the frame of the made angle."""
        self._follow()
        self.rig.drive.voltage(u_q, u_d)

    def current(self, i_d: float, i_q: float = 0.0) -> None:
        """Ask the current loop for a current, A, in the frame of the made angle."""
        self._follow()
        self.rig.drive.current(i_q, i_d)
        self._asked = complex(i_d, i_q)

    def ramp(self, first: float, last: float, seconds: float, steps: int = 12) -> None:
        """A d current that grows in steps, for a rotor that comes with it."""
        for share in np.linspace(first, last, steps):
            self.current(float(share))
            self.wait(seconds / steps)

    @contextmanager
    def square(self, axis: str, amplitude: float, periods: int) -> Iterator[None]:
        """Within this a square wave is added: `axis` is u_d or u_q (V), i_d or i_q (A); see `Drive.square`."""
        with self.rig.drive.square(axis, amplitude, periods):
            yield

    # -- what flows ---------------------------------------------------------------------------------------------

    def run(self, seconds: float, kind: str = "") -> Window:
        """The next `seconds`, as a window. Raises Refused where more flows than was agreed to, or samples are lost."""
        self._follow()
        return self._checked(self._window(self.rig.record(seconds), kind))

    @contextmanager
    def stretch(self, kind: str) -> Iterator[Stretch]:
        """What happens inside, as one window after it, if it ends without an exception.

        Raises Refused as `run` does. Ask for a current before it, so that all of the window is under one command.
        Where the drive's memory keeps it (`keep`) its window is there once the drive has stopped.
        """
        stretch, asked, kept = Stretch(), self._asked, self._kept
        if kept is not None:
            self.wait(LATE)
            first = self.rig.tick()
            yield stretch
            last = self.rig.tick()
            stretch.taken(lambda: self._part(kept, first, last, kind, asked))
            return
        with self.rig.recording() as recording:
            yield stretch
        window = self._windowed(recording.capture, kind, asked)
        stretch.taken(lambda: window)

    def keep(self, before: float, after: float, edges_per_s: float | None = None) -> None:
        """Of a drive that runs: have it keep what stretches are to show, where the link is too slow.

        They begin from now on, and only the last `before` s until the outputs go off, and `after` s then, are kept; see
        `FullRate.keep`.
        """
        if self.held:
            self._kept = self.rig.keep(before, after, edges_per_s)

    def _part(self, kept: Recorded, first: int, last: int, kind: str, asked: complex) -> Window | None:
        if kept.last < 0:
            kept.end()
        capture = kept.capture
        oldest, newest = int(capture.samples.tick[0]), int(capture.samples.tick[-1])
        if last <= oldest or first >= newest:
            return None
        return self._windowed(capture.ticks(max(first, oldest), min(last, newest)), kind, asked)

    def _windowed(self, capture: Capture, kind: str, asked: complex) -> Window:
        self._require_whole(capture)
        return self._checked(replace(window_of(capture, self.offsets, kind), i_ref=asked))

    def _checked(self, window: Window) -> Window:
        most = float(np.abs(window.i).max(initial=0.0))
        if most > BEYOND * self.i_max + 6.0 * self.noise:
            raise Refused(self.step, f"{most:.3g} A flowed, and {self.i_max:g} A were agreed to: switched off")
        return window

    def await_rest(self, step: str) -> None:
        """Of a drive that is off: wait until its shaft stands still, by encoder or Hall edges. Refused else."""
        for _ in range(round(LONGEST_STOP / STOP_LOOK)):
            seen = self.look(STOP_LOOK)
            if seen.theta is None:
                still = not len(self.recent_edges(NO_EDGE))
            else:
                still = float(np.ptp(unwrapped(seen.theta))) < STILL
            if still:
                return
        raise Refused(step, f"the shaft still turns after {LONGEST_STOP:g} s with the outputs off: hold what turns it")

    def look(self, seconds: float) -> Window:
        """The same as the link carries it, whatever its rate: to see whether a current flows, or how it turns."""
        self._follow()
        return self._checked(self._window(self.rig.streamed(seconds), ""))

    def recent_edges(self, seconds: float) -> Edges:
        """Hall edges of so many s up to the newest sample, which has index 0."""
        newest = self.rig.recorder.newest
        edges = self.rig.between(newest - round(seconds * self.rig.recorder.tick_hz), newest).edges
        index = (edges.tick - newest) / (self.rig.recorder.tick_hz * self.T)
        old, new, count = (np.asarray(each, np.int64) for each in (edges.hall_old, edges.hall_new, edges.encoder))
        return Edges(old, new, index, count)

    def wait(self, seconds: float) -> None:
        """Let it go on for so long."""
        self.rig.wait(seconds)
        self._follow()

    def _window(self, capture: Capture, kind: str) -> Window:
        self._require_whole(capture)
        window = window_of(capture, self.offsets, kind)
        first, last = int(capture.samples.tick[0]), int(capture.samples.tick[-1])
        self._heat(first)
        own = max(float(np.mean(np.abs(window.current) ** 2)) - self._square_of_noise, 0.0)
        self.heats, self._heated = warmed(self.heats, own, window.seconds), last
        return replace(window, i_ref=self._asked)

    def _require_whole(self, capture: Capture) -> None:
        if capture.dropped:
            raise Refused(self.step, f"samples were lost: {capture.dropped[0][2]}; measure again, on a faster link")

    def heat(self) -> tuple[Floats, int]:
        """A2 s so far, for each time of COOLING, and the drive's tick up to which that is."""
        self._heat(self.rig.recorder.newest)
        return self.heats, self._heated

    def heat_of(self, window: Window, before: tuple[Floats, int]) -> Floats:
        """The same in the middle of a window, once all up to it has come; `before`: what `heat` said just before it."""
        heats, tick = before
        middle = round(0.5 * float(window.index[0] + window.index[-1]) * window.dt * self.rig.recorder.tick_hz)
        seconds = max(middle - tick, 0) / self.rig.recorder.tick_hz
        return warmed(heats, self._mean_square(tick, middle), seconds)

    def _heat(self, tick: int) -> None:
        """By the current since the last window, or command, up to this tick."""
        if 0 <= self._heated < tick:
            seconds = (tick - self._heated) / self.rig.recorder.tick_hz
            self.heats = warmed(self.heats, self._mean_square(self._heated, tick), seconds)
            self._heated = tick

    @property
    def _square_of_noise(self) -> float:
        return 4.0 / 3.0 * self.noise**2

    def _mean_square(self, first: int, last: int) -> float:
        """A2 between two windows: as streamed, or of the current that was asked for where no sample came."""
        if last <= first + 1 or self.rig.recorder.newest < first + SEEN * self.rig.recorder.tick_hz:
            return abs(self._asked) ** 2
        between = window_of(self.rig.between(first, last), self.offsets, "")
        return max(float(np.mean(np.abs(between.current) ** 2)) - self._square_of_noise, 0.0)

    def _follow(self) -> None:
        self.rig.drive.node.watch_setpoints()


def warmed(heats: Floats, square: float, seconds: float) -> Floats:
    """The heats, A2 s, for each time of COOLING, after a current of this mean square, A2, for so long."""
    share = -np.expm1(-seconds / COOLING)  # of the heat that has left
    kept = np.where(np.isinf(COOLING), seconds, np.where(np.isinf(COOLING), 1.0, COOLING) * share)
    return np.asarray(heats * (1.0 - share) + square * kept)


def window_of(capture: Capture, offsets: Floats, kind: str) -> Window:
    """A capture as a window; `offsets`, A, shape (3,), of the current sensors."""
    samples, edges, config = capture.samples, capture.edges, capture.samples.config
    tick, per = samples.tick, config.period_ticks * config.decimation
    theta = None
    if WITH_ENCODER in capture:
        theta = capture[WITH_ENCODER]
    status = samples.raw["status"].astype(np.int64)
    return Window(
        T=config.period_ticks / config.tick_hz,
        every=config.decimation,
        i=np.stack([capture[name] for name in ("i_a", "i_b", "i_c")]) - offsets[:, None],
        u=np.asarray(capture["u_alpha"] + 1j * capture["u_beta"]),
        u_dc=capture["u_dc"],
        theta=theta,
        control=capture["theta_ctrl"],
        index=tick // per,
        cycle=(status & Status.INJECTION_SYNC) != 0,
        edges=Edges(
            edges.hall_old.astype(np.int64),
            edges.hall_new.astype(np.int64),
            (edges.tick - tick[0]) / per + float(tick[0] // per),
            edges.encoder.astype(np.int64),
        ),
        kind=kind,
    )
