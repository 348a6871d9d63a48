"""How a check may end: by passing, or by one of these exceptions, whose words are its evidence."""

from __future__ import annotations

from enum import StrEnum


class Verdict(StrEnum):
    """How a check ended."""

    PASSED = "passed"
    FAILED = "failed"
    UNKNOWN = "unknown"
    """What it looks for was not seen."""
    NOT_APPLICABLE = "not applicable"
    """The device or the link has no such thing."""


class Ended(Exception):
    """A check ends here, other than by passing; the words are its evidence."""

    verdict: Verdict


class Failed(Ended):
    """The device does not do what SPEC demands."""

    verdict = Verdict.FAILED


class Unknown(Ended):
    """What would tell was not seen."""

    verdict = Verdict.UNKNOWN


class NotApplicable(Ended):
    """There is no such thing here."""

    verdict = Verdict.NOT_APPLICABLE
