"""What differs between two aligned runs: every common channel and position error, events and parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bench.compare.batches import VERDICT_WORDS, Batches, Difference, of_means, of_rms, of_std
from bench.compare.said import EventPair, ParameterPair, events, parameters
from bench.errors import BenchError
from bench.record.info import AnyChannel
from bench.record.layout import SAMPLES
from bench.record.times import Side
from bench.report.words import number
from bench.signal.position import position_errors
from protocol.frames import data_frame
from protocol.signals import Flag
from protocol.streams import SampleChunk

if TYPE_CHECKING:
    import pandas as pd

WORDS = ("hall", "status")
"""Bits, which have no mean."""


@dataclass(frozen=True)
class Row:
    """One quantity of both runs."""

    name: str
    unit: str
    difference: Difference

    @property
    def relative(self) -> float:
        """Of the size of A's value, by which B's is larger; NaN where that is 0."""
        return self.difference.value / abs(self.difference.a) if self.difference.a else math.nan


@dataclass(frozen=True)
class Comparison:
    """All that differs, and what could not be compared."""

    a: Side
    b: Side
    rows: tuple[Row, ...]
    left_out: tuple[str, ...]
    """Channels that are not compared, each with why."""
    events: tuple[EventPair, ...]
    parameters: tuple[ParameterPair, ...]

    def to_pandas(self) -> pd.DataFrame:
        """A row for each quantity: unit, mean in A and B, their difference and its standard error, the verdict."""
        return data_frame(as_json(self)["rows"]).set_index("quantity")


def compare(a: Side, b: Side, channels: Sequence[str] = ()) -> Comparison:
    """Compare two aligned runs, read piece by piece; only `channels`, where any are named.

    BenchError for a name that is not common to both.
    """
    ours, theirs = ({c.name: c for c in side.run.config(SAMPLES).channels} for side in (a, b))
    common, left_out = _common(ours, theirs)
    errors = [
        name
        for name in a.run.info.position_estimates
        if name in b.run.info.position_estimates and a.run.info.position_reference and b.run.info.position_reference
    ]
    known = dict.fromkeys([*common, *errors])
    if unknown := [name for name in channels if name not in known]:
        raise BenchError(f"channel {unknown[0]} cannot be compared; both runs have {', '.join(known)}")
    if channels:
        common, errors = ([name for name in names if name in channels] for names in (common, errors))
        left_out = []
    sums = [_batches(side, common, errors) for side in (a, b)]
    rows = [Row(name, ours[name].unit.symbol, of_means(*(each.sums(name) for each in sums))) for name in common]
    rows += error_rows(sums, errors)
    if not rows:
        raise BenchError(f"{a.run.path} and {b.run.path} have no channel in common: {'; '.join(left_out)}")
    return Comparison(a, b, tuple(rows), tuple(left_out), tuple(events(a, b)), tuple(parameters(a, b)))


def _common(ours: dict[str, AnyChannel], theirs: dict[str, AnyChannel]) -> tuple[list[str], list[str]]:
    """Names of the channels that can be compared, and the others with why not."""
    common, left_out = [], []
    for name in dict.fromkeys([*ours, *theirs]):
        one, other = ours.get(name), theirs.get(name)
        if one is None or other is None:
            left_out.append(f"{name} (only in {'B' if one is None else 'A'})")
        elif one.unit != other.unit:
            left_out.append(f"{name} ({one.unit.symbol or 'no unit'} in A, {other.unit.symbol or 'no unit'} in B)")
        elif name in WORDS:
            left_out.append(f"{name} (bits)")
        elif (one.flags | other.flags) & Flag.WRAPS:
            left_out.append(f"{name} (a wrapping angle has no mean)")
        else:
            common.append(name)
    return common, left_out


def _error(name: str) -> str:
    return f"{name} error"


def error_rows(sums: Sequence[Batches], errors: Sequence[str]) -> list[Row]:
    """Mean, rms and standard deviation of position errors, of the sums of A and B."""
    return [
        Row(f"{name} error, {what}", "°", judge(*(each.sums(_error(name)) for each in sums)))
        for name in errors
        for what, judge in (("mean", of_means), ("rms", of_rms), ("std", of_std))
    ]


def take(
    sums: Batches, chunk: SampleChunk, channels: Sequence[str], errors: Sequence[str],
    which: NDArray[np.bool_] | slice = slice(None),
) -> None:  # fmt: skip
    """Add samples of a chunk, those to take as `which` (n,) says: channels, and position errors of estimates."""
    batch = sums.of(chunk.tick[which])
    for name in channels:
        sums.add(name, batch, chunk.physical(name)[which])
    found = position_errors(chunk) if errors else {}
    for name in errors:
        sums.add(_error(name), batch, np.degrees(found[name][which]))


def _batches(side: Side, channels: Sequence[str], errors: Sequence[str]) -> Batches:
    sums = Batches(side.first, side.last)
    for chunk in side.run.pieces(SAMPLES, side.first, side.last):
        assert isinstance(chunk, SampleChunk)
        take(sums, chunk, channels, errors)
    return sums


def as_json(found: Comparison) -> dict[str, Any]:
    """Plain data; times in s after what the runs are aligned at."""
    a, b = found.a, found.b
    return {
        "a": _side(a),
        "b": _side(b),
        "from_s": a.seconds(a.first),
        "to_s": a.seconds(a.last),
        "rows": [
            {
                "quantity": row.name, "unit": row.unit, "a": row.difference.a, "b": row.difference.b,
                "difference": row.difference.value, "standard_error": row.difference.error,
                "verdict": VERDICT_WORDS[row.difference.verdict], "why": row.difference.why or None,
            }
            for row in found.rows
        ],
        "not_compared": list(found.left_out),
        "events": [{"event": pair.words, "a_s": pair.a, "b_s": pair.b} for pair in found.events],
        "parameters": [{"parameter": pair.name, "a": pair.a, "b": pair.b} for pair in found.parameters],
    }  # fmt: skip


def _side(side: Side) -> dict[str, Any]:
    return {"run": str(side.run.path), "zero_s": side.zero / side.run.info.tick_hz,
            "rate": side.run.config(SAMPLES).rate, "damage": side.run.damage}  # fmt: skip


def cells(row: Row) -> list[str]:
    """A row of the table."""
    of = row.difference
    numbers = [number(value, ".4g") for value in (of.a, of.b, of.value, of.error)]
    return [row.name, row.unit or "–", *numbers, of.words]
