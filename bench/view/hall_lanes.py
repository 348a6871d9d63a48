"""The Hall code over time, as the Hall view needs it: at every edge, and again and again in between.

A view of the last moments finds nothing while the shaft rests, or before it has turned, if only edges are logged.
Between edges the code comes from the channel `hall`, where it is streamed, else from the last edge. A drive that
streams `hall` but no edges has its edges told by the samples.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bench.record.info import RunInfo

REPEAT = 0.05  # s after an edge, and from row to row where there is none
UNKNOWN_CODE = 8  # before the first edge, without the channel `hall`

I64 = NDArray[np.int64]
Codes = NDArray[np.uint8]

_REPEAT_NS = round(REPEAT * 1e9)
_NEVER = -(1 << 62)  # ns


class HallLanes:
    """Takes the edges and samples of a block, edges first, and gives the rows to log. All times are in ns."""

    def __init__(self, run: RunInfo) -> None:
        self._wanted = run.hall
        self._channel = "hall" in run.words
        self.restart()

    def restart(self) -> None:
        """Start anew: the drive has rebooted."""
        self._edges_come = False
        self._slot = _NEVER  # number of the last interval of REPEAT that a sample was seen in
        self._times, self._codes = np.array([_NEVER]), np.array([UNKNOWN_CODE], np.uint8)  # last edge, edges since
        self._repeats: list[tuple[I64, Codes]] = []

    def edges(self, t_ns: I64, codes: Codes) -> None:
        """Take edges at `t_ns` and the codes after them, both of shape (n,)."""
        self._edges_come = True
        self._add(t_ns, codes & np.uint8(7))

    def samples(self, t_ns: I64, raw: NDArray[np.void]) -> None:
        """Take samples at `t_ns`, shape (n,): they tell how far the drive has come, and the code if they hold it."""
        if not self._wanted:
            return
        hall = (raw["hall"] & 7).astype(np.uint8) if self._channel else None
        if hall is not None and not self._edges_come:
            rows = np.flatnonzero(np.diff(hall, prepend=self._codes[-1]))
            self._add(t_ns[rows], hall[rows])
        slots = t_ns // _REPEAT_NS
        rows = np.flatnonzero(np.diff(slots, prepend=self._slot))
        self._slot = int(slots[-1])
        last = np.searchsorted(self._times, t_ns[rows], side="right") - 1
        rested = t_ns[rows] - self._times[last] >= _REPEAT_NS
        rows, last = rows[rested], last[rested]
        self._repeats.append((t_ns[rows], self._codes[last] if hall is None else hall[rows]))

    def take(self) -> tuple[I64, Codes]:
        """Return the rows since the last call: times and codes, both of shape (n,), in order of time; n may be 0."""
        parts = [(self._times[1:], self._codes[1:]), *self._repeats]
        self._times, self._codes, self._repeats = self._times[-1:], self._codes[-1:], []
        times, codes = (np.concatenate(column) for column in zip(*parts, strict=True))
        order = np.argsort(times, kind="stable")
        return times[order], codes[order]

    def _add(self, t_ns: I64, codes: Codes) -> None:
        self._times, self._codes = np.concatenate([self._times, t_ns]), np.concatenate([self._codes, codes])
