"""The drive's observers, run again on the host from what the drive measured.

The kernels are those of the simulated drive, `sim.observers`. Fed with the raw values that telemetry carries they give
the same estimates, bit for bit, so a difference means that the drive's firmware differs. This module never touches a
link, and it never runs ahead of its input: an edge is used once a sample at or after it has arrived.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from protocol.descriptor import Channel
from protocol.signals import Flag, Signal, Status
from protocol.streams import EdgeChunk, SampleChunk
from sim.observers import bank

INPUTS = ("hall", "status", "u_alpha", "u_beta", "i_a", "i_b", "i_c", "i_q_ref", "i_q")
OPTIONAL = ("inject", "inject_amplitude", "inject_hz")
"""Parameters that a drive need not have: without them nothing is injected."""
CHECKED = (
    *(f"{what}_{short}" for short in bank.SHORT for what in ("theta", "omega")),
    "delta_hat",
    "e_alpha",
    "e_beta",
)


class HostObservers:
    """Runs the observer bank over a drive's chunks: edges first, then the samples that cover them.

    The bank starts when the drive initialises its own (the `status` bit OBSERVERS_RESET); after a gap it waits for the
    next time, because what it would have remembered is lost.
    """

    def __init__(self, parameters: Mapping[str, float], tick_hz: float, pwm_hz: float) -> None:
        needed = {name: parameters.get(name, 0.0) if name in OPTIONAL else parameters[name] for name in bank.PARAMETERS}
        self._params = bank.make_params(tick_hz, pwm_hz, exact_inverse=True, **needed)
        self._state = bank.init()
        self._synchronised = False
        self._i_q = 0.0  # of the last sample, A
        self._edge_tick: NDArray[np.int64] = np.empty(0, np.int64)
        self._edge_hall: NDArray[np.uint8] = np.empty(0, np.uint8)
        self._compile()

    def _compile(self) -> None:
        """Compile, or load what was compiled, now: while a motor turns there is no time for it."""
        x = np.zeros(1)
        sample = np.zeros(1, np.int64), np.ones(1, np.uint8), x, x, x, x, x, x
        bank.run(self._params, self._state, *sample, self._edge_tick, self._edge_hall, np.ones(1, bool))

    def edges(self, chunk: EdgeChunk) -> None:
        """Take edges; they wait for the samples that cover them."""
        if chunk.gaps:
            self._synchronised = False
        self._edge_tick = np.concatenate([self._edge_tick, chunk.tick])
        self._edge_hall = np.concatenate([self._edge_hall, chunk.hall_new])

    def samples(self, chunk: SampleChunk) -> tuple[bank.BankEstimates, NDArray[np.bool_]]:
        """Estimates at the samples of `chunk`, and where they are valid; arrays of shape (n,).

        The chunk must have the channels `INPUTS` at full rate.
        """
        reset = (chunk.raw["status"] & Status.OBSERVERS_RESET) != 0
        before = -1 if self._synchronised else -3
        last_reset = np.maximum.accumulate(np.where(reset, np.arange(len(reset)), before))
        last_gap = np.full(len(reset), -2)
        for gap in chunk.gaps:
            last_gap[gap.position :] = gap.position
        valid: NDArray[np.bool_] = last_reset >= last_gap
        self._synchronised = bool(valid[-1])
        used = int(np.searchsorted(self._edge_tick, chunk.tick[-1], side="right"))
        u_alpha, u_beta, i_a, i_b, i_c, i_q_ref, i_q = (chunk.physical(name) for name in INPUTS[2:])
        i_q_err = i_q_ref - np.r_[self._i_q, i_q[:-1]]
        self._i_q = float(i_q[-1])
        self._state, estimates = bank.run(
            self._params,
            self._state,
            chunk.tick,
            np.ascontiguousarray(chunk.raw["hall"]),
            u_alpha,
            u_beta,
            i_a,
            i_b,
            i_c,
            i_q_err,
            self._edge_tick[:used],
            self._edge_hall[:used],
            reset,
        )
        self._edge_tick, self._edge_hall = self._edge_tick[used:], self._edge_hall[used:]
        return estimates, valid

    def compare(self, chunk: SampleChunk) -> tuple[int, int]:
        """Number of samples compared with the drive's own estimates, and of those that differ in any raw bit."""
        estimates, valid = self.samples(chunk)
        differ = np.zeros(len(valid), dtype=bool)
        for name in CHECKED:
            if name in (chunk.raw.dtype.names or ()):
                channel = chunk.config.channel(name)
                differ |= _raw(channel, estimates.column(name)) != chunk.raw[name]
        return int(valid.sum()), int((differ & valid).sum())


def _raw(channel: Channel | Signal, values: NDArray[np.float64]) -> NDArray[np.generic]:
    """Raw counts of physical values, as the simulated drive rounds them: half to even; angles wrap, others saturate."""
    counts = np.rint(values * (1.0 / channel.scale))
    dtype = np.dtype(channel.raw.dtype)
    if not channel.flags & Flag.WRAPS:
        info = np.iinfo(dtype)
        counts = np.clip(counts, info.min, info.max)
    return counts.astype(np.int64).astype(dtype)
