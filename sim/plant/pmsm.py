"""The motor: a permanent-magnet synchronous machine by its flux linkage in the stator frame.

    d psi_alphabeta / dt = u_alphabeta - R_s i_alphabeta
    psi_dq = [L_d i_d + psi_f, L_q i_q]
    tau_e = 3/2 n_p (psi_alpha i_beta - psi_beta i_alpha)

With the flux as the state, the rotor's motion enters only through cos and sin of its angle: no rotational voltage has
to be integrated, and the voltages stay constant over a PWM period. It is the model of (3) for L_d = L_q = L_s.

The magnet's flux may have harmonics:

    psi_m = psi_f e^{j theta} + psi_5 e^{-5 j theta} + psi_7 e^{7 j theta}
          + psi_11 e^{-11 j theta} + psi_13 e^{13 j theta}

A phase's back-EMF then has harmonics of h psi_h / psi_f of its fundamental, and since i . d psi_m / d theta is the
torque, each psi_h counts -+h times in it, where psi x i counts it once:

    tau_e = 3/2 n_p (psi + sum of (-+h - 1) psi_h e^{-+h j theta}) x i

Cogging is a torque of the angle alone, with 6 and 12 periods in an electrical revolution.

Iron saturates: with v the winding's own flux and i_0 what the inductances L_d, L_q make of it,

    i = i_0 (1 + (v . i_0) / (L i_sat^2)),   1 / L = (1/L_d + 1/L_q) / 2

so that with L_d = L_q half the inductance is left at 2 i_sat. It is the gradient of an energy, and the torque stays
psi x i. There the magnet's own flux is left out. With it, the axes saturate one another: with psi_d = v_d + psi_f,

    i_d = ... + k/2 psi_d v_q^2,   i_q = ... + k/2 (psi_d^2 - psi_f^2) v_q,   k = 1 / (L_d L_q psi_f i_cross)

so that 1 / L_q rises by the share i_d / i_cross (it falls for a negative i_d), and i_q takes L_q i_q^2 / (2 i_cross)
from the magnet's flux. That is the gradient of an energy again, k/4 (psi_d^2 - psi_f^2) v_q^2.

Amplitude-invariant quantities; currents are positive into the motor. Iron losses are a torque on the shaft
(`mechanics`), what depends on frequency is in series with the winding (`skin_effect`).

Source: (3) of Kim et al. 2011, DOI 10.1109/TIE.2010.2098367; the torque of harmonics by co-energy; the crossing of the
axes is the cross term of the polynomial of Hinkkanen et al., "Sensorless self-commissioning of synchronous reluctance
motors at standstill without rotor locking", IEEE Trans. Ind. Appl., 2017, with exponents 0, about the magnet's flux.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from sim.hints import apart, seldom
from sim.numba_cache import kernel

HALF_SQRT3 = 0.5 * math.sqrt(3.0)
ONE_THIRD = 1.0 / 3.0
ONE_BY_SQRT3 = 1.0 / math.sqrt(3.0)
ORDERS = (5, 7, 11, 13)  # of the harmonics


class Params(NamedTuple):
    """The motor's constants."""

    R_s: float  # ohm
    g_mean: float  # (1/L_d + 1/L_q) / 2, 1/H
    g_diff: float  # (1/L_d - 1/L_q) / 2, 1/H
    psi_f: float  # V s
    n_p: float
    k_tau: float  # 3/2 n_p
    psi_5: float  # V s
    psi_7: float
    psi_11: float
    psi_13: float
    cog_6: float  # N m
    cog_12: float
    soft: float  # 1 / (L i_sat^2), 1/(H A2); 0: no saturation
    cross: float  # k above, A/(V s)^3; 0: the axes know nothing of one another
    uneven: int  # 1: harmonics, cogging or saturation of any kind


def make_params(
    R_s: float,
    L_d: float,
    L_q: float,
    psi_f: float,
    n_p: int,
    emf_harmonics: Sequence[float] = (0.0, 0.0, 0.0, 0.0),
    cogging: Sequence[float] = (0.0, 0.0),
    i_sat: float = 0.0,
) -> Params:
    """The motor's constants from ohm, H, H, V s and the number of pole pairs.

    `emf_harmonics`: the 5th, 7th, 11th, 13th of the back-EMF over its fundamental, with signs; `cogging`: amplitudes
    with 6 and 12 periods in an electrical revolution, N m; `i_sat`: in A, 0: none.
    """
    g_mean = 0.5 * (1.0 / L_d + 1.0 / L_q)
    g_diff = 0.5 * (1.0 / L_d - 1.0 / L_q)
    soft = g_mean / i_sat**2 if i_sat > 0.0 else 0.0
    five, seven, eleven, thirteen = (psi_f * share / order for share, order in zip(emf_harmonics, ORDERS, strict=True))
    six, twelve = map(float, cogging)
    return Params(
        float(R_s),
        g_mean,
        g_diff,
        float(psi_f),
        float(n_p),
        1.5 * n_p,
        five,
        seven,
        eleven,
        thirteen,
        six,
        twelve,
        soft,
        0.0,
        int(soft > 0.0 or any(emf_harmonics) or any(cogging)),
    )


def with_crossing(params: Params, i_cross: float) -> Params:
    """The constants of a motor whose axes saturate one another, from A, 0: they do not."""
    if i_cross == 0.0:
        return params
    bent = (params.g_mean + params.g_diff) * (params.g_mean - params.g_diff)
    return params._replace(cross=bent / (params.psi_f * i_cross), uneven=1)


@kernel
def _times(a_re: float, a_im: float, b_re: float, b_im: float) -> tuple[float, float]:
    """Product of two complex numbers."""
    return a_re * b_re - a_im * b_im, a_re * b_im + a_im * b_re


class Magnet(NamedTuple):
    """What the magnet does at an angle."""

    alpha: float  # its flux, V s
    beta: float
    more_alpha: float  # what its harmonics add to the flux where that makes torque, V s
    more_beta: float
    cogging: float  # N m
    cos: float  # of the angle
    sin: float
    cos_2: float  # of twice the angle
    sin_2: float


@kernel
def magnet(params: Params, cos: float, sin: float) -> Magnet:
    """What the magnet of an uneven motor does at an angle."""
    c_2, s_2 = cos * cos - sin * sin, 2.0 * cos * sin
    c_4, s_4 = c_2 * c_2 - s_2 * s_2, 2.0 * c_2 * s_2
    c_6, s_6 = _times(c_2, s_2, c_4, s_4)
    c_12, s_12 = c_6 * c_6 - s_6 * s_6, 2.0 * c_6 * s_6
    # psi_5 e^{-5 j theta} + psi_7 e^{7 j theta} = e^{j theta} (psi_5 e^{-6 j theta} + psi_7 e^{6 j theta}), and so on
    sum_re = (params.psi_5 + params.psi_7) * c_6 + (params.psi_11 + params.psi_13) * c_12
    sum_im = (params.psi_7 - params.psi_5) * s_6 + (params.psi_13 - params.psi_11) * s_12
    more_re = 6.0 * (params.psi_7 - params.psi_5) * c_6 + 12.0 * (params.psi_13 - params.psi_11) * c_12
    more_im = 6.0 * (params.psi_7 + params.psi_5) * s_6 + 12.0 * (params.psi_13 + params.psi_11) * s_12
    alpha, beta = _times(cos, sin, params.psi_f + sum_re, sum_im)
    more_alpha, more_beta = _times(cos, sin, more_re, more_im)
    cogging = s_6 * (params.cog_6 + 2.0 * c_6 * params.cog_12)
    return Magnet(alpha, beta, more_alpha, more_beta, cogging, cos, sin, c_2, s_2)


@kernel
def _crossed(params: Params, v_d: float, v_q: float) -> tuple[float, float]:
    """i_d, i_q (A) that are there because the axes saturate one another, from the winding's own flux (V s)."""
    half = 0.5 * params.cross * v_q
    return half * v_q * (v_d + params.psi_f), half * v_d * (v_d + 2.0 * params.psi_f)


@kernel
def uneven_currents(params: Params, magnet: Magnet, psi_alpha: float, psi_beta: float) -> tuple[float, float]:
    """i_alpha, i_beta (A) of an uneven motor from the flux linkage (V s)."""
    v_alpha = psi_alpha - magnet.alpha
    v_beta = psi_beta - magnet.beta
    i_alpha = params.g_mean * v_alpha + params.g_diff * (magnet.cos_2 * v_alpha + magnet.sin_2 * v_beta)
    i_beta = params.g_mean * v_beta + params.g_diff * (magnet.sin_2 * v_alpha - magnet.cos_2 * v_beta)
    more = 1.0 + params.soft * (v_alpha * i_alpha + v_beta * i_beta)
    i_alpha *= more
    i_beta *= more
    if seldom(params.cross != 0.0):
        v_d, v_q = _times(v_alpha, v_beta, magnet.cos, -magnet.sin)
        d, q = _crossed(params, v_d, v_q)
        x_alpha, x_beta = _times(d, q, magnet.cos, magnet.sin)
        i_alpha += x_alpha
        i_beta += x_beta
    return i_alpha, i_beta


@kernel
def uneven_torque(
    params: Params, magnet: Magnet, psi_alpha: float, psi_beta: float, i_alpha: float, i_beta: float
) -> float:
    """Torque of an uneven motor, cogging too, N m."""
    by_flux = (psi_alpha + magnet.more_alpha) * i_beta - (psi_beta + magnet.more_beta) * i_alpha
    return params.k_tau * by_flux + magnet.cogging


@kernel
def even_currents(params: Params, psi_alpha: float, psi_beta: float, cos: float, sin: float) -> tuple[float, float]:
    """i_alpha, i_beta (A) of a motor with L_d = L_q and a sinusoidal back-EMF."""
    return params.g_mean * (psi_alpha - params.psi_f * cos), params.g_mean * (psi_beta - params.psi_f * sin)


@kernel
def currents(params: Params, psi_alpha: float, psi_beta: float, cos: float, sin: float) -> tuple[float, float]:
    """i_alpha, i_beta (A) from the flux linkage (V s) and the rotor's angle."""
    if params.uneven == 1:
        return uneven_currents(params, magnet(params, cos, sin), psi_alpha, psi_beta)
    v_alpha = psi_alpha - params.psi_f * cos
    v_beta = psi_beta - params.psi_f * sin
    i_alpha = params.g_mean * v_alpha
    i_beta = params.g_mean * v_beta
    if params.g_diff != 0.0:
        cos2 = cos * cos - sin * sin
        sin2 = 2.0 * cos * sin
        i_alpha += params.g_diff * (cos2 * v_alpha + sin2 * v_beta)
        i_beta += params.g_diff * (sin2 * v_alpha - cos2 * v_beta)
    return i_alpha, i_beta


@kernel
def _own_flux(params: Params, i_d: float, i_q: float, v_d: float, v_q: float) -> tuple[float, float]:
    """The winding's own flux (V s) that takes these currents (A) where the axes cross, by Newton from a guess."""
    apart()
    g_d, g_q = params.g_mean + params.g_diff, params.g_mean - params.g_diff
    for _ in range(12):
        linear_d, linear_q = g_d * v_d, g_q * v_q
        more = 1.0 + params.soft * (v_d * linear_d + v_q * linear_q)
        whole = v_d + params.psi_f
        cross_d, cross_q = _crossed(params, v_d, v_q)
        wrong_d = more * linear_d + cross_d - i_d
        wrong_q = more * linear_q + cross_q - i_q
        h_dd = g_d * more + 2.0 * params.soft * linear_d * linear_d + 0.5 * params.cross * v_q * v_q
        h_qq = g_q * more + 2.0 * params.soft * linear_q * linear_q
        h_qq += 0.5 * params.cross * v_d * (v_d + 2.0 * params.psi_f)
        h_dq = 2.0 * params.soft * linear_d * linear_q + params.cross * whole * v_q
        det = h_dd * h_qq - h_dq * h_dq
        v_d -= (h_qq * wrong_d - h_dq * wrong_q) / det
        v_q -= (h_dd * wrong_q - h_dq * wrong_d) / det
    return v_d, v_q


@kernel
def flux(params: Params, i_alpha: float, i_beta: float, cos: float, sin: float) -> tuple[float, float]:
    """psi_alpha, psi_beta (V s) from the currents (A) and the rotor's angle: the inverse of `currents`."""
    i_d = cos * i_alpha + sin * i_beta
    i_q = cos * i_beta - sin * i_alpha
    psi_d = i_d / (params.g_mean + params.g_diff)
    psi_q = i_q / (params.g_mean - params.g_diff)
    if params.uneven == 0:
        psi_d += params.psi_f
        return cos * psi_d - sin * psi_q, sin * psi_d + cos * psi_q
    if params.soft > 0.0:  # i = i_0 (1 + c x^2) of i_0 = i / x: Newton for the cubic x - 1 - c / x^2, c at i itself
        c = params.soft * (psi_d * i_d + psi_q * i_q)
        x = 1.0 + c
        for _ in range(30):
            x -= (x * x * x - x * x - c) / (3.0 * x * x - 2.0 * x)
        psi_d /= x
        psi_q /= x
    if params.cross != 0.0:
        psi_d, psi_q = _own_flux(params, i_d, i_q, psi_d, psi_q)
    m = magnet(params, cos, sin)
    return cos * psi_d - sin * psi_q + m.alpha, sin * psi_d + cos * psi_q + m.beta


@kernel
def currents_and_torque(
    params: Params, psi_alpha: float, psi_beta: float, cos: float, sin: float
) -> tuple[float, float, float]:
    """`currents`, and the electromagnetic torque, N m, without cogging."""
    if params.uneven == 1:
        m = magnet(params, cos, sin)
        i_alpha, i_beta = uneven_currents(params, m, psi_alpha, psi_beta)
        return i_alpha, i_beta, uneven_torque(params, m, psi_alpha, psi_beta, i_alpha, i_beta) - m.cogging
    i_alpha, i_beta = currents(params, psi_alpha, psi_beta, cos, sin)
    return i_alpha, i_beta, params.k_tau * (psi_alpha * i_beta - psi_beta * i_alpha)


@kernel
def phases(alpha: float, beta: float) -> tuple[float, float, float]:
    """Phase quantities a, b, c of a stator-frame vector."""
    b = HALF_SQRT3 * beta - 0.5 * alpha
    return alpha, b, -alpha - b


@kernel
def vector(a: float, b: float, c: float) -> tuple[float, float]:
    """Stator-frame vector of phase quantities; what the three have in common drops out."""
    return (2.0 * a - b - c) * ONE_THIRD, (b - c) * ONE_BY_SQRT3
