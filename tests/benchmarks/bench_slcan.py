"""slcan: how quick its text is on one core, and what reading a busy CAN FD bus over a pty costs and loses.

python -m tests.benchmarks slcan

The adapter is the emulated one in a process of its own, paced by the clock; what the pty does not take in time is lost,
as in an adapter whose host does not read. Each reader is a process that only reads: ours as records and as messages,
and python-can's own slcan.
"""

from __future__ import annotations

import multiprocessing
import select
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection

import can
import numpy as np
from can.interfaces.slcan import slcanBus
from numpy.typing import NDArray

from protocol.canmap.frame import BRS, CAN_RECORD, FDF, RECORD_BYTES, BusRates
from protocol.canmap.slcan import SlcanParser, encode
from protocol.links.slcan_bus import SlcanBus
from sim.ports.slcan_port import SlcanPort
from tests.benchmarks.table import Quickest, Row, cost, speed

FEED = 8192  # bytes
FRAMES = 50_000
RATE = 5000  # frames/s: a bus at 1 and 5 Mbit/s is full at about 5400 frames of 64 bytes
TICK = 0.001  # s between the adapter's writes
BURST = 20  # most frames in one of them: an adapter that had to wait catches up without flooding the pty
SETTLE = 0.005  # s
SILENCE = 1.0  # s after which a reader has seen the last frame
CPU_GOAL = 40.0  # % of a core

Receive = Callable[[float], int]  # waits so many s; returns how many frames came

GO = can.Message(arbitration_id=1, is_extended_id=False)


def frames(n: int, length: int, flags: int) -> NDArray[np.void]:
    """Return n frames of random data."""
    rng = np.random.default_rng(0)
    records = np.zeros(n, CAN_RECORD)
    records["id"] = rng.integers(0, 0x800, n)
    records["length"], records["flags"] = length, flags
    records["data"][:, :length] = rng.integers(0, 256, (n, length))
    return records


def text_speed(records: NDArray[np.void], repeat: int) -> tuple[float, float]:
    """Return frames/s of the parser and of the encoder, in pieces of `FEED` bytes; the best of `repeat` runs."""
    text = encode(records)
    per_feed = len(records) * FEED // len(text)
    pieces = [text[k : k + FEED] for k in range(0, len(text), FEED)]
    groups = [records[k : k + per_feed] for k in range(0, len(records), per_feed)]
    best = Quickest()
    for _ in range(repeat):
        parser = SlcanParser()
        with best.timed("parse"):
            parsed = [parser.feed(piece, 0.0) for piece in pieces]
        assert (np.concatenate(parsed) == records).all()
        with best.timed("write"):
            lines = [encode(group) for group in groups]
        assert b"".join(lines) == text
    return len(records) / best["parse"], len(records) / best["write"]


def be_adapter(results: Connection, seconds: float) -> None:
    """Serve one host: once it has sent a frame, write `RATE` frames/s; then tell how many there were."""
    port = SlcanPort(None, BusRates(1_000_000, 5_000_000))
    results.send(port.target.removeprefix("can:slcan/").partition("?")[0])
    while not port.read():
        select.select(port.read_fds(), [], [], 1.0)
    records = frames(RATE, 64, FDF | BRS)
    start, written, total = time.monotonic(), 0, int(RATE * seconds)
    while written < total:
        time.sleep(TICK)
        due = min(int((time.monotonic() - start) * RATE), written + BURST, total)
        port.write(records[np.arange(written, due) % RATE].tobytes())
        written = due
    results.send(total)
    results.recv()  # the reader has finished
    port.unplug()


def read_records(path: str) -> tuple[can.BusABC, Receive]:
    """Our bus, as `CanLink` reads it."""
    bus = SlcanBus(path, bitrate=1_000_000, data_bitrate=5_000_000)
    return bus, lambda timeout: len(bus.recv_records(timeout, SETTLE)) // RECORD_BYTES


def read_messages(path: str) -> tuple[can.BusABC, Receive]:
    """Our bus, as any program that uses python-can reads it."""
    bus = SlcanBus(path, bitrate=1_000_000, data_bitrate=5_000_000)
    return bus, lambda timeout: bus.recv(timeout) is not None


def read_python_can(path: str) -> tuple[can.BusABC, Receive]:
    """Its own slcan."""
    bus = slcanBus(path, bitrate=1_000_000, sleep_after_open=0)
    return bus, lambda timeout: bus.recv(timeout) is not None


def be_reader(results: Connection, path: str, reader: Callable[[str], tuple[can.BusABC, Receive]]) -> None:
    """Read until there is silence; tell what came of it, times between the first frame and the last."""
    bus, receive = reader(path)
    bus.send(GO)
    count = receive(10.0)
    started = ended = (time.monotonic(), time.process_time())
    pause = 0.0
    while more := receive(SILENCE):
        now = (time.monotonic(), time.process_time())
        pause = max(pause, now[0] - ended[0])
        count, ended = count + more, now
    bus.shutdown()
    results.send((count, 100 * (ended[1] - started[1]) / (ended[0] - started[0]), 1e3 * pause))


def read_for(seconds: float, reader: Callable[[str], tuple[can.BusABC, Receive]]) -> tuple[int, float, float]:
    """Return how many frames a reader lost, its % of a core, and its longest time without a frame in ms."""
    context = multiprocessing.get_context("spawn")
    ours, adapters = context.Pipe()
    mine, readers = context.Pipe()
    adapter = context.Process(target=be_adapter, args=(adapters, seconds))
    adapter.start()
    process = context.Process(target=be_reader, args=(readers, ours.recv(), reader))
    process.start()
    total = ours.recv()
    count, cpu, pause = mine.recv()
    ours.send(None)
    process.join()
    adapter.join()
    return total - count, cpu, pause


def rows(short: bool) -> Iterator[Row]:
    """The figures; each reader runs for a minute."""
    seconds, n, repeat = (1.0, 1_000, 1) if short else (60.0, FRAMES, 5)
    for bus, length, flags, goal in (("CAN FD", 64, FDF | BRS, 300), ("classic", 8, 0, 500)):
        parse, write = text_speed(frames(n, length, flags), repeat)
        yield speed(f"parser, {bus} with {length} B, feeds of {FEED // 1024} KiB", parse / 1e3, "k frames/s", goal)
        yield speed(f"encoder, {bus} with {length} B", write / 1e3, "k frames/s", goal)
    for name, reader, is_ours in (
        ("records", read_records, True),
        ("messages", read_messages, True),
        ("python-can's slcan", read_python_can, False),
    ):
        lost, cpu, pause = read_for(seconds, reader)
        what = f"{name}, {RATE} FD frames/s of 64 B"
        yield Row(f"{what}: lost of {int(RATE * seconds)}", lost, "", 0 if is_ours else None, at_most=True)
        yield cost(f"{what}: reader", cpu, "% of a core", CPU_GOAL if is_ours else None)
        yield Row(f"{what}: longest silence", pause, "ms", at_most=True)
