"""How the drive holds and changes its speed beyond the paper: reversal, slowest and fastest speed, a held shaft, STOP.

All of it with vector tracking in the control loop, and with light load unless the test's name says more.
"""

from __future__ import annotations

import math

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
    needs,
)
from bench.accept.fixtures import Record
from bench.accept.plots.drive import draw_run
from bench.accept.suite.common import (
    NEARLY_GONE,
    OVER,
    PROPOSED,
    SLOW,
    STD,
    TURNS,
    VECTOR,
    Figure,
    Measure,
    around,
    electrical_turn,
    error_deg,
    errors,
    full_load,
    held,
    measure_error,
    or_nan,
    own_angle,
    ramp,
    rpm,
    run_at,
    settle,
    speed_rpm,
    whole_turns,
    within_voltage,
)
from bench.accept.suite.events import current, currents_gone, first, largest, states, stepped
from bench.accept.suite.tripping import angle_source
from bench.rig.loads import Load, NodeLoad
from bench.signal.units import RPM
from bench.signal.waveforms import settled
from protocol.codes import DriveState


@called("Reversal")
@limit("zero_lag", "ms", hi=60, about="from the reference's zero to standstill")
@limit("settling_time", "ms", hi=500, about="from the reference's end until the speed stays within 20 % of it")
@limit("overshoot", "%", hi=50, about="past the new speed, of the step")
@limit("error_max", "deg", hi=120, about="largest position error from the step on: Hall sensors alone, about zero")
@limit("error_mean", "deg", lo=-4.5, hi=4.5, about="mean position error once it has settled, in reverse")
@limit("error_std", "deg", hi=STD, about="its standard deviation")
@limit("current_max", "A", hi=OVER, of=RATED_CURRENT, about="largest phase current")
@needs(*TURNS, *VECTOR, "encoder", "currents", "channel:omega_ref")
@energises(rated_speed=SLOW, rated_current=1)
def test_reversal(drive: Drive, rated: Ratings, record: Record, measure: Measure, figure: Figure) -> None:
    """Reversal at a tenth of the rated speed, faster where there is too little back-EMF.

    The Hall speed is lost about zero and found again; the drive must not trip on the way.
    """
    speed = speed_rpm(drive, rated, 1 / 10)
    run_at(drive, record, speed, 0.4)
    run = around(record, 0.05, lambda: drive.speed(rpm=-speed), 0.6 + ramp(drive, 2.0 * speed))
    after = whole_turns(record(max(0.2, 1.1 * 60.0 / speed)))
    start, omega, reference = stepped(run, "omega_ref"), rpm(run), rpm(run, "omega_ref")
    since = run.t >= start
    zero, end = (first(run, since & (reference < to)) for to in (0.0, -0.999 * speed))
    settling = or_nan(lambda: settled(run.t[since], omega[since], -speed, 0.2 * speed, hold=0.05).time)
    measure("zero_lag", 1e3 * (first(run, since & (omega < 0.0)) - zero), run)
    measure("settling_time", 1e3 * (start + settling - end), run)
    measure("overshoot", 50.0 * (largest(-omega, since) / speed - 1.0), run)
    measure("error_max", largest(np.abs(error_deg(run, PROPOSED)), since), run)
    measure("error_mean", error_deg(after, PROPOSED).mean(), after)
    measure("error_std", error_deg(after, PROPOSED).std(), after)
    measure("current_max", current(run).max(), run)
    figure(
        "drive_reversal",
        f"Reversal from {speed:g} to {-speed:g} r/min, light load",
        lambda: draw_run(
            run.between(run.t[0], start + 0.35), ("speed", "error", "dq"), {"step of the reference": start}
        ),
    )


LOWEST, BARELY = 1 / 150, 0.6  # of the rated speed, and of that at which the drive begins to look at the back-EMF


@called("Lowest speed at {torque} % of the rated torque")
@limit("speed", "%", lo=5, hi=250, about="mean by the encoder, of the setpoint: it turns, no more", chance=True)
@limit("backwards", "deg", hi=360, about="largest swing back of the shaft, electrical", chance=True)
@limit("current_max", "A", hi=OVER, of=RATED_CURRENT, about="largest phase current", chance=True)
@limit("speed_ripple", "r/min", about="standard deviation by the encoder: the shaft sticks and slips", chance=True)
@limit("error_std", "deg", about="17 deg is a sector's centre held, more while the shaft slips", chance=True)
@limit("error_max", "deg", about="half a sector and its edge offset: 30 to 45 deg; more: it slipped", chance=True)
@needs(*TURNS, *VECTOR, "encoder", "currents", "channel:i_q", "load", "parameter:psi_f_hat")
@energises(rated_speed=SLOW, rated_current=1)
@pytest.mark.parametrize("torque", [0, 25])
def test_lowest_speed(
    torque: int, drive: Drive, rated: Ratings, load: Load, record: Record, measure: Measure, figure: Figure
) -> None:
    """A 150th of the rated speed, with light load and with 25 % of the rated torque: it turns, no more is asked.

    The back-EMF is no larger than what the inverter gets wrong, and the correction of the observer is off, or comes
    and goes: what is left are Hall sectors, 60 deg each. The position error is for information: who needs an angle at
    such a speed needs another sensor.
    """
    speed = speed_rpm(drive, rated, LOWEST, BARELY)
    drive.start(PROPOSED)
    drive.speed(rpm=speed)
    if torque:
        load.torque(0.01 * torque * rated.current * drive.torque_constant)
    record.wait(0.8)
    run = record(max(2.0, 3.0 * electrical_turn(drive, speed)))
    omega, turned = rpm(run), np.degrees(run.theta)
    measure("speed", 100.0 * omega.mean() / speed, run)
    measure("backwards", (np.maximum.accumulate(turned) - turned).max(), run)
    measure("current_max", current(run).max(), run)
    measure("speed_ripple", omega.std(), run)
    measure_error(measure, run, mean=False)
    figure(
        f"drive_lowest_speed_{torque}",
        f"{speed:g} r/min, {f'{torque} % of the rated torque' if torque else 'light load'}",
        lambda: draw_run(run, ("speed", "error", "dq"), {}),
    )


@called("Rated speed")
@limits(held("speed", 1, "mean, counted from Hall edges of the same kind"))
@limit("speed_ripple", "r/min", hi=0.05, of=RATED_SPEED, about="of the drive's estimate, which has Hall ripple in it")
@limit("current_max", "A", hi=0.75, of=RATED_CURRENT, about="largest phase current")
@needs(*TURNS, *VECTOR, "currents", "feature:EDGES")
@energises(rated_speed=1, rated_current=1)
def test_full_speed(drive: Drive, rated: Ratings, record: Record, measure: Measure) -> None:
    """The drive's rated speed, light load; the Hall edges tell how fast the shaft is."""
    run_at(drive, record, rated.speed_rpm, 0.7)
    run = record(0.2)
    measure("speed", 100.0 * _speed_by_edges(run) / rated.speed_rpm, run)
    measure("speed_ripple", rpm(run, "omega_vt").std(), run)
    measure("current_max", current(run).max(), run)


@called("Position error at rated speed")
@limits(*errors())
@needs(*TURNS, *VECTOR, "encoder")
@energises(rated_speed=1, rated_current=1)
def test_full_speed_error(drive: Drive, rated: Ratings, record: Record, measure: Measure) -> None:
    """The position error at the drive's rated speed, light load."""
    run_at(drive, record, rated.speed_rpm, 0.7)
    measure_error(measure, record(0.2))


@called("High power")
@limits(held("speed", 2, "mean by the encoder"))
@limit("i_q", "A", hi=1, of=RATED_CURRENT, about="mean: three quarters of load and the friction")
@limits(*errors(about=", with iron that saturates", saturated=0.1))
@limit("current_max", "A", hi=OVER, of=RATED_CURRENT, about="largest phase current")
@needs(*TURNS, *VECTOR, "encoder", "currents", "channel:i_q", "channel:u_dc", "load")
@needs("parameter:psi_f_hat", "parameter:R_s_hat", "parameter:L_s_hat")
@energises(rated_speed=5 / 6, rated_current=1)
def test_high_power(drive: Drive, rated: Ratings, load: Load, record: Record, measure: Measure) -> None:
    """Three quarters of the rated torque at five sixths of the rated speed, or at what the voltage allows.

    The rest up to the current limit is for friction and the ripple of the estimated speed: where that reaches the
    limit, the shaft stays slower than it should be.
    """
    u_dc = float(record(0.01)["u_dc"].mean())
    full = full_load(drive, rated, u_dc, speed_rpm(drive, rated, 1 / 6))
    speed = min(rated.speed_rpm * 5 / 6, within_voltage(drive, u_dc, full))
    run_at(drive, record, speed, 0.44)
    for share in (3 / 8, 3 / 4):  # in two steps: a single one takes the speed far down
        load.torque(share * full * drive.torque_constant)
        record.wait(0.2)
    settle(record, speed, within=0.004, timeout=2.0)
    run = record(0.24)
    measure("speed", 100.0 * rpm(run).mean() / speed, run)
    measure("i_q", run["i_q"].mean(), run)
    measure_error(measure, run)
    measure("current_max", current(run).max(), run)


BEYOND_VOLTAGE = 1.05  # of the largest that linear modulation gives: what the voltage limit is asked for


@called("Voltage limit")
@limit("voltage", "%", hi=116, about="mean of what linear modulation gives, while the current asks for more")
@limit("reached", "%", hi=110, about="mean d current then, of the reference; 100: the voltage is no limit")
@limit("current_max", "A", hi=OVER, of=RATED_CURRENT, about="largest phase current")
@limit("current_after", "A", hi=0.35, of=RATED_CURRENT, about="largest phase current from 3 ms after the reference on")
@needs(*TURNS, "currents", "load.speed", "channel:i_d", "channel:i_d_ref")
@needs("channel:u_alpha", "channel:u_beta", "channel:u_dc", "parameter:L_s_hat", "parameter:psi_f_hat")
@energises(rated_speed=1, rated_current=1)
def test_voltage_limit(drive: Drive, rated: Ratings, load: NodeLoad, record: Record, measure: Measure) -> None:
    """At the rated speed a current along the rotor's flux, which adds to the back-EMF until it is too much; then none.

    What the current loop winds up meanwhile shows once the reference is gone.
    """
    drive.start(angle_source(drive))
    load.speed(rpm=rated.speed_rpm)
    assert settle(record, rated.speed_rpm), f"{rated.speed_rpm:g} r/min were not reached"
    most = float(record(0.01)["u_dc"].mean()) / math.sqrt(3.0)
    more = BEYOND_VOLTAGE * most / (rated.speed_rpm * RPM * drive.n_p) - drive.parameters["psi_f_hat"]
    i_d = min(max(more / drive.parameters["L_s_hat"], 0.1 * rated.current), rated.current)
    drive.current(0.0, i_d)
    record.wait(0.1)
    limited = record(0.1)
    run = around(record, 0.01, lambda: drive.current(0.0), 0.1)
    measure("voltage", 100.0 * np.hypot(limited["u_alpha"], limited["u_beta"]).mean() / most, limited)
    measure("reached", 100.0 * limited["i_d"].mean() / i_d, limited)
    measure("current_max", max(current(limited).max(), current(run).max()), limited, run)
    measure("current_after", largest(current(run), run.t >= stepped(run, "i_d_ref") + 3e-3), run)


@called("Stall and restart")
@limit(
    "current_held",
    "A",
    lo=0.5,
    hi=OVER,
    of=RATED_CURRENT,
    about="largest while the shaft is held",
    tells="current limit",
)
@limit("speed_held", "r/min", hi=0.005, of=RATED_SPEED, about="largest speed while the shaft is held")
@limit("rise_time", "ms", hi=300, about="from the first movement to 90 % of the speed")
@limit("overshoot", "%", hi=200, about="past the speed: what the speed loop had wound up")
@limit("settling_time", "ms", hi=600, about="from the first movement until the speed stays within 15 %")
@limit("current_max", "A", hi=OVER, of=RATED_CURRENT, about="largest phase current from the release on")
@needs(*TURNS, "currents", "load.speed")
@energises(rated_speed=SLOW, rated_current=1)
def test_stall_and_restart(
    drive: Drive, rated: Ratings, load: NodeLoad, record: Record, measure: Measure, figure: Figure
) -> None:
    """The load holds the shaft while a tenth of the rated speed is asked for; then it lets go.

    The current must stay at its limit, and the drive must start by itself and come down to its speed.
    """
    speed = speed_rpm(drive, rated, 1 / 10)
    load.speed(rpm=0.2 * speed)  # to some position that nobody has chosen
    record.wait(0.2)
    load.speed(rpm=0)
    record.wait(0.1)
    drive.start(own_angle(drive))
    with record.stretch() as stretch:
        drive.speed(rpm=speed)
        record.wait(0.4)
        load.torque(0.0)
        record.wait(0.8)
    run = stretch.capture
    omega = rpm(run)
    moves = first(run, omega > 0.05 * speed)
    at_rest, free = run.t < moves - 0.01, run.t >= moves
    measure("current_held", largest(current(run), at_rest), run)
    measure("speed_held", largest(np.abs(omega), at_rest), run)
    measure("rise_time", 1e3 * (first(run, omega > 0.9 * speed) - moves), run)
    measure("overshoot", 100.0 * (largest(omega, free) / speed - 1.0), run)
    settling = or_nan(lambda: settled(run.t[free], omega[free], speed, 0.15 * speed, hold=0.1).time)
    measure("settling_time", 1e3 * settling, run)
    measure("current_max", largest(current(run), free), run)
    figure(
        "drive_stall",
        f"The shaft is held while {speed:g} r/min are asked for, and let go at about 0 s",
        lambda: draw_run(run, ("speed", "dq"), {"shaft moves": moves}),
    )


@called("Stop")
@limits(held("speed_before", 2, "mean before STOP: there was something to switch off"))
@limit("command_time", "ms", hi=100, about="from before the command was sent until the drive is not RUNNING")
@limit("off_time", "ms", hi=5, about="from then until all currents are gone for good")
@limit("idle_share", "%", lo=100, about="samples in IDLE of those after RUNNING")
@limit("current_after", "A", hi=NEARLY_GONE, of=RATED_CURRENT, about="largest from 5 ms after RUNNING on")
@needs(*TURNS, "currents")
@energises(rated_speed=SLOW, rated_current=1, unrated_rpm=0.0)
def test_stop(drive: Drive, rated: Ratings, record: Record, measure: Measure) -> None:
    """STOP at a sixth of the rated speed, or at rest if nobody tells it: outputs off at once, for good, and IDLE."""
    lacking = rated.missing((RATED_SPEED, RATED_CURRENT))
    speed = 0.0 if lacking else speed_rpm(drive, rated, 1 / 6)
    run_at(drive, record, speed, 0.35)
    before = record(0.1)
    run = around(record, 0.0, drive.stop, 0.25)
    off = first(run, states(run) != DriveState.RUNNING)
    after = run.t >= off
    measure("command_time", 1e3 * (off - run.t[0]), run)
    idle = states(run)[after] == DriveState.IDLE
    measure("idle_share", 100.0 * idle.mean() if len(idle) else math.nan, run)
    if lacking:
        pytest.skip("; ".join(lacking))
    measure("speed_before", 100.0 * rpm(before).mean() / speed, before)
    measure("off_time", 1e3 * (currents_gone(run, NEARLY_GONE * rated.current) - off), run)
    measure("current_after", largest(current(run), run.t >= off + 5e-3), run)


def _speed_by_edges(run: Capture) -> float:
    """Mean mechanical r/min over as many whole electrical revolutions as there are, from the first edge on."""
    turns = (len(run.edges) - 1) // 6
    if turns < 1:
        return math.nan
    seconds = (run.edges.tick[6 * turns] - run.edges.tick[0]) / run.tick_hz
    return float(60.0 * turns / seconds / run.parameters["n_p"])
