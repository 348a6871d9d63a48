"""`bench motor`: the motor of another tool's file or of a data sheet is the one that the simulated drive then has."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from against import said as bench
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.cli.motor import command
from bench.dumps.motor import Given, described
from bench.dumps.read import read
from bench.errors import BenchError
from protocol.messages import DriveState, SetpointMode
from sim.config.params import load_params
from sim.ports.device import SimulatedDevice

VESC = {
    "foc_motor_r": "0.0163", "foc_motor_l": "1.2e-05", "foc_motor_ld_lq_diff": "4e-06",
    "foc_motor_flux_linkage": "0.00538", "si_motor_poles": "14", "l_current_max": "60", "l_max_vin": "57",
}  # fmt: skip
ODRIVE_5 = {"axis0": {"motor": {"config": {
    "pole_pairs": 7, "phase_resistance": 0.039, "phase_inductance": 1.57e-5, "torque_constant": 8.27 / 270,
    "current_lim": 60.0, "I_bus_hard_max": math.inf, "motor_type": 0,
}}, "encoder": {"config": {"mode": 1, "hall_polarity": 0}}}}  # fmt: skip
ODRIVE_6 = {
    "axis0.config.motor.pole_pairs": 15, "axis0.config.motor.phase_resistance": 0.17,
    "axis0.config.motor.phase_inductance": 2.5e-4, "axis0.config.motor.torque_constant": 8.27 / 16,
    "axis0.config.motor.current_soft_max": 40.0, "axis0.config.motor.current_hard_max": 60.0,
}  # fmt: skip
MOTEUS = """motor.poles 14
motor.phase_invert 0
motor.resistance_ohm 0.0473
motor.inductance_d_H 0.0000216
motor.inductance_q_H 0.0000270
motor.Kv 304.0
servo.max_current_A 40
servo.max_voltage 46
"""


def xml(values: dict[str, str], root: str = "MCConfiguration") -> str:
    return f"<?xml version='1.0'?><{root}>{''.join(f'<{k}>{v}</{k}>' for k, v in values.items())}</{root}>"


@pytest.fixture
def written(tmp_path: Path):
    def write(text: str | bytes, name: str = "dump") -> Path:
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


def refused(path: Path) -> str:
    with pytest.raises(BenchError) as caught:
        described(read(path), Given())
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_vesc_says_all_of_its_motor(written) -> None:
    motor = described(read(written(xml(VESC))), Given())
    assert (motor.n_p, motor.R_s, motor.psi_f, motor.i_max) == (7, 0.0163, 0.00538, 60.0)
    assert (motor.L_d, motor.L_q) == pytest.approx((10e-6, 14e-6))
    # no-load speed by volt: a phase's peak at that speed is 1 / sqrt(3) of a volt
    assert motor.kv * math.tau / 60.0 * 7 * 0.00538 * math.sqrt(3.0) == pytest.approx(1.0)


def test_an_odrive_of_either_generation_says_its_motor(written) -> None:
    old = described(read(written(json.dumps(ODRIVE_5))), Given())
    new = described(read(written(json.dumps(ODRIVE_6))), Given())
    assert (old.n_p, old.R_s, old.L_q, old.i_max) == (7, 0.039, 1.57e-5, 60.0)
    assert (new.n_p, new.R_s, new.i_max) == (15, 0.17, 40.0)
    assert old.kv == pytest.approx(270, rel=1e-3)
    assert new.kv == pytest.approx(16, rel=1e-3)
    assert 1.5 * new.n_p * new.psi_f == pytest.approx(8.27 / 16, rel=1e-5)


def test_a_moteus_says_its_motor(written) -> None:
    motor = described(read(written(MOTEUS)), Given())
    assert (motor.n_p, motor.R_s, motor.L_d, motor.L_q, motor.i_max) == (7, 0.0473, 21.6e-6, 27e-6, 40.0)
    # half of the DC link is the largest amplitude of a phase: Kv r/min take 0.5 V of back-EMF
    assert motor.psi_f * 7 * 304 * math.tau / 60.0 == pytest.approx(0.5, rel=1e-4)
    older = MOTEUS.replace("motor.Kv 304.0", f"motor.v_per_hz {30 / 304}")
    assert described(read(written(older)), Given()).psi_f == pytest.approx(motor.psi_f, rel=1e-4)


@pytest.mark.parametrize(("given", "psi_f", "R_s"), [
    # anaheim's BLY172S: 0.8 ohm between terminals, 0.0343291 V/Hz of a phase, peak; maxon's EC 45 flat: 1.03 ohm
    (Given(kv=60 / math.sqrt(3) / 0.0343291 / 4, resistance=0.8, poles=8, current=7.5), 0.0343291 / math.tau, 0.4),
    (Given(kv=285, resistance=1.03, poles=16, current=4), 60 / math.tau / math.sqrt(3) / 8 / 285, 0.515),
    (Given(kv=100, kv_rms=True, resistance=0.1, of_phase=True, poles=14, current=20, inductance=1e-4),
     math.sqrt(2 / 3) * 60 / math.tau / 7 / 100, 0.1),
])  # fmt: skip
def test_a_data_sheet_says_the_same_motor(given: Given, psi_f: float, R_s: float) -> None:
    motor = described(None, given)
    assert motor.psi_f == pytest.approx(psi_f, rel=1e-5)
    assert motor.R_s == pytest.approx(R_s)
    assert any("by volt" in note for note in motor.notes)  # what the other reading gives


motors = st.builds(
    Given,
    kv=st.floats(5.0, 3000.0), kv_rms=st.booleans(), resistance=st.floats(2e-3, 30.0), of_phase=st.booleans(),
    inductance=st.none() | st.floats(4e-6, 1e-2), poles=st.integers(1, 32).map(lambda n: 2 * n),
    current=st.floats(0.2, 200.0), voltage=st.none() | st.floats(12.0, 60.0),
)  # fmt: skip


@given(motors)
@settings(max_examples=120, deadline=None)
def test_what_is_written_is_a_configuration_that_the_simulated_drive_takes(tmp_path_factory, given: Given) -> None:
    try:
        motor = described(None, given)
    except BenchError:
        return
    file = tmp_path_factory.getbasetemp() / "my-motor.toml"
    file.write_text(motor.toml())
    notes: list[str] = []
    params = load_params(file, None, notes.append)
    assert (params.motor.n_p, params.motor.i_max, params.motor.psi_f) == (motor.n_p, motor.i_max, motor.psi_f)
    assert params.inverter.u_dc == motor.u_dc
    assert not [note for note in notes if "paper's motor" in note]  # nothing is missing


def test_sixty_amperes_and_sixty_volts_turn(written, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = tmp_path / "my-motor.toml"
    bench(capsys, "motor", str(written(xml(VESC))), "--voltage", "60", "-o", str(out))
    drive = SimulatedDevice(load_params(out), 1).bench
    for state in (DriveState.ARMED, DriveState.RUNNING):
        drive.enter_state(state)
        drive.advance(1)
    drive.setpoint(SetpointMode.SPEED, 100.0)
    drive.advance(12_000)
    before = drive.truth.theta_e
    drive.advance(1600)
    assert not drive.faults
    assert (drive.truth.theta_e - before) / 7 / 0.1 == pytest.approx(100.0, rel=0.05)


@pytest.mark.parametrize(("changed", "words"), [
    ({"foc_motor_r": "16.3"}, ""),
    ({"foc_motor_r": "350"}, "350 ohm; is it in milliohm? Then give 0.35 ohm"),
    ({"foc_motor_r": "0"}, "it must be above 0"),
    ({"foc_motor_r": "-0.01"}, "it must be above 0"),
    ({"foc_motor_r": "nan"}, "foc_motor_r = nan is not a finite number"),
    ({"foc_motor_r": "1e999"}, "is not a finite number"),
    ({"foc_motor_r": ""}, "is not a finite number"),
    ({"si_motor_poles": "0"}, "magnet poles: 0"),
    ({"si_motor_poles": "7"}, "is it pole pairs?"),
    ({"si_motor_poles": "13.5"}, "is not whole"),
    ({"foc_motor_flux_linkage": "5.38"}, "is it in mWb? Then give 0.00538 V s"),
    ({"foc_motor_l": "12"}, "is it in microhenry? Then give 1.2e-05 H"),
    ({"foc_motor_ld_lq_diff": "3e-05"}, "must be above 0"),
    ({"foc_motor_l": "0.012"}, "check the units of inductance and resistance"),
    ({"l_current_max": "60000"}, "is it in mA? Then give 60 A"),
])  # fmt: skip
def test_values_that_no_motor_has_are_questioned(written, changed: dict[str, str], words: str) -> None:
    said = refused(written(xml(VESC | changed)))
    assert words in said
    if not words:
        assert "16.3 ohm" in said  # 60 A take more than there is


def test_a_number_that_somebody_gives_is_not_looked_for_in_the_file(written) -> None:
    unset = ODRIVE_6 | {"axis0.config.motor.current_soft_max": math.inf, "axis0.config.motor.phase_resistance": None}
    path = written(json.dumps(unset))
    assert "is not a finite number" in refused(path)
    motor = described(read(path), Given(current=30.0, resistance=0.3))
    assert (motor.i_max, motor.R_s) == (30.0, 0.15)
    assert "magnet poles: 0" in refused(written(json.dumps(ODRIVE_6 | {"axis0.config.motor.pole_pairs": 0})))


def test_a_tools_own_defaults_are_not_taken_in_silence(written) -> None:
    default = VESC | {"foc_motor_r": "0.015", "foc_motor_l": "7e-06", "foc_motor_flux_linkage": "0.00245"}
    default["foc_motor_ld_lq_diff"] = "0"
    assert any("was the motor detected?" in note for note in described(read(written(xml(default))), Given()).notes)
    in_amperes = ODRIVE_6 | {"axis0.config.motor.torque_constant": 1.0}
    assert "takes torques in A" in refused(written(json.dumps(in_amperes))).replace("has the ODrive take", "takes")
    unset = ODRIVE_6 | {"axis0.config.motor.torque_constant": 0.04}
    assert any("0.04" in note for note in described(read(written(json.dumps(unset))), Given()).notes)


@pytest.mark.parametrize(("text", "words"), [
    ("<!DOCTYPE a [<!ENTITY b 'c'>]><MCConfiguration><foc_motor_r>&b;</foc_motor_r></MCConfiguration>", "entities"),
    ("<!DOCTYPE a [<!ENTITY b SYSTEM 'file:///etc/passwd'>]><MCConfiguration>&b;</MCConfiguration>", "entities"),
    ("<!DOCTYPE a SYSTEM 'http://127.0.0.1/a.dtd'><MCConfiguration/>", "entities"),
    ("<MCConfiguration><foc_motor_r>1</MCConfiguration>", "not valid XML"),
    ("<?xml version='1.0' encoding='no-such'?><MCConfiguration/>", "not valid XML"),
    ("<APPConfiguration/>", "not <MCConfiguration>"),
    (xml({"foc_motor_r": "0.1"}).replace("</MCC", "<foc_motor_r>0.2</foc_motor_r></MCC"), "foc_motor_r twice"),
    ("<MCConfiguration/>", "--poles, --resistance, --kv, --current"),
    ('{"axis0": ', "not valid JSON"),
    ('{"a":' * 5000, "not valid JSON"),
    ('{"a": 1}', "no axis0 of an ODrive"),
    ("hello world\n", "no configuration of a motor"),
    ("", "no configuration of a motor"),
    (b"\xff\xff\x00", "neither XML nor text"),
    (b"\x00" * 10_000_001, "larger than 10 MB"),
])  # fmt: skip
def test_a_file_that_is_none_of_theirs_is_refused_in_a_line(
    written, text: str | bytes, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(text)
    assert words in refused(path)
    _, err = bench(capsys, "motor", str(path), "-o", str(path.parent / "out.toml"), code=2)
    assert err.startswith("error: ")
    assert not (path.parent / "out.toml").exists()


begun = st.builds(bytes.__add__, st.sampled_from([b"<", b"{", b"motor.poles "]), st.binary(max_size=80))


@given(st.binary(max_size=200) | st.text(max_size=200).map(str.encode) | begun)
@settings(max_examples=300, deadline=None)
def test_whatever_is_in_a_file_nothing_escapes(tmp_path_factory, data: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "any"
    path.write_bytes(data)
    with pytest.raises(BenchError):
        described(read(path), Given())


def test_options_go_before_the_file_and_its_axis_is_chosen(written) -> None:
    two = {**ODRIVE_5, "axis1": {"motor": {"config": ODRIVE_5["axis0"]["motor"]["config"] | {"pole_pairs": 4}}}}
    path = written(json.dumps(two))
    assert described(read(path, 1), Given()).n_p == 4
    first = described(read(path), Given(current=10.0))
    assert (first.n_p, first.i_max) == (7, 10.0)
    assert "--axis" in first.notes[0]
    with pytest.raises(BenchError, match="no axis3 of an ODrive: it has axis0, axis1"):
        read(path, 3)
    with pytest.raises(BenchError, match="not of an ODrive"):
        read(written(xml(VESC)), 0)


def test_halls_of_the_file_are_those_of_the_simulated_motor(
    written, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    table = (255, 142, 8, 174, 74, 108, 42, 255)  # vedderb/bldc, applications/finn/app_finn_az_conf.h
    halls = {f"foc_hall_table__{code}": str(entry) for code, entry in enumerate(table)}
    out = tmp_path / "my-motor.toml"
    bench(capsys, "motor", str(written(xml(VESC | halls))), "-o", str(out))
    params = load_params(out)
    assert params.hall.offset_deg % 60.0 == pytest.approx(45.3, abs=0.1)
    assert params.firmware.hall_offset == pytest.approx(math.radians(params.hall.offset_deg), abs=1e-4)
    _, err = bench(capsys, "motor", str(written(xml(VESC))), "-o", str(out), "--overwrite")
    assert "has no table of Hall sensors" in err


def test_a_name_cannot_put_keys_into_the_configuration(written) -> None:
    path = written(xml(VESC), "x\n[motor]\nR_s = 7\n.xml")
    assert described(read(path), Given()).toml().count("[motor]\n") == 1


def test_nothing_is_asked_without_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    _, err = bench(capsys, "motor", "--kv", "190", code=2)
    assert "--poles, --resistance, --current" in err
    out, _ = bench(capsys, "motor", "--kv", "190", "--resistance", "0.05", "--poles", "14", "--current", "60", "--json")
    assert json.loads(out)["n_p"] == 7
    _, err = bench(capsys, "motor", "--kv", "190", "-o", "motor.json", code=2)
    assert "must end in .toml" in err


def test_on_a_terminal_what_is_missing_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bench.cli.motor.at_terminal", lambda: True)
    ended = CliRunner().invoke(command, ["--kv", "190", "--current", "60"], input="14\n0.05\nn\n")
    assert ended.exit_code == 0, ended.output
    assert "0.05 ohm, of a phase" in ended.output
