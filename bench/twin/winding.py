"""Winding and inverter by the flux: over some PWM periods it changes by the integral of the voltage less R i.

    sum T u = R sum T i + [e^{j theta} (L_d i_d + j L_q i_q + psi_f + harmonics)] + dead time and devices

between two samples, exact for voltages that are held over a period. Everything but the encoder's zero and delay, and
the sensors' gains, is linear; these are found by small steps, each from where the last one came to. The drive's own
compensation of the dead time is known by its parameters, and belongs to the voltage.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bench.commission.window import Booleans, Complexes, Floats, Integers, clarke
from bench.twin.directions import Equations, Told, solved, spread
from bench.twin.samples import Stretch
from sim.legs import FADE

SPAN = 1e-3
"""s from one end of a window to the other, about."""
STEPS = 10
"""Times that zero, delay and gains are put right."""
ORDERS = (5, 7, 11, 13)
SIGNS = (-1, 1, -1, 1)
"""Of the harmonics of the flux: it turns that way."""
PHASES = np.exp(2j * math.pi / 3.0 * np.arange(3)) * 2.0 / 3.0
NAMES = (
    "R_s", "L_q", "L_d", "psi_f", "dead_time", "encoder_zero", "encoder_delay",
    *(f"emf_harmonic_{order}" for order in ORDERS), "gain_a", "gain_b", "i_smooth",
)  # fmt: skip
ZERO, DELAY, GAIN_A, GAIN_B, SMOOTH = 5, 6, 11, 12, 13
BY_STEPS = np.isin(np.arange(len(NAMES)), (ZERO, DELAY, GAIN_A, GAIN_B, SMOOTH))
"""Of `NAMES`: what is put right step by step."""
LEAST = 50
"""Windows."""


@dataclass(frozen=True)
class Start:
    """What is taken where nothing tells better: as the simulated drive's configuration has it."""

    R_s: float
    L_d: float
    L_q: float
    psi_f: float
    dead_time: float
    i_smooth: float
    emf_harmonics: Sequence[float]


@dataclass(frozen=True)
class Winding:
    """What was found, in SI units by the drive's own volts and amperes."""

    told: Told
    """By `NAMES`; harmonics as shares of the fundamental, gains relative to their mean."""
    shape: Floats
    """Of each, sd: what it differs by between slow and fast, small and large currents, beyond noise."""
    offset: Floats
    """A, (3,): of the current sensors."""
    residual: float
    """V rms, mean over a window."""

    def __getitem__(self, name: str) -> float:
        return float(self.told.x[NAMES.index(name)])

    def sd(self, name: str) -> float:
        """Of a quantity; 0 where it is kept."""
        return float(self.told.sd[NAMES.index(name)])

    def parts(self, name: str, method: float) -> dict[str, float]:
        """Standard deviations of a quantity by cause; `method`: what the method leaves."""
        return {"noise": self.sd(name), "method": method, "shape": float(self.shape[NAMES.index(name)])}

    def known(self, name: str) -> bool:
        """Whether the recordings tell it."""
        return self.told.known[NAMES.index(name)]

    def angle(self, theta: Floats, omega: Floats | float) -> Floats:
        """The rotor's electrical angle, rad, by the encoder's."""
        return theta - self["encoder_zero"] + self["encoder_delay"] * omega

    def gains(self) -> Floats:
        """Relative errors of the three sensors, (3,); their mean, which nothing tells, is 0."""
        a, b = self["gain_a"], self["gain_b"]
        return np.array([a, b, -a - b])

    def currents(self, stretch: Stretch) -> Floats:
        """A, (3, n): without offsets and gains."""
        assert stretch.i is not None
        return np.asarray((stretch.i - self.offset[:, None]) / (1.0 + self.gains()[:, None]))


def winding(stretches: Sequence[Stretch], start: Start, offset: Floats, noise: float) -> Winding | None:
    """By stretches with currents, voltages and the encoder at every period; None where there are too few windows."""
    used = [s for s in stretches if s.every and s.i is not None and s.u is not None and s.theta is not None]
    used = [s for s in used if s.u_dc is not None and s.on.sum() > 2 * round(SPAN / s.T)]
    x = np.array([
        start.R_s, start.L_q, 0.0, start.psi_f, start.dead_time, 0.0, 0.0,
        *(share * start.psi_f for share in start.emf_harmonics), 0.0, 0.0, start.i_smooth,
    ])  # fmt: skip
    ratio = start.L_d / start.L_q
    scale = np.array([
        0.3 * start.R_s, 0.3 * start.L_q, 0.3 * start.L_q, 0.3 * start.psi_f, 5e-7, math.radians(2.0), 5e-6,
        *(4 * [0.01 * start.psi_f]), 0.01, 0.01, 0.5 * start.i_smooth,
    ])  # fmt: skip
    if not used:
        return None
    of_noise = np.zeros((len(x), len(x)))  # of the difference of two samples of the current, a component
    of_noise[1:3, 1:3] = 2.0 / 3.0 * noise**2 * np.array([[1.0 + ratio**2, ratio], [ratio, 1.0]])
    for _ in range(STEPS):
        A, y, by = (np.concatenate(each) for each in zip(*(_rows(s, x, ratio, offset) for s in used), strict=True))
        if len(y) < 2 * LEAST:
            return None
        equations = Equations(A, y, scale, NAMES, each=2, noise=of_noise)
        told = solved(equations, np.where(BY_STEPS, 0.0, x))
        step = np.where(BY_STEPS, told.x, 0.0)
        step[ZERO], psi = math.atan2(x[3] * told.x[ZERO], told.x[3]), math.hypot(x[3] * told.x[ZERO], told.x[3])
        x = np.where(BY_STEPS, x, told.x) + step
        x[3] = psi  # an encoder may stand at any angle
        x[SMOOTH] = max(x[SMOOTH], 0.1 * start.i_smooth)
        if np.all(np.abs(step) < 1e-3 * scale):
            break
    shape = spread(equations, told, (by[:, 0], by[:, 1]))
    sd, psi = told.sd.copy(), float(x[3])
    x[2] += ratio * x[1]
    for one in (sd, shape):
        one[2] = math.hypot(one[2], ratio * one[1])
        one[7:11] /= psi
    x[7:11] /= psi
    found = replace(told, x=x, sd=sd)
    residual = float(np.sqrt(np.mean(told.residuals**2) * 2.0)) / SPAN
    return Winding(found, shape, offset, residual)


def _rows(s: Stretch, x: Floats, ratio: float, offset: Floats) -> tuple[Floats, Floats, Floats]:
    """Equations of a stretch about x, real ones of d and of q in turn, and of each its speed and its current."""
    assert s.i is not None
    assert s.u is not None
    assert s.theta is not None
    assert s.u_dc is not None
    T, m = s.T, max(4, round(SPAN / s.T))
    gains = np.array([x[GAIN_A], x[GAIN_B], -x[GAIN_A] - x[GAIN_B]])
    phases = (s.i - offset[:, None]) / (1.0 + gains[:, None])
    i = clarke(phases)
    omega = s.omega
    theta = s.theta - x[ZERO] + x[DELAY] * omega
    turned = np.exp(1j * theta)
    i_dq = i / turned
    psi = x[3]
    more = sum(
        (share / order * np.exp(1j * (sign * order - 1) * theta) for share, order, sign in
         zip(x[7:11], ORDERS, SIGNS, strict=True)), np.zeros(len(s), complex),
    )  # fmt: skip
    d_phases = -phases * PHASES[:, None]  # of the current vector by a gain
    flux = [
        turned * (ratio * i_dq.real + 1j * i_dq.imag), turned * i_dq.real, turned, 1j * turned * -(psi + more),
        1j * omega * turned * (psi + more),
        *(np.exp(1j * sign * order * theta) / order for order, sign in zip(ORDERS, SIGNS, strict=True)),
    ]  # fmt: skip
    L = x[1]
    per_gain = [d_phases[0] - d_phases[2], d_phases[1] - d_phases[2]]
    held = _held(s.on, m)
    if not len(held):
        return np.zeros((0, len(x))), np.zeros(0), np.zeros((0, 2))

    def integral(v: Complexes) -> Complexes:
        """Of what is given in each period up to a sample, over the windows."""
        sums = np.concatenate([[0.0], np.cumsum(v)]) * T
        return np.asarray(sums[held + m + 1] - sums[held + 1])

    def middle(v: Complexes) -> Complexes:
        return integral(np.concatenate([[0.0], 0.5 * (v[1:] + v[:-1])]))

    def change(v: Complexes) -> Complexes:
        return np.asarray(v[held + m] - v[held])

    mean, fade = 0.5 * (phases + np.roll(phases, 1, axis=1)), x[SMOOTH]
    lost = s.u_dc / T * _legs(mean, fade)
    wider = x[4] * s.u_dc / T * (PHASES @ np.where(np.abs(mean) < fade, -mean / fade**2, 0.0))
    given = s.u + _compensation(s, omega)
    columns = [
        middle(i), change(flux[0]), change(flux[1]), change(flux[2]), integral(lost), change(flux[3]), change(flux[4]),
        *(change(f) for f in flux[5:]), *(x[0] * middle(g) + L * change(g) for g in per_gain), integral(wider),
    ]  # fmt: skip
    back = np.exp(-1j * theta[held + m // 2])
    A, y = np.stack(columns, 1) * back[:, None], integral(given) * back
    both = np.stack([A.real, A.imag], 1).reshape(-1, len(columns))
    middles = held + m // 2
    by = np.repeat(np.abs(np.stack([omega[middles], i[middles]], 1)), 2, axis=0)
    return both, np.stack([y.real, y.imag], 1).reshape(-1), by


def _held(on: Booleans, m: int) -> Integers:
    """First samples of windows of m periods in which the outputs were on, and had been for four samples."""
    firsts = np.arange(4, len(on) - m, m)
    off = np.concatenate([[0], np.cumsum(~on)])
    held: Integers = firsts[off[firsts + m + 1] == off[firsts - 4]]
    return held


def _legs(phases: Floats, fade: float) -> Complexes:
    """What legs lose of 1 V, (n,), at these currents, (3, n), A; below `fade` in proportion."""
    return np.asarray(PHASES @ np.clip(phases / fade, -1.0, 1.0))


def _compensation(s: Stretch, omega: Floats) -> Complexes:
    """V, (n,), that the drive adds to its reference: by the currents as measured two samples before, turned on."""
    parameters = s.parameters
    share = parameters.get("dead_time_hat", 0.0) * parameters.get("dead_time_comp", 0.0)
    if not share or s.u_dc is None or s.i is None:
        return np.zeros(len(s), complex)
    turned = clarke(np.roll(s.i, 2, axis=1)) * np.exp(1.5j * s.T * omega)
    three = (turned * np.conj(PHASES[:, None] * 1.5)).real
    return np.asarray(share / s.T * s.u_dc * _legs(three, FADE * s.T / parameters.get("L_s_hat", 1.0)))
