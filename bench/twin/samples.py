"""What a twin is fitted to: stretches of a recording without a gap, as arrays."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from bench.commission.window import Booleans, Complexes, Floats, clarke
from bench.record.reader import Run, captures
from bench.signal.capture import Capture
from bench.signal.chunks import contiguous, part
from bench.signal.position import states, unwrapped
from bench.signal.trace import speed
from protocol.messages import DriveState

SETTLE = 0.02
"""s after the outputs went off, from which on no current flows."""
SLOPE = 1e-3
"""s to either side of a sample, over which the speed is taken."""
READ_BY = (
    "encoder_zero", "encoder_reverse", "encoder_lines", "dead_time_hat", "dead_time_comp", "dead_time_learn", "L_s_hat",
)  # fmt: skip
"""The drive's parameters by which samples are read: a stretch ends where one of them changes."""


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
    """rad, (n,): the encoder's electrical angle without the drive's `encoder_zero`, unwrapped."""
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

    @property
    def omega(self) -> Floats:
        """Electrical rad/s, (n,), by the encoder."""
        assert self.theta is not None
        return speed(self.theta, np.arange(len(self), dtype=np.float64) * self.T, SLOPE)


def stretches(run: Run) -> Iterator[Stretch]:
    """Those of a run, in the order of time, of ten seconds or less."""
    changes = [change.tick for change in run.parameters.changes if change.name in READ_BY]
    for capture in captures(run):
        samples = capture.samples
        cuts = np.searchsorted(samples.tick, changes, "right").tolist()
        for rows in contiguous(samples):
            ends = sorted({rows.start, rows.stop, *(cut for cut in cuts if rows.start < cut < rows.stop)})
            for begin, end in pairwise(ends):
                if end - begin > 1:
                    known = run.parameters.since(int(samples.tick[begin]))
                    yield _stretch(replace(capture, samples=part(samples, begin, end), parameters=known))


def _stretch(own: Capture) -> Stretch:
    config, n = own.samples.config, len(own)

    def several(*names: str) -> Floats | None:
        return np.stack([own[name] for name in names]) if all(name in own for name in names) else None

    def one(name: str) -> Floats | None:
        return own[name] if name in own else None  # noqa: SIM401 - a capture has no get

    i, u, theta = several("i_a", "i_b", "i_c"), several("u_alpha", "u_beta"), one("theta_enc")
    if i is None and (two := several("i_a", "i_b")) is not None:
        i = np.vstack([two, -two.sum(axis=0)])
    if (told := states(own.samples)) is not None:
        on = told == DriveState.RUNNING
    else:
        on = np.zeros(n, bool) if u is None else np.abs(u[0] + 1j * u[1]) > 0.0
    T = config.decimation / config.pwm_hz
    since = np.arange(n) - np.maximum.accumulate(np.where(on, np.arange(n), -1))
    return Stretch(
        T, config.decimation == 1, i, None if u is None else u[0] + 1j * u[1], one("u_dc"),
        None if theta is None else unwrapped(theta) - own.parameters.get("encoder_zero", 0.0),
        one("tau_load_true"), on, since > round(SETTLE / T),
        dict(own.parameters),
    )  # fmt: skip
