"""The paper's Fig. 13: total harmonic distortion of a phase current over load and speed, for both approaches.

Limits are for the paper's drive; another one states its own in bench.toml.

Source: (20) of Kim et al. 2011, DOI 10.1109/TIE.2010.2098367.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from bench.acceptance import RPM, Capture, Drive, Limits, energises, limit, limits, needs
from bench.acceptance.fixtures import Record
from bench.acceptance.loads import Load
from bench.acceptance.plots.thd_map import draw_thd_map
from bench.acceptance.suite.common import AVERAGE, PROPOSED, WORDS, or_nan, rpm, settle, whole_turns
from bench.acceptance.waveforms import thd_by_angle

Measure = Callable[..., bool]
Figure = Callable[..., None]

SPEEDS = tuple(range(250, 2501, 250))  # r/min
TYPICAL = {
    PROPOSED: {
        2.0: (8.2, 13.2, 18.5, 22.2, 26.3, 29.4, 31.8, 34.1, 36.1, 37.7),
        4.0: (4.5, 7.7, 11.0, 13.6, 16.1, 18.0, 19.5, 21.0, 22.3, 23.4),
        6.0: (3.5, 6.0, 8.6, 10.7, 12.6, 14.0, 15.3, 16.2, 17.2, 18.0),
        8.0: (3.2, 5.5, 8.0, 10.0, 11.7, 12.9, 13.7, 14.6, 15.2, 15.7),
    },
    AVERAGE: {
        2.0: (25.3, 42.0, 56.9, 66.1, 74.8, 81.5, 83.4, 84.3, 87.2, 91.1),
        4.0: (17.6, 25.6, 33.5, 39.4, 44.5, 49.6, 52.9, 56.2, 60.9, 66.3),
        6.0: (15.8, 20.5, 25.6, 29.7, 35.4, 39.5, 41.4, 44.9, 46.7, 50.5),
        8.0: (15.4, 18.8, 22.6, 25.8, 29.4, 32.8, 35.0, 38.3, 41.6, 45.3),
    },
}
"""THD in % that the paper's drive has, by approach and load (A of q current), at each of SPEEDS."""
SPREAD = {PROPOSED: (0.08, 0.3), AVERAGE: (0.12, 1.0)}
"""Allowed to either side: a share of the typical value, and %."""
LOADS = tuple(TYPICAL[PROPOSED])
APPROACHES = (PROPOSED, AVERAGE)
HEADROOM = 0.5  # A below the drive's i_max, which its speed loop needs for itself
WITHIN = {PROPOSED: 0.02, AVERAGE: 0.3}
"""How near the speed must come, as a share: the average-speed approach's ripple runs into the current limit."""
OVERCOME = 0.5  # as a share, how far the speed is from what it should be when the load is taken off
TRIES = 10  # stretches that are recorded until one is steady


def _allowed(observer: str, amps: float, speed: int, typical: float) -> Limits:
    share, more = SPREAD[observer]
    margin = share * typical + more
    return Limits(
        _name(observer, amps, speed), "%", round(typical - margin, 1), round(typical + margin, 1), "THD of i_a"
    )


def _name(observer: str, amps: float, speed: int) -> str:
    return f"thd.{WORDS[observer]}.{amps:g}A.{speed}rpm"


@limits(
    *(
        _allowed(observer, amps, speed, typical)
        for observer, rows in TYPICAL.items()
        for amps, row in rows.items()
        for speed, typical in zip(SPEEDS, row, strict=True)
    )
)
@limit("ratio_max", "", hi=0.5, about="THD of the proposed approach over that of the average speed, largest")
@limit("rise", "", lo=1.3, hi=2.2, about="THD of the proposed approach at 2500 r/min over that at 1000, least")
@needs("encoder", "load")
@energises(speed_rpm=2500, current=8)
def test_fig13_thd_map(drive: Drive, load: Load, record: Record, measure: Measure, figure: Figure) -> None:
    """Fig. 13: THD (20) of i_a at 2 to 8 A and 250 to 2500 r/min, with both approaches.

    The drive keeps the speed, the load the current: as far as the drive's own limit leaves its speed loop room, and
    less what friction takes, which is found without load. A point at which speed and current do not settle has no THD.
    """
    speeds, thd = np.full((2, len(APPROACHES), len(LOADS), len(SPEEDS)), math.nan)
    captures = []
    drive.start(PROPOSED)
    for k, speed in enumerate(SPEEDS):
        load.torque(0.0)
        drive.observe(PROPOSED)
        drive.speed(speed * RPM)
        assert settle(record, speed), f"{speed} r/min were not reached without load"
        friction = whole_turns(record(_turn(speed)))["i_q"].mean()
        for j, amps in enumerate(LOADS):
            for i, observer in enumerate(APPROACHES):
                drive.observe(observer)
                load.torque(drive.torque_constant * (min(amps, drive.parameters["i_max"] - HEADROOM) - friction))
                capture, settled = _steady(record, speed, observer)
                if settled:
                    thd[i, j, k] = thd_of_current(capture)
                else:
                    load.torque(0.0)
                speeds[i, j, k] = rpm(capture).mean()
                captures.append(capture)
                measure(_name(observer, amps, speed), thd[i, j, k], capture)
    proposed, average = thd
    measure("ratio_max", (proposed / average).max(), *captures)
    measure("rise", (proposed[:, SPEEDS.index(2500)] / proposed[:, SPEEDS.index(1000)]).min(), *captures)
    figure(
        "fig13",
        "THD (20) of the phase current over the speed that was kept, by load: (a) average speed, (b) proposed. "
        f"The highest load is {HEADROOM:g} A below the drive's largest current, which its speed loop needs.",
        lambda: draw_thd_map(LOADS, {"(a) average speed": (speeds[1], average), "(b) proposed": (speeds[0], proposed)}),
    )


def thd_of_current(capture: Capture) -> float:
    """THD (20) of i_a in %, by the electrical angle; NaN if there are no three periods of it."""
    return or_nan(lambda: 100.0 * thd_by_angle(capture.theta, capture["i_a"]).value)


def _turn(speed_rpm: float) -> float:
    """Seconds in which there is a whole mechanical turn, also where the speed has dropped a little."""
    return max(0.1, 1.3 * 60.0 / speed_rpm)


def _steady(record: Record, speed_rpm: float, observer: str) -> tuple[Capture, bool]:
    """Whole turns at `speed_rpm` whose halves agree in speed and current; False with the last tried if there are none.

    A drive that the load overcomes is given up at once.
    """
    record.wait(0.1)
    for _ in range(TRIES):
        capture = whole_turns(record(_turn(speed_rpm)))
        first, second = _halves(capture)
        off = abs(rpm(capture).mean() / speed_rpm - 1.0)
        even = abs(rpm(first).mean() - rpm(second).mean()) <= 0.01 * speed_rpm
        if off <= WITHIN[observer] and even and abs(first["i_q"].mean() - second["i_q"].mean()) <= 0.15:
            return capture, True
        if off > OVERCOME:
            break
    return capture, False


def _halves(capture: Capture) -> tuple[Capture, Capture]:
    middle = sum(capture.span) / 2.0
    return capture.between(capture.span[0], middle), capture.between(middle, capture.span[1])
