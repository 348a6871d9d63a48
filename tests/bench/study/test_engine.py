"""The engine of a study: which rows go to which worker, in virtual time; and rows through real workers."""

from __future__ import annotations

import heapq
import itertools
import json
import math
import os
import random
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

import pytest

from bench.errors import BenchError
from bench.study.engine import Engine, Rate, Serial, open_engine
from bench.study.schedule import Crashed, Done, Schedule
from bench.study.worker import identity

WORK = "tests.bench.study.engine_work"


# -- the schedule, in virtual time ----------------------------------------------------------------------------------


@dataclass
class Simulated:
    """Workers that take their batches in order: `cost` s a row, `once` s more for the first batch of each.

    A worker dies as it ends a batch with a row that is `deadly`, or where `killed` says so. Another joins 1 s later.
    """

    schedule: Schedule
    workers: int
    cost: float
    once: float = 0.0
    deadly: frozenset[int] = frozenset()
    killed: Callable[[int], bool] = lambda turn: False
    came: Counter[int] = field(default_factory=Counter)
    sizes: list[int] = field(default_factory=list)
    crashed: list[int] = field(default_factory=list)
    ends: dict[str, float] = field(default_factory=dict)
    deaths: int = 0
    most_at_once: int = 0
    stale: list[object] = field(default_factory=list)

    def run(self) -> Simulated:
        queues: dict[str, list[tuple[int, tuple[int, ...]]]] = {}
        events = [(0.0, k, f"w{k}", "joins") for k in range(self.workers)]
        order = itertools.count(self.workers)
        while events:
            now, _, worker, what = heapq.heappop(events)
            if what == "joins":
                self.schedule.joined(worker)
                queues[worker] = []
            else:
                number, rows = queues[worker][0]
                if self.deadly & set(rows) or self.killed(len(self.sizes) + self.deaths):
                    self.deaths += 1
                    gone = queues.pop(worker)
                    self.crashed += [crash.rows[0] for crash in self.schedule.left(worker)]
                    self.stale += [self.schedule.came(worker, number, 1.0) for number, _ in gone]
                    heapq.heappush(events, (now + 1.0, next(order), f"w{next(order)}", "joins"))
                else:
                    queues[worker].pop(0)
                    seconds = self.cost * len(rows) + self.once * (worker not in self.ends)
                    batch = self.schedule.came(worker, number, seconds)
                    assert batch is not None
                    assert batch.rows == rows
                    self.came.update(rows)
                    self.sizes.append(len(rows))
                    self.ends[worker] = now
                    if queues[worker]:
                        self._begin(events, order, now, worker, queues[worker][0][1])
            for other, batch in [*self.schedule.wanted()]:
                queues[other].append(batch)
                if len(queues[other]) == 1:
                    self._begin(events, order, now, other, batch.rows)
            self.most_at_once = max([self.most_at_once, *map(len, queues.values())])
        assert self.schedule.over
        return self

    def _begin(self, events: list[tuple[float, int, str, str]], order: Iterator[int], now: float, worker: str,
               rows: tuple[int, ...]) -> None:  # fmt: skip
        end = now + self.cost * len(rows) + self.once * (worker not in self.ends)
        heapq.heappush(events, (end, next(order), worker, "ends"))


def simulated(count: int, workers: int, cost: float, **more: object) -> Simulated:
    return Simulated(Schedule(range(count)), workers, cost, **more).run()  # type: ignore[arg-type]


@pytest.mark.parametrize("cost", [0.0, 0.001, 0.02, 0.33, 10.0])
@pytest.mark.parametrize("workers", [1, 2, 16, 100])
@pytest.mark.parametrize("count", [0, 1, 7, 5000])
def test_each_row_comes_once_and_no_worker_has_more_than_two_batches(count: int, workers: int, cost: float) -> None:
    got = simulated(count, workers, cost)
    assert got.came == Counter(range(count))
    assert got.most_at_once <= 2


@pytest.mark.parametrize("cost", [0.001, 0.02, 0.33])
@pytest.mark.parametrize("workers", [1, 2, 16, 100])
def test_batches_begin_small_and_take_seconds_and_workers_end_together(workers: int, cost: float) -> None:
    each = 60.0  # s of work for each worker
    got = simulated(int(each * workers / cost), workers, cost, once=1.0)
    assert got.sizes[0] == 1
    half = len(got.sizes) // 2
    assert all(2.0 <= cost * size <= 5.0 for size in got.sizes[half - workers // 2 : half + workers // 2 + 1])
    last = max(got.ends.values())
    assert last - min(got.ends.values()) < 1.0 + cost
    assert last < 1.02 * (each + 1.0) + cost
    assert 0.01 * len(got.sizes) < 0.05 * each * workers / 2  # 10 ms for each batch


def test_rows_are_read_as_they_are_needed() -> None:
    read = sent = most = 0

    def rows() -> Iterator[int]:
        nonlocal read
        for row in range(10**6):
            read += 1
            yield row

    schedule = Schedule(rows())
    schedule.joined("w")
    for _ in range(40):
        for worker, batch in [*schedule.wanted()]:
            sent += len(batch.rows)
            schedule.came(worker, batch.number, 0.005 * len(batch.rows))
            most = max(most, read - sent)
    assert sent > 30_000
    assert most < 3000


@pytest.mark.parametrize("seed", range(20))
def test_each_row_comes_once_whoever_dies(seed: int) -> None:
    choose = random.Random(seed)
    got = simulated(5000, choose.choice([1, 2, 5]), 0.02, killed=lambda turn: choose.random() < 0.2)
    assert got.deaths > 5
    assert got.came + Counter(got.crashed) == Counter(range(5000))
    assert set(got.stale) == {None}


@pytest.mark.parametrize("deadly", [{0}, {499}, {250, 251}, {3, 77, 490}])
@pytest.mark.parametrize("workers", [1, 3])
def test_rows_that_kill_workers_are_found_and_no_others(deadly: set[int], workers: int) -> None:
    got = simulated(500, workers, 0.02, deadly=frozenset(deadly))
    assert set(got.crashed) == deadly
    assert got.came == Counter(set(range(500)) - deadly)
    assert got.deaths <= len(deadly) * (4 + math.log2(500))


def test_what_was_lost_with_the_scheduler_comes_again_and_counts_as_nothing_s_fault() -> None:
    schedule = Schedule(range(3), allowed=1)
    for _ in range(5):
        schedule.joined("w")
        assert [*schedule.wanted()]
        schedule.lost()
    schedule.joined("w")
    assert sorted(row for _, batch in schedule.wanted() for row in batch.rows) == [0, 1]


# -- rates ------------------------------------------------------------------------------------------------------------


def test_a_rate_says_what_is_left() -> None:
    now = 0.0
    rate = Rate(1000, lambda: now, done=5)
    assert rate.said("drives") == "5 of 1000 drives"
    now = 60.0  # kernels were compiled
    rate.add(2)
    assert rate.said("drives") == "7 of 1000 drives"
    now = 65.0
    rate.add(405)
    assert rate.said("drives") == "412 of 1000 drives, 81/s, 7 s left"
    now = 160.0
    rate.add(10)
    now = 170.0
    rate.add(10)
    assert rate.per_second == pytest.approx(20 / 105.0)
    assert rate.said("drives") == "432 of 1000 drives, 0.19/s, 50 min left"
    rate.add(568)
    assert rate.said("drives") == "1000 of 1000 drives"


# -- rows through workers ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def notes() -> list[str]:
    return []


@pytest.fixture(scope="module")
def two(notes: list[str]) -> Iterator[Engine]:
    pytest.importorskip("distributed")
    with open_engine(2, None, notes.append) as engine:
        yield engine


@pytest.fixture(params=["serial", "two"])
def engine(request: pytest.FixtureRequest) -> Engine:
    return Serial() if request.param == "serial" else request.getfixturevalue("two")


def collected(came: Iterable[Done | Crashed]) -> tuple[dict[int, int], list[Done], list[int]]:
    """What each row has given, no row twice; the batches; rows that crashed."""
    values: dict[int, int] = {}
    batches, crashed = [], []
    for one in came:
        if isinstance(one, Crashed):
            crashed += one.rows
        else:
            found = dict(zip(one.rows, json.loads(one.result), strict=True))
            assert not values.keys() & found.keys()
            values |= found
            batches.append(one)
    return values, batches, crashed


def run(engine: Engine, work: str, count: int, **plan: object) -> Iterator[Done | Crashed]:
    return engine.run(json.dumps(plan).encode(), f"{WORK}:{work}", range(count))


def test_rows_come_back_once_with_their_cpu_time(engine: Engine) -> None:
    values, batches, crashed = collected(run(engine, "tripled", 300, ms=2))
    assert values == {row: 3 * row for row in range(300)}
    assert not crashed
    assert sum(batch.seconds for batch in batches) == pytest.approx(0.6, rel=0.3)
    workers = {batch.worker for batch in batches}  # of two the one may have done all before the other was there
    for done in run(engine, "tripled", 20_000, ms=2):
        if isinstance(engine, Serial) or len(workers) == 2:
            break
        assert isinstance(done, Done)
        workers.add(done.worker)
    assert len(workers) == (1 if isinstance(engine, Serial) else 2)


def test_a_failure_names_row_and_error_after_what_has_come(engine: Engine) -> None:
    came = []
    with pytest.raises(BenchError, match=r"^row 77: ZeroDivisionError: no flux( \(worker \S+:\d+\))?$"):
        came += run(engine, "failing", 10_000, failing=77)
    assert collected(came)[0]


def test_no_rows_are_done_at_once(engine: Engine) -> None:
    assert not [*run(engine, "tripled", 0)]


def test_an_engine_serves_again_after_it_was_left(engine: Engine) -> None:
    for _ in run(engine, "tripled", 10_000, ms=1):
        break
    assert collected(run(engine, "tripled", 3))[0] == {0: 0, 1: 3, 2: 6}


@pytest.mark.long("a dozen workers die, one after the other, and others start")
def test_a_row_that_kills_its_workers_is_found_and_all_others_come(two: Engine, notes: list[str]) -> None:
    values, _, crashed = collected(run(two, "deadly", 200, deadly=[23]))
    assert crashed == [23]
    assert values == {row: 3 * row for row in range(200) if row not in crashed}
    assert all("has gone" in note for note in notes)
    assert len(notes) > 3


@pytest.mark.long("a dozen workers die, one after the other, and others start")
def test_a_study_in_which_each_row_kills_its_workers_ends(two: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bench.study.cluster.HOPELESS", 3)
    with pytest.raises(BenchError, match=r"^3 rows have killed their workers, row \d+ the last, and 0 have come; "):
        [*run(two, "deadly", 12, deadly=[*range(12)])]


def test_a_function_that_workers_do_not_have_is_named(two: Engine) -> None:
    with pytest.raises(BenchError, match=r"no worker of this machine can be used: .*'nothing_like_it'"):
        [*run(two, "nothing_like_it", 3)]


def test_one_worker_is_this_process_and_needs_no_dask() -> None:
    words = "import sys; sys.modules['dask'] = sys.modules['distributed'] = None\n" + (
        "from bench.study.engine import open_engine; import numpy as np\n"
        f"with open_engine(1, None) as e: print(sum(len(d.rows) for d in e.run(b'{{}}', '{WORK}:tripled', range(9))))"
    )
    done = subprocess.run([sys.executable, "-c", words], capture_output=True, text=True, env={**os.environ})
    assert done.stdout.strip() == "9", done.stderr


def test_several_workers_without_dask_are_an_error_that_says_what_brings_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bench.study.engine.find_spec", lambda name: None)
    with pytest.raises(BenchError, match=r"pip install 'hallbench\[study\]', or --workers 1$"):
        open_engine(2, None)
    with pytest.raises(BenchError, match=r"--cluster needs dask: pip install 'hallbench\[study\]'$"):
        open_engine(None, "tcp://nowhere:8786")


def test_an_identity_names_what_rows_depend_on() -> None:
    found = identity()
    assert found["Python"] == f"{sys.version_info.major}.{sys.version_info.minor}"
    assert {"hallbench", "sources of sim", "numpy", "numba", "llvmlite", "processor"} <= found.keys()
    assert all(found.values())
