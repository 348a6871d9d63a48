"""What follows from the motor where a configuration does not say it."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest

import sim
from sim.config.derive import RULES
from sim.config.params import BenchParams, ConfigError, load_params

OTHER = {
    "motor.R_s": 0.5, "motor.L_d": 1.0e-3, "motor.L_q": 1.4e-3, "motor.psi_f": 0.02, "motor.n_p": 4, "motor.i_max": 5.0,
}  # fmt: skip


def value(params: BenchParams, dotted: str) -> object:
    found: object = params
    for key in dotted.split("."):
        found = getattr(found, key)
    return found


def test_default_toml_shows_what_each_rule_gives_the_papers_motor() -> None:
    shown, section = {}, ""
    for line in (Path(sim.__file__).parent / "default.toml").read_text().splitlines():
        if head := re.match(r"\[([\w.]+)\]", line):
            section = head[1]
        elif key := re.match(r"# (\w+) = (\S+) ", line):
            shown[f"{section}.{key[1]}"] = float(key[2])
    params = load_params()
    assert shown == {dotted: value(params, dotted) for dotted in RULES}


def test_firmware_of_another_motor_knows_it() -> None:
    firmware = load_params(None, OTHER).firmware
    assert (firmware.n_p, firmware.R_s_hat, firmware.psi_f_hat) == (4, 0.5, 0.02)
    assert firmware.L_s_hat == 1.4e-3  # back-EMF of the active flux: the q inductance
    assert (firmware.i_max, firmware.protection.i_trip) == (5.0, 10.0)


def test_the_voltage_is_enough_for_half_the_current_at_the_largest_speed_and_not_for_much_more() -> None:
    omega = 4 * load_params(None, OTHER).firmware.omega_m_max

    def volts(omega: float) -> float:
        return math.hypot(0.02 * omega + 0.5 * 2.5, 1.4e-3 * 2.5 * omega)

    assert volts(omega) < 24.0 / math.sqrt(3.0) < volts(1.12 * omega)


def test_the_speed_loop_closes_at_the_same_speed_on_any_shaft() -> None:
    for J in (1e-5, 1e-3):
        loop = load_params(None, {**OTHER, "mechanics.J": J}).firmware.speed_loop
        assert loop.k_p_speed * 1.5 * 4 * 0.02 / J == pytest.approx(59.0, rel=0.01)
        assert loop.k_i_speed == pytest.approx(15 * loop.k_p_speed, rel=0.01)


def test_the_current_loop_keeps_its_step_within_the_voltage() -> None:
    slow = load_params(None, {**OTHER, "motor.L_q": 8e-3}).firmware.current_loop.bw_current
    assert 2 * math.pi * slow * 8e-3 * 5.0 == pytest.approx(24.0 / math.sqrt(3.0), rel=0.05)
    assert load_params(None, {"clock.pwm_hz": 10_000}).firmware.current_loop.bw_current == 500.0


def test_observers_work_from_the_same_voltage_on() -> None:
    weak, strong = (load_params(None, {"motor.psi_f": psi_f}).firmware for psi_f in (5e-3, 20e-3))
    for firmware, psi_f in ((weak, 5e-3), (strong, 20e-3)):
        assert firmware.vector_tracking.omega_on * psi_f == pytest.approx(0.131, rel=0.05)
        assert firmware.protection.hall_emf == 0.3


def test_voltage_limits_go_with_the_link() -> None:
    limits = load_params(None, {"inverter.u_dc": 48.0}).firmware.protection
    assert (limits.u_dc_min, limits.u_dc_max) == (24.0, 64.0)


def test_what_is_given_stays_and_what_follows_follows_from_it() -> None:
    params = load_params(None, {"firmware.i_max": 4.0, "firmware.omega_m_max": 100.0, "mechanics.J": 1e-3})
    assert (params.firmware.protection.i_trip, params.firmware.protection.omega_m_trip) == (8.0, 120.0)
    assert params.firmware.J_hat == 1e-3
    assert params.motor.i_max == 8.0
    assert params.mechanics.b == load_params().mechanics.b


def test_a_motor_that_cannot_turn_is_refused() -> None:
    with pytest.raises(ConfigError) as refused:
        load_params(None, {"motor.R_s": 4.0})
    assert str(refused.value) == (
        "motor.i_max = 8 A is too much for motor.R_s = 4 ohm: half of it takes 16 V, and of inverter.u_dc = 24 V a "
        "phase gets 13.9 V"
    )


@pytest.mark.parametrize(("key", "bad"), [("motor.i_max", 0.0), ("inverter.u_dc", math.nan), ("clock.pwm_hz", 1)])
def test_bad_input_is_named_before_what_follows_from_it(key: str, bad: float) -> None:
    with pytest.raises(ConfigError, match=rf"\({key} in overrides\)$"):
        load_params(None, {key: bad})
