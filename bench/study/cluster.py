"""Batches of rows over the workers of a dask cluster: one of this machine, or one that somebody has started.

Each batch is sent to one worker by name, so that it is known what died with which worker, and what a worker of another
version has never seen. dask's own thread talks to the cluster; what comes of it waits in a queue for the main thread.
"""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, Future
from contextlib import ExitStack, closing, contextmanager, suppress
from importlib import import_module
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple
from uuid import uuid4

from bench.errors import BenchError
from bench.study.schedule import Crashed, Done, Schedule
from bench.study.worker import Computed, Worker, compute, identity, introduce, token_of, told
from bench.system import APART
from sim.interrupts import Held

CONNECT = 10.0  # s for a scheduler to answer
JOIN = 30.0  # s for a worker to join, or to come back
STRANGERS = 3.0  # s for a worker that fits to join where others do not
BUSY = 120.0  # s for a worker to answer for the first time: others may use it, or its disk is slow
LOOK = 0.5  # s between two looks at who is there
CLOSE = 1.0  # s
RESTARTS = 3  # schedulers of a local cluster that may die before another row comes
HOPELESS = 10  # rows that may crash their workers while fewer have come back
UNDELIVERED = (OSError, CancelledError, asyncio.CancelledError)
"""What dask raises where a connection breaks: it may be the scheduler's, of which others tell."""
HELLO = 0  # in place of a batch's number
KEPT = "what is done is kept: the same command again goes on from there"


class Came(NamedTuple):
    """What a call at a worker has given: an exception if it failed."""

    worker: str
    number: int
    value: object


class Here(NamedTuple):
    """The workers that there are now, with their threads; None where the scheduler does not answer."""

    workers: dict[str, int] | None


class SchedulerLost(Exception):
    """The cluster's scheduler has ended, or cannot be reached."""


class Connection:
    """A client of dask in a thread of its own, where no signal interrupts it."""

    def __init__(self, address: str) -> None:
        self.client: Any = None
        self.loop: asyncio.AbstractEventLoop | None = None
        self._task: asyncio.Task[Any] | None = None
        self._answer = SimpleQueue[Exception | None]()
        self._thread = threading.Thread(target=self._run, args=(address,), daemon=True)
        self._thread.start()

    def answer(self) -> None:
        """Wait for the scheduler's answer; raises what dask does where there is none."""
        with suppress(Empty):
            if error := self._answer.get(timeout=2 * CONNECT):
                raise error
            return
        raise TimeoutError("no answer")

    def close(self) -> None:
        """End it."""
        if self.loop and self._task:
            with suppress(RuntimeError):  # it has ended
                self.loop.call_soon_threadsafe(self._task.cancel)
            self._thread.join(CLOSE)

    def _run(self, address: str) -> None:
        with suppress(asyncio.CancelledError):
            asyncio.run(self._live(address))

    async def _live(self, address: str) -> None:
        self._task, self.loop = asyncio.current_task(), asyncio.get_running_loop()
        self.loop.set_exception_handler(lambda *_: None)  # it tells of calls that were given up
        try:
            self.client = import_module("distributed").Client(
                address, timeout=CONNECT, asynchronous=True, set_as_default=False
            )
            await self.client
            self._answer.put(None)
            await asyncio.Event().wait()
        except Exception as error:
            self._answer.put(error)
        finally:
            if self.client:
                with suppress(Exception):
                    await self.client.close(timeout=CLOSE)


class Calls:
    """Calls at workers, by one client of dask. What comes of them, and who is there, is put into `events`."""

    def __init__(self, connection: Connection) -> None:
        self.events = SimpleQueue[Came | Here]()
        self._client, self._loop = connection.client, connection.loop
        self._running: dict[str, dict[int, Future[None]]] = {}
        self._watching = self._start(self._watch())

    def send(self, worker: str, number: int, function: Callable[..., object], *arguments: object) -> None:
        """Call a function there; `number` says which call it was."""
        self._running.setdefault(worker, {})[number] = self._start(self._call(worker, number, function, arguments))

    def look(self) -> None:
        """Raise SchedulerLost where nobody watches the workers any more."""
        if self._watching.done():
            raise SchedulerLost

    def expected(self, came: Came) -> bool:
        """Whether it is of a call that was not forgotten, and comes for the first time."""
        return self._running.get(came.worker, {}).pop(came.number, None) is not None

    def forget(self, worker: str) -> None:
        """Expect nothing more of it."""
        for call in self._running.pop(worker, {}).values():
            call.cancel()

    def close(self) -> None:
        """Expect nothing more."""
        self._watching.cancel()
        for worker in [*self._running]:
            self.forget(worker)

    def _start(self, call: Any) -> Future[None]:
        assert self._loop
        return asyncio.run_coroutine_threadsafe(call, self._loop)

    async def _call(self, worker: str, number: int, function: Callable[..., object], arguments: Any) -> None:
        place = {"workers": [worker], "allow_other_workers": False, "pure": False, "key": f"study-{uuid4().hex}"}
        try:
            value = await self._client.submit(function, *arguments, **place)
        except (Exception, asyncio.CancelledError) as error:  # dask, too, cancels what it cannot bring
            value = error
        self.events.put(Came(worker, number, value))

    async def _watch(self) -> None:
        before: dict[str, int] | None = None
        while True:
            try:
                if self._client.status != "running":
                    raise OSError("the connection is closed")
                now = dict(await asyncio.wait_for(self._client.scheduler.ncores(), JOIN))
            except Exception:
                self.events.put(Here(None))
                return
            if now != before:
                self.events.put(Here(now))
                before = now
            await asyncio.sleep(LOOK)


class Cluster:
    """A dask cluster that is there while this context manager is entered.

    Args:
        workers: how many processes a cluster of this machine has; None: one for each of its cores.
        address: scheduler of a cluster that somebody has started, or None for one of this machine.
        note: told, one line each, what is worth knowing: a worker has died, is of another version.
    """

    def __init__(self, workers: int | None, address: str | None, note: Callable[[str], None]) -> None:
        self.address, self.note = address, note
        self._workers = workers
        self._open = ExitStack()
        self._connection: Connection | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._calls: Calls | None = None

    def __enter__(self) -> Cluster:
        try:
            self._begin()
        except SchedulerLost as error:
            raise BenchError(self._gone(error)) from None
        return self

    def __exit__(self, *_: object) -> None:
        self._connection = self._process = None
        with Held():  # whoever presses Ctrl-C twice leaves nothing either
            if self._calls:
                self._calls.close()
            self._open.close()

    def run(self, plan: bytes, work: str, rows: Iterable[int]) -> Iterator[Done | Crashed]:
        """Rows through `work`, module:function, as they come. BenchError where that fails, or nobody is left to do it.

        Ended early it leaves the batches that workers have at work to them; what they make is dropped.
        """
        schedule = Schedule(rows)
        restarts = 0
        while True:
            try:
                connection = self._connection or self._begin()
                with closing(Calls(connection)) as calls:
                    self._calls = calls
                    for came in Crew(self, calls, schedule, plan, work).run():
                        restarts = 0
                        yield came
                return
            except SchedulerLost as error:
                restarts += 1
                if self.address or restarts > RESTARTS:
                    raise BenchError(f"{self._gone(error)}; {KEPT}") from None
                self.note(f"{self._gone(error)}: a new one is started")
            schedule.lost()
            self.__exit__()

    def _gone(self, error: SchedulerLost) -> str:
        why = f" ({error})" if str(error) else ""
        return f"the dask scheduler {self.address or 'of this machine'} is gone{why}"

    def _begin(self) -> Connection:
        opened = self._open = ExitStack()
        try:
            opened.enter_context(_quiet())
            self._connection = self._connect(opened)
        except BaseException:
            self.__exit__()
            raise
        return self._connection

    def look(self) -> None:
        """Raise SchedulerLost where this machine's scheduler has ended."""
        if self._process and self._process.poll() is not None:
            raise SchedulerLost

    def _connect(self, opened: ExitStack) -> Connection:
        address = self.address or self._start(opened)
        connection = Connection(address)
        opened.callback(connection.close)
        try:
            connection.answer()
        except Exception as error:
            if not self.address:
                raise SchedulerLost(told(error)) from None
            words = f"no dask scheduler answers at {address} ({told(error)})"
            advice = "start one there with `dask scheduler`, or leave --cluster out for the cores of this machine"
            raise BenchError(f"{words}: {advice}") from None
        return connection

    def _start(self, opened: ExitStack) -> str:
        """A scheduler and workers on this machine, in a session of their own, which Ctrl-C at a terminal spares."""
        from dask.system import CPU_COUNT

        folder = opened.enter_context(tempfile.TemporaryDirectory(prefix="hallbench-", ignore_cleanup_errors=True))
        with Path(folder, "log").open("wb") as log:
            process = subprocess.Popen(
                [sys.executable, "-P", "-m", "bench.study.local", str(self._workers or CPU_COUNT), folder],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "DASK_LOGGING__DISTRIBUTED": "error"},
                start_new_session=True, creationflags=APART,
            )  # fmt: skip
        opened.callback(_end, process)
        self._process = process
        assert process.stdout
        if address := process.stdout.readline().decode().strip():
            return address
        lines = Path(folder, "log").read_text("utf-8", "replace").strip().splitlines() or ["it has ended"]
        raise SchedulerLost(lines[-1])


class Crew:
    """The workers of one run: those that are known, those that fit, and what they are told."""

    def __init__(self, cluster: Cluster, calls: Calls, schedule: Schedule, plan: bytes, work: str) -> None:
        self._cluster, self._calls, self._schedule = cluster, calls, schedule
        self._plan, self._work, self._token = plan, work, token_of(plan, work)
        self._here: dict[str, int] = {}  # threads, by address
        self._names: dict[str, str] = {}  # of those that fit
        self._refused: dict[str, str] = {}  # why, by address
        self._nobody_since = time.monotonic()
        self._done = self._crashed = 0

    def run(self) -> Iterator[Done | Crashed]:
        """Until all rows have come."""
        while not self._schedule.over:
            for worker, batch in self._schedule.wanted():
                self._calls.send(worker, batch.number, compute, self._token, batch.rows)
            try:
                event = self._calls.events.get(timeout=LOOK)
            except Empty:
                self._cluster.look()
                self._calls.look()
                self._require()
                continue
            if isinstance(event, Here):
                yield from self._look(event)
            elif self._calls.expected(event):
                yield from self._took(event)

    def _look(self, now: Here) -> Iterator[Crashed]:
        if now.workers is None:
            raise SchedulerLost
        for worker in [*(self._here.keys() - now.workers)]:
            if name := self._names.get(worker):
                self._cluster.note(f"the worker {name} has gone: what it was computing is computed again")
            yield from self._gone(worker)
        for worker in [*(now.workers.keys() - self._here)]:
            self._here[worker] = now.workers[worker]
            self._greet(worker)

    def _greet(self, worker: str) -> None:
        self._calls.send(worker, HELLO, introduce, self._token, self._plan, self._work)

    def _gone(self, worker: str, died: bool = True) -> Iterator[Crashed]:
        self._calls.forget(worker)
        self._here.pop(worker, None)
        self._refused.pop(worker, None)
        if self._names.pop(worker, None) and not self._names:
            self._nobody_since = time.monotonic()
        for crashed in self._schedule.left(worker, died):
            self._crashed += 1
            if self._crashed >= HOPELESS and self._crashed > self._done:
                words = f"{self._crashed} rows have killed their workers, row {crashed.rows[0]} the last"
                raise BenchError(f"{words}, and {self._done} have come; {KEPT}")
            yield crashed

    def _took(self, came: Came) -> Iterator[Done | Crashed]:
        worker, number, value = came
        name = self._names.get(worker, worker)
        killed = type(value).__name__ == "KilledWorker"
        if value is None or killed or isinstance(value, UNDELIVERED):  # another one is at its address, or it may be
            threads = self._here[worker]
            yield from self._gone(worker, killed)
            self._here[worker] = threads
            self._greet(worker)
        elif number == HELLO:
            self._met(worker, value)
        elif isinstance(value, Computed) and not value.why:
            if batch := self._schedule.came(worker, number, value.seconds):
                self._done += len(batch.rows)
                yield Done(batch.rows, value.result, name, value.seconds)
        elif isinstance(value, Computed):
            yield from self._rest()
            raise BenchError(f"{value.why} (worker {name})")
        else:
            assert isinstance(value, BaseException)
            raise BenchError(f"the cluster has failed at the worker {name}: {told(value)}; {KEPT}")

    def _rest(self) -> Iterator[Done | Crashed]:
        """What has come by now."""
        with suppress(Empty):
            while True:
                event = self._calls.events.get_nowait()
                if isinstance(event, Came) and isinstance(event.value, Computed) and not event.value.why:
                    yield from self._took(event)

    def _met(self, worker: str, answer: object) -> None:
        """A worker that fits gets work; another one is refused by name."""
        ours = identity()
        if isinstance(answer, Worker):
            place, theirs = f"{worker} ({answer.name})", answer.identity
            differs = [f"{what} {theirs.get(what, 'unknown')} there, {ours[what]} here" for what in ours
                       if theirs.get(what) != ours[what]]  # fmt: skip
            why = ", ".join(differs) or answer.why
        else:
            place, why = worker, told(answer) if isinstance(answer, BaseException) else "it answers something else"
        if why:
            self._refused[worker] = f"{place}: {why}"
            self._cluster.note(f"the worker {place} is not used: {why}")
            return
        assert isinstance(answer, Worker)
        self._names[worker] = answer.name
        self._schedule.joined(worker)
        if (threads := self._here[worker]) > 1:
            better = f"dask worker … --nworkers {threads} --nthreads 1"
            self._cluster.note(f"of the {threads} threads of the worker {answer.name} one is used; better: {better}")

    def _require(self) -> None:
        """Raise BenchError where nobody has been there for too long."""
        waited = time.monotonic() - self._nobody_since
        if self._names or waited < STRANGERS:
            return
        place = self._cluster.address or "this machine"
        if self._here and self._here.keys() == self._refused.keys():
            words = "; ".join(sorted(self._refused.values()))
            raise BenchError(f"no worker of {place} can be used: {words}. Install there what is installed here; {KEPT}")
        if waited < (BUSY if self._here else JOIN):
            return
        what = f"none of {len(self._here)} workers has answered" if self._here else "no worker has come"
        advice = (
            f": start some with `dask worker {place} --nworkers auto --nthreads 1`" if self._cluster.address else ""
        )
        raise BenchError(f"{place}: {what} within {waited:.0f} s{advice}; {KEPT}")


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a scheduler and its workers: its session has nothing else."""
    if sys.platform != "win32":
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    process.kill()
    with suppress(subprocess.TimeoutExpired):  # until the last of them has closed its output
        process.communicate(timeout=CLOSE)


@contextmanager
def _quiet() -> Iterator[None]:
    """What dask logs and warns of on the way is not for a user's eyes: `note` says it."""
    import_module("distributed")  # it sets its loggers up
    loggers = [logging.getLogger(name) for name in ("distributed", "distributed.client", "tornado.application")]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    warnings.filterwarnings("ignore", module=r"distributed\.")
    try:
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)
