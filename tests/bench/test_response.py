"""`bench response` on the simulated drive: against formulas of its loops, and what it says where it cannot measure."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

import bench
from bench.cli import cli
from bench.errors import BenchError
from bench.response.experiment import Asked, Measured, measure
from bench.response.loops import CURRENT, SPEED, Loop, waveform
from bench.signal.capture import F64
from bench.signal.waveforms import excitation
from bench.signal.waveforms.frequency_response import Complexes
from protocol.signals import Status

PWM = 16_000.0
R, L, PSI, N_P, J, B = 0.158, 0.176e-3, 6.55e-3, 6, 2.0e-4, 1.0e-4
ENCODER_HZ = 100.0
CONFIG: dict[str, Any] = {
    "motor": {"R_s": R, "L_d": L, "L_q": L, "psi_f": PSI, "n_p": N_P},
    "mechanics": {"J": J, "b": B, "tau_coulomb": 0.005},
    "encoder": {"bw_speed": ENCODER_HZ},
    "inverter": {"dead_time": 0.0},  # near zero current it acts like a resistance, which the formulas do not have
}


def z_of(f: F64) -> Complexes:
    return np.asarray(np.exp(2j * np.pi * f / PWM))


def current_open(f: F64, bandwidth: float) -> Complexes:
    """PI by internal model, a period of computation, a zero-order hold on R and L."""
    z, decay, alpha = z_of(f), math.exp(-R / (L * PWM)), 2.0 * math.pi * bandwidth
    opened: Complexes = (alpha * L + alpha * R / PWM * z / (z - 1.0)) * (1.0 - decay) / R / (z - decay) / z
    return opened


def speed_open(f: F64, k_p: float, k_i: float, bandwidth: float = 800.0) -> Complexes:
    """PI, the closed current loop, inertia and friction, the alpha-beta filter on the encoder's counts."""
    z, s, pole = z_of(f), 2j * np.pi * f, math.exp(-2.0 * math.pi * ENCODER_HZ / PWM)
    inner = current_open(f, bandwidth)
    angle = 1.5 * N_P * PSI / (J * s + B) / s
    seen = PWM * (1.0 - pole) ** 2 * z * (z - 1.0) / (z - pole) ** 2
    opened: Complexes = (k_p + k_i / PWM * z / (z - 1.0)) * inner / (1.0 + inner) * angle * seen
    return opened


def margin_of(opened: Any) -> tuple[float, float]:
    """Crossover in Hz and phase margin in degrees, by bisection on the formula, from 1 Hz on."""
    lo, hi = 1.0, 5000.0
    for _ in range(60):
        mid = math.sqrt(lo * hi)
        lo, hi = (mid, hi) if abs(opened(np.array([mid]))[0]) > 1.0 else (lo, mid)
    phase = math.degrees(float(np.angle(opened(np.array([lo]))[0])))
    return lo, 180.0 + (phase if phase < 0.0 else phase - 360.0)


def measured(loop: Loop, parameters: dict[str, float], asked: dict[str, Any], config: dict[str, Any]) -> Measured:
    question = Asked(loop, observer="encoder", **asked)
    names = [loop.reference, loop.output or "omega_enc", "i_q_ref", "u_alpha", "u_beta", "u_dc"]
    with bench.connect("sim", channels=names, config=config) as rig:
        for name, value in parameters.items():
            rig.drive.set(name, value)
        return measure(rig, question)


@pytest.mark.parametrize("bandwidth", [300.0, 500.0, 800.0, 1100.0, 1500.0])
def test_the_phase_margin_of_the_current_loop_is_that_of_its_formula(bandwidth: float) -> None:
    asked = {"lowest": 40.0, "highest": 3000.0, "amplitude": 1.0, "bias": 3.0}
    found = measured(CURRENT, {"bw_current": bandwidth}, asked, CONFIG)
    crossover, margin = margin_of(lambda f: current_open(f, bandwidth))
    got = found.margins
    assert got.phase_margin.value == pytest.approx(margin, abs=1.0)
    assert got.crossover.value == pytest.approx(crossover, rel=0.03)
    assert not found.remarks


@pytest.mark.parametrize(
    ("k_p", "k_i", "rpm"), [(0.2, 3.0, 500), (0.1, 1.0, 800), (0.4, 3.0, 600), (0.2, 8.0, 300), (0.3, 0.5, 1000)]
)
def test_the_phase_margin_of_the_speed_loop_is_that_of_its_formula(k_p: float, k_i: float, rpm: float) -> None:
    asked = {"lowest": 2.0, "highest": 100.0, "amplitude": 2.0, "speed_rpm": rpm, "periods": 6}
    found = measured(SPEED, {"k_p_speed": k_p, "k_i_speed": k_i}, asked, CONFIG)
    crossover, margin = margin_of(lambda f: speed_open(f, k_p, k_i))
    got = found.margins
    assert got.phase_margin.value == pytest.approx(margin, abs=1.0)
    assert got.crossover.value == pytest.approx(crossover, rel=0.03)
    assert not found.remarks


def test_coherence_falls_where_the_answer_is_not_the_test_signals() -> None:
    """At a hundredth of an ampere on a sensor with noise the high frequencies drown; with an ampere they do not."""
    noisy = CONFIG | {"current_sensor": {"noise_rms": 0.02}}
    asked = {"lowest": 100.0, "highest": 4000.0, "bias": 2.0}
    strong = measured(CURRENT, {}, asked | {"amplitude": 1.0}, noisy).response
    weak = measured(CURRENT, {}, asked | {"amplitude": 0.02}, noisy).response
    assert strong.coherence.min() > 0.98
    assert np.median(weak.coherence[weak.f > 2000.0]) < 0.9
    assert np.median(weak.coherence) < np.median(strong.coherence)


def test_a_ripple_that_goes_with_the_shaft_is_no_answer() -> None:
    """Vector tracking on misplaced Hall sensors: its speed swings 1 to 3 times an electrical turn."""
    names = ["omega_ref", "omega_vt", "i_q_ref"]
    with bench.connect("sim", channels=names, config=CONFIG) as rig:
        question = Asked(SPEED, 2.0, 110.0, 3.0, speed_rpm=500.0, observer="vector-tracking")
        found = measure(rig, question)
    assert found.margins.phase_margin.value is not None
    assert 40.0 < found.margins.phase_margin.value < 90.0
    assert np.any(found.response.coherence < 0.9)


def test_a_loop_at_a_limit_is_told() -> None:
    asked = {"lowest": 2.0, "highest": 100.0, "amplitude": 40.0, "speed_rpm": 500.0, "periods": 4}
    found = measured(SPEED, {"k_p_speed": 1.0}, asked, CONFIG)
    assert any("current was at its limit" in words for words in found.remarks)


@pytest.mark.parametrize(
    ("lowest", "highest", "words"),
    [(0.5, 4000.0, "needs 32000 samples; the drive has room for 4096"), (10.0, 5000.0, "above a quarter"),
     (20.0, 10.0, "the first must be above 0 and below the last")],
)  # fmt: skip
def test_frequencies_that_do_not_fit_are_refused(lowest: float, highest: float, words: str) -> None:
    with pytest.raises(BenchError, match=words):
        waveform(16_000.0, 4096, lowest, highest)


def test_the_command_prints_draws_and_writes(tmp_path: Path) -> None:
    out, data = tmp_path / "loop.png", tmp_path / "loop.json"
    runner = CliRunner()
    ended = runner.invoke(cli, ["response", "sim", "current", "--to", "1500", "-o", str(out), "--json", str(data)])
    assert ended.exit_code == 0, ended.output
    assert "phase margin" in ended.stdout
    told = json.loads(data.read_text())
    assert told["asked"]["loop"] == "current"
    assert {"hz", "gain", "phase_deg", "coherence", "open_gain"} <= set(told["lines"][0])
    with Image.open(out) as image:
        assert image.size[0] > 500
    low = runner.invoke(cli, ["response", "sim", "current", "--to", "1500", "--phase-margin", "89"])
    assert low.exit_code == 1
    assert "at least 89 deg are asked for" in low.stderr


def test_the_acceptance_test_of_the_docs_passes_and_fails_by_its_limits(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "response.md").read_text(encoding="utf-8")
    (code, _) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    for limit, verdict in (("lo=45", 0), ("lo=80", 1)):
        test = tmp_path / f"test_margin_{verdict}.py"
        test.write_text(code.replace("lo=45", limit), encoding="utf-8")
        ended = CliRunner().invoke(cli, ["accept", "sim", "--tests", str(test)])
        assert ended.exit_code == verdict, ended.output


WAVES = {
    "sine": excitation.sine(160, 3),
    "square": excitation.square(80),
    "chirp": excitation.chirp(800, 2, 60),
    "noise": excitation.noise(512, 3, 80, hold=2),
    "table": excitation.table([1.0, 0.5, -0.25, -1.0, 0.0, 0.75], hold=20),
}


@pytest.mark.parametrize("name", WAVES)
def test_any_waveform_is_in_the_reference_as_it_was_made(name: str) -> None:
    """The reference is the setpoint plus amplitude times the samples, from the period that status marks on."""
    wave = WAVES[name]
    with bench.connect("sim", channels=["i_d_ref", "status"], config=CONFIG) as rig:
        rig.drive.start("encoder")
        rig.drive.current(0.0, 2.0)
        with rig.drive.excited("i_d", wave, 0.5):
            capture = rig.record(0.3)
        quiet = rig.record(0.05)
        assert rig.drive.parameters["test"] == 0.0
    begins = np.flatnonzero(capture["status"].astype(int) & Status.INJECTION_SYNC)
    assert np.all(np.diff(begins) == wave.periods)
    expected = 2.0 + 0.5 * np.repeat(wave.values, wave.hold)
    for begin in begins[:-1]:
        seen = capture["i_d_ref"][begin : begin + wave.periods]
        assert np.abs(seen - expected).max() < 1.0 / 1024 + 0.5 / 32767
    assert np.all(quiet["i_d_ref"][-100:] == 2.0)


def test_a_drive_is_as_it_was_and_off_afterwards() -> None:
    with bench.connect("sim", channels=["i_d_ref", "i_d"], config=CONFIG) as rig:
        before = rig.drive.node.parameters()
        question = Asked(CURRENT, 100.0, 2000.0, 1.0, 2.0, periods=4, observer="encoder")
        first = measure(rig, question)
        assert not rig.drive.on
        again = measure(rig, question)  # the drive has put its test signal off by itself meanwhile
        after = rig.drive.node.parameters()
    assert {name for name, value in after.items() if before[name] != value} <= {"observer"}
    assert again.margins.phase_margin.value == pytest.approx(first.margins.phase_margin.value, abs=1.0)
