"""Windings with their exact answers, period by period: by the exponential of their equations, by no rule of sums."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from bench.commission.window import Window, no_edges

Floats = NDArray[np.float64]
T = 1.0 / 16_000.0


@dataclass(frozen=True)
class Winding:
    """R (ohm), L (H) of an axis, K (V/(A s)): what the back-EMF of a rotor that rocks is for an integral of current."""

    R: float
    L: float
    K: float = 0.0

    def answer(self, u: Floats, start: float = 0.0) -> Floats:
        """Current (n + 1,) at the ends of n periods of constant voltage: L di/dt = u - R i - e, de/dt = K i."""
        system = np.array([[-self.R / self.L, -1.0 / self.L, 1.0 / self.L], [self.K, 0.0, 0.0], [0.0, 0.0, 0.0]])
        step = expm(system * T)
        state = np.array([start, 0.0, 0.0])
        i = [start]
        for volts in u:
            state[2] = volts
            state = step @ state
            i.append(float(state[0]))
        return np.array(i)


def phases(vector: NDArray[np.complex128]) -> Floats:
    """Phase currents, shape (3, n), of a vector i_alpha + j i_beta whose phases add up to zero."""
    turns = np.exp(-2j * np.pi / 3.0 * np.arange(3))
    return np.real(vector[None, :] * turns[:, None])


def window(
    i_dq: NDArray[np.complex128], u_dq: NDArray[np.complex128], angle: float = 0.0, u_dc: float = 24.0
) -> Window:
    """A window of currents and of the voltages that led to them, in the frame of a made angle; no noise, no offsets."""
    n, turn = len(i_dq), np.exp(1j * angle)
    return Window(
        T=T, i=phases(i_dq * turn), u=np.asarray(u_dq * turn), u_dc=np.full(n, u_dc), theta=None,
        control=np.full(n, angle), index=np.arange(n), cycle=np.zeros(n, bool), edges=no_edges(),
    )  # fmt: skip


def seen_by(
    window: Window, rng: np.random.Generator, noise: float = 0.0, gains: tuple[float, ...] = (1.0, 1.0, 1.0)
) -> Window:
    """The same through current sensors with gains and noise (A)."""
    return replace(window, i=window.i * np.array(gains)[:, None] + rng.normal(0.0, noise, window.i.shape))
