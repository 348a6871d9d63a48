"""How a measurement, a test or a run ended.

The verdicts are those of OpenHTF, which separate a bad motor from a broken bench, plus INVALID: the data are
insufficient for either.
"""

from __future__ import annotations

import signal
from collections.abc import Iterable
from enum import StrEnum

from bench.errors import ExitCode


class Verdict(StrEnum):
    """How a measurement, a test or a run ended."""

    PASS = "PASS"
    INCOMPLETE = "INCOMPLETE"  # of a run: all that was tested passed, but something was not tested
    FAIL = "FAIL"  # the drive is not as it should be
    INVALID = "INVALID"  # the data are insufficient for a verdict: samples lost, clock jump, saturated sensor
    ERROR = "ERROR"  # the bench is not as it should be
    ABORTED = "ABORTED"  # the run was interrupted
    SKIPPED = "SKIPPED"  # the rig lacks what the test needs

    @property
    def exit_code(self) -> int:
        """Of a command that ended like this."""
        return _CODES.get(self, ExitCode.ERROR)


_CODES = {
    Verdict.PASS: ExitCode.DONE,
    Verdict.FAIL: ExitCode.FAILED,
    Verdict.INCOMPLETE: ExitCode.INCOMPLETE,
    Verdict.ABORTED: 128 + signal.SIGINT,
}

WORDS = {
    Verdict.ABORTED: "aborted", Verdict.FAIL: "failed", Verdict.ERROR: "in error", Verdict.INVALID: "invalid",
    Verdict.INCOMPLETE: "incomplete", Verdict.PASS: "passed", Verdict.SKIPPED: "skipped",
}  # fmt: skip
"""The worst first: a failing drive stays a failing drive whatever else went wrong."""


def worst(verdicts: Iterable[Verdict]) -> Verdict:
    """The verdict over several; SKIPPED over none."""
    return min(verdicts, key=list(WORDS).index, default=Verdict.SKIPPED)
