"""What a check is, how it may end, and the table of all of them.

A check is a function that takes a `Device` and returns its evidence. It raises `Failed`, `Unknown` or `NotApplicable`
with the reason where it does not pass. Nothing here speaks to a device.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bench.conforming.device import Device

LEVELS = ("link", "identity and parameters", "streams", "states and setpoints", "motion", "CAN")
"""Names of the levels, by number."""
LINK, IDENTITY, STREAMS, STATES, MOTION, CAN = range(len(LEVELS))
DEFAULT_LEVEL = STREAMS
"""Nothing is energised up to this one."""


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


class Carrier(StrEnum):
    """Links on which a check makes sense."""

    ANY = "any link"
    BYTES = "serial, TCP"
    BUS = "CAN"


@dataclass(frozen=True)
class Check:
    """One thing that SPEC demands.

    `says` is SPEC's sentence and `chapter` where it stands; `needs`, the level from which on the check may run, is its
    own `level` but for those of CAN. Where a `critical` one fails, nothing is energised any more.
    """

    id: str
    level: int
    chapter: int
    says: str
    body: Callable[[Device], str]
    needs: int
    carrier: Carrier = Carrier.ANY
    critical: bool = False


@dataclass(frozen=True)
class Result:
    """How a check ended, with the evidence in numbers."""

    check: Check
    verdict: Verdict
    evidence: str
    seconds: float = 0.0


TABLE: dict[str, Check] = {}
"""All checks by id; `catalogue` has them in the order in which they run."""

Body = Callable[["Device"], str]


class Group:
    """Enters the checks of one level and one family: `@group("id", chapter, "sentence")`."""

    def __init__(self, family: str, level: int, carrier: Carrier = Carrier.ANY) -> None:
        self._family = family
        self._level = level
        self._carrier = carrier

    def __call__(
        self,
        name: str,
        chapter: int,
        says: str,
        *,
        needs: int | None = None,
        carrier: Carrier | None = None,
        critical: bool = False,
    ) -> Callable[[Body], Body]:
        """Enter the decorated function as the check `family.name`."""

        def enter(body: Body) -> Body:
            number = f"{self._family}.{name}"
            TABLE[number] = Check(
                number, self._level, chapter, says, body, self._level if needs is None else needs,
                carrier or self._carrier, critical,
            )  # fmt: skip
            return body

        return enter
