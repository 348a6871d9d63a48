"""The inverter, averaged over a PWM period: duties to phase voltages, with what dead time and devices take away.

    u_x = d_x u_dc - e_x sat(i_x / i_smooth),   e_x = u_dc t_d / T_s + u_device

A leg's current flows through a diode during the dead time, so the voltage lost opposes the current. Near zero current
the PWM ripple reverses the current within a period and the loss shrinks: here in proportion to the current, below
`i_smooth`. A leg that does not switch (duty 0 or 1) loses no dead time.

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


class Params(NamedTuple):
    """The inverter's constants."""

    u_dc: float  # V
    e_dead: float  # u_dc t_d / T_s, V
    e_device: float  # V
    g_smooth: float  # 1 / i_smooth, 1/A
    u_freewheel: float  # voltage against the current vector while the outputs are off, V


class Applied(NamedTuple):
    """What the inverter does over one period."""

    on: bool  # the outputs are on
    u_alpha: float  # ideal voltage by the duties, V
    u_beta: float
    e_a: float  # voltage lost at full current, V
    e_b: float
    e_c: float


def make_params(u_dc: float, dead_time: float, u_device: float, i_smooth: float, u_diode: float, T_s: float) -> Params:
    """The inverter's constants from V, s, V, A, V and the PWM period in s."""
    return Params(
        float(u_dc),
        u_dc * dead_time / T_s,
        float(u_device),
        1.0 / i_smooth,
        0.5 * u_dc + u_diode,
    )


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
def loss(params: Params, applied: Applied, i_alpha: float, i_beta: float) -> tuple[float, float]:
    """What dead time and devices take from u_alpha, u_beta (V) at these currents (A)."""
    i_a, i_b, i_c = pmsm.phases(i_alpha, i_beta)
    return pmsm.vector(
        applied.e_a * min(max(i_a * params.g_smooth, -1.0), 1.0),
        applied.e_b * min(max(i_b * params.g_smooth, -1.0), 1.0),
        applied.e_c * min(max(i_c * params.g_smooth, -1.0), 1.0),
    )


@kernel
def freewheel(params: Params, motor: pmsm.Params, i_alpha: float, i_beta: float, h: float) -> tuple[float, float]:
    """The currents (A) after `h` seconds with the outputs off: the vector shrinks to zero and stays there."""
    size = math.sqrt(i_alpha * i_alpha + i_beta * i_beta)
    left = size - h * params.u_freewheel * motor.g_mean
    if left <= 0.0:
        return 0.0, 0.0
    return i_alpha * (left / size), i_beta * (left / size)
