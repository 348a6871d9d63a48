"""The unkind bench: its file, its figures for other motors, and a drive that runs on it."""

from pathlib import Path

import numpy as np
import pytest

import sim
from sim.config.params import load_params
from sim.config.unkind import effects, unkind
from tests.sim.drive.rig import Rig, error_deg

FILE = Path(sim.__file__).parent / "bench24v.toml"


def test_the_file_is_what_the_rules_give_for_the_papers_motor():
    assert load_params(FILE) == load_params(None, unkind(load_params()))


def test_each_effect_is_off_by_default_and_changes_something():
    kind = load_params()
    for name, overrides in effects(kind).items():
        assert load_params(None, overrides) != kind, name
    assert len({key for overrides in effects(kind).values() for key in overrides}) == len(unkind(kind))


def test_a_drive_runs_on_it():
    rig = Rig(0, **unkind(load_params()))
    rig.start()
    rig.spin(500.0, 1.0)
    rig.spin(500.0, 1.0, 0.2)
    run = rig.spin(500.0, 1.0, 0.2)
    assert not rig.faults
    assert run["omega_m"].mean() == pytest.approx(500 * 2 * np.pi / 60, rel=0.01)
    assert error_deg(run, "theta_vt").std() < 5.0
    assert 20.0 < run["u_dc"].min() < 23.95
