"""How a test stands after each phase that pytest runs of it: setup, call, teardown.

Tells a bad drive from a broken bench by what was raised. Nothing here keeps results or talks to a drive.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import pytest

from bench.accept.measuring import NotPassed
from bench.accept.results import Verdict, worst
from bench.errors import UNSAFE, BenchError, DriveFailed
from bench.rig.drive import DriveTripped
from protocol.errors import HbpError


@dataclass(frozen=True, slots=True)
class Phase:
    """How a test stands after a phase, or after several."""

    verdict: Verdict
    why: str = ""
    log: str = ""
    seconds: float = 0.0
    expected: bool = False
    """A foreseen ending, whose words are for people."""

    def then(self, later: Phase, seconds: float) -> Phase:
        """How it stands after a later phase, which took `seconds`: the worse of both, with the reasons of both."""
        verdict = worst((self.verdict, later.verdict))
        phases = (later,) if UNSAFE in self.why and UNSAFE in later.why else (self, later)  # which is told once
        why = "; then ".join(phase.why.partition("\n")[0] for phase in phases if phase.why)
        log = "\n\n".join(phase.log for phase in (self, later) if phase.log)
        return Phase(verdict, why, log, self.seconds + seconds)


NOT_BEGUN = Phase(Verdict.SKIPPED)


def judge(call: pytest.CallInfo[None], report: Any) -> Phase:
    """The phase that has just ended with `call`, of which pytest made `report`.

    A test that is marked as one that fails (xfail) is judged like any other: the mark does not change the verdict. If
    it passes against a strict mark, that is an ERROR of the test.
    """
    error = None if call.excinfo is None else call.excinfo.value
    marked = getattr(report, "wasxfail", None)
    if marked is not None and call.when == "setup" and isinstance(error, pytest.xfail.Exception):
        return Phase(Verdict.SKIPPED, f"expected to fail: {marked}")
    if report.skipped and marked is None:
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
        return Phase(Verdict.SKIPPED, str(reason).removeprefix("Skipped: "))
    if error is None:
        if report.failed:
            return Phase(Verdict.ERROR, str(report.longrepr))
        return Phase(Verdict.PASS if call.when == "call" else Verdict.SKIPPED)
    phase = _raised(error, report.longreprtext)
    return phase if marked is None else replace(phase, why=f"expected to fail ({marked}), and did: {phase.why}")


def _raised(error: BaseException, traceback: str) -> Phase:
    words = str(error).strip() or type(error).__name__
    match error:
        case NotPassed():
            return Phase(error.verdict, words, expected=True)
        case DriveTripped() | DriveFailed():
            return Phase(Verdict.FAIL, words, expected=True)
        case BenchError() | HbpError():
            return Phase(Verdict.ERROR, words, expected=True)
        case AssertionError() | pytest.fail.Exception():
            return Phase(Verdict.FAIL, words, traceback)
    return Phase(Verdict.ERROR, f"{type(error).__name__}: {words}", traceback)
