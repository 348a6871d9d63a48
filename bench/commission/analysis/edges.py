"""Where the Hall edges lie, both ways, and how late they are seen: by the encoder at speed, else by the back-EMF.

By the encoder each edge of a turn of the shaft has its own place, and a delay shows in how edges move with the speed
(`bench.signal.edge_fit`). Angles are of the rotor flux: the encoder's less what it is ahead by.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from bench.commission import least_squares
from bench.commission.analysis.back_emf import rotations
from bench.commission.analysis.flux import Flux
from bench.commission.analysis.stretches import merged
from bench.commission.quantity import Quantity
from bench.commission.refusal import Refused
from bench.commission.window import Floats, Window
from bench.signal import hall_inputs
from bench.signal.edge_fit import EdgeFit, fitted
from bench.signal.hall_edges import mean_angle
from bench.signal.position import unwrapped, wrap, wrapped
from bench.signal.trace import Edges
from bench.signal.waveforms.sectors import SECTOR_WIDTH, SECTORS, edge_passages

STEP = "edges"
DELAY_FLOOR = 4e-7
"""s, sd, of the delay of the sensors: where each edge of the turn was passed a few times only, `edge_fit` takes a part
of the delay for what pole pairs add, up to 0.6 us of synthetic benches that coast for 0.4 s."""
BLIND_FLOOR = math.radians(0.1)
"""rad, sd, of an edge by the back-EMF: of unkind benches 0.04 deg in the median, 0.24 at worst, the noise among it."""
PAIRS_FLOOR = math.radians(0.3)
"""rad, sd, of an edge of one pole pair against their mean, where they could not be told apart."""
SLOPE = 8e-3
"""s on either side of an edge over which its speed is taken."""
TICKS = 4096
"""Steps of a PWM period in which the time of an edge is counted here."""
USUAL_DELAY = 1e-5, 1e-5
"""s, by which Hall edges are seen late in drives, and its sd: for a shaft too slow to tell it."""
BLIND_DELAY_FLOOR = math.radians(0.15)
"""rad, sd, of what an edge by the back-EMF moves by from the slowest to the fastest speed, besides its delay."""
APART = 0.7
"""Of the fastest speed, that the slowest may be at most for a delay to be told."""
LEAST_PASSAGES = 3
"""Of each edge in each direction, by the back-EMF of each sign of the current."""


@dataclass(frozen=True)
class HallEdges:
    """Twelve edges as parameters of a drive: ideal minus actual angle, rad, from `ring` on."""

    ring: Quantity
    """rad, name `hall_offset`: where the ring sits."""
    up: tuple[Quantity, ...]
    """`edge_up_1` to `edge_up_6`, at standstill."""
    down: tuple[Quantity, ...]
    delay: Quantity | None = None
    """s, name `hall_delay`: by which edges are seen late, against currents and voltages; None where it is not told."""


def quantities(
    places: Mapping[str, Sequence[float]], ring: float, parts: Sequence[Mapping[str, float]]
) -> list[tuple[Quantity, ...]]:
    """Edges as parameters: `places` by `up` and `down`, six angles each, rad; `parts`: of the twelve, by cause."""
    by_cause = iter(parts)
    return [
        tuple(
            Quantity(f"edge_{way}_{s + 1}", "rad", wrapped(ring + s * SECTOR_WIDTH - place), next(by_cause))
            for s, place in enumerate(six)
        )
        for way, six in places.items()
    ]


def hall_edges(
    windows: Sequence[Window],
    found: Flux,
    n_p: int,
    counts: int = 0,
    step: float = 0.0,
) -> HallEdges:
    """The edges of windows with an encoder, in the order of time, at any speeds and currents.

    `counts`: of the encoder in a turn, below 0 where it counts down, 0 where they are not known; `step`: s between
    the times that edges can have. Refused for too few edges, codes that run backwards, and for one speed.
    """
    edges, tick_hz = _edges(windows, found, n_p, counts)
    if len(edges.tick) < 2 * SECTORS:
        raise Refused(
            STEP, f"{len(edges.tick)} Hall edges came while the shaft turned: look at the sensors' supply and wires"
        )
    inputs = hall_inputs.read(edges, tick_hz)
    if inputs.ratio < 0.0:
        raise Refused(STEP, "the Hall codes come in the reverse order of the encoder: put the wiring right first")
    fit = fitted(inputs, 1.0, n_p, max(step, 1.0 / tick_hz))
    _require_told(fit)
    assert fit is not None
    sits = mean_angle(fit.place - SECTOR_WIDTH * np.arange(SECTORS))
    half = 0.5 * fit.hysteresis
    eye = np.eye(SECTORS)
    noise = np.concatenate([fit.sd(np.hstack([eye, way * 0.5 * eye])) for way in (1.0, -1.0)])
    missing = 0.0 if fit.apart else PAIRS_FLOOR / math.sqrt(n_p) if n_p > 1 else 0.0
    by_count = _by_count(edges.omega, tick_hz / TICKS, n_p, counts)
    shared = {
        "zero": found.zero.sd,
        "pole pairs": missing,
        "encoder's counts": by_count,
        "delay": fit.speed * DELAY_FLOOR,
    }
    up, down = quantities(
        {"up": (fit.place + half).tolist(), "down": (fit.place - half).tolist()},
        sits,
        [{"noise": float(sd), **shared} for sd in noise],
    )
    delay = Quantity(
        "hall_delay", "s", float(np.mean(fit.delay)),
        {"noise": float(np.sqrt(np.mean(fit.delay_sd**2))), "encoder's delay": found.delay.sd,
         "encoder's counts": by_count / max(fit.fastest - fit.slowest, 1e-9), "method": DELAY_FLOOR},
    )  # fmt: skip
    of_ring = float(fit.sd(np.full((1, SECTORS), 1.0 / SECTORS))[0])
    return HallEdges(Quantity("hall_offset", "rad", sits, {"noise": of_ring, **shared}), up, down, delay)


def _by_count(omega: Floats, pwm_hz: float, n_p: int, counts: int) -> float:
    """rad, sd of the mean of the pole pairs' edges: one lies at one place within a count, while the shaft is slow.

    A shaft that passes more than a count from sample to sample meets each edge at another one each time.
    """
    if not counts:
        return 0.0
    step = math.tau * n_p / abs(counts)
    slow = float(np.mean(np.clip(1.5 - np.abs(omega) / pwm_hz / step, 0.0, 1.0)))
    return slow * step / math.sqrt(12.0 * n_p)


def _require_told(fit: EdgeFit | None) -> None:
    """Refused where places, both ways, or delays are not told."""
    if fit is None or not np.isfinite(fit.place).all():
        raise Refused(STEP, "not all six Hall edges were passed: turn the shaft by whole turns, both ways")
    if not np.isfinite(fit.hysteresis).all():
        raise Refused(STEP, "Hall edges were passed one way only: where they lie differs by the way; turn it both ways")
    if not np.isfinite(fit.delay).all():
        raise Refused(
            STEP,
            f"all edges were passed at about {fit.speed:.0f} rad/s: turn slower too, to tell places from delays",
        )


def _edges(windows: Sequence[Window], found: Flux, n_p: int, counts: int) -> tuple[Edges, float]:
    """Edges with the rotor flux's angle at each; a stretch of windows has one number, for edges may be lost between."""
    columns: list[tuple[Floats, ...]] = []
    T = 0.0
    for number, window in enumerate(w for w in merged(windows, by_command=False) if w.theta is not None):
        T = window.T
        theta, at = unwrapped(np.asarray(window.theta)), window.edges.index
        inside = (at >= window.index[0]) & (at <= window.index[-1])
        at = at[inside]
        around = SLOPE / T
        before, after = (np.clip(at + side, window.index[0], window.index[-1]) for side in (-around, around))
        gone = np.interp(after, window.index, theta) - np.interp(before, window.index, theta)
        w = gone / np.maximum((after - before) * T, 1e-12)
        angle = np.interp(at, window.index, theta)
        pairs = _pole_pair(angle, window.edges.count[inside], n_p, counts)
        size = np.abs(np.interp(at, window.index, np.abs(window.current)))
        columns.append(
            (np.round(at * TICKS), window.edges.old[inside], window.edges.new[inside],
             angle - math.tau * pairs - found.error(w), w, size, np.full(len(at), number))
        )  # fmt: skip
    if not columns:
        raise Refused(STEP, "no window has an encoder's angle")
    tick, old, new, theta, omega, size, stretch = (np.concatenate(column) for column in zip(*columns, strict=True))
    whole = (each.astype(np.int64) for each in (tick, old, new, stretch))
    tick, old, new, stretch = whole
    return Edges(tick, old, new, theta, omega, size, stretch), TICKS / T


def _pole_pair(angle: Floats, count: Floats, n_p: int, counts: int) -> int:
    """Electrical turns, 0..n_p - 1, by which the unwrapped `angle` of a stretch differs from that by the counts."""
    if not counts or not len(angle):
        return 0
    off = angle - n_p * math.tau * count / counts
    turns = np.round((off - mean_angle(off)) / math.tau).astype(np.int64) % n_p
    return int(np.argmax(np.bincount(turns)))


def edges_by_back_emf(windows: Sequence[Window], R: Quantity, L_q: Quantity) -> HallEdges:
    """The edges of windows of the kinds "d+" and "d-" at speed, without an encoder; pole pairs are not told apart.

    Refused where an edge was passed too seldom with either sign of the current, and for one speed.
    """
    every = list(_against_back_emf(windows, R.value, L_q.value))
    n = np.array([[sum(p.kind == kind and p.along == along for p in every) for along in (True, False)]
                  for kind in range(2 * SECTORS)])  # fmt: skip
    if n.min() < LEAST_PASSAGES:
        kind = int(np.argmin(n.min(axis=1)))
        raise Refused(
            STEP,
            f"the edge of sector {kind % SECTORS + 1} was passed {'forward' if kind < SECTORS else 'in reverse'} in "
            f"fewer than {LEAST_PASSAGES} parts of one sign of the current: turn it longer at speed, both ways",
        )
    kinds, w = np.array([p.kind for p in every]), np.array([p.w for p in every])
    fastest, slowest = float(np.abs(w).max()), float(np.abs(w).min())
    if slowest > APART * fastest:
        raise Refused(STEP, f"all edges were passed at about {fastest:.0f} rad/s: turn slower too, to tell their delay")
    off = np.array([p.off for p in every])
    near = np.array([mean_angle(off[kinds == kind]) for kind in range(2 * SECTORS)])
    along = np.array([1.0 if p.along else -1.0 for p in every]) * fastest / w
    columns = [(kinds[:, None] == np.arange(2 * SECTORS)).astype(float), along[:, None], w[:, None]]
    A, y, weights = np.hstack(columns), wrap(off - near[kinds]), np.sqrt([float(p.n) for p in every])
    told = least_squares.fit(A, y, weights)
    slow = np.abs(w) < 0.5 * (fastest + slowest)
    if min(slow.sum(), (~slow).sum()) > 2 * SECTORS:
        for own in (slow, ~slow):  # a slow shaft sways by cogging
            weights[own] /= math.sqrt(float(np.mean(told.residuals[own] ** 2)))
        told = least_squares.fit(A, y, weights)
    told = told.informed(told.x.size - 1, *USUAL_DELAY)
    by = {"noise": float(told.sd[-1]) * told.inflation(), "method": BLIND_DELAY_FLOOR / (fastest - slowest)}
    delay = Quantity("hall_delay", "s", float(told.x[-1]), by)
    late = by["method"] * slowest
    noise = (told.sd * told.inflation())[: 2 * SECTORS]
    places = near + told.x[: 2 * SECTORS] + SECTOR_WIDTH * np.tile(np.arange(SECTORS), 2)
    sits = mean_angle(places - SECTOR_WIDTH * np.tile(np.arange(SECTORS), 2))
    parts = [{"noise": float(sd), "delay": late, "method": BLIND_FLOOR} for sd in noise]
    up, down = quantities({"up": places[:SECTORS].tolist(), "down": places[SECTORS:].tolist()}, sits, parts)
    of_ring = {"noise": float(np.mean(noise)) / math.sqrt(len(noise)), "method": BLIND_FLOOR}
    return HallEdges(Quantity("hall_offset", "rad", sits, of_ring), up, down, delay)


class _Passed(NamedTuple):
    """Passages of one edge in a part of a window."""

    kind: int  # sector, and 6 more in reverse
    along: bool  # whether the current is along the flux
    w: float  # rad/s, electrical
    off: float  # rad, from where an ideal edge lies, in the mean
    n: int


def _against_back_emf(windows: Sequence[Window], R: float, L_q: float) -> Iterator[_Passed]:
    """Edges by the angle of the back-EMF."""
    for window in merged(windows):
        for rotation in rotations([window], R, L_q):
            inside = rotation.holds(window.edges.index)
            edge, way = edge_passages(window.edges.old[inside] & 7, window.edges.new[inside] & 7)
            off = wrap(rotation.theta(window.edges.index[inside]) - SECTOR_WIDTH * edge)
            forward = rotation.w > 0.0
            for sector in range(SECTORS):
                own = off[(edge == sector) & (way == (1 if forward else -1))]
                if len(own):
                    kind = sector + (0 if forward else SECTORS)
                    yield _Passed(kind, rotation.along, rotation.w, mean_angle(own), len(own))
