"""Every script of docs/examples runs, draws its figure, and prints what formulas and the plant say."""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from processes import ENVIRONMENT, LIMIT

from sim.config.params import load_params
from tests.choice import CAMPAIGN, chosen

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
PARAMS = load_params(None, {})
LARGEST = 60_000  # bytes of a figure on a page


pytestmark = pytest.mark.long("a script that records and draws")
HERE = chosen("examples", sorted(file.stem for file in EXAMPLES.glob("*.py")), 2)


def late(name: str) -> pytest.MarkDecorator:
    return pytest.mark.slow if name in HERE and not os.environ.get(CAMPAIGN) else pytest.mark.campaign("examples")


@pytest.fixture
def numbers(request: pytest.FixtureRequest, tmp_path: Path) -> dict[str, list[float]]:
    """What the script of the test's name has printed: by the word that a line begins with, the numbers in it."""
    name = request.function.__name__.removeprefix("test_")
    out = tmp_path / f"{name}.png"
    command = [sys.executable, str(EXAMPLES / f"{name}.py"), str(out)]
    ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=3 * LIMIT, env=ENVIRONMENT)
    assert ran.returncode == 0, ran.stderr
    height, width, _ = matplotlib.image.imread(out).shape
    assert (width, height > 250) == (716, True)
    assert 10_000 < out.stat().st_size < LARGEST
    lines = [line.partition(" ") for line in ran.stdout.splitlines()]
    return {word.rstrip(":"): [float(n) for n in re.findall(r"-?\d+\.?\d*", rest)] for word, _, rest in lines}


def test_every_example_is_tested_and_has_its_figure() -> None:
    scripts = {file.stem for file in EXAMPLES.glob("*.py")}
    assert {f"test_{name}" for name in scripts} <= globals().keys()
    assert scripts == {file.stem for file in EXAMPLES.glob("*.png")}
    assert all(file.stat().st_size < LARGEST for file in EXAMPLES.glob("*.png"))
    assert all(len(file.read_text().splitlines()) <= 55 for file in EXAMPLES.glob("*.py"))


@late("step_response")
def test_step_response(numbers: dict[str, list[float]]) -> None:
    for source in ("encoder", "vector-tracking"):
        last, rise, over = numbers[source]
        assert last == pytest.approx(800, abs=0.5)
        assert 20 < rise < 80  # not sooner than its torque can: J 500 r/min / (i_max 1.5 n_p psi_f) is 22 ms
        assert 0 < over < 20
    assert numbers["average-speed"][0] == pytest.approx(800, abs=15)


@late("load_step")
def test_load_step(numbers: dict[str, list[float]]) -> None:
    motor = PARAMS.motor
    dip, rise, torque, constant = numbers["dip"]
    assert (torque, constant) == (0.15, pytest.approx(1.5 * motor.n_p * motor.psi_f, abs=1e-4))
    assert rise == pytest.approx(torque / (1.5 * motor.n_p * motor.psi_f), rel=0.01)
    assert 50 < dip < 150


@late("error_by_angle")
def test_error_by_angle(numbers: dict[str, list[float]]) -> None:
    """The sector's centre stays in the middle of an ideal sector from one real edge to the next."""
    late = -np.array(PARAMS.hall.delta_deg) + PARAMS.hall.hysteresis_deg / 2
    edges = 60.0 * np.arange(7) + np.append(late, late[0])
    low, high = edges[:-1] - (60.0 * np.arange(6) + 30), edges[1:] - (60.0 * np.arange(6) + 30)
    mean = np.sum(high**2 - low**2) / 720
    std = math.sqrt(np.sum(high**3 - low**3) / 1080 - mean**2)
    assert numbers["sector_centre"] == pytest.approx([mean, std], abs=0.25)
    each = [numbers[name][1] for name in ("sector_centre", "average_speed", "vector_tracking", "edge_kalman")]
    assert each == sorted(each, reverse=True)


@late("gains")
def test_gains(numbers: dict[str, list[float]]) -> None:
    gain, by_drive, by_host, best = numbers["drive's"][:4]
    assert gain == 1268  # docs/simulated-drive.md
    assert by_drive == by_host  # the drive's firmware has estimated it in the run, the host afterwards
    assert 0 < best < by_drive


@late("spectrum")
def test_spectrum(numbers: dict[str, list[float]]) -> None:
    for source, within in (("average-speed", 0.02), ("vector-tracking", 1e-3)):
        f, first, thd, rms = numbers[source]
        assert f == pytest.approx(PARAMS.motor.n_p * 600 / 60, rel=within)
        assert thd / 100 == pytest.approx(math.sqrt(2 * rms**2 / first**2 - 1), rel=0.03)  # Parseval
    motor = PARAMS.motor
    assert numbers["vector-tracking"][1] > 0.2 / (1.5 * motor.n_p * motor.psi_f)  # and friction


@late("hall_edges")
def test_hall_edges(numbers: dict[str, list[float]]) -> None:
    assert numbers["late"] == pytest.approx([-delta for delta in PARAMS.hall.delta_deg], abs=0.1)
    hysteresis, edges = numbers["hysteresis"]
    assert hysteresis == pytest.approx(PARAMS.hall.hysteresis_deg, abs=0.05)
    assert edges == pytest.approx(2 * 2.0 * 200 / 60 * 36, abs=4)
