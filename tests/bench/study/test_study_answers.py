"""Yields, distances to limits and worst drives of studies whose truth is known; what is degenerate gets words."""

from __future__ import annotations

import json
import math
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

from bench.accept.results import Measurement
from bench.errors import BenchError
from bench.signal.limits import Limits
from bench.signal.verdict import Verdict
from bench.study.answers import Answers, answer, answers, lines
from bench.study.capability import Capability
from bench.study.drives import ALL
from bench.study.report import write_report
from bench.study.rows import Rows
from bench.study.worst import margin_share
from bench.study.yields import Yield
from tests.bench.study.made import about, motors, picked, rows_of

pytestmark = pytest.mark.filterwarnings("error")


def yield_of(found: Answers, test: str, design: str = "a") -> Yield:
    (one,) = (each for each in found.yields if (each.test, each.design) == (test, design))
    return one


def of(found: Answers, name: str, design: str = "a") -> Capability:
    (one,) = (each for each in found.capability if (each.name, each.design) == (name, design))
    return one


def only_verdicts(**verdicts: list[list[str]]) -> Rows:
    """By test: for each drive its verdict in each repetition."""
    tables = {test: np.array(rows)[:, :, None] for test, rows in verdicts.items()}
    (shape,) = {table.shape for table in tables.values()}
    return rows_of({"x": np.arange(float(shape[0]))}, {"note": np.zeros(shape)}, verdicts=tables)


def test_a_drive_passes_that_passes_in_every_repetition() -> None:
    rows = only_verdicts(
        t=[["PASS", "PASS"], ["PASS", "FAIL"], ["FAIL", "INVALID"], ["PASS", "INVALID"], ["", ""], ["PASS", "PASS"]],
        u=[["PASS", "PASS"], ["PASS", "PASS"], ["PASS", "PASS"], ["FAIL", "PASS"], ["PASS", "PASS"], ["ERROR", "PASS"]],
    )
    found = answer(rows, about(rows))
    t, u, both = (yield_of(found, test) for test in ("t", "u", ALL))
    assert (t.unknown_row, u.unknown_row, both.unknown_row) == (7, 10, None)
    assert (t.passed, t.failed, t.unknown, t.bounds) == (2, 2, 2, pytest.approx((2 / 6, 4 / 6)))
    assert (u.passed, u.failed, u.unknown) == (4, 1, 1)
    assert (both.passed, both.failed, both.unknown, both.bounds) == (1, 3, 2, pytest.approx((1 / 6, 3 / 6)))
    assert t.share is not None
    assert t.share.value == 0.5
    assert any(
        "2 unknown: 33.3 % if all of them fail, 66.7 % if they pass" in line for line in lines(rows, about(rows))
    )


def test_a_row_that_is_missing_leaves_its_drive_unknown() -> None:
    rows = only_verdicts(t=[["PASS", "PASS"]] * 4)
    found = answer(picked(rows, np.arange(7)), about(rows))
    assert (yield_of(found, "t").passed, yield_of(found, "t").unknown) == (3, 1)
    found = answer(picked(rows, np.arange(6)), about(rows))
    assert (yield_of(found, "t").passed, yield_of(found, "t").unknown) == (3, 0)
    assert any(note.startswith("3 of 4 drives are there") for note in found.notes)


def test_the_yield_of_all_tests_is_no_higher_than_of_one() -> None:
    rows = motors(300)
    found = answer(rows, about(rows))
    for design in rows.designs:
        every = yield_of(found, ALL, design)
        for test in ("steady", "step"):
            assert every.passed <= yield_of(found, test, design).passed
            assert every.failed >= yield_of(found, test, design).failed


def test_rows_in_another_order_say_the_same() -> None:
    rows = motors(120)
    shuffled = picked(rows, np.random.default_rng(1).permutation(len(rows)))
    assert answers(shuffled, about(rows)) == answers(rows, about(rows))


def test_a_value_that_is_missing_never_passes() -> None:
    """Neither in a yield, which a verdict makes, nor beside a limit."""
    rows = motors(200, repetitions=2)
    before = of(answer(rows, about(rows)), "steady.error_std", "paper")
    gone = np.flatnonzero(rows.of(0))[::10]
    rows.measured["steady.error_std"][gone] = np.nan
    after = of(answer(rows, about(rows)), "steady.error_std", "paper")
    lost = len({int(rows.sample[at]) for at in gone})
    assert after.sides[0].n == before.sides[0].n - lost
    assert after.n + after.missing == before.n


def normal_study(n: int, mean: float, sd: float, limits: Limits, seed: int = 0, repetitions: int = 1) -> Rows:
    values = np.random.default_rng(seed).normal(mean, sd, (n, repetitions, 1))
    return rows_of({"x": np.arange(float(n))}, {"t.m": values}, [limits])


def test_is_my_limit_three_sigma_away() -> None:
    limits = Limits("t.m", "deg", None, 10.0)
    for mean, said in ((6.0, "yes"), (7.1, "cannot tell"), (8.5, "no")):
        rows = normal_study(400, mean, 1.0, limits)
        (side,) = of(answer(rows, about(rows)), "t.m").sides
        assert side.three_sigma == said
        assert side.away is not None
        assert side.away.lo < 10.0 - mean < side.away.hi
        assert side.by_theory is not None
        assert side.by_theory.lo < norm.sf(10.0 - mean) < side.by_theory.hi


def test_cpk_distance_and_the_limit_that_99_percent_keep() -> None:
    """Of both sides, of normal values whose figures are known."""
    rows = normal_study(4000, 1.0, 2.0, Limits("t.m", "", -5.0, 6.0))
    found = of(answer(rows, about(rows)), "t.m")
    lo, hi = found.sides
    assert found.cp is not None
    assert found.cpk is not None
    assert found.cp.lo < 11.0 / 12.0 < found.cp.hi
    assert found.cpk.lo < 5.0 / 6.0 < found.cpk.hi
    for side, sign in ((lo, -1.0), (hi, 1.0)):
        assert side.wanted.lo < 1.0 + sign * 2.0 * norm.ppf(0.99) < side.wanted.hi
        at, out, low, high = np.array(side.curve).T
        truth = norm.sf(sign * (at - 1.0) / 2.0)
        assert np.mean((low <= truth) & (truth <= high)) > 0.85
        assert np.all((low <= out) & (out <= high))
    values = rows.measured["t.m"]
    assert (lo.beyond, hi.beyond) == (int((values < -5.0).sum()), int((values > 6.0).sum()))
    assert list(found.quantiles) == ["0.1 %", "50 %", "99.9 %"]


def test_the_worst_repetition_counts_beside_a_limit_as_in_a_verdict() -> None:
    rows = normal_study(300, 0.0, 1.0, Limits("t.m", "", None, 1.5), repetitions=3)
    found = answer(rows, about(rows))
    assert of(found, "t.m").sides[0].beyond == yield_of(found, "t").failed


def test_a_value_at_its_limit_is_within() -> None:
    rows = normal_study(40, 2.0, 0.0, Limits("t.m", "", 2.0, 2.0))
    assert [side.beyond for side in of(answer(rows, about(rows)), "t.m").sides] == [0, 0]


def test_what_is_not_normal_is_judged_by_the_share_seen() -> None:
    values = np.random.default_rng(2).standard_exponential((5000, 1, 1))
    for limit, said in ((4.0, "no"), (12.0, "yes")):  # 4 is 3 sd from the mean, with 1.8 % beyond it
        rows = rows_of({"x": np.arange(5000.0)}, {"t.m": values}, [Limits("t.m", "", None, limit)])
        found = of(answer(rows, about(rows)), "t.m")
        assert found.not_normal.startswith("skew")
        assert found.sides[0].three_sigma == said


def test_few_drives_do_not_tell_the_limit_that_99_percent_keep() -> None:
    rows = normal_study(100, 0.0, 1.0, Limits("t.m", "", None, 3.0))
    (side,) = of(answer(rows, about(rows)), "t.m").sides
    assert math.isinf(side.wanted.hi)
    assert side.too_few == "368 drives tell its other end; at the furthest of 100 at least 96.4 % pass"


@pytest.mark.parametrize("limits", [Limits("m", "", 1.0, 3.0), Limits("m", "", None, 2.0), Limits("m", "", 0.0, None)])
def test_a_margin_is_that_of_bench_accept(limits: Limits) -> None:
    for value, found in zip(values := [0.5, 1.0, 2.5, 7.0], margin_share(limits, np.array(values)), strict=True):
        share = Measurement("m", limits, Verdict.PASS, value).share
        margin = limits.margin(value)
        wanted = share if share is not None else math.copysign(math.inf, margin or 0.0)
        assert math.isnan(found) if margin == 0.0 else found == pytest.approx(wanted)


def test_the_worst_drive_comes_with_its_command_and_what_is_unusual_in_it() -> None:
    random = np.random.default_rng(4)
    inputs = {"r": random.normal(size=50), "l": random.normal(size=50)}
    inputs["l"][17] = 9.0
    values = random.uniform(0.0, 1.0, (50, 2, 1))
    values[17, :, 0], values[31, 0, 0] = (2.5, 3.0), 1.8
    rows = rows_of(inputs, {"t.m": values}, [Limits("t.m", "deg", None, 2.0)])
    first, second, _ = answer(rows, about(rows)).worst
    assert (first.sample, first.row, first.verdict, first.replay) == (17, 35, "FAIL", "bench study replay s.toml 35")
    assert first.share == pytest.approx(-0.5)
    assert first.unusual[0][:2] == ("l", 9.0)
    assert (second.sample, second.share) == (31, pytest.approx(0.1))
    assert "worst: t.m 3, ≤ 2 deg, a: bench study replay s.toml 35" in lines(rows, about(rows))


CASES = {
    "one drive": motors(1, repetitions=1),
    "two drives": motors(2),
    "few drives": motors(20),
    "no rows": picked(motors(3), np.arange(0)),
    "one design's rows only": picked(motors(60), np.flatnonzero(motors(60).of(1))),
    "all pass": only_verdicts(t=[["PASS"]] * 40),
    "all fail": only_verdicts(t=[["FAIL"]] * 40),
    "nothing judged": only_verdicts(t=[["SKIPPED"]] * 40),
    "constant": normal_study(60, 2.0, 0.0, Limits("t.m", "", 0.0, 2.0)),
    "all beyond": normal_study(60, 20.0, 1.0, Limits("t.m", "", None, 1.0)),
    "one limit twice": normal_study(60, 0.0, 0.0, Limits("t.m", "", 0.0, 0.0)),
    "information only": normal_study(60, 20.0, 1.0, Limits("t.m")),
    "yes or no": rows_of({"x": np.arange(30.0)}, {"t.m": np.ones((30, 1, 1))}, [Limits("t.m", "yes/no", 1.0, 1.0)]),
    "all missing": rows_of({"x": np.ones(30)}, {"t.m": np.full((30, 1, 1), np.nan)}, [Limits("t.m", "", 0.0, 1.0)]),
    "infinite": rows_of({"x": np.arange(60.0)}, {"t.m": np.full((60, 1, 1), np.inf)}, [Limits("t.m", "", 0.0, 1.0)]),
    "no limits, no verdicts": rows_of({"x": np.arange(60.0)}, {"t.m": np.random.default_rng(1).random((60, 2, 1))}),
    "no inputs": rows_of({}, {"t.m": np.random.default_rng(1).random((60, 1, 1))}),
    "no measurements": rows_of({"x": np.arange(3.0)}, {}, verdicts={"t": np.full((3, 1, 1), "PASS")}),
    "alike designs": rows_of({"x": np.arange(60.0)}, {"m": np.ones((60, 1, 2))}, designs=("a", "b")),
    "names of others": rows_of(
        {"$x_1$ & <b>": np.arange(60.0)}, {"t.<i>$a": np.random.default_rng(1).random((60, 1, 1))}
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_degenerate_gets_words(case: str, tmp_path: Path) -> None:
    rows = CASES[case]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = answer(rows, about(rows))
        text = json.dumps(answers(rows, about(rows), found), allow_nan=False)
        words = lines(rows, about(rows), found)
        page = write_report(tmp_path / "new" / "folder", rows, about(rows)).read_text()
    assert "<i>" not in page
    assert "<b>" not in page
    said = re.sub(r"<[^>]*>", " ", " ".join([*words, page.partition("<body>")[2]]))
    assert not {"nan", "inf", "-inf", "−inf", "None"} & set(re.findall(r"[^\s(),;:]+", said))
    assert json.loads(text)["drives"] == len(set(rows.sample.tolist()))


def test_a_report_is_one_file_and_replaces_another_only_if_told(tmp_path: Path) -> None:
    rows = motors(25)
    page = write_report(tmp_path, rows, about(rows, points=True))
    text = page.read_text()
    assert page == tmp_path / "report.html"
    assert text.count('src="data:image/png;base64,') == text.count("<img") > 5
    assert "http" not in text
    for words in ("edge_kalman", "bench study replay s.toml ", "cannot tell", "pwm.dead_time does not vary", "McNemar"):
        assert words in text
    rows = only_verdicts(t=[["PASS"]])
    with pytest.raises(BenchError, match="exists"):
        write_report(tmp_path, rows, about(rows))
    assert "edge_kalman" not in write_report(tmp_path, rows, about(rows), overwrite=True).read_text()
