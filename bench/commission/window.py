"""One stretch of what a drive measured at its PWM rate, as arrays, for the analysis of a step."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Complexes = NDArray[np.complex128]
Booleans = NDArray[np.bool_]


def clarke(i: Floats) -> Complexes:
    """Current vector i_alpha + j i_beta, amplitude invariant, shape (...), of phase currents, shape (3, ...)."""
    return np.asarray((2.0 * i[0] - i[1] - i[2]) / 3.0 + 1j * (i[1] - i[2]) / np.sqrt(3.0))


@dataclass(frozen=True)
class Edges:
    """Hall edges of a stretch, each an array of shape (m,)."""

    old: Integers
    """Code before the edge, 0 to 7, as the drive tells it."""
    new: Integers
    """Code after it."""
    index: Floats
    """When, on the same scale as `Window.index`."""
    count: Integers
    """Count of the encoder at the edge; all 0 without one."""

    def __len__(self) -> int:
        return len(self.index)


def no_edges() -> Edges:
    """Of a stretch in which none came."""
    none = np.zeros(0, np.int64)
    return Edges(none, none, np.zeros(0), none)


@dataclass(frozen=True)
class Window:
    """Samples of one stretch, evenly in time.

    At the PWM rate the voltage `u[k + 1]` is what lay on the winding between the samples `i[k]` and `i[k + 1]`, in the
    mean of that period (SPEC, chapter 13).
    """

    T: float
    """s, the PWM period."""
    i: Floats
    """A, shape (3, n): phase currents less their offsets."""
    u: Complexes
    """V, shape (n,): u_alpha + j u_beta as streamed, that is, without the compensation of the dead time."""
    u_dc: Floats
    """V, shape (n,)."""
    theta: Floats | None
    """rad, shape (n,): theta_enc as streamed, electrical by the drive's n_p and encoder_zero; None without encoder."""
    control: Floats
    """rad, shape (n,): theta_ctrl as streamed, the angle that the control used."""
    index: Integers
    """Of each sample, shape (n,), by the drive's clock: its number from one to the next."""
    cycle: Booleans
    """Shape (n,): a cycle of the test signal begins (bit 7 of status)."""
    edges: Edges = field(default_factory=no_edges)
    kind: str = ""
    """What was commanded: "up", "d+", "d-", "off", "q", "forced"."""
    i_ref: complex = 0j
    """A: i_d + j i_q commanded, where a current was."""
    every: int = 1
    """PWM periods from sample to sample: more than one where a link is slow and the shaft, too."""

    def __len__(self) -> int:
        return int(self.i.shape[1])

    @property
    def current(self) -> Complexes:
        """A, shape (n,): i_alpha + j i_beta."""
        return clarke(self.i)

    @property
    def dq(self) -> Complexes:
        """A, shape (n,): i_d + j i_q in the frame of the control's angle."""
        return np.asarray(self.current * np.exp(-1j * self.control))

    @property
    def u_dq(self) -> Complexes:
        """V, shape (n,): the voltage in the frame of the control's angle, sample by sample."""
        return np.asarray(self.u * np.exp(-1j * self.control))

    @property
    def seconds(self) -> float:
        """s that it lasts."""
        return len(self) * self.dt

    @property
    def dt(self) -> float:
        """s from sample to sample."""
        return self.every * self.T

    def last(self, seconds: float) -> Window:
        """Its last part of so many s."""
        return self._part(max(len(self) - max(round(seconds / self.dt), 2), 0), len(self))

    def until(self, other: Window) -> Window:
        """Its part up to where `other` ends."""
        return self._part(0, int(np.searchsorted(self.index * self.every, other.index[-1] * other.every, side="right")))

    def _part(self, begin: int, end: int) -> Window:
        edges, first, last = self.edges, self.index[begin], self.index[end - 1]
        inside = (edges.index >= first) & (edges.index <= last)
        part = slice(begin, end)
        return replace(
            self, i=self.i[:, part], u=self.u[part], u_dc=self.u_dc[part],
            theta=None if self.theta is None else self.theta[part], control=self.control[part],
            index=self.index[part], cycle=self.cycle[part],
            edges=Edges(edges.old[inside], edges.new[inside], edges.index[inside], edges.count[inside]),
        )  # fmt: skip


@dataclass(frozen=True)
class Wave:
    """A window under a square wave of `half` + `half` periods on `axis`, u_d or u_q, beside a d current of `bias` A."""

    window: Window
    axis: str
    half: int
    bias: float
