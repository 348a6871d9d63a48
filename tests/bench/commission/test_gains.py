"""Gains by what was found, and the model of a step: against the simulated drive's own rules, and a solver's answer."""

from __future__ import annotations

import math

import numpy as np
import pytest
from drawn_benches import NAMES
from scipy.integrate import solve_ivp

from bench.commission import gains
from bench.commission.quantity import Quantity
from bench.commission.steps import check
from bench.device.simulator import motors
from sim.config.params import load_params


def of_motor(name: str) -> tuple[dict[str, Quantity], gains.Limits, object]:
    p = load_params(motors().get(name))
    values = {"R_s": p.motor.R_s, "L_q": p.motor.L_q, "psi_f": p.motor.psi_f, "J": p.mechanics.J}
    limits = gains.Limits(p.motor.i_max, math.inf, p.inverter.u_dc, p.clock.pwm_hz)
    return {key: Quantity(key, "", value) for key, value in values.items()}, limits, p


@pytest.mark.parametrize("name", NAMES)
def test_a_motor_that_is_known_gets_the_gains_that_the_simulated_drive_has_for_it(name: str) -> None:
    """These are rounded to two or more digits, which is all that they may differ by."""
    found, limits, p = of_motor(name)
    told = gains.settings(found, p.motor.n_p, limits)  # type: ignore[attr-defined]
    firmware = p.firmware  # type: ignore[attr-defined]
    sections = (firmware, firmware.current_loop, firmware.speed_loop, firmware.vector_tracking, firmware.hall_speed,
                firmware.hall_vector, firmware.protection)  # fmt: skip
    compared = 0
    for key, value in told.items():
        for section in sections:
            if hasattr(section, key) and key not in ("dead_time_comp",):
                assert value == pytest.approx(getattr(section, key), rel=0.08 if key == "k_i_vt" else 0.055), key
                compared += 1
    assert compared >= 15


def test_what_is_missing_is_left_out() -> None:
    found, limits, _ = of_motor("paper")
    assert gains.settings({}, None, limits) == {}
    still = gains.settings({key: found[key] for key in ("R_s", "L_q")}, None, limits)
    assert {"bw_current", "i_trip"} <= still.keys()
    assert not {"omega_m_max", "k_p_vt", "k_p_speed"} & still.keys()
    assert "k_p_speed" not in gains.settings({k: v for k, v in found.items() if k != "J"}, 6, limits)


@pytest.mark.parametrize("agreed", [50.0, 1e3])
def test_no_more_speed_than_was_agreed_to(agreed: float) -> None:
    found, limits, _ = of_motor("paper")
    told = gains.settings(found, 6, gains.Limits(limits.i_max, agreed, limits.u_dc, limits.pwm_hz))
    assert told["omega_m_max"] == pytest.approx(min(agreed, 330.0), rel=0.01)


@pytest.mark.parametrize(("R", "i"), [(0.158, 8.0), (10.9, 1.0), (0.5, 3.0)])
def test_at_the_top_speed_half_the_current_takes_all_of_the_voltage(R: float, i: float) -> None:
    limits, L, psi = gains.Limits(i, math.inf, 24.0, 16e3), 0.4e-3, 8e-3
    w = gains.top_speed(R, L, psi, limits)
    u = complex(-w * L * 0.5 * i, R * 0.5 * i + w * psi)
    assert abs(u) == pytest.approx(24.0 / math.sqrt(3.0), rel=1e-9)
    assert gains.top_speed(30.0, L, psi, limits) == 0.0


@pytest.mark.parametrize(
    ("R", "L", "bandwidth"), [(0.158, 0.176e-3, 800.0), (10.9, 4.7e-3, 465.0), (0.03, 2e-5, 250.0)]
)
def test_the_model_of_a_step_is_the_winding_of_a_solver_under_a_sampled_loop(
    R: float, L: float, bandwidth: float
) -> None:
    T, half = 1 / 16e3, round(12.0 / (math.tau * bandwidth) * 16e3)
    told = check.model(R, L, bandwidth, T, half)
    i, u, integral, seen = 0.0, 0.0, 0.0, []
    for k in range(4 * half):
        seen.append(i)
        error = (1.0 if k % (2 * half) < half else -1.0) - i
        integral += math.tau * bandwidth * R * T * error
        solved = solve_ivp(lambda t, x, v=u: [(v - R * x[0]) / L], (0.0, T), [i], rtol=1e-10, atol=1e-12)
        i, u = float(solved.y[0, -1]), math.tau * bandwidth * L * error + integral
    assert told == pytest.approx(np.array(seen[2 * half : 3 * half]), abs=1e-6)
    assert told[-1] == pytest.approx(1.0, abs=0.02)
    assert told[0] == pytest.approx(-1.0, abs=0.02)
