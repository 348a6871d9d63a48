"""What the dead time makes of a PWM period: the legs' mean voltages, by the currents at each switching.

A leg whose switches are both off follows its current: through the lower diode where it flows out, through the upper
one where it flows in. So an edge is late or not by the sign of the current at that edge, ripple included, and a current
that reaches zero meanwhile stays there: the leg floats until a switch turns on, or until its voltage reaches a rail.

The period is walked through from event to event, with the currents as straight lines in between, for the mean
inductance and the back-EMF as it changes. That agrees with legs in small steps (`test_dead_time_by_edges.py`) to
0.8 % of the dead time's voltage in the fundamental. Where every phase keeps away from zero, all of that is the sign of
its current. Where one alone comes near, and no other leg switches in its dead times, what its current is at its edges
follows from the legs' voltages until then, and nothing is walked through.

Centre-aligned PWM: a leg rises at T/2 (1 - d) and falls at T/2 (1 + d). Both switches conduct both ways without a drop
of their own: that is `u_device`'s.

Source: own derivation; N. Urasaki et al., "Dead-time compensation strategy for permanent magnet synchronous motor drive
taking zero-current clamp and parasitic capacitance effects into account", IEE Proc. Electr. Power Appl., 2005, tells
of the clamping.
"""

from __future__ import annotations

from typing import NamedTuple

from sim.numba_cache import kernel
from sim.plant import pmsm

Two = tuple[float, float]
Three = tuple[float, float, float]
"""A value for each phase."""

LOW, DEAD, HIGH = 0, 1, 2
ONE_THIRD = 1.0 / 3.0
EVENTS = 40  # more than a period can have: 12 switchings, and what happens at diodes between them


class Params(NamedTuple):
    """Constants of the legs."""

    T: float  # PWM period, s
    dead: float  # s
    u_dc: float  # V
    u_diode: float  # V


@kernel
def _gate(params: Params, duty: float, now: float) -> tuple[int, float]:
    """State of a leg's switches at a moment of the period, s, and until when."""
    if duty <= 0.0:
        return LOW, params.T
    if duty >= 1.0:
        return HIGH, params.T
    rise = 0.5 * params.T * (1.0 - duty)
    fall = params.T - rise
    if now < fall + params.dead - params.T:  # of the period before
        return DEAD, fall + params.dead - params.T
    if now < rise:
        return LOW, rise
    if now < min(rise + params.dead, fall):
        return DEAD, min(rise + params.dead, fall)
    if now < fall:
        return HIGH, fall
    if now < fall + params.dead:
        return DEAD, min(fall + params.dead, params.T)
    return LOW, params.T


@kernel
def _leg(params: Params, gate: int, i: float) -> tuple[float, float]:
    """A leg's voltage, V, and 1.0 if it conducts."""
    if gate == LOW:
        return 0.0, 1.0
    if gate == HIGH:
        return params.u_dc, 1.0
    if i > 0.0:
        return -params.u_diode, 1.0
    if i < 0.0:
        return params.u_dc + params.u_diode, 1.0
    return 0.0, 0.0


@kernel
def _floating(params: Params, star: float, e: float) -> tuple[float, float]:
    """The same of a leg without current, by the star point and the voltage behind its phase."""
    v = star + e
    if v < -params.u_diode:
        return -params.u_diode, 1.0
    if v > params.u_dc + params.u_diode:
        return params.u_dc + params.u_diode, 1.0
    return v, 0.0


@kernel
def _star(
    v_a: float, v_b: float, v_c: float, on_a: float, on_b: float, on_c: float, otherwise: float
) -> tuple[float, float]:
    """Mean of what conducts (V), and how many do."""
    n = on_a + on_b + on_c
    return ((on_a * v_a + on_b * v_b + on_c * v_c) / n if n > 0.0 else otherwise), n


@kernel
def _until_zero(gate: int, i: float, slope: float, left: float) -> float:
    """s until a diode's current ends, at most `left`."""
    return min(left, -i / slope) if gate == DEAD and i * slope < 0.0 else left


@kernel
def _further(i: float, slope: float, step: float, gate: int) -> float:
    """A current (A) after `step` s; exactly zero where a diode ends it."""
    after = i + slope * step
    return 0.0 if gate == DEAD and i * slope < 0.0 and -i / slope <= step else after


@kernel
def _ripple(d: float, d_1: float, d_2: float, mean: float) -> float:
    """By how much a leg's current at its rising edge is below the line of its mean, in units of u_dc T / L."""
    rise = 0.5 * (1.0 - d)
    return ONE_THIRD * 0.5 * (max(0.0, d_1 - d) + max(0.0, d_2 - d)) + (d - mean) * rise


@kernel
def _area(u_dc: float, on: float, off: float, now: float) -> float:
    """V s of a leg that is high from `on` to `off` (s), until `now`."""
    return u_dc * (min(max(now, on), off) - on)


@kernel
def _window(params: Params, i: float, pull: float, others: float, e: float) -> tuple[float, bool]:
    """V s of a leg in a dead time that begins with the current `i` (A), and whether that is so.

    `pull` (A/s): of the current per volt; `others`: mean of the other legs' voltages; `e`: what is behind the phase.
    It is not so where the leg takes up a current the other way.
    """
    v = -params.u_diode if i > 0.0 else params.u_dc + params.u_diode
    floating = others + 1.5 * e  # the leg's voltage without a current
    rate = pull * (v - floating)
    if (i + rate * params.dead) * i > 0.0:
        return v * params.dead, True
    if floating < -params.u_diode or floating > params.u_dc + params.u_diode:
        return 0.0, False
    t = -i / rate
    return v * t + floating * (params.dead - t), True


@kernel
def _alone(
    params: Params, pull: float, duty: float, i: float, e: float, rise_e: float, y: Two, z: Two
) -> tuple[float, bool]:
    """V s of the one leg near zero, and whether that is so; `y`, `z`: when the others are high (s).

    `pull`: 2/3 of 1/L; `e`, `rise_e`: voltage behind the phase and its slope (V, V/s). It is not so where an edge of
    another leg falls into a dead time of this one.
    """
    dead = params.dead
    u_dc = params.u_dc
    rise = 0.5 * params.T * (1.0 - duty)
    fall = params.T - rise
    if rise <= dead or rise + dead >= fall or y[1] > params.T or z[1] > params.T:
        return 0.0, False
    area = 0.0
    for k in range(2):
        begin = rise if k == 0 else fall
        end = begin + dead
        for edge in (y[0], y[1], z[0], z[1]):
            if begin < edge < end:
                return 0.0, False
        others = 0.5 * (_area(u_dc, y[0], y[1], begin) + _area(u_dc, z[0], z[1], begin))
        after = 0.5 * (_area(u_dc, y[0], y[1], end) + _area(u_dc, z[0], z[1], end))
        i_begin = i + pull * (area - others - 1.5 * begin * (e + 0.5 * rise_e * begin))
        gained, so = _window(params, i_begin, pull, (after - others) / dead, e + rise_e * (begin + 0.5 * dead))
        if not so:
            return 0.0, False
        area += gained
        if k == 0:
            area += u_dc * (fall - end)
    return area, True


@kernel
def _high(params: Params, duty: float, i: float) -> tuple[float, float]:
    """When a leg whose current keeps its sign is high (s)."""
    if duty <= 0.0:
        return params.T, params.T
    if duty >= 1.0:
        return 0.0, params.T
    rise = 0.5 * params.T * (1.0 - duty)
    if i > 0.0:
        return min(rise + params.dead, params.T - rise), params.T - rise
    return rise, params.T - rise + params.dead


@kernel
def mean_voltage(
    params: Params, motor: pmsm.Params, duties: Three, currents: Three, cos: float, sin: float, omega_e: float
) -> tuple[float, float]:
    """Mean voltage of a period (V, alpha and beta) with duties 0..1; currents (A), angle and speed are its first."""
    T = params.T
    d_a, d_b, d_c = duties
    i_a, i_b, i_c = currents
    ripple = params.u_dc * T * motor.g_mean
    mean = ONE_THIRD * (d_a + d_b + d_c)
    least = abs(omega_e) * T * max(abs(i_a), abs(i_b), abs(i_c)) + params.u_dc * params.dead * motor.g_mean
    near_a = abs(i_a) <= least + ripple * abs(_ripple(d_a, d_b, d_c, mean))
    near_b = abs(i_b) <= least + ripple * abs(_ripple(d_b, d_a, d_c, mean))
    near_c = abs(i_c) <= least + ripple * abs(_ripple(d_c, d_a, d_b, mean))
    lost = (params.u_dc + 2.0 * params.u_diode) * params.dead / T  # late at one edge, a diode at both
    v_a = d_a * params.u_dc - (0.0 if d_a <= 0.0 or d_a >= 1.0 else lost if i_a > 0.0 else -lost)
    v_b = d_b * params.u_dc - (0.0 if d_b <= 0.0 or d_b >= 1.0 else lost if i_b > 0.0 else -lost)
    v_c = d_c * params.u_dc - (0.0 if d_c <= 0.0 or d_c >= 1.0 else lost if i_c > 0.0 else -lost)
    near = int(near_a) + int(near_b) + int(near_c)
    if near == 0:
        return pmsm.vector(v_a, v_b, v_c)
    if near == 1:
        emf = omega_e * motor.psi_f
        e_a, e_b, e_c = pmsm.phases(-emf * sin, emf * cos)
        s_a, s_b, s_c = pmsm.phases(-emf * omega_e * cos, -emf * omega_e * sin)
        high_a = _high(params, d_a, i_a)
        high_b = _high(params, d_b, i_b)
        high_c = _high(params, d_c, i_c)
        pull = 2.0 * ONE_THIRD * motor.g_mean
        if near_a:
            area, so = _alone(params, pull, d_a, i_a, e_a + motor.R_s * i_a, s_a, high_b, high_c)
            v_a = area / T
        elif near_b:
            area, so = _alone(params, pull, d_b, i_b, e_b + motor.R_s * i_b, s_b, high_a, high_c)
            v_b = area / T
        else:
            area, so = _alone(params, pull, d_c, i_c, e_c + motor.R_s * i_c, s_c, high_a, high_b)
            v_c = area / T
        if so:
            return pmsm.vector(v_a, v_b, v_c)
    return _walked(params, motor, duties, currents, cos, sin, omega_e)


@kernel
def _walked(
    params: Params, motor: pmsm.Params, duties: Three, currents: Three, cos: float, sin: float, omega_e: float
) -> tuple[float, float]:
    """`mean_voltage` where it takes a walk from event to event."""
    d_a, d_b, d_c = duties
    i_a, i_b, i_c = currents
    emf = omega_e * motor.psi_f
    sum_a = sum_b = sum_c = 0.0
    now = 0.0
    for _ in range(EVENTS):
        gate_a, next_a = _gate(params, d_a, now)
        gate_b, next_b = _gate(params, d_b, now)
        gate_c, next_c = _gate(params, d_c, now)
        left = min(next_a, next_b, next_c) - now
        turned = omega_e * (now + 0.5 * left)
        e_a, e_b, e_c = pmsm.phases(-emf * (sin + turned * cos), emf * (cos - turned * sin))
        e_a += motor.R_s * i_a
        e_b += motor.R_s * i_b
        e_c += motor.R_s * i_c
        v_a, on_a = _leg(params, gate_a, i_a)
        v_b, on_b = _leg(params, gate_b, i_b)
        v_c, on_c = _leg(params, gate_c, i_c)
        star, n = _star(v_a - e_a, v_b - e_b, v_c - e_c, on_a, on_b, on_c, 0.5 * params.u_dc)
        if n < 3.0:
            if on_a == 0.0:
                v_a, on_a = _floating(params, star, e_a)
            if on_b == 0.0:
                v_b, on_b = _floating(params, star, e_b)
            if on_c == 0.0:
                v_c, on_c = _floating(params, star, e_c)
            if on_a + on_b + on_c > n:
                star, n = _star(v_a - e_a, v_b - e_b, v_c - e_c, on_a, on_b, on_c, star)
        pull = motor.g_mean / (1.0 + 0.5 * motor.R_s * motor.g_mean * left) if n > 1.0 else 0.0  # by the mean drop
        slope_a = pull * on_a * (v_a - e_a - star)
        slope_b = pull * on_b * (v_b - e_b - star)
        slope_c = pull * on_c * (v_c - e_c - star)
        step = min(
            _until_zero(gate_a, i_a, slope_a, left),
            _until_zero(gate_b, i_b, slope_b, left),
            _until_zero(gate_c, i_c, slope_c, left),
        )
        i_a = _further(i_a, slope_a, step, gate_a)
        i_b = _further(i_b, slope_b, step, gate_b)
        i_c = _further(i_c, slope_c, step, gate_c)
        sum_a += v_a * step
        sum_b += v_b * step
        sum_c += v_c * step
        now += step
        if now >= params.T:
            break
    return pmsm.vector(sum_a / params.T, sum_b / params.T, sum_c / params.T)
