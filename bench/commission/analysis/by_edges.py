"""The shaft's angle and speed without an encoder: through its Hall edges, each where it is known to lie."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from bench.commission.analysis.edges import HallEdges
from bench.commission.window import Edges, Floats, Window
from bench.signal.position import unwrapped
from bench.signal.waveforms.sectors import SECTOR_WIDTH, SECTORS, edge_passages

OVERDUE = 1.5
"""Sectors that the shaft may have gone at most since the last edge."""


def passed(edges: Edges, places: HallEdges) -> tuple[Floats, Floats]:
    """When edges were passed, PWM periods, and the flux's angle then, electrical rad, not wrapped; (m,) each.

    Edges that are none of neighbouring sectors are left out.
    """
    edge, way = edge_passages(edges.old & 7, edges.new & 7)
    up, down = (
        np.array([places.ring.value + s * SECTOR_WIDTH - each.value for s, each in enumerate(six)])
        for six in (places.up, places.down)
    )
    told = way != 0
    return edges.index[told], unwrapped(np.where(way > 0, up[edge], down[edge])[told])


def speed(recent: Edges, places: HallEdges, T: float) -> tuple[float, float]:
    """rad/s, electrical, by the last electrical turn of edges up to index 0, and the rad gone since, if it kept on.

    A shaft of which no edge came is as fast as that allows. It keeps on as it went through the last two sectors; one
    that has not gone a whole turn need not, and has gone 0. T: s of a PWM period.
    """
    at, angle = passed(recent, places)
    if len(at) < 2:
        return 0.0, 0.0
    first = max(len(at) - 1 - SECTORS, 0)
    w = float(angle[-1] - angle[first]) / max(float(at[-1] - at[first]) * T, 1e-9)
    silent = -float(at[-1]) * T
    most = OVERDUE * SECTOR_WIDTH / max(silent, 1e-9)
    whole = abs(angle[-1] - angle[first]) > math.tau - SECTOR_WIDTH / 2.0
    lately = abs(angle[-1] - angle[-3]) / max(float(at[-1] - at[-3]) * T, 1e-9) if whole else 0.0
    return math.copysign(min(abs(w), most), w), min(abs(w), float(lately)) * silent


def with_angle(window: Window, places: HallEdges) -> Window:
    """The window with the flux's angle through its edges as `theta`; the same without, where fewer than two came.

    Before the first edge and after the last it goes on as fast as the next ones tell, by a sector at most.
    """
    at, angle = passed(window.edges, places)
    if len(at) < 2:
        return window
    at = at - (0.0 if places.delay is None else places.delay.value / window.T)
    ends = []
    for end, near, far in ((window.index[0], 0, min(SECTORS, len(at) - 1)),
                           (window.index[-1], -1, max(-1 - SECTORS, -len(at)))):  # fmt: skip
        slope = (angle[far] - angle[near]) / (at[far] - at[near])
        ends.append(angle[near] + float(np.clip(slope * (end - at[near]), -SECTOR_WIDTH, SECTOR_WIDTH)))
    at = np.concatenate([[min(window.index[0], at[0] - 1e-6)], at, [max(window.index[-1], at[-1] + 1e-6)]])
    return replace(window, theta=np.interp(window.index, at, np.concatenate([ends[:1], angle, ends[1:]])))
