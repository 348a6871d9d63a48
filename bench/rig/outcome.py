"""How a run ended: its exit code for a script, verdict and words for a reader. One place chooses them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from bench.errors import UNSAFE, ExitCode
from bench.signal.verdict import Verdict


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
            joined = unsafe if words in ("", "ok") or words in unsafe else f"{unsafe} ({words})"
            if UNSAFE in words:  # it is told there, with its cause
                joined = words
            return cls(ExitCode.OUTPUTS_MAY_BE_ON, verdict, joined, findings)
        ended = verdict is Verdict.ABORTED and signum
        return cls(128 + signum if ended else verdict.exit_code, verdict, words, findings)
