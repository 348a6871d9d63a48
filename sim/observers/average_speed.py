"""Position by the average speed, (1)-(2): the estimate that the paper compares itself with.

The paper names two of the kind, linear extrapolation [13] and the zeroth-order algorithm [14], [15]. Both are this: the
speed is taken to be constant over a sector, of order zero, so the angle grows linearly.

theta_hat = theta_s + omega_h * (time since the edge), kept inside the sector. The edge's captured time takes
the place of (2)'s count n of sampling periods, so an edge between two samples costs no resolution.

While no speed is known: the centre of the sector (at most 30 deg wrong) as long as no edge was passed;
after the first edge its angle, then the middle between the edge and the furthest that the rotor can have
come at its largest speed, which is the centre of the sector again within a millisecond.

Never looks at a current, and knows nothing of the sensors' misplacement: boundaries are taken at k * 60 deg from
where the ring sits, `hall_offset`.

Source: (1)-(2) of Kim et al. 2011, DOI 10.1109/TIE.2010.2098367.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from sim.numba_cache import kernel
from sim.observers import hall_speed
from sim.observers.hall_speed import SECTOR_WIDTH
from sim.observers.transforms import wrap

HALF_SECTOR = SECTOR_WIDTH / 2.0
FASTEST = 1.5  # of the largest speed reference: no pair of edges makes more


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The drive's parameters that the front end takes."""

    n_p: float
    omega_m_max: float  # mechanical rad/s
    hall_timeout: float  # s
    hall_offset: float = 0.0  # electrical rad, ideal angle of the edge that opens sector 0


class Params(NamedTuple):
    """Constants of the estimate."""

    hall: hall_speed.Params
    omega_max: float  # largest electrical speed, rad/s
    hall_offset: float  # electrical rad


def make_params(tick_hz: float, drive: Settings) -> Params:
    """Constants for a counter of `tick_hz` Hz."""
    omega_max = float(drive.n_p) * float(drive.omega_m_max)
    front = hall_speed.make_params(tick_hz, drive.hall_timeout, FASTEST * omega_max)
    return Params(front, omega_max, float(drive.hall_offset))


@kernel
def centre(sector: int, hall_offset: float) -> float:
    """Angle of a sector's middle, electrical rad, not wrapped; sector 0 opens at `hall_offset`."""
    return sector * SECTOR_WIDTH + HALF_SECTOR + hall_offset


@kernel
def position(params: Params, hall: hall_speed.Estimate) -> float:
    """Estimated angle, electrical rad in [-pi, pi), from the front end's result; 0: no sector known yet."""
    if hall.sector < 0:
        return 0.0
    if hall.anchored == 0:
        travel = hall.omega * hall.age
        return wrap(centre(hall.sector, params.hall_offset) + min(max(travel, -HALF_SECTOR), HALF_SECTOR))
    if hall.omega == 0.0:
        travel = min(0.5 * params.omega_max * hall.age, HALF_SECTOR)
    else:
        travel = min(abs(hall.omega) * hall.age, SECTOR_WIDTH)
    return wrap(centre(hall.sector, params.hall_offset) + hall.direction * (travel - HALF_SECTOR))
