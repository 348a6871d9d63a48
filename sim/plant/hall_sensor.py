"""Three Hall sensors by six edge angles, with hysteresis and jitter; edge times between integration steps.

The edge that opens sector s lies at offset + s * 60 deg - delta_s (Table I), so rising and falling edges of one sensor
need not be 180 deg apart; the offset turns the whole ring. Met forwards an edge lies half the hysteresis later, met
backwards half of it earlier, and each meeting has its own jitter. Once passed, an edge is not met again before the
rotor turns round. Poles are not all alike: each edge of each pole pair may lie elsewhere by a constant of its own, all
edges of one pole pair by one angle, and those of a ring that sits off its centre by a sine of the shaft's angle.
Sensors answer late: what they show is where the rotor was `latency` ago, at the speed that it has.

The code follows the sector: 1, 3, 2, 6, 4, 5 for sectors 0..5 (bit 0 = sensor a, 1 = b, 2 = c).

Never sees a timer tick: `sim.drive.tick` turns times into ticks.

Source: Table I and Fig. 1 of Kim et al. 2011, DOI 10.1109/TIE.2010.2098367.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sim.native import Pointer
from sim.numba_cache import kernel
from sim.plant import noise

CODE_OF_SECTOR = (1, 3, 2, 6, 4, 5)
APART = 1e-6  # rad that an edge just passed keeps away, however it jitters
TWO_PI = 2.0 * math.pi


class Params(NamedTuple):
    """The sensors' constants, electrical rad."""

    edges: tuple[float, float, float, float, float, float]  # where the sectors 0..5 open
    half_hysteresis: tuple[float, float, float]  # of the sensors c, b, a, as the sectors 0, 1, 2 open by them
    jitter: float  # rms
    around: int  # edges in a turn of the shaft
    spread: float  # most by which an edge of a pole pair lies elsewhere
    latency: float  # s
    pole_pair: int  # the one that lies elsewhere, from 0 on,
    pole_pair_off: float  # and by how much
    eccentric: float  # amplitude of the sine


class State(NamedTuple):
    """Where the rotor stands between edges."""

    number: int  # of the sector: 0..5, and 6 more a turn
    below: float  # unwrapped angle under which the sector is left backwards, rad
    above: float  # unwrapped angle from which it is left forwards


def make_params(
    delta_deg: Sequence[float],
    hysteresis_deg: float,
    jitter_deg: float,
    n_p: int = 1,
    pole_pair_deg: float = 0.0,
    latency: float = 0.0,
    offset_deg: float = 0.0,
) -> Params:
    """The sensors' constants from six delta_s, widths and offset in electrical degrees, pole pairs and s."""
    e0, e1, e2, e3, e4, e5 = (math.radians(offset_deg + 60.0 * s - delta) for s, delta in enumerate(delta_deg))
    half, jitter = math.radians(hysteresis_deg) / 2.0, math.radians(jitter_deg)
    around = 6 * n_p, math.radians(pole_pair_deg), float(latency)
    return Params((e0, e1, e2, e3, e4, e5), (half, half, half), jitter, *around, 0, 0.0, 0.0)


def make_faulty(
    params: Params, hysteresis_deg: Sequence[float], late_deg: Sequence[float], magnets: Mapping[str, float]
) -> Params:
    """The constants with more hysteresis of the sensors a, b, c, and their edges later, in electrical degrees.

    `magnets`: `pole_pair` (from 1 on) lies later by `pole_pair_off_deg`; `eccentricity_deg`.
    """
    e0, e1, e2, e3, e4, e5 = (edge + math.radians(late_deg[2 - s % 3]) for s, edge in enumerate(params.edges))
    c, b, a = (
        half + math.radians(more) / 2.0 for half, more in zip(params.half_hysteresis, hysteresis_deg[::-1], strict=True)
    )
    return params._replace(
        edges=(e0, e1, e2, e3, e4, e5),
        half_hysteresis=(c, b, a),
        pole_pair=int(magnets["pole_pair"]) - 1,
        pole_pair_off=math.radians(magnets["pole_pair_off_deg"]),
        eccentric=math.radians(magnets["eccentricity_deg"]),
    )


@kernel
def edge_angle(params: Params, number: int) -> float:
    """Unwrapped angle (rad) of the edge that opens the sector `number`."""
    sector = number % 6
    edge = params.edges[sector] + TWO_PI * ((number - sector) // 6)
    if params.spread > 0.0:
        edge += params.spread * _own(number % params.around)
    if params.pole_pair_off != 0.0 and number % params.around // 6 == params.pole_pair:
        edge += params.pole_pair_off
    if params.eccentric > 0.0:
        edge += params.eccentric * math.sin(6.0 * edge / params.around)
    return edge


@kernel
def _own(number: int) -> float:
    """A number between -1 and 1 that belongs to an edge of a turn: always the same, and like drawn at random."""
    x = math.sin(12.9898 * (number + 1)) * 43758.5453
    return 2.0 * (x - math.floor(x)) - 1.0


@kernel
def seen(params: Params, theta_e: float, omega_e: float) -> float:
    """The unwrapped angle (rad) that the sensors show at an angle and a speed (rad/s)."""
    return theta_e - omega_e * params.latency


@kernel
def code(number: int) -> int:
    """The Hall code in the sector `number`."""
    return CODE_OF_SECTOR[number % 6]


@kernel
def enter(params: Params, number: int, theta_e: float, quantiles: Pointer[float], rng: np.uint64) -> State:
    """The state on entering the sector `number` at `theta_e`, with the jitter of its two edges drawn from `rng`."""
    below = edge_angle(params, number) - params.half_hysteresis[number % 3]
    above = edge_angle(params, number + 1) + params.half_hysteresis[(number + 1) % 3]
    below += params.jitter * noise.first(quantiles, rng)
    above += params.jitter * noise.second(quantiles, rng)
    return State(number, min(below, theta_e - APART), max(above, theta_e + APART))


@kernel
def init(params: Params, theta_e: float, quantiles: Pointer[float], rng: np.uint64) -> State:
    """The state at boot at the unwrapped angle `theta_e` (rad)."""
    number = math.floor((theta_e - params.edges[0]) / (math.pi / 3.0)) - 2
    while edge_angle(params, number + 1) <= theta_e:
        number += 1
    return enter(params, number, theta_e, quantiles, rng)


@kernel
def time_of(theta_0: float, omega_0: float, theta_1: float, omega_1: float, h: float, theta: float) -> float:
    """When, as a share 0..1 of a step of `h` seconds, the angle `theta` (rad) was passed.

    By the cubic through angles and speeds (electrical rad, rad/s) at both ends, with Newton's method from the chord.
    """
    way = theta_1 - theta_0
    v_0 = omega_0 * h
    v_1 = omega_1 * h
    c_2 = 3.0 * way - 2.0 * v_0 - v_1
    c_3 = v_0 + v_1 - 2.0 * way
    goal = theta - theta_0
    x = goal / way if way != 0.0 else 1.0
    for _ in range(4):
        slope = v_0 + x * (2.0 * c_2 + x * 3.0 * c_3)
        if slope * way <= 0.0:
            break
        x -= (x * (v_0 + x * (c_2 + x * c_3)) - goal) / slope
        x = min(max(x, 0.0), 1.0)
    return x
