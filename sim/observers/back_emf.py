"""The back-EMF (5) of a control period, through the filter of (6) and turned back by what the filter turns it.

(5) is the mean of the period that ends at the sample. The gain of the filter is T_s / (T_s + tau) with tau =
min(tau_max, 1 / |omega_h|). At the speed omega_h the sampled filter y += a (x - y) turns and shrinks a vector; the
exact inverse of that, not the one of the continuous filter, leaves no bias that grows with speed.

Never uses an angle, and knows neither the rotor's flux nor a loop.

Source: (5), (6) of Kim et al. 2011, DOI 10.1109/TIE.2010.2098367.
"""

from __future__ import annotations

from typing import NamedTuple

from sim.numba_cache import kernel
from sim.observers.sample import Sample


class Params(NamedTuple):
    """Constants: SI units."""

    T_s: float
    R_s: float
    L_by_T: float  # L_s / T_s
    a_min: float  # gain of the filter at tau = tau_max: T_s / (T_s + tau)


class State(NamedTuple):
    """What is remembered of the last sample."""

    primed: int  # 1: the fields below hold one
    i_alpha: float  # A
    i_beta: float
    e_alpha: float  # V, after the filter, before its inverse
    e_beta: float


def make_params(pwm_hz: float, R_s: float, L_s: float, tau_max: float) -> Params:
    """Constants for control periods at `pwm_hz` Hz from ohm, H and s."""
    T_s = 1.0 / float(pwm_hz)
    return Params(T_s, float(R_s), float(L_s) / T_s, T_s / (T_s + float(tau_max)))


@kernel
def init() -> State:
    """Nothing known: the next sample gives the first currents."""
    return State(0, 0.0, 0.0, 0.0, 0.0)


@kernel
def _undo_filter(params: Params, a: float, omega: float) -> tuple[float, float]:
    """Real and imaginary part of the inverse, at `omega`, of the filter y += a (x - y)."""
    x = omega * params.T_s
    b = 1.0 - a
    # Series of cos and sin: within 5e-8 for |x| < 0.3, over twice the speed of Table II's motor at 16 kHz.
    y = x * x
    cos = 1.0 - y * (0.5 - y * (1.0 / 24.0 - y / 720.0))
    sin = x * (1.0 - y * (1.0 / 6.0 - y / 120.0))
    return (1.0 - b * cos) / a, b * sin / a


@kernel
def step(params: Params, state: State, sample: Sample) -> tuple[State, float, float]:
    """One control period: E_f* of (6), V, alpha and beta, of the middle of the period; zero at the first sample."""
    i_alpha, i_beta = sample.i_alpha, sample.i_beta
    if state.primed == 0:
        return State(1, i_alpha, i_beta, 0.0, 0.0), 0.0, 0.0

    # (5): mean back-EMF of the period that ends here
    i_alpha_mean = 0.5 * (i_alpha + state.i_alpha)
    i_beta_mean = 0.5 * (i_beta + state.i_beta)
    e_alpha = sample.u_alpha - params.R_s * i_alpha_mean - params.L_by_T * (i_alpha - state.i_alpha)
    e_beta = sample.u_beta - params.R_s * i_beta_mean - params.L_by_T * (i_beta - state.i_beta)

    # (6)
    omega_h = sample.hall.omega
    x = params.T_s * abs(omega_h)
    a = max(params.a_min, x / (1.0 + x))
    e_alpha = state.e_alpha + a * (e_alpha - state.e_alpha)
    e_beta = state.e_beta + a * (e_beta - state.e_beta)
    g_re, g_im = _undo_filter(params, a, omega_h)
    return (
        State(1, i_alpha, i_beta, e_alpha, e_beta),
        g_re * e_alpha - g_im * e_beta,
        g_re * e_beta + g_im * e_alpha,
    )
