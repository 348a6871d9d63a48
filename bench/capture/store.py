"""A capture as a run: samples, Hall edges, a mark at the trigger, and what it is in the run's description."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from bench.capture.decode import Captured
from bench.capture.memory import frozen_words
from bench.device.heard import Chunk, Note
from bench.record.info import CAPTURE, Mark, RunInfo
from bench.record.writer import whole_run
from bench.signal.chunks import BEGIN, between, part, streams_none
from protocol.codes import fault_names
from protocol.messages import CaptureTrigger

_PIECE = 1.0  # s that a reader of the run gets at once


def about(captured: Captured, trigger: str = "", pre: float | None = None) -> dict[str, Any]:
    """What tells which capture this is, as plain data; `trigger` and `pre` as it was asked for, if that is known."""
    status = captured.status
    share = status.before / (status.before + status.after)
    frozen = frozen_words(status)
    return {
        "trigger": trigger or frozen,
        "frozen_by": frozen if status.trigger == CaptureTrigger.FAULT else trigger or frozen,
        "pre": share if pre is None else pre, "before": status.first, "records": status.records,
        "decimation": status.decimation, "edges": status.edges, "edges_lost": status.edges_lost,
        "number": status.number, "boot_id": captured.boot_id, "crc": f"{status.crc:08x}", "bytes": status.size,
        "trigger_tick": status.tick, "faults": fault_names(status.faults),
    }  # fmt: skip


def store(captured: Captured, path: Path, info: RunInfo, told: dict[str, Any], overwrite: bool = False) -> None:
    """Write a capture to the run `path`, which appears when it is whole; `told` is what `about` gives.

    `info` is of the drive; its channels are replaced by those of the capture. Raises RecordingError.
    """
    status = captured.status
    info = replace(info, channels=captured.stream.channels, identity={**info.identity, CAPTURE: told})
    with whole_run(path, info, overwrite) as writer:
        for chunk in pieces(captured):
            writer.take(chunk)
        writer.take(Mark(f"trigger {told['trigger']}", status.tick, status.tick))
        if told["faults"]:
            writer.take(Note(status.tick, f"the drive tripped: {', '.join(told['faults'])}", "ERROR"))
        if captured.lost:
            writer.take(Note(status.tick, captured.lost, "WARN"))


def pieces(captured: Captured) -> Iterator[Chunk]:
    """A capture as chunks of a second, edges before the samples that they precede."""
    samples, edges = captured.samples, captured.edges
    step = max(1, round(_PIECE * captured.stream.rate))
    done = BEGIN
    for first in range(0, len(samples), step):
        piece = part(samples, first, min(first + step, len(samples)))
        last = int(piece.tick[-1])
        if not streams_none(edges.config) and len(near := between(edges, done + 1, last)):
            yield near
        done = last
        yield piece
