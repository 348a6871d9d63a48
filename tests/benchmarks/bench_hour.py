"""An hour, recorded live.

`python -m tests.benchmarks hour`. It is recorded over TCP: a pty holds but 4 kB, which is 6 ms of what comes.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from threading import Thread

from bench.record.reader import Run
from tests.bench.processes import Sim
from tests.benchmarks.bench_live import account
from tests.benchmarks.memory import FLAT, MB, Memory
from tests.benchmarks.table import Row, cost

DISK = 0.25  # MB/s
CPU = 10.0  # % of a core
WARM = 120.0  # s after which memory is looked at: everything has been imported, two segments have ended


def hour(seconds: float, warm: float, folder: Path) -> Iterator[Row]:
    """The hour, live, recorded to `folder`."""
    file = folder / "hour.run"
    with closing(Sim("--tcp", "127.0.0.1:0")) as sim:
        command = [
            sys.executable, "-m", "bench", "live", sim.target, "--yes", "--viewer", "none", "--speed", "1000",
            "--duration", f"{seconds:g}", "--save", str(file), "--json", "-",
        ]  # fmt: skip
        live = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        said: list[str] = []
        listener = Thread(target=_listen, args=(live, said))
        with closing(Memory(live.pid)) as memory:
            listener.start()
            assert live.stdout is not None
            printed = live.stdout.read()
            listener.join()
            live.wait()
    if live.returncode:  # also where the motor did not turn for all of it
        raise RuntimeError(f"bench live: exit code {live.returncode}\n{''.join(said)}")
    summary = json.loads(printed)
    streamed = streamed_in_part(file)
    most, flat, slope = memory.after(warm)
    rate = summary["recording"]["bytes"] / summary["duration_s"]
    what = f"{seconds / 60:g} min live, {streamed} and edges"
    yield Row(f"{what}: samples", summary["samples"], "", round(0.999 * seconds * 16000))
    yield from account(summary)
    yield cost("host, recording", summary["cpu_percent"], "% of a core", CPU)
    yield Row(f"memory of the host from {warm:g} s on, most less least", flat, "MB", FLAT, at_most=True)
    yield Row("memory of the host, most", most, "MB", at_most=True)
    yield Row("memory of the host, growth by a straight line", slope, "MB/h", at_most=True)
    yield Row("disk", rate / MB, "MB/s", DISK, at_most=True)
    yield Row("a day on the disk, by arithmetic", rate * 86400 / 1e9, "GB", DISK * 86400 / 1e3, at_most=True)
    yield Row("sample to sink, p99", summary["latency_ms"]["p99"], "ms", at_most=True)


def _listen(live: subprocess.Popen[str], said: list[str]) -> None:
    """Take what it says into `said`, and end it when the drive trips: the rest would be of a motor that stands."""
    assert live.stderr is not None
    for line in live.stderr:
        said.append(line)
        if "tripped" in line:
            live.send_signal(signal.SIGINT)


def streamed_in_part(file: Path) -> str:
    """Channels and rate of a recording, without all of it."""
    run = Run(file)
    config = run.drive_streams[0]
    return f"{len(config.channels)} channels at {run.info.pwm_hz / config.decimation / 1000:g} kHz"


def rows(short: bool) -> Sequence[Row]:
    """The hour."""
    with tempfile.TemporaryDirectory() as name:
        return list(hour(4.0 if short else 3600.0, 1.0 if short else WARM, Path(name)))
