"""How a run ended: its exit code for a script, verdict and words for a reader. The one place that chooses them."""

from __future__ import annotations

import signal
from dataclasses import dataclass
from typing import Self

from bench.errors import ExitCode
from bench.signal.verdict import Verdict

_CODES = {
    Verdict.PASS: ExitCode.DONE,
    Verdict.FAIL: ExitCode.FAILED,
    Verdict.INCOMPLETE: ExitCode.INCOMPLETE,
    Verdict.ABORTED: 128 + signal.SIGINT,
}
"""Of a run that ended like this; every other verdict is `ExitCode.ERROR`."""


@dataclass(frozen=True)
class RunOutcome:
    """How a run ended; `findings` are what was wrong, one by one."""

    exit_code: int
    verdict: Verdict
    words: str = ""
    findings: tuple[str, ...] = ()

    @classmethod
    def of(
        cls, verdict: Verdict, words: str = "", findings: tuple[str, ...] = (), *, unsafe: str = "", signum: int = 0
    ) -> Self:
        """`unsafe`: why outputs may still be on, which goes before all else. `signum`: the signal that ended it."""
        if unsafe:
            joined = unsafe if words in ("", "ok") else f"{unsafe} ({words})"
            return cls(ExitCode.OUTPUTS_MAY_BE_ON, verdict, joined, findings)
        ended = verdict is Verdict.ABORTED and signum
        return cls(128 + signum if ended else _CODES.get(verdict, ExitCode.ERROR), verdict, words, findings)
