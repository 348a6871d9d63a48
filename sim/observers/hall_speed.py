"""Hall front end: sector, direction and average speed (1) from edges and sampled codes.

What the paper leaves open, and how it is settled here:
- An edge between neighbouring sectors is the boundary between them, whichever way it is passed. The first one
  gives an angle, the second in the same direction a speed: omega_h = (pi/3) / (time between them), (1).
- While an edge is overdue the rotor is still in its sector: |omega_h| is at most (pi/3) / (time since the
  last edge). After `hall_timeout` without an edge the rotor counts as standing: speed zero, direction
  unknown.
- An edge back over the boundary just passed is a reversal: direction and the sign of omega_h change, the
  magnitude stays (as it does when a torque turns the rotor round); the time between the two is no sector's.
- An edge taken back within 50 us was none: a sensor that chatters on its edge, or a glitch of one sensor
  inside a sector, which shows the code of a neighbour. All is as it was before it.
- No two edges make a speed beyond the fastest that the drive can have: a glitch just after an edge would.
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

from sim.native import Pointer
from sim.numba_cache import kernel

# Sector 0..5 by Hall code (bit 0 = sensor a, 1 = b, 2 = c); -1: a code that no rotor angle gives.
SECTOR_OF_CODE = (-1, 0, 2, 1, 4, 5, 3, -1)
SECTOR_WIDTH = math.pi / 3.0  # electrical rad
GLITCH = 50e-6  # s
DOUBTS = 2  # contradicting samples in a row that re-synchronise the sector


class Params(NamedTuple):
    """Constants of the front end."""

    tick_period: float  # s a tick
    sector_rate: float  # rad/s times ticks: sector width by (1) for an interval of one tick
    timeout: float  # ticks without an edge after which the rotor counts as standing
    glitch: float  # ticks within which an edge taken back was none
    omega_max: float  # rad/s, no sector is passed faster


class Edge(NamedTuple):
    """A captured edge of the Hall sensors."""

    tick: int
    code: int  # 0..7, after it


class Entry(NamedTuple):
    """How the rotor came into a sector."""

    sector: int  # 0..5, or -1: not known yet
    direction: int  # +1 or -1 by the edge, 0: unknown
    anchored: int  # 1: `tick` is the time of a boundary's passing; 0: the rotor is anywhere in the sector
    tick: int  # when the sector was entered
    omega: float  # rad/s, by the last two edges; 0: unknown


class State(NamedTuple):
    """What the front end remembers."""

    now: Entry
    before: Entry  # what an edge taken back at once goes back to; sector -1: nothing
    doubts: int  # samples in a row that contradict the sector
    illegal: int  # codes 000 and 111 seen so far, in edges and samples
    skipped: int  # re-synchronisations so far
    undone: int  # edges taken back at once so far


class Estimate(NamedTuple):
    """One period's result."""

    sector: int  # 0..5, or -1: not known yet
    direction: int  # +1, -1, 0: unknown
    anchored: int  # 1: the sector was entered over a known boundary, `age` ago
    omega: float  # omega_h, electrical rad/s, bounded while an edge is overdue; 0: unknown or standing
    age: float  # s since the sector was entered
    edge: int  # 1: a boundary was passed in this period


def make_params(tick_hz: float, hall_timeout: float, omega_max: float = math.inf) -> Params:
    """Constants for a counter of `tick_hz` Hz, a standstill time-out in s and the largest speed, electrical rad/s."""
    tick_hz = float(tick_hz)
    return Params(
        1.0 / tick_hz, SECTOR_WIDTH * tick_hz, float(hall_timeout) * tick_hz, GLITCH * tick_hz, float(omega_max)
    )


@kernel
def _nothing() -> Entry:
    return Entry(-1, 0, 0, 0, 0.0)


@kernel
def init() -> State:
    """Nothing known: the next sampled code gives the sector."""
    return State(_nothing(), _nothing(), 0, 0, 0, 0)


@kernel
def _bounded(params: Params, omega: float, age: int) -> float:
    """`omega` cut to what a rotor can have that has not left its sector for `age` ticks."""
    if abs(omega) * age > params.sector_rate:
        return math.copysign(params.sector_rate / age, omega)
    return omega


@kernel
def _resynchronised(params: Params, entry: Entry, tick: int, sector: int) -> Entry:
    """The rotor turns up in `sector` by no known boundary: speed held, angle unknown."""
    return Entry(sector, entry.direction, 0, tick, _bounded(params, entry.omega, tick - entry.tick))


@kernel
def _entered(params: Params, entry: Entry, tick: int, sector: int, direction: int) -> Entry:
    """The rotor passes a boundary of its sector into the neighbour `sector`."""
    age = max(tick - entry.tick, 1)
    if direction == entry.direction and entry.anchored == 1:
        omega = direction * min(params.sector_rate / age, params.omega_max)
    elif direction == -entry.direction:
        omega = -_bounded(params, entry.omega, age)
    else:
        omega = _bounded(params, entry.omega, age)
    return Entry(sector, direction, 1, tick, omega)


@kernel
def edge(params: Params, state: State, tick: int, code: int) -> State:
    """The state after a captured edge to Hall code `code` at `tick`."""
    now = state.now
    before = _nothing()
    illegal = state.illegal
    skipped = state.skipped
    undone = state.undone
    sector = SECTOR_OF_CODE[code & 7]
    jump = (sector - now.sector) % 6
    if sector < 0:
        illegal += 1
        before = state.before
    elif sector == now.sector:
        before = state.before
    elif now.sector < 0:
        now = Entry(sector, 0, 0, tick, 0.0)
    elif sector == state.before.sector and tick - now.tick <= params.glitch:
        now = state.before
        undone += 1
    elif jump == 1 or jump == 5:
        before = now
        now = _entered(params, now, tick, sector, 1 if jump == 1 else -1)
    else:
        before = now
        now = _resynchronised(params, now, tick, sector)
        skipped += 1
    return State(now, before, 0, illegal, skipped, undone)


@kernel
def sample(params: Params, state: State, tick: int, code: int, edges: int) -> tuple[State, Estimate]:
    """The state and estimate at the sample at `tick`, where the pins read `code`.

    `edges`: 1 where `edge` passed a boundary since the last sample. Edges up to `tick` come first.
    """
    now = state.now
    before = state.before
    doubts = 0
    illegal = state.illegal
    skipped = state.skipped
    sector = SECTOR_OF_CODE[code & 7]
    if sector < 0:
        illegal += 1
        doubts = state.doubts
    elif now.sector < 0:
        now = Entry(sector, 0, 0, tick, 0.0)
    elif sector != now.sector:
        doubts = state.doubts + 1
        if doubts >= DOUBTS:
            now = _resynchronised(params, now, tick, sector)
            before = _nothing()
            skipped += 1
            doubts = 0

    age = tick - now.tick
    if age > params.timeout:
        now = Entry(now.sector, 0, 0, now.tick, 0.0)
    omega = _bounded(params, now.omega, age)
    state = State(now, before, doubts, illegal, skipped, state.undone)
    return state, Estimate(now.sector, now.direction, now.anchored, omega, age * params.tick_period, edges)


@kernel
def step(
    params: Params, state: State, tick: int, hall: int, edges: Pointer[Edge], first: int, last: int
) -> tuple[State, Estimate]:
    """One control period: the edges [first, last), then the sample at `tick` with code `hall`."""
    before = state.now.tick
    for j in range(first, last):
        passed = edges[j]
        state = edge(params, state, passed.tick, passed.code)
    entered = 1 if state.now.anchored == 1 and state.now.tick != before else 0
    return sample(params, state, tick, hall, entered)
