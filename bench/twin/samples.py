"""What a twin is fitted to: stretches of a recording without a gap, as arrays."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from bench.commission.window import Booleans, Complexes, Floats, clarke
from bench.record.reader import Run, captures
from bench.signal.capture import Capture
from bench.signal.chunks import contiguous, part
from bench.signal.position import unwrapped
from protocol.messages import DriveState
from protocol.signals import STATUS_STATE_MASK

SETTLE = 0.02
"""s after the outputs went off, from which on no current flows."""


@dataclass(frozen=True)
class Stretch:
    """Samples without a gap, n of them."""

    T: float
    """s from one to the next."""
    every: bool
    """Whether they are those of every PWM period."""
    i: Floats | None
    """A, (3, n): phase currents as measured; None where they were not recorded."""
    u: Complexes | None
    """V, (n,): the voltage reference, in force up to each sample."""
    u_dc: Floats | None
    theta: Floats | None
    """rad, (n,): the encoder's electrical angle, unwrapped."""
    load: Floats | None
    """N m, (n,): torque against the shaft, where it was recorded."""
    on: Booleans
    """(n,): the outputs were on."""
    rest: Booleans
    """(n,): they had been off for so long that no current flows."""
    parameters: Mapping[str, float]
    """The drive's, as it began."""

    def __len__(self) -> int:
        return len(self.on)

    @property
    def current(self) -> Complexes:
        """A, (n,): i_alpha + j i_beta as measured."""
        assert self.i is not None
        return clarke(self.i)


def stretches(run: Run) -> Iterator[Stretch]:
    """Those of a run, in the order of time, of ten seconds or less."""
    for capture in captures(run):
        for rows in contiguous(capture.samples):
            if rows.stop - rows.start > 1:
                yield _stretch(replace(capture, samples=part(capture.samples, rows.start, rows.stop)))


def _stretch(own: Capture) -> Stretch:
    config, n = own.samples.config, len(own)

    def several(*names: str) -> Floats | None:
        return np.stack([own[name] for name in names]) if all(name in own for name in names) else None

    def one(name: str) -> Floats | None:
        return own[name] if name in own else None  # noqa: SIM401 - a capture has no get

    i, u, theta = several("i_a", "i_b", "i_c"), several("u_alpha", "u_beta"), one("theta_enc")
    if i is None and (two := several("i_a", "i_b")) is not None:
        i = np.vstack([two, -two.sum(axis=0)])
    if "status" in own:
        on = (own["status"].astype(np.int64) & STATUS_STATE_MASK) == DriveState.RUNNING
    else:
        on = np.zeros(n, bool) if u is None else np.abs(u[0] + 1j * u[1]) > 0.0
    T = config.decimation / config.pwm_hz
    since = np.arange(n) - np.maximum.accumulate(np.where(on, np.arange(n), -1))
    return Stretch(
        T, config.decimation == 1, i, None if u is None else u[0] + 1j * u[1], one("u_dc"),
        None if theta is None else unwrapped(theta),
        one("tau_load_true"), on, since > round(SETTLE / T),
        dict(own.parameters),
    )  # fmt: skip
