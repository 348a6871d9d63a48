"""Runs observers again on a recording and writes a new one: all that was recorded, and the host's estimates beside it.

Parameters are those that the drive had at each sample, as the recording tells, and what `settings` puts in their
place. Losses are those that the stream's own gaps tell. The input is never changed, nor copied: its files are linked.
The output appears, or replaces an earlier one, when it is whole.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from bench.errors import BenchError
from bench.files import RUN, check_output
from bench.record.extended import Extension
from bench.record.reader import Run
from bench.record.recording import readable
from bench.replay.augment import Augmenter
from bench.replay.estimators import INPUTS, all_for, done_without, entry_of, given, unfit
from bench.signal.capture import Capture
from bench.signal.chunks import streams_none
from bench.signal.parameters import course_of
from bench.view import markdown
from protocol import __version__
from protocol.signals import DRIVE_PARAMETERS, Flag
from protocol.streams import EdgeChunk, SampleChunk, StreamConfig
from sim.observers import sample
from sim.observers.catalogue import CATALOGUE
from sim.observers.entry import names as names_of

BEGAN = {
    "start": "at the start",
    "drive": "where the drive initialised them",
    "lost_samples": "after lost samples",
    "lost_edges": "after lost edges",
}
"""Why observers restarted, in words, by the keys of `Estimators.restarts`."""
ENDS_EARLY = "the recording ends early: it was interrupted, or is still being written"
OTHERS = 10.0
"""Times the largest value in the simulated drive that a parameter may have where the recording's drive has none."""
ALIASES = {"k_p": "k_p_vt", "k_i": "k_i_vt"}


@dataclass(frozen=True)
class Replayed:
    """What a replay came to. `restarts`: why and how often the observers began anew."""

    path: Path
    observers: tuple[str, ...]
    samples: int
    seconds: float
    """Length of the recording."""
    lost_samples: int
    lost_edges: int
    restarts: Mapping[str, int]
    left_out: tuple[str, ...]
    """Observers that the drive's parameters do not suffice for."""
    unknown: tuple[str, ...]
    """What is not known of the run, and what was done about it."""


def replay(
    path: Path,
    observers: Sequence[str] = (),
    settings: Mapping[str, float] | None = None,
    out: Path | None = None,
    overwrite: bool = False,
) -> Replayed:
    """Replay `path` with these observers (all of them if none is named) and write `out`.

    `settings` are drive parameters for the observers, by name and in their units, `k_p` and `k_i` those of the vector
    tracking. Raises BenchError for a recording that cannot be replayed, for an observer or a setting that does not
    exist or is out of range, where `out` exists (unless `overwrite`), and RecordingError where it cannot be written.
    """
    out = out or path.with_suffix(f".replay{RUN}")
    check_output(out, str(out), overwrite, recording=True)
    if out.exists() and out.samefile(path):
        raise BenchError(f"{out} is the recording itself: choose another name")
    names = tuple(dict.fromkeys(entry_of(name).name for name in observers))
    run = readable(path)
    config, edge_stream = run.drive_streams
    if why := not_replayable(config, edge_stream, names):
        raise BenchError(f"{path} cannot be replayed: {why}")
    values = checked_settings(settings or {}, names or tuple(CATALOGUE), run.info.parameters)
    parameters = run.parameters.fixed(values)
    left_out: tuple[str, ...] = ()
    if not names:
        names, lacking, unfed = all_for(parameters, config)
        left_out = (*lacking, *unfed)
        if not names:
            raise BenchError(f"{path} cannot be replayed: {lacking[0]}, which the drive does not have; use --set")
    augmenter = Augmenter(names, parameters, config)
    taken = {channel.name for channel in config.channels}
    if double := [channel.name for channel in augmenter.channels if channel.name in taken]:
        raise BenchError(f"{path} already has {double[0]}: replay the original recording")
    info = replace(
        run.info,
        channels=(*run.info.channels, *augmenter.channels),
        identity={**run.info.identity, "replayed": f"{path.name} by hallbench {__version__}", **_told(values)},
        recording_id=uuid4().hex,
    )
    counted = _Counted()

    def more(chunk: SampleChunk) -> list[NDArray[np.generic]]:
        counted.add(chunk)
        return augmenter.columns(chunk)

    def edges(chunk: EdgeChunk) -> None:
        counted.add(chunk)
        augmenter.take(chunk)

    def result() -> Replayed:
        if not counted.samples:
            raise BenchError(f"{path} has no samples to replay: {'; '.join(run.damage)}")
        return Replayed(
            path=out,
            observers=names,
            seconds=counted.samples / config.rate,
            **asdict(counted),
            restarts=augmenter.estimators.restarts,
            left_out=left_out,
            unknown=(*done_without(names, config), *_unknown(run)),
        )

    extension = Extension(run, out, info, overwrite, INPUTS)
    extension.write(more, edges, lambda: f"{run.summary}\n\n{as_markdown(result())}")
    return result()


@dataclass
class _Counted:
    """What went through a replay."""

    samples: int = 0
    lost_samples: int = 0
    lost_edges: int = 0

    def add(self, chunk: SampleChunk | EdgeChunk) -> None:
        lost = sum(gap.lost_samples for gap in chunk.gaps)
        if isinstance(chunk, SampleChunk):
            self.samples += len(chunk)
            self.lost_samples += lost
        else:
            self.lost_edges += lost


def estimate_capture(capture: Capture, observer: str, settings: Mapping[str, float]) -> Capture:
    """See `bench.estimate`."""
    name = entry_of(observer).name
    if why := not_replayable(capture.samples.config, capture.edges.config, [name]):
        raise BenchError(f"{name} cannot be run on this capture: {why}")
    parameters = course_of(capture.parameters).fixed(checked_settings(settings, [name], capture.parameters))
    augmenter = Augmenter([name], parameters, capture.samples.config)
    if double := [channel.name for channel in augmenter.channels if channel.name in capture]:
        raise BenchError(f"{double[0]} is already in this capture: use the original capture")
    augmenter.estimators.edges(capture.edges)
    return replace(capture, samples=augmenter.samples(capture.samples))


def not_replayable(samples: StreamConfig, edges: StreamConfig | None, names: Sequence[str] = ()) -> str:
    """Why these observers, or any, cannot be run on what these streams hold, in words; empty if they can."""
    whys = {name: unfit(samples, CATALOGUE[name].needs.required) for name in names} or {"": unfit(samples)}
    for name, why in whys.items():
        if why:
            return f"{name}: {why}" if len(names) > 1 else why
    return "it has no Hall edges" if edges is None or streams_none(edges) else ""


def checked_settings(
    settings: Mapping[str, float], observers: Sequence[str], recorded: Mapping[str, float]
) -> dict[str, float]:
    """`settings` by the parameters' full names. BenchError for what none of the observers has, or is out of range."""
    used = set(names_of(sample.Settings)).union(*(entry_of(name).parameters for name in observers))
    known = {parameter.name: parameter for parameter in DRIVE_PARAMETERS}
    checked: dict[str, float] = {}
    for named, value in settings.items():
        name = ALIASES.get(named, named)
        if name not in used:
            exists = name in known or name in recorded
            why = f"changes nothing in {', '.join(observers)}" if exists else "is no parameter"
            raise BenchError(f"{named}: it {why}; available: {', '.join(sorted(used))}")
        if name in known:
            limits = known[name]
            hi = limits.hi * (1.0 if name in recorded else OTHERS)
            if not limits.lo <= value <= hi:
                raise BenchError(f"{named}: must be {limits.lo:g}..{hi:g}, got {value:g}")
            if limits.flags & Flag.WHOLE and value != int(value):
                raise BenchError(f"{named}: must be a whole number, got {value:g}")
        if name in checked:
            raise BenchError(f"{named}: {name} is already set: use only one of its two names")
        checked[name] = value
    return checked


def rows(result: Replayed) -> list[list[str]]:
    """The figures of a replay as pairs of name and text."""
    began = ", ".join(f"{n} {BEGAN[why]}" for why, n in result.restarts.items() if n)
    return [
        ["observers", ", ".join(result.observers)],
        ["samples", f"{result.samples}, {result.seconds:.1f} s"],
        ["lost in the recording", f"{result.lost_samples} samples, {result.lost_edges} edges"],
        ["observers restarted", began],
        *(["not run", words] for words in result.left_out),
        *(["unknown", words] for words in result.unknown),
    ]


def as_json(result: Replayed) -> dict[str, Any]:
    """The same as plain data."""
    return asdict(result) | {"path": str(result.path)}


def as_markdown(result: Replayed) -> str:
    """The same as a markdown document."""
    return f"# Replay\n\n{markdown.table(('', ''), rows(result))}"


def _told(values: Mapping[str, float]) -> dict[str, str]:
    return {"replayed_with": ", ".join(f"{name}={value:g}" for name, value in values.items())} if values else {}


def _unknown(run: Run) -> tuple[str, ...]:
    names = {channel.name for channel in run.drive_streams[0].channels}
    missing = [name for name in INPUTS if name not in names]
    notes = [f"what followed the end: {ENDS_EARLY}"] if not run.ended else []
    notes += run.damage
    if told := sorted({change.name for change in run.changes if change.node == run.info.node and not change.exact}):
        notes.append(f"when exactly {', '.join(told)} changed: the drive does not tell it")
    if "status" in missing:
        notes.append("where the drive initialised its observers: no channel status")
    if ("i_q" in missing or "i_q_ref" in missing) and given(run.drive_streams[0]):
        notes.append("the current loop's error, taken as 0: no channels i_q, i_q_ref")
    return tuple(notes)
