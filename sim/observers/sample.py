"""What every position observer is given of one control period, and the front end that makes it from the raw signals.

The front end runs once, for all observers: `hall_speed` and `average_speed` on the Hall edges, Clarke's transform on
the currents. It also passes on the last captured edge as it came, because an observer that doubts a sensor cannot work
with sectors. It estimates nothing itself, and knows no parameter of the motor.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.numba_cache import jit, kernel
from sim.observers import average_speed, hall_speed
from sim.observers.transforms import clarke


class Sample(NamedTuple):
    """One control period. Voltages and the current error are those in force over the period that ends at the sample."""

    hall: hall_speed.Estimate
    theta_avg: float  # electrical rad, by (1)-(2)
    code: int  # 0..7, at the sample
    edges: int  # captured in the period, glitches included
    edge_from: int  # 0..7, code before the last of them; meaningless without an edge
    edge_to: int  # code after it
    edge_age: float  # s from the last of them to the sample
    u_alpha: float  # V
    u_beta: float
    i_alpha: float  # A
    i_beta: float
    i_q_err: float  # A, reference less q current, as the drive's current loop had it one period ago


class Samples(NamedTuple):
    """A run of n periods: fields as in `Sample`, one element a sample."""

    hall: hall_speed.Estimates
    theta_avg: NDArray[np.float64]
    code: NDArray[np.int64]
    edges: NDArray[np.int64]
    edge_from: NDArray[np.int64]
    edge_to: NDArray[np.int64]
    edge_age: NDArray[np.float64]
    u_alpha: NDArray[np.float64]
    u_beta: NDArray[np.float64]
    i_alpha: NDArray[np.float64]
    i_beta: NDArray[np.float64]
    i_q_err: NDArray[np.float64]


class State(NamedTuple):
    """What the front end remembers."""

    hall: hall_speed.State
    code: int  # after the last edge or sample; -1: none yet


Settings = average_speed.Settings
Params = average_speed.Params
make_params = average_speed.make_params


@kernel
def init() -> State:
    """Nothing known yet."""
    return State(hall_speed.init(), -1)


@kernel
def step(
    params: Params,
    state: State,
    tick: int,
    hall: int,
    u_alpha: float,
    u_beta: float,
    i_a: float,
    i_b: float,
    i_c: float,
    i_q_err: float,
    edge_ticks: NDArray[np.int64],
    edge_halls: NDArray[np.uint8],
    first: int,
    last: int,
) -> tuple[State, Sample]:
    """One control period with the edges [first, last) of the arrays; `tick`, `hall`: time and code of the sample."""
    edge_from = state.code
    edge_to = state.code
    age = 0.0
    if last > first:
        if last - 1 > first:
            edge_from = int(edge_halls[last - 2] & 7)
        edge_to = int(edge_halls[last - 1] & 7)
        age = (tick - edge_ticks[last - 1]) * params.hall.tick_period
    code = int(hall & 7)
    front, estimate = hall_speed.step(params.hall, state.hall, tick, hall, edge_ticks, edge_halls, first, last)
    i_alpha, i_beta = clarke(i_a, i_b, i_c)
    return State(front, code), Sample(
        estimate,
        average_speed.position(params, estimate),
        code,
        last - first,
        edge_from,
        edge_to,
        age,
        u_alpha,
        u_beta,
        i_alpha,
        i_beta,
        i_q_err,
    )


@jit
def empty(n: int) -> Samples:
    """Room for n samples."""
    return Samples(
        hall_speed.empty(n),
        np.empty(n, np.float64),
        np.empty(n, np.int64),
        np.empty(n, np.int64),
        np.empty(n, np.int64),
        np.empty(n, np.int64),
        np.empty(n, np.float64),
        np.empty(n, np.float64),
        np.empty(n, np.float64),
        np.empty(n, np.float64),
        np.empty(n, np.float64),
        np.empty(n, np.float64),
    )


@kernel
def at(samples: Samples, k: int) -> Sample:
    """The k-th sample of a run."""
    return Sample(
        hall_speed.at(samples.hall, k),
        samples.theta_avg[k],
        samples.code[k],
        samples.edges[k],
        samples.edge_from[k],
        samples.edge_to[k],
        samples.edge_age[k],
        samples.u_alpha[k],
        samples.u_beta[k],
        samples.i_alpha[k],
        samples.i_beta[k],
        samples.i_q_err[k],
    )


@jit
def run(
    params: Params,
    state: State,
    tick: NDArray[np.int64],
    hall: NDArray[np.uint8],
    u_alpha: NDArray[np.float64],
    u_beta: NDArray[np.float64],
    i_a: NDArray[np.float64],
    i_b: NDArray[np.float64],
    i_c: NDArray[np.float64],
    i_q_err: NDArray[np.float64],
    edge_tick: NDArray[np.int64],
    edge_hall: NDArray[np.uint8],
    reset: NDArray[np.bool_],
) -> tuple[State, Samples]:
    """`step` over n samples of one control period each, with `init` before each sample where `reset` is set.

    Samples: shape (n,). Edges: shape (m,), rising ticks; an edge is taken in with the first sample at or after it, and
    edges after the last sample are left alone (give them again with the next samples).
    """
    n = tick.shape[0]
    m = edge_tick.shape[0]
    out = empty(n)
    first = 0
    for k in range(n):
        last = first
        while last < m and edge_tick[last] <= tick[k]:
            last += 1
        if reset[k]:
            state = init()
        state, sample = step(
            params,
            state,
            tick[k],
            hall[k],
            u_alpha[k],
            u_beta[k],
            i_a[k],
            i_b[k],
            i_c[k],
            i_q_err[k],
            edge_tick,
            edge_hall,
            first,
            last,
        )
        first = last
        hall_speed.put(out.hall, k, sample.hall)
        out.theta_avg[k] = sample.theta_avg
        out.code[k] = sample.code
        out.edges[k] = sample.edges
        out.edge_from[k] = sample.edge_from
        out.edge_to[k] = sample.edge_to
        out.edge_age[k] = sample.edge_age
        out.u_alpha[k] = sample.u_alpha
        out.u_beta[k] = sample.u_beta
        out.i_alpha[k] = sample.i_alpha
        out.i_beta[k] = sample.i_beta
        out.i_q_err[k] = sample.i_q_err
    return state, out
