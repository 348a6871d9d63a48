"""Captures of real motors: twins of their Hall sensors, against numbers that another method has found."""

from __future__ import annotations

import numpy as np
import pytest
from moteus_captures import NAMES, needs_captures, read
from test_real_captures import KNOWN, UNEVEN

from bench.record.recording import run_of
from bench.twin.fit import fit
from sim.config.params import load_params

pytestmark = needs_captures


@pytest.mark.parametrize("name", NAMES)
def test_a_capture_of_real_halls_has_a_twin(name: str, tmp_path) -> None:
    known = KNOWN[name]
    twin = fit([run_of(read(name))])
    (tmp_path / "twin.toml").write_text(twin.toml())
    params = load_params(tmp_path / "twin.toml")
    assert params.motor.n_p == known.motor.n_p
    assert params.encoder.present == 0
    delta = np.array(params.hall.delta_deg)
    widths = 60.0 - np.roll(delta, -1) + delta
    limit = 1.0 if name == UNEVEN else known.motor.widths_limit
    ways = [way for way, n in ((1, known.forward), (-1, known.reverse)) if n > 100]  # hysteresis: the middle of both
    expected = np.mean([known.motor.widths_deg[way] for way in ways], axis=0)
    np.testing.assert_allclose(widths, expected, atol=limit)
    late = 1e6 * (np.array(params.faults.hall.rise_delay) - params.faults.hall.fall_delay)
    if known.rise_late_us is None or known.rise_late_us[0] < 5.0:
        assert np.abs(late).max() < 5.0
    else:
        np.testing.assert_allclose(late, known.rise_late_us[0], atol=known.rise_late_us[1])
    left, resolved = (twin.residuals[key][0] for key in twin.residuals)
    assert left < 1.2 * resolved + 0.25, "deg: the capture's resolution, and how evenly a motor turns"
    assert any("angle of the Hall ring" in words for words in twin.untold)
