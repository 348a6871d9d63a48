"""The observers fed from one stream of samples and edges, exactly as drive and host both run them.

The drive steps the bank once a control period; a host runs it over chunks of telemetry. Given the same
telemetered values (raw * scale in float64) and the same parameters (float32) the two agree bit for bit.
A gap in the stream is an explicit `init`: `run` does it where `reset` is set.

Never touches raw counts, frames or files.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.numba_cache import jit, kernel
from sim.observers import average_speed, hall_speed, vector_tracking
from sim.observers.transforms import clarke

# The drive parameters that the estimates depend on, by their names.
PARAMETERS = (
    "n_p",
    "omega_m_max",
    "hall_timeout",
    "R_s_hat",
    "L_s_hat",
    "psi_f_hat",
    "k_p_vt",
    "k_i_vt",
    "tau_max",
    "omega_on",
    "omega_off",
    "k_pc",
    "k_ic",
    "load_angle_comp",
    "literal_sgn",
    "bw_omega_lpf",
    "inject",
    "inject_amplitude",
    "inject_hz",
)


class Params(NamedTuple):
    """Constants of all observers."""

    average: average_speed.Params
    vector: vector_tracking.Params


class State(NamedTuple):
    """What the observers remember."""

    hall: hall_speed.State
    vector: vector_tracking.State


class BankEstimate(NamedTuple):
    """One period's results: electrical angles in [-pi, pi) and speeds, rad and rad/s, at the sample."""

    theta_avg: float
    omega_avg: float  # omega_h of (1), bounded while an edge is overdue
    theta_vt: float
    omega_vt: float  # low-pass filtered
    delta_hat: float  # rad
    e_alpha: float  # V
    e_beta: float
    correction_on: int  # 1: the vector-tracking observer's correction is at work
    sector: int  # 0..5, -1: not known yet
    injection_sync: int  # 1: the test sine begins a turn at this sample


class BankEstimates(NamedTuple):
    """A run's results, one element a sample; fields as in `BankEstimate`."""

    theta_avg: NDArray[np.float64]
    omega_avg: NDArray[np.float64]
    theta_vt: NDArray[np.float64]
    omega_vt: NDArray[np.float64]
    delta_hat: NDArray[np.float64]
    e_alpha: NDArray[np.float64]
    e_beta: NDArray[np.float64]
    correction_on: NDArray[np.int64]
    sector: NDArray[np.int64]
    injection_sync: NDArray[np.int64]


def make_params(tick_hz: float, pwm_hz: float, *, exact_inverse: bool = True, **drive: float) -> Params:
    """Constants from the drive's parameters, by their names and in their units.

    `drive` must hold all of `PARAMETERS` (KeyError names the missing one); others are ignored, so that a
    drive's whole parameter table can be given. Values are rounded to float32, as a drive stores them.
    `exact_inverse`: see `vector_tracking`.
    """
    value = {name: float(np.float32(drive[name])) for name in PARAMETERS}
    average = {name: value.pop(name) for name in ("n_p", "omega_m_max", "hall_timeout")}
    return Params(
        average_speed.make_params(tick_hz, **average),
        vector_tracking.make_params(pwm_hz, exact_inverse=exact_inverse, **value),
    )


@kernel
def init() -> State:
    """Nothing known yet: the first sample gives sector and currents."""
    return State(hall_speed.init(), vector_tracking.init())


@kernel
def step_span(
    params: Params,
    state: State,
    tick: int,
    hall: int,
    u_alpha: float,
    u_beta: float,
    i_a: float,
    i_b: float,
    i_c: float,
    i_q_ref: float,
    edge_ticks: NDArray[np.int64],
    edge_halls: NDArray[np.uint8],
    first: int,
    last: int,
) -> tuple[State, BankEstimate]:
    """`step` with the period's edges at [first, last) of the arrays: without slicing, for tight loops."""
    hall_state, front = hall_speed.step(
        params.average.hall, state.hall, tick, hall, edge_ticks, edge_halls, first, last
    )
    theta_avg = average_speed.position(params.average, front)
    i_alpha, i_beta = clarke(i_a, i_b, i_c)
    vector_state, vector = vector_tracking.step(
        params.vector, state.vector, front, theta_avg, u_alpha, u_beta, i_alpha, i_beta, i_q_ref
    )
    return State(hall_state, vector_state), BankEstimate(
        theta_avg,
        front.omega,
        vector.theta,
        vector.omega,
        vector.delta_hat,
        vector.e_alpha,
        vector.e_beta,
        vector.on,
        front.sector,
        vector.sync,
    )


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
    i_q_ref: float,
    edge_ticks: NDArray[np.int64],
    edge_halls: NDArray[np.uint8],
) -> tuple[State, BankEstimate]:
    """One control period.

    `tick`, `hall`: time and code of the sample; `i_a`, `i_b`, `i_c`: its currents, A; `u_alpha`, `u_beta`
    (V), `i_q_ref` (A): in force over the period that ends at it. `edge_ticks`, `edge_halls`: times and new
    codes of the edges after the last sample and up to this one, shape (m,), rising.
    """
    return step_span(
        params,
        state,
        tick,
        hall,
        u_alpha,
        u_beta,
        i_a,
        i_b,
        i_c,
        i_q_ref,
        edge_ticks,
        edge_halls,
        0,
        edge_ticks.shape[0],
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
    i_q_ref: NDArray[np.float64],
    edge_tick: NDArray[np.int64],
    edge_hall: NDArray[np.uint8],
    reset: NDArray[np.bool_],
) -> tuple[State, BankEstimates]:
    """`step` over n samples of one control period each, with `init` before each sample where `reset` is set.

    Samples: shape (n,). Edges: shape (m,), rising ticks; an edge is taken in with the first sample at or
    after it, and edges after the last sample are left alone (give them again with the next chunk).
    """
    n = tick.shape[0]
    m = edge_tick.shape[0]
    out = BankEstimates(
        np.empty(n, np.float64),
        np.empty(n, np.float64),
        np.empty(n, np.float64),
        np.empty(n, np.float64),
        np.empty(n, np.float64),
        np.empty(n, np.float64),
        np.empty(n, np.float64),
        np.empty(n, np.int64),
        np.empty(n, np.int64),
        np.empty(n, np.int64),
    )
    first = 0
    for k in range(n):
        last = first
        while last < m and edge_tick[last] <= tick[k]:
            last += 1
        if reset[k]:
            state = init()
        state, estimate = step_span(
            params,
            state,
            tick[k],
            hall[k],
            u_alpha[k],
            u_beta[k],
            i_a[k],
            i_b[k],
            i_c[k],
            i_q_ref[k],
            edge_tick,
            edge_hall,
            first,
            last,
        )
        first = last
        out.theta_avg[k] = estimate.theta_avg
        out.omega_avg[k] = estimate.omega_avg
        out.theta_vt[k] = estimate.theta_vt
        out.omega_vt[k] = estimate.omega_vt
        out.delta_hat[k] = estimate.delta_hat
        out.e_alpha[k] = estimate.e_alpha
        out.e_beta[k] = estimate.e_beta
        out.correction_on[k] = estimate.correction_on
        out.sector[k] = estimate.sector
        out.injection_sync[k] = estimate.injection_sync
    return state, out
