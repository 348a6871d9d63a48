"""Position by the average speed with a table of the boundaries where they really are, found at commissioning.

As `average_speed`, but the boundary that opens sector s lies at s * 60 deg less the table's entry, from where the ring
sits: one entry for each way of passing it, and a sensor's hysteresis is then in the table too. The speed is the true
width of the passed sector by the time that its passing took, and the estimate stays inside the true sector. With the
right table and a constant speed only the jitter of the edges is left.

What the source leaves open, and how it is settled here:
- omega_h of (1) is (pi/3) / (time between the last two edges): times width / (pi/3) it is the speed. It is scaled at
  the edge, by the sector just passed, and held; an edge that measures nothing (the first, a reversal, the one after a
  re-synchronisation) keeps the magnitude that the estimate had.
- While an edge is overdue |omega| is at most (true width) / (time since the last edge).
- An edge that the front end takes back brings back the speed from before it.
- While the way is unknown a boundary lies midway between its two entries.

Never looks at a current and never learns the table: its entries are the drive's parameters edge_up_1..6 and
edge_down_1..6.

Source: P. B. Beccue, S. D. Pekarek, B. J. Deken, A. C. Koenig, "Compensation for asymmetries and misalignment in a
Hall-effect position observer used in PMSM torque-ripple control", IEEE Trans. Ind. Appl., vol. 43, no. 2, pp. 560-570,
2007 (the paper lists it by the authors' first names).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from sim.numba_cache import kernel
from sim.observers.hall_edges import HallEdges
from sim.observers.hall_speed import SECTOR_WIDTH
from sim.observers.sample import Sample
from sim.observers.transforms import wrap

Six = tuple[float, float, float, float, float, float]


@dataclass(frozen=True, kw_only=True)
class Settings(HallEdges):
    """The drive's parameters that it takes: the table, and what bounds the speed."""

    n_p: float
    omega_m_max: float  # mechanical rad/s


class Params(NamedTuple):
    """Constants of the estimate; tables by sector 0..5."""

    T_s: float
    omega_max: float  # largest electrical speed, rad/s
    up: Six  # boundary that opens the sector, passed upwards, rad from the ring's own zero
    down: Six  # the same boundary, passed downwards


class State(NamedTuple):
    """What the estimate remembers."""

    direction: int  # +1, -1 or 0, at the last sample
    anchored: int  # 1: the sector of the last sample was entered over a known boundary
    omega: float  # electrical rad/s, at the last sample; 0: unknown
    omega_before: float  # at the sample before the sector was entered


class Estimate(NamedTuple):
    """One period's result."""

    theta: float  # electrical rad in [-pi, pi), at the sample; 0: no sector known yet
    omega: float  # electrical rad/s


def make_params(pwm_hz: float, drive: Settings) -> Params:
    """Constants for control periods at `pwm_hz` Hz."""
    table = drive.places()
    return Params(
        1.0 / float(pwm_hz),
        float(drive.n_p) * float(drive.omega_m_max),
        _boundaries(table[:6]),
        _boundaries(table[6:]),
    )


def _boundaries(delta: list[float]) -> Six:
    """Angles (rad) of the boundaries that open sectors 0..5, from their six offsets."""
    a, b, c, d, e, f = (s * SECTOR_WIDTH - offset for s, offset in enumerate(delta))
    return a, b, c, d, e, f


@kernel
def init() -> State:
    """Nothing known yet."""
    return State(0, 0, 0.0, 0.0)


@kernel
def _boundary(params: Params, direction: int, sector: int) -> float:
    """Angle (rad) of the boundary that opens `sector`, passed upwards (+1), downwards (-1) or either way (0)."""
    if direction > 0:
        return params.up[sector]
    if direction < 0:
        return params.down[sector]
    return 0.5 * (params.up[sector] + params.down[sector])


@kernel
def _span(params: Params, direction: int, sector: int) -> tuple[float, float]:
    """Angle of a sector's lower boundary and its width (rad), for a rotor that passes both in `direction`."""
    opens = _boundary(params, direction, sector)
    closes = _boundary(params, direction, (sector + 1) % 6) + (2.0 * math.pi if sector == 5 else 0.0)
    return opens, max(closes - opens, 0.0)


@kernel
def step(params: Params, state: State, sample: Sample) -> tuple[State, Estimate]:
    """One control period."""
    hall = sample.hall
    if hall.sector < 0:
        return init(), Estimate(0.0, 0.0)
    direction = hall.direction
    omega = state.omega
    omega_before = state.omega_before
    entered = hall.age < params.T_s  # in this period
    if entered:
        omega_before = omega
    if hall.omega == 0.0:
        omega = 0.0
    elif hall.edge == 1 and not entered:  # an edge was taken back
        omega = state.omega_before
    elif hall.edge == 1:
        if state.anchored == 1 and direction == state.direction:
            _, passed = _span(params, direction, (hall.sector - direction) % 6)
            omega = hall.omega * (passed / SECTOR_WIDTH)
        else:
            omega = direction * abs(omega)

    opens, width = _span(params, direction, hall.sector)
    middle = opens + 0.5 * width
    if abs(omega) * hall.age > width:  # overdue
        omega = math.copysign(width / hall.age, omega)
    if hall.anchored == 0:
        travel = omega * hall.age
        theta = middle + min(max(travel, -0.5 * width), 0.5 * width)
    elif omega == 0.0:
        travel = min(0.5 * params.omega_max * hall.age, 0.5 * width)
        theta = middle + direction * (travel - 0.5 * width)
    else:
        theta = middle + direction * (abs(omega) * hall.age - 0.5 * width)
    return State(direction, hall.anchored, omega, omega_before), Estimate(wrap(theta + sample.hall_offset), omega)
