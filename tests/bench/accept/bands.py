"""How the shipped suite measures our own drive: bands for each measurement, apart from any limit.

    python tests/bench/accept/bands.py     # measures anew and writes bands.toml

A value outside its band is a change of ours, better or worse, and no verdict on a drive. Who changes something on
purpose writes the bands anew and reads the difference.
"""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from unittest.mock import patch
from zlib import crc32

from bench.accept.accept import AcceptOptions, accept
from bench.cli.output import Progress

FILE = Path(__file__).with_name("bands.toml")
SEEDS = range(7)  # 0: the noise that a run has by itself
WIDER = 3.0, 0.1, 1e-2
"""What a band is wider than the values of `SEEDS`, either side: of their range, of the largest size, in the unit."""


def read() -> dict[str, tuple[float, float]]:
    """The bands by the measurements' full names."""
    return {name: (lo, hi) for name, (lo, hi) in tomllib.loads(FILE.read_text())["bands"].items()}


def measured(seed: int) -> dict[str, float]:
    """All that the shipped suite measures on the default drive with the noise of a seed."""
    with patch("bench.rig.connection.crc32", lambda test: crc32(test, seed)):
        run, _ = accept(AcceptOptions(target="sim"), Progress(status=False))
    return {m.name: m.value for m in run.measurements if m.value is not None}


def _band(values: list[float]) -> tuple[float, float]:
    lo, hi = min(values), max(values)
    share, size, least = WIDER
    more = share * (hi - lo) + size * max(abs(lo), abs(hi)) + least
    return _rounded(lo - more, math.floor), _rounded(hi + more, math.ceil)


def _rounded(value: float, way: object) -> float:
    """Three significant digits, outwards."""
    step = 10.0 ** (math.floor(math.log10(abs(value) or 1.0)) - 2)
    return round(way(value / step) * step, 9)  # type: ignore[operator]


def write() -> None:
    """Measure with each of `SEEDS` and write the file."""
    runs = [measured(seed) for seed in SEEDS]
    lines = [
        f"# Made by tests/bench/accept/bands.py with {len(runs)} seeds: what our own drive measures.",
        "[bands]",
    ]
    for name in runs[0]:
        lo, hi = _band([run[name] for run in runs])
        lines.append(f'"{name}" = [{lo!r}, {hi!r}]')
    FILE.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    write()
