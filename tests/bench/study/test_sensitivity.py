"""Sobol indices against their analytic values: Ishigami's function, a linear one, an additive one with noise."""

from __future__ import annotations

import builtins
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from SALib.sample import sobol as saltelli_points

from bench.signal.limits import Limits
from bench.study.answers import answer, answers, lines
from bench.study.drives import Drives
from bench.study.inputs import varied
from bench.study.report import write_report
from bench.study.sensitivity import Curves, Index, Sensitivity, noise, sensitivities
from tests.bench.study.made import about, picked, rows_of

Draw = Callable[[np.random.Generator, int], tuple[np.ndarray, np.ndarray]]

pytestmark = pytest.mark.filterwarnings("error")


def ishigami(x: np.ndarray) -> np.ndarray:
    """T. Ishigami, T. Homma, ISUMA 1990, with a = 7 and b = 0.1; x is (n, 3)."""
    return np.sin(x[:, 0]) + 7.0 * np.sin(x[:, 1]) ** 2 + 0.1 * x[:, 2] ** 4 * np.sin(x[:, 0])


VARIANCE = 49 / 8 + 0.1 * np.pi**4 / 5 + 0.01 * np.pi**8 / 18 + 0.5
FIRST = np.array([0.5 * (1 + 0.1 * np.pi**4 / 5) ** 2, 49 / 8, 0.0]) / VARIANCE
TOTAL = FIRST + np.array([1.0, 0.0, 1.0]) * 0.01 * np.pi**8 * (1 / 18 - 1 / 50) / VARIANCE
WEIGHTS = np.array([4.0, 3.0, 2.0, 1.0, 0.0, 0.0, 0.0, 0.0])


def draw_ishigami(random: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    x = random.uniform(-np.pi, np.pi, (n, 3))
    return x, ishigami(x)


def draw_linear(random: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    x = random.normal(size=(n, 8))
    return x, x @ WEIGHTS


def draw_noisy(random: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    """A slope and a parabola, each of the variance 1, and noise of 2."""
    x = random.uniform(-1, 1, (n, 6))
    slope, parabola = np.sqrt(3.0) * x[:, 0], np.sqrt(45 / 4) * (x[:, 1] ** 2 - 1 / 3)
    return x, slope + parabola + np.sqrt(2.0) * random.normal(size=n)


KNOWN: dict[str, tuple[Draw, np.ndarray]] = {
    "ishigami": (draw_ishigami, FIRST),
    "linear": (draw_linear, WEIGHTS**2 / 30.0),
    "additive and noise": (draw_noisy, np.array([0.25, 0.25, 0, 0, 0, 0])),
}


def first_order(x: np.ndarray, y: np.ndarray) -> list[Index]:
    n, found, why = Curves({f"x{k}": column for k, column in enumerate(x.T)}).indices(y)
    assert (n, why) == (np.isfinite(y).sum(), "")
    return found


def test_the_analytic_indices_are_the_published_ones() -> None:
    """I. M. Sobol', Y. L. Levitan, Comput. Phys. Commun. 117 (1999), 52."""
    assert np.round(FIRST, 4).tolist() == [0.3139, 0.4424, 0.0]
    assert np.round(TOTAL, 4).tolist() == [0.5576, 0.4424, 0.2437]


@pytest.mark.parametrize("n", [100, 300, 1000])
@pytest.mark.parametrize("function", KNOWN)
def test_indices_of_any_sampling_are_within_their_intervals(function: str, n: int) -> None:
    """At least 90 % of 150 studies by input, and none of the inputs without effect is said to have one in 97 %."""
    draw, truth = KNOWN[function]
    random = np.random.default_rng(11)
    found = [first_order(*draw(random, n)) for _ in range(150)]
    inside = [[each.first.lo <= s <= each.first.hi for each, s in zip(row, truth, strict=True)] for row in found]
    assert np.mean(inside, axis=0).min() >= 0.9
    accused = [any(each.matters for each, s in zip(row, truth, strict=True) if s == 0.0) for row in found]
    assert np.mean(accused) <= 0.03
    off = np.mean([[each.first.value for each in row] for row in found], axis=0) - truth
    assert np.abs(off).max() < 0.05  # an index without effect is told as 0 or more


def test_intervals_of_indices_shrink_with_n() -> None:
    wide, narrow = (first_order(*draw_ishigami(np.random.default_rng(2), n))[0].first for n in (200, 3200))
    assert (narrow.hi - narrow.lo) < 0.4 * (wide.hi - wide.lo)


def test_an_input_of_few_values_has_its_index() -> None:
    """Three motors: the share is that of an analysis of variance."""
    random = np.random.default_rng(6)
    motor = random.integers(0, 3, 900).astype(float)
    y = np.array([0.0, 2.0, -1.0])[motor.astype(int)] + random.normal(size=900)
    (index,) = first_order(motor[:, None], y)
    assert index.first.value == pytest.approx(14 / 9 / (14 / 9 + 1.0), abs=0.05)
    assert index.first.lo > 0.5


def study(x: np.ndarray, y: np.ndarray) -> Drives:
    """`y` is (n,) or (n, repetitions)."""
    inputs = {f"x{k}": column for k, column in enumerate(x.T)}
    return Drives(rows_of(inputs, {"t.y": y.reshape(len(x), -1, 1)}), 0)


def saltelli(groups: int, **more: Any) -> tuple[np.ndarray, np.ndarray]:
    problem = {"num_vars": 3, "names": ["x0", "x1", "x2"], "bounds": [[-np.pi, np.pi]] * 3}
    x = saltelli_points.sample(problem, groups, calc_second_order=False, seed=3, **more)
    return x, ishigami(x)


def by_saltelli(x: np.ndarray, y: np.ndarray) -> Sensitivity:
    rows = study(x, y).rows
    (found,) = answer(rows, about(rows, saltelli=("x0", "x1", "x2"))).sensitivity
    return found


def test_a_saltelli_design_has_first_and_total_indices() -> None:
    found = by_saltelli(*saltelli(512))
    assert found.n == 512
    for index in found.indices:
        k = int(index.input[1:])
        assert index.total is not None
        assert index.first.lo <= FIRST[k] <= index.first.hi
        assert index.total.lo <= TOTAL[k] <= index.total.hi
    assert found.strongest is not None
    assert found.strongest.input == "x0"


def test_groups_with_a_hole_are_left_out_as_a_whole() -> None:
    x, y = saltelli(256)
    whole = by_saltelli(x, y)
    y[[3, 7, 8, 1279]] = np.nan  # groups of 5: 0, 1, 255
    found = by_saltelli(x, y)
    assert (whole.n, found.n) == (256, 253)
    for index in found.indices:
        k = int(index.input[1:])
        assert index.first.lo <= FIRST[k] <= index.first.hi
    assert by_saltelli(x[:100], y[:100]).why == "18 groups of 5 drives have all values, and indices take 32"
    rows = study(x, y).rows
    kept = picked(rows, np.flatnonzero(rows.sample != 11))
    assert answer(kept, about(rows, saltelli=("x0", "x1", "x2"))).sensitivity[0].n == 252


def test_of_a_saltelli_design_only_what_is_drawn_independently_counts() -> None:
    x, y = saltelli(64)
    rows = study(x, y).rows
    found = answer(rows, about(rows, saltelli=("x0", "x1", "x2")))
    assert found.capability[0].n == 128
    assert found.capability[0].mean == pytest.approx(np.r_[y[::5], y[4::5]].mean())
    assert any("of those 128 only" in note for note in found.notes)


def test_without_salib_it_says_what_brings_it(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        if name.startswith("SALib"):
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    x, y = saltelli(64)
    rows = study(x, y).rows
    words = lines(rows, about(rows, saltelli=("x0", "x1", "x2")))
    assert any("pip install 'hallbench[study]'" in line for line in words)
    assert sensitivities(study(x, y), ["t.y"], ())[0].indices  # of any other sampling it is not needed


def test_inputs_that_cannot_be_told_apart_are_said() -> None:
    random = np.random.default_rng(8)
    x = random.normal(size=400)
    inputs = {
        "a": x,
        "b": 2.0 - 3.0 * x,
        "c": np.ones(400),
        "d": x + random.normal(size=400),
        "e": random.normal(size=400),
    }
    names, words = varied(inputs)
    assert list(names) == ["a", "d", "e"]
    assert words[:2] == ("c does not vary", "b follows from a, which stands for both")
    assert words[2].startswith("a and d vary together (correlation 0.7")
    assert len(words) == 3


def test_what_mostly_follows_another_is_told_by_what_it_adds() -> None:
    """A firmware was told an angle with an error, and that error is what matters, not where the sensors stand."""
    random = np.random.default_rng(18)
    angle, error = random.uniform(0.0, 50.0, 300), random.normal(0.0, 3.0, 300)
    x = np.column_stack([angle, 0.0175 * (angle + error), random.normal(size=300)])
    (found,) = sensitivities(study(x, np.abs(error) + 0.2 * random.normal(size=300)), ["t.y"], ())
    assert [index.input for index in found.indices if index.matters] == ["own part of x1"]
    assert found.indices[0].first.lo > 0.9
    adds, notes = study(x, error).inputs.told["own part of x1"], study(x, error).inputs.notes
    assert notes == ("x1 mostly follows x0 (correlation 0.977): its own part is what it adds to that",)
    assert abs(np.corrcoef(adds, error)[0, 1]) > 0.99


def test_drives_without_a_value_are_left_out_and_few_tell_nothing() -> None:
    x, y = draw_linear(np.random.default_rng(9), 300)
    y[::3] = np.nan
    (found,) = sensitivities(study(x, y), ["t.y"], ())
    assert found.n == 200
    assert found.indices[0].input == "x0"
    y[49:] = np.nan
    (found,) = sensitivities(study(x, y), ["t.y"], ())
    assert (found.indices, found.why) == ((), "32 drives have a value, and indices take 50")


@pytest.mark.parametrize(("sd", "repetitions"), [(0.5, 2), (0.5, 8), (3.0, 3)])
def test_the_share_of_noise_is_within_its_interval(sd: float, repetitions: int) -> None:
    random = np.random.default_rng(13)
    truth = sd * sd / (1.0 + sd * sd)
    inside = []
    for _ in range(1000):
        table = random.normal(size=(10, 1)) + sd * random.normal(size=(10, repetitions))
        found = noise(table)
        assert found is not None
        inside.append(found.lo <= truth <= found.hi)
    assert np.mean(inside) == pytest.approx(0.95, abs=0.02)


def test_noise_is_told_of_repetitions_only() -> None:
    assert noise(np.random.default_rng(1).normal(size=(40, 1))) is None
    assert noise(np.ones((40, 3))) is None
    assert noise(np.repeat(np.arange(5.0)[:, None], 2, axis=1)) == (0.0, 0.0, 0.0)


def test_inputs_that_are_drawn_as_a_set_are_told_as_one() -> None:
    """Halls of five motors that were measured: two of them have the third edge in the same place."""
    random = np.random.default_rng(10)
    sets = np.column_stack([random.normal(size=(5, 2)), [0.1, 0.2, 0.2, 0.3, 0.4]])[random.integers(0, 5, 100)]
    inputs = {"edge_3": sets[:, 2], "edge_1": sets[:, 0], "edge_2": sets[:, 1], "r": random.integers(0, 3, 100) * 1.0}
    names, words = varied(inputs)
    assert list(names) == ["edge_1", "r"]
    assert words[:2] == tuple(f"edge_{k} follows from edge_1, which stands for both" for k in (3, 2))


@pytest.mark.parametrize("repetitions", [1, 3])
def test_noise_makes_no_input_matter(repetitions: int) -> None:
    """It counts in every total index: x3 and x4 have no effect, x2 one with x1 only."""
    problem = {"num_vars": 5, "names": list("01234"), "bounds": [[-1, 1]] * 5}
    factors = tuple(f"x{k}" for k in range(5))
    for seed in range(10):
        x = saltelli_points.sample(problem, 512, calc_second_order=False, seed=seed)
        y = (2.0 * x[:, 0] + 4.0 * x[:, 1] * x[:, 2])[:, None]
        rows = study(x, y + np.random.default_rng(seed).normal(size=(len(x), repetitions))).rows
        (found,) = answer(rows, about(rows, saltelli=factors)).sensitivity
        assert {index.input for index in found.indices if index.matters} == {"x0", "x1", "x2"}
        assert all(index.total is not None and index.total.lo > 0.0 for index in found.indices)


def test_of_many_inputs_without_effect_none_is_said_to_have_one() -> None:
    """In 19 of 20 studies; of one input alone the intervals would accuse one in a hundred."""
    random = np.random.default_rng(14)
    curves = Curves({f"x{k}": random.normal(size=100) for k in range(20)})
    studies = [curves.indices(random.normal(size=100))[1] for _ in range(1000)]
    assert np.mean([any(index.matters for index in found) for found in studies]) <= 0.05


@pytest.mark.parametrize("constant", [False, True])
def test_one_factor_makes_all_of_the_variance(constant: bool, tmp_path: Path) -> None:
    """Another, which does not vary, is left out."""
    a, b = np.random.default_rng(15).random((2, 64))
    x = np.column_stack([a, b, *([a] if constant else []), b]).ravel()
    inputs = {"x": x} | ({"still": np.ones(len(x))} if constant else {})
    rows = rows_of(inputs, {"t.y": x.reshape(-1, 1, 1)}, [Limits("t.y", "", None, 0.9)])
    said = about(rows, saltelli=tuple(inputs))
    found = json.loads(json.dumps(answers(rows, said), allow_nan=False))
    ((index,),) = (each["indices"] for each in found["sensitivity"])
    assert (index["input"], index["matters"], index["total"]["hi"]) == ("x", True, 1.0)
    assert "By SALib" in write_report(tmp_path, rows, said).read_text()


def test_an_input_of_one_design_is_told_of_that_one_only(tmp_path: Path) -> None:
    """The other's is what it was told in its place; both are in all rows."""
    random = np.random.default_rng(16)
    inputs = {"x": random.normal(size=200), "e": random.normal(size=200), "e@b": random.normal(size=200)}
    y = np.stack([inputs["e"], inputs["x"] + inputs["e@b"]], axis=1)[:, None, :]
    rows = rows_of(inputs, {"t.y": y}, [Limits("t.y", "", None, 2.0)], ("a", "b"))
    found = answer(rows, about(rows))
    told = {each.design: {index.input: index.matters for index in each.indices} for each in found.sensitivity}
    assert told == {"a": {"e": True, "x": False}, "b": {"x": True, "e@b": True}}
    assert {name for each in found.worst if each.design == "a" for name, _, _ in each.unusual} <= {"x", "e"}
    assert write_report(tmp_path, rows, about(rows)).exists()


def test_a_factor_that_is_no_figure_of_the_drive_has_indices_too(tmp_path: Path) -> None:
    x, y = saltelli(64)
    rows = study(x, y).rows
    said = about(rows, saltelli=("x0", "error of x1", "x2"))
    assert answer(rows, said).sensitivity[0].indices[0].input in ("x0", "error of x1")
    assert "error of x1" in write_report(tmp_path, rows, said).read_text()
