"""What does not go together in a configuration is said, with both values, and is allowed."""

from __future__ import annotations

import pytest

from sim.config.params import load_params


def notes(**changed: float | list[float]) -> list[str]:
    said: list[str] = []
    load_params(None, {key.replace("__", "."): value for key, value in changed.items()}, said.append)
    return said


def test_the_papers_drive_has_none() -> None:
    assert notes() == []
    assert notes(firmware__R_s_hat=0.19, firmware__psi_f_hat=5.5e-3) == []  # within 25 %


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"firmware__n_p": 5}, "firmware.n_p = 5, but motor.n_p = 6"),
        ({"firmware__R_s_hat": 0.25}, "firmware.R_s_hat = 0.25 ohm, but motor.R_s = 0.158 ohm"),
        ({"firmware__L_s_hat": 1e-4}, "firmware.L_s_hat = 0.0001 H, but motor.L_q = 0.000176 H"),
        ({"firmware__psi_f_hat": 4e-3}, "firmware.psi_f_hat = 0.004 V s, but motor.psi_f = 0.00655 V s"),
        ({"firmware__J_hat": 4e-4}, "firmware.J_hat = 0.0004 kg m2, but mechanics.J = 0.0002 kg m2"),
        ({"firmware__encoder_lines": 900}, "firmware.encoder_lines = 900, but encoder.pulses_per_rev = 3600"),
        ({"load__tau_max": 0.1}, "load.tau_max = 0.1 N m, but the show of bench live brakes with 0.236 N m"),
        ({"firmware__protection__i_trip": 25.0},
         "firmware.protection.i_trip = 25 A is beyond current_sensor.range = 20 A"),
        ({"firmware__omega_m_max": 400.0},
         "firmware.omega_m_max = 400 rad/s, but inverter.u_dc = 24 V turns the motor at 353 rad/s at most"),
        ({"faults__begin": 2.0, "wiring__hall_open": 1},
         "faults.begin = 2 s, but wiring.hall_open is in force from the start"),
        ({"faults__hall__drift_deg": [0.1, 0.0, 0.0]},
         "faults.hall.drift_deg moves nothing: with thermal.R_th_winding = 0 K/W nothing gets warm"),
        ({"clock__pwm_hz": 5000},
         "clock.pwm_hz = 5000 Hz makes only 15.9 periods of an electrical revolution at "
         "firmware.omega_m_max = 330 rad/s"),
    ],
)  # fmt: skip
def test_each_is_one_line_with_both_values(changed: dict[str, float | list[float]], said: str) -> None:
    assert notes(**changed) == [said]


def test_half_a_motor_is_told_whose_the_other_half_is() -> None:
    assert notes(motor__n_p=4, motor__psi_f=9e-3, motor__i_max=5.0) == [
        "[motor] sets psi_f, n_p, i_max but not R_s, L_d, L_q: those of the paper's motor are used"
    ]
