"""A long run, made of a kept one that is repeated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.record.reader import Run
from bench.record.writer import RunWriter
from bench.signal.chunks import part

KEPT = Path(__file__).parents[1] / "data"


def repeated(path: Path, times: int, kept: str = "reversal") -> Path:
    """The kept run one after the other, `times` times, with ticks and indices that go on."""
    run = Run(KEPT / f"{kept}.run")
    samples, edges = run.samples, run.edges
    step = int(samples.index[-1] - samples.index[0]) + 1
    ticks = step * samples.config.period_ticks
    edges = part(edges, 0, int(np.searchsorted(edges.tick, samples.tick[-1], "right")))
    writer = RunWriter(path, run.info)
    for k in range(times):
        shifted = edges.tick + k * ticks
        writer.take(replace(edges, index=edges.index + k * len(edges), tick=shifted, gaps=()))
        writer.take(replace(samples, index=samples.index + k * step, tick=samples.tick + k * ticks, gaps=()))
    writer.close()
    return path
