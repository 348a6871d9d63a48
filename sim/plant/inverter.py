"""The inverter, averaged over a PWM period: duties to phase voltages, with what dead time and devices take away.

    u_x = d_x u_dc - e_x sat(i_x / i_smooth),   e_x = u_dc t_d / T_s + u_device

A leg's current flows through a diode during the dead time, so the voltage lost opposes the current. Near zero current
the PWM ripple reverses the current within a period and the loss shrinks: here in proportion to the current, below
`i_smooth`. A leg that does not switch (duty 0 or 1) loses no dead time. Instead, `dead_time` can say what each period
loses by the currents at its edges; then only u_device is lost as above.

With the outputs off the phases float: the currents run down through the diodes against the DC link and then stay
zero. Rectification by a back-EMF above the DC link voltage is not modelled.

Never sees a reference voltage: modulation and compensation are the firmware's.

Source: S.-Y. Kim et al., "Effective dead-time compensation using a simple vectorial disturbance estimator in PMSM
drives", IEEE Trans. Ind. Electron., 2010, for the model of the error; reference [20] of DOI 10.1109/TIE.2010.2098367.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sim.numba_cache import kernel
from sim.plant import pmsm
from sim.plant.dead_time import Params as Legs

NEAR = 1e-6  # of i_smooth: closer currents are one
TWO_THIRDS = 2.0 / 3.0
CLEAR = 1.1  # of i_smooth: from here on a phase is not near zero, though the way is not quite straight


class Params(NamedTuple):
    """The inverter's constants."""

    u_dc: float  # V
    e_dead: float  # u_dc t_d / T_s, V
    e_device: float  # V
    g_smooth: float  # 1 / i_smooth, 1/A
    u_freewheel: float  # voltage against the current vector while the outputs are off, V
    legs: Legs  # without a dead time where `e_dead` stands for it


class Applied(NamedTuple):
    """What the inverter does over one period."""

    on: bool  # the outputs are on
    u_alpha: float  # ideal voltage by the duties, V
    u_beta: float
    e_a: float  # voltage lost at full current, V
    e_b: float
    e_c: float


def make_params(
    u_dc: float,
    dead_time: float,
    u_device: float,
    i_smooth: float,
    u_diode: float,
    T_s: float,
    dead_time_by_edges: int = 0,
) -> Params:
    """The inverter's constants from V, s, V, A, V, the PWM period in s, and 1 to let `sim.plant.dead_time` tell."""
    by_edges = dead_time if dead_time_by_edges else 0.0
    return Params(
        float(u_dc),
        u_dc * (dead_time - by_edges) / T_s,
        float(u_device),
        1.0 / i_smooth,
        0.5 * u_dc + u_diode,
        Legs(float(T_s), float(by_edges), float(u_dc), float(u_diode)),
    )


@kernel
def fed(params: Params, u_dc: float) -> Params:
    """The same inverter on another DC link voltage (V)."""
    legs = Legs(params.legs.T, params.legs.dead, u_dc, params.legs.u_diode)
    more = u_dc - params.u_dc
    e_dead = params.e_dead * (u_dc / params.u_dc)
    return Params(u_dc, e_dead, params.e_device, params.g_smooth, params.u_freewheel + 0.5 * more, legs)


@kernel
def taken(params: Params, applied: Applied, i_alpha: float, i_beta: float) -> float:
    """The mean current (A) that is taken from the DC link over a period with these mean currents (A)."""
    if not applied.on:  # what is left of the current runs into the link through the diodes
        return -0.75 * math.sqrt(i_alpha * i_alpha + i_beta * i_beta)
    device = Applied(True, 0.0, 0.0, params.e_device, params.e_device, params.e_device)
    loss_alpha, loss_beta = loss(params, applied, i_alpha, i_beta)
    kept_alpha, kept_beta = loss(params, device, i_alpha, i_beta)  # a drop turns into heat, and costs no current less
    u_alpha = applied.u_alpha - loss_alpha + kept_alpha
    u_beta = applied.u_beta - loss_beta + kept_beta
    return 1.5 * (u_alpha * i_alpha + u_beta * i_beta) / params.u_dc


@kernel
def off() -> Applied:
    """Outputs off."""
    return Applied(False, 0.0, 0.0, 0.0, 0.0, 0.0)


@kernel
def apply(params: Params, d_a: float, d_b: float, d_c: float) -> Applied:
    """Outputs on with duties 0..1; beyond that the leg stands still."""
    a = min(max(d_a, 0.0), 1.0)
    b = min(max(d_b, 0.0), 1.0)
    c = min(max(d_c, 0.0), 1.0)
    u_alpha, u_beta = pmsm.vector(a * params.u_dc, b * params.u_dc, c * params.u_dc)
    e_a = params.e_device + (params.e_dead if 0.0 < a < 1.0 else 0.0)
    e_b = params.e_device + (params.e_dead if 0.0 < b < 1.0 else 0.0)
    e_c = params.e_device + (params.e_dead if 0.0 < c < 1.0 else 0.0)
    return Applied(True, u_alpha, u_beta, e_a, e_b, e_c)


@kernel
def loses(applied: Applied) -> bool:
    """Whether any current makes a leg lose voltage."""
    return applied.e_a + applied.e_b + applied.e_c > 0.0


@kernel
def loss(params: Params, applied: Applied, i_alpha: float, i_beta: float) -> tuple[float, float]:
    """What dead time and devices take from u_alpha, u_beta (V) at these currents (A)."""
    i_a, i_b, i_c = pmsm.phases(i_alpha, i_beta)
    return pmsm.vector(
        applied.e_a * min(max(i_a * params.g_smooth, -1.0), 1.0),
        applied.e_b * min(max(i_b * params.g_smooth, -1.0), 1.0),
        applied.e_c * min(max(i_c * params.g_smooth, -1.0), 1.0),
    )


@kernel
def settled(params: Params, i0_alpha: float, i0_beta: float, i1_alpha: float, i1_beta: float) -> bool:
    """Whether `loss` is the same on the way from some currents (A) to others: no phase comes near zero."""
    g = params.g_smooth
    a0, b0, c0 = pmsm.phases(g * i0_alpha, g * i0_beta)
    a1, b1, c1 = pmsm.phases(g * i1_alpha, g * i1_beta)
    near = min(abs(a0), abs(b0), abs(c0), abs(a1), abs(b1), abs(c1))
    return near >= CLEAR and a0 * a1 > 0.0 and b0 * b1 > 0.0 and c0 * c1 > 0.0


@kernel
def _area(x: float) -> float:
    """Integral of sat from 0 to x."""
    size = abs(x)
    return 0.5 * x * x if size < 1.0 else size - 0.5


@kernel
def _mean_sat(x0: float, x1: float) -> float:
    """Mean of sat on the way from x0 to x1."""
    if x0 >= 1.0 and x1 >= 1.0:
        return 1.0
    if x0 <= -1.0 and x1 <= -1.0:
        return -1.0
    if abs(x1 - x0) < NEAR:
        return min(max(0.5 * (x0 + x1), -1.0), 1.0)
    return (_area(x1) - _area(x0)) / (x1 - x0)


@kernel
def mean_loss(
    params: Params,
    applied: Applied,
    i0_alpha: float,
    i0_beta: float,
    i1_alpha: float,
    i1_beta: float,
    bow_alpha: float,
    bow_beta: float,
) -> tuple[float, float]:
    """The mean of `loss` on the way from some currents (A) to others; `bow`: how far half way is from straight."""
    g = params.g_smooth
    shift_alpha = TWO_THIRDS * bow_alpha  # the straight way of the same mean
    shift_beta = TWO_THIRDS * bow_beta
    a0, b0, c0 = pmsm.phases(g * (i0_alpha + shift_alpha), g * (i0_beta + shift_beta))
    a1, b1, c1 = pmsm.phases(g * (i1_alpha + shift_alpha), g * (i1_beta + shift_beta))
    return pmsm.vector(
        applied.e_a * _mean_sat(a0, a1), applied.e_b * _mean_sat(b0, b1), applied.e_c * _mean_sat(c0, c1)
    )


@kernel
def freewheel(params: Params, motor: pmsm.Params, i_alpha: float, i_beta: float, h: float) -> tuple[float, float]:
    """The currents (A) after `h` seconds with the outputs off: the vector shrinks to zero and stays there."""
    size = math.sqrt(i_alpha * i_alpha + i_beta * i_beta)
    left = size - h * params.u_freewheel * motor.g_mean
    if left <= 0.0:
        return 0.0, 0.0
    return i_alpha * (left / size), i_beta * (left / size)
