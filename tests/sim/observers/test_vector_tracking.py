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
