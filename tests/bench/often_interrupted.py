"""Ctrl-C at many moments of what takes locks in the main thread; then it is to end as ever: NAME FOLDER."""

from __future__ import annotations

import subprocess
import sys
import uuid
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, nullcontext, suppress
from pathlib import Path

import can

from bench.record import sink
from bench.record.info import RunInfo, SummaryText
from bench.rig.interrupts import none_dropped
from bench.view.sinks import LiveSink
from protocol.links import open_link, parse_target
from tests.bench.view import synthetic
from tests.viewers import any_port

KILLER = """
import os, random, signal, sys, time
dice = random.Random(7)
while os.read(0, 1):
    time.sleep(dice.uniform(1e-5, 3e-4))
    os.kill(os.getppid(), signal.SIGINT)
"""


def often_interrupt(action: Callable[[], object], times: int) -> None:
    """Ctrl-C at `times` moments of an action that is repeated. From another process: no thread waits for Python."""
    with subprocess.Popen([sys.executable, "-c", KILLER], stdin=subprocess.PIPE, bufsize=0) as killer:
        assert killer.stdin is not None
        for _ in range(times):
            with suppress(KeyboardInterrupt):
                killer.stdin.write(b".")
                while True:
                    action()


Pair = tuple[Callable[[], object], Callable[[], object]]
"""What is interrupted, and how it ends."""
RUN = RunInfo(168_000_000, 16_000, (), {})


def of_recording(folder: Path) -> Pair:
    sink.BACKLOG_LIMIT = 10_000  # the thread that writes is not left far behind
    recording, edges = sink.RunSink(folder / "a.run", RUN, wait=True), synthetic.SyntheticRun(1.0).edge_chunk(0, 2)
    return lambda: recording.take(edges), recording.close  # RecordingError: it cannot be written


def of_dashboard(folder: Path) -> Pair:
    view = LiveSink(RUN, any_port())

    def close() -> None:
        assert view.close()

    return lambda: view.take(SummaryText("")), close


def of_can_link(folder: Path) -> Pair:
    channel = uuid.uuid4().hex
    link = open_link(parse_target(f"can:virtual/{channel}"))

    def close() -> None:
        with closing(link), can.Bus(interface="virtual", channel=channel, ignore_config=True) as bus:
            bus.send(can.Message(arbitration_id=1, is_extended_id=False))
            assert link.read(10.0)

    return lambda: link.read(0.0, 1e-6), close


def of_an_executor(folder: Path) -> Pair:
    executor = ThreadPoolExecutor(2)

    def close() -> None:
        assert executor.submit(int).result() == 0
        executor.shutdown(cancel_futures=True)

    return lambda: executor.submit(int).result(), close


OF = {"recording": of_recording, "dashboard": of_dashboard, "CAN link": of_can_link, "executor": of_an_executor}


def main(name: str, folder: str) -> None:
    """See the module."""
    action, close = OF[name](Path(folder))
    with none_dropped() if name == "executor" else nullcontext():
        often_interrupt(action, 600)
    close()


if __name__ == "__main__":
    main(*sys.argv[1:])
