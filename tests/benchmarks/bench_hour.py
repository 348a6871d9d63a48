"""An hour, recorded live.

`python -m tests.benchmarks hour`. It is recorded over TCP: a pty holds but 4 kB, which is 6 ms of what comes.
"""

from __future__ import annotations

from collections.abc import Iterator

from tests.benchmarks.bench_live import account, run
from tests.benchmarks.memory import FLAT, MB
from tests.benchmarks.table import Row, cost

DISK = 0.25  # MB/s
CPU = 10.0  # % of a core
WARM = 120.0  # s after which memory is looked at: everything has been imported, two segments have ended


def rows(short: bool) -> Iterator[Row]:
    """The hour, live, recorded."""
    return recorded(*(4.0, 1.0) if short else (3600.0, WARM))


def recorded(seconds: float, warm: float) -> Iterator[Row]:
    """So many s, live, recorded; memory is looked at after `warm` s."""
    summary, streamed, _, _, memory = run(seconds, ["--tcp", "127.0.0.1:0"], ["--speed", "1000"])
    most, flat, slope = memory.after(warm)
    rate = summary["recording"]["bytes"] / summary["duration_s"]
    least = round(0.999 * seconds * 16000)
    yield Row(f"{seconds / 60:g} min live, {streamed} and edges: samples", summary["samples"], "", least)
    yield from account(summary)
    yield cost("host, recording", summary["cpu_percent"], "% of a core", CPU)
    yield Row(f"memory of the host from {warm:g} s on, most less least", flat, "MB", FLAT, at_most=True)
    yield Row("memory of the host, most", most, "MB", at_most=True)
    yield Row("memory of the host, growth by a straight line", slope, "MB/h", at_most=True)
    yield Row("disk", rate / MB, "MB/s", DISK, at_most=True)
    yield Row("a day on the disk, by arithmetic", rate * 86400 / 1e9, "GB", DISK * 86400 / 1e3, at_most=True)
    yield Row("sample to sink, p99", summary["latency_ms"]["p99"], "ms", at_most=True)
