"""All observers fed from one stream of samples and edges, as the drive runs them.

The drive steps the bank once a control period; of an observer that is not active nothing is remembered, and its
estimate is zero. A host runs any of the same kernels over telemetry (`catalogue`); given
the same telemetered values (raw * scale in float64) and the same parameters (float32) the two agree bit for bit. A gap
in the stream is an explicit `init`: `run` does it where `reset` is set.

Never touches raw counts, frames or files.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.numba_cache import jit, kernel
from sim.observers import (
    hall_vector,
    hall_vector_decoupled,
    learned_edges,
    load_angle,
    lookup_table,
    programmable_filter,
    sample,
    vector_tracking,
    vector_tracking_q15,
    zeroth_order,
)
from sim.observers.catalogue import CATALOGUE, chosen, names

SHORT = tuple(entry.short for entry in CATALOGUE.values())
"""The observers' names in channels, `theta_avg`, `omega_avg` …, in the order of the estimates."""
COUNT = len(SHORT)
ALL = (1 << COUNT) - 1
PARAMETERS = tuple(
    dict.fromkeys((*names(sample.Settings), *(name for entry in CATALOGUE.values() for name in entry.parameters)))
)
"""The drive parameters that the estimates depend on, by their names."""


class Params(NamedTuple):
    """Constants of all observers."""

    active: int  # which are run: bit j is the j-th of `CATALOGUE`; the first two always are
    front: sample.Params
    vector_tracking: vector_tracking.Params
    load_angle: load_angle.Params
    zeroth_order: zeroth_order.Params
    lookup_table: lookup_table.Params
    hall_vector: hall_vector.Params
    hall_vector_decoupled: hall_vector_decoupled.Params
    programmable_filter: programmable_filter.Params
    vector_tracking_q15: vector_tracking_q15.Params
    learned_edges: learned_edges.Params


class State(NamedTuple):
    """What the observers remember."""

    front: sample.State
    vector_tracking: vector_tracking.State
    load_angle: load_angle.State
    zeroth_order: zeroth_order.State
    lookup_table: lookup_table.State
    hall_vector: hall_vector.State
    hall_vector_decoupled: hall_vector_decoupled.State
    programmable_filter: programmable_filter.State
    vector_tracking_q15: vector_tracking_q15.State
    learned_edges: learned_edges.State


class BankEstimate(NamedTuple):
    """One period's results: electrical angles in [-pi, pi) and speeds, rad and rad/s, at the sample."""

    theta: tuple[float, ...]  # by observer, in the order of `CATALOGUE`
    omega: tuple[float, ...]
    delta_hat: float  # rad, of the vector-tracking observer, as are the following
    e_alpha: float  # V
    e_beta: float
    correction_on: int  # 1: the correction is at work
    sector: int  # 0..5, -1: not known yet
    injection_sync: int  # 1: the test sine begins a turn at this sample
    sensors: int  # what the learned-edge observer thinks of the Hall sensors


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
    sensors: NDArray[np.int64]

    def column(self, name: str) -> NDArray[np.float64]:
        """The column of a channel, shape (n,): such as "theta_vt", "omega_avg", "delta_hat"."""
        what, _, short = name.partition("_")
        found: NDArray[np.float64] = getattr(self, name if short not in SHORT else what)
        return found if short not in SHORT else found[SHORT.index(short)]


def make_params(tick_hz: float, pwm_hz: float, *, active: float = ALL, **drive: float) -> Params:
    """Constants from the drive's parameters, by their names and in their units.

    `drive` must hold all of `PARAMETERS` (KeyError names the missing one); others are ignored, so that a
    drive's whole parameter table can be given. Values are rounded to float32, as a drive stores them.
    `active`: see `Params`.
    """
    value = {name: drive[name] for name in PARAMETERS}
    own: dict[str, Any] = {name: entry.make_params(pwm_hz, value) for name, entry in CATALOGUE.items()}
    return Params(
        int(active),
        sample.make_params(tick_hz, chosen(sample.Settings, value)),
        own["vector_tracking"],
        own["load_angle"],
        own["zeroth_order"],
        own["lookup_table"],
        own["hall_vector"],
        own["hall_vector_decoupled"],
        own["programmable_filter"],
        own["vector_tracking_q15"],
        own["learned_edges"],
    )


@kernel
def init() -> State:
    """Nothing known yet: the first sample gives sector and currents."""
    return State(
        sample.init(),
        vector_tracking.init(),
        load_angle.init(),
        zeroth_order.init(),
        lookup_table.init(),
        hall_vector.init(),
        hall_vector_decoupled.init(),
        programmable_filter.init(),
        vector_tracking_q15.init(),
        learned_edges.init(),
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
    vt_state, vt = vector_tracking.step(params.vector_tracking, state.vector_tracking, seen)
    la_state = load_angle.init()
    la_theta = la_omega = 0.0
    if params.active & 4 != 0:
        la_state, la = load_angle.step(params.load_angle, state.load_angle, seen)
        la_theta, la_omega = la.theta, la.omega
    zero_state = zeroth_order.init()
    zero_theta = zero_omega = 0.0
    if params.active & 8 != 0:
        zero_state, zero = zeroth_order.step(params.zeroth_order, state.zeroth_order, seen)
        zero_theta, zero_omega = zero.theta, zero.omega
    lut_state = lookup_table.init()
    lut_theta = lut_omega = 0.0
    if params.active & 16 != 0:
        lut_state, lut = lookup_table.step(params.lookup_table, state.lookup_table, seen)
        lut_theta, lut_omega = lut.theta, lut.omega
    hv_state = hall_vector.init()
    hv_theta = hv_omega = 0.0
    if params.active & 32 != 0:
        hv_state, hv = hall_vector.step(params.hall_vector, state.hall_vector, seen)
        hv_theta, hv_omega = hv.theta, hv.omega
    hvd_state = hall_vector_decoupled.init()
    hvd_theta = hvd_omega = 0.0
    if params.active & 64 != 0:
        hvd_state, hvd = hall_vector_decoupled.step(params.hall_vector_decoupled, state.hall_vector_decoupled, seen)
        hvd_theta, hvd_omega = hvd.theta, hvd.omega
    plf_state = programmable_filter.init()
    plf_theta = plf_omega = 0.0
    if params.active & 128 != 0:
        plf_state, plf = programmable_filter.step(params.programmable_filter, state.programmable_filter, seen)
        plf_theta, plf_omega = plf.theta, plf.omega
    q15_state = vector_tracking_q15.init()
    q15_theta = q15_omega = 0.0
    if params.active & 256 != 0:
        q15_state, q15 = vector_tracking_q15.step(params.vector_tracking_q15, state.vector_tracking_q15, seen)
        q15_theta, q15_omega = q15.theta, q15.omega
    le_state = learned_edges.init()
    le_theta = le_omega = 0.0
    sensors = 0
    if params.active & 512 != 0:
        le_state, le = learned_edges.step(params.learned_edges, state.learned_edges, seen)
        le_theta, le_omega = le.theta, le.omega
        sensors = le.sensors
    state = State(
        front,
        vt_state,
        la_state,
        zero_state,
        lut_state,
        hv_state,
        hvd_state,
        plf_state,
        q15_state,
        le_state,
    )
    return state, BankEstimate(
        (
            seen.theta_avg,
            vt.theta,
            la_theta,
            zero_theta,
            lut_theta,
            hv_theta,
            hvd_theta,
            plf_theta,
            q15_theta,
            le_theta,
        ),
        (
            seen.hall.omega,
            vt.omega,
            la_omega,
            zero_omega,
            lut_omega,
            hv_omega,
            hvd_omega,
            plf_omega,
            q15_omega,
            le_omega,
        ),
        vt.delta_hat,
        vt.e_alpha,
        vt.e_beta,
        vt.on,
        seen.hall.sector,
        vt.sync,
        sensors,
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
        out.sensors[k] = estimate.sensors
    return state, out
