"""Turns a motor slowly both ways so that its Hall sensors can be looked at, whatever is wrong with them.

Three ways are tried in turn until the shaft has turned far enough in both directions: the drive by its encoder, which
needs no Hall sensor; the drive by its Hall sensors, which needs no encoder; the load machine, where the rig has one,
with the drive off. A drive that trips (its protection sees bad Hall sensors) lets the shaft coast, and is recorded
meanwhile. By hand is the fourth way: `bench.hall.passive`.

Everything goes through a `Rig`, which stops what turns and puts parameters back however this is left. Nothing here
judges Hall sensors.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from bench.errors import BenchError
from bench.findings.thresholds import LEAST_REACH
from bench.hall.trace import Recorded
from bench.rig.drive import RanAway
from bench.rig.loads import SPEED
from bench.rig.needs import offers
from bench.rig.recorder import Recorder
from bench.rig.rig import Rig
from bench.signal import hall_inputs
from bench.signal.capture import Capture
from bench.signal.trace import INPUTS, Edges
from bench.signal.units import RPM
from bench.signal.waveforms.sectors import SECTOR_WIDTH, SECTORS
from protocol.errors import HbpError
from protocol.messages import Fault

SHARES = (0.25, 0.5, 1.0)
"""Of the highest speed, at which the shaft turns both ways; by Hall sensors the lowest is left out."""
AGAIN = 0.5
"""Of the highest speed, at which it at last turns forward once more: an encoder that slipped at the reversal shows."""
DWELL_TURNS, AGAIN_TURNS = 8.0, 5.0  # electrical turns at a speed, and once more,
DWELL, AGAIN_DWELL = (1.0, 4.0), (0.5, 4.0)  # s, but so long at least and at most
ENOUGH = 6.0
"""Electrical turns each way with which no further way of turning is tried."""
FOLLOWS = 0.4  # share of the way that was asked for, below which the motor does not follow
RUNAWAY = 1.6  # of the highest speed that was asked for so far, at which a motor is stopped
GROWS = 1.2  # of the speed that was there when it was told to stand, at which a motor is stopped
HUNTS = 0.4  # of that speed, below which it only hunts about a stand, and is let go
COAST = 5.0  # s that a shaft may take to stand when it is let go
STANDS = 3.0  # electrical rad/s
SETTLES = 0.35  # s in which a shaft that stands may still creep to a Hall code that trips the drive again
FURTHER = "with more current (--current), faster (--speed), by a load machine, or by hand (--passive)"
LOOKS = 100.0  # Hz at which the way is looked at: a shaft at rest trembles by a count


@dataclass(frozen=True)
class Turned:
    """What was captured or recorded, and how the shaft was turned, in words."""

    capture: Capture | Recorded
    how: str
    remarks: tuple[str, ...] = ()
    """Trips, and ways that did not turn the motor."""
    further: str = ""
    """How more of it is to be had, in words; empty for a recording."""


class _NotFollowing(Exception):
    """The motor does not do what it is told; the text says what it did."""


class Turner:
    """Turns the shaft of `rig` at up to `most_rpm` mechanical r/min; `progress` shows a line.

    Raises BenchError for a speed that is too low to measure at.
    """

    def __init__(self, rig: Rig, most_rpm: float, progress: Callable[[str], None]) -> None:
        self._rig = rig
        self._most_rpm = most_rpm
        self._progress = progress
        self._first = rig.tick()
        self._remarks: list[str] = []
        self._trips: dict[str, dict[str, None]] = {}  # speeds, by how the drive turned the motor and what it tripped
        slowest = ENOUGH / DWELL[1] * math.tau / rig.drive.n_p / RPM
        if most_rpm < slowest:
            raise BenchError(
                f"--speed {most_rpm:g} is too slow: at least {slowest:g} r/min are needed, for {ENOUGH:g} electrical "
                f"revolutions in {DWELL[1]:g} s"
            )
        self._asked = 0.0  # mechanical rad/s, the highest so far
        self._running = False  # the drive, as far as it was told; its heartbeat says so a tenth of a second later

    def spin(self) -> Turned:
        """Try all ways until the shaft has turned far enough both ways.

        Raises BenchError if the link goes silent; HbpError.
        """
        tried = []
        with self._rig.drive.may_trip():
            for how, turn in self._ways():
                try:
                    turn()
                except _NotFollowing as error:
                    self._remarks.append(f"{how}: {error}")
                finally:
                    self._running = False
                    self._rig.drive.stop()
                tried.append(how)
                self._coast()
                if way(self._rig.recorder, self._first).enough:
                    break
            self._leave_clear()
        trips = [f"{what} at {', '.join(speeds)} r/min" for what, speeds in self._trips.items()]
        capture = self._rig.between(self._first, self._rig.recorder.newest)
        return Turned(capture, ", then ".join(tried), (*trips, *self._remarks), FURTHER)

    # -- ways ---------------------------------------------------------------------------------------------------

    def _ways(self) -> Iterator[tuple[str, Callable[[], None]]]:
        drive = self._rig.drive.node
        if self._rig.has_encoder and offers(drive, "encoder"):
            yield "the drive by its encoder", lambda: self._by_drive("encoder", "encoder", SHARES)
        if offers(drive, "average-speed"):
            yield "the drive by its Hall sensors", lambda: self._by_drive("Hall sensors", "average-speed", SHARES[1:])
        else:
            yield "the drive by its own angle", lambda: self._by_drive("own angle", None, SHARES[1:])
        if SPEED in self._rig.load.abilities:
            yield "the load machine", self._by_load

    def _legs(self, shares: tuple[float, ...]) -> list[tuple[float, float]]:
        """Mechanical rad/s, and s at it."""
        legs = [(sign * share, DWELL_TURNS, DWELL) for sign in (1.0, -1.0) for share in shares]
        per_second = self._most_rpm / 60.0 * self._rig.drive.n_p
        return [
            (share * self._most_rpm * RPM, min(max(turns / (per_second * abs(share)), least), most))
            for share, turns, (least, most) in [*legs, (AGAIN, AGAIN_TURNS, AGAIN_DWELL)]
        ]

    def _by_drive(self, source: str, observer: str | None, shares: tuple[float, ...]) -> None:
        drive = self._rig.drive
        for omega_m, seconds in self._legs(shares):
            self._progress(f"the drive by its {source}: {omega_m / RPM:+.0f} r/min")
            if self._running and self._speed() * omega_m < 0.0:
                self._brake()
            first = self._rig.tick()
            self._asked = max(self._asked, abs(omega_m))
            self._at_most(RUNAWAY * self._asked)
            try:
                if not self._running:
                    self._running = True
                    drive.start(observer)
                drive.speed(rad_s=omega_m, unless=lambda: bool(drive.faults))
                self._rig.until(lambda: bool(drive.faults), seconds)
            except RanAway:
                raise _NotFollowing(f"at {omega_m / RPM:+.0f} r/min it ran away and was stopped") from None
            except (BenchError, HbpError):
                if not drive.faults:
                    raise
            if drive.faults:
                self._after_trip(source, omega_m)
            self._require_following(first, omega_m, seconds)

    def _brake(self) -> None:
        """Down to a stand before the shaft turns the other way; a trip is looked at later.

        By its Hall sensors a motor may hunt about a stand: it is let go, and starts anew from there.
        """
        before = self._speed()
        drive = self._rig.drive
        self._at_most(GROWS * abs(before) / drive.n_p)
        with suppress(BenchError, HbpError):
            drive.speed(rpm=0, unless=lambda: bool(drive.faults))
        if drive.on:
            with suppress(RanAway):
                self._rig.until(lambda: abs(self._speed()) < STANDS or bool(drive.faults), COAST)
        ran_away = not drive.on
        if drive.faults or (abs(self._speed()) < STANDS and not ran_away):
            return
        if abs(self._speed()) < HUNTS * abs(before):
            self._running = False
            drive.stop()
            self._coast()
        if abs(self._speed()) >= STANDS or ran_away:
            was, now = (speed / drive.n_p / RPM for speed in (before, self._speed()))
            raise _NotFollowing(f"commanded to stop, it went from {was:+.0f} to {now:+.0f} r/min and was switched off")

    def _by_load(self) -> None:
        load = self._rig.load
        try:
            for omega_m, seconds in self._legs(SHARES):
                self._progress(f"the load machine: {omega_m / RPM:+.0f} r/min")
                load.speed(rad_s=omega_m)
                self._rig.wait(seconds)
        finally:
            load.off()

    # -- looks --------------------------------------------------------------------------------------------------

    def _at_most(self, omega_m: float) -> None:
        """A motor that turns faster than this, mechanical rad/s, is stopped: it raises RanAway."""
        if self._rig.drive.guard is not None:
            self._rig.drive.guard.most = omega_m

    def _speed(self) -> float:
        """Electrical rad/s, by what the drive has; 0 before the first sample."""
        recorder = self._rig.recorder
        if recorder.newest < 0:
            return 0.0
        return recorder.latest(self._rig.speed_channel)

    def _after_trip(self, source: str, omega_m: float) -> None:
        """Record what coasts, and make the drive ready again."""
        drive = self._rig.drive
        what = f"the drive, by its {source}, tripped {', '.join(drive.faults)}"
        self._trips.setdefault(what, {})[f"{omega_m / RPM:+.0f}"] = None
        if unfed := drive.unfed():
            self._remarks.append(f"its watchdog ran out at {omega_m / RPM:+.0f} r/min: {unfed}")
        self._running = False
        self._coast()
        other = [name for name in drive.faults if name != Fault.HALL.name]
        try:
            drive.forget_faults()
        except (BenchError, HbpError):
            raise _NotFollowing("its fault cannot be cleared at this shaft position") from None
        if other:
            raise _NotFollowing(f"not retried after {', '.join(other)}")

    def _coast(self) -> None:
        self._rig.until(lambda: abs(self._speed()) < STANDS, COAST)

    def _leave_clear(self) -> None:
        """Clear what the drive has latched; one that sees an illegal code where the shaft stands keeps its fault."""
        drive = self._rig.drive
        with suppress(BenchError, HbpError):
            drive.forget_faults()
            self._rig.wait(SETTLES)
        if drive.faults:
            self._remarks.append(f"the drive is off, {', '.join(drive.faults)} still latched: the cause persists")
            drive.leave_faults()

    def _require_following(self, first: int, omega_m: float, seconds: float) -> None:
        if not self._rig.has_encoder:
            return
        capture = self._rig.between(first, self._rig.recorder.newest)
        took = np.diff(capture.t)
        known = took < 1.5 / capture.rate  # what turned while samples were lost, an angle does not tell
        gone = float(np.diff(capture.theta)[known].sum()) * math.copysign(1.0, omega_m)
        asked = abs(omega_m) * self._rig.drive.n_p * seconds * float(took[known].sum() / max(took.sum(), 1e-9))
        if gone < (FOLLOWS * asked if self._running else 0.0):
            raise _NotFollowing(
                f"commanded to turn {math.degrees(asked):.0f} deg at {omega_m / RPM:+.0f} r/min, it turned "
                f"{math.degrees(gone):.0f} deg (electrical, by the encoder)"
            )


class Way(NamedTuple):
    """How far a shaft went, electrical revolutions; to and fro within half a revolution counts nothing."""

    up: float
    down: float
    reach: float
    """Between the farthest places that it was at."""

    @property
    def enough(self) -> bool:
        """Whether it can be judged by that."""
        return min(self.up, self.down) >= ENOUGH and self.reach >= LEAST_REACH


def way(recorder: Recorder, first: int) -> Way:
    """Since the device tick `first`: by the encoder, or without one by the sectors.

    Beside an input that never changes two edges of six tell the way; they then count three times.
    """
    if recorder.newest <= first:
        return Way(0.0, 0.0, 0.0)
    capture = recorder.capture(first, recorder.newest)
    each = 1.0 / SECTORS
    try:
        theta = capture.theta[:: max(1, round(capture.measured_rate / LOOKS))]
        sectors = np.floor((theta - theta[0]) / SECTOR_WIDTH).astype(np.int64)
        sectors = sectors[hall_inputs.reached(sectors)]
    except BenchError:  # no encoder
        old, new = (codes.astype(np.int64) & 7 for codes in (capture.edges.hall_old, capture.edges.hall_new))
        unknown = np.full(len(old), math.nan)
        edges = Edges(capture.edges.tick, old, new, unknown, unknown, unknown, 0 * old)
        sectors = hall_inputs.net_sectors(edges, hall_inputs.usual(edges)).sectors
        changed = np.bitwise_or.reduce(old ^ new, initial=0)
        each *= 3.0 if int(changed).bit_count() < len(INPUTS) else 1.0
    steps = np.diff(sectors, prepend=0)
    up, down = steps[steps > 0].sum(), -steps[steps < 0].sum()
    return Way(float(up) * each, float(down) * each, float(np.ptp(np.append(sectors, 0))) * each)
