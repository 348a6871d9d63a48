"""Past the paper: the learned-edge observer, with the paper's beside it on the same samples.

Each test lets the observer learn first, as a drive does in its first seconds of use. The limits are what the observer
is meant for; for another drive than the paper's state your own in bench.toml.

Source: docs/learned-edges.md; the experiments are those of Figs. 8 to 13 of Kim et al. 2011,
DOI 10.1109/TIE.2010.2098367.
"""

from __future__ import annotations

import numpy as np

from bench.acceptance import RPM, Capture, Drive, Limits, energises, limit, limits, needs
from bench.acceptance.fixtures import Record
from bench.acceptance.plots.by_speed import Panel, draw_by_speed
from bench.acceptance.plots.transients import draw_transient
from bench.acceptance.suite.common import (
    LEARNED,
    PAPER,
    PROPOSED,
    Figure,
    Measure,
    around,
    error_deg,
    from_reference,
    ratio,
    rpm,
    settle,
    thd_of_current,
    whole_turns,
)
from bench.rig.loads import NodeLoad

pytestmark = needs(*PAPER, "observer:learned-edges")

SPEEDS = (100, 200, 500, 1000, 2000, 3000)  # r/min
LOADS = (1.0, 4.0, 8.0)  # A of q current
THD_SPEEDS = (100, 200, 500, 1000, 2000)
THD_LOAD = 4.0
LESSONS = ((1000, 0.5, 1.0), (1000, 4.0, 0.7), (1000, 8.0, 0.7), (1000, 1.0, 0.6))
"""Where the edges are learned: speed in r/min, q current in A, s. The load must vary, or a wrong L_s_hat moves them."""
SETTLING = 0.25  # s
OFF = {"R_s_hat": 1.3, "L_s_hat": 1.2, "psi_f_hat": 0.9}
"""Wrong parameters, as factors."""
CHANNELS = ("channel:theta_le", "channel:omega_le")


def at_point(drive: Drive, load: NodeLoad, record: Record, speed: float, amps: float, seconds: float = 0.0) -> Capture:
    """A capture at a forced speed (r/min) with a q current, settled; as long as its own turns take if not longer."""
    load.speed(speed * RPM)
    drive.current(amps)
    record.wait(SETTLING + 20.0 / speed)  # the load's ramp takes its time, and a slow estimate some turns
    return record(max(seconds, 0.2, 2.2 * 60.0 / speed / drive.n_p))


def teach(drive: Drive, load: NodeLoad, record: Record) -> None:
    """Start the drive on the learned-edge observer and let it learn, the load machine turning the shaft."""
    drive.start(LEARNED)
    for speed, amps, seconds in LESSONS:
        load.speed(speed * RPM)
        drive.current(amps)
        record.wait(seconds)


@limits(
    *(
        declared
        for amps in LOADS
        for speed in SPEEDS
        for declared in (
            Limits(f"error_std.{amps:g}A.{speed}rpm", "deg", 0.01, 0.5, "position error, learned edges"),
            Limits(f"error_max.{amps:g}A.{speed}rpm", "deg", 0.05, 1.5, "its largest"),
        )
    )
)
@limits(*(Limits(f"thd.{THD_LOAD:g}A.{speed}rpm", "%", 0.1, 3.0, "THD of i_a") for speed in THD_SPEEDS))
@limit("proposed.error_std.500rpm", "deg", lo=1.5, hi=3.5, about="the paper's observer on the same samples, 4 A")
@limit("proposed.error_std.1000rpm", "deg", lo=2.5, hi=5, about="the same")
@limit("ratio_max", lo=0.005, hi=0.35, about="error std, learned edges to the paper's observer, largest")
@needs("load.speed", "rate:16000", *CHANNELS)
@energises(speed_rpm=3000, current=8)
def test_learned_edges_map(drive: Drive, load: NodeLoad, record: Record, measure: Measure, figure: Figure) -> None:
    """Learned edges: position error at 100 to 3000 r/min and 1 to 8 A, THD of a phase current, once it has learned."""
    grid = [(amps, speed) for amps in LOADS for speed in SPEEDS]
    teach(drive, load, record)
    runs = {(amps, speed): at_point(drive, load, record, speed, amps, 66.0 / speed) for amps, speed in grid}
    drive.stop()  # what follows takes longer than the watchdog
    std, largest = np.empty((2, 2, len(LOADS), len(SPEEDS)))  # by observer, load and speed
    for place, (amps, speed) in zip(np.ndindex(len(LOADS), len(SPEEDS)), grid, strict=True):
        run = runs[amps, speed]
        for k, observer in enumerate((PROPOSED, LEARNED)):
            error = error_deg(run, observer)
            std[k, *place], largest[k, *place] = error.std(), np.abs(error).max()
        measure(f"error_std.{amps:g}A.{speed}rpm", std[1, *place], run)
        measure(f"error_max.{amps:g}A.{speed}rpm", largest[1, *place], run)
    for speed in THD_SPEEDS:
        run = runs[THD_LOAD, speed]
        measure(f"thd.{THD_LOAD:g}A.{speed}rpm", thd_of_current(whole_turns(run)), run)
    for speed in (500, 1000):
        error = error_deg(runs[THD_LOAD, speed], PROPOSED)
        measure(f"proposed.error_std.{speed}rpm", error.std(), runs[THD_LOAD, speed])
    measure("ratio_max", max(map(ratio, std[1].flat, std[0].flat)), *runs.values())
    figure(
        "learned_edges_map",
        "Position error over speed, by q current: (a) standard deviation, (b) largest; the paper's observer dashed.",
        lambda: draw_by_speed(
            SPEEDS,
            LOADS,
            [
                Panel("(a)", "error std", "deg", std[1], std[0], 0.5),
                Panel("(b)", "error max", "deg", largest[1], largest[0], 1.5),
            ],
            "vector tracking",
        ),
    )


@limit("speed_step.error_max", "deg", lo=0.1, hi=3, about="500 to 1000 r/min near no load")
@limit("load_step_4A.error_max", "deg", lo=0.1, hi=3, about="near no load to 4 A at 500 r/min, speed by the drive")
@limit("load_step_8A.error_max", "deg", lo=0.1, hi=3, about="0.2 to 8 A at 500 r/min, speed by the load, as Fig. 12")
@limit("load_step_8A.error_shift", "deg", lo=-0.5, hi=0.5, about="of the mean error, 0.2 to 8 A")
@limit("proposed.speed_step.error_max", "deg", lo=3, hi=14, about="the paper's observer on the same samples")
@limit("speed_step.speed", "r/min", lo=996, hi=1004, about="after the speed step")
@needs("load.speed", "rate:16000", "channel:omega_ref", *CHANNELS)
@energises(speed_rpm=1000, current=8)
def test_learned_edges_transients(
    drive: Drive, load: NodeLoad, record: Record, measure: Measure, figure: Figure
) -> None:
    """Learned edges: the transients of Figs. 10 to 12."""
    teach(drive, load, record)
    load.torque(0.0)
    drive.speed(500 * RPM)
    settle(record, 500)
    speed_step = around(record, 0.1, lambda: drive.speed(1000 * RPM), 0.6)
    drive.speed(500 * RPM)
    settle(record, 500)
    load_step = around(record, 0.1, lambda: load.torque(4.0 * drive.torque_constant), 0.6)
    before = at_point(drive, load, record, 500, 0.2)
    full_step = around(record, 0.0, lambda: drive.current(8.0), 0.4)
    after = record(0.2)
    drive.stop()
    for name, run in (("speed_step", speed_step), ("load_step_4A", load_step), ("load_step_8A", full_step)):
        measure(f"{name}.error_max", np.abs(error_deg(run, LEARNED)).max(), run)
    measure("proposed.speed_step.error_max", np.abs(error_deg(speed_step, PROPOSED)).max(), speed_step)
    shift = error_deg(whole_turns(after), LEARNED).mean() - error_deg(whole_turns(before), LEARNED).mean()
    measure("load_step_8A.error_shift", shift, before, after)
    settled = speed_step.between(speed_step.span[1] - 0.15, speed_step.span[1])
    measure("speed_step.speed", rpm(settled).mean(), settled)
    begin = from_reference(speed_step, 500.0, PROPOSED)
    figure(
        "learned_edges_speed_step",
        "Speed step, 500 to 1000 r/min, near no load, learned edges in the loop. "
        "(a) Estimate of the paper's observer on the same samples. (b) Learned edges.",
        lambda: draw_transient(
            begin, begin._replace(observer=LEARNED), -0.05, 0.2, 12, ("proposed, not in the loop", "learned edges")
        ),
    )


@limits(
    *(
        declared
        for speed in (200, 500, 1000)
        for declared in (
            Limits(f"error_std.{speed}rpm", "deg", 0.02, 1.0, "parameters wrong, 8 A"),
            Limits(f"error_max.{speed}rpm", "deg", 0.1, 3.0, "its largest"),
        )
    )
)
@limit(
    "ratio", lo=0.01, hi=0.8, about="error std, wrong parameters to the paper's observer with the drive's own, largest"
)
@needs("load.speed", "rate:16000", *(f"parameter:{name}" for name in OFF), *CHANNELS)
@energises(speed_rpm=1000, current=8)
def test_learned_edges_wrong_parameters(drive: Drive, load: NodeLoad, record: Record, measure: Measure) -> None:
    """Learned edges: resistance 30 % and inductance 20 % too large, flux linkage 10 % too small, from the start on."""
    speeds = (200, 500, 1000)
    drive.start(PROPOSED)
    own = {speed: at_point(drive, load, record, speed, 8.0) for speed in speeds}
    load.speed(0.0)
    record.wait(0.5)
    drive.stop()
    for name, factor in OFF.items():
        drive.set(name, factor * drive.parameters[name])
    teach(drive, load, record)
    runs = {speed: at_point(drive, load, record, speed, 8.0) for speed in speeds}
    drive.stop()
    ratios = []
    for speed in speeds:
        error, paper = error_deg(runs[speed], LEARNED), error_deg(own[speed], PROPOSED)
        measure(f"error_std.{speed}rpm", error.std(), runs[speed])
        measure(f"error_max.{speed}rpm", np.abs(error).max(), runs[speed])
        ratios.append(ratio(float(error.std()), float(paper.std())))
    measure("ratio", max(ratios), *own.values(), *runs.values())
