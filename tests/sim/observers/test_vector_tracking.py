import math

import numpy as np
import pytest
from ideal_motor import (
    DRIVE,
    PWM_HZ,
    T_S,
    constant,
    error_deg,
    estimate,
    own,
    rpm,
    run,
    samples,
    signals,
    voltage,
)

from sim.native import Cells
from sim.observers import back_emf, vector_tracking
from sim.observers.sample import Sample


def locked(omega_h, theta, *, start=None, direction=1, i_q=0.0, i_q_ref=0.0, **drive):
    """The observer alone, the correction on from the start, fed with any Hall speed and the back-EMF of `theta`.

    `start`: initial estimate (default: the true angle). Returns the estimates at samples 1, 2, ...
    """
    n = theta.size
    params = vector_tracking.make_params(PWM_HZ, own(vector_tracking, **drive))
    rotor = np.exp(1j * theta)
    i = 1j * np.broadcast_to(i_q, n) * rotor
    u = voltage(i, rotor)
    omega_h = np.broadcast_to(np.asarray(omega_h, float), n).copy()
    sector = (np.floor(theta / (np.pi / 3)) % 6).astype(np.int64)
    seen = Cells(Sample, n).array.view(np.recarray)
    hall = seen.hall
    hall.sector, hall.direction, hall.anchored, hall.omega = sector, direction, 1, omega_h
    first = vector_tracking.init()._replace(
        # the filter of (6) as it would have settled: as long as tau is short this hardly matters
        back_emf=back_emf.State(1, i.real[0], i.imag[0], u.real[1], u.imag[1]),
        on=1,
        direction=direction,
        theta=float(theta[0] if start is None else start),
        omega=float(omega_h[0]),
        omega_lpf=float(omega_h[0]),
    )
    seen.i_q_err = np.asarray(i_q_ref, float) - i_q
    seen.theta_avg, seen.u_alpha, seen.u_beta, seen.i_alpha, seen.i_beta = theta, u.real, u.imag, i.real, i.imag
    return run(vector_tracking, params, seen[1:], state=first)[1]


@pytest.mark.parametrize("speed", [500.0, 1000.0, 2000.0, -1000.0])
def test_the_filter_of_the_back_emf_leaves_no_bias(speed):
    s = signals(constant(rpm(speed)), 0.4)
    assert abs(error_deg(s.theta, estimate(vector_tracking, s, tau_max=1e-3).theta)[-800:].mean()) < 0.002


@pytest.mark.parametrize("hertz", [5.0, 37.0, 100.0, 202.0, 500.0, 1000.0])
@pytest.mark.parametrize("omega", [rpm(500), rpm(-500)])
def test_hall_ripple_passes_as_the_high_pass_of_11(hertz, omega):
    """theta_h = A sin(nu t) comes through as s²/(s² + k_p s + k_i) says, in size and phase."""
    n = round(PWM_HZ * (0.3 + 4 / hertz))
    t = np.arange(n) * T_S
    nu, A = 2 * np.pi * hertz, np.radians(2.0)
    out = locked(omega + A * nu * np.cos(nu * t), omega * t, tau_max=0.0, direction=int(np.sign(omega)))
    error = -np.radians(error_deg((omega * t)[1:], out.theta))
    tail = slice(-round(PWM_HZ * 2 / hertz), None)
    amplitude = 2 * np.mean(error[tail] * np.exp(-1j * nu * t[1:][tail])) * 1j
    # the loop holds its speed over a period: compare with (11) on z = e^{s T}, where 1/s is T z / (z - 1)
    z = np.exp(1j * nu * T_S)
    integral = T_S * z / (z - 1)
    k_p, k_i = DRIVE["k_p_vt"], DRIVE["k_i_vt"]
    expected = A * nu * integral / (1 + integral * (k_p + k_i * integral) / z)
    assert abs(amplitude) == pytest.approx(abs(expected), rel=0.05)
    s = 1j * nu
    paper = A * abs(s**2 / (s**2 + k_p * s + k_i))
    assert abs(amplitude) == pytest.approx(paper, rel=0.10 if hertz <= 500 else 0.25)


@pytest.mark.parametrize("omega", [rpm(500), rpm(-500)])
def test_an_error_decays_as_the_second_order_loop_of_fig_5(omega):
    t = np.arange(4000) * T_S
    e0 = np.radians(3.0)
    out = locked(omega, omega * t, start=-e0, tau_max=0.0, direction=int(np.sign(omega)))
    error = np.radians(error_deg((omega * t)[1:], out.theta))
    k_p, k_i = DRIVE["k_p_vt"], DRIVE["k_i_vt"]
    p1, p2 = np.roots([1, k_p, k_i])
    expected = e0 * (p1 * np.exp(p1 * t[1:]) - p2 * np.exp(p2 * t[1:])) / (p1 - p2)
    assert np.abs(error - expected).max() < 0.06 * e0
    assert abs(error[-1]) < 1e-4 * e0


@pytest.mark.parametrize("k_ic", [8.0, -8.0])
@pytest.mark.parametrize("k_pc", [0.0, 2e-3])
def test_load_angle_is_the_pi_of_the_current_error_and_shifts_the_estimate(k_ic, k_pc):
    """(18): delta_hat = k_pc e + k_ic integral(e); (19): in steady state theta_hat = theta + delta_hat."""
    omega, charge, pulse = rpm(500), 2e-3, 0.02  # A s in a pulse of 20 ms
    t = np.arange(4800) * T_S
    e = np.where((t > 0.05) & (t < 0.05 + pulse), charge / pulse, 0.0)
    params = {"k_ic": k_ic, "k_pc": k_pc, "load_angle_comp": 1.0}
    theta = omega * t
    out = locked(omega, theta, i_q_ref=e, **params)
    error = error_deg(theta[1:], out.theta)
    assert out.delta_hat[-1] == pytest.approx(k_ic * charge, rel=0.02)
    assert error[-100:].mean() == pytest.approx(-np.degrees(k_ic * charge), rel=0.03)
    during = (t[1:] > 0.051) & (t[1:] < 0.0695)
    rising = k_pc * charge / pulse + k_ic * (t[1:][during] - 0.05) * charge / pulse
    np.testing.assert_allclose(out.delta_hat[during], rising, atol=0.03 * abs(k_ic) * charge)


@pytest.mark.parametrize(("on", "largest"), [(0.0, 0.0), (1.0, np.pi / 6)])
def test_load_angle_is_zero_while_it_is_off_and_stays_within_30_degrees(on, largest):
    omega = rpm(500)
    t = np.arange(1600) * T_S
    out = locked(omega, omega * t, i_q=4.0, i_q_ref=5.0, k_ic=500.0, load_angle_comp=on)
    assert np.abs(out.delta_hat).max() == pytest.approx(largest)


def test_speed_is_filtered_at_its_cut_off():
    """A step of the speed comes out after the filter's time constant, 1 / (2 pi f)."""
    omega = rpm(500)
    t = np.arange(1600) * T_S
    step = np.where(t < 0.05, omega, 1.1 * omega)
    out = locked(step, np.cumsum(step) * T_S, bw_omega_lpf=50.0)
    rise = (out.omega - omega) / (0.1 * omega)
    reached = np.argmax(rise > 1 - math.exp(-1)) * T_S - 0.05
    assert reached == pytest.approx(1 / (2 * np.pi * 50), abs=2 * T_S)


def test_an_estimate_far_from_its_sector_is_dropped_and_found_again():
    """130 deg off, on the side where the loop would fall to 180 deg: the guard drops it."""
    omega = rpm(500)
    s = signals(constant(omega), 0.2)
    params = vector_tracking.make_params(PWM_HZ, own(vector_tracking))
    seen, half = samples(s), 1600
    state, _ = run(vector_tracking, params, seen[:half])
    lost = state._replace(theta=float(s.theta[half] + np.radians(130)), omega_corr_i=200.0)
    _, out = run(vector_tracking, params, seen[half:], state=lost)
    error = np.abs(error_deg(s.theta[half:], out.theta))
    assert out.on[0] == 0
    assert error[0] < 0.1
    assert error.max() < 1.0
    assert out.on[-1] == 1
