"""Electrical sectors, and where the Hall edges lie.

Angles are electrical rad, wrapped or not. Sector k is [k * 60 deg, (k + 1) * 60 deg) from where the sensors' ring sits,
`hall_offset`. Nothing here knows a wiring other than the specified one: see `bench.findings.wiring`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bench.signal.position import wrap
from bench.signal.waveforms.samples import Floats
from protocol.signals import SECTOR_OF_CODE

SECTORS = 6
NUMERALS = ("I", "II", "III", "IV", "V", "VI")
"""Names of the sectors."""
SECTOR_WIDTH = math.pi / 3.0  # electrical rad
_STEPS = np.array([
    (0.0, 1.0, 2.0, 0.0, -2.0, -1.0)[(new - old) % SECTORS] if old >= 0 <= new else 0.0
    for old in SECTOR_OF_CODE for new in SECTOR_OF_CODE
])  # fmt: skip
"""Sectors gone, by the old code times 8 and the new one."""
FORWARD, REVERSE = 0, 1
"""Columns of `EdgeOffsets`."""


class EdgeOffsets(NamedTuple):
    """Where the edges lie: (6, 2), row s for the edge that opens sector s, columns FORWARD and REVERSE."""

    mean: Floats
    """delta = ideal - measured angle, rad in [-pi, pi), circular mean; NaN where n is 0."""
    std: Floats
    """About the mean, rad; NaN where n is 0."""
    n: NDArray[np.int64]
    dropped: int
    """Edges that join no neighbouring sectors: an illegal code, or a sector that was skipped."""


def hall_offset(parameters: Mapping[str, float]) -> float:
    """Where the ring sits by a drive's parameters: ideal angle of the edge that opens sector 0, rad; 0 if not said."""
    return parameters.get("hall_offset", 0.0)


def edge_angle(sector: NDArray[np.int64], hall_offset: float) -> Floats:
    """Ideal angles of the edges that open these sectors 0..5, rad, not wrapped; their middles lie half a sector on."""
    return np.asarray(sector * SECTOR_WIDTH + hall_offset, np.float64)


def sector_of_angle(theta: Floats, hall_offset: float = 0.0) -> NDArray[np.int64]:
    """Sector 0..5 of the angles `theta` (n,) rad, by ideal edges."""
    sector: NDArray[np.int64] = np.floor((theta - hall_offset) / SECTOR_WIDTH).astype(np.int64) % SECTORS
    return sector


def edge_offsets(
    theta_at_edge: ArrayLike,
    hall_old: NDArray[np.integer[Any]],
    hall_new: NDArray[np.integer[Any]],
    hall_offset: float = 0.0,
) -> EdgeOffsets:
    """Offsets delta of the six edges, met forward and in reverse, from Hall edges with the true angle at each.

    `theta_at_edge` (n,) rad, `hall_old` and `hall_new` (n,) codes before and after, 0..7, bit 0 = sensor a. The edge
    that opens sector s ideally lies at `hall_offset` + s * 60 deg; measured 3 deg late its delta is -3 deg, as in
    Table I of Kim et al. 2011 (DOI 10.1109/TIE.2010.2098367). Half the hysteresis is (reverse - forward) / 2.

    Raises ValueError for angles that are not finite, for arrays of different lengths and for codes beyond 7.
    """
    theta, old, new = (np.atleast_1d(np.asarray(array)) for array in (theta_at_edge, hall_old, hall_new))
    if not theta.shape == old.shape == new.shape or theta.ndim != 1:
        raise ValueError(f"angles and codes must be of one shape (n,), got {theta.shape}, {old.shape} and {new.shape}")
    if not np.isfinite(theta).all():
        raise ValueError(f"{np.count_nonzero(~np.isfinite(theta))} of {len(theta)} edges have no finite angle")
    edge, way = edge_passages(old, new)
    forward, reverse = way > 0, way < 0
    delta = wrap(edge_angle(edge, hall_offset) - theta)
    mean, std = np.full((2, SECTORS, 2), math.nan)
    n = np.zeros((SECTORS, 2), dtype=np.int64)
    for column, met in ((FORWARD, forward), (REVERSE, reverse)):
        for s in range(SECTORS):
            here = delta[met & (edge == s)]
            n[s, column] = len(here)
            if len(here):
                mean[s, column] = np.angle(np.exp(1j * here).mean())
                std[s, column] = np.sqrt(np.mean(wrap(here - mean[s, column]) ** 2))
    return EdgeOffsets(mean, std, n, int(np.count_nonzero(~(forward | reverse))))


def edge_passages(
    old: NDArray[np.integer[Any]], new: NDArray[np.integer[Any]]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Which edge was passed, and which way, from the Hall codes (n,) before and after; (n,) each.

    The edge is named by the sector 0..5 that it opens to a shaft that turns forward. The way is 1 forward, -1 in
    reverse, 0 where the codes are not those of neighbouring sectors. ValueError for a code beyond 0..7.
    """
    leaves, enters = sector_of_code(old), sector_of_code(new)
    steps = steps_between(old, new)
    way = np.where(np.abs(steps) == 1.0, steps, 0.0).astype(np.int64)
    return np.where(way > 0, enters, leaves), way


def sector_of_code(code: NDArray[np.integer[Any]]) -> NDArray[np.int64]:
    """Sector 0..5 of the Hall codes `code` (n,), -1 for 000 and 111. Raises ValueError for a code beyond 0..7."""
    if len(code) and not (code.min() >= 0 and code.max() <= 7):
        raise ValueError(f"a Hall code is 0..7, got {code.min()} to {code.max()}")
    sector: NDArray[np.int64] = np.array(SECTOR_OF_CODE)[code.astype(np.int64)]
    return sector


def steps_between(hall_old: NDArray[np.integer[Any]], hall_new: NDArray[np.integer[Any]]) -> Floats:
    """Sectors that each Hall edge goes forward, -2..2, shape (n,); 0 where a code is none, or where it goes three."""
    steps: Floats = _STEPS[(hall_old & 7) * 8 + (hall_new & 7)]
    return steps
