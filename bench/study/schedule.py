"""Which rows go to which worker, and when: each row is handed out once, whatever becomes of workers.

It knows of no processes and reads no clock. Batches begin with one row and grow until they hold `TARGET` of CPU time;
towards the end they shrink, so that workers end together. Each worker has one batch at work and one that waits.

What was on a worker that died is under suspicion: it goes to a worker alone, so that nothing is accused of another's
fault. Where that worker dies too, the batch is halved, until it is a single row.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import NamedTuple

TARGET = 3.0  # s of CPU time that a batch should take
LEAST = 0.2  # s, while there is more than that for each worker: to hand out a batch costs some ms
AHEAD = 2  # batches that a worker has: one at work and one that waits
GROWTH = 4  # a batch is at most so many times as large as the largest that has come back
SHARE = 4  # a batch is at most that part of what is left for a worker
MEMORY = 0.8  # weight of what was measured so far, against the newest batch: the first ones load kernels


class Batch(NamedTuple):
    """Rows that are computed in one call."""

    number: int
    rows: tuple[int, ...]


@dataclass(frozen=True)
class Done:
    """Rows that have come back."""

    rows: tuple[int, ...]
    result: bytes
    worker: str
    """host:pid"""
    seconds: float
    """CPU time that they took there."""


@dataclass(frozen=True)
class Crashed:
    """A row that was alone on a worker each time when that worker died."""

    rows: tuple[int, ...]
    """One row."""
    why: str


class Schedule:
    """What is to be computed, where it is being computed, and what is back.

    Args:
        allowed: workers that may die of a single row before it counts as crashed.
    """

    def __init__(self, rows: Iterable[int], allowed: int = 3, target: float = TARGET, ahead: int = AHEAD) -> None:
        self._rows = iter(rows)
        self._allowed, self._target, self._most = allowed, target, ahead
        self._next: deque[int] = deque()  # read from `rows`, some batches ahead
        self._again: deque[Batch] = deque()
        self._suspects: deque[Batch] = deque()
        self._alone: set[int] = set()  # numbers of batches that are, or were, under suspicion
        self._on: dict[str, list[Batch]] = {}  # by worker
        self._deaths = Counter[int]()  # by row
        self._batches = 0
        self._largest = 1
        self._seconds = self._measured = 0.0  # CPU time and rows, the newest with the largest weight

    @property
    def over(self) -> bool:
        """Whether all that there was has come back."""
        return not (self._again or self._suspects or any(self._on.values()) or self._ahead(1))

    def joined(self, worker: str) -> None:
        """A worker is ready."""
        self._on.setdefault(worker, [])

    def left(self, worker: str, died: bool = True) -> Iterator[Crashed]:
        """A worker is gone, or if it has not died, does not know its batches any more. Gives rows that are given up."""
        batches = self._on.pop(worker, [])
        for batch in batches:
            if not died:
                (self._suspects if batch.number in self._alone else self._again).append(batch)
            elif batch.number not in self._alone:
                self._suspect(batch.rows)
            elif len(batch.rows) > 1:
                middle = len(batch.rows) // 2
                self._suspect(batch.rows[:middle])
                self._suspect(batch.rows[middle:])
            else:
                self._deaths[batch.rows[0]] += 1
                if (count := self._deaths[batch.rows[0]]) < self._allowed:
                    self._suspects.append(batch)
                else:
                    yield Crashed(batch.rows, f"{count} workers have died of it")

    def lost(self) -> None:
        """All workers are gone at once, by no fault of what they did."""
        for worker in [*self._on]:
            for _ in self.left(worker, died=False):
                pass

    def came(self, worker: str, number: int, seconds: float) -> Batch | None:
        """A batch is back, after this CPU time. None where it was not expected from there any more."""
        for batch in self._on.get(worker, []):
            if batch.number == number:
                self._on[worker].remove(batch)
                self._seconds = MEMORY * self._seconds + seconds
                self._measured = MEMORY * self._measured + len(batch.rows)
                self._largest = max(self._largest, len(batch.rows))
                return batch
        return None

    def wanted(self) -> Iterator[tuple[str, Batch]]:
        """Where to send what, now."""
        kept_free = len(self._suspects)
        for worker in sorted(self._on, key=lambda name: len(self._on[name])):
            on = self._on[worker]
            if self._suspects and not on:
                kept_free -= 1
                yield worker, self._send(worker, self._suspects.popleft())
            elif kept_free > 0:  # until it has nothing else
                kept_free -= 1
            elif not any(batch.number in self._alone for batch in on):
                while len(on) < self._most and (batch := self._fresh()):
                    yield worker, self._send(worker, batch)

    def _send(self, worker: str, batch: Batch) -> Batch:
        self._on[worker].append(batch)
        return batch

    def _suspect(self, rows: tuple[int, ...]) -> None:
        batch = self._numbered(rows)
        self._alone.add(batch.number)
        self._suspects.append(batch)

    def _fresh(self) -> Batch | None:
        if self._again:
            return self._again.popleft()
        rows = tuple(self._next.popleft() for _ in range(self._size()))
        return self._numbered(rows) if rows else None

    def _numbered(self, rows: tuple[int, ...]) -> Batch:
        self._batches += 1
        return Batch(self._batches, rows)

    def _ahead(self, count: int) -> int:
        """Have `count` rows read, if there are as many; how many there are."""
        self._next.extend(islice(self._rows, max(0, count - len(self._next))))
        return min(count, len(self._next))

    def _size(self) -> int:
        """How many rows the next batch has."""
        if not self._measured:
            return self._ahead(1)
        workers = len(self._on)
        cost = max(self._seconds / self._measured, 1e-6)
        most = max(1, min(int(self._target / cost), GROWTH * self._largest))
        left = self._ahead(most * workers * SHARE)
        fewest = max(1, min(int(LEAST / cost), most))
        return min(left, max(min(fewest, -(-left // workers)), min(most, left // (workers * SHARE))))
