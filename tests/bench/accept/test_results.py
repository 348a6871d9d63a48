"""Results survive the way to JSON and back, verdicts are weighed, limits mean what they say."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from bench.accept.results import Measurement, RunResult, TestResult, Verdict, run_from_json, to_json, worst
from bench.rig.quality import ParameterValue
from bench.signal.limits import Limits


def test_a_parameter_that_is_not_finite_comes_back_as_nan() -> None:
    run = RunResult("", "sim", Verdict.PASS, (), parameters=(ParameterValue("i_max", math.inf, 5.0, "A"),))
    written = to_json(run)
    assert written["parameters"][0]["value"] is None
    (back,) = run_from_json(written).parameters
    assert math.isnan(back.value)
    assert back.default == 5.0


def test_json_spells_out_margins_and_what_is_no_number() -> None:
    found = [
        Measurement("t.a", Limits("a", "A", 1.0, 4.0), Verdict.PASS, 1.5),
        Measurement("t.b", Limits("b", "A", None, 4.0), Verdict.INVALID, math.nan),
        Measurement("t.c", Limits("c", "A", None, 4.0), Verdict.FAIL, math.inf),
        Measurement("t.d", Limits("d"), Verdict.PASS, 3.0),
        Measurement("t.e", Limits("e", "A", 1.0), Verdict.ERROR),
    ]
    test = TestResult("t", "", "", "", Verdict.FAIL, measurements=tuple(found))
    written = to_json(RunResult("", "sim", Verdict.FAIL, (test,)))["tests"][0]["measurements"]
    shown = [(1.5, 0.5), (None, None), (None, None), (3.0, None), (None, None)]
    assert [(m["value"], m["margin"]) for m in written] == shown


@pytest.mark.parametrize(("verdicts", "expected"), [
    ([], "SKIPPED"),
    (["SKIPPED", "SKIPPED"], "SKIPPED"),
    (["SKIPPED", "PASS"], "PASS"),
    (["PASS", "INVALID"], "INVALID"),
    (["INVALID", "ERROR"], "ERROR"),
    (["ERROR", "FAIL", "PASS"], "FAIL"),
    (["FAIL", "ABORTED"], "ABORTED"),
])  # fmt: skip
def test_the_worst_verdict_counts(verdicts: list[str], expected: str) -> None:
    assert (worst(map(Verdict, verdicts)), worst(map(Verdict, reversed(verdicts)))) == (expected, expected)


@pytest.mark.parametrize(("lo", "hi", "value", "allowed", "margin", "share"), [
    (1.0, 5.0, 2.0, True, 1.0, 0.25),
    (1.0, 5.0, 5.0, True, 0.0, 0.0),
    (1.0, 5.0, 7.0, False, -2.0, -0.5),
    (1.0, 5.0, 0.0, False, -1.0, -0.25),
    (None, 4.0, 1.0, True, 3.0, 0.75),
    (-4.0, None, -5.0, False, -1.0, -0.25),
    (None, 0.0, 3.0, False, -3.0, None),
    (None, None, 3.0, True, None, None),
])  # fmt: skip
def test_limits_and_margins(lo, hi, value, allowed, margin, share) -> None:
    limits = Limits("x", "A", lo, hi)
    measurement = Measurement("t.x", limits, Verdict.PASS, value)
    assert limits.allow(value) is allowed
    assert (measurement.margin, measurement.share) == (margin, share)
    assert not limits.allow(math.nan)


@pytest.mark.parametrize(
    ("lo", "hi"), [(2.0, 1.0), (math.nan, None), (None, math.inf), (True, None), (None, "1"), (np.bool_(True), None)]
)
def test_limits_that_make_no_sense_are_refused(lo: Any, hi: Any) -> None:
    with pytest.raises(ValueError, match=r"^x: "):
        Limits("x", "A", lo, hi)


def test_limits_of_numpy_become_plain_numbers() -> None:
    limits = Limits("x", "A", np.int64(-2), np.float32(0.5))
    assert ((limits.lo, limits.hi), {type(limits.lo), type(limits.hi)}) == ((-2.0, 0.5), {float})
