"""Past the paper: the Kalman filter on Hall edges, with the paper's observer beside it on the same samples.

Each test lets the observer learn first, as a drive does in its first seconds of use. The limits are what the observer
is meant for.

Source: docs/edge-kalman.md; the experiments are those of Figs. 8 to 13 of Kim et al. 2011,
DOI 10.1109/TIE.2010.2098367.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.accept import Capture, Drive, Limits, Ratings, called, energises, limit, limits, must_be_yes, needs
from bench.accept.faults import WIRES, HallFaults
from bench.accept.fixtures import Record
from bench.accept.plots.by_speed import Panel, draw_by_speed
from bench.accept.plots.transients import draw_transient
from bench.accept.suite.common import (
    KALMAN,
    PAPER,
    PROPOSED,
    SLOW,
    Figure,
    Measure,
    around,
    electrical_turn,
    error_deg,
    errors,
    from_reference,
    held,
    loaded,
    measure_error,
    percent,
    ramp,
    ratio,
    rpm,
    settle,
    shares,
    speed_rpm,
    thd_of_current,
    turns_for_thd,
    whole_turns,
)
from bench.accept.suite.events import first, illegal
from bench.rig.loads import NodeLoad

pytestmark = needs(*PAPER, "observer:edge-kalman")

SPEEDS = (1 / 30, 1 / 15, 1 / 6, 1 / 3, 2 / 3, 1.0)  # of the rated speed
LOADS = (1 / 8, 1 / 2, 1.0)  # of the rated current
THD_LOAD, THD_SPEEDS = LOADS[1], SPEEDS[:-1]
LESSONS = ((1 / 3, 1 / 16, 1.0), (1 / 3, 1 / 2, 0.7), (1 / 3, 1.0, 0.7), (1 / 3, 1 / 8, 0.6))
"""Where the edges are learned: speed, q current, s. The load must vary, or a wrong L_s_hat moves them."""
FROM = 1 / 6  # of the rated speed: below it the back-EMF has little to say, and errors may be `WIDER` times as large
WIDER = 1.4
STD, LARGEST = 0.8, 4.0
MOST = {True: (2.5, STD, LARGEST), False: (WIDER * 2.5, WIDER * STD, WIDER * LARGEST)}
"""Position error in deg that the filter leaves from there on, and below: mean (either sign), std, largest."""
LITTLE = 3.0  # deg: a standard deviation that is no worse than another's for being above it
SETTLING = 0.25  # s
OFF = {"R_s_hat": 1.3, "L_s_hat": 1.2, "psi_f_hat": 0.9}
"""Wrong parameters, as factors."""
CHANNELS = ("channel:theta_ek", "channel:omega_ek")


class Bench(NamedTuple):
    """What the tests here turn the shaft with."""

    drive: Drive
    rated: Ratings
    load: NodeLoad
    record: Record

    def at_point(self, speed: float, current: float, seconds: float = 0.0) -> Capture:
        """A capture at a forced speed with a q current, both as shares; as long as its own turns take if not longer."""
        rate = speed * self.rated.speed_rpm
        self.load.speed(rpm=rate)
        amps = current * self.rated.current
        self.drive.current(amps)
        settling = SETTLING + 20.0 / rate  # the load's ramp takes its time, and a slow estimate some turns
        long = max(seconds, 0.2, 2.2 * electrical_turn(self.drive, rate))
        return loaded(self.record, self.drive, amps, long, settling)

    def teach(self) -> None:
        """Start the drive on the Kalman filter and let it learn, the load machine turning the shaft."""
        self.drive.start(KALMAN)
        for speed, current, seconds in LESSONS:
            self.load.speed(rpm=speed * self.rated.speed_rpm)
            self.drive.current(current * self.rated.current)
            self.record.wait(seconds)


def _point(load: float, speed: float) -> str:
    return f"load{percent(load)}.speed{percent(speed)}"


@called("Kalman filter over speed and load")
@limits(
    *(
        declared
        for load in LOADS
        for speed in SPEEDS
        for declared in errors(f"{{}}.{_point(load, speed)}", MOST[speed >= FROM], f" at {shares(load, speed)}")
    )
)
@limits(
    *(Limits(f"thd.{_point(THD_LOAD, at)}", "%", about=f"THD of i_a at {shares(THD_LOAD, at)}") for at in THD_SPEEDS)
)
@limit("proposed.error_std.speed17", "deg", about="the paper's observer on the same samples, half the load")
@limit("proposed.error_std.speed33", "deg", about="the paper's observer on the same samples, half the load")
@limit(
    "ratio_max",
    hi=1,
    about=f"std, Kalman filter to the paper's observer, largest; below {LITTLE:g} deg as that",
    chance=True,
)
@needs("load.speed", "rate:16000", *CHANNELS)
@energises(rated_speed=1, rated_current=1)
def test_edge_kalman_map(
    drive: Drive, rated: Ratings, load: NodeLoad, record: Record, measure: Measure, figure: Figure
) -> None:
    """Kalman filter: position error from 3 to 100 % of the speed and 12 to 100 % of the current, THD of i_a."""
    grid = [(amps, speed) for amps in LOADS for speed in SPEEDS]
    bench = Bench(drive, rated, load, record)
    bench.teach()
    runs = {
        (amps, speed): bench.at_point(speed, amps, turns_for_thd(drive, speed * rated.speed_rpm))
        for amps, speed in grid
    }
    drive.stop()  # what follows takes longer than the watchdog
    std, largest = np.empty((2, 2, len(LOADS), len(SPEEDS)))  # by observer, load and speed
    for place, point in zip(np.ndindex(len(LOADS), len(SPEEDS)), grid, strict=True):
        run = runs[point]
        for k, observer in enumerate((PROPOSED, KALMAN)):
            error = error_deg(run, observer)
            std[k, *place], largest[k, *place] = error.std(), np.abs(error).max()
        measure(f"error_mean.{_point(*point)}", error_deg(whole_turns(run), KALMAN).mean(), run)
        measure(f"error_std.{_point(*point)}", std[1, *place], run)
        measure(f"error_max.{_point(*point)}", largest[1, *place], run)
    for speed in THD_SPEEDS:
        run = runs[THD_LOAD, speed]
        measure(f"thd.{_point(THD_LOAD, speed)}", thd_of_current(whole_turns(run)), run)
    for speed in (1 / 6, 1 / 3):
        error = error_deg(runs[THD_LOAD, speed], PROPOSED)
        measure(f"proposed.error_std.speed{percent(speed)}", error.std(), runs[THD_LOAD, speed])
    fast = np.array(SPEEDS) > FROM
    ratios = [ratio(*pair, LITTLE) for pair in zip(std[1][:, fast].flat, std[0][:, fast].flat, strict=True)]
    measure("ratio_max", max(ratios), *runs.values())
    figure(
        "edge_kalman_map",
        "Position error over speed, by q current: (a) standard deviation, (b) largest; the paper's observer dashed.",
        lambda: draw_by_speed(
            [speed * rated.speed_rpm for speed in SPEEDS],
            [share * rated.current for share in LOADS],
            [
                Panel("(a)", "error std", "deg", std[1], std[0], STD),
                Panel("(b)", "error max", "deg", largest[1], largest[0], LARGEST),
            ],
            "vector tracking",
        ),
    )


@called("Kalman filter: transients")
@limit("speed_step.error_max", "deg", hi=10, about="a sixth to a third of the rated speed near no load")
@limit("load_step_half.error_max", "deg", hi=15, about="near no load to half the torque, speed by the drive")
@limit("load_step_full.error_max", "deg", hi=12, about="2.5 % to full current, speed by the load, as Fig. 12")
@limits(Limits("load_step_full.error_shift", "deg", -1.5, 1.5, "of the mean error, 2.5 % to full current"))
@limit("proposed.speed_step.error_max", "deg", about="the paper's observer on the same samples")
@limits(held("speed_step.speed", 1, "after the speed step"))
@needs("load.speed", "rate:16000", "channel:omega_ref", *CHANNELS)
@energises(rated_speed=2 * SLOW, rated_current=1)
def test_edge_kalman_transients(
    drive: Drive, rated: Ratings, load: NodeLoad, record: Record, measure: Measure, figure: Figure
) -> None:
    """Kalman filter: the transients of Figs. 10 to 12."""
    bench = Bench(drive, rated, load, record)
    low = speed_rpm(drive, rated, 1 / 6)
    high = 2.0 * low
    bench.teach()
    drive.current(0.0)  # without the load it would be faster than anybody asked for
    load.torque(0.0)
    drive.speed(rpm=low)
    settle(record, low)
    speed_step = around(record, 0.1, lambda: drive.speed(rpm=high), 0.55 + ramp(drive, high - low))
    drive.speed(rpm=low)
    settle(record, low)
    torque = 0.5 * rated.current * drive.torque_constant
    load_step = around(record, 0.1, lambda: load.torque(torque), 0.6, then=lambda: load.torque(0.0))
    before = bench.at_point(low / rated.speed_rpm, 1 / 40)
    loaded_by_full = around(record, 0.0, lambda: drive.current(rated.current), 0.6, then=drive.stop)
    begun, ended = loaded_by_full.span
    full_step, after = loaded_by_full.between(begun, begun + 0.4), loaded_by_full.between(begun + 0.4, ended)
    for name, run in (("speed_step", speed_step), ("load_step_half", load_step), ("load_step_full", full_step)):
        measure(f"{name}.error_max", np.abs(error_deg(run, KALMAN)).max(), run)
    measure("proposed.speed_step.error_max", np.abs(error_deg(speed_step, PROPOSED)).max(), speed_step)
    shift = error_deg(whole_turns(after), KALMAN).mean() - error_deg(whole_turns(before), KALMAN).mean()
    measure("load_step_full.error_shift", shift, before, after)
    settled = speed_step.between(speed_step.span[1] - 0.15, speed_step.span[1])
    measure("speed_step.speed", 100.0 * rpm(settled).mean() / high, settled)
    begin = from_reference(speed_step, low, PROPOSED)
    figure(
        "edge_kalman_speed_step",
        f"Speed step, {low:g} to {high:g} r/min, near no load, the Kalman filter in the loop. "
        "(a) Estimate of the paper's observer on the same samples. (b) The Kalman filter.",
        lambda: draw_transient(
            begin, begin._replace(observer=KALMAN), -0.05, 0.2, 12, ("proposed, not in the loop", "Kalman filter")
        ),
    )


WRONG = {1 / 15: (None, None), 1 / 6: (None, None), 1 / 3: (2.0, 20.0)}
"""Shares of the rated speed, faster where R_s takes much, with what wrong parameters may leave in deg: std, largest.

Below a third nobody can demand anything: where the resistance takes half of the voltage, 30 % of it are many an EMF.
"""
WRONG_SEEN, WRONG_MOST = 8.0, 0.7
"""How many times `omega_on` that is, up to which share.

Where the back-EMF at `omega_on` is a tenth of R_s i_max, 30 % of R_s take three eighths of it then.
"""


@called("Kalman filter: wrong motor parameters")
@limits(
    *(
        Limits(f"error_std.speed{percent(speed)}", "deg", None, std, "standard deviation of the position error")
        for speed, (std, _) in WRONG.items()
    ),
    *(
        Limits(f"error_max.speed{percent(speed)}", "deg", None, most, "largest position error")
        for speed, (_, most) in WRONG.items()
    ),
)
@limit(
    "ratio", hi=1.2, about=f"std, wrong parameters to the paper's observer with its own; below {LITTLE:g} deg as that"
)
@needs("load.speed", "rate:16000", *(f"parameter:{name}" for name in OFF), *CHANNELS)
@energises(rated_speed=WRONG_MOST, rated_current=1)
def test_edge_kalman_wrong_parameters(
    drive: Drive, rated: Ratings, load: NodeLoad, record: Record, measure: Measure
) -> None:
    """Kalman filter: resistance 30 % and inductance 20 % too large, flux linkage 10 % too small, from the start on."""
    bench = Bench(drive, rated, load, record)
    drive.start(PROPOSED)
    speeds = [speed_rpm(drive, rated, at, WRONG_SEEN, WRONG_MOST) / rated.speed_rpm for at in WRONG]
    own = [bench.at_point(speed, 1.0) for speed in speeds]
    load.speed(rpm=0)
    record.wait(0.5)
    drive.stop()
    for name, factor in OFF.items():
        drive.set(name, factor * drive.parameters[name])
    bench.teach()
    runs = [bench.at_point(speed, 1.0) for speed in speeds]
    drive.stop()
    ratios = []
    for at, right, wrong in zip(WRONG, own, runs, strict=True):
        std = measure_error(measure, wrong, KALMAN, f"{{}}.speed{percent(at)}", mean=False)
        if at > FROM:
            ratios.append(ratio(std, float(error_deg(right, PROPOSED).std()), LITTLE))
    measure("ratio", max(ratios), *own, *runs)


TURNS_BROKEN = 6.0
"""Electrical revolutions for which a wire is broken, and for which it is whole again."""


@called("Kalman filter: broken Hall wires")
@limits(
    *(
        Limits(f"turns.{wire}", "turns", None, 5.0, f"until sensor {wire}, and no other, is not believed")
        for wire in WIRES
    ),
    *(
        Limits(f"error_std.{wire}", "deg", None, 15.0, "standard deviation of the position error then")
        for wire in WIRES
    ),
    must_be_yes("believed_again", "all sensors are believed within as many revolutions once a wire is whole"),
)
@needs("load.speed", "hall-faults", "channel:hall", "channel:sensors_ek", *CHANNELS)
@energises(rated_speed=FROM, rated_current=0)
def test_edge_kalman_broken_wires(
    drive: Drive, rated: Ratings, load: NodeLoad, record: Record, hall_faults: HallFaults, measure: Measure
) -> None:
    """Kalman filter: a Hall wire after the other breaks while the load machine turns the shaft, outputs off.

    With the outputs on the drive trips before the filter has doubted the sensor.
    """
    speed = rated.speed_rpm * FROM
    load.speed(rpm=speed)
    assert settle(record, speed), f"{speed:g} r/min were not reached"
    turn, again = electrical_turn(drive, speed), []
    for wire, bit in WIRES.items():
        with record.stretch() as stretch:
            hall_faults.open(wire)
            record.wait(TURNS_BROKEN * turn)
        run = stretch.capture
        hall_faults.clear()
        record.wait(TURNS_BROKEN * turn)
        again.append(record(turn))
        named = _not_believed(run) == bit
        known = first(run, named) if named[-1] else math.nan
        measure(f"turns.{wire}", (known - illegal(run)) / turn, run)
        measure(f"error_std.{wire}", error_deg(run, KALMAN)[run.t >= known].std() if named[-1] else math.nan, run)
    measure("believed_again", not any(_not_believed(run).any() for run in again), *again)


def _not_believed(run: Capture) -> NDArray[np.int64]:
    """Bits 0 to 2: sensor a, b, c."""
    return run["sensors_ek"].astype(np.int64) & 7
