"""The back-EMF (5), and what of the motor's voltage the parameters do not explain: learned on line.

Dead time. What the drive leaves uncompensated is a voltage v in step with the signs of the phase currents,

    u_x = u_x* - v sat(i_x / I_FADE),   x = a, b, c.

Across the rotor it swings at six times the frequency, which at low speed distorts the back-EMF more than noise does. v
follows by least mean squares from what the observer's loop leaves of e_d, the back-EMF across the estimate, along the d
component of those signs; the slower, the stronger the back-EMF: at speed other errors swing alike, and v matters less.

Resistance. Over a sector the mean back-EMF along the estimate is psi_f omega plus (R_s - R_s_hat) i_q, and the edges
give omega. Where the speed is low, so that an error of psi_f matters little, a part of the difference goes to R_s.

Never measures an angle or a speed, and never learns an inductance (`edge_learning` does).

Source: (5) of Kim et al. 2011, DOI 10.1109/TIE.2010.2098367; the dead time's error as a vector in step with the
currents' signs, its size estimated: S.-Y. Kim, W. Lee, M.-S. Rho, S.-Y. Park, "Effective Dead-Time Compensation Using a
Simple Vectorial Disturbance Estimator in PMSM Drives", IEEE Trans. Ind. Electron., vol. 57, no. 5, 2010, pp. 1609-1614.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sim.numba_cache import kernel
from sim.observers.sample import Sample
from sim.observers.transforms import clarke, clip

SQRT3 = math.sqrt(3.0)
I_FADE = 0.3  # A, below it the dead time's error is in proportion to the current: the sign changes within the period
V_RATE = 30.0  # 1/(V s)
V_MAX = 0.5  # V
R_RATE = 0.02  # a sector
R_MAX = 0.5  # of R_s_hat


class Voltage(NamedTuple):
    """What is learned."""

    v: float  # V, of a phase
    R_error: float  # ohm, R_s less R_s_hat


class BackEmf(NamedTuple):
    """Mean values over one period, in the stator frame."""

    e_alpha: float  # V
    e_beta: float
    i_alpha: float  # A
    i_beta: float
    s_alpha: float  # signs of the phase currents, as the dead time's error has them
    s_beta: float


@kernel
def init() -> Voltage:
    """Nothing learned: the parameters explain everything."""
    return Voltage(0.0, 0.0)


@kernel
def _sign(current: float) -> float:
    return clip(current / I_FADE, 1.0)


@kernel
def back_emf(
    voltage: Voltage, R_s_hat: float, L_by_T: float, sample: Sample, i_alpha_before: float, i_beta_before: float
) -> BackEmf:
    """Mean back-EMF (5) of the period that ends at `sample`; the currents of the sample before in A."""
    i_alpha = 0.5 * (sample.i_alpha + i_alpha_before)
    i_beta = 0.5 * (sample.i_beta + i_beta_before)
    h = SQRT3 * i_beta
    s_alpha, s_beta = clarke(_sign(i_alpha), _sign(0.5 * (h - i_alpha)), _sign(-0.5 * (h + i_alpha)))
    R_s = R_s_hat + voltage.R_error
    return BackEmf(
        sample.u_alpha - R_s * i_alpha - L_by_T * (sample.i_alpha - i_alpha_before) - voltage.v * s_alpha,
        sample.u_beta - R_s * i_beta - L_by_T * (sample.i_beta - i_beta_before) - voltage.v * s_beta,
        i_alpha,
        i_beta,
        s_alpha,
        s_beta,
    )


@kernel
def learn_dead_time(voltage: Voltage, seconds: float, rest: float, s_d: float) -> Voltage:
    """After `seconds` in which the loop left `rest` (V) of e_d, `s_d` being the signs' d component.

    The loop keeps the mean of `rest` at zero; e_d itself may have one, which a d current would turn into a drift of v.
    """
    return Voltage(clip(voltage.v + V_RATE * seconds * rest * s_d, V_MAX), voltage.R_error)


@kernel
def learn_resistance(voltage: Voltage, R_s_hat: float, excess: float, i_q: float) -> Voltage:
    """After a sector whose mean back-EMF along the estimate was `excess` (V) above psi_f omega, at `i_q` (A)."""
    R_error = voltage.R_error + R_RATE * excess * i_q / (i_q * i_q + 1.0)
    return Voltage(voltage.v, clip(R_error, R_MAX * R_s_hat))
