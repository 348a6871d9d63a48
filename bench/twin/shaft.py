"""Shaft by its own motion: over a window, weighed by a function phi that is 0 at both ends, with its slope,

    sum phi tau_e = J sum phi'' theta_m - b sum phi' theta_m + tau_c sum phi sign(omega) - cogging + load - late

so that the encoder's angle is never differentiated. Long windows tell inertia and friction, short ones cogging. The
torque is that of the currents and of the magnet's flux, as the winding was found. `late`: currents that are sampled
late lack (R i_q + omega psi) / L_q times that; a shaft that coasts with the outputs off tells it from b.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bench.commission.window import Floats, clarke
from bench.twin.directions import Equations, Told, solved, spread
from bench.twin.samples import Stretch
from bench.twin.winding import ORDERS, SIGNS, Winding

NAMES = ("J", "b", "tau_coulomb", "cogging_6", "cogging_12", "current_delay")
LATE = 5
"""Of `NAMES`."""
USUAL_LATE = 5e-7
"""s, sd, by which currents are late where nothing tells it."""
LONG, SHORT = 0.05, 0.006
"""s, the windows' lengths."""
SLOW = 0.05
"""Of the fastest speed, below which dry friction has another shape, and a window counts for nothing."""
LEAST = 20
"""Windows of each length."""


@dataclass(frozen=True)
class Start:
    """What is taken where nothing tells better."""

    J: float
    b: float
    tau_coulomb: float
    cogging: Sequence[float]


@dataclass(frozen=True)
class Shaft:
    """What was found, by `NAMES`: kg m2, N m s/rad, N m."""

    told: Told
    shape: Floats
    """Of each, sd: what it differs by between slow and fast, and between both ways, beyond noise."""
    residual: float
    """N m rms, of a long window."""
    loaded: bool
    """Whether the load's torque was recorded."""
    late_as_b: float
    """N m s/rad by s: what currents that are late look like in b."""


def shaft(stretches: Sequence[Stretch], start: Start, found: Winding, n_p: int, torque: float) -> Shaft | None:
    """By stretches with currents and the encoder; None with too few windows in motion. `torque`: rated, N m."""
    used = [s for s in stretches if s.i is not None and s.theta is not None]
    fastest = max((float(np.abs(s.omega).max()) for s in used), default=0.0)
    blocks = []
    for seconds in (LONG, SHORT):
        own = [_rows(s, found, n_p, seconds, SLOW * fastest) for s in used if len(s) > seconds / s.T]
        A, y = (np.concatenate(each) for each in zip(_none(), *own, strict=True))
        blocks.append((A, y))
    if min(len(y) for _, y in blocks) < LEAST:
        return None
    x = np.array([start.J, start.b, start.tau_coulomb, *start.cogging, 0.0])
    scale = np.array([
        0.3 * start.J, max(0.5 * start.b, 1e-9), max(0.5 * start.tau_coulomb, 1e-9), *(2 * [0.01 * torque]), USUAL_LATE,
    ])  # fmt: skip
    at = x
    for _ in range(2):
        rms = [max(float(np.sqrt(np.mean((y - A @ at) ** 2))), 1e-12) for A, y in blocks]
        weights = np.concatenate([np.full(len(y), 1.0 / one) for (_, y), one in zip(blocks, rms, strict=True)])
        A, y = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
        equations = Equations(A, y, scale, NAMES, weights=weights)
        told = solved(equations, x)
        at = told.x
    rest = blocks[0][1] - blocks[0][0] @ at
    shape = spread(equations, told, (np.abs(A[:, 1]), A[:, 1]))
    loaded, late_as_b = any(s.load is not None for s in used), 1.5 * (n_p * found["psi_f"]) ** 2 / found["L_q"]
    return Shaft(told, shape, float(np.sqrt(np.mean(rest**2))), loaded, late_as_b)


def _rows(s: Stretch, found: Winding, n_p: int, seconds: float, slow: float) -> tuple[Floats, Floats]:
    """Equations of a stretch, N m: its windows of so many s, half of each in the next."""
    assert s.theta is not None
    m = max(8, round(seconds / s.T))
    share = (np.arange(m) + 0.5) / m
    phi = 8.0 / 3.0 * np.sin(math.pi * share) ** 4 / m  # of mean 1
    by_T = math.pi / (m * s.T)
    sin, cos = np.sin(math.pi * share), np.cos(math.pi * share)
    first = 8.0 / 3.0 / m * 4.0 * by_T * sin**3 * cos
    second = 8.0 / 3.0 / m * 4.0 * by_T**2 * (3.0 * sin**2 * cos**2 - sin**4)
    omega = s.omega
    theta = found.angle(s.theta, omega)
    torque = torques(s, found, n_p, theta) - (0.0 if s.load is None else s.load)
    i_q = (s.current * np.exp(-1j * theta)).imag
    psi = found["psi_f"]
    late = np.where(s.on, 1.5 * n_p * psi * (found["R_s"] * i_q + omega * psi) / found["L_q"], 0.0)
    firsts = np.arange(0, len(s) - m + 1, m // 2)
    moves = np.array([float(np.abs(omega[k : k + m]).min()) > slow for k in firsts], bool)
    at = firsts[moves][:, None] + np.arange(m)
    if not len(at):
        return _none()
    way = s.theta[at] / n_p
    way = way - way[:, :1]
    columns = [
        way @ second, -(way @ first), np.sign(omega[at]) @ phi, -np.sin(6.0 * theta[at]) @ phi,
        -np.sin(12.0 * theta[at]) @ phi, -late[at] @ phi,
    ]  # fmt: skip
    return np.stack(columns, 1), torque[at] @ phi


def _none() -> tuple[Floats, Floats]:
    """No equations."""
    return np.zeros((0, len(NAMES))), np.zeros(0)


def torques(s: Stretch, found: Winding, n_p: int, theta: Floats) -> Floats:
    """N m, (n,), without cogging; 0 where no current can flow."""
    i = np.where(s.rest, 0.0, clarke(found.currents(s))) * np.exp(-1j * theta)
    psi = found["psi_f"]
    flux = psi + found["L_d"] * i.real + 1j * found["L_q"] * i.imag
    for order, sign in zip(ORDERS, SIGNS, strict=True):
        own = psi * found[f"emf_harmonic_{order}"] / order
        flux = flux + own * sign * order * np.exp(1j * (sign * order - 1) * theta)
    return np.asarray(1.5 * n_p * (np.conj(flux) * i).imag)
