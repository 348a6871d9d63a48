"""One figure of two commits that were measured turn about: ratio, spread, and what is asked of it."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from tests.benchmarks.table import number

WORSE = 1.03
"""What a row may have become, beyond its spread, where a commit asks for nothing else."""
SLOW = 1.3
"""From where on the short form fails."""
WITHIN = "within a run"
"""The unit of a ratio that a tree has by itself: it grows where its denominator gets quicker, which is no loss."""


@dataclass(frozen=True, slots=True)
class Pair:
    """A cost, now and then, of each round; none where that side has no such thing.

    `at_most` limits the ratio, as it is or beyond its spread; `limit` what is measured now, in `unit`.
    """

    what: str
    unit: str
    now: Sequence[float]
    then: Sequence[float]
    at_most: float | None = None
    beyond: bool = False
    limit: float | None = None

    @property
    def ratios(self) -> list[float]:
        """Now over then, of each round; more than 1 is slower."""
        return [now / then for now, then in zip(self.now, self.then, strict=True)] if self.now and self.then else []

    @property
    def ratio(self) -> float:
        """The median of the rounds' ratios."""
        return statistics.median(self.ratios)

    @property
    def spread(self) -> float:
        """Half the distance of the quartiles of the rounds' ratios; of two or three rounds half of all; 0 of one."""
        ratios = sorted(self.ratios)
        if len(ratios) < 4:
            return 0.5 * (ratios[-1] - ratios[0])
        low, _, high = statistics.quantiles(ratios, n=4, method="inclusive")
        return 0.5 * (high - low)

    @property
    def least(self) -> float:
        """The smaller of the ratio and the ratio of the best rounds: what other load on the machine does not raise."""
        return min(self.ratio, min(self.now) / min(self.then))

    @property
    def compared(self) -> bool:
        """Whether both sides have it."""
        return bool(self.ratios)

    @property
    def missed(self) -> bool:
        """Whether something is asked for and not reached."""
        slow = self.compared and self.at_most is not None and self.ratio > self.at_most + self.beyond * self.spread
        return slow or (bool(self.now) and self.limit is not None and statistics.median(self.now) > self.limit)

    @property
    def slow(self) -> bool:
        """Whether the short form fails."""
        return self.compared and self.unit != WITHIN and self.least > SLOW

    def cells(self, rev: str) -> tuple[str, str, str, str, str, str]:
        """What, now, then, the ratio with its spread, what is asked for and whether it is reached, for people."""
        now, then = (f"{number(statistics.median(x))} {self.unit}" if x else "" for x in (self.now, self.then))
        rounds = f" ± {self.spread:.2f}" if len(self.ratios) > 1 else ", one round"
        asked = [f"ratio at most {self.at_most:.3g}{' beyond its spread' * self.beyond}"] if self.at_most else []
        asked += [f"at most {number(self.limit)} {self.unit}"] if self.limit is not None else []
        judged = asked and (self.compared or self.limit is not None) and bool(self.now)
        return (
            self.what,
            now or "not here",
            then or f"not in {rev}",
            f"{self.ratio:.2f}{rounds}" if self.compared else "",
            ", ".join(asked) if judged else "",
            ("MISSED" if self.missed else "reached") if judged else "",
        )


def paired(now: list[dict[str, float]], then: list[dict[str, float]]) -> list[Pair]:
    """The rows of what two trees told, a dictionary for each round; a row's name ends with its unit.

    Raises ValueError if a tree told of a row in some rounds only, or a cost is none.
    """
    found = []
    for name in dict.fromkeys(name for told in (*now, *then) for name in told):
        sides = [tuple(told[name] for told in side if name in told) for side in (now, then)]
        if any(side and len(side) < len(now) for side in sides):
            raise ValueError(f"{name}: not in every round")
        if bad := [x for side in sides for x in side if not 0.0 < x < float("inf")]:
            raise ValueError(f"{name}: {bad[0]} is no cost")
        what, _, unit = name.rpartition(", ")
        found.append(Pair(what, unit, *sides))
    return found
