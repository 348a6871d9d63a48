"""Hall front end: sector, direction and average speed (1) from edges and sampled codes.

What the paper leaves open, and how it is settled here:
- An edge between neighbouring sectors is the boundary between them, whichever way it is passed. The first one
  gives an angle, the second in the same direction a speed: omega_h = (pi/3) / (time between them), (1).
- While an edge is overdue the rotor is still in its sector: |omega_h| is at most (pi/3) / (time since the
  last edge). After `hall_timeout` without an edge the rotor counts as standing: speed zero, direction
  unknown.
- An edge back over the boundary just passed is a reversal: direction and the sign of omega_h change, the
  magnitude stays (as it does when a torque turns the rotor round); the time between the two is no sector's.
  A sensor that chatters on an edge so ends with the speed it began with.
- Codes 000 and 111 are ignored and counted. A jump over a sector re-synchronises: the rotor is somewhere in
  the new sector, the speed is held, and neither this edge nor the next gives a speed. A sampled code that
  contradicts the edges in two samples running (edges were lost) does the same.

Never guesses an angle (that is `average_speed`'s) and never looks at a current. Ticks are int64, and only
differences of them are used.

Source: (1) of Kim et al. 2011, DOI 10.1109/TIE.2010.2098367.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.numba_cache import jit

# Sector 0..5 by Hall code (bit 0 = sensor a, 1 = b, 2 = c); -1: a code that no rotor angle gives.
SECTOR_OF_CODE = (-1, 0, 2, 1, 4, 5, 3, -1)
SECTOR_WIDTH = math.pi / 3.0  # electrical rad
DOUBTS = 2  # contradicting samples in a row that re-synchronise the sector


class Params(NamedTuple):
    """Constants of the front end."""

    tick_period: float  # s a tick
    sector_rate: float  # rad/s times ticks: sector width by (1) for an interval of one tick
    timeout: float  # ticks without an edge after which the rotor counts as standing


class State(NamedTuple):
    """What the front end remembers."""

    sector: int  # 0..5, or -1: not known yet
    direction: int  # +1 or -1 by the last edge, 0: unknown
    anchored: int  # 1: edge_tick is the time of a boundary's passing; 0: the rotor is anywhere in the sector
    edge_tick: int  # when the sector was entered
    omega: float  # rad/s, by the last two edges; 0: unknown
    doubts: int  # samples in a row that contradict the sector
    illegal: int  # codes 000 and 111 seen so far, in edges and samples
    skipped: int  # re-synchronisations so far


class Estimate(NamedTuple):
    """One period's result."""

    sector: int  # 0..5, or -1: not known yet
    direction: int  # +1, -1, 0: unknown
    anchored: int  # 1: the sector was entered over a known boundary, `age` ago
    omega: float  # omega_h, electrical rad/s, bounded while an edge is overdue; 0: unknown or standing
    age: float  # s since the sector was entered
    edge: int  # 1: a boundary was passed in this period


class Estimates(NamedTuple):
    """A run's results, one element a sample."""

    sector: NDArray[np.int64]
    direction: NDArray[np.int64]
    anchored: NDArray[np.int64]
    omega: NDArray[np.float64]
    age: NDArray[np.float64]
    edge: NDArray[np.int64]


def make_params(tick_hz: float, hall_timeout: float) -> Params:
    """Constants for a counter of `tick_hz` Hz and a standstill time-out in s."""
    tick_hz = float(tick_hz)
    return Params(1.0 / tick_hz, SECTOR_WIDTH * tick_hz, float(hall_timeout) * tick_hz)


@jit
def init() -> State:
    """Nothing known: the next sampled code gives the sector."""
    return State(-1, 0, 0, 0, 0.0, 0, 0, 0)


@jit
def _bounded(params: Params, omega: float, age: int) -> float:
    """`omega` cut to what a rotor can have that has not left its sector for `age` ticks."""
    if abs(omega) * age > params.sector_rate:
        return math.copysign(params.sector_rate / age, omega)
    return omega


@jit
def _resynchronise(params: Params, state: State, tick: int, sector: int) -> State:
    """The rotor turns up in `sector` by no known boundary: speed held, angle unknown."""
    omega = _bounded(params, state.omega, tick - state.edge_tick)
    return State(sector, state.direction, 0, tick, omega, 0, state.illegal, state.skipped + 1)


@jit
def edge(params: Params, state: State, tick: int, code: int) -> State:
    """The state after a captured edge to Hall code `code` at `tick`."""
    sector = SECTOR_OF_CODE[code & 7]
    if sector < 0:
        return State(
            state.sector,
            state.direction,
            state.anchored,
            state.edge_tick,
            state.omega,
            state.doubts,
            state.illegal + 1,
            state.skipped,
        )
    if sector == state.sector:
        return state
    if state.sector < 0:
        return State(sector, 0, 0, tick, 0.0, 0, state.illegal, state.skipped)
    jump = (sector - state.sector) % 6
    if jump != 1 and jump != 5:
        return _resynchronise(params, state, tick, sector)
    direction = 1 if jump == 1 else -1
    age = max(tick - state.edge_tick, 1)
    if direction == state.direction and state.anchored == 1:
        omega = direction * (params.sector_rate / age)
    elif direction == -state.direction:
        omega = -_bounded(params, state.omega, age)
    else:
        omega = _bounded(params, state.omega, age)
    return State(sector, direction, 1, tick, omega, 0, state.illegal, state.skipped)


@jit
def sample(params: Params, state: State, tick: int, code: int, edges: int) -> tuple[State, Estimate]:
    """The state and estimate at the sample at `tick`, where the pins read `code`.

    `edges`: 1 where `edge` passed a boundary since the last sample. Edges up to `tick` come first.
    """
    sector = state.sector
    direction = state.direction
    anchored = state.anchored
    edge_tick = state.edge_tick
    omega = state.omega
    doubts = state.doubts
    illegal = state.illegal
    skipped = state.skipped

    seen = SECTOR_OF_CODE[code & 7]
    if seen < 0:
        illegal += 1
    elif seen == sector:
        doubts = 0
    elif sector < 0:
        sector = seen
        edge_tick = tick
    else:
        doubts += 1
        if doubts >= DOUBTS:
            state = _resynchronise(params, state, tick, seen)
            sector = seen
            anchored = 0
            edge_tick = tick
            omega = state.omega
            doubts = 0
            skipped = state.skipped

    age = tick - edge_tick
    if age > params.timeout:
        direction = 0
        anchored = 0
        omega = 0.0
    state = State(sector, direction, anchored, edge_tick, omega, doubts, illegal, skipped)
    estimate = Estimate(
        sector, direction, anchored, _bounded(params, omega, age), age * params.tick_period, edges
    )
    return state, estimate


@jit
def step(
    params: Params,
    state: State,
    tick: int,
    hall: int,
    edge_ticks: NDArray[np.int64],
    edge_halls: NDArray[np.uint8],
    first: int,
    last: int,
) -> tuple[State, Estimate]:
    """One control period: edges [first, last) of the arrays, then the sample at `tick` with code `hall`."""
    before = state.edge_tick
    for j in range(first, last):
        state = edge(params, state, edge_ticks[j], edge_halls[j])
    passed = 1 if state.anchored == 1 and state.edge_tick != before else 0
    return sample(params, state, tick, hall, passed)


@jit
def run(
    params: Params,
    state: State,
    tick: NDArray[np.int64],
    hall: NDArray[np.uint8],
    edge_tick: NDArray[np.int64],
    edge_hall: NDArray[np.uint8],
    reset: NDArray[np.bool_],
) -> tuple[State, Estimates]:
    """`step` over n samples, with `init` before each sample where `reset` is set.

    `tick`, `hall`, `reset`: shape (n,). `edge_tick`, `edge_hall`: shape (m,), rising ticks; an edge is
    taken in with the first sample at or after it, and edges after the last sample are left alone (give them
    again).
    """
    n = tick.shape[0]
    m = edge_tick.shape[0]
    out = Estimates(
        np.empty(n, np.int64),
        np.empty(n, np.int64),
        np.empty(n, np.int64),
        np.empty(n, np.float64),
        np.empty(n, np.float64),
        np.empty(n, np.int64),
    )
    first = 0
    for k in range(n):
        last = first
        while last < m and edge_tick[last] <= tick[k]:
            last += 1
        if reset[k]:
            state = init()
        state, estimate = step(params, state, tick[k], hall[k], edge_tick, edge_hall, first, last)
        first = last
        out.sector[k] = estimate.sector
        out.direction[k] = estimate.direction
        out.anchored[k] = estimate.anchored
        out.omega[k] = estimate.omega
        out.age[k] = estimate.age
        out.edge[k] = estimate.edge
    return state, out
