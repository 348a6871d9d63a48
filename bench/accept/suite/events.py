"""When something happened in a capture, and how far values went then: states, currents, setpoints, Hall codes.

What did not happen is NaN, which fails every limit. Nothing here knows a limit, needs an encoder, or waits.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bench.signal.capture import F64, Capture
from protocol.codes import DriveState
from protocol.signals import STATUS_STATE_MASK

PHASES = ("i_a", "i_b", "i_c")


def only(capture: Capture, *channels: str) -> Capture:
    """The capture as far as these channels go: for a measurement that does not mind what the others did.

    Give it to `measure`: of its flaws those remain that are no other channel's.
    """
    return capture.only(*(channel for channel in channels if channel in capture))


def states(capture: Capture) -> NDArray[np.int64]:
    """The `DriveState` at each sample, shape (n,)."""
    return capture["status"].astype(np.int64) & STATUS_STATE_MASK


def phases(capture: Capture) -> F64 | None:
    """i_a, i_b and i_c, A, shape (3, n): one that is not streamed is what the others leave; None without two."""
    there = [name for name in PHASES if name in capture]
    if len(there) < 2:
        return None
    left = -np.sum([capture[name] for name in there], axis=0)
    return np.array([capture[name] if name in there else left for name in PHASES], dtype=np.float64)


def current(capture: Capture) -> F64:
    """Size of the largest phase current, A, shape (n,); of the current vector where two phases are not streamed."""
    found = phases(capture)
    return np.hypot(capture["i_d"], capture["i_q"]) if found is None else np.asarray(np.abs(found).max(axis=0))


def largest(values: F64, where: NDArray[np.bool_]) -> float:
    """The largest of `values` (n,) where `where` (n,) holds; NaN if it holds nowhere."""
    return float(values[where].max()) if where.any() else math.nan


def first(capture: Capture, where: NDArray[np.bool_]) -> float:
    """Device time in s of the first sample at which `where` (n,) holds; NaN if it never does."""
    return float(capture.t[int(np.argmax(where))]) if where.any() else math.nan


def stepped(capture: Capture, channel: str) -> float:
    """Device time in s at which a channel first differs from its value at the first sample; NaN if it never does."""
    values = capture[channel]
    return first(capture, values != values[0])


def tripped(capture: Capture) -> float:
    """Device time in s of the first sample in the state FAULT; NaN if there is none."""
    return first(capture, states(capture) == DriveState.FAULT)


def illegal(capture: Capture) -> float:
    """Device time in s of the first sample with the Hall code 000 or 111; NaN if there is none."""
    code = capture["hall"]
    return first(capture, (code == 0) | (code == 7))


def currents_gone(capture: Capture, gone: float) -> float:
    """Device time in s from which on all currents are below `gone` A to the end; NaN if they are not at the end."""
    small = current(capture) < gone
    if not small[-1]:
        return math.nan
    return float(capture.t[0] if small.all() else capture.t[len(small) - int(np.argmin(small[::-1]))])
