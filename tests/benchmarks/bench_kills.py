"""`bench live` killed, stopped or told to end at random moments, while the motor turns and a file is written.

The simulated drive is another process, and a proxy between the two sees what the drive had sent by the time of the
signal, and what it says afterwards: when its outputs went off is measured by the drive, in its own ticks.

python -m tests.benchmarks kills
"""

from __future__ import annotations

import random
import re
import select
import signal
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

from bench.record.folder import remove
from bench.record.reader import Run
from protocol.framing import Deframer, parse_frame
from protocol.links.target import split_host_port
from protocol.messages import Heartbeat, MessageType
from protocol.streams import STREAM_HEADER
from tests.bench.processes import Program, Sim
from tests.benchmarks.table import Row

SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGSTOP)
WATCHDOG = 0.5  # s; other programs may want the machine
LATEST = 2.0  # s after the first sample
DURATION = 6.0  # s of a run that goes on: one that was stopped, and has tripped
WITHIN = 60.0  # s for whatever is awaited
SHORT = 0.1  # s that a recording may lack
_OFF = r"outputs off(?: (\d+) ms after the last ALIVE)?: (\w+) \(node 1"


class Proxy:
    """Passes bytes between one host at a time and a drive behind TCP. The drive's side stays when the host has gone."""

    def __init__(self, target: str) -> None:
        self._drive_at = split_host_port(target.removeprefix("tcp:"))
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.target = f"tcp:127.0.0.1:{self._listener.getsockname()[1]}"
        self.last_tick = -1  # of the last sample that the drive sent, node 1; low 32 bits
        self.heartbeat: Heartbeat | None = None  # the drive's last
        self._leave = threading.Event()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def leave(self) -> None:
        """Let go of the drive, for the next host."""
        self._leave.set()

    def close(self) -> None:
        """End."""
        self._end.set()
        self._thread.join()
        self._listener.close()

    def _run(self) -> None:
        while not self._end.is_set():
            if select.select([self._listener], [], [], 0.02)[0]:
                with self._listener.accept()[0] as host, socket.create_connection(self._drive_at) as drive:
                    self._carry(host, drive)

    def _carry(self, host: socket.socket, drive: socket.socket) -> None:
        self._leave.clear()
        self.last_tick, self.heartbeat = -1, None
        deframer = Deframer()
        waiting, there = bytearray(), True
        host.setblocking(False)
        while not (self._end.is_set() or self._leave.is_set()):
            ready = select.select([drive, *([host] if there else [])], [host] if there and waiting else [], [], 0.02)
            if drive in ready[0]:
                data = drive.recv(1 << 16)
                if not data:
                    return
                for raw in deframer.feed(data):
                    self._look(raw)
                waiting += data
            try:
                if waiting and there:
                    del waiting[: host.send(waiting)]
                if host in ready[0]:
                    data = host.recv(1 << 16)
                    there = bool(data)
                    drive.sendall(data)
            except BlockingIOError:
                pass
            except OSError:
                there = False

    def _look(self, raw: bytes) -> None:
        frame = parse_frame(raw)
        if frame.node == 1 and frame.type == MessageType.HEARTBEAT:
            self.heartbeat = Heartbeat.unpack(frame.payload)
        elif frame.node == 1 and frame.type == MessageType.DATA:
            self.last_tick = STREAM_HEADER.unpack_from(frame.payload)[-1]  # of its first sample: 20 ms at most


@dataclass(frozen=True)
class Kill:
    """What came of one signal."""

    number: signal.Signals
    moment: float  # s after the first sample
    off: str  # why the outputs went off, as the drive says it: STOP, or its watchdog
    unfed: float  # s from the last ALIVE until the watchdog switched off; 0 after a STOP
    outputs_on: bool  # what the drive's last heartbeat says
    short: float  # s of samples that the drive had sent by then and the recording lacks
    code: int
    result: str  # that of the summary; empty where there is none


def kill(number: signal.Signals, moment: float, sim: Sim, proxy: Proxy, file: Path) -> Kill:
    """Start `bench live`, send it a signal `moment` s after the motor has been started, look what became of it all."""
    said = len(sim.out)
    live = Program(
        "bench", "live", proxy.target, "--speed", "300", "--viewer", "none", "--yes", "--clear-faults",
        "--save", str(file), "--duration", str(DURATION),
    )  # fmt: skip
    try:
        sim.line(r"outputs on \(node 1", said)
        _until(lambda: proxy.last_tick >= 0, "a sample")
        time.sleep(moment)
        sent = proxy.last_tick
        live.send(number)
        off = sim.line(_OFF, said)
        if number == signal.SIGSTOP:
            live.send(signal.SIGCONT)
        code = live.end()
        _until(lambda: proxy.heartbeat is not None and not proxy.heartbeat.outputs_on, "outputs off in a heartbeat")
        assert proxy.heartbeat is not None
        recorded = Run(file)
        lacking = (sent - int(recorded.samples.tick[-1])) % (1 << 32)
        lacking -= (1 << 32) if lacking >= 1 << 31 else 0
        return Kill(
            number,
            moment,
            off[2],
            int(off[1] or 0) / 1000,
            proxy.heartbeat.outputs_on,
            max(0.0, lacking / recorded.info.tick_hz),
            code,
            next((match[1] for line in live.out if (match := re.match(r"  result  +(.*)", line))), ""),
        )
    finally:
        live.close()
        proxy.leave()


def _until(condition: Callable[[], bool], what: str) -> None:
    end = time.monotonic() + WITHIN
    while not condition():
        assert time.monotonic() < end, f"no {what} within {WITHIN:g} s"
        time.sleep(0.005)


@contextmanager
def drive() -> Iterator[tuple[Sim, Proxy]]:
    """A simulated drive of its own, and the proxy before it."""
    settings = (word for node in ("firmware", "load") for word in ("--set", f"{node}.watchdog={WATCHDOG}"))
    with closing(Sim("--tcp", "127.0.0.1:0", *settings)) as sim, closing(Proxy(sim.target)) as proxy:
        yield sim, proxy


def kills(times: int, seed: int = 1) -> Iterator[Kill]:
    """That many, the signals in turn, at random moments."""
    moments = random.Random(seed)
    with drive() as (sim, proxy), tempfile.TemporaryDirectory() as folder:
        for n in range(times):
            file = Path(folder, f"{n}.run")
            yield kill(SIGNALS[n % len(SIGNALS)], moments.uniform(0.0, LATEST), sim, proxy, file)
            remove(file)


def rows(short: bool) -> list[Row]:
    """The worst of all."""
    times = len(SIGNALS) if short else 100
    found = []
    for each in kills(times):
        found.append(each)
        print(
            f"  {len(found):3} {each.number.name:8} {each.moment:5.3f} s: outputs off by {each.off} "
            f"({each.unfed:.3f} s unfed), {each.short * 1000:.1f} ms not recorded, exit code {each.code} {each.result}"
        )
    return [
        Row(
            f"kills, of {times}, with outputs on afterwards",
            sum(each.outputs_on for each in found),
            "",
            0,
            at_most=True,
        ),
        Row("longest without ALIVE until outputs off", max(each.unfed for each in found), "s", WATCHDOG + 0.002, True),
        Row("most that a recording lacks", max(each.short for each in found), "s", SHORT, at_most=True),
    ]
