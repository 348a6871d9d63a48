"""What the drive does when something breaks: a Hall wire, exchanged wires, false pulses, a host that falls silent.

Faults of the wiring are put in by the rig. The default limits are those of the paper's drive.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from bench.acceptance import RPM, Capture, Drive, Limits, energises, limit, limits, needs
from bench.acceptance.faults import PAIRS, WIRES, HallFaults
from bench.acceptance.fixtures import Record
from bench.acceptance.plots.drive import draw_run
from bench.acceptance.suite.common import (
    PROPOSED,
    TURNS,
    VECTOR,
    Figure,
    Measure,
    error_deg,
    own_angle,
    rpm,
    run_at,
)
from bench.acceptance.suite.events import (
    GONE,
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
from bench.analysis.wiring import AS_SPECIFIED, diagnose
from bench.rig.loads import Load, NodeLoad
from protocol.codes import DriveState

WATCHDOG = 0.2  # s, of a drive without a parameter for it, by the specification
OPEN = {f"open_{wire}": f"sensor {wire} open (always 1)" for wire in WIRES}
EXCHANGED = {f"swap_{pair}": f"sensors {pair[0]} and {pair[1]} exchanged" for pair in PAIRS}


@limit("trip_time", "ms", lo=0.1, hi=80, about="from the first illegal code to FAULT: two electrical turns take 67 ms")
@limit("named", "", lo=1, hi=1, about="1: HALL is the fault, and the only one")
@limit("current_max", "A", hi=9.6, about="largest phase current from the break on")
@limit("current_after", "A", hi=GONE, about="largest phase current 5 ms after the trip and later")
@limit("speed_again", "r/min", lo=298.5, hi=301.5, about="mean once the wire is whole and the fault is cleared")
@needs(*TURNS, "currents", "channel:hall", "hall-faults")
@energises(speed_rpm=300, current=8)
@pytest.mark.parametrize("wire", WIRES)
def test_hall_wire_broken(
    wire: str, drive: Drive, record: Record, hall_faults: HallFaults, measure: Measure, figure: Figure
) -> None:
    """A Hall wire breaks at 300 r/min: the drive trips by itself, and runs again once the wire is whole.

    How far it may run away follows from the time and the current.
    """
    run_at(drive, record, 300, 0.4)
    with drive.may_trip():
        with record.stretch() as stretch:
            hall_faults.open(wire)
            record.until(lambda: bool(drive.faults), 0.5)
            record.wait(0.1)
        run = stretch.capture
        named = drive.faults == ("HALL",)
        drive.stop()
        hall_faults.clear()
        record.wait(0.3)
        drive.forget_faults()
    broken, fault = illegal(run), tripped(run)
    measure("trip_time", 1e3 * (fault - broken), run)
    measure("named", named)
    measure("current_max", current(run).max(), run)
    measure("current_after", largest(current(run), run.t >= fault + 5e-3), run)
    run_at(drive, record, 300, 0.4)
    again = record(0.2)
    measure("speed_again", rpm(again).mean(), again)
    figure(
        f"drive_broken_{wire}",
        f"Hall wire {wire} breaks at 300 r/min; dashed: the current limit",
        lambda: draw_run(run, ("speed", "hall", "phases"), {"illegal code": broken, "FAULT": fault}),
    )


@limits(
    Limits("as_specified", "", 1, 1, "1: nothing is wrong before anything is"),
    *(Limits(name, "", 1, 1, f"1: diagnosed as {words}") for name, words in (OPEN | EXCHANGED).items()),
    Limits("as_specified_again", "", 1, 1, "1: nothing is wrong once all is put back"),
)
@limit("outputs_off", "%", lo=100, hi=100, about="samples in which the drive was not RUNNING")
@needs(*TURNS, "encoder", "channel:hall", "load.speed", "hall-faults")
@energises(speed_rpm=60, current=0)
def test_hall_wiring_is_named(
    drive: Drive, load: NodeLoad, record: Record, hall_faults: HallFaults, measure: Measure
) -> None:
    """Broken and exchanged Hall wires are found and named before the drive is ever switched on.

    The load machine turns the shaft; the encoder tells which codes belong where.
    """
    load.speed(60 * RPM)
    record.wait(0.2)

    def look(name: str, expected: str) -> Capture:
        run = record(0.3)
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


@limit("current_max", "A", lo=1, hi=10.5, about="largest phase current while 100 r/min were asked for")
@limit("speed_max", "r/min", hi=450, about="largest speed, either way")
@limit("only_hall", "", lo=1, hi=1, about="1: it tripped with HALL or not at all")
@limit("current_after", "A", hi=GONE, about="largest phase current from 5 ms after STOP on")
@needs(*TURNS, "encoder", "currents", "load.speed", "hall-faults")
@energises(speed_rpm=100, current=8)
@pytest.mark.parametrize("pair", PAIRS)
def test_hall_wires_exchanged(
    pair: str, drive: Drive, load: NodeLoad, record: Record, hall_faults: HallFaults, measure: Measure, figure: Figure
) -> None:
    """With two Hall wires exchanged the drive is asked for 100 r/min for a second.

    It cannot turn; it must not draw more than its limit, run away, or trip for another reason.
    """
    load.speed(60 * RPM)  # the Hall sensors are seen once before
    record.wait(0.2)
    load.torque(0.0)
    record.wait(0.3)
    hall_faults.swap(pair)
    with drive.may_trip():
        drive.start(own_angle(drive))
        with record.stretch() as stretch:
            drive.speed(100 * RPM)
            record.until(lambda: bool(drive.faults), 0.9)
        run = stretch.capture
        faults = drive.faults
        drive.stop()
        hall_faults.clear()
        record.wait(0.1)
        after = record(0.1)
        drive.forget_faults()
    measure("current_max", current(run).max(), run)
    measure("speed_max", np.abs(rpm(run)).max(), run)
    measure("only_hall", faults in ((), ("HALL",)))
    measure("current_after", current(after).max(), after)
    figure(
        f"drive_exchanged_{pair}",
        f"100 r/min asked for with the Hall wires {pair[0]} and {pair[1]} exchanged; dashed: the current limit",
        lambda: draw_run(run, ("speed", "hall", "phases"), {"FAULT": tripped(run)}),
    )


@limit("implausible_edges", "", lo=4, hi=200, about="edges that skip a sector or lead to 000 or 111: the burst came")
@limit("current_max", "A", lo=0.2, hi=6, about="largest phase current from the burst on")
@limit("speed_after", "r/min", lo=497, hi=503, about="mean 0.2 s later")
@needs(*TURNS, "currents", "feature:EDGES", "channel:hall", "hall-faults")
@energises(speed_rpm=500, current=8)
def test_hall_glitches(drive: Drive, record: Record, hall_faults: HallFaults, measure: Measure) -> None:
    """A thousand false pulses a second for 50 ms at 500 r/min: the drive must not trip, and goes on.

    Two false edges close together make any Hall speed: that `omega_avg` leaves its range is no flaw of the data.
    """
    burst, after = _glitches(drive, record, hall_faults)
    changed = burst.edges.hall_old ^ burst.edges.hall_new
    several = (changed & (changed - 1)) != 0
    needed = only(burst, "hall", "i_d", "i_q", *PHASES)
    measure("implausible_edges", int((several | (burst.edges.illegal != 0)).sum()), needed)
    measure("current_max", current(burst).max(), needed)
    measure("speed_after", rpm(after).mean(), after)


@limit("error_max", "deg", lo=4, hi=85, about="largest position error during the burst and 0.1 s after it")
@limit("speed_deviation", "r/min", lo=0.5, hi=110, about="largest from 500 r/min, in the same time")
@limit("error_std_after", "deg", lo=1, hi=4, about="position error 0.2 s later")
@limit("error_max_after", "deg", lo=2, hi=8, about="largest position error 0.2 s later")
@needs(*TURNS, *VECTOR, "encoder", "channel:hall", "hall-faults")
@energises(speed_rpm=500, current=8)
def test_hall_glitches_error(
    drive: Drive, record: Record, hall_faults: HallFaults, measure: Measure, figure: Figure
) -> None:
    """The position error under the same false pulses: bounded, and as before soon after."""
    burst, after = _glitches(drive, record, hall_faults)
    error_after = error_deg(after, PROPOSED)
    needed = only(burst, "theta_enc", "omega_enc", "theta_vt")
    measure("error_max", np.abs(error_deg(burst, PROPOSED)).max(), needed)
    measure("speed_deviation", np.abs(rpm(burst) - 500.0).max(), needed)
    measure("error_std_after", error_after.std(), after)
    measure("error_max_after", np.abs(error_after).max(), after)
    figure(
        "drive_glitches",
        "1000 false pulses a second on the Hall wires for 50 ms at 500 r/min; the inputs as the drive samples them",
        lambda: draw_run(burst, ("speed", "error", "hall"), {}),
    )


@limit("trip_time", "s", lo=0.19, hi=0.26, about="from the last set point to FAULT")
@limit("lateness", "ms", lo=-5, hi=60, about="the same, less the drive's watchdog time")
@limit("named", "", lo=1, hi=1, about="1: WATCHDOG is the fault, and the only one")
@limit("outputs_off", "", lo=1, hi=1, about="1: the heartbeats after that say so")
@needs(*TURNS)
@energises(speed_rpm=220, current=8)
def test_watchdog(drive: Drive, record: Record, measure: Measure) -> None:
    """The host falls silent at 200 r/min: the drive switches itself off.

    The last that it hears is a set point, whose effect shows in the data when that was.
    """
    run, last, named, off = _silence(drive, record, lambda: None)
    trip_time = tripped(run) - last
    measure("trip_time", trip_time, run)
    measure("lateness", 1e3 * (trip_time - drive.parameters.get("watchdog", WATCHDOG)), run)
    measure("named", named)
    measure("outputs_off", off)


@limit(
    "current_before", "A", lo=1, hi=5, about="largest phase current before the trip: there was a torque to take away"
)
@limit(
    "off_time", "s", lo=0.19, hi=0.26, about=f"from the last set point until all currents are below {GONE} A for good"
)
@needs(*TURNS, "currents", "load", "parameter:psi_f_hat")
@energises(speed_rpm=220, current=8)
def test_watchdog_under_load(drive: Drive, load: Load, record: Record, measure: Measure, figure: Figure) -> None:
    """The same under a load torque of 2 A: the currents that held it are gone."""
    torque = 2.0 * drive.torque_constant
    load.torque(torque)
    run, last, *_ = _silence(drive, record, load.off)
    fault = tripped(run)
    measure("current_before", largest(current(run), run.t < fault), run)
    measure("off_time", currents_gone(run) - last if not math.isnan(fault) else math.nan, run)
    figure(
        "drive_watchdog",
        "The host falls silent after a set point of 220 r/min, load torque of 2 A; dashed: the current limit",
        lambda: draw_run(run, ("speed", "dq", "phases"), {"last set point": last, "FAULT": fault}),
    )


def _silence(drive: Drive, record: Record, let_go: Callable[[], None]) -> tuple[Capture, float, bool, bool]:
    """Fall silent at 200 r/min; `let_go` takes the load off once the drive has tripped.

    Returns what came, the device time in s of the last that the drive heard, whether WATCHDOG was its only fault, and
    whether its heartbeat then said that the outputs are off.
    """
    watchdog = drive.parameters.get("watchdog", WATCHDOG)
    run_at(drive, record, 200, 0.3)
    with drive.may_trip():
        with record.stretch() as stretch:
            record.wait(0.03)
            drive.node.client.feed(drive.node.number, on=False)
            drive.speed(220 * RPM)
            record.until(lambda: bool(drive.faults), 3.0 * watchdog)
            let_go()
            record.wait(0.05)
        run, named = stretch.capture, drive.faults == ("WATCHDOG",)
        heartbeat = drive.node.next_heartbeat()
        drive.forget_faults()
    last = stepped(run, "omega_ref") if "omega_ref" in run else run.span[0]
    return run, last, named, heartbeat is not None and not heartbeat.outputs_on


def _glitches(drive: Drive, record: Record, hall_faults: HallFaults) -> tuple[Capture, Capture]:
    """False pulses on the Hall wires at 500 r/min: from the first of them to 0.1 s after the last, and later."""
    run_at(drive, record, 500, 0.5)
    with record.stretch() as stretch:
        hall_faults.glitches(1000)
        record.wait(0.05)
        hall_faults.glitches(0)
        record.wait(0.1)
    record.wait(0.2)
    return stretch.capture, record(0.24)


def _wiring(run: Capture) -> str:
    """What `diagnose` names; why it cannot, where it cannot."""
    try:
        return diagnose(run[run.reference], run["hall"].astype(np.int64)).best
    except ValueError as error:
        return str(error)
