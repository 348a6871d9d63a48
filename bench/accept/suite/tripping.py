"""A trip provoked, what the drive does then, and how it is cleared: what all tests of protection share.

A current flows before, so that it can be seen to go. Nothing here knows which protection it is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from bench.accept import RATED_CURRENT, Capture, Drive, Limits, Ratings, must_be_yes
from bench.accept.fixtures import Record
from bench.accept.suite.common import NEARLY_GONE, Measure, own_angle, ramp, settle
from bench.accept.suite.events import current, largest, states, tripped
from bench.rig.loads import SPEED
from bench.rig.needs import offers
from protocol.codes import DriveState
from protocol.messages import SetpointMode

FLOWS = 0.3  # of the rated current, against the rotor's flux: it makes no torque
HOLD = 0.02  # s at least in which the drive, with its setpoint still sent, must stay in FAULT
LONG = 0.5  # s, the same once: firmware that tries again does so in some tenths of a second
TIMEOUT = 0.3  # s
TRIPPED = (
    must_be_yes("named", "this is the fault, and the only one"),
    Limits("current_before", "A", 0.15, None, "smallest that flowed before a trip, of all", of=RATED_CURRENT),
    Limits("current_after", "A", None, NEARLY_GONE, "largest from 5 ms after a trip on", of=RATED_CURRENT),
    must_be_yes("latched", "FAULT until it was cleared, with setpoints still sent, and off until it was started"),
    Limits("current_again", "A", 0.2, 0.45, "largest phase current once it is cleared and started", of=RATED_CURRENT),
)
"""What `measure_trips` measures."""


class Trip(NamedTuple):
    """What came of it."""

    run: Capture
    """From before the cause until the drive had been cleared, and not yet started."""
    caused: float
    """Device time in s at which the cause was there at the latest."""
    named: bool
    latched: bool

    def least_delay(self, since: float) -> float:
        """Seconds from `since`, device time, to FAULT, at the least: as samples are apart; NaN without a FAULT."""
        faults = states(self.run) == DriveState.FAULT
        if not faults.any():
            return math.nan
        first = int(np.argmax(faults))
        return max(0.0, float(self.run.t[first - 1]) - since) if first else 0.0


def angle_source(drive: Drive) -> str | None:
    """The encoder where the drive offers it, else its own."""
    return "encoder" if offers(drive.node, "encoder") else own_angle(drive)


def turn(drive: Drive, record: Record, rated: Ratings, speed_rpm: float) -> float:
    """Of a running drive: turn the shaft, by the load machine where it can, and let a current flow; 0: it stands.

    Returns the q current in A that keeps the speed, the load machine's doing apart.
    """
    i_q, load = 0.0, record.rig.load
    if speed_rpm and SPEED in load.abilities:
        load.speed(rpm=speed_rpm)
    elif speed_rpm:
        drive.speed(rpm=speed_rpm)
        record.wait(ramp(drive, abs(speed_rpm)) + 0.3)
        i_q = float(record(0.05)["i_q"].mean())
    drive.current(i_q, -FLOWS * rated.current)
    if speed_rpm and SPEED in load.abilities:
        assert settle(record, speed_rpm), f"{speed_rpm:g} r/min were not reached"
    return i_q


def send(drive: Drive, i_d: float, i_q: float, unless: Callable[[], bool]) -> None:
    """A current setpoint that is confirmed unless `unless()`: a drive that trips, or has, confirms none."""
    drive.node.setpoint(SetpointMode.CURRENT, i_q, i_d, unless)


def provoke(
    drive: Drive,
    record: Record,
    fault: str,
    cause: Callable[[], object],
    undo: Callable[[], object],
    still_sent: tuple[float, float],
    hold: float = HOLD,
) -> Trip:
    """Of a running drive: bring the cause about and take it away, clear the fault, start again.

    `still_sent`: the setpoint, i_d and i_q in A, that the drive gets in FAULT; `hold`: s that it is left there.
    """
    rig = record.rig
    with drive.may_trip(), record.stretch(TIMEOUT + hold) as stretch:
        cause()
        caused = rig.tick()
        record.until(lambda: bool(drive.faults), TIMEOUT)
        undo()
        send(drive, *still_sent, unless=lambda: True)
        record.wait(hold)
        named, held = drive.faults == (fault,), rig.tick()
        drive.node.clear_faults()
        end = rig.tick()
        if drive.faults or drive.state != DriveState.IDLE:  # it has not tripped, or goes its own ways
            drive.forget_faults()
        drive.start()
    run = stretch.capture.ticks(stretch.first, end)
    state, ticks = states(run), run.samples.tick
    after = np.logical_or.accumulate(state == DriveState.FAULT)
    latched = bool(after.any() and (state[after & (ticks < held)] == DriveState.FAULT).all())
    off = np.isin(state[after], (DriveState.FAULT, DriveState.IDLE)).all()
    return Trip(run, caused / run.tick_hz, named, latched and bool(off))


def measure_trips(measure: Measure, drive: Drive, rated: Ratings, record: Record, trips: Sequence[Trip]) -> None:
    """`TRIPPED`, of a drive that has been started after the last of them."""
    drive.current(0.0, -FLOWS * rated.current)
    again = record(0.03)
    runs = [trip.run for trip in trips]
    sizes = [(current(run), run.t, tripped(run)) for run in runs]
    measure("named", bool(trips) and all(trip.named for trip in trips))
    measure("current_before", np.min([largest(i, ~(t >= fault)) for i, t, fault in sizes]), *runs)
    measure("current_after", np.max([largest(i, t >= fault + 5e-3) for i, t, fault in sizes]), *runs)
    measure("latched", bool(trips) and all(trip.latched for trip in trips), *runs)
    measure("current_again", current(again).max(), again)
