"""Samples of a run in pieces without a gap, with what the shaft does in them.

What a shaft does at a sample follows from a moment before and after it, which is looked at with each piece.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bench.record.layout import SAMPLES
from bench.record.reader import Run
from bench.score.phases import START_UP, Phases, phases_of, speed_of
from bench.signal.capture import Capture
from bench.signal.channels import reference_angle, speed_channel
from bench.signal.chunks import part
from bench.signal.position import running
from bench.signal.units import RPM
from bench.signal.windows import windows
from protocol.streams import SampleChunk

F64 = NDArray[np.float64]

AROUND = START_UP + 0.2  # s around a piece that are looked at with it
LEAST = 0.1  # s: shorter pieces tell no speed


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
        self._rate = config.rate
        self._reference = reference_angle(config.channels)
        self._speed = speed_channel(config.channels, run.info.parameters)
        self._n_p = run.info.n_p or 1
        self._watched = run.ran
        self.why = "" if self._reference or self._speed else "needs an encoder's angle, or a speed in rad/s"

    @property
    def rate(self) -> float:
        """Samples a second."""
        return self._rate

    def pieces(self, captures: Iterable[Capture]) -> Iterator[Piece]:
        """The samples of captures that follow each other."""
        for window in windows(captures, AROUND):
            for rows, own in window.stretches():
                whole = part(window.capture.samples, rows.start, rows.stop)
                yield self._piece(whole, slice(own.start - rows.start, own.stop - rows.start))

    def _piece(self, whole: SampleChunk, new: slice) -> Piece:
        n, now = len(whole), part(whole, new.start, new.stop)
        runs = running(whole) if self._watched else np.ones(n, bool)
        theta = whole.physical(self._reference) if self._reference else None
        omega = self._omega(whole, theta)
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
