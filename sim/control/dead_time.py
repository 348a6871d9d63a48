"""Dead-time compensation: what a leg loses to its dead time, added to its duty by the sign of its current.

While both switches of a leg are off the current chooses the diode: a current into the motor pulls the
terminal to minus, one out of it to plus. Over a period the leg so loses t_d / T_s of the link voltage
against its current. Around zero current the switching ripple changes the sign within the period and the
loss fades out; the compensation fades with it, linearly below a current in proportion to the ripple, which
also keeps the noise of the current from being amplified.

The currents to give are those of the period in which the duties are in force: the measured ones turned
ahead with the voltage (no angle estimate enters, only a speed).

Never estimates what the dead time is: `dead_time_hat` and the compensated share are parameters.

Source: S.-Y. Kim, W. Lee, M.-S. Rho, S.-Y. Park, "Effective Dead-Time Compensation Using a Simple Vectorial
Disturbance Estimator in PMSM Drives", IEEE Trans. Ind. Electron., vol. 57, no. 5, 2010, pp. 1609-1614 (the
paper's [20]), takes the same error as a vector in step with the currents' signs, and estimates its size.
"""

from __future__ import annotations

from typing import NamedTuple

from sim.numba_cache import kernel

FADE = 0.8448  # V, the current below which it fades, times inductance and PWM frequency: 0.3 A with the paper's


class Params(NamedTuple):
    """Constants of the compensation."""

    duty: float  # share of a period that is given back at full current
    per_fade: float  # 1/A, of the current below which it fades


def make_params(pwm_hz: float, *, dead_time_hat: float, dead_time_comp: float, L_s_hat: float) -> Params:
    """Constants from the drive's parameters of the same names (s, share of the error that is compensated, H)."""
    fade = float(f"{FADE / (L_s_hat * pwm_hz):.3g}")
    return Params(float(dead_time_hat) * float(dead_time_comp) * float(pwm_hz), 1.0 / fade)


@kernel
def _share(params: Params, current: float) -> float:
    """Sign of a phase current, linear where it fades."""
    return min(max(current * params.per_fade, -1.0), 1.0)


@kernel
def compensate(
    params: Params, d_a: float, d_b: float, d_c: float, i_a: float, i_b: float, i_c: float
) -> tuple[float, float, float]:
    """Duties with the dead time's loss given back, each in [0, 1]; currents in A, positive into the motor."""
    return (
        min(max(d_a + params.duty * _share(params, i_a), 0.0), 1.0),
        min(max(d_b + params.duty * _share(params, i_b), 0.0), 1.0),
        min(max(d_c + params.duty * _share(params, i_c), 0.0), 1.0),
    )
