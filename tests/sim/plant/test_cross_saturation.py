"""Axes that saturate one another: the law by its energy, its inverse, and what an engineer reads off it."""

import cmath
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

import sim
from sim.config.params import ConfigError, load_params
from sim.config.saturation import least_i_cross
from sim.plant import pmsm
from tests.sim.plant.test_integrator import Reference, make, voltage_steps

MOTORS = [None, *sorted((Path(sim.__file__).parent / "motors").glob("*.toml"))]
R, L, PSI, N_P = 0.158, 176e-6, 6.55e-3, 6


def crossed(R_s, L_d, L_q, psi_f, n_p, i_cross, **more):
    return pmsm.with_crossing(pmsm.make_params(R_s, L_d, L_q, psi_f, n_p, **more), i_cross)


def drawn(seed):
    """A motor of the eleven with crossing and isotropic saturation drawn, its reference, and the limit of currents."""
    rng = np.random.default_rng(seed)
    m = load_params(MOTORS[seed % len(MOTORS)]).motor
    i_cross = least_i_cross(m.L_d, m.L_q, m.psi_f, m.i_max) * rng.uniform(1.0, 5.0)
    i_sat = rng.choice([0.0, rng.uniform(2.0, 4.0) * m.i_max])
    params = crossed(m.R_s, m.L_d, m.L_q, m.psi_f, m.n_p, i_cross, i_sat=i_sat)
    return rng, params, Reference(m, {}, (0.0,) * 4, (0.0, 0.0), i_sat, i_cross), m.i_max


@pytest.mark.parametrize("seed", range(22))
def test_currents_are_the_gradient_of_the_energy_and_flux_is_their_inverse(seed):
    rng, params, reference, i_max = drawn(seed)
    for _ in range(10):
        theta = rng.uniform(-math.pi, math.pi)
        i = cmath.rect(rng.uniform(0.0, 2.0 * i_max), rng.uniform(-math.pi, math.pi))
        psi = complex(*pmsm.flux(params, i.real, i.imag, math.cos(theta), math.sin(theta)))
        found = complex(*pmsm.currents(params, psi.real, psi.imag, math.cos(theta), math.sin(theta)))
        assert abs(found - i) < 1e-9 * i_max
        d = 1e-4 * reference.m.psi_f
        rises = [reference.energy(psi + d * w, theta) - reference.energy(psi - d * w, theta) for w in (1.0, 1j)]
        assert abs(complex(*rises) / (2.0 * d) - i) < 1e-6 * i_max


@pytest.mark.parametrize("share", [-0.2, -0.05, 0.0, 0.05, 0.2])
def test_the_q_inductance_falls_with_d_current_by_what_i_cross_says(share):
    """Incremental L_q at i_q = 0: 1 / L_q by 1 + x + x^2 L_d i_cross / (2 psi_f), x = i_d / i_cross."""
    i_cross, d = 40.0, 1e-3
    params = crossed(R, L, L, PSI, N_P, i_cross)
    more, less = (pmsm.flux(params, share * i_cross, q, 1.0, 0.0)[1] for q in (d, -d))
    expected = L / (1.0 + share + share**2 * L * i_cross / (2.0 * PSI))
    assert (more - less) / (2.0 * d) == pytest.approx(expected, rel=1e-6)


def test_q_current_takes_from_the_magnets_flux():
    """To first order in 1 / i_cross L_q i_q^2 / (2 i_cross), whichever way it flows."""
    i_cross, i_q = 2000.0, 8.0
    params = crossed(R, L, L, PSI, N_P, i_cross)
    for way in (1.0, -1.0):
        psi_d, _ = pmsm.flux(params, 0.0, way * i_q, 1.0, 0.0)
        assert PSI - psi_d == pytest.approx(L * i_q**2 / (2.0 * i_cross), rel=0.02)


def test_the_least_i_cross_leaves_the_energy_bent_upwards_within_twice_i_max():
    """By second differences of the energy in all directions, at currents as they really are."""
    for file in MOTORS:
        m = load_params(file).motor
        least = least_i_cross(m.L_d, m.L_q, m.psi_f, m.i_max)
        reference = Reference(m, {}, (0.0,) * 4, (0.0, 0.0), 0.0, least)
        params = crossed(m.R_s, m.L_d, m.L_q, m.psi_f, m.n_p, least)
        step = 1e-3 * m.psi_f

        def bend(way, psi, reference=reference, step=step):
            d = step * cmath.exp(1j * way)
            return reference.energy(psi + d, 0.0) + reference.energy(psi - d, 0.0) - 2.0 * reference.energy(psi, 0.0)

        for k in range(24):
            i = cmath.rect((1.0 + k % 2) * m.i_max, math.tau * k / 24)
            psi = complex(*pmsm.flux(params, i.real, i.imag, 1.0, 0.0))
            worst = minimize_scalar(bend, bounds=(0.0, math.pi), args=(psi,), method="bounded").fun
            assert worst > 0.05 * step**2 / max(m.L_d, m.L_q), (file, k)


@pytest.mark.parametrize("omega_m", [0.0, 250.0])
def test_turning_it_agrees_with_solve_ivp(omega_m):
    _, _, current, angle, torque, _ = voltage_steps(1, 300e-6, omega_m or 20.0, 120, i_cross=25.0)
    assert current < 1e-4
    assert angle < 1e-6
    assert torque < 1e-5
    assert make(i_cross=25.0)[0].motor.uneven


def test_too_much_is_refused_with_the_least():
    least = least_i_cross(L, L, PSI, 8.0)
    with pytest.raises(ConfigError, match=rf"i_cross must be >= {least:.3g} A, or 0 for none: .* got 10 \(motor"):
        load_params(None, {"motor.i_cross": 10.0})
