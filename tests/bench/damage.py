"""Damage done to recordings: a bit flipped or a file cut, anywhere, and whether a reader tells it."""

from __future__ import annotations

import random
import shutil
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from bench.record import layout
from bench.record.reader import NotARecordingError, Run
from bench.record.writer import RunWriter
from protocol.host import DeviceEventReceived
from protocol.streams import EdgeChunk, SampleChunk

_EDGES = ("tick", "hall_old", "hall_new", "illegal", "encoder")


@dataclass(frozen=True)
class Trial:
    """What became of one: `told` or not, and whether what is read is what was written, where it is read at all."""

    what: str
    told: bool
    same: bool


class Whole:
    """A run that is as it was written, to compare with."""

    def __init__(self, path: Path) -> None:
        self.path, self.run = path, Run(path)
        assert not self.run.damage

    @cached_property
    def chunks(self) -> dict[str, SampleChunk | EdgeChunk | None]:
        """Its streams."""
        return {name: self.run.chunk(name) for name in self.run.names}

    @cached_property
    def said(self) -> set[str]:
        """Everything in its log that is no sample."""
        return set(_said(self.run))

    def trial(self, dice: random.Random, folder: Path) -> Trial:
        """Damage a copy in `folder` at a place that `dice` choose, and read it."""
        copy = folder / "damaged.run"
        shutil.copytree(self.path, copy)
        try:
            file = dice.choice(sorted(file for file in copy.iterdir() if file.stat().st_size))
            what = f"{file.name}: {_damage(file, dice)}"
            try:
                run = Run(copy)
                found = {name: run.chunk(name) for name in run.names}
                for segment in run.segments:
                    list(segment.tables(layout.OVERVIEW))
            except NotARecordingError:
                return Trial(what, True, True)
            same = set(_said(run)) <= self.said and all(self._has(name, chunk) for name, chunk in found.items())
            cut = not run.ended and all(self._begins_with(name, chunk) for name, chunk in found.items())
            return Trial(what, bool(run.damage) or (cut and not self.run.ended) or run.ended < self.run.ended, same)
        finally:
            shutil.rmtree(copy)

    def _has(self, stream: str, chunk: SampleChunk | EdgeChunk | None) -> bool:
        """Whether each of these records is one of the run's."""
        if chunk is None:
            return True
        whole = self.chunks.get(stream)
        if whole is None:
            return False
        at = np.minimum(np.searchsorted(whole.index, chunk.index), len(whole) - 1)
        if not np.array_equal(whole.index[at], chunk.index) or not np.array_equal(whole.tick[at], chunk.tick):
            return False
        if isinstance(chunk, SampleChunk) and isinstance(whole, SampleChunk):
            return whole.raw[at].tobytes() == chunk.raw.tobytes()
        return all(np.array_equal(getattr(whole, name)[at], getattr(chunk, name)) for name in _EDGES)

    def _begins_with(self, stream: str, chunk: SampleChunk | EdgeChunk | None) -> bool:
        """Whether these records are the run's first: it was cut short, as a kill does, and says so."""
        whole = self.chunks.get(stream)
        return chunk is None or (whole is not None and np.array_equal(whole.index[: len(chunk)], chunk.index))


def _damage(file: Path, dice: random.Random) -> str:
    data = bytearray(file.read_bytes())
    at = dice.randrange(len(data))
    if dice.random() < 0.3:
        file.write_bytes(data[:at])
        return f"cut at byte {at} of {len(data)}"
    bit = dice.randrange(8)
    flip(file, at, bit)
    return f"bit {bit} of byte {at} of {len(data)} flipped"


def flip(file: Path, at: int, bit: int = 2) -> None:
    """Flip a bit of a byte; `at` counts from the end where it is negative."""
    data = bytearray(file.read_bytes())
    data[at] ^= 1 << bit
    file.write_bytes(data)


def _said(run: Run) -> list[str]:
    of: list[Any] = [
        *run.events,
        *run.heartbeats,
        *run.notes,
        *run.marks,
        *run.changes,
        *run.missing,
        run.info.to_json(),
    ]
    return [repr(each) for each in of] + ([run.summary] if run.summary else [])


def unfinished(run: Run, path: Path) -> Path:
    """The same run as a recorder leaves it that is killed before its end."""
    writer = RunWriter(path, run.info)
    for change in run.changes:
        writer.take(change)
    for event in run.events:
        writer.take(DeviceEventReceived(event.node, event))
    for mark in run.marks:
        writer.take(mark)
    names = sorted(run.names, key=lambda name: name != layout.EDGES)
    tick, last = run.span
    step = run.info.tick_hz // 50
    while tick <= last:
        for name in names:
            chunk = run.chunk(name, tick, tick + step - 1)
            if isinstance(chunk, SampleChunk) or chunk is not None:
                writer.take(chunk)
        tick += step
    writer.abandon()
    return path
