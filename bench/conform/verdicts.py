"""How a check may end: by passing, or by one of these exceptions, whose words are its evidence."""

from __future__ import annotations

from bench.signal.verdict import Verdict

WORDS = {
    Verdict.PASS: "passed", Verdict.FAIL: "failed", Verdict.INVALID: "unknown", Verdict.SKIPPED: "not applicable",
}  # fmt: skip
"""Unknown: what a check looks for was not observed. Not applicable: the device or the link lacks this feature."""


class Ended(Exception):
    """A check ends here, other than by passing; the words are its evidence."""

    verdict: Verdict


class Failed(Ended):
    """The device does not do what SPEC demands."""

    verdict = Verdict.FAIL


class Hopeless(Failed):
    """So much so that no other check can say anything."""


class Unknown(Ended):
    """What would decide was not observed."""

    verdict = Verdict.INVALID


class NotApplicable(Ended):
    """The device or the link lacks this feature."""

    verdict = Verdict.SKIPPED
