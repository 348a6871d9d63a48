"""What a check is, and the table of all of them.

A check is a function that takes a `Device` and returns its evidence. It raises `Failed`, `Unknown` or `NotApplicable`
with the reason where it does not pass. Nothing here speaks to a device.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import StrEnum

from bench.conform.device import Device
from bench.signal.verdict import Verdict
from protocol.requirements import requirements

Body = Callable[[Device], str | Iterable[str]]
"""Gives the evidence, in one piece or in several."""


class Carrier(StrEnum):
    """Links on which a check makes sense."""

    ANY = "any link"
    BYTES = "serial, TCP"
    BUS = "CAN"


@dataclass(frozen=True)
class Check:
    """One thing that SPEC demands.

    `cites` are the numbers of SPEC's requirements that it looks at, the main one first; `needs`, the level from which
    on the check may run, is its own `level` but for those of CAN. If a `critical` one fails, nothing more is
    energised; if it is unknown, its level is not claimed.
    """

    id: str
    level: int
    cites: tuple[str, ...]
    body: Body
    needs: int
    carrier: Carrier = Carrier.ANY
    critical: bool = False

    @property
    def says(self) -> str:
        """The main requirement, in SPEC's words."""
        return requirements()[self.cites[0]].text

    def evidence(self, device: Device) -> str:
        """Make the check; see the module for what it raises."""
        found = self.body(device)
        return found if isinstance(found, str) else "; ".join(found)


@dataclass(frozen=True)
class Result:
    """How a check ended, with the evidence in numbers."""

    check: Check
    verdict: Verdict
    evidence: str
    seconds: float = 0.0


TABLE: dict[str, Check] = {}
"""All checks by id; `catalogue` has them in the order in which they run."""


class Group:
    """Enters the checks of one level and one family: `@group("id", "7.27 7.24")`, by numbers of requirements."""

    def __init__(self, family: str, level: int, carrier: Carrier = Carrier.ANY) -> None:
        self._family = family
        self._level = level
        self._carrier = carrier

    def __call__(
        self,
        name: str,
        cites: str,
        *,
        needs: int | None = None,
        carrier: Carrier | None = None,
        critical: bool = False,
    ) -> Callable[[Body], Body]:
        """Enter the decorated function as the check `family.name`."""

        def enter(body: Body) -> Body:
            number = f"{self._family}.{name}"
            TABLE[number] = Check(
                number, self._level, tuple(cites.split()), body, self._level if needs is None else needs,
                carrier or self._carrier, critical,
            )  # fmt: skip
            return body

        return enter
