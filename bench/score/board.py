"""All statistics of every observer, by recording and pooled, in the order of their rank.

The rank is by the rms error of the angle over all samples in which the shaft moves: starts, steady running, changes of
speed and reversals. Recordings are pooled sample by sample; an observer that is in only some of them stands after those
that are in all, because it was not put to the same test. Angles are in electrical degrees, speeds in r/min (mechanical
where the pole pairs are known), lags in microseconds.
"""

from __future__ import annotations

import math
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.errors import BenchError
from bench.files import leaves
from bench.record.recording import Source
from bench.replay.estimators import entry_of
from bench.score import phases
from bench.score.reference import ACTUAL, AUTO, ENCODER
from bench.score.tally import Tally
from bench.score.tracks import DRIVE, HOST, REPLAYED, Asked, Track, load
from bench.signal.capture import Capture
from protocol import __version__
from protocol.frames import data_frame
from protocol.text import did_you_mean
from sim.observers.catalogue import CATALOGUE

if TYPE_CHECKING:
    import pandas as pd

Figures = dict[str, Any]
OF_TRACK = ("path", "started", "recorded_by", "samples", "pole_pairs", "lost", "dropped", "restarts", "notes")
"""What stands in JSON of a recording as it is."""
PHASES = ("moving", "error", "transient", "start_up", "reversal")
"""Keys of the position error's statistics by phase; `error` is that of steady running."""


@dataclass(frozen=True)
class Scoreboard:
    """Statistics by observer, the best first: pooled over all recordings, and by recording."""

    tracks: tuple[Track, ...]
    pooled: dict[str, Figures]
    by_file: dict[str, dict[str, Figures]]

    @property
    def reference(self) -> str:
        """What all estimates are compared with: encoder, edges, or the name of an observer or a recorded estimate."""
        return self.tracks[0].reference.kind

    @property
    def noun(self) -> str:
        """What the figures are of: without an actual angle a difference is no error."""
        return self.tracks[0].reference.noun

    @property
    def taken_from(self) -> str:
        """What an estimate is taken from, in words."""
        return ACTUAL.get(self.reference, self.reference)

    @property
    def notes(self) -> list[str]:
        """What a reader has to know, with the recording that it is about."""
        found = []
        rates = sorted({track.rate for track in self.tracks})
        if len(rates) > 1:
            which = ", ".join(f"{rate:g}" for rate in rates)
            found.append(f"recorded at {which} samples/s: pooled by sample, so the faster one weighs more")
        for name, figures in self.pooled.items():
            if words := partly(figures, self.tracks):
                found.append(f"{name} is only in {words}: ranked after those that are in all")
        for track in self.tracks:
            lost = f"{track.lost} samples lost" if track.lost else ""
            short = f"{track.dropped} samples in stretches too short to score" if track.dropped else ""
            began = sum(n for why, n in track.restarts.items() if why.startswith("lost"))
            anew = f"observers restarted {began} times after losses" if began else ""
            found += [f"{track.path}: {words}" for words in (*track.notes, lost, short, anew) if words]
        return found

    def to_pandas(self) -> pd.DataFrame:
        """The pooled numbers: a row for each observer, the best first, and columns such as ("moving", "rms")."""
        rows = {name: dict(flat(figures)) for name, figures in self.pooled.items()}
        frame = data_frame(list(rows.values()), list(rows), "observer")
        frame.columns = frame.columns.map(lambda name: name.rpartition(".")[::2] if "." in name else (name, ""))
        return frame

    def as_json(self) -> dict[str, Any]:
        """All of it as plain data; undefined values are null."""
        return {
            "hallbench": __version__,
            "machine": {"processor": platform.machine(), "cores": os.cpu_count(), "python": platform.python_version()},
            "definitions": {
                "reference": self.reference,
                "error": "actual less estimated"
                if self.reference == ENCODER
                else f"{self.noun}: {self.taken_from} less estimated",
                "units": {"angle": "electrical deg", "speed": "r/min", "lag": "us", "step": "ns on this machine"},
                "rank": "moving.rms",
                "moving_rpm": phases.MOVING_RPM,
                "transient_rpm_s": phases.TRANSIENT_RPM_S,
                "start_up_s": phases.START_UP,
                "reversal_s": phases.REVERSAL,
            },
            "observers": self.pooled,
            "files": [
                {name: getattr(track, name) for name in OF_TRACK}
                | {"reference": _reference(track), "rate_hz": track.rate, "front_end_ns": track.front_ns}
                | {"observers": self.by_file[track.path]}
                for track in self.tracks
            ],
        }


def _reference(track: Track) -> dict[str, Any]:
    sd = {"sd_rms_deg": track.sd.rms, "sd_max_deg": track.sd.peak} if track.sd.n else {}
    return {"kind": track.reference.kind, "unknown_samples": track.unknown, **(track.reference.stated or {}), **sd}


def score(
    sources: Sequence[Source],
    observers: Sequence[str] = (),
    begin: float | None = None,
    end: float | None = None,
    *,
    reference: str = AUTO,
    settings: Mapping[str, float] | None = None,
) -> Scoreboard:
    """Score recordings or captures: all estimates in them and all observers, or those named.

    `begin`, `end`: of recordings, device time in s; None: from the beginning, to the end. Names are the catalogue's,
    long or short, and those of recorded estimates, as drive_vt; `reference` is one of these too, or encoder, edges,
    auto. `settings`: drive parameters for the observers. Raises BenchError for what cannot be read or scored, and for a
    name that is nowhere.
    """
    if not sources:
        raise BenchError("nothing to score: pass a recording or a capture")
    recorded = [name.replace("-", "_") for name in observers if _is_recorded(name)]
    again = [_observer(name) for name in observers if not _is_recorded(name)]
    apart = list({id(source) if isinstance(source, Capture) else source: source for source in sources}.values())
    asked = Asked(again if observers else None, begin, end, reference, settings or {})
    tracks = tuple(load(source, asked) for source in apart)
    if len(kinds := {track.reference.kind: track.path for track in tracks}) > 1:
        each = ", ".join(f"{path} by {kind}" for kind, path in kinds.items())
        raise BenchError(f"nothing to pool: {each}: score them apart, or give one --reference")
    if len({track.path for track in tracks}) < len(tracks):  # captures
        tracks = tuple(replace(track, path=f"{track.path} {k}") for k, track in enumerate(tracks, 1))
    names = list(dict.fromkeys(name for track in tracks for name in track.kinds))
    if missing := [name for name in recorded if name not in names]:
        nearest = did_you_mean(missing[0], names, form=" (did you mean {}?)")
        raise BenchError(f"no recording has the estimate '{missing[0]}'{nearest}; there are {', '.join(names)}")
    if observers:
        names = [name for name in names if name in (*recorded, *again)]
    by_file = {track.path: _ranked(names, [track]) for track in tracks}
    pooled = _ranked(names, tracks) if len(tracks) > 1 else by_file[tracks[0].path]
    board = Scoreboard(tracks, pooled, by_file)
    if not any(figures["moving"]["n"] for figures in pooled.values()):
        still = f"in no sample does the shaft turn faster than {phases.MOVING_RPM:g} r/min" if pooled else ""
        raise BenchError(f"nothing to score: {'; '.join(filter(None, (*board.notes, still)))}")
    return board


def partly(figures: Figures, tracks: Sequence[Track]) -> str:
    """In how many of the recordings the observer of these figures is, in words; empty for all."""
    n = figures["recordings"]
    return f"{n} of {len(tracks)} recordings" if n < len(tracks) else ""


def _is_recorded(name: str) -> bool:
    return name.replace("-", "_").startswith((f"{DRIVE}_", f"{REPLAYED}_"))


def _observer(name: str) -> str:
    try:
        return entry_of(name).name
    except BenchError as error:
        raise BenchError(
            f"{error}; for recorded estimates use drive_… or replayed_… and the short name, such as drive_vt"
        ) from None


def flat(figures: Figures) -> Iterator[tuple[str, float | None]]:
    """Every number under its dotted name, as `error.std`; words are left out."""
    return ((name, value) for name, value in leaves(figures) if not isinstance(value, str))


def _ranked(names: Sequence[str], tracks: Sequence[Track]) -> dict[str, Figures]:
    having = {name: [track for track in tracks if name in track.kinds] for name in names}
    found = {name: _figures(name, tracks) for name, tracks in having.items() if tracks}
    ranked = sorted(found, key=lambda name: _place(found[name], len(tracks)))
    return {name: {"rank": place, **found[name]} for place, name in enumerate(ranked, 1)}


def _place(figures: Figures, recordings: int) -> tuple[bool, float]:
    rms = figures["moving"]["rms"]
    return figures["recordings"] < recordings, math.inf if rms is None else rms


def _figures(name: str, tracks: Sequence[Track]) -> Figures:
    """All figures of an observer over recordings that have it, put together."""
    kind = tracks[0].kinds[name]
    steps = [track.step_ns[name] for track in tracks if name in track.step_ns]
    tally = tracks[0].tallies[name]
    if len(tracks) > 1:
        tally = Tally()
        for track in tracks:
            tally.merge(track.tallies[name])
    return {
        "kind": kind,
        "recordings": len(tracks),
        "source": CATALOGUE[name].source if kind == HOST else f"channel of the recording, {kind}",
        **tally.figures(sum(track.starts for track in tracks), sum(track.reversals for track in tracks)),
        "step_ns": float(np.mean(steps)) if steps else None,
    }
