"""`bench twin check`: a twin under the commands of a recording, and in what the two differ by more than noise."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.commission.window import Floats
from bench.compare.batches import SURE, VERDICT_WORDS, Batches, Difference, of_means, of_rms, of_std
from bench.compare.compare import WORDS
from bench.errors import BenchError
from bench.files import finite
from bench.record.layout import EDGES, SAMPLES
from bench.record.reader import Run, captures
from bench.report.words import number
from bench.signal.batches import ROUNDING
from bench.signal.capture import Capture
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


@dataclass(frozen=True)
class Row:
    """One quantity of both, while the drive ran."""

    name: str
    unit: str
    difference: Difference

    @property
    def relative(self) -> float:
        """Of the recorded value, by which the twin's is larger; NaN where that is 0."""
        return self.difference.value / abs(self.difference.a) if self.difference.a else math.nan

    @property
    def cells(self) -> list[str]:
        """Of a table."""
        of, share = self.difference, self.relative
        said = f"{100.0 * share:+.2g} %" if math.isfinite(share) else "–"
        words = VERDICT_WORDS[of.verdict] + (f": {of.why}" if of.why else "")
        return [
            self.name,
            self.unit or "–",
            *(number(x, ".4g") for x in (of.a, of.b)),
            said,
            number(of.error, ".2g"),
            words,
        ]


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
        told: dict[str, Any] = finite({
            "run": str(self.run), "twin": str(self.twin), "tripped": self.tripped or None, "remarks": self.remarks,
            "edges": {"recorded": self.edges[0], "twin": self.edges[1]},
            "rows": [
                {"quantity": row.name, "unit": row.unit, "recorded": row.difference.a, "twin": row.difference.b,
                 "relative": row.relative, "standard_error": row.difference.error,
                 "verdict": VERDICT_WORDS[row.difference.verdict], "why": row.difference.why or None}
                for row in self.rows
            ],
        })  # fmt: skip
        return told


def check(run: Run, twin: Path, seed: int = 0, repeats: int = REPEATS) -> Checked:
    """Run the twin of the configuration file `twin` under the commands of a recording, so often with other noise.

    `seed` is that of the first. BenchError for a recording that does not tell its commands, or that has another PWM
    rate; ConfigError.
    """
    found = Checked(run.path, twin)
    channels = run.config(SAMPLES).channels
    names = [c.name for c in channels if c.name in KNOWN and c.name not in WORDS and not c.flags & Flag.WRAPS]
    units = {c.name: c.unit.symbol for c in channels}
    several, edges = [], []
    for again in range(repeats):
        sums = [Batches(*run.span) for _ in range(2)]
        kept, follower = _run(run, twin, seed + again, sums, names)
        several.append(list(_rows(sums, names, units, run)))
        edges.append(follower.edges)
        if not again:
            found.traces = _traces(kept)
            if "tau_load_true" not in units:
                found.remarks.append("no load was recorded: the twin has none")
        if follower.fault:
            found.tripped = follower.fault
            break
    found.rows = tuple(_pooled([of[k] for of in several]) for k in range(len(several[0])))
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
    run: Run, twin: Path, seed: int, sums: Sequence[Batches], names: Sequence[str]
) -> tuple[list[tuple[SampleChunk, SampleChunk]], Follower]:
    """One run of the twin: chunks of both, and the twin at its end; `sums` take what both do while the drive runs."""
    pieces = captures(run)
    first = next(pieces, None)
    n_p = run.info.n_p
    if first is None or n_p is None:
        raise BenchError(f"{run.path} holds no samples, or no parameter n_p")
    follower = _begun(run, twin, seed, first, n_p)
    kept: list[tuple[SampleChunk, SampleChunk]] = []
    before: int | None = None
    for capture in _with(first, pieces):
        samples = capture.samples
        raw = _followed(run, follower, capture, n_p, before)
        own = SampleChunk(samples.config, samples.index, samples.tick, raw[samples.index - samples.index[-1] - 1], ())
        before = int(samples.index[-1])
        on = running(samples)
        for side, chunk in zip(sums, (samples, own), strict=True):
            _add(side, chunk, names, on)
        kept.append((samples, own))
        if follower.fault:
            break
    return kept, follower


def _with(first: Capture, rest: Iterator[Capture]) -> Iterator[Capture]:
    yield first
    yield from rest


def _begun(run: Run, twin: Path, seed: int, first: Capture, n_p: int) -> Follower:
    """The twin with the drive's parameters, where the drive was when the recording began, and at its speed."""
    theta = None
    channels = run.config(SAMPLES).channels
    if "theta_enc" in first:
        offset = Follower(twin, None, seed, channels).encoder_deg
        count = 360.0 * n_p / (4.0 * run.parameters.get("encoder_lines", math.inf))
        within = count * float(np.random.default_rng(seed).uniform(-0.5, 0.5))  # of a count of the encoder
        theta = math.remainder(math.degrees(float(first["theta_enc"][0])) - offset + within, 360.0)
    follower = Follower(twin, theta, seed, channels)
    if follower.pwm_hz != run.info.pwm_hz:
        raise BenchError(f"{twin} has a PWM rate of {follower.pwm_hz} Hz, and {run.path} {run.info.pwm_hz} Hz")
    for name, value in first.parameters.items():
        follower.set(name, value)
    begin = asked(first, n_p)[0]
    if begin.state == DriveState.RUNNING:
        follower.follow([Asked(1, int(DriveState.IDLE)), begin._replace(periods=round(RUN_IN * follower.pwm_hz))])
        follower.edges = 0
    return follower


def _followed(run: Run, follower: Follower, capture: Capture, n_p: int, before: int | None) -> Any:
    """Raw samples of the twin, one a period, up to the capture's last one; parameters change as they did."""
    periods = asked(capture, n_p, before)
    first = int(capture.samples.index[-1]) + 1 - sum(one.periods for one in periods)
    tick, index = capture.samples.tick, capture.samples.index
    changes = [
        (int(index[min(int(np.searchsorted(tick, change.tick, side="right")), len(index) - 1)]), change)
        for change in run.parameters.changes
        if (before is None or change.tick > tick[0]) and change.tick <= tick[-1]
    ]
    parts, at = [], first
    for one in periods:
        left = one
        while changes and changes[0][0] < at + left.periods:
            moment, change = changes.pop(0)
            if moment > at:
                parts.append(follower.follow([left._replace(periods=moment - at)]))
                left, at = left._replace(periods=left.periods - (moment - at)), moment
            follower.set(change.name, change.value)
        parts.append(follower.follow([left]))
        at += left.periods
    return np.concatenate(parts)


def _add(side: Batches, chunk: SampleChunk, names: Sequence[str], on: Any) -> None:
    batch = side.of(chunk.tick[on])
    for name in names:
        side.add(name, batch, chunk.physical(name)[on])
    for name, error in position_errors(chunk).items():
        side.add(f"{name} error", batch, np.degrees(error[on]))


def _rows(sums: Sequence[Batches], names: Sequence[str], units: dict[str, str], run: Run) -> Iterator[Row]:
    for name in names:
        yield Row(f"{name}, rms", units[name], of_rms(*(side.sums(name) for side in sums)))
    for name in run.info.position_estimates if run.info.position_reference else ():
        if name in KNOWN:
            for what, judge in (("mean", of_means), ("rms", of_rms), ("std", of_std)):
                yield Row(f"{name} error, {what}", "°", judge(*(side.sums(f"{name} error") for side in sums)))


def _traces(kept: Sequence[tuple[SampleChunk, SampleChunk]]) -> dict[str, tuple[Floats, Floats, Floats]]:
    every = max(1, sum(len(chunk) for chunk, _ in kept) // SHOWN)
    found = {}
    hz = kept[0][0].config.tick_hz
    names = kept[0][0].raw.dtype.names or ()
    errors = [position_errors(chunk) for pair in kept for chunk in pair]
    for name in ("omega_enc", "i_q", *errors[0]):
        if name not in names:
            continue
        columns = [[], [], []]  # type: list[list[Floats]]
        for k, pair in enumerate(kept):
            columns[0].append(pair[0].tick[::every] / hz)
            for side, chunk in enumerate(pair):
                own = errors[2 * k + side].get(name)
                columns[1 + side].append((chunk.physical(name) if own is None else np.degrees(own))[::every])
        t, a, b = (np.concatenate(column) for column in columns)
        found[name] = t, a, b
    return found
