"""What varies from drive to drive: distributions against formulas; what is none is refused by name."""

from __future__ import annotations

import math
from dataclasses import replace
from statistics import NormalDist
from typing import Any

import numpy as np
import pytest

from bench.errors import BenchError
from bench.study.variation import Variation, Varied, leaf, read_varied

FIGURES = {
    "motor": {"R_s": 0.2, "n_p": 6, "i_sat": 0.0},
    "hall": {"delta_deg": (1.0, 2.0, 3.0, 4.0, 5.0, 6.0), "offset_deg": 0.0},
    "own": {"list": (0.0,) * 6},
}
P = np.linspace(0.01, 0.99, 99)[:, None]


def varied(key: str, **given: Any) -> Varied:
    return read_varied(key, given, FIGURES, "study.toml")


def column(key: str, **given: Any) -> np.ndarray:
    return varied(key, **given).of(P)[:, 0]


def test_a_normal_figure_has_the_quantiles_of_a_normal_distribution() -> None:
    wanted = [0.2 * NormalDist(1.0, 0.05).inv_cdf(p) for p in P[:, 0]]
    assert column("motor.R_s", normal=[1.0, 0.05], relative=True) == pytest.approx(wanted, rel=1e-12)


def test_a_uniform_and_a_triangular_figure() -> None:
    assert column("motor.R_s", uniform=[0.1, 0.5]) == pytest.approx(0.1 + 0.4 * P[:, 0])
    wanted = [math.sqrt(p * 4 * 1) if p < 0.25 else 4 - math.sqrt((1 - p) * 4 * 3) for p in P[:, 0]]  # of 0, 1, 4
    assert column("motor.R_s", triangular=[0.0, 1.0, 4.0]) == pytest.approx(wanted)


def test_what_is_cut_off_is_spread_over_the_rest() -> None:
    """The distribution under the condition that it lies within, not one that piles up at its ends."""
    normal = NormalDist(0.0, 1.0)
    a, b = normal.cdf(-0.5), normal.cdf(2.0)
    got = column("motor.R_s", normal=[0.0, 1.0], within=[-0.5, 2.0])
    assert got == pytest.approx([normal.inv_cdf(a + p * (b - a)) for p in P[:, 0]])
    ends = varied("motor.R_s", normal=[0.0, 1.0], within=[-0.5, 2.0]).of(np.array([[0.0], [1.0]]))
    assert ends[:, 0] == pytest.approx([-0.5, 2.0])


def test_a_normal_figure_has_no_infinite_one() -> None:
    assert np.isfinite(varied("motor.R_s", normal=[0.0, 1.0]).of(np.array([[0.0], [1.0]]))).all()


def test_the_numbers_of_a_list_vary_by_themselves_or_together() -> None:
    uniform = np.random.default_rng(1).random((50, 6))
    one = varied("hall.delta_deg", uniform=[-1.0, 1.0])
    assert one.inputs == tuple(f"hall.delta_deg_{k}" for k in range(1, 7))
    assert one.of(uniform) == pytest.approx(2.0 * uniform - 1.0)
    together = varied("hall.delta_deg", uniform=[0.5, 1.5], together=True, relative=True)
    assert together.dimensions == 1
    assert together.of(uniform[:, :1]) == pytest.approx((0.5 + uniform[:, :1]) * np.arange(1, 7))


def test_a_number_of_a_list_is_named_by_its_place() -> None:
    variation = Variation((varied("hall.delta_deg_3", uniform=[-1.0, 1.0]),))
    assert variation.changes([9.0], FIGURES) == {"hall.delta_deg": [1.0, 2.0, 9.0, 4.0, 5.0, 6.0]}


def test_choices_come_equally_often_and_whole_numbers_stay_whole() -> None:
    got = column("motor.n_p", choice=[4, 5, 7])
    assert [int((got == n).sum()) for n in (4, 5, 7)] == [33, 33, 33]
    value = Variation((varied("motor.n_p", choice=[4, 5, 7]),)).changes([5.0], FIGURES)["motor.n_p"]
    assert value == 5
    assert isinstance(value, int)


def test_a_choice_of_lists_is_told_by_number() -> None:
    lists = [[0.0] * 6, [1.0, -1.0] * 3]
    variation = Variation((varied("hall.delta_deg", choice=lists),))
    assert variation.inputs == ("hall.delta_deg",)
    assert variation.of(np.array([[0.1], [0.9]])).tolist() == [[0.0], [1.0]]
    assert variation.changes([1.0], FIGURES) == {"hall.delta_deg": lists[1]}


def test_rows_of_a_table_stay_together() -> None:
    table = Varied(
        "halls", "table", ((1.0, 2.0, 3.0), (10.0, 20.0, 30.0)), ("motor.R_s", "hall.offset_deg"), (1.0, 1.0)
    )
    got = table.of(np.array([[0.0], [0.4], [0.99]]))
    assert got.tolist() == [[1.0, 10.0], [2.0, 20.0], [3.0, 30.0]]


def test_correlated_figures_have_that_correlation_and_their_own_distributions() -> None:
    """Of a Gaussian copula Spearman's coefficient is 6 / pi asin(r / 2)."""
    both = (varied("motor.R_s", normal=[1.0, 0.1]), varied("hall.offset_deg", uniform=[-3.0, 3.0]))
    variation = Variation(both, ((("motor.R_s", "hall.offset_deg"), 0.8),))
    got = variation.of(np.random.default_rng(2).random((20_000, 2)))
    ranks = got.argsort(0).argsort(0)
    assert np.corrcoef(ranks.T)[0, 1] == pytest.approx(6 / math.pi * math.asin(0.4), abs=0.01)
    assert got.mean(0) == pytest.approx([1.0, 0.0], abs=0.05)
    assert got.std(0) == pytest.approx([0.1, math.sqrt(3.0)], rel=0.02)


def test_correlations_that_contradict_each_other_are_refused() -> None:
    three = tuple(varied(f"hall.delta_deg_{k}", normal=[0.0, 1.0]) for k in (1, 2, 3))
    names = [one.inputs[0] for one in three]
    pairs = ((0, 1, 0.9), (1, 2, 0.9), (0, 2, -0.9))
    with pytest.raises(BenchError, match=r"contradict each other .*delta_deg_1 and hall.delta_deg_3: -0.9"):
        Variation(three, tuple(((names[a], names[b]), r) for a, b, r in pairs))
    with pytest.raises(BenchError, match=r"'motor.n_p' is not varied by a distribution"):
        Variation((*three, varied("motor.n_p", choice=[4, 5])), (((names[0], "motor.n_p"), 0.5),))


def test_what_the_firmware_was_told_follows_the_drive_with_an_error_of_its_own() -> None:
    varying = (
        varied("hall.offset_deg", follows="motor.R_s", factor=10.0, sd=0.5),
        varied("motor.R_s", uniform=[1.0, 2.0]),
        replace(varied("motor.i_sat", follows="motor.R_s"), only=("told",)),
    )
    variation = Variation(varying)
    assert variation.dimensions == 2
    uniform = np.random.default_rng(3).random((20_000, 2))
    offset, R_s, i_sat = variation.of(uniform).T
    assert np.array_equal(i_sat, R_s)
    assert R_s == pytest.approx(1.0 + uniform[:, 1])
    error = offset - 10.0 * R_s
    assert error == pytest.approx([0.5 * NormalDist().inv_cdf(u) for u in uniform[:, 0]], abs=1e-9)
    assert abs(np.corrcoef(error, R_s)[0, 1]) < 0.02
    assert variation.changes([15.0, 1.5, 1.5], FIGURES, "told")["motor.i_sat"] == 1.5
    assert "motor.i_sat" not in variation.changes([15.0, 1.5, 1.5], FIGURES, "other")
    lists = Variation(
        (varied("hall.delta_deg", uniform=[0, 1]), varied("own.list", follows="hall.delta_deg", factor=2))
    )
    got = lists.of(np.random.default_rng(4).random((5, 6)))
    assert got[:, 6:] == pytest.approx(2.0 * got[:, :6])
    with pytest.raises(BenchError, match=r"motor.R_s follows motor.n_p, which is not varied: .*hall.offset_deg"):
        Variation((varied("motor.R_s", follows="motor.n_p"), varied("hall.offset_deg", uniform=[0, 1])))


@pytest.mark.parametrize(
    ("key", "given", "words"),
    [
        ("hall.delta_deg", {"follows": "motor.R_s"}, r"it is 6 numbers, and motor.R_s is 1"),
        ("motor.R_s", {"follows": "motor.i_sat", "within": [0, 1]}, r"within does not go with follows"),
        ("motor.R_s", {"normal": [1, 1], "sd": 1}, r"sd does not go with normal"),
        ("motor.R_s", {"follows": "motor.i_sat", "sd": -1}, r"sd one from 0 on, got 1 and -1"),
        ("motor.R", {"normal": [1, 1]}, r"no motor.R: did you mean motor.R_s"),
        ("hall.delta_deg_7", {"normal": [1, 1]}, r"no hall.delta_deg_7"),
        ("motor", {"normal": [1, 1]}, r"motor is a section: name one of motor.R_s"),
        ("motor.R_s", {"gauss": [1, 1]}, r"must have one of \{ normal = \[mean"),
        ("motor.R_s", {"normal": [1, 1], "uniform": [0, 1]}, r"must have one of"),
        ("motor.R_s", {"normal": [1.0, 0.0]}, r"normal must be \[mean, standard deviation\]"),
        ("motor.R_s", {"normal": [1.0]}, r"must be 2 numbers, got \[1.0\]"),
        ("motor.R_s", {"normal": [1.0, "a"]}, r"must be 2 numbers"),
        ("motor.R_s", {"normal": [1.0, math.nan]}, r"must be 2 numbers"),
        ("motor.R_s", {"uniform": [2.0, 1.0]}, r"uniform must be \[lowest, highest\], got \[2.0, 1.0\]"),
        ("motor.R_s", {"triangular": [0.0, 2.0, 1.0]}, r"triangular must be \[lowest, likeliest, highest\]"),
        ("motor.R_s", {"choice": []}, r"choice must be a list of values"),
        ("hall.delta_deg", {"choice": [[1.0, 2.0]]}, r"choice must be 6 numbers"),
        ("motor.R_s", {"normal": [1, 1], "withn": [0, 1]}, r"unknown 'withn': did you mean within"),
        ("motor.R_s", {"normal": [1, 1], "relative": 1}, r"relative must be true or false, got 1"),
        ("motor.R_s", {"normal": [1, 1], "within": [3, 2]}, r"within must be \[lowest, highest\]"),
        ("motor.R_s", {"uniform": [0, 1], "within": [2, 3]}, r"nothing of the distribution lies within \[2.0, 3.0\]"),
        ("motor.i_sat", {"normal": [1, 0.1], "relative": True}, r"a nominal value of 0 it would stay 0"),
    ],
)  # fmt: skip
def test_what_is_no_variation_is_refused_by_name(key: str, given: dict[str, Any], words: str) -> None:
    with pytest.raises(BenchError, match=words):
        read_varied(key, given, FIGURES, "study.toml")


def test_a_leaf_is_found_by_section_and_key() -> None:
    assert leaf(FIGURES, "motor.R_s") == ("motor.R_s", None, 0.2)
    assert leaf(FIGURES, "hall.delta_deg_2") == ("hall.delta_deg", 1, FIGURES["hall"]["delta_deg"])
