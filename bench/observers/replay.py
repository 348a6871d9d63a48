"""Runs observers again on a recording and writes a new one: all that was recorded, and the host's estimates beside it.

Parameters are those that the recording began with, and what `settings` puts in their place: later changes are not in a
recording. The health counters of the drive's heartbeats are not in it either; losses are counted anew, from the
stream's own gaps. The input is never changed. The output appears, or replaces an earlier one, when it is whole.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

from bench.analysis.capture import Capture
from bench.analysis.chunks import part, streams_none
from bench.errors import BenchError
from bench.files import check_output, part_of
from bench.observers.augment import Augmenter
from bench.observers.estimators import INPUTS, all_for, entry_of, unfit
from bench.rerunio import markdown, schema
from bench.rerunio.recording import Run, capture_of, read_run
from bench.rerunio.salvage import ends_early
from bench.rerunio.sinks import FileSink
from protocol import __version__
from protocol.signals import DRIVE_PARAMETERS, Flag
from protocol.streams import EdgeChunk, SampleChunk
from sim.observers import sample
from sim.observers.catalogue import CATALOGUE
from sim.observers.entry import names as names_of

WINDOW = 0.2  # s of the recording handed on at a time: longer ones are quicker, but their files are larger
BEGAN = {
    "start": "at the start",
    "drive": "where the drive initialised them",
    "lost_samples": "after lost samples",
    "lost_edges": "after lost edges",
}
"""Why observers began anew, in words, by the keys of `Estimators.restarts`."""
ENDS_EARLY = "the recording ends early: it was cut short, or is still being written"
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
    out = out or path.with_suffix(".replay.rrd")
    check_output(out, str(out), overwrite, recording=True)
    if out.exists() and out.samefile(path):
        raise BenchError(f"{out} is the recording itself: choose another name")
    if out.exists() and not out.is_file():
        raise BenchError(f"{out} is no file that can be replaced: choose another name")
    names = tuple(dict.fromkeys(entry_of(name).name for name in observers))
    run = readable_run(path)
    if why := not_replayable(capture_of(run)):
        raise BenchError(f"{path} cannot be replayed: {why}")
    values = checked_settings(settings or {}, names or tuple(CATALOGUE), run.info.parameters)
    parameters = {**run.info.parameters, **values}
    left_out: tuple[str, ...] = ()
    if not names:
        names, left_out = all_for(parameters)
        if not names:
            raise BenchError(f"{path} cannot be replayed: {left_out[0]}, which the drive does not tell: --set it")
    augmenter = Augmenter(names, parameters, run.samples.config)
    taken = {channel.name for channel in run.samples.config.channels}
    if double := [channel.name for channel in augmenter.channels if channel.name in taken]:
        raise BenchError(f"{path} has {double[0]} already: replay the recording that it was made from")
    info = replace(
        run.info,
        channels=(*run.info.channels, *augmenter.channels),
        identity={**run.info.identity, "replayed": f"{path.name} by hallbench {__version__}", **_told(values)},
        recording_id=uuid4().hex,
    )
    whole = out.resolve()
    part_file = part_of(whole)
    sink = FileSink(part_file, info, wait=True)
    try:
        _feed(run, augmenter, sink)
        result = Replayed(
            path=out,
            observers=names,
            samples=len(run.samples),
            seconds=len(run.samples) / run.info.pwm_hz,
            lost_samples=sum(gap.lost_samples for gap in run.samples.gaps),
            lost_edges=sum(gap.lost_samples for gap in run.edges.gaps),
            restarts=augmenter.estimators.restarts,
            left_out=left_out,
            unknown=_unknown(run),
        )
        sink.summary(f"{run.summary}\n\n{as_markdown(result)}")
        sink.close()
        part_file.replace(whole)
    except BaseException:
        with suppress(BenchError):
            sink.close()
        part_file.unlink(missing_ok=True)
        raise
    return result


def estimate_capture(capture: Capture, observer: str, settings: Mapping[str, float]) -> Capture:
    """See `bench.estimate`."""
    name = entry_of(observer).name
    if why := not_replayable(capture):
        raise BenchError(f"{name} cannot be run on this capture: {why}")
    parameters = {**capture.parameters, **checked_settings(settings, [name], capture.parameters)}
    augmenter = Augmenter([name], parameters, capture.samples.config)
    if double := [channel.name for channel in augmenter.channels if channel.name in capture]:
        raise BenchError(f"{double[0]} is in this capture already: estimate from the one that it was made of")
    augmenter.estimators.edges(capture.edges)
    return replace(capture, samples=augmenter.samples(capture.samples))


def readable_run(path: Path) -> Run:
    """Read a recording with samples of the drive and one clock. BenchError says why it is none."""
    run = read_run(path)
    if schema.FAST not in run.streams or not len(run.samples):
        raise BenchError(f"{path} holds no samples of the drive")
    chunks: list[SampleChunk | EdgeChunk] = [*run.streams.values(), *run.edge_streams.values()]
    for chunk in chunks:
        if len(back := np.flatnonzero(np.diff(chunk.tick) < 0)):
            at = chunk.tick[back[0]] / run.info.tick_hz
            raise BenchError(f"{path}: the drive's clock went back at {at:.3f} s, so it has rebooted in the run")
    return run


def not_replayable(capture: Capture) -> str:
    """Why observers cannot be run on a capture, in words; empty if they can."""
    return unfit(capture.samples.config) or ("it has no Hall edges" if streams_none(capture.edges.config) else "")


def checked_settings(
    settings: Mapping[str, float], observers: Sequence[str], recorded: Mapping[str, float]
) -> dict[str, float]:
    """`settings` by the parameters' full names. BenchError for what none of the observers has, or is out of range."""
    used = set(names_of(sample.Settings)).union(*(entry_of(name).parameters for name in observers))
    known = {parameter.name: parameter for parameter in DRIVE_PARAMETERS}
    checked: dict[str, float] = {}
    for given, value in settings.items():
        name = ALIASES.get(given, given)
        if name not in used:
            exists = name in known or name in recorded
            why = f"changes nothing in {', '.join(observers)}" if exists else "is no parameter"
            raise BenchError(f"{given}: it {why}; there are {', '.join(sorted(used))}")
        if name in known:
            limits = known[name]
            if not limits.lo <= value <= limits.hi:
                raise BenchError(f"{given}: must be {limits.lo:g}..{limits.hi:g}, got {value:g}")
            if limits.flags & Flag.WHOLE and value != int(value):
                raise BenchError(f"{given}: must be a whole number, got {value:g}")
        if name in checked:
            raise BenchError(f"{given}: {name} is set already: give one of the two names")
        checked[name] = value
    return checked


def rows(result: Replayed) -> list[list[str]]:
    """The figures of a replay as pairs of name and text."""
    began = ", ".join(f"{n} {BEGAN[why]}" for why, n in result.restarts.items() if n)
    return [
        ["observers", ", ".join(result.observers)],
        ["samples", f"{result.samples}, {result.seconds:.1f} s"],
        ["lost in the recording", f"{result.lost_samples} samples, {result.lost_edges} edges"],
        ["observers began anew", began],
        *(["left out", words] for words in result.left_out),
        *(["not known", words] for words in result.unknown),
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
    names = {channel.name for channel in run.samples.config.channels}
    missing = [name for name in INPUTS if name not in names]
    notes = [f"what came after its end: {ENDS_EARLY}"] if ends_early(run.path) else []
    notes.append("parameters that were changed during the run: those of its beginning hold")
    if "status" in missing:
        notes.append("where the drive initialised its observers: no channel status")
    if "i_q" in missing or "i_q_ref" in missing:
        notes.append("the current loop's error, taken as 0: no channels i_q, i_q_ref")
    return tuple(notes)


def _feed(run: Run, augmenter: Augmenter, sink: FileSink) -> None:
    """Hand everything on in the order in which it happened, `WINDOW` at a time: edges before their samples."""
    streams: list[SampleChunk | EdgeChunk] = [*run.edge_streams.values(), *run.streams.values()]
    first = min(int(chunk.tick[0]) for chunk in streams if len(chunk))
    last = max(int(chunk.tick[-1]) for chunk in streams if len(chunk))
    bounds = np.append(np.arange(first, last, round(WINDOW * run.info.tick_hz))[1:], last + 1)
    events = sorted(run.events, key=lambda event: event.tick)
    sent = 0
    ends = [np.searchsorted(chunk.tick, bounds) for chunk in streams]
    for k, bound in enumerate(bounds):
        final = k + 1 == len(bounds)
        for chunk, end in zip(streams, ends, strict=True):
            begin = int(end[k - 1]) if k else 0
            if begin < end[k]:
                piece = augmenter.take(part(chunk, begin, int(end[k])))
                if isinstance(piece, EdgeChunk):
                    sink.edges(piece)
                else:
                    sink.samples(piece)
        while sent < len(events) and (final or events[sent].tick < bound):
            sink.event(events[sent].node, events[sent])
            sent += 1
    for mark in run.marks:
        sink.mark(mark.name, mark.first_tick, mark.last_tick, mark.verdict)
    ours = {(mark.first_tick, f"{mark.verdict} {mark.name}, ") for mark in run.marks}
    for (tick, text), level in zip(run.notes, run.levels, strict=True):
        if not any(tick == at and text.startswith(begin) for at, begin in ours):  # `mark` writes its own
            sink.note(text, level, tick)
