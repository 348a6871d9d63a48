"""Which of a drive's angles is late: the encoder's, that of the Hall edges, or that of the back-EMF.

What is seen tau late lies omega tau behind the rotor. A constant delay does not show in a speed, and nothing in the
stream knows the rotor: only differences between angles can be measured, over speeds that differ. Hall edges carry time
stamps of their own; the back-EMF e = u - (R_s + j omega L_s) i is made of the same samples as the encoder's angle, and
knows neither sensor. So two differences tell three delays, if the back-EMF is taken to be on time: an encoder that is
late makes both lead by as much, late Hall sensors make the edges lag alone. An estimate that leads where neither does
is the estimator's own doing.

The angle by the back-EMF is off by what the inductance is wrong by, in proportion to the q current: that is fitted
beside the delay, where the two can be separated. It is also off by what the inverter's voltage is not known to, over
the size of the back-EMF: at low speed more than a delay is worth, and then it counts as unknown. Nothing here judges a
sensor's place.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import Enum
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from bench.analysis.capture import Capture
from bench.analysis.channels import reference_angle
from bench.analysis.position import states, wrap
from bench.analysis.waveforms.sectors import SECTORS
from protocol.codes import DriveState
from protocol.signals import SECTOR_OF_CODE

F64 = NDArray[np.float64]

STATOR = ("u_alpha", "u_beta", "i_a", "i_b")
"""Channels that the back-EMF is made of."""
SLOW = 5.0
"""Electrical rad/s, below which the direction of a shaft is not sure."""
SLOPE = 8e-3
"""s on either side of a sample over which the speed is taken."""
SPREAD = 0.1
"""Of speeds about their mean, as a share of them, below which no delay is fitted."""
UNSURE = 0.03
"""V across the back-EMF, by which the inverter may be off: what a dead time's compensation leaves."""
LEAST, MOST = 200, 500_000  # samples, and
LEAST_EDGES, MOST_EDGES = 36, 300_000  # edges, that a delay is fitted to
FAR = math.radians(30.0)  # from the others of its kind, from which on an edge is none of them
ALIKE = 0.97  # correlation of speed and q current above which their effects cannot be separated
LATE = 30e-6
"""s, from which on a delay is one: the fits are good to about 10 us."""
AGREE = 25e-6  # s within which two delays are one


ASK_BACK_EMF = "let the drive turn the motor faster, and record u_alpha, u_beta, i_a and i_b: the back-EMF shows which"
ASK_EDGES = "record Hall edges at several speeds: they show which"
OF_ANOTHER_TIME = "currents and voltages are sampled at another time"


class Delays(NamedTuple):
    """Delay in s of Hall edges and back-EMF against the encoder; NaN where unknown."""

    edges: float
    back_emf: float


class Late(Enum):
    """What is late, or early."""

    NONE = "none"
    ENCODER = "encoder"
    HALL = "hall"
    BOTH = "both"
    UNCLEAR = "unclear"


def delays(capture: Capture) -> Delays:
    """Measure them, over all samples and edges of a shaft that turns."""
    evidence = Evidence(len(capture), len(capture.edges))
    evidence.add(capture)
    return evidence.delays()


class Evidence:
    """What the delays of a recording are told from, gathered piece by piece, in bounded memory.

    `samples`, `edges`: about how many there are: of more than `MOST` and `MOST_EDGES`, so many evenly spread ones are
    looked at.
    """

    def __init__(self, samples: int, edges: int) -> None:
        self._every, self._every_turn = -(-samples // MOST) or 1, -(-edges // MOST_EDGES) or 1
        self._samples = 0
        self._passages: list[Passages] = []
        self._emf: list[InFrame] = []

    def add(self, capture: Capture, own: slice = slice(None)) -> None:
        """Add the edges of a capture, and of its samples `own`, with as many as `SLOPE` takes on either side."""
        rows = np.arange(len(capture))[own]
        some = rows[-self._samples % self._every :: self._every]
        self._samples += len(rows)
        if not reference_angle(capture.samples.config.channels):
            return
        omega = speed(capture.theta, capture.t)
        turn = capture.edges.index // SECTORS
        self._passages.append(_passages(capture, omega, turn % self._every_turn == 0))
        if (in_frame := _in_frame(capture, omega, some)) is not None:
            self._emf.append(in_frame)

    def delays(self) -> Delays:
        """What they tell."""
        if self._samples < LEAST:
            return Delays(math.nan, math.nan)
        edges = _by_edges(_together(Passages, self._passages)) if self._passages else math.nan
        return Delays(edges, _by_back_emf(_together(InFrame, self._emf)) if self._emf else math.nan)


class Passages(NamedTuple):
    """Hall edges of a shaft that turns, (n,) each: which edge and way, angle by the encoder, speed."""

    kind: NDArray[np.int64]
    place: F64
    omega: F64


class InFrame(NamedTuple):
    """The back-EMF in the encoder's frame, (n,) each: as a complex number, V; electrical speed; q current."""

    still: NDArray[np.complex128]
    omega: F64
    size: F64
    torque: F64


def blame(found: Delays) -> tuple[Late, str]:
    """What is late by these delays, and how that is known, in words; where several causes fit, all are named."""
    edges, emf = found
    known = [delay for delay in found if not math.isnan(delay)]
    if all(abs(delay) < LATE for delay in known):
        return Late.NONE, ""
    edges_differ, emf_differs = _against(edges, "Hall edges", ""), _against(emf, "back-EMF", "s")
    if math.isnan(emf):
        other = "they are late" if edges > 0.0 else "the time stamps of samples are late against those of edges"
        return Late.UNCLEAR, f"{edges_differ}: the encoder is {_late(-edges)}, or {other}; {ASK_BACK_EMF}"
    if math.isnan(edges):
        return Late.UNCLEAR, f"{emf_differs}: the encoder is {_late(-emf)}, or {OF_ANOTHER_TIME}; {ASK_EDGES}"
    if abs(edges - emf) < AGREE:
        return Late.ENCODER, f"the encoder is {_late(-emf)}: {emf_differs}, and {edges_differ}"
    if abs(emf) < LATE and edges > 0.0:
        return Late.HALL, f"the Hall edges are {_late(edges)}: encoder and back-EMF agree"
    if abs(emf) < LATE:
        return Late.UNCLEAR, (
            f"{edges_differ}, and the back-EMF does not: no sensor sees an edge before it happens, so the time stamps "
            f"of samples are late against those of edges"
        )
    if abs(edges) < LATE:
        return Late.UNCLEAR, (
            f"{emf_differs}, and the Hall edges do not: encoder and Hall edges are both {_late(-emf)}, or "
            f"{OF_ANOTHER_TIME}; these data do not separate the two"
        )
    return Late.BOTH, (
        f"the encoder is {_late(-emf)} and the Hall edges are {_late(edges - emf)}, if the back-EMF is on time: "
        f"{emf_differs}, and {edges_differ}"
    )


def _passages(capture: Capture, speeds: F64, wanted: NDArray[np.bool_]) -> Passages:
    """The edges that are `wanted` and of a shaft that turns, among samples."""
    edges, at = capture.edges, capture.samples.tick
    sector = np.array(SECTOR_OF_CODE)
    old, new = sector[edges.hall_old & 7], sector[edges.hall_new & 7]
    omega = np.interp(edges.tick, at, speeds)
    way = np.select([(new - old) % 6 == 1, (old - new) % 6 == 1], [1, -1])
    good = (old >= 0) & (new >= 0) & (way * omega > SLOW) & (edges.tick >= at[0]) & (edges.tick <= at[-1]) & wanted
    return Passages((old * 6 + new)[good], wrap(capture.theta_at_edges()[good]), omega[good])


def _by_edges(passages: Passages) -> float:
    kinds, place, omega = passages
    if len(kinds) < LEAST_EDGES:
        return math.nan
    groups = []
    for kind in np.unique(kinds):
        of = kinds == kind
        off = wrap(place[of] - np.angle(np.exp(1j * place[of]).mean()))
        near = np.abs(off - np.median(off)) < FAR
        groups.append((off[near], omega[of][near]))
    delay, error = within_groups(groups)
    return delay if 2.0 * error < AGREE else math.nan


def _in_frame(capture: Capture, speeds: F64, some: NDArray[np.int64]) -> InFrame | None:
    """Of the samples `some` those of a shaft that is driven and turns; None where the drive does not tell enough."""
    resistance, inductance = (capture.parameters.get(name) for name in ("R_s_hat", "L_s_hat"))
    if resistance is None or inductance is None or any(name not in capture for name in STATOR):
        return None
    theta, omega = capture.theta[some], speeds[some]
    u, i = (vector[some] for vector in stator(capture))
    e = u - (resistance + 1j * omega * inductance) * i
    size = np.abs(e)
    use = driven(capture)[some] & (np.abs(omega) > SLOW) & (size > UNSURE)
    # the voltage is that of the period that ends at the sample: it is half a period old
    at_samples = theta - 0.5 * omega / capture.samples.config.pwm_hz
    still = (e * np.exp(-1j * at_samples) * np.sign(omega) / 1j)[use]
    return InFrame(still, omega[use], size[use], (i * np.exp(-1j * theta)).imag[use])


def _by_back_emf(emf: InFrame) -> float:
    still, omega, size, torque = emf
    if len(omega) < LEAST or omega.std() < SPREAD * np.abs(omega).max():
        return math.nan
    terms = [np.ones(len(omega)), omega]
    if torque.std() > 0.0 and abs(np.corrcoef(torque, omega)[0, 1]) < ALIKE:
        terms.append(torque)
    angles = [-np.angle(still / still.mean()), UNSURE / size, UNSURE / size * np.sign(omega)]
    slope, *errors = _fitted(terms, angles, size)[1]
    return float(slope) if np.abs(errors).max() < AGREE else math.nan


Parts = TypeVar("Parts", Passages, InFrame)


def _together(kind: type[Parts], parts: Sequence[Parts]) -> Parts:
    return kind(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def speed(theta: F64, t: F64) -> F64:
    """Speed at each sample from the samples `SLOPE` before and after it."""
    n = len(theta)
    reach = max(1, round(SLOPE / float(np.median(np.diff(t))))) if n > 1 else 1
    before, after = np.maximum(np.arange(n) - reach, 0), np.minimum(np.arange(n) + reach, n - 1)
    slope: F64 = (theta[after] - theta[before]) / np.maximum(t[after] - t[before], 1e-9)
    return slope


def stator(capture: Capture) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Voltage and current vectors, (n,) each, V and A."""
    i_a, i_b = capture["i_a"], capture["i_b"]
    return capture["u_alpha"] + 1j * capture["u_beta"], i_a + 1j * (i_a + 2.0 * i_b) / math.sqrt(3.0)


def driven(capture: Capture) -> NDArray[np.bool_]:
    """Where the outputs were on, and had been for eight samples."""
    on = np.ones(len(capture), bool)
    if (state := states(capture.samples)) is not None:
        on = state == DriveState.RUNNING
    return np.convolve(on, np.ones(9), "full")[: len(on)] > 8.5


def within_groups(groups: Sequence[tuple[F64, F64]]) -> tuple[float, float]:
    """Slope of angles over speeds, s, common to groups (angles, speeds) that each have a place of their own.

    With its standard error; NaN where the speeds of each group are too much alike.
    """
    groups = [(angles, omega) for angles, omega in groups if len(omega) > 1]
    if not groups:
        return math.nan, math.nan
    angles = np.concatenate([angles - angles.mean() for angles, _ in groups])
    speeds = np.concatenate([omega - omega.mean() for _, omega in groups])
    size = np.concatenate([omega for _, omega in groups])
    freedom = len(angles) - len(groups) - 1
    if freedom < 2 * len(groups) or speeds.std() < SPREAD * math.sqrt(float(np.mean(size**2))):
        return math.nan, math.nan
    square = float(np.sum(speeds**2))
    slope = float(np.sum(angles * speeds)) / square
    rest = angles - slope * speeds
    return slope, math.sqrt(float(np.sum(rest**2)) / freedom / square)


def _fitted(terms: list[F64], angles: list[F64], weight: F64) -> F64:
    """Coefficients (terms, angles) of the combinations of `terms` that are nearest to `angles`, (n,) each."""
    left, right = (np.stack(columns, 1) * weight[:, None] for columns in (terms, angles))
    return np.linalg.lstsq(left, right, rcond=None)[0].astype(np.float64)


def _against(delay: float, what: str, ending: str) -> str:
    return f"the {what} {'lag' if delay > 0.0 else 'lead'}{ending} the encoder by {1e6 * abs(delay):.0f} us"


def _late(delay: float) -> str:
    return f"{1e6 * abs(delay):.0f} us {'late' if delay > 0.0 else 'early'}"
