"""How the drive holds and changes its speed beyond the paper: reversal, slowest and fastest speed, a held shaft, STOP.

All of it with vector tracking in the control loop, and with light load unless the test's name says more. The default
limits are those of the paper's drive.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from bench.acceptance import RPM, Capture, Drive, energises, limit, needs
from bench.acceptance.fixtures import Record
from bench.acceptance.plots.drive import draw_run
from bench.acceptance.suite.common import (
    PROPOSED,
    TURNS,
    VECTOR,
    Figure,
    Measure,
    around,
    error_deg,
    or_nan,
    own_angle,
    rpm,
    run_at,
    settle,
)
from bench.acceptance.suite.events import GONE, current, currents_gone, first, largest, states, stepped
from bench.analysis.waveforms import settled
from bench.rig.loads import Load, NodeLoad
from protocol.codes import DriveState


@limit("zero_time", "ms", lo=31, hi=60, about="from the step of the reference to standstill; the ramp takes 31 ms")
@limit("settling_time", "ms", lo=60, hi=400, about="from the step until the speed stays within 15 r/min")
@limit("overshoot", "%", lo=0, hi=17, about="past -300 r/min, of the 600 r/min of the step")
@limit("error_max", "deg", lo=5, hi=30, about="largest position error from the step on")
@limit("error_std_after", "deg", lo=0.5, hi=3, about="position error once it has settled")
@limit("current_max", "A", lo=2, hi=8.8, about="largest phase current")
@needs(*TURNS, *VECTOR, "encoder", "currents", "channel:omega_ref")
@energises(speed_rpm=300, current=8)
def test_reversal_300_rpm(drive: Drive, record: Record, measure: Measure, figure: Figure) -> None:
    """Reversal from 300 to -300 r/min.

    The Hall speed is lost about zero and found again; the drive must not trip on the way.
    """
    run_at(drive, record, 300, 0.4)
    run = around(record, 0.05, lambda: drive.speed(-300 * RPM), 0.5)
    after = record(0.2)
    start = stepped(run, "omega_ref")
    omega = rpm(run)
    since = run.t >= start
    measure("zero_time", 1e3 * (first(run, since & (omega < 0.0)) - start), run)
    settling = or_nan(lambda: settled(run.t[since], omega[since], -300.0, 15.0, hold=0.05).time)
    measure("settling_time", 1e3 * settling, run)
    measure("overshoot", (largest(-omega, since) - 300.0) / 6.0, run)
    measure("error_max", largest(np.abs(error_deg(run, PROPOSED)), since), run)
    measure("error_std_after", error_deg(after, PROPOSED).std(), after)
    measure("current_max", current(run).max(), run)
    figure(
        "drive_reversal",
        "Reversal from 300 to -300 r/min, light load",
        lambda: draw_run(
            run.between(run.t[0], start + 0.35), ("speed", "error", "dq"), {"step of the reference": start}
        ),
    )


@limit("speed", "r/min", lo=18, hi=25, about="mean by the encoder")
@limit("speed_min", "r/min", lo=-60, about="lowest: it must not run backwards for good")
@limit("speed_ripple", "r/min", lo=0.5, hi=35, about="standard deviation by the encoder")
@limit("error_std", "deg", lo=0.5, hi=32, about="below the speed at which the correction works: a Hall sector's width")
@limit("error_max", "deg", lo=2, hi=100, about="largest position error")
@limit("current_max", "A", hi=7.0, about="largest phase current")
@needs(*TURNS, *VECTOR, "encoder", "currents", "channel:i_q", "load", "parameter:psi_f_hat")
@energises(speed_rpm=20, current=8)
@pytest.mark.parametrize("amperes", [0, 2])
def test_low_speed_20_rpm(
    amperes: int, drive: Drive, load: Load, record: Record, measure: Measure, figure: Figure
) -> None:
    """Twenty r/min, with light load and with the torque of 2 A.

    The back-EMF is 0.08 V and the correction of the observer is off, or comes and goes: what is left are Hall sectors.
    """
    drive.start(PROPOSED)
    drive.speed(20 * RPM)
    if amperes:
        load.torque(amperes * drive.torque_constant)
    record.wait(0.8)
    run = record(2.0)
    omega, error = rpm(run), error_deg(run, PROPOSED)
    measure("speed", omega.mean(), run)
    measure("speed_min", omega.min(), run)
    measure("speed_ripple", omega.std(), run)
    measure("error_std", error.std(), run)
    measure("error_max", np.abs(error).max(), run)
    measure("current_max", current(run).max(), run)
    figure(
        f"drive_low_speed_{amperes}A",
        f"20 r/min, {f'load torque of {amperes} A' if amperes else 'light load'}",
        lambda: draw_run(run, ("speed", "error", "dq"), {}),
    )


@limit("speed", "r/min", lo=2990, hi=3010, about="mean, counted from Hall edges of the same kind")
@limit(
    "speed_ripple",
    "r/min",
    lo=5,
    hi=60,
    about="standard deviation of the drive's estimate, which has Hall ripple in it",
)
@limit("current_max", "A", lo=0.3, hi=3.5, about="largest phase current")
@needs(*TURNS, *VECTOR, "currents", "feature:EDGES")
@energises(speed_rpm=3000, current=8)
def test_full_speed_3000_rpm(drive: Drive, record: Record, measure: Measure) -> None:
    """The drive's rated speed, light load; the Hall edges tell how fast the shaft is."""
    run_at(drive, record, 3000, 1.0)
    run = record(0.2)
    measure("speed", _speed_by_edges(run), run)
    measure("speed_ripple", rpm(run, "omega_vt").std(), run)
    measure("current_max", current(run).max(), run)


@limit("error_mean", "deg", lo=-0.8, hi=0.4, about="mean position error")
@limit("error_std", "deg", lo=2, hi=5, about="position error")
@limit("error_max", "deg", lo=4, hi=12, about="largest position error")
@needs(*TURNS, *VECTOR, "encoder")
@energises(speed_rpm=3000, current=8)
def test_full_speed_3000_rpm_error(drive: Drive, record: Record, measure: Measure) -> None:
    """The position error at the drive's rated speed, light load."""
    run_at(drive, record, 3000, 1.0)
    _measure_error(measure, record(0.2))


@limit("speed", "r/min", lo=2487, hi=2513, about="mean by the encoder")
@limit("i_q", "A", lo=6.2, hi=7.1, about="mean: 6 A of load and the friction")
@limit("error_mean", "deg", lo=-0.5, hi=0.3, about="mean position error")
@limit("error_std", "deg", lo=2, hi=5.5, about="position error")
@limit("error_max", "deg", lo=4, hi=14, about="largest position error")
@limit("current_max", "A", lo=6.5, hi=9, about="largest phase current")
@needs(*TURNS, *VECTOR, "encoder", "currents", "channel:i_q", "load", "parameter:psi_f_hat")
@energises(speed_rpm=2500, current=8)
def test_high_power_2500_rpm_6_A(drive: Drive, load: Load, record: Record, measure: Measure) -> None:
    """Much load at 2500 r/min: 6 A, and about 0.6 A of friction.

    The rest up to the current limit of 8 A is for the ripple of the estimated speed: where that reaches the limit, the
    shaft stays slower than it should be.
    """
    run_at(drive, record, 2500, 0.7)
    for amperes in (3, 6):  # in two steps: a single one takes the speed far down
        load.torque(amperes * drive.torque_constant)
        record.wait(0.2)
    settle(record, 2500, within=0.004, timeout=2.0)
    run = record(0.24)
    measure("speed", rpm(run).mean(), run)
    measure("i_q", run["i_q"].mean(), run)
    _measure_error(measure, run)
    measure("current_max", current(run).max(), run)


@limit("current_held", "A", lo=5, hi=8.8, about="largest phase current while the shaft is held")
@limit("speed_held", "r/min", hi=10, about="largest speed while the shaft is held")
@limit("rise_time", "ms", lo=2, hi=60, about="from the first movement to 270 r/min")
@limit("overshoot", "%", lo=5, hi=60, about="past 300 r/min: what the speed loop had wound up")
@limit("settling_time", "ms", lo=40, hi=400, about="from the first movement until the speed stays within 30 r/min")
@limit("current_max", "A", lo=5, hi=9.2, about="largest phase current from the release on")
@needs(*TURNS, "currents", "load.speed")
@energises(speed_rpm=300, current=8)
def test_stall_and_restart(drive: Drive, load: NodeLoad, record: Record, measure: Measure, figure: Figure) -> None:
    """The load holds the shaft while 300 r/min are asked for; then it lets go.

    The current must stay at its limit, and the drive must start by itself and come down to its speed.
    """
    load.speed(60 * RPM)  # to some position that nobody has chosen
    record.wait(0.2)
    load.speed(0.0)
    record.wait(0.1)
    drive.start(own_angle(drive))
    with record.stretch() as stretch:
        drive.speed(300 * RPM)
        record.wait(0.4)
        load.torque(0.0)
        record.wait(0.5)
    run = stretch.capture
    omega = rpm(run)
    moves = first(run, omega > 15.0)
    held, free = run.t < moves - 0.01, run.t >= moves
    measure("current_held", largest(current(run), held), run)
    measure("speed_held", largest(np.abs(omega), held), run)
    measure("rise_time", 1e3 * (first(run, omega > 270.0) - moves), run)
    measure("overshoot", (largest(omega, free) - 300.0) / 3.0, run)
    settling = or_nan(lambda: settled(run.t[free], omega[free], 300.0, 30.0, hold=0.1).time)
    measure("settling_time", 1e3 * settling, run)
    measure("current_max", largest(current(run), free), run)
    figure(
        "drive_stall",
        "The shaft is held while 300 r/min are asked for, and let go at about 0 s",
        lambda: draw_run(run, ("speed", "dq"), {"shaft moves": moves}),
    )


@limit("speed_before", "r/min", lo=497, hi=503, about="mean before STOP: there was something to switch off")
@limit("command_time", "ms", lo=0, hi=100, about="from before the command was sent until the drive is not RUNNING")
@limit("off_time", "ms", lo=-1, hi=5, about=f"from then until all currents are below {GONE} A for good")
@limit("idle_share", "%", lo=100, hi=100, about="samples in IDLE of those after RUNNING")
@limit("current_after", "A", hi=GONE, about="largest phase current 5 ms after RUNNING and later")
@needs(*TURNS, "currents")
@energises(speed_rpm=500, current=8)
def test_stop_500_rpm(drive: Drive, record: Record, measure: Measure) -> None:
    """STOP at 500 r/min: outputs off at once, for good, and the drive stays IDLE."""
    run_at(drive, record, 500, 0.4)
    before = record(0.1)
    run = around(record, 0.0, drive.stop, 0.25)
    off = first(run, states(run) != DriveState.RUNNING)
    after = run.t >= off
    measure("speed_before", rpm(before).mean(), before)
    measure("command_time", 1e3 * (off - run.t[0]), run)
    measure("off_time", 1e3 * (currents_gone(run) - off), run)
    idle = states(run)[after] == DriveState.IDLE
    measure("idle_share", 100.0 * idle.mean() if len(idle) else math.nan, run)
    measure("current_after", largest(current(run), run.t >= off + 5e-3), run)


def _speed_by_edges(run: Capture) -> float:
    """Mean mechanical r/min over as many whole electrical turns as there are, from the first edge on."""
    turns = (len(run.edges) - 1) // 6
    if turns < 1:
        return math.nan
    seconds = (run.edges.tick[6 * turns] - run.edges.tick[0]) / run.tick_hz
    return float(60.0 * turns / seconds / run.parameters["n_p"])


def _measure_error(measure: Measure, run: Capture) -> None:
    error = error_deg(run, PROPOSED)
    measure("error_mean", error.mean(), run)
    measure("error_std", error.std(), run)
    measure("error_max", np.abs(error).max(), run)
