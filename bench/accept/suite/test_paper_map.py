"""The paper's Fig. 13: total harmonic distortion of a phase current over load and speed, for both approaches.

What a THD must be nobody says: the values are for information, and the proposed approach must have less than the
average speed.

Source: (20) of Kim et al. 2011, DOI 10.1109/TIE.2010.2098367.
"""

from __future__ import annotations

import numpy as np

from bench.accept import Drive, Limits, Ratings, called, energises, limit, limits, needs
from bench.accept.fixtures import Record
from bench.accept.plots.by_speed import draw_thd_map
from bench.accept.suite.common import (
    AVERAGE,
    PAPER,
    PROPOSED,
    WORDS,
    Figure,
    Measure,
    loaded,
    percent,
    ratio,
    shares,
    thd_of_current,
    turns_for_thd,
    whole_turns,
)
from bench.rig.loads import NodeLoad

pytestmark = needs(*PAPER)

SPEEDS = tuple(k / 12 for k in range(1, 11))  # of the rated speed
LOADS = (1 / 4, 1 / 2, 3 / 4, 1.0)  # of the rated current
APPROACHES = (PROPOSED, AVERAGE)
SETTLING = 0.1  # s for the estimate and the currents after a change
LITTLE = 10.0  # %: with less than this neither approach disturbs a motor, and which has more means nothing


def _name(observer: str, load: float, speed: float) -> str:
    return f"thd.{WORDS[observer]}.load{percent(load)}.speed{percent(speed)}"


@called("Fig. 13: distortion of the current")
@limits(
    *(
        Limits(_name(observer, load, speed), "%", about=f"THD of i_a at {shares(load, speed)}")
        for observer in APPROACHES
        for load in LOADS
        for speed in SPEEDS
    )
)
@limit("ratio", "", hi=0.8, about=f"THD, proposed to average speed, means; the latter counts as {LITTLE:g} % at least")
@needs("load.speed", "rate:16000")
@energises(rated_speed=SPEEDS[-1], rated_current=1)
def test_fig13_thd_map(
    drive: Drive, rated: Ratings, load: NodeLoad, record: Record, measure: Measure, figure: Figure
) -> None:
    """Fig. 13: THD (20) of i_a at 25 to 100 % of the current and 8 to 83 % of the speed, with both approaches.

    The load holds the speed and the drive keeps the q current, so that neither a speed loop's gains nor its current
    limit are part of it. What differs is the estimate that the current loop is given, its angle and its speed; both
    speeds should pass the same low-pass.
    """
    drive.start(PROPOSED)
    captures = {}
    for speed in SPEEDS:
        load.speed(rpm=speed * rated.speed_rpm)
        for amps in LOADS:
            drive.current(amps * rated.current)
            for observer in APPROACHES:
                drive.observe(observer)
                seconds = turns_for_thd(drive, speed * rated.speed_rpm)
                captures[speed, amps, observer] = loaded(record, drive, amps * rated.current, seconds, SETTLING)
    drive.stop()  # what follows takes longer than the watchdog
    thd = {}
    for (speed, amps, observer), capture in captures.items():
        thd[observer, amps, speed] = thd_of_current(whole_turns(capture))
        measure(_name(observer, amps, speed), thd[observer, amps, speed], capture)
    proposed, average = (
        np.array([[thd[observer, amps, speed] for speed in SPEEDS] for amps in LOADS]) for observer in APPROACHES
    )
    measure("ratio", ratio(float(proposed.mean()), float(average.mean()), LITTLE), *captures.values())
    figure(
        "fig13",
        "THD (20) of the phase current over speed, by q current: (a) average speed, (b) proposed.",
        lambda: draw_thd_map(
            [amps * rated.current for amps in LOADS],
            [speed * rated.speed_rpm for speed in SPEEDS],
            {"(a) average speed": average, "(b) proposed": proposed},
        ),
    )
