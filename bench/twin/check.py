"""`bench twin check`: a twin under the commands of a recording, and in what the two differ by more than noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.commission.window import Floats
from bench.compare.batches import SURE, VERDICT_WORDS, Batches, Difference, of_rms
from bench.compare.compare import WORDS, Row, error_rows, take
from bench.errors import BenchError
from bench.record.layout import EDGES, SAMPLES
from bench.record.reader import Run, captures
from bench.report.words import number
from bench.signal.batches import ROUNDING
from bench.signal.capture import Capture
from bench.signal.chunks import join
from bench.signal.position import position_errors, running
from bench.signal.verdict import Verdict
from bench.twin.commands import asked
from protocol.messages import DriveState
from protocol.signals import DRIVE_CHANNELS, Flag
from protocol.streams import SampleChunk
from sim.ports.followed import Asked, Follower

REPEATS = 3
"""Runs of a twin: where a rotor stands by chance when an observer is in trouble decides much."""
RUN_IN = 1.0
"""s that a twin turns at first, where the recording begins with a drive that runs."""
KNOWN = {channel.name for channel in DRIVE_CHANNELS}
SHOWN = 4000
"""Points of a channel that are kept to be drawn."""
HEADERS = ("quantity", "unit", "recorded", "twin", "differs by", "std. error", "")


@dataclass
class Checked:
    """What a twin does under the commands of a recording."""

    run: Path
    twin: Path
    rows: tuple[Row, ...] = ()
    edges: tuple[int, int] = (0, 0)
    """Hall edges, recorded and of the twin."""
    tripped: str = ""
    """What the twin's firmware switched off for."""
    remarks: list[str] = field(default_factory=list)
    traces: dict[str, tuple[Floats, Floats, Floats]] = field(default_factory=dict)
    """By channel: device time, recorded, twin, thinned out."""

    def __getitem__(self, name: str) -> Row:
        """A row by its name, such as `i_q, rms`; KeyError for none."""
        return {row.name: row for row in self.rows}[name]

    @property
    def differing(self) -> list[Row]:
        """Those that differ by more than noise."""
        return [row for row in self.rows if row.difference.verdict is Verdict.FAIL]

    def as_json(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "run": str(self.run), "twin": str(self.twin), "tripped": self.tripped or None, "remarks": self.remarks,
            "edges": {"recorded": self.edges[0], "twin": self.edges[1]},
            "rows": [
                {"quantity": row.name, "unit": row.unit, "recorded": row.difference.a, "twin": row.difference.b,
                 "relative": row.relative, "standard_error": row.difference.error,
                 "verdict": VERDICT_WORDS[row.difference.verdict], "why": row.difference.why or None}
                for row in self.rows
            ],
        }  # fmt: skip


def cells(row: Row) -> list[str]:
    """A row of the table."""
    of, share = row.difference, row.relative
    said = f"{100.0 * share:+.2g} %" if math.isfinite(share) else "–"
    both = [number(value, ".4g") for value in (of.a, of.b)]
    return [row.name, row.unit or "–", *both, said, number(of.error, ".2g"), of.words]


def check(run: Run, twin: Path, seed: int = 0, repeats: int = REPEATS) -> Checked:
    """Run the twin of the configuration file `twin` under the commands of a recording, so often with other noise.

    `seed` is that of the first. BenchError for a recording that does not tell its commands, or that has another PWM
    rate; ConfigError.
    """
    found = Checked(run.path, twin)
    channels = run.config(SAMPLES).channels
    names = [c.name for c in channels if c.name in KNOWN and c.name not in WORDS and not c.flags & Flag.WRAPS]
    errors = [name for name in run.info.position_estimates if run.info.position_reference and name in KNOWN]
    units = {c.name: c.unit.symbol for c in channels}
    several, edges = [], []
    for again in range(repeats):
        sums = [Batches(*run.span) for _ in range(2)]
        kept, follower = _run(run, twin, seed + again, sums, names, errors)
        rows = [Row(f"{name}, rms", units[name], of_rms(*(side.sums(name) for side in sums))) for name in names]
        several.append(rows + error_rows(sums, errors))
        edges.append(follower.edges)
        if not again:
            found.traces = _traces(kept)
            if "tau_load_true" not in units:
                found.remarks.append("no load was recorded: the twin has none")
        if follower.fault:
            found.tripped = follower.fault
            break
    found.rows = tuple(map(_pooled, zip(*several, strict=True)))
    found.edges = run.rows(EDGES) if EDGES in run.names else 0, round(sum(edges) / len(edges))
    return found


def _pooled(rows: Sequence[Row]) -> Row:
    """The mean of the twin's runs; what they differ by counts as noise, of the recording as well."""
    one, values = rows[0].difference, [row.difference.b for row in rows]
    mean = float(np.mean(values))
    spread = float(np.std(values, ddof=1)) * math.sqrt(1.0 + 1.0 / len(values)) if len(values) > 1 else 0.0
    error = math.hypot(max(row.difference.error for row in rows), spread)
    far = abs(mean - one.a) > SURE * error and abs(mean - one.a) > ROUNDING * abs(one.a)
    if all(row.difference.verdict is Verdict.INVALID for row in rows) and not (far and spread):
        return replace(rows[0], difference=replace(one, b=mean, error=error))
    return replace(rows[0], difference=Difference(one.a, mean, error, Verdict.FAIL if far else Verdict.PASS))


def _run(
    run: Run, twin: Path, seed: int, sums: Sequence[Batches], names: Sequence[str], errors: Sequence[str]
) -> tuple[list[tuple[SampleChunk, SampleChunk]], Follower]:
    """One run of the twin: chunks of both, thinned out, and the twin at its end.

    `sums`, of the recording and of the twin, take what each does while the drive runs.
    """
    n_p = run.info.n_p
    if n_p is None:
        raise BenchError(f"{run.path} holds no parameter n_p")
    pieces = captures(run)
    first = next(pieces)
    follower = _begun(run, twin, seed, first, n_p)
    every = max(1, run.rows(SAMPLES) // SHOWN)
    kept: list[tuple[SampleChunk, SampleChunk]] = []
    before: SampleChunk | None = None
    for capture in chain([first], pieces):
        samples = capture.samples
        raw = _followed(run, follower, capture, n_p, before)
        own = SampleChunk(samples.config, samples.index, samples.tick, raw[samples.index - samples.index[-1] - 1], ())
        before = samples
        for side, chunk in zip(sums, (samples, own), strict=True):
            take(side, chunk, names, errors, running(samples))
        kept.append((_thinned(samples, every), _thinned(own, every)))
        if follower.fault:
            break
    return kept, follower


def _begun(run: Run, twin: Path, seed: int, first: Capture, n_p: int) -> Follower:
    """The twin with the drive's parameters, where the drive was when the recording began, and at its speed."""
    theta, known = None, first.parameters
    if "theta_enc" in first:
        count = math.tau * n_p / (4.0 * known.get("encoder_lines", math.inf))
        within = count * float(np.random.default_rng(seed).uniform(-0.5, 0.5))  # of a count of the encoder
        theta = float(first["theta_enc"][0]) - known.get("encoder_zero", 0.0) + within
    follower = Follower(twin, theta, seed, run.config(SAMPLES).channels)
    if follower.pwm_hz != run.info.pwm_hz:
        raise BenchError(f"{twin} has a PWM rate of {follower.pwm_hz} Hz, and {run.path} {run.info.pwm_hz} Hz")
    for name, value in known.items():
        follower.set(name, value)
    begin = asked(first, n_p)[0]
    if begin.state == DriveState.RUNNING:
        follower.follow(Asked(1, int(DriveState.IDLE)))
        follower.follow(begin._replace(periods=round(RUN_IN * follower.pwm_hz)))
        follower.edges = 0
    return follower


def _followed(run: Run, follower: Follower, capture: Capture, n_p: int, before: SampleChunk | None) -> NDArray[np.void]:
    """Raw samples of the twin, one a period, up to the capture's last one; parameters change as they did."""
    tick, index = capture.samples.tick, capture.samples.index
    since = int(tick[0] if before is None else before.tick[-1])
    due = [change for change in run.parameters.changes if since <= change.tick < tick[-1]]
    begins = [int(index[np.searchsorted(tick, change.tick, side="right")]) for change in due]
    periods = asked(capture, n_p, None if before is None else int(before.index[-1]), begins)
    parts, at = [], int(index[-1]) + 1 - sum(one.periods for one in periods)
    for one in periods:
        for begin, change in zip(begins, due, strict=True):
            if begin == at:
                follower.set(change.name, change.value)
        parts.append(follower.follow(one))
        at += one.periods
    return np.concatenate(parts)


def _thinned(chunk: SampleChunk, every: int) -> SampleChunk:
    return replace(chunk, index=chunk.index[::every], tick=chunk.tick[::every], raw=chunk.raw[::every], gaps=())


def _traces(kept: Sequence[tuple[SampleChunk, SampleChunk]]) -> dict[str, tuple[Floats, Floats, Floats]]:
    recorded, twin = (join(side) for side in zip(*kept, strict=True))
    t, names = recorded.tick / recorded.config.tick_hz, recorded.raw.dtype.names or ()
    found = {name: (t, recorded.physical(name), twin.physical(name)) for name in ("omega_enc", "i_q") if name in names}
    errors = position_errors(twin)
    return found | {
        name: (t, np.degrees(error), np.degrees(errors[name])) for name, error in position_errors(recorded).items()
    }
