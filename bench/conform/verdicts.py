"""How a check may end: by passing, or by one of these exceptions, whose words are its evidence."""

from __future__ import annotations

from enum import StrEnum


class Verdict(StrEnum):
    """How a check ended."""

    PASSED = "passed"
    FAILED = "failed"
    UNKNOWN = "unknown"
    """What it looks for was not observed."""
    NOT_APPLICABLE = "not applicable"
    """The device or the link lacks this feature."""


class Ended(Exception):
    """A check ends here, other than by passing; the words are its evidence."""

    verdict: Verdict


class Failed(Ended):
    """The device does not do what SPEC demands."""

    verdict = Verdict.FAILED


class Unknown(Ended):
    """What would decide was not observed."""

    verdict = Verdict.UNKNOWN


class NotApplicable(Ended):
    """The device or the link lacks this feature."""

    verdict = Verdict.NOT_APPLICABLE
