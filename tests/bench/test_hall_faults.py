"""The judge of `bench hall check` before recordings by formula: right or "cannot tell", and nothing well is accused."""

from __future__ import annotations

import itertools

import pytest

from bench.findings.health import examine
from bench.hall.trace import trace
from tests.bench.hall_cases.drives import healthy
from tests.bench.hall_cases.faults import Case, cases
from tests.choice import chosen, sampled

NOT_YET = "the judge knows neither rings that sit anywhere nor most of the faults"
BY_FAULT = [chosen(name, of, 1)[0] for name, of in itertools.groupby(cases(), lambda case: case.fault.name)]


@pytest.mark.xfail(reason=NOT_YET, strict=False)
@pytest.mark.parametrize("case", chosen("Hall faults", BY_FAULT, 16), ids=lambda case: case.name)
def test_faults_are_named_and_nothing_else_is(case: Case) -> None:
    health = examine(trace(case.recording.capture()))
    said = [(finding.code, finding.cause) for finding in health.findings]
    assert case.judged(str(health.verdict), said) in ("right", "cannot tell"), (case.expected, health.verdict, said)


@pytest.mark.xfail(reason=NOT_YET, strict=False)
@pytest.mark.parametrize("seed", sampled("healthy drives", range(200), 6, campaign="hall"))
def test_healthy_drives_are_not_accused(seed: int) -> None:
    assert not examine(trace(healthy(seed).capture())).findings
