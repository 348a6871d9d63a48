"""That a step of a commissioning cannot claim what it is there for."""

from __future__ import annotations

from bench.errors import BenchError, ExitCode


class Refused(BenchError):
    """Step `step` claims nothing; `reason` is a sentence for the user, which says what was seen and what to do."""

    exit_code = ExitCode.FAILED

    def __init__(self, step: str, reason: str) -> None:
        super().__init__(f"{step}: {reason}")
        self.step = step
        self.reason = reason
