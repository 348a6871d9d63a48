"""A file becomes a run: opened, mapped, gone through once, and written whole or not at all."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.errors import BenchError
from bench.files import check_output
from bench.importer import convert
from bench.importer.mapping import Mapping as Mapped
from bench.importer.plan import AS_SECONDS, Plan, plan
from bench.importer.source import Apart, Source
from bench.importer.survey import Progress, Survey, survey
from bench.record.info import RunInfo
from bench.record.writer import whole_run
from bench.signal.capture import Capture
from bench.signal.chunks import LostStretches, join, no_edge_stream, no_edges
from protocol import __version__
from protocol.streams import EdgeChunk, SampleChunk
from protocol.text import counted

SPARSE = 0.2
"""Share of rows in which a value is missing, from which on it is a series of its own."""
LEGAL = 0.9
"""Share of changes that go to a neighbouring sector, below which it is said that the inputs may be other ones."""


@dataclass(frozen=True)
class Prepared:
    """What will be made of a file."""

    source: Source
    plan: Plan
    seen: Survey
    when: convert.Timing
    mapping: Mapped

    @property
    def edge_step(self) -> float:
        """s by which the time of a Hall edge may be late; 0 without Hall inputs."""
        tables = {self.plan.tables[table] for table, _ in self.plan.lines}
        return max(
            (self.seen.clocks[one.name].period if not one.held else 1.0) / self.seen.tick_hz for one in tables
        ) if tables else 0.0  # fmt: skip

    @property
    def notes(self) -> list[str]:
        """What a reader has to know."""
        return [*self.plan.notes, *self._clock(), *self._values(), *self._hall(), *self._left_out()]

    def _clock(self) -> Iterator[str]:
        when, seen = self.when, self.seen
        if when.rate == 1.0 and any(AS_SECONDS in note for note in self.plan.notes):
            yield "warning: the time goes up by 1 from row to row: if it counts rows, give --time '' and --rate HZ"
        if when.main is not None:
            clock = seen.clocks[when.main]
            jitter = clock.jitter / clock.period
            words = f"samples are the rows{f' of {when.main}' if when.main else ''}, {when.rate:.6g} a second"
            words += f", every {when.every}th, edges of all" if when.every > 1 else ""
            yield words + (f"; their times scatter by {jitter:.1%} of that" if jitter > 0.01 else "")
        else:
            held = any(not self.plan.tables[name].held for name in seen.clocks)
            rule = "interpolated linearly, angles the short way round" if held else "as the lines stood"
            yield f"samples are made at {when.rate:.6g} a second, {rule}"
        if self.plan.lines:
            exact = all(self.plan.tables[table].held for table, _ in self.plan.lines)
            yield f"Hall edges are known to {'the digits of their times' if exact else seconds(self.edge_step)}"

    def _values(self) -> Iterator[str]:
        for one in self.plan.inputs:
            values = self.seen.values[one.table, one.column]
            if not values.n - values.missing:
                yield f"{one.column} has no number at all"
            elif values.constant and not one.own:
                yield f"{one.column}, which becomes {one.name}, is always {values.least:g}"
            elif values.missing:
                yield f"{one.column}: {values.missing} of {values.n} values are missing"

    def _hall(self) -> Iterator[str]:
        changes = self.seen.sectors + self.seen.leaps
        if not self.plan.lines:
            yield "no Hall inputs: nothing can be said of Hall sensors"
        elif self.seen.leaps and self.seen.sectors < LEGAL * changes:
            named = ", ".join(column for _, column in self.plan.lines)
            yield (
                f"warning: {self.seen.leaps} of {changes} changes of the Hall code do not go to a neighbouring sector: "
                f"are {named} the inputs of sensors a, b, c?"
            )

    def _left_out(self) -> Iterator[str]:
        words = list(dict.fromkeys([*self.plan.left_out, *self.source.left_out]))  # some is known once it was read
        if words:
            more = f" and {len(words) - 5} more" if len(words) > 5 else ""
            yield f"left out: {'; '.join(words[:5])}{more}"


@dataclass(frozen=True)
class Imported:
    """What became of a file."""

    path: Path
    samples: int
    edges: int
    gaps: int
    seconds: float
    rate: float
    channels: tuple[str, ...]
    rejected: Mapping[str, int]
    notes: tuple[str, ...]


def prepare(
    source: Source, mapping: Mapped, guessed: Collection[str] = (), progress: Progress = lambda _: None
) -> Prepared:
    """Look at a file by a mapping, of which channels were `guessed`. Raises BenchError for what does not fit."""
    planned = plan(source, mapping, guessed)
    seen = survey(source, planned, progress)
    if sparse := _sparse(planned, seen):
        source = Apart(source, sparse)
        planned = plan(source, mapping, guessed)
        seen = survey(source, planned, progress)
    planned = seen.pole_pairs(planned).electrical()
    return Prepared(source, planned, seen, convert.timing(source, planned, seen, mapping.time.rate_hz), mapping)


def _sparse(planned: Plan, seen: Survey) -> list[tuple[str, str]]:
    """Table and column of those with a value in some rows only: a series each, as PlotJuggler writes them."""
    sparse = [
        place for place in {(one.table, one.column): None for one in planned.inputs}
        if (values := seen.values[place]).missing > SPARSE * values.n and values.n - values.missing > 1
        and place not in planned.lines
    ]  # fmt: skip
    return sparse if any(planned.tables[table].time for table, _ in sparse) else []


def write(
    prepared: Prepared, path: Path, out: Path, overwrite: bool = False, progress: Progress = lambda _: None
) -> Imported:
    """Write what was prepared of the file `path` to the run `out`, which appears when it is whole.

    Raises BenchError.
    """
    check_output(out, f"--out {out}", overwrite, recording=True)
    converter = convert.Converter(prepared.source, prepared.plan, prepared.seen, prepared.when)
    notes = prepared.notes
    info = _info(prepared, converter, path, notes)
    first = last = None
    with whole_run(out, info, overwrite) as writer:
        for chunk in converter.chunks(progress):
            writer.take(chunk)
            first = int(chunk.tick[0]) if first is None else min(first, int(chunk.tick[0]))
            last = int(chunk.tick[-1]) if last is None else max(last, int(chunk.tick[-1]))
        if not converter.samples or first is None or last is None:
            raise BenchError(f"{path}: no row has all that a sample needs: {_why(converter.rejected.counts)}")
    return Imported(
        out, converter.samples, converter.edges, converter.gaps, (last - first) / prepared.seen.tick_hz,
        prepared.when.rate, tuple(channel.name for channel in converter.channels), converter.rejected.counts,
        tuple(notes),
    )  # fmt: skip


def seconds(value: float) -> str:
    """A time for people."""
    scale, unit = next((scale, unit) for scale, unit in ((1.0, "s"), (1e3, "ms"), (1e6, "us"), (1e9, "ns"))
                       if value * scale >= 1.0 or unit == "ns")  # fmt: skip
    return f"{value * scale:.4g} {unit}"


def _why(rejected: Mapping[str, int]) -> str:
    return ", ".join(f"{n} {why}" for why, n in rejected.items()) or "it is empty"


def _info(prepared: Prepared, converter: convert.Converter, path: Path, notes: Sequence[str]) -> RunInfo:
    when, plan = prepared.when, prepared.plan
    about = dict(prepared.source.about)
    identity = {
        "name": path.name, "imported": path.name, "format": prepared.source.format, "sha256": _digest(path),
        "hallbench": __version__, "mapping": prepared.mapping.model_dump(exclude_defaults=True),
        "time_0_s": prepared.seen.origin, "import_notes": list(notes),
        **({} if plan.lines else {"features": []}), **({"file": about} if about else {}),
    }  # fmt: skip
    return RunInfo(
        when.tick_hz, when.pwm_hz, converter.channels, _parameters(plan), identity,
        started=str(about.get("started", "")), edge_step=prepared.edge_step,
    )  # fmt: skip


def _digest(path: Path) -> str:
    with suppress(OSError), path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
    return ""


def as_json(done: Imported) -> dict[str, Any]:
    """The same as plain data."""
    return {
        "path": str(done.path), "samples": done.samples, "edges": done.edges, "gaps": done.gaps,
        "seconds": done.seconds, "rate_hz": done.rate, "channels": list(done.channels),
        "rejected": dict(done.rejected), "notes": list(done.notes),
    }  # fmt: skip


def rows(done: Imported) -> list[tuple[str, str]]:
    """The same as names and words."""
    shown = ", ".join(done.channels[:12]) + (f" and {len(done.channels) - 12} more" if len(done.channels) > 12 else "")
    return [
        ("samples", f"{done.samples} of {counted(len(done.channels), 'channel')}, {done.seconds:.3f} s: {shown}"),
        ("Hall edges", str(done.edges)),
        ("gaps", str(done.gaps)),
        ("rejected", ", ".join(f"{n} {why}" for why, n in done.rejected.items()) or "nothing"),
    ]


def capture_of(prepared: Prepared) -> Capture:
    """All of it in memory. Raises BenchError."""
    converter = convert.Converter(prepared.source, prepared.plan, prepared.seen, prepared.when)
    samples: list[SampleChunk] = []
    edges: list[EdgeChunk] = []
    for chunk in converter.chunks():
        if isinstance(chunk, SampleChunk):
            samples.append(chunk)
        else:
            edges.append(chunk)
    if not samples:
        raise BenchError(f"no row has all that a sample needs: {_why(converter.rejected.counts)}")
    config = converter.edge_config
    none = no_edges(config if prepared.plan.lines else no_edge_stream(config.node, config.tick_hz, config.pwm_hz))
    whole, changes = join(samples), join(edges) if edges else none
    stretches = LostStretches()
    lost = stretches.before(whole) + stretches.before(changes)
    return Capture(whole, changes, _parameters(prepared.plan), tuple(lost), edge_step=prepared.edge_step)


def _parameters(planned: Plan) -> dict[str, float]:
    return {} if planned.n_p is None else {"n_p": float(planned.n_p)}
