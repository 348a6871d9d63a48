"""Windows that follow each other made one, and parts of a window that are whole electrical turns."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from bench.commission.window import Edges, Floats, Window

PART = 0.02
"""s of a part, about: whole electrical turns, so that harmonics of the motor leave no mean."""
LEAST_PART = 16
"""Samples of the shortest part."""


def merged(windows: Iterable[Window], by_command: bool = True) -> list[Window]:
    """Windows of which each begins in the PWM period after the one before as one window each; empty ones are left out.

    `by_command`: only windows of one kind and one current are made one; else the kind is that of the first.
    """
    found: list[list[Window]] = []
    for window in windows:
        if not len(window):
            continue
        last = found[-1][-1] if found else None
        follows = last is not None and window.index[0] == last.index[-1] + 1
        if last is not None and follows and (not by_command or _command(window) == _command(last)):
            found[-1].append(window)
        else:
            found.append([window])
    return [each[0] if len(each) == 1 else _joined(each) for each in found]


def _command(window: Window) -> tuple[str, complex]:
    return window.kind, window.i_ref


def _joined(windows: Sequence[Window]) -> Window:
    angles = [window.theta for window in windows if window.theta is not None]
    every = [window.edges for window in windows]
    edges = Edges(*(np.concatenate([getattr(part, name) for part in every]) for name in Edges.__annotations__))
    u, u_dc, control, index, cycle = (
        np.concatenate([getattr(window, name) for window in windows])
        for name in ("u", "u_dc", "control", "index", "cycle")
    )
    return Window(
        windows[0].T, np.concatenate([window.i for window in windows], 1), u, u_dc,
        np.concatenate(angles) if len(angles) == len(windows) else None,
        control, index, cycle, edges, windows[0].kind, windows[0].i_ref,
    )  # fmt: skip


def parts(angle: Floats, T: float, seconds: float = PART) -> list[slice]:
    """Cuts samples with an unwrapped electrical `angle`, shape (n,) rad, into parts of about so many `seconds`.

    Each part is of whole electrical turns, where one fits, and ends with the sample that the next one begins
    with, so that the differences from sample to sample belong to one part each.
    """
    n = len(angle)
    length = max(LEAST_PART, round(seconds / T))
    turn = math.tau / max(abs(float(angle[-1] - angle[0])) / max(n - 1, 1), 1e-12)
    whole = round(max(1, round(length / turn)) * turn)
    if whole < n:
        length = whole
    return [slice(begin, begin + length + 1) for begin in range(0, n - length, length)]
