"""Captures of real motors: twins of their Hall sensors, against numbers that another method has found."""

from __future__ import annotations

import numpy as np
import pytest
from moteus_captures import NAMES, displacements_deg, needs_captures, read, shares_deg
from test_real_captures import KNOWN, UNEVEN

import bench
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
    delta = np.array([twin[f"hall.delta_deg[{k}]"].value for k in range(1, 7)])
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


def apart(widths: np.ndarray) -> float:
    """By how much sectors with one high input are wider than those with two, deg: late rising edges make it less."""
    return float(widths[::2].mean() - widths[1::2].mean())


@pytest.mark.parametrize("name", ["20250616-hboard-cycle", "20260618-spindle-sweep"])
def test_a_twin_turned_as_fast_as_the_motor_shows_the_same_sectors(name: str, tmp_path) -> None:
    """By shares of electrical turns, which do not know what was fitted: at two speeds, late rising edges and all.

    A speed that swings once an electrical turn, as a motor's does and that of the twin's load machine not, moves both
    edges of a sensor oppositely, and so neither of the figures that are compared.
    """
    real, known = read(name), KNOWN[name]
    (tmp_path / "twin.toml").write_text(fit([run_of(real)]).toml())
    for first, last, way in known.steady:
        t = real.edge_t[(real.edge_t > first) & (real.edge_t < last)]
        rpm = way * 60.0 * (len(t) - 1) / (6.0 * known.motor.n_p * (t[-1] - t[0]))
        with bench.connect("sim", config=tmp_path / "twin.toml", channels="hall") as rig:
            rig.load.speed(rpm=rpm)
            rig.wait(0.5)
            turned = rig.record(max(1.0, 120.0 / abs(rpm)))
        twin, motor = shares_deg(turned, *turned.span), shares_deg(real, first, last)
        assert apart(twin) == pytest.approx(apart(motor), abs=0.5), f"{name}, {first} s"
        np.testing.assert_allclose(displacements_deg(twin), displacements_deg(motor), atol=0.2, err_msg=f"{first} s")
