"""edge_kalman with constants that can be set afterwards is edge_kalman; and what the page says was found."""

from __future__ import annotations

import ast
import json
import math
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from sim.observers import edge_kalman, edge_lessons, edge_scales
from sim.observers.catalogue import CATALOGUE
from sim.observers.edge_scales import Motor
from tests.tuning.__main__ import FOUND, KINDS, ratios
from tests.tuning.benches import LOST, Drive, Stretch, drive
from tests.tuning.constants import LOADED, Constants

NAMES = ("EMF_D", "GATE", "C_3", "LEGS_EMF", "ONE", "OMEGA_B")
DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(scope="module")
def constants() -> Constants:
    return Constants()


def test_kernels_load_every_constant_and_keep_none(constants: Constants) -> None:
    kept = []
    for tree in constants._trees.values():
        for function in ast.walk(tree):
            if isinstance(function, ast.FunctionDef) and function.decorator_list:
                kept += [one.id for one in ast.walk(function) if isinstance(one, ast.Name) and one.id in NAMES]
    assert not kept
    loads = [one for tree in constants._trees.values() for one in ast.walk(tree)
             if isinstance(one, ast.Name) and one.id == LOADED]  # fmt: skip
    assert len(loads) > 150
    assert constants.as_they_are["edge_kalman.EMF_D"] == edge_kalman.EMF_D
    assert constants.as_they_are["edge_lessons.C_3"] == edge_lessons.C_3


def test_what_runs_in_python_has_the_constants_too(constants: Constants) -> None:
    motor = Motor(n_p=4, omega_m_max=300.0, R_s_hat=0.1, L_s_hat=1e-4, psi_f_hat=0.01, i_range=20.0)
    scale = constants._modules["edge_scales"].make_scale
    before = edge_scales.make_scale(16_000, motor)
    constants.set({})
    assert tuple(scale(16_000, motor)) == tuple(before)
    constants.set({"edge_scales.OMEGA_B": 2.0 * edge_scales.OMEGA_B})
    assert scale(16_000, motor).omega_b == pytest.approx(2.0 * before.omega_b)
    assert edge_scales.make_scale(16_000, motor) == before


@pytest.mark.campaign("tuning")
def test_it_agrees_bit_for_bit_and_another_constant_is_that_of_another_source(constants: Constants) -> None:
    seen = drive("bench24v", 1)
    known = CATALOGUE["edge_kalman"]
    usual = known.start(known.make_params(seen.pwm_hz, seen.parameters)).run(seen.samples, seen.reset)
    constants.set({})
    as_it_is = constants.start(seen.pwm_hz, seen.parameters).run(seen.samples, seen.reset)
    assert as_it_is.tobytes() == usual.tobytes()
    constants.set({"edge_lessons.C_3": 0.1})
    other = constants.start(seen.pwm_hz, seen.parameters).run(seen.samples, seen.reset)
    assert np.abs(other["theta"] - usual["theta"]).max() > 1e-6


def test_errors_are_those_of_the_angle() -> None:
    theta = np.linspace(0.0, 20.0, 1000)
    none = np.zeros(1000, bool)
    seen = Drive("x", none, none, theta, {}, [Stretch("slow", 0, 400), Stretch("steps", 400, 1000)], 16_000.0)
    off = np.radians(2.0) * np.sin(theta)
    told = np.mod(theta - off, math.tau)
    slow, steps = seen.errors(told)
    assert slow == ("slow", pytest.approx(2.0 * math.sqrt(np.mean(np.sin(theta[:400]) ** 2))))
    assert steps == ("steps", pytest.approx(2.0 * np.abs(np.sin(theta[400:])).max()))
    assert dict(seen.errors(np.full(1000, np.nan))) == {"slow": LOST, "steps": LOST}


def test_ratios_have_their_interval_over_drives() -> None:
    changed = np.random.default_rng(1).normal(-0.2, 0.1, (50, len(KINDS)))
    factor, lo, hi = ratios(changed)["slow"]
    assert factor == pytest.approx(math.exp(changed[:, 0].mean()), abs=1e-4)
    assert lo < math.exp(-0.2) < hi


def test_the_page_has_the_tables_of_what_was_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else: python docs/make_tune.py"""
    monkeypatch.syspath_prepend(str(DOCS))
    generator = import_module("make_tune")
    found, text = json.loads(FOUND.read_text()), (DOCS / "tune.md").read_text()
    assert found["as_they_are"] == Constants().as_they_are  # else: python -m tests.tuning
    assert text == generator.page(text, found)
