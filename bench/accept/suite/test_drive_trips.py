"""Whether the drive's own protection works: too much current, speed or voltage, too little voltage, Hall sensors.

Nothing is brought to where it could break: the drive's threshold is moved near what is there. Just within it the drive
must go on, just beyond it must switch off, at once, and stay off. Faults of the Hall wiring are put in by the rig.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest
from _pytest.mark.structures import ParameterSet

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
    must_be_yes,
    needs,
    yes,
)
from bench.accept.faults import PAIRS, WIRES, HallFaults
from bench.accept.fixtures import Record
from bench.accept.suite.common import OVER, SEEN, SLOW, TURNS, Measure, electrical_turn, own_angle, rpm, speed_rpm
from bench.accept.suite.events import PHASES, current, only, phases, states, tripped
from bench.accept.suite.tripping import (
    FLOWS,
    HOLD,
    LONG,
    TRIPPED,
    Trip,
    angle_source,
    measure_trips,
    provoke,
    send,
    turn,
)
from bench.rig.loads import SPEED
from protocol.codes import DriveState

WITHIN, BEYOND = 0.9, 1.1  # of the threshold
ROUGH = 0.7, 1.3  # the same of a speed by Hall sensors, which each sector makes another
AT_ONCE = 1.0  # ms, from the first sample beyond
SOON = 10.0  # ms, from the drive's word that its threshold is past what is there


def _threshold(of: str, lo: float, hi: float) -> Limits:
    return Limits("threshold", "%", 100.0 * lo, 100.0 * hi, f"the drive's own, of {of}")


# -- current ------------------------------------------------------------------------------------------------------

AXES = {"a+": 0.0, "c-": 60.0, "b+": 120.0, "a-": 180.0, "c+": 240.0, "b-": 300.0}
"""By phase and sign, where a current vector points, in deg, that makes this the largest current, twice the others."""
THRESHOLD = 0.5  # of the rated current
NEAR = 85.0  # % of the threshold, that each current must have been without a trip
ASIDE = 25.0  # deg that a vector may lie beside its axis: no other phase comes to the threshold
TRIES = 40  # of a shaft that is free: a third of the places serve for each phase


@called("Protection: over-current")
@limits(
    _threshold("the rated current", 1.05, 4.0),
    *(
        Limits(
            f"no_trip.{axis}", "%", NEAR, None, f"i_{axis[0]}, {axis[1]}, without a trip, of the threshold", chance=True
        )
        for axis in AXES
    ),
    *(
        Limits(f"trip_time.{axis}", "ms", None, AT_ONCE, f"from i_{axis[0]}, {axis[1]}, beyond it to FAULT, at least")
        for axis in AXES
    ),
    *TRIPPED,
)
@limit("current_max", "A", hi=0.6 * OVER, of=RATED_CURRENT, about="largest phase current")
@yes("seen", about="the current sensors reach as far as the threshold of the current")
@needs(*TURNS, "parameter:i_trip", "channel:i_a", "channel:i_b")
@energises(rated_speed=1 / 20, rated_current=1)
def test_trip_over_current(drive: Drive, rated: Ratings, record: Record, measure: Measure) -> None:
    """Each phase current, either sign, is the first beyond half the rated current: the drive bears what is just below.

    The shaft stands. Where a load holds it, the current may point anywhere; else along the rotor's flux, without a
    torque, and the shaft is moved until it has pointed everywhere.
    """
    own, threshold = drive.parameters["i_trip"], THRESHOLD * rated.current
    measure("threshold", 100.0 * own / rated.current)
    measure("seen", own <= drive.parameters.get("i_range", own))
    load = record.rig.load
    held = SPEED in load.abilities
    if held:
        load.speed(rpm=0.0)
    drive.start(angle_source(drive))
    trips: dict[str, tuple[float, float, Trip]] = {}
    for _ in range(TRIES):
        if not (wanted := [axis for axis in AXES if axis not in trips]):
            break
        if (aim := _aim(drive, record, threshold, wanted, held)) is None:
            drive.set("i_trip", own)
            _move(drive, record, rated)
            continue
        drive.set("i_trip", threshold)
        trip, hold = _beyond(drive, record, threshold, aim, HOLD if trips else LONG)
        axis, before, since = _seen(trip.run, hold, threshold)
        if before >= NEAR or tripped(trip.run) * trip.run.tick_hz <= hold:  # else the shaft has turned meanwhile
            trips.setdefault(axis, (before, 1e3 * trip.least_delay(since), trip))
    drive.set("i_trip", own)
    missing = sorted(AXES.keys() - trips.keys())
    unproved = f"not proved for {', '.join(missing)}: no current got beyond the threshold there before any other"
    if not trips:
        pytest.skip(unproved)
    for axis, (before, delay, trip) in trips.items():
        measure(f"no_trip.{axis}", before, only(trip.run, *PHASES))
        measure(f"trip_time.{axis}", delay, only(trip.run, *PHASES))
    measure("current_max", np.max([current(trip.run).max() for *_, trip in trips.values()]))
    measure_trips(measure, drive, rated, record, [trip for *_, trip in trips.values()])
    if missing:
        pytest.skip(unproved)


def _aim(
    drive: Drive, record: Record, threshold: float, wanted: Sequence[str], held: bool
) -> tuple[float, float] | None:
    """Where, from the drive's d axis on, in rad, a vector makes one of the wanted currents the largest, and how long it
    must be, as a share of that current; None where no vector without a torque does, and a torque would turn the shaft.
    """
    d_axis = _direction(drive, record, 0.6 * threshold)
    for axis in wanted:
        target = math.radians(AXES[axis]) - d_axis
        if held:
            return target, 1.0
        for phi in (0.0, math.pi):
            if abs(aside := math.remainder(target - phi, math.tau)) < math.radians(ASIDE):
                return phi, 1.0 / math.cos(aside)
    return None


def _direction(drive: Drive, record: Record, amps: float) -> float:
    """The angle from phase a to the drive's d axis, rad, by the phase currents that a d current makes."""
    drive.current(0.0, amps)
    found = phases(record(0.01))
    assert found is not None
    a, b, c = found.mean(axis=1)
    return math.atan2((b - c) / math.sqrt(3.0), a - (a + b + c) / 3.0)


def _move(drive: Drive, record: Record, rated: Ratings) -> None:
    """Leave the shaft elsewhere."""
    for share in (1 / 20, 0.0):
        drive.speed(rpm=share * rated.speed_rpm)
        record.wait(0.15)


def _beyond(drive: Drive, record: Record, threshold: float, aim: tuple[float, float], hold: float) -> tuple[Trip, int]:
    """A current there just within the threshold, then just beyond it; the device tick at which the first had ended."""
    phi, length = aim
    d, q = (threshold * length * part for part in (math.cos(phi), math.sin(phi)))
    faulty = lambda: bool(drive.faults)  # noqa: E731
    ended = 0

    def cause() -> None:
        nonlocal ended
        send(drive, WITHIN * d, WITHIN * q, faulty)
        ended = record.rig.tick()
        send(drive, BEYOND * d, BEYOND * q, faulty)

    return provoke(drive, record, "OVERCURRENT", cause, lambda: None, (BEYOND * d, BEYOND * q), hold), ended


def _seen(run: Capture, hold: int, threshold: float) -> tuple[str, float, float]:
    """Which current was the first beyond the threshold, or the largest where no sample caught that before the trip;
    what it had before until the tick `hold`, in % of the threshold; when it was beyond, device time in s.
    """
    i = phases(run)
    assert i is not None
    off = states(run) == DriveState.FAULT
    i = i[:, : int(np.argmax(off)) + 1] if off.any() else i
    size = np.abs(i).max(axis=0)
    k = int(np.argmax(size > threshold)) if (size > threshold).any() else int(np.argmax(size))
    phase = int(np.argmax(np.abs(i[:, k])))
    sign = 1.0 if i[phase, k] > 0.0 else -1.0
    borne = ((run.samples.tick <= hold) & ~off)[: i.shape[1]]
    before = np.max(sign * i[phase], where=borne, initial=0.0)
    return f"{'abc'[phase]}{'-+'[sign > 0.0]}", 100.0 * before / threshold, float(run.t[k])


# -- speed and voltage --------------------------------------------------------------------------------------------


class Moved(NamedTuple):
    """A fault, the parameter that is its threshold, and what that is compared with."""

    fault: str
    parameter: str
    of: str
    """`speed` or `voltage`."""
    within: tuple[float, float]
    """Where the threshold may stand, as a share of the rated speed, or of the voltage that is there."""


MOVED = {
    "over-speed": Moved("OVERSPEED", "omega_m_trip", "speed", (1.02, 2.0)),
    "under-voltage": Moved("UNDERVOLTAGE", "u_dc_min", "voltage", (0.2, 0.95)),
    "over-voltage": Moved("OVERVOLTAGE", "u_dc_max", "voltage", (1.05, 2.0)),
}
WAYS = {"speed": {".forward": 1.0, ".reverse": -1.0}, "voltage": {"": 0.0}}
"""What is added to the names of measurements, and the direction of rotation."""


def _case(name: str, moved: Moved) -> ParameterSet:
    measured = [_threshold("the rated speed" if moved.of == "speed" else "the voltage that is there", *moved.within)]
    for way in WAYS[moved.of]:
        measured.append(must_be_yes(f"no_trip{way}", "no trip with the threshold just beyond what is there"))
        measured.append(
            Limits(f"trip_time{way}", "ms", None, SOON, "from when what is there is beyond it to FAULT, at least")
        )
    return pytest.param(moved, id=name, marks=[needs(f"parameter:{moved.parameter}"), limits(*measured)])


@called("Protection: {id}")
@limits(*TRIPPED)
@needs(*TURNS, "currents", "channel:u_dc", "channel:i_q")
@energises(rated_speed=SLOW, rated_current=1)
@pytest.mark.parametrize("moved", [_case(*case) for case in MOVED.items()])
def test_trip(moved: Moved, drive: Drive, rated: Ratings, record: Record, measure: Measure) -> None:
    """The threshold of a protection is moved near what is there, then past it, while a current flows.

    The speed is a sixth of the rated one, both directions; for the voltage the shaft stands.
    """
    own, i_d = drive.parameters[moved.parameter], -FLOWS * rated.current
    within, beyond = ROUGH if moved.of == "speed" and not record.rig.has_encoder else (WITHIN, BEYOND)
    trips: list[Trip] = []
    drive.start(angle_source(drive))
    for way, sign in WAYS[moved.of].items():
        i_q = turn(drive, record, rated, sign * speed_rpm(drive, rated, 1 / 6))
        seen = record(0.05)
        there = float(np.abs(rpm(seen)).mean()) * RPM if sign else float(seen["u_dc"].mean())
        if not trips:
            measure("threshold", 100.0 * own / (rated.speed_rpm * RPM if sign else there))
        shares = (within, beyond) if moved.parameter == "u_dc_min" else (1.0 / within, 1.0 / beyond)
        near, past = (share * there for share in shares)
        with drive.may_trip():
            drive.set(moved.parameter, near)
            record.wait(0.06)
            measure(f"no_trip{way}", not drive.faults)
        move, back = (partial(drive.set, moved.parameter, to) for to in (past, own))
        trip = provoke(drive, record, moved.fault, move, back, (i_d, i_q))
        measure(f"trip_time{way}", 1e3 * trip.least_delay(trip.caused), only(trip.run, "status"))
        trips.append(trip)
    measure_trips(measure, drive, rated, record, trips)


# -- Hall sensors -------------------------------------------------------------------------------------------------

WRONG = {"open": (WIRES, 1 / 10, 5.0), "shorted": (WIRES, 1 / 10, 5.0), "exchanged": (PAIRS, 1 / 3, 12.0)}
"""What is put in, one after the other, at which share of the rated speed, and in how many electrical revolutions the
drive must trip."""


def _wrong(kind: str) -> ParameterSet:
    what, _, most = WRONG[kind]
    about = f"wires {{}} {kind}, {{}}, to FAULT, at least, in electrical revolutions"
    measured = [
        Limits(f"turns.{which}{way}", "turns", None, most, about.format(which, way[1:]))
        for way in WAYS["speed"]
        for which in what
    ]
    return pytest.param(kind, id=kind, marks=limits(*measured))


@called("Protection: Hall wires {kind}")
@limits(*TRIPPED)
@needs(*TURNS, "currents", "channel:hall", "load.speed", "hall-faults")
@energises(rated_speed=SLOW, rated_current=1)
@pytest.mark.parametrize("kind", [_wrong(kind) for kind in WRONG])
def test_trip_hall(
    kind: str, drive: Drive, rated: Ratings, record: Record, hall_faults: HallFaults, measure: Measure
) -> None:
    """A Hall wire after the other is broken, or a pair exchanged, while the load machine turns the shaft: HALL.

    At a tenth of the rated speed, exchanged at a third, in both directions, while a current flows along the angle that
    the drive has by the Hall sensors: one that does not use them need not trip. Exchanged wires make a sequence of
    codes that runs backwards.
    """
    put_in = {"open": hall_faults.open, "shorted": hall_faults.short, "exchanged": hall_faults.swap}[kind]
    what, share, _ = WRONG[kind]
    seen = SEEN if kind == "exchanged" else 0.0  # the back-EMF tells that the sequence runs backwards
    speed, i_d = speed_rpm(drive, rated, share, seen), -FLOWS * rated.current
    trips: list[Trip] = []
    drive.start(own_angle(drive))
    for way, sign in WAYS["speed"].items():
        turn(drive, record, rated, sign * speed)
        for n, which in enumerate(what):
            if n:
                drive.current(0.0, i_d)
            trip = provoke(drive, record, "HALL", partial(put_in, which), hall_faults.clear, (i_d, 0.0))
            delay = trip.least_delay(trip.caused) / electrical_turn(drive, speed)
            measure(f"turns.{which}{way}", delay, only(trip.run, "status"))
            trips.append(trip)
    measure_trips(measure, drive, rated, record, trips)
