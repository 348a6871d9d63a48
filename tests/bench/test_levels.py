"""Which level inputs have in each half of a revolution, against the shares of time that their wires are open."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from bench.findings.health import examine
from bench.hall.trace import trace
from bench.signal import hall_inputs
from bench.signal.levels import Levels, levels
from tests.bench.hall_cases.drives import MOTORS, around, drawn, healthy, top_rpm
from tests.bench.hall_cases.faults import cases
from tests.bench.hall_cases.recording import Contact, Recording
from tests.bench.hall_cases.shaft import check
from tests.choice import chosen


def drive(seed: int, encoder: bool) -> Recording:
    """Any motor, turned as `bench hall check` does it, with sensors as real ones are."""
    rng = np.random.default_rng((83, seed))
    motor = MOTORS[1 + seed % (len(MOTORS) - 1)]
    made = around(rng, motor, check(top_rpm(motor, ("slow", "fast")[seed // 9 % 2]), motor.n_p), encoder)
    return made.but(sensors=drawn(rng, motor.n_p, made.omega))


def of(recording: Recording) -> Levels:
    made = trace(recording.capture())
    found = levels(made.edges, hall_inputs.read(made.edges, made.tick_hz), made.tick_hz)
    assert found is not None
    return found


@pytest.mark.parametrize("encoder", [True, False])
@pytest.mark.parametrize("share", [0.05, 0.3])
def test_the_share_of_wrong_levels_is_that_of_the_time_that_a_wire_is_open(share, encoder):
    for seed in chosen(f"open wires {share} {encoder}", range(40), 3):
        rng = np.random.default_rng(seed)
        inputs = tuple(rng.permutation(3)[: 1 + seed % 2].tolist())
        level, seconds = int(rng.integers(2)), float(rng.uniform(1e-3, 8e-3))
        recording = drive(seed, encoder).with_effect(Contact(inputs, share, seconds, level))
        found = of(recording)
        stretches = share * recording.way.seconds / seconds / 2.0  # half of them where the level would be the other
        within = 4.0 * share * math.sqrt(2.0 / stretches) + 0.01
        for number in range(3):
            for side in (0, 1):
                expected = share if number in inputs and side == level else 0.0
                assert found.share[number, side] == pytest.approx(expected, abs=within if expected else 0.01), seed


def test_inputs_of_drives_that_are_well_have_hardly_a_wrong_level():
    for seed in chosen("levels of healthy drives", range(2000), 8):
        made = trace(healthy(seed).capture())
        found = levels(made.edges, hall_inputs.read(made.edges, made.tick_hz), made.tick_hz)
        assert found is None or found.share.max() < 0.05, seed


@pytest.mark.slow
def test_an_encoder_that_slips_opens_no_wire():
    for seed in chosen("levels with slips", range(20), 3):
        made = drive(seed, True)
        slipping = made.encoding(slips=((0.3 * made.way.seconds, 60.0), (0.7 * made.way.seconds, 90.0)))
        codes = {finding.code for finding in examine(trace(slipping.capture())).findings}
        assert codes & {"encoder_slipped", "encoder_slips", "encoder_drifts"}, (seed, codes)
        assert "contact" not in codes, seed


@pytest.mark.slow
def test_a_delay_is_known_as_well_as_is_said_even_with_a_coarse_encoder():
    """Edges that are not late at all, at places that repeat with the counts of the encoder, and at others."""
    off = []
    for seed in chosen("delays and counts", range(60), 12):
        made = drive(seed, True)
        lines = (500, 1024, 36 * made.motor.n_p)[seed % 3]
        prompt = made.sensing(rise_late=(0.0, 0.0, 0.0), fall_late=(0.0, 0.0, 0.0))
        assert made.encoder is not None
        measured = examine(trace(prompt.but(encoder=replace(made.encoder, lines=lines)).capture())).measured
        if not math.isnan(measured.delay):
            off.append(abs(measured.delay) / (measured.delay_half_width + measured.delay_by_count))
    assert len(off) > 6
    assert np.mean(np.array(off) <= 1.0) >= 0.8, off  # 95 % of them, of a dozen


@pytest.mark.slow
def test_an_input_that_bounces_without_an_encoder_is_no_bad_contact():
    """Edges that return three times look like revolutions in which nothing else moves."""
    for case in chosen("bounces, blind", [case for case in cases("bounce_some", seeds=30) if not case.encoder], 8):
        assert "contact" not in {finding.code for finding in examine(trace(case.recording.capture())).findings}, case
