"""Winding and magnet that get warm, sensors that drift: against solve_ivp and closed forms, and in the loop."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sim.plant import pmsm
from sim.plant.warming import Params, Warming
from tests.sim.drive.rig import Rig, loop_records

THERMAL = Params(25.0, 2.5, 5.0, 12.0, 300.0, -0.0011, (0.03, -0.02, 0.01), (0.01, 0.0, -0.01), 20.0)
MOTOR = pmsm.make_params(0.158, 176e-6, 176e-6, 6.55e-3, 6)


def test_agrees_with_solve_ivp_while_the_loss_changes():
    warming, seconds = Warming(THERMAL, 0.064), 0.064

    def rates(t, x, power):
        flow = (x[0] - x[1]) / 2.5
        return [(power - flow) * 2.5 / 12.0, (flow - x[1] / 5.0) * 5.0 / 300.0]

    x = np.zeros(2)
    for k in range(600):
        square = 40.0 if k % 200 < 120 else 5.0
        warming.heat(MOTOR.R_s, square)
        x = solve_ivp(rates, (0.0, seconds), x, args=(1.5 * 0.158 * square,), rtol=1e-9, atol=1e-12).y[:, -1]
        assert warming.state[:2] == pytest.approx(x, abs=1e-6)
    warm = warming.factors
    assert warm.R_s == pytest.approx((235.0 + 25.0 + x[0]) / (235.0 + 20.0), abs=1e-9)  # IEC 60034-1
    assert warm.psi_f == pytest.approx(1.0 - 0.0011 * (5.0 + x[1]), abs=1e-9)


def test_sensors_drift_to_their_ends():
    warming = Warming(THERMAL._replace(R_th_winding=0.0), 1.0)
    for _ in range(20):
        warming.heat(MOTOR.R_s, 0.0)
    moved = warming.drifted((0.1, 0.0, 0.0), (0.0, 0.0, 0.0))
    share = 1.0 - math.exp(-1.0)
    assert moved["offset"] == pytest.approx((0.1 + 0.03 * share, -0.02 * share, 0.01 * share))
    assert moved["gain_error"] == pytest.approx((0.01 * share, 0.0, -0.01 * share))
    assert warming.factors == (1.0, 1.0)


FAST = {
    "thermal.R_th_winding": 6.0, "thermal.tau_winding": 0.5, "thermal.R_th_housing": 1.0, "thermal.tau_housing": 0.5,
    "thermal.drift_offset": [0.2, 0.0, -0.1], "thermal.tau_drift": 0.2,
}  # fmt: skip


def test_in_the_loop_resistance_and_flux_change_with_what_flows():
    rig = Rig(0, **FAST)
    rig.start()
    rig.forced(600.0, 6.0, 4.0)
    run = rig.forced(600.0, 6.0, 0.5)
    winding, housing, _ = rig._warming.state
    power = 1.5 * 0.158 * (235.0 + 20.0 + winding) / 255.0 * 36.0
    assert housing == pytest.approx(power * 1.0, rel=0.03)
    assert winding == pytest.approx(power * 7.0, rel=0.03)
    back_emf = np.hypot(run["e_alpha"], run["e_beta"]).mean() / run["omega_true"].mean()
    motor = rig.params.motor
    # the drive's own R_s_hat is the cold winding's: what it takes too little off stands in its back-EMF
    in_phase = motor.R_s * (winding / 255.0) * 6.0 / run["omega_true"].mean()
    assert back_emf == pytest.approx(motor.psi_f * (1.0 - 0.0011 * housing) + in_phase, rel=0.02)
    rig.enable(on=False)
    at_rest = rig.run(0.2)
    assert at_rest["i_a"].mean() == pytest.approx(0.2, abs=0.01)
    assert at_rest["i_c"].mean() == pytest.approx(-0.1, abs=0.01)


def test_the_same_bits_whatever_the_portions():
    def record(portions):
        rig = Rig(3, **FAST)
        rig.start()
        return loop_records([rig.advance(n) for n in portions])

    assert record([5000]) == record([1, 1000, 23, 3000, 976])
