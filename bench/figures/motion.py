"""Samples of a run in pieces without a gap, with what the shaft does in them.

What a shaft does at a sample follows from a moment before it: the end of each piece is looked at again with the next.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from bench.analysis.channels import reference_angle, speed_channel
from bench.analysis.chunks import contiguous, index_step, join, part
from bench.analysis.position import running
from bench.analysis.units import RPM
from bench.recording.layout import SAMPLES
from bench.recording.reader import Run
from bench.scoring.phases import START_UP, Phases, phases_of, speed_of
from protocol.streams import SampleChunk

F64 = NDArray[np.float64]

BEFORE = START_UP + 0.2  # s before a piece that are looked at with it
LEAST = 0.1  # s: shorter pieces tell no speed
LARGEST = 1 << 18  # samples of a piece


@dataclass(frozen=True)
class Piece:
    """n samples without a gap."""

    samples: SampleChunk
    running: NDArray[np.bool_]
    """(n,) whether the drive was RUNNING; everywhere where the run never tells."""
    rpm: F64 | None
    """(n,) speed in r/min, mechanical where the pole pairs are known; None where none is known."""
    phases: Phases | None
    theta: F64 | None
    """(n,) electrical angle by the encoder, rad, wrapped; None without one."""


class Motion:
    """Makes pieces of a run's samples. `why` says why no speed is known; it is empty if one is."""

    def __init__(self, run: Run) -> None:
        config = run.config(SAMPLES)
        self._rate, self._step = config.rate, index_step(config)
        self._reference = reference_angle(config.channels)
        self._speed = speed_channel(config.channels, run.info.parameters)
        self._n_p = run.info.n_p or 1
        self._watched = run.ran
        self._held: SampleChunk | None = None
        self.why = "" if self._reference or self._speed else "needs an encoder's angle, or a speed in rad/s"

    @property
    def rate(self) -> float:
        """Samples a second."""
        return self._rate

    def pieces(self, chunk: SampleChunk) -> Iterator[Piece]:
        """The samples `chunk`, which come after those of the last call."""
        for rows in contiguous(chunk):
            for begin, end in pairwise([*range(rows.start, rows.stop, LARGEST), rows.stop]):
                yield self._piece(part(chunk, begin, end))

    def _piece(self, now: SampleChunk) -> Piece:
        held = self._held
        follows = held is not None and int(held.index[-1]) + self._step == int(now.index[0])
        whole = join([held, now]) if held is not None and follows else now
        n = len(whole)
        self._held = part(whole, max(0, n - round(BEFORE * self._rate)), n)
        runs = running(whole) if self._watched else np.ones(n, bool)
        theta = whole.physical(self._reference) if self._reference else None
        omega = self._omega(whole, theta)
        new = slice(n - len(now), n)
        if omega is None:
            return Piece(now, runs[new], None, None, None if theta is None else theta[new])
        usable = runs if n >= LEAST * self._rate else np.zeros(n, bool)
        found = phases_of(omega, usable, self._rate, self._n_p)
        masks = ("moving", "steady", "transient", "start_up", "reversal")
        phases = replace(found, **{name: getattr(found, name)[new] for name in masks})
        return Piece(now, runs[new], omega[new] / (RPM * self._n_p), phases, None if theta is None else theta[new])

    def _omega(self, chunk: SampleChunk, theta: F64 | None) -> F64 | None:
        """Electrical speed, rad/s: that of the encoder's angle, else the drive's own; None where it is not known."""
        if self.why:
            return None
        told = chunk.physical(self._speed) if self._speed else None
        if theta is None:
            return None if told is None else np.nan_to_num(told)
        fastest = 0.0 if told is None else float(np.nanmax(np.abs(told), initial=0.0))
        if fastest >= math.pi * self._rate:
            self.why = (
                f"the shaft turns half an electrical revolution or more per sample ({fastest:.0f} rad/s at "
                f"{self._rate:g} a second), so its angle is ambiguous: record at --rate {fastest / 2:.0f} or more"
            )
            return None
        return speed_of(np.nan_to_num(theta), self._rate)
