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
from sim.observers import load_angle, sample, vector_tracking

OBSERVERS = ("average_speed", "vector_tracking", "load_angle")
"""The observers of the bank, in the order of `protocol.signals.AngleSource`, which begins with the encoder."""
SHORT = ("avg", "vt", "la")
"""Their names in channels: `theta_avg`, `omega_avg` …"""
COUNT = len(OBSERVERS)

# The drive parameters that the estimates depend on, by their names.
FRONT_PARAMETERS = ("n_p", "omega_m_max", "hall_timeout")
PARAMETERS = (
    *FRONT_PARAMETERS,
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

    front: sample.Params
    vector: vector_tracking.Params
    load_angle: load_angle.Params


class State(NamedTuple):
    """What the observers remember."""

    front: sample.State
    vector: vector_tracking.State
    load_angle: load_angle.State


class BankEstimate(NamedTuple):
    """One period's results: electrical angles in [-pi, pi) and speeds, rad and rad/s, at the sample."""

    theta: tuple[float, float, float]  # by observer, in the order of `OBSERVERS`
    omega: tuple[float, float, float]
    delta_hat: float  # rad, of the vector-tracking observer, as are the following
    e_alpha: float  # V
    e_beta: float
    correction_on: int  # 1: the correction is at work
    sector: int  # 0..5, -1: not known yet
    injection_sync: int  # 1: the test sine begins a turn at this sample


class BankEstimates(NamedTuple):
    """A run's results; fields as in `BankEstimate`."""

    theta: NDArray[np.float64]  # shape (observers, n)
    omega: NDArray[np.float64]
    delta_hat: NDArray[np.float64]  # shape (n,), as are the following
    e_alpha: NDArray[np.float64]
    e_beta: NDArray[np.float64]
    correction_on: NDArray[np.int64]
    sector: NDArray[np.int64]
    injection_sync: NDArray[np.int64]

    def column(self, name: str) -> NDArray[np.float64]:
        """The column of a channel, shape (n,): such as "theta_vt", "omega_avg", "delta_hat"."""
        what, _, short = name.partition("_")
        found: NDArray[np.float64] = getattr(self, name if short not in SHORT else what)
        return found if short not in SHORT else found[SHORT.index(short)]


def make_params(tick_hz: float, pwm_hz: float, *, exact_inverse: bool = True, **drive: float) -> Params:
    """Constants from the drive's parameters, by their names and in their units.

    `drive` must hold all of `PARAMETERS` (KeyError names the missing one); others are ignored, so that a
    drive's whole parameter table can be given. Values are rounded to float32, as a drive stores them.
    `exact_inverse`: see `vector_tracking`.
    """
    value = {name: float(np.float32(drive[name])) for name in PARAMETERS}
    front = {name: value.pop(name) for name in FRONT_PARAMETERS}
    return Params(
        sample.make_params(tick_hz, **front),
        vector_tracking.make_params(pwm_hz, exact_inverse=exact_inverse, **value),
        load_angle.make_params(pwm_hz, exact_inverse=exact_inverse, **value),
    )


@kernel
def init() -> State:
    """Nothing known yet: the first sample gives sector and currents."""
    return State(sample.init(), vector_tracking.init(), load_angle.init())


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
) -> tuple[State, BankEstimate]:
    """One control period.

    `tick`, `hall`: time and code of the sample; `i_a`, `i_b`, `i_c`: its currents, A; `u_alpha`, `u_beta` (V): in force
    over the period that ends at it; `i_q_err` (A): reference less q current in the drive's current loop one period ago.
    `edge_ticks`, `edge_halls`: times and new codes of edges, rising; those in [first, last) came after the last sample
    and up to this one.
    """
    front, seen = sample.step(
        params.front,
        state.front,
        tick,
        hall,
        u_alpha,
        u_beta,
        i_a,
        i_b,
        i_c,
        i_q_err,
        edge_ticks,
        edge_halls,
        first,
        last,
    )
    vector_state, vector = vector_tracking.step(params.vector, state.vector, seen)
    load_state, load = load_angle.step(params.load_angle, state.load_angle, seen)
    return State(front, vector_state, load_state), BankEstimate(
        (seen.theta_avg, vector.theta, load.theta),
        (seen.hall.omega, vector.omega, load.omega),
        vector.delta_hat,
        vector.e_alpha,
        vector.e_beta,
        vector.on,
        seen.hall.sector,
        vector.sync,
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
) -> tuple[State, BankEstimates]:
    """`step` over n samples, with `init` before each sample where `reset` is set.

    Samples: shape (n,). Edges: shape (m,), rising ticks; an edge is taken in with the first sample at or after it, and
    edges after the last sample are left alone (give them again with the next chunk).
    """
    n = tick.shape[0]
    m = edge_tick.shape[0]
    out = BankEstimates(
        np.empty((COUNT, n), np.float64),
        np.empty((COUNT, n), np.float64),
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
        state, estimate = step(
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
        for j in range(COUNT):
            out.theta[j, k] = estimate.theta[j]
            out.omega[j, k] = estimate.omega[j]
        out.delta_hat[k] = estimate.delta_hat
        out.e_alpha[k] = estimate.e_alpha
        out.e_beta[k] = estimate.e_beta
        out.correction_on[k] = estimate.correction_on
        out.sector[k] = estimate.sector
        out.injection_sync[k] = estimate.injection_sync
    return state, out
