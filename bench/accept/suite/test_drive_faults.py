"""What the drive does when something breaks: a Hall wire, exchanged wires, false pulses, a host that falls silent.

Faults of the wiring are put in by the rig.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from bench.accept import (
    RATED_CURRENT,
    RATED_SPEED,
    Capture,
    Drive,
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
from bench.accept.plots.drive import draw_run
from bench.accept.suite.common import (
    LARGEST,
    NEARLY_GONE,
    OVER,
    PROPOSED,
    SLOW,
    STD,
    TURNS,
    UNRATED,
    VECTOR,
    Figure,
    Measure,
    electrical_turn,
    error_deg,
    held,
    own_angle,
    rpm,
    run_at,
    speed_rpm,
    wiring_of,
)
from bench.accept.suite.events import (
    PHASES,
    current,
    currents_gone,
    illegal,
    largest,
    only,
    states,
    stepped,
    tripped,
)
from bench.findings.wiring import AS_SPECIFIED
from bench.rig.loads import Load, NodeLoad
from protocol.codes import DriveState

WATCHDOG = 0.2  # s, of a drive without a parameter for it, by the specification
OPEN = {f"open_{wire}": f"sensor {wire} open (always 1)" for wire in WIRES}
EXCHANGED = {f"swap_{pair}": f"sensors {pair[0]} and {pair[1]} exchanged" for pair in PAIRS}


TENTH, SIXTH = 1 / 10, 1 / 6  # of the rated speed


@called("Hall wire {wire} broken")
@limit("trip_time", "turns", hi=3, about="from the first illegal code to FAULT, in electrical revolutions")
@yes("named", about="HALL is the fault, and the only one")
@limit("current_max", "A", hi=OVER, of=RATED_CURRENT, about="largest phase current from the break on")
@limit("current_after", "A", hi=NEARLY_GONE, of=RATED_CURRENT, about="largest from 5 ms after the trip on")
@limits(held("speed_again", 2, "mean once the wire is whole and the fault is cleared"))
@needs(*TURNS, "currents", "channel:hall", "hall-faults")
@energises(rated_speed=SLOW, rated_current=1)
@pytest.mark.parametrize("wire", WIRES)
def test_hall_wire_broken(
    wire: str, drive: Drive, rated: Ratings, record: Record, hall_faults: HallFaults, measure: Measure, figure: Figure
) -> None:
    """A Hall wire breaks at a tenth of the rated speed: the drive trips, and runs again once the wire is whole.

    How far it may run away follows from the time and the current.
    """
    speed = speed_rpm(drive, rated, TENTH)
    run_at(drive, record, speed, 0.3)
    with drive.may_trip():
        with record.stretch() as stretch:
            hall_faults.open(wire)
            record.until(lambda: bool(drive.faults), 0.5)
            record.wait(0.05)
        named = drive.faults == ("HALL",)
        hall_faults.clear()
        drive.forget_faults()
    run = stretch.capture
    broken, fault = illegal(run), tripped(run)
    measure("trip_time", (fault - broken) / electrical_turn(drive, speed), run)
    measure("named", named)
    measure("current_max", current(run).max(), run)
    measure("current_after", largest(current(run), run.t >= fault + 5e-3), run)
    run_at(drive, record, speed, 0.3)
    again = record(0.15)
    measure("speed_again", 100.0 * rpm(again).mean() / speed, again)
    figure(
        f"drive_broken_{wire}",
        f"Hall wire {wire} breaks at {speed:g} r/min; dashed: the current limit",
        lambda: draw_run(run, ("speed", "hall", "phases"), {"illegal code": broken, "FAULT": fault}),
    )


@called("Hall wiring diagnosed")
@limits(
    must_be_yes("as_specified", "wiring as specified before the fault"),
    *(must_be_yes(name, f"diagnosed as {words}") for name, words in (OPEN | EXCHANGED).items()),
    must_be_yes("as_specified_again", "wiring as specified after the fault is removed"),
)
@limit("outputs_off", "%", lo=100, hi=100, about="samples in which the drive was not RUNNING")
@needs(*TURNS, "encoder", "channel:hall", "load.speed", "hall-faults")
@energises(rated_speed=1 / 50, rated_current=0)
def test_hall_wiring_is_named(
    drive: Drive, rated: Ratings, load: NodeLoad, record: Record, hall_faults: HallFaults, measure: Measure
) -> None:
    """Broken and exchanged Hall wires are found and named before the drive is ever switched on.

    The load machine turns the shaft; the encoder tells which codes belong where.
    """
    speed = rated.speed_rpm / 50
    load.speed(rpm=speed)
    record.wait(0.2)

    def look(name: str, expected: str) -> Capture:
        run = record(max(0.3, 1.8 * electrical_turn(drive, speed)))
        found = _wiring(run)
        record.note(f"{name}: {found}")
        measure(name, found == expected, run)
        return run

    runs = [look("as_specified", AS_SPECIFIED)]
    for wire in WIRES:
        hall_faults.open(wire)
        runs.append(look(f"open_{wire}", OPEN[f"open_{wire}"]))
        hall_faults.clear()
    for pair in PAIRS:
        hall_faults.swap(pair)
        runs.append(look(f"swap_{pair}", EXCHANGED[f"swap_{pair}"]))
        hall_faults.clear()
    runs.append(look("as_specified_again", AS_SPECIFIED))
    off = np.concatenate([states(run) != DriveState.RUNNING for run in runs])
    measure("outputs_off", 100.0 * off.mean(), *runs)


@called("Hall wires {pair[0]} and {pair[1]} exchanged")
@limit(
    "current_max", "A", hi=1.6, of=RATED_CURRENT, about="largest phase current while the drive was to turn", chance=True
)
@limit("speed_max", "r/min", hi=0.2, of=RATED_SPEED, about="largest speed, either way", chance=True)
@yes("only_hall", about="it tripped with HALL or not at all")
@limit("current_after", "A", hi=NEARLY_GONE, of=RATED_CURRENT, about="largest phase current from 5 ms after STOP on")
@needs(*TURNS, "encoder", "currents", "load.speed", "hall-faults")
@energises(rated_speed=1 / 30, rated_current=1)
@pytest.mark.parametrize("pair", PAIRS)
def test_hall_wires_exchanged(
    pair: str,
    drive: Drive,
    rated: Ratings,
    load: NodeLoad,
    record: Record,
    hall_faults: HallFaults,
    measure: Measure,
    figure: Figure,
) -> None:
    """With two Hall wires exchanged the drive is asked for a thirtieth of its rated speed, from rest.

    It cannot turn; it must not draw more than its limit, run away, or trip for another reason. That it trips once the
    shaft turns is for `trip_hall`.
    """
    speed = rated.speed_rpm / 30
    load.speed(rpm=0.6 * speed)  # the Hall sensors are seen once before
    record.wait(0.2)
    load.torque(0.0)
    record.wait(0.3)
    hall_faults.swap(pair)
    with drive.may_trip():
        drive.start(own_angle(drive))
        with record.stretch() as stretch:
            drive.speed(rpm=speed)
            record.until(lambda: bool(drive.faults), 0.5)
        faults = drive.faults
        drive.stop()  # before the memory is read, which may take long
        hall_faults.clear()
        run, after = stretch.capture, record(0.05)
        if faults:
            drive.forget_faults()
    measure("current_max", current(run).max(), run)
    measure("speed_max", np.abs(rpm(run)).max(), run)
    measure("only_hall", faults in ((), ("HALL",)))
    measure("current_after", current(after).max(), after)
    figure(
        f"drive_exchanged_{pair}",
        f"{speed:g} r/min asked for with the Hall wires {pair[0]} and {pair[1]} exchanged; dashed: the current limit",
        lambda: draw_run(run, ("speed", "hall", "phases"), {"FAULT": tripped(run)}),
    )


@called("False pulses on the Hall wires")
@limit(
    "implausible_edges", "", lo=4, about="edges that skip a sector or lead to 000 or 111: the burst came", chance=True
)
@limit("current_max", "A", hi=OVER, of=RATED_CURRENT, about="largest phase current from the burst on", chance=True)
@limits(held("speed_after", 2, "mean 0.2 s later"))
@needs(*TURNS, "currents", "feature:EDGES", "channel:hall", "hall-faults")
@energises(rated_speed=SLOW, rated_current=1)
def test_hall_glitches(drive: Drive, rated: Ratings, record: Record, hall_faults: HallFaults, measure: Measure) -> None:
    """A thousand false pulses a second for 50 ms at a sixth of the rated speed: the drive must not trip, and goes on.

    Two false edges close together make any Hall speed: that `omega_avg` leaves its range is no flaw of the data.
    """
    speed, burst, after = _glitches(drive, rated, record, hall_faults)
    changed = burst.edges.hall_old ^ burst.edges.hall_new
    several = (changed & (changed - 1)) != 0
    needed = only(burst, "hall", "i_d", "i_q", *PHASES)
    measure("implausible_edges", int((several | (burst.edges.illegal != 0)).sum()), needed)
    measure("current_max", current(burst).max(), needed)
    measure("speed_after", 100.0 * rpm(after).mean() / speed, after)


@called("Position error under false pulses")
@limit("error_max", "deg", hi=90, about="largest position error during the burst and 0.1 s after it", chance=True)
@limit(
    "speed_deviation",
    "r/min",
    hi=0.1,
    of=RATED_SPEED,
    about="largest from the setpoint, in the same time",
    chance=True,
)
@limit("error_std_after", "deg", hi=STD, about="position error 0.2 s later")
@limit("error_max_after", "deg", hi=LARGEST, about="largest position error 0.2 s later")
@needs(*TURNS, *VECTOR, "encoder", "channel:hall", "hall-faults")
@energises(rated_speed=SLOW, rated_current=1)
def test_hall_glitches_error(
    drive: Drive, rated: Ratings, record: Record, hall_faults: HallFaults, measure: Measure, figure: Figure
) -> None:
    """The position error under a thousand false pulses a second: bounded, and as before soon after."""
    speed, burst, after = _glitches(drive, rated, record, hall_faults)
    error_after = error_deg(after, PROPOSED)
    needed = only(burst, "theta_enc", "omega_enc", "theta_vt")
    measure("error_max", np.abs(error_deg(burst, PROPOSED)).max(), needed)
    measure("speed_deviation", np.abs(rpm(burst) - speed).max(), needed)
    measure("error_std_after", error_after.std(), after)
    measure("error_max_after", np.abs(error_after).max(), after)
    figure(
        "drive_glitches",
        "1000 false pulses a second on the Hall wires for 50 ms; the inputs as the drive samples them",
        lambda: draw_run(burst, ("speed", "error", "hall"), {}),
    )


SPEED, LAST = 2 / 30, 2.2 / 30  # of the rated speed: at the start, and the last that the drive hears


@called("Watchdog")
@limit("lateness", "ms", lo=-5, hi=60, about="from the last setpoint to FAULT, less the drive's watchdog time")
@yes("named", about="WATCHDOG is the fault, and the only one")
@yes("outputs_off", about="the heartbeats after that say so")
@needs(*TURNS)
@energises(rated_speed=LAST, rated_current=1, unrated_rpm=UNRATED)
def test_watchdog(drive: Drive, rated: Ratings, record: Record, measure: Measure) -> None:
    """The host falls silent at a fifteenth of the rated speed, or at rest if nobody tells it: the drive switches off.

    The last that it hears is a setpoint, whose effect shows in the data when that was.
    """
    run, last, named, off = _silence(drive, rated, record, lambda: None)
    measure("lateness", 1e3 * (tripped(run) - last - _watchdog(drive)), run)
    measure("named", named)
    measure("outputs_off", off)


@called("Watchdog under load")
@limit("current_before", "A", lo=0.125, of=RATED_CURRENT, about="largest phase current before: a torque to take away")
@limit("off_lateness", "ms", lo=-5, hi=60, about="until all currents are gone for good, less the drive's watchdog time")
@needs(*TURNS, "currents", "load", "parameter:psi_f_hat")
@energises(rated_speed=LAST, rated_current=1)
def test_watchdog_under_load(
    drive: Drive, rated: Ratings, load: Load, record: Record, measure: Measure, figure: Figure
) -> None:
    """The host falls silent under a quarter of the rated torque: the currents that held it are gone."""
    load.torque(0.25 * rated.current * drive.torque_constant)
    run, last, *_ = _silence(drive, rated, record, load.off)
    fault = tripped(run)
    gone = currents_gone(run, NEARLY_GONE * rated.current) if not math.isnan(fault) else math.nan
    measure("current_before", largest(current(run), run.t < fault), run)
    measure("off_lateness", 1e3 * (gone - last - _watchdog(drive)), run)
    figure(
        "drive_watchdog",
        "The host falls silent after a setpoint, a quarter of the rated torque on the shaft; dashed: current limit",
        lambda: draw_run(run, ("speed", "dq", "phases"), {"last setpoint": last, "FAULT": fault}),
    )


def _watchdog(drive: Drive) -> float:
    """Seconds of silence after which the drive switches itself off."""
    return drive.parameters.get("watchdog", WATCHDOG)


def _silence(
    drive: Drive, rated: Ratings, record: Record, let_go: Callable[[], None]
) -> tuple[Capture, float, bool, bool]:
    """Fall silent at SPEED, at rest if nobody tells the rated one; `let_go` takes the load off once it has tripped.

    Returns what came, the device time in s of the last that the drive heard, whether WATCHDOG was its only fault, and
    whether its heartbeat then said that the outputs are off.
    """
    speed, last_speed = (
        (SPEED * rated.speed_rpm, LAST * rated.speed_rpm) if RATED_SPEED in rated.told else (0.0, UNRATED)
    )
    run_at(drive, record, speed, 0.3)
    with drive.may_trip():
        with record.stretch() as stretch:
            record.wait(0.03)
            drive.node.client.feed(drive.node.number, on=False)
            drive.speed(rpm=last_speed)
            record.until(lambda: bool(drive.faults), 3.0 * _watchdog(drive))
            let_go()
            record.wait(0.05)
        named, heartbeat = drive.faults == ("WATCHDOG",), drive.node.next_heartbeat()
        drive.forget_faults()
    run = stretch.capture
    last = stepped(run, "omega_ref") if "omega_ref" in run else run.span[0]
    return run, last, named, heartbeat is not None and not heartbeat.outputs_on


def _glitches(drive: Drive, rated: Ratings, record: Record, hall_faults: HallFaults) -> tuple[float, Capture, Capture]:
    """False pulses on the Hall wires: the speed, from the first pulse to 0.1 s after the last, and later."""
    speed = speed_rpm(drive, rated, SIXTH)
    run_at(drive, record, speed, 0.5)
    with record.stretch() as stretch:
        hall_faults.glitches(1000)
        record.wait(0.05)
        hall_faults.glitches(0)
        record.wait(0.1)
    record.wait(0.2)
    return speed, stretch.capture, record(0.24)


def _wiring(run: Capture) -> str:
    """What `diagnose` names; why it cannot, where it cannot."""
    try:
        return wiring_of(run).best
    except ValueError as error:
        return str(error)
