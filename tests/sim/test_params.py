"""Parameters of the bench: defaults, files and overrides over them, and what is refused in which words."""

from pathlib import Path

import pytest
from pydantic import ValidationError

from protocol.signals import DRIVE_PARAMETERS, LOAD_PARAMETERS, AngleSource
from sim.config.params import ConfigError, load_params


def test_every_parameter_of_the_protocol_has_a_value() -> None:
    params = load_params()
    assert params.drive_parameters().keys() == {p.name for p in DRIVE_PARAMETERS}
    assert params.load_parameters().keys() == {p.name for p in LOAD_PARAMETERS}


def test_a_list_is_one_parameter_for_each_sector() -> None:
    key = "firmware.hall_edges.edge_down"
    values = load_params(None, {key: [0.1, 0.2, 0.3, -0.1, -0.2, -0.3]}).drive_parameters()
    assert [values[f"edge_down_{s}"] for s in range(1, 7)] == [0.1, 0.2, 0.3, -0.1, -0.2, -0.3]
    with pytest.raises(ConfigError, match=r"edge_down\[2\] must be between -0.506 and 0.506 rad, got 0.6 "):
        load_params(None, {key: [0, 0, 0.6, 0, 0, 0]})


def test_control_by_an_encoder_needs_one() -> None:
    assert load_params(None, {"encoder.present": 0}).firmware.observer == 2
    with pytest.raises(ConfigError, match=r"^firmware.observer must be 1 or 2 where encoder.present = 0, got 0 "):
        load_params(None, {"encoder.present": 0, "firmware.observer": 0})


def test_file_then_overrides_replace_single_keys(tmp_path: Path) -> None:
    file = tmp_path / "my.toml"
    file.write_text("[motor]\nR_s = 1\n[firmware.vector_tracking]\nk_p_vt = 10\nk_i_vt = 20\n")
    params = load_params(file, {"firmware.vector_tracking.k_p_vt": 11, "hall.jitter_deg": 0})
    assert params.motor.R_s == 1.0
    assert isinstance(params.motor.R_s, float)
    assert params.motor.psi_f == 6.55e-3
    assert params.firmware.vector_tracking.k_p_vt == 11.0
    assert params.firmware.vector_tracking.k_i_vt == 20.0
    assert params.hall.jitter_deg == 0.0


def test_params_are_frozen() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        load_params().motor.R_s = 1.0  # type: ignore[misc]


LAST = int(max(AngleSource))


def refusal(key: str, value: object) -> str:
    with pytest.raises(ConfigError) as caught:
        load_params(None, {key: value})  # type: ignore[dict-item]
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("key", "value", "others"),
    [("motor.i_cross", 1.0, {}), ("motor.skin_R", 50.0, {}), ("mechanics.J", 1e-12, {"mechanics.b": 0.1}),
     ("inverter.i_smooth", 1e-3, {}), ("coupling.stiffness", 1e5, {}),
     ("coupling.damping", 10.0, {"coupling.stiffness": 1.0})],
)  # fmt: skip
def test_the_limit_that_a_refusal_tells_is_allowed(key: str, value: float, others: dict[str, float]) -> None:
    for factor in (1.0, 1.1, 1.23, 1.37):  # limits that are rounded one way and the other
        given = others | {"motor.L_d": 170e-6 * factor, "motor.L_q": 180e-6 * factor, "mechanics.J": 2e-4 * factor}
        with pytest.raises(ConfigError, match=r"must be [<>]= ") as caught:
            load_params(None, given | {key: value})
        load_params(None, given | {key: float(str(caught.value).split()[4])})


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("motor.R_s", -1, "R_s must be > 0 ohm, got -1 (motor.R_s in overrides)"),
        ("motor.L_d", float("nan"), "L_d must be > 0 H, got nan (motor.L_d in overrides)"),
        ("motor.n_p", 6.5, "n_p must be a whole number between 1 and 64, got 6.5 (motor.n_p in overrides)"),
        ("motor.R_s", True, "R_s must be > 0 ohm, got True (motor.R_s in overrides)"),
        ("motor.R_s", "1", "R_s must be > 0 ohm, got '1' (motor.R_s in overrides)"),
        pytest.param("motor.R_s", 10**400, f"R_s must be > 0 ohm, got {10**400} (motor.R_s in overrides)", id="long"),
        ("firmware.observer", 99,
         f"observer must be a whole number between 0 and {LAST}, got 99 (firmware.observer in overrides)"),
        ("hall.delta_deg", [1, 2], "delta_deg must be a list of 6 numbers, got [1, 2] (hall.delta_deg in overrides)"),
        ("hall.delta_deg", [0, 0, 0, 99, 0, 0],
         "delta_deg[3] must be between -29 and 29 deg, got 99 (hall.delta_deg in overrides)"),
        ("motor.r_s", 1, "unknown key motor.r_s in overrides; did you mean motor.R_s?"),
        ("motr.R_s", 1, "unknown key motr in overrides; did you mean motor?"),
        ("firmware.vector_tracking.kp_vt", 1,
         "unknown key firmware.vector_tracking.kp_vt in overrides; did you mean firmware.vector_tracking.k_p_vt?"),
        ("mechanics.colour", 1,
         "unknown key mechanics.colour in overrides; "
         "allowed here: J, b, tau_coulomb, stribeck, omega_stribeck, theta_0_deg"),
        ("motor", 3, "motor is a section, got 3 (in overrides)"),
        ("clock.pwm_hz", 16001,
         "tick_hz must be a whole multiple of pwm_hz = 16001 Hz, got 20000000 (clock in overrides)"),
        ("firmware.protection.u_dc_min", 40.0,
         "u_dc_min must be < u_dc_max = 32 V, got 40 (firmware.protection in overrides)"),
        ("firmware.vector_tracking.omega_off", 40.0,
         "omega_off must be <= omega_on = 20 rad/s, got 40 (firmware.vector_tracking in overrides)"),
    ],
)  # fmt: skip
def test_a_refusal_names_value_range_key_and_section(key: str, value: object, message: str) -> None:
    assert refusal(key, value) == message


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"[motor\n", "bad.toml is not valid TOML"),
        (b"\xff\xfe", "bad.toml is not valid TOML"),
        pytest.param(b"x = " + b"1" * 5000, "bad.toml is not valid TOML", id="long"),
        (b"[clock]\npwm_hz = 16001\n[motr]\nR_s = 1\n", r"^unknown key motr in bad.toml; did you mean motor\?$"),
        (b"motor = 3", r"^motor is a section, got 3 \(in bad.toml\)$"),
    ],
)
def test_a_bad_file_is_named_before_what_is_wrong_besides(tmp_path: Path, content: bytes, message: str) -> None:
    file = tmp_path / "bad.toml"
    file.write_bytes(content)
    with pytest.raises(ConfigError, match=message):
        load_params(file, {"motor.R_s": -1})


@pytest.mark.parametrize("key", ["motor.L_d", "motor.L_q", "mechanics.J", "inverter.i_smooth"])
def test_too_fast_for_the_integration_step(key: str) -> None:
    overrides = {key: {"inverter.i_smooth": 1e-3}.get(key, 1e-9), "mechanics.b": 1e-3}
    with pytest.raises(
        ConfigError, match=rf"^{key} must be >= \S+ \S+.* for integration steps of .*substeps"
    ) as refused:
        load_params(None, overrides)
    assert "default.toml" not in str(refused.value)  # the override is to blame


def test_a_whole_number_may_be_written_with_a_point() -> None:
    n_p = load_params(None, {"motor.n_p": 6.0}).motor.n_p
    assert (n_p, type(n_p)) == (6, int)


def test_sectors_may_not_vanish() -> None:
    assert "sector 2 only 3 deg wide" in refusal("hall", {"delta_deg": [0, -28, 29, 0, 0, 0], "hysteresis_deg": 5})


def test_missing_file_and_directory(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no configuration file"):
        load_params(tmp_path / "absent.toml")
    with pytest.raises(ConfigError, match="cannot read"):
        load_params(tmp_path)


def test_replace_is_checked_too() -> None:
    params = load_params()
    with pytest.raises(ConfigError, match=r"^J must be > 0 kg m2, got 0$"):
        params.mechanics.replace(J=0.0)
