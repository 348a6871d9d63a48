"""How the Hall sensors are wired, where their ring sits, and rough edges, by the codes of a rotor that is dragged.

The angle that drags it is the phases' own, so it is known where the flux is without any sensor: the order of the codes
tells exchanged, inverted and open wires. A ring that sits elsewhere is an orientation and no fault; wires that are
rotated look the same as one that is turned by 120 deg, and need not be told from it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bench.commission.analysis.edges import HallEdges, quantities
from bench.commission.analysis.stretches import merged
from bench.commission.quantity import Quantity
from bench.commission.refusal import Refused
from bench.commission.window import Floats, Integers, Window
from bench.findings.finding import Finding, degrees, percent
from bench.findings.sensors import stuck
from bench.findings.wiring import CONNECT, Wired, ways
from bench.signal.edge_fit import OPENS
from bench.signal.hall_edges import mean_angle
from bench.signal.hall_inputs import INVERTED
from bench.signal.position import unwrapped, wrap, wrapped
from bench.signal.trace import INPUTS
from bench.signal.waveforms.sectors import SECTOR_WIDTH, SECTORS, steps_between

STEP = "Hall sensors"
FORWARD, BACKWARD, NEITHER = "forward", "backward", "neither"
IN_ORDER = 0.9
"""Of the edges, that must go one way for the codes to have an order."""
SELDOM = 0.05
"""Of the edges, below which codes that are none are disturbances, and not an inverted input."""
NEAR = math.radians(60.0)
"""rad from the mean of its kind, beyond which a change of an input does not count."""
CONTACT = 0.5
"""Changes of an input in an electrical turn, below which it has no contact: two belong there."""
ROUGH = math.radians(2.0)
"""rad, sd of an edge by the angle that drags the rotor: cogging does not cancel edge by edge (trial: 1.2 deg in the
median, 3.7 for 90 %)."""
HEAVY, HEAVY_BY_EDGES = 0.25, 0.4
"""Share of the current that drags the rotor, that turning the shaft may take: by the encoder, and by Hall edges, where
cogging counts, too."""


@dataclass(frozen=True)
class HallOrder:
    """How the Hall inputs answer to a rotor that is dragged."""

    order: str
    """FORWARD, BACKWARD or NEITHER, of the codes against the angle of the phases."""
    levels: tuple[int | None, ...]
    """Of a, b, c: the level at which an input that does not change stays; None of one that does."""
    wired: Wired | None
    """The wiring with the least that is not as specified, and where the ring then sits; None where none explains it."""
    others: tuple[Wired, ...]
    """Other wirings that explain the codes as well."""
    edges: HallEdges | None
    """By the wiring; rough."""
    in_order: float
    """Share of the edges that go the way of most."""
    lag: float = 0.0
    """rad, by which the rotor stays behind the angle that drags it, with half the sensors' hysteresis in it."""


@dataclass(frozen=True)
class _Changes:
    old: Integers
    new: Integers
    angle: Floats  # rad, of the phases, at the edge
    way: int


def hall_order(up: Sequence[Window], down: Sequence[Window]) -> HallOrder:
    """How the sensors are wired, of windows dragged forward and in reverse; no encoder is needed.

    Refused where no edges came in either direction.
    """
    seen = [_changes(windows, way) for windows, way in ((up, 1), (down, -1))]
    turns = sum(abs(float(np.ptp(w.control))) for w in _unwrapped([*up, *down])) / math.tau
    n = sum(len(each.old) for each in seen)
    flips = [sum(int(np.count_nonzero((each.old ^ each.new) >> k & 1)) for each in seen) for k in range(3)]
    if not n:
        raise Refused(
            STEP, "no Hall edge came while the rotor was dragged: look at the sensors' supply, and at their connector"
        )
    levels = tuple(_level(seen, k) if flips[k] < CONTACT * turns else None for k in range(3))
    mask = _inverted(seen)
    steps = np.concatenate([each.way * steps_between(each.old ^ mask, each.new ^ mask) for each in seen])
    forward, backward = (float(np.mean(np.sign(steps) == sign)) for sign in (1.0, -1.0))
    order = FORWARD if forward > IN_ORDER else BACKWARD if backward > IN_ORDER else NEITHER
    rises, falls, lags = np.full(3, math.nan), np.full(3, math.nan), []
    for k in range(3):
        for places, high in ((rises, True), (falls, False)):
            by_way = [_place(each, k, high) for each in seen]
            lags.append(0.5 * wrapped(by_way[0] - by_way[1]))
            places[k] = mean_angle(np.array(by_way)) if np.isfinite(by_way).all() else math.nan
    found = []
    if order != NEITHER and np.isfinite([rises, falls]).all():
        undone = np.array([mask >> k & 1 == 1 for k in range(3)])
        begin, end = np.where(undone, falls, rises), np.where(undone, rises, falls)
        found = ways(begin + (end - begin) % math.tau / 2.0, mask)
    found.sort(key=lambda w: (w.changes, w.inverted.bit_count(), abs(w.ring)))
    wired = found[0] if found else None
    edges = _edges(seen, wired) if wired is not None else None
    lag = float(np.nan_to_num(np.mean(lags)))
    return HallOrder(order, levels, wired, tuple(found[1:]), edges, max(forward, backward), lag)


def _unwrapped(windows: Sequence[Window]) -> list[Window]:
    return [replace(w, control=unwrapped(w.control)) for w in merged(windows, by_command=False)]


def _changes(windows: Sequence[Window], way: int) -> _Changes:
    """Edges within the windows, with the angle of the phases at each."""
    none = np.zeros(0, np.int64)
    parts: list[tuple[Integers, Integers, Floats]] = [(none, none, np.zeros(0))]
    for window in _unwrapped(windows):
        at = window.edges.index
        inside = (at >= window.index[0]) & (at <= window.index[-1])
        angle = np.interp(at[inside], window.index, window.control)
        kept = _onward(window.edges.old[inside] & 7, window.edges.new[inside] & 7)
        parts.append((window.edges.old[inside][kept] & 7, window.edges.new[inside][kept] & 7, angle[kept]))
    old, new, angles = zip(*parts, strict=True)
    return _Changes(np.concatenate(old), np.concatenate(new), np.concatenate(angles), way)


def _onward(old: Integers, new: Integers) -> list[int]:
    """Numbers of the edges without those that were taken back: cogging has a rotor that is dragged swing over them."""
    kept: list[int] = []
    for number in range(len(old)):
        if kept and old[number] == new[kept[-1]] and new[number] == old[kept[-1]]:
            kept.pop()
        else:
            kept.append(number)
    return kept


def _level(seen: Sequence[_Changes], number: int) -> int:
    """Level at which an input is most of the time."""
    return round(float(np.mean(np.concatenate([each.new for each in seen]) >> number & 1)))


def _inverted(seen: Sequence[_Changes]) -> int:
    """Bit of the input that is inverted beside the others, by which two codes are the rarest; 0 for none."""
    weight = np.bincount(np.concatenate([each.new for each in seen]), minlength=8)
    none = [float(weight[mask] + weight[7 ^ mask]) for mask in INVERTED]
    return INVERTED[int(np.argmin(none))] if none[0] > SELDOM * weight.sum() else 0


def _place(seen: _Changes, number: int, high: bool) -> float:
    """Where an input rises, or falls, to a rotor that turns forward; NaN where it never does."""
    rose = (seen.new >> number & 1) == 1
    changed = (seen.old ^ seen.new) >> number & 1 == 1
    angles = seen.angle[changed & (rose == (high == (seen.way > 0)))]
    if not len(angles):
        return math.nan
    return mean_angle(angles[np.abs(wrap(angles - mean_angle(angles))) < NEAR])


def _edges(seen: Sequence[_Changes], wired: Wired) -> HallEdges:
    """The six edges by the angle of the phases; each way has the mean of both, for friction's lag is not known."""
    places = []
    for sector, (sensor, rises) in enumerate(OPENS):
        at = wired.sensors.index(sensor)
        high = rises ^ bool(wired.inverted >> at & 1)
        both = mean_angle(np.array([_place(each, at, high) for each in seen]))
        places.append(wired.ring + sector * SECTOR_WIDTH + wrapped(both - wired.ring - sector * SECTOR_WIDTH))
    parts = {"method": ROUGH}
    up, down = quantities({"up": places, "down": places}, wired.ring, [parts] * (2 * SECTORS))
    of_ring = {"method": ROUGH / math.sqrt(SECTORS)}
    return HallEdges(Quantity("hall_offset", "rad", wired.ring, of_ring), up, down)


def verdicts(found: HallOrder, direction: int | None = None) -> Iterator[Finding]:
    """What is wrong with wires of motor, encoder and Hall sensors; `direction`: the encoder's, None without one.

    A ring that sits elsewhere is none of it.
    """
    for name, level in zip(INPUTS, found.levels, strict=True):
        if level is not None:
            cause, advice = stuck(name, level)
            yield Finding("dead", cause, (f"sensor {name} never changes while the rotor turns",), advice)
    if any(level is not None for level in found.levels):
        return
    encoder_back, hall_back = direction is not None and direction < 0, found.order == BACKWARD
    if found.order == NEITHER or found.wired is None:
        told = f"{percent(found.in_order)} of the edges follow one order"
        yield Finding(
            "hall_codes",
            "the Hall codes come in no order",
            (told,),
            "look for wires without contact and for disturbances",
        )
    elif encoder_back and hall_back:
        yield Finding(
            "motor_phases",
            "encoder and Hall sensors both run backwards: two motor phases are exchanged",
            ("the flux was turned forward",),
            "exchange two wires of the motor",
        )
        return
    if encoder_back:
        yield Finding(
            "encoder_reversed", "the encoder counts backwards", ("theta_enc falls while the flux is turned forward",),
            "exchange the encoder's tracks A and B, or set encoder_reverse",
        )  # fmt: skip
    if hall_back:
        yield from _exchanged(found, direction is not None)
    elif found.wired is not None and found.wired.inverted:
        turned = ", ".join(f"{w.name} with the ring at {degrees(w.ring)}" for w in (found.wired, *found.others))
        yield Finding(
            "wiring", found.wired.name, (f"that explains the codes: {turned}",), "set hall_invert_hat and hall_swap_hat"
        )


def _exchanged(found: HallOrder, encoder: bool) -> Iterator[Finding]:
    every = [w for w in (found.wired, *found.others) if w is not None and w.inverted in (0, 1, 2, 4)]
    by_ring = ", ".join(f"{w.name} with the ring at {degrees(w.ring)}" for w in every)
    cause = "two Hall wires are exchanged" if encoder else "two Hall wires are exchanged, or two motor phases"
    yield Finding(
        "wiring", cause, (f"the codes come in reverse order: {by_ring}",), f"{CONNECT}; else set hall_swap_hat"
    )


def orientation(found: HallOrder) -> Finding | None:
    """Where the ring sits: a note. None where the wiring is not known."""
    if found.wired is None:
        return None
    return Finding("ring", f"the Hall ring sits at {degrees(found.wired.ring)} (hall_offset)")


def heavy(share: float, current: float, i_max: float, most: float = HEAVY) -> Finding | None:
    """That the shaft is hard to turn: `share` of the `current`, A, that drags it, of a motor for `i_max`, A."""
    if share <= most:
        return None
    told = f"it takes {100.0 * share * current / i_max:.0f} % of i_max to turn the shaft"
    return Finding("heavy", f"{told}: something is attached, or it binds", (), "take off what is attached")
