"""Which angle is late: by formula, with a motor that is none of the simulator's, and on two simulated drives."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
from hall_motor import REAL, capture
from virtual_run import RecordingScreen

from bench.findings.health import examine
from bench.findings.late import Late, blame
from bench.hall.source import Options, opened
from bench.hall.trace import trace
from bench.score.board import score
from bench.signal.delays import delays
from bench.signal.verdict import Verdict
from tests.choice import sampled

FAST = REAL.but(turns=((300.0, 0.6), (650.0, 0.6), (0.0, 0.05), (-300.0, 0.6), (-650.0, 0.6)))
OTHER_MOTOR = """
[motor]
R_s = 0.36
L_d = 0.6e-3
L_q = 0.7e-3
psi_f = 0.0105
n_p = 4
i_max = 6.0
"""


@pytest.mark.parametrize(("encoder", "hall", "late", "words"), [
    (0.0, 0.0, Late.NONE, ""),
    (100e-6, 0.0, Late.ENCODER, "the encoder is 100 us late"),
    (-60e-6, 0.0, Late.ENCODER, "the encoder is 60 us early"),
    (0.0, 100e-6, Late.HALL, "the Hall edges are 100 us late"),
    (150e-6, 60e-6, Late.BOTH, "the encoder is 150 us late and the Hall edges are 60 us late"),
    (80e-6, 80e-6, Late.UNCLEAR, "encoder and Hall edges are both 80 us late, or currents and voltages"),
    (0.0, -70e-6, Late.UNCLEAR, "the time stamps of samples are late against those of edges"),
])  # fmt: skip
def test_each_delay_is_found_and_the_one_who_is_late_is_named(encoder, hall, late, words):
    found = delays(capture(FAST.but(late=encoder, delay=hall)))
    assert found.edges == pytest.approx(hall - encoder, abs=2e-6)
    assert found.back_emf == pytest.approx(-encoder, abs=2e-6)
    what, told = blame(found)
    assert what is late
    assert words in told


@pytest.mark.parametrize("encoder", [0.0, 100e-6])
def test_an_inductance_that_is_wrong_is_no_delay(encoder):
    """20 % of it turn the back-EMF by 0.3 deg an ampere, here in step with the direction."""

    def current(t):
        return 3.0 * (1.0 - 2.0 * (t > 1.25)) + 0.5 * (t % 0.6 > 0.3)

    made = capture(FAST.but(late=encoder, current=current))
    wrong = replace(made, parameters=made.parameters | {"L_s_hat": 1.2 * 0.176e-3})
    assert delays(wrong).back_emf == pytest.approx(-encoder, abs=3e-6)


def test_at_low_speed_the_back_emf_is_not_asked_and_two_causes_are_named():
    slow = delays(capture(REAL.but(late=100e-6)))
    assert math.isnan(slow.back_emf)
    assert slow.edges == pytest.approx(-100e-6, abs=25e-6)
    what, words = blame(slow)
    assert what is Late.UNCLEAR
    assert "or the time stamps of samples are late" in words
    assert "turn the motor faster" in words


def test_one_speed_tells_no_edges_and_a_drive_that_is_off_no_back_emf():
    one = delays(capture(FAST.but(turns=((650.0, 0.6), (-650.0, 0.6)), late=100e-6)))
    assert math.isnan(one.edges)
    assert one.back_emf == pytest.approx(-100e-6, abs=3e-6)
    assert "record Hall edges at several speeds" in blame(one)[1]
    off = delays(capture(FAST.but(running=False, late=100e-6)))
    assert math.isnan(off.back_emf)
    assert off.edges == pytest.approx(-100e-6, abs=2e-6)
    blind = delays(capture(FAST.but(without=("theta_enc",))))
    assert all(map(math.isnan, blind[:2]))
    assert blame(blind) == (Late.NONE, "")


def test_a_score_says_that_the_encoder_is_late():
    from_late, from_prompt = (score([capture(FAST.but(late=late))]) for late in (100e-6, 0.0))
    assert any("angles differ in time: the encoder is 100 us late" in note for note in from_late.notes)
    assert not any("angles differ" in note for note in from_prompt.notes)


LATE = (
    ("encoder", 1000.0, "the encoder is 100 us late"),
    ("encoder", 240.0, "the Hall edges lead the encoder by 100 us"),
    ("hall", 1000.0, None),
)


@pytest.mark.parametrize(
    ("motor", "late", "rpm", "cause"),
    sampled("late", [(motor, *late) for motor in ("", OTHER_MOTOR) for late in LATE], 3, campaign="motors"),
)
def test_a_check_tells_a_late_encoder_from_late_hall_sensors(tmp_path: Path, motor, late, rpm, cause):
    config = tmp_path / "drive.toml"
    config.write_text(f"{motor}\n[{late}]\nlatency = 1e-4\n")
    with opened(Options("sim", config=config, speed_rpm=rpm), RecordingScreen(), None) as source:
        health = examine(trace(source.turned.capture))
    if cause is None:
        assert health.verdict is Verdict.PASS
        assert blame(health.delays)[0] is Late.HALL
        assert health.delays.edges == pytest.approx(100e-6, abs=3e-6)
    else:
        (finding,) = health.findings
        assert finding.code == "encoder_late"
        found = float(finding.cause.replace(" us", "").split()[3 if rpm > 500.0 else -1])
        assert (found, finding.cause.replace(f"{found:.0f}", "100")) == (pytest.approx(100.0, abs=4.0), cause)
