"""A switched inverter on a machine at constant speed: an oracle of what dead time does, from first principles.

Between two events (a switch turns, a diode's current ends) the legs' voltages are constant, and each phase is a
resistance and an inductance in series with a sinusoidal voltage: its current has a closed form. So nothing here is
integrated in steps, and nothing is averaged. Upper and lower switch of a leg conduct both ways; in the dead time a
leg's current flows through a diode, up to where it is zero: then the leg floats until a switch turns on or the floating
voltage reaches a rail.

A PI controller of the currents in the rotor's frame, with one period of delay and the true angle, closes the loop.

    python -m tests.sim.plant.switched

writes what it makes of three motors, three dead times and 24 working points to tests/data/switched.npz: compiling
takes its time, and what is compared with it needs only some periods of the steady state.
"""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numba
import numpy as np

LOW, HIGH, DEAD = 0, 1, 2
SIGMA = 2.0 * math.pi / 3.0
BANDWIDTH = 2.0 * math.pi * 500.0  # of the current loop, rad/s
PERIOD = 1.0 / 16000.0  # s
U_DC, U_DIODE = 24.0, 0.8  # V
MOTORS = (((0.158, 176e-6, 6.55e-3), 6), ((0.35, 600e-6, 10.5e-3), 4), ((0.12, 90e-6, 4.2e-3), 7))
"""R_s in ohm, L_s in H, psi_f in V s; pole pairs."""
DEAD_TIMES = (0.5e-6, 1e-6, 2e-6)  # s
POINTS = tuple(itertools.product((20, 100, 500, 1000, 2000, 3000), (0.5, 1.0, 4.0, 8.0)))  # r/min, A
KEPT = 41  # periods of a point: at as many angles, in one turn or six
FILE = Path(__file__).parents[2] / "data" / "switched.npz"


@numba.njit(error_model="numpy")
def _current(i0, u, a, b, w, R, L, t0, t1):
    """Current at t1 of a phase with i0 at t0 and the voltage u - a cos(w t) - b sin(w t) in between."""
    z = R * R + (w * L) ** 2
    A, B = (R * a - w * L * b) / z, (R * b + w * L * a) / z
    rest = i0 - u / R + A * math.cos(w * t0) + B * math.sin(w * t0)
    return u / R - A * math.cos(w * t1) - B * math.sin(w * t1) + rest * math.exp(-R * (t1 - t0) / L)


@numba.njit(error_model="numpy")
def _mode(gate, i, e, u_dc, u_diode, v, conducts):
    """Leg voltages `v` and whether each leg conducts, for gate states, currents and induced voltages at a moment."""
    driven = 0
    for k in range(3):
        conducts[k] = True
        if gate[k] == LOW:
            v[k] = 0.0
        elif gate[k] == HIGH:
            v[k] = u_dc
        elif i[k] > 0.0:
            v[k] = -u_diode
        elif i[k] < 0.0:
            v[k] = u_dc + u_diode
        else:
            conducts[k] = False
        driven += conducts[k]
    for _ in range(3):  # a floating leg follows the star point until it reaches a rail
        star = 0.5 * u_dc
        if driven:
            star = 0.0
            for k in range(3):
                if conducts[k]:
                    star += (v[k] - e[k]) / driven
        changed = False
        for k in range(3):
            if not conducts[k]:
                v[k] = star + e[k]
                rail = -u_diode if v[k] < -u_diode else u_dc + u_diode
                if driven and not -u_diode <= v[k] <= u_dc + u_diode and not changed:
                    v[k], conducts[k], changed = rail, True, True
                    driven += 1
        if not changed:
            return


@numba.njit(error_model="numpy")
def switching(i, t0, T, duty, w, R, L, psi, u_dc, dead_time, u_diode, mean):
    """One centre-aligned period from t0 on, angle w t: changes the currents `i`; `mean`: the legs' mean voltages, V."""
    a, b = np.empty(3), np.empty(3)
    for k in range(3):  # e_k = -w psi sin(w t - k sigma) = a cos + b sin
        a[k], b[k] = w * psi * math.sin(k * SIGMA), -w * psi * math.cos(k * SIGMA)
    times, legs, states = np.empty(12), np.empty(12, np.int64), np.empty(12, np.int64)
    gate = np.zeros(3, np.int64)
    for k in range(3):
        rise, fall = 0.5 * T * (1.0 - duty[k]), 0.5 * T * (1.0 + duty[k])
        at = (rise, min(rise + dead_time, fall), fall, min(fall + dead_time, T))
        what = (DEAD, HIGH, DEAD, LOW)
        for j in range(4):
            times[4 * k + j], legs[4 * k + j], states[4 * k + j] = at[j], k, what[j]
    order = np.argsort(times, kind="mergesort")
    e, v, conducts, after = np.empty(3), np.empty(3), np.empty(3, np.bool_), np.empty(3)
    mean[:] = 0.0
    now = 0.0
    for n in range(13):
        end = times[order[n]] if n < 12 else T
        while now < end:
            here = t0 + now
            for k in range(3):
                e[k] = a[k] * math.cos(w * here) + b[k] * math.sin(w * here)
            _mode(gate, i, e, u_dc, u_diode, v, conducts)
            count, u_star, a_star, b_star = 0, 0.0, 0.0, 0.0
            for k in range(3):
                if conducts[k]:
                    count += 1
                    u_star, a_star, b_star = u_star + v[k], a_star + a[k], b_star + b[k]
            if count:
                u_star, a_star, b_star = u_star / count, a_star / count, b_star / count
            until, zero = end, -1
            for _ in range(2):  # to the end, or to the first current that reaches zero on its diode
                for k in range(3):
                    after[k] = 0.0
                    if conducts[k] and count > 1:
                        after[k] = _current(
                            i[k], v[k] - u_star, a[k] - a_star, b[k] - b_star, w, R, L, here, t0 + until
                        )
                first = -1
                for k in range(3):
                    if gate[k] == DEAD and conducts[k] and i[k] * after[k] < 0.0 and k != zero:
                        lo, hi = now, until
                        for _ in range(60):
                            mid = 0.5 * (lo + hi)
                            x = _current(i[k], v[k] - u_star, a[k] - a_star, b[k] - b_star, w, R, L, here, t0 + mid)
                            if x * i[k] > 0.0:
                                lo = mid
                            else:
                                hi = mid
                        until, first = hi, k
                if first < 0:
                    break
                zero = first
            for k in range(3):
                mean[k] += v[k] * (until - now) / T
                i[k] = after[k]
            if zero >= 0:
                i[zero] = 0.0
            now = until
        if n < 12:
            k = legs[order[n]]
            gate[k] = states[order[n]]


@numba.njit(error_model="numpy")
def run(n, motor, inverter, w, i_q, lost, where, currents, duties):
    """n periods under current control at the electrical speed w (rad/s), from rest, at i_d = 0.

    Args:
        motor: R, L, psi in ohm, H, V s.
        inverter: u_dc, dead time, a diode's drop, PWM period in V and s.
        lost: room for the legs' voltages lost, V, shape (n, 3), what they have in common taken off.
        where: for the angle in the middle of each period, rad, (n,).
        currents: at its beginning, A, (n, 3).
        duties: in force in it, (n, 3).
    """
    R, L, psi = motor
    u_dc, dead_time, u_diode, T = inverter
    i, mean, duty, wanted = np.zeros(3), np.zeros(3), np.full(3, 0.5), np.empty(3)
    u_alpha = u_beta = sum_d = sum_q = 0.0
    k_p, k_i = BANDWIDTH * L, BANDWIDTH * R * T
    for m in range(n):
        t = m * T
        currents[m] = i
        c, s = math.cos(w * t), math.sin(w * t)
        i_alpha, i_beta = i[0], (i[1] - i[2]) / math.sqrt(3.0)
        error_d, error_q = -(c * i_alpha + s * i_beta), i_q - (c * i_beta - s * i_alpha)
        for k in range(3):
            wanted[k] = u_alpha * math.cos(k * SIGMA) + u_beta * math.sin(k * SIGMA)
        middle = 0.5 * (max(wanted) + min(wanted))
        for k in range(3):
            duty[k] = 0.5 + (wanted[k] - middle) / u_dc
        duties[m] = duty
        switching(i, t, T, duty, w, R, L, psi, u_dc, dead_time, u_diode, mean)
        error = mean - duty * u_dc
        lost[m] = error - np.sum(error) / 3.0
        where[m] = w * (t + 0.5 * T)
        u_d, u_q = k_p * error_d + sum_d - w * L * i_q, k_p * error_q + sum_q + w * psi
        size, most = math.hypot(u_d, u_q), 0.97 * u_dc / math.sqrt(3.0)
        if size > most:
            u_d, u_q = u_d * most / size, u_q * most / size
        else:
            sum_d, sum_q = sum_d + k_i * error_d, sum_q + k_i * error_q
        c, s = math.cos(w * (t + 1.5 * T)), math.sin(w * (t + 1.5 * T))
        u_alpha, u_beta = c * u_d - s * u_q, s * u_d + c * u_q


def harmonics(values: np.ndarray, theta: np.ndarray, orders: tuple[int, ...]) -> dict[int, complex]:
    """Amplitudes and phases of `values` (n,) at angles (n,): x = Re(h e^{j order theta}), by least squares."""
    columns = [f(k * theta) for k in orders for f in (np.cos, np.sin)]
    found, *_ = np.linalg.lstsq(np.stack([*columns, np.ones(len(theta))], axis=1), values, rcond=None)
    return {k: complex(found[2 * j], -found[2 * j + 1]) for j, k in enumerate(orders)}


def steady(motor, dead, rpm, i_q, u_diode=U_DIODE):
    """A turn, or six, in steady state.

    Returns:
        The lost voltages (V) and the angles in the middle of the periods, their currents (A) and duties, by phase.
    """
    constants, n_p = motor
    w = rpm * math.tau / 60.0 * n_p
    settled = round(0.1 / PERIOD)
    n = settled + round((1 if rpm < 100 else 6) * math.tau / w / PERIOD)
    lost, where, currents, duties = np.empty((n, 3)), np.empty(n), np.empty((n, 3)), np.empty((n, 3))
    run(n, constants, (U_DC, dead, u_diode, PERIOD), w, i_q, lost, where, currents, duties)
    return lost[settled:], where[settled:], currents[settled:], duties[settled:]


def kept():
    """What stands in the file, a row for each period that is kept.

    Returns:
        Number of the motor, dead time (s), r/min, A asked for; angle in the middle of the period, currents of phases a
        and b at its beginning, duties, voltages that phases a and b lost. Points that the link's voltage does not do
        are left out.
    """
    rows = []
    for (number, motor), dead, (rpm, i_q) in itertools.product(enumerate(MOTORS), DEAD_TIMES, POINTS):
        lost, where, currents, duties = steady(motor, dead, rpm, i_q)
        w = rpm * math.tau / 60.0 * motor[1]
        amplitude = abs(harmonics(currents[:, 0], where - 0.5 * w * PERIOD, (1, 5, 7))[1])
        if abs(amplitude - i_q) <= 0.02 * i_q:
            some = np.arange(KEPT) * len(where) // KEPT
            head = np.broadcast_to((number, dead, rpm, i_q), (KEPT, 4))
            found = (where[some] % math.tau, currents[some, :2], duties[some], lost[some, :2])
            rows.append(np.column_stack((head, *found)))
    return np.concatenate(rows)


if __name__ == "__main__":
    np.savez_compressed(FILE, periods=kept().astype(np.float32))
