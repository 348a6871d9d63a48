"""Encoders that slip and index pulses that come, by formula: near a reversal, in the first turn of the shaft."""

from __future__ import annotations

import math

import numpy as np
import pytest

from bench.findings.health import Health, examine
from bench.hall.trace import trace
from tests.bench.hall_cases.drives import telling_ring
from tests.bench.hall_cases.recording import Motor, Recording
from tests.bench.hall_cases.shaft import Way, check, ways
from tests.choice import chosen

AFTER = tuple(np.round(np.arange(0.6, 8.0, 0.35), 2).tolist())  # electrical revolutions after the reversal
SIZES = (-60.0, -20.0, -8.0, 8.0, 20.0, 60.0)  # deg
TOLD = {
    "by the back-EMF": Recording(motor=Motor(4)),
    "by the ring": telling_ring(Recording(motor=Motor(4), voltages=False).sensing(ring=37.0)),
    "by nothing": Recording(motor=Motor(4), voltages=False).sensing(ring=37.0),
}


def judged(recording: Recording) -> Health:
    return examine(trace(recording.capture()))


@pytest.mark.parametrize("revolutions", chosen("slips near a reversal", AFTER, 2))
def test_a_slip_is_told_once_with_moment_and_size_however_near_to_a_reversal(revolutions: float) -> None:
    """Forward, reverse and forward again: a slip is none of the sensors' hysteresis."""
    for size in chosen("sizes of slips", SIZES, 2):
        made = Recording(voltages=False)
        turned = (made.shaft - made.shaft[0]) * made.motor.n_p / math.tau
        back = (turned < turned.max() - revolutions) & (np.arange(len(turned)) > np.argmax(turned))
        at = float(made.t[np.argmax(back)])
        [slip] = judged(made.encoding(slips=((at, size),))).findings
        told, _, when = slip.cause.partition(" deg (electrical) at ")
        assert slip.code == "encoder_slipped"
        assert float(told.removeprefix("the encoder slipped by ")) == pytest.approx(size, abs=0.3)
        assert float(when.removesuffix(" s")) == pytest.approx(at, abs=0.1)


@pytest.mark.parametrize("told", TOLD)
def test_a_jump_in_the_first_turn_is_an_index_pulse_where_it_put_the_angle_right_and_a_slip_where_it_was_right(
    told: str,
) -> None:
    for start in chosen("where the shaft stands", (0.1, 0.3, 0.45, 0.7), 2):
        index = judged(TOLD[told].but(start=start).encoding(indexed=False))
        assert not index.findings
        assert [note.code for note in index.notes if note.code == "index"] == ["index"] * (told != "by nothing")
        assert any("or the encoder slipped" in words for words in index.missing) == (told == "by nothing")
    slip = judged(TOLD[told].encoding(slips=((0.9, 40.0),)))
    codes = [finding.code for finding in slip.findings]
    assert codes == ([] if told == "by nothing" else ["encoder_slipped"])
    assert any("or the encoder slipped" in words for words in slip.missing) == (told == "by nothing")


def test_edges_that_a_harmless_delay_moves_at_one_speed_are_unknown_and_measured_at_three() -> None:
    late = (90e-6, 90e-6, 90e-6)  # both ways and at 628 rad/s that is 6.5 deg, and sensors have no such hysteresis
    leg = ((0.02, 1.0), (1.5, 1.0), (0.02, 0.0), (0.1, 0.0))
    one = Way(ways(*((s, sign * share * 1500.0) for sign in (1.0, -1.0) for s, share in leg)))
    for way, unknown in ((one, True), (check(1500.0, 4), False)):
        made = Recording(motor=Motor(4), way=way, voltages=False)
        health = judged(made.sensing(rise_late=late, fall_late=late))
        assert not health.findings
        assert any("or the encoder slipped" in words for words in health.missing) == unknown
        assert np.isnan(health.delays.edges) == unknown
    assert health.delays.edges == pytest.approx(90e-6, abs=5e-6)
