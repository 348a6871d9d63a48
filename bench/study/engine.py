"""Rows of a study through a function: in this process, or over the workers of a cluster."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from importlib.util import find_spec
from types import TracebackType
from typing import Protocol

from bench.errors import BenchError
from bench.study.schedule import Crashed, Done, Schedule
from bench.study.worker import computed, found, this_process

ALONE = 1.0  # s of CPU time that a batch should take where there is nobody to wait for
WINDOW = 30.0  # s over which a rate is taken


class Engine(Protocol):
    """What computes rows; a context manager."""

    def __enter__(self) -> Engine: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def run(self, plan: bytes, work: str, rows: Iterable[int]) -> Iterator[Done | Crashed]:
        """Rows through `work`, a `bench.study.worker.Work` as module:function, in batches, in any order, each row once.

        A row that kills its workers is given as Crashed. BenchError where `work` raises an exception.
        """


class Serial:
    """This process alone."""

    def __enter__(self) -> Serial:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def run(self, plan: bytes, work: str, rows: Iterable[int]) -> Iterator[Done | Crashed]:
        """As `Engine` says; a row that kills its worker kills this process."""
        schedule, here, function = Schedule(rows, target=ALONE, ahead=1), this_process(), found(work)
        schedule.joined(here)
        for _, batch in iter(lambda: next(schedule.wanted(), (here, None)), (here, None)):
            assert batch
            done = computed(plan, function, batch.rows)
            if done.why:
                raise BenchError(done.why)
            schedule.came(here, batch.number, done.seconds)
            yield Done(batch.rows, done.result, here, done.seconds)


def open_engine(workers: int | None, cluster: str | None, note: Callable[[str], None] = lambda text: None) -> Engine:
    """What computes rows, to be entered.

    Args:
        workers: processes on this machine; None: one for each of its cores.
        cluster: a dask scheduler's address, tcp://host:8786, whose workers are to do it.
        note: told, one line each, what is worth knowing: a worker has died, is of another version.
    """
    if workers == 1 and not cluster:
        return Serial()
    if not find_spec("distributed"):
        what = "--cluster needs" if cluster else "several workers need"
        raise BenchError(f"{what} dask: pip install 'hallbench[study]'{'' if cluster else ', or --workers 1'}")
    from bench.study.cluster import Cluster

    return Cluster(workers, cluster, note)


class Rate:
    """How quickly something gets done, for a line that says so.

    Args:
        total: how much there is.
        done: how much of it was done before.
        clock: time, s.
    """

    def __init__(self, total: int, clock: Callable[[], float], done: int = 0) -> None:
        self.total, self.done = total, done
        self._clock = clock
        self._seen = deque[tuple[float, int]]()  # when so much was done; what starts before the first does not count

    def add(self, count: int) -> None:
        """So much more is done."""
        now = self._clock()
        self.done += count
        self._seen.append((now, self.done))
        while len(self._seen) > 2 and now - self._seen[1][0] > WINDOW:
            self._seen.popleft()

    @property
    def per_second(self) -> float:
        """Over the last `WINDOW` at least; 0 until more than the first has come."""
        begun, before = self._seen[0] if self._seen else (self._clock(), self.done)
        elapsed = self._clock() - begun
        return (self.done - before) / elapsed if elapsed > 0 else 0.0

    @property
    def left(self) -> float:
        """s, infinite where there is no rate yet."""
        rate = self.per_second
        return (self.total - self.done) / rate if rate > 0 else float("inf")

    def said(self, what: str) -> str:
        """412 of 1000 drives, 81/s, 7 s left"""
        words = f"{self.done} of {self.total} {what}"
        if self.per_second <= 0 or self.done >= self.total:
            return words
        return f"{words}, {self.per_second:.3g}/s, {_duration(self.left)} left"


def _duration(seconds: float) -> str:
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < 99.5 else f"{minutes / 60:.0f} h"
