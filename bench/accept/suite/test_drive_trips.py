"""Whether the drive's own protection works: too much current, speed or voltage, too little voltage.

Nothing is brought to where it could break: the drive's threshold is moved past what is there, and it must switch off.
"""

from __future__ import annotations

from typing import NamedTuple

import pytest

from bench.accept import (
    RATED_CURRENT,
    RPM,
    Capture,
    Drive,
    Limits,
    Ratings,
    called,
    energises,
    limit,
    limits,
    needs,
    yes,
)
from bench.accept.fixtures import Record
from bench.accept.suite.common import NEARLY_GONE, OVER, SLOW, TURNS, Measure, held, rpm, run_at, speed_rpm
from bench.accept.suite.events import current, largest, tripped


class Trip(NamedTuple):
    """A fault, the parameter that is its threshold, and what that is compared with at a test's working point."""

    fault: str
    parameter: str
    of: str
    """Of `current`, `speed` and `voltage`: what is compared."""
    moved: float
    """Where the threshold is put, as a share of that."""
    within: tuple[float, float]
    """Where it may stand, as a share of the rated current or speed, or of the voltage that is there."""


TRIPS = {
    "over-current": Trip("OVERCURRENT", "i_trip", "current", 0.3, (1.05, 4.0)),
    "over-speed": Trip("OVERSPEED", "omega_m_trip", "speed", 0.8, (1.02, 2.0)),
    "under-voltage": Trip("UNDERVOLTAGE", "u_dc_min", "voltage", 1.1, (0.2, 0.95)),
    "over-voltage": Trip("OVERVOLTAGE", "u_dc_max", "voltage", 0.9, (1.05, 2.0)),
}
PULSE = 0.6  # of the rated current, in the d axis: it makes a phase current, and no torque
TIMEOUT = 0.3  # s


def _threshold(trip: Trip) -> Limits:
    lo, hi = (100.0 * share for share in trip.within)
    of = "the voltage that is there" if trip.of == "voltage" else f"the rated {trip.of}"
    return Limits("threshold", "%", lo, hi, f"the drive's own, of {of}")


CASES = [
    pytest.param(trip, id=name, marks=[needs(f"parameter:{trip.parameter}"), limits(_threshold(trip))])
    for name, trip in TRIPS.items()
]


@called("Protection: {id}")
@yes("named", about="this is the fault, and the only one")
@limit("trip_time", "ms", hi=100, about="from before the threshold or the current was set until FAULT")
@limit("current_max", "A", hi=PULSE * OVER, of=RATED_CURRENT, about="largest phase current")
@limit("current_after", "A", hi=NEARLY_GONE, of=RATED_CURRENT, about="largest from 5 ms after the trip on")
@yes("seen", about="the current sensors reach as far as the threshold of the current")
@limits(held("speed_again", 2, "mean once the threshold is back and the fault is cleared"))
@needs(*TURNS, "currents", "channel:u_dc")
@energises(rated_speed=SLOW, rated_current=1)
@pytest.mark.parametrize("trip", CASES)
def test_trip(trip: Trip, drive: Drive, rated: Ratings, record: Record, measure: Measure) -> None:
    """The threshold of a protection moved past what it looks at: the drive trips, says why, and runs again."""
    speed = speed_rpm(drive, rated, 1 / 6)
    own = drive.parameters[trip.parameter]
    run_at(drive, record, speed, 0.4)
    u_dc = float(record(0.05)["u_dc"].mean())
    rating = {"current": rated.current, "speed": rated.speed_rpm * RPM, "voltage": u_dc}[trip.of]
    there = {"current": rated.current, "speed": speed * RPM, "voltage": u_dc}[trip.of]
    measure("threshold", 100.0 * own / rating)
    measure("seen", trip.of != "current" or own <= drive.parameters.get("i_range", own))
    with drive.may_trip():
        run = _provoked(drive, record, trip, trip.moved * there, PULSE * rated.current)
        named = drive.faults == (trip.fault,)
        drive.stop()
        drive.set(trip.parameter, own)
        record.wait(0.05)
        drive.forget_faults()
    fault = tripped(run)
    measure("named", named)
    measure("trip_time", 1e3 * (fault - run.t[0]), run)
    measure("current_max", current(run).max(), run)
    measure("current_after", largest(current(run), run.t >= fault + 5e-3), run)
    run_at(drive, record, speed, 0.4)
    again = record(0.2)
    measure("speed_again", 100.0 * rpm(again).mean() / speed, again)


def _provoked(drive: Drive, record: Record, trip: Trip, threshold: float, amps: float) -> Capture:
    """What came from before the threshold was moved until the drive had tripped and its currents were gone."""
    if trip.of == "current":  # so that nothing but the pulse is beyond it
        drive.set(trip.parameter, threshold)
    with record.stretch() as stretch:
        if trip.of == "current":
            drive.current(0.0, -amps)
        else:
            drive.set(trip.parameter, threshold)
        record.until(lambda: bool(drive.faults), TIMEOUT)
        record.wait(0.05)
    return stretch.capture
