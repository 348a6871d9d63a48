"""What level each Hall input had in each half of an electrical revolution, and where that was the wrong one.

An input that follows its magnet is 1 over one half of a revolution and 0 over the other, wherever its sensor stands. So
the mean over many revolutions tells where it should be 1, and each revolution whether it was. That holds for a wire
that is open half of the time as well as for one that is away for a millisecond.

Revolutions are told by the encoder, or by one of the inputs as long as its edges follow each other evenly: by that of
the four which the inputs follow best. One input that is well is enough to tell of the two others.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from bench.signal.hall_inputs import ALIKE, Bools, Inputs, lasting
from bench.signal.trace import SLOW, Edges, Floats, Ints

BINS = 24
"""Of a revolution."""
BESIDE = 4
"""Of them on either side of an edge that do not count, 60 deg: no edge was found farther from where it mostly is."""
PARTLY, WHOLLY = 0.02, 0.95
"""Of a half revolution, from which on some of it, and all of it, had the wrong level."""
FOLLOWS = 0.1
"""Share of revolutions in which an input has another level in one part than in another, below which it follows none."""
MOST_REVOLUTIONS, IN_A_ROW = 4000, 8
"""That are looked at, and how many in a row of them."""
LEAST = 8
"""Revolutions with which something tells enough of them."""
STEADY, IN_CHAIN = 1.3, 3
"""Times the revolution before it, that one may last to be told by an input, and how many must last so in a row: an edge
too many makes two that are alike."""
UNCLEAR = 0.3
"""Of how clearly inputs mostly follow each other, below which a revolution does not tell which way the shaft turned."""
ALL_WRONG, UNLIKE, MISSES = 0.03, 0.2, 0.2
"""What tells revolutions badly smears levels to both sides, no other input rises once in each of them, and some are
missing. What all wrong levels count, the logarithm of how often another input rises, and the share of revolutions that
are missing, against levels that are wrong both ways;"""
ENCODER = 0.05
"""and by how much the encoder is trusted more."""
SMEARED = 0.15
"""Share of levels that are wrong both ways, summed over the inputs, beyond which nothing told revolutions well."""
BY_OTHERS, SEEN_BY_OTHERS = 0.7, 0.3
"""Of the revolutions by the encoder, that another input must tell, and of what was wrong by it, that it must see."""


class Levels(NamedTuple):
    """What was wrong with the levels, by the input and the level that it had, each array (3, 2)."""

    share: Floats
    """Of the way over which the other level was right."""
    halves: Ints
    """Half revolutions with a part that was wrong,"""
    whole: Ints
    """and those that were wrong wholly."""
    revolutions: int
    """That were looked at."""
    high: Floats
    """(3,) share of all the time in which each input was 1, standing left out."""


class _Way(NamedTuple):
    """Revolutions that something tells, at edges (n,)."""

    place: Floats  # in revolutions; NaN where it is not known
    known: Bools  # whether it is told until the next edge
    step: Floats  # until then; 0 where it is not
    input: int | None  # that tells it, None for the encoder; it grows when the shaft turns back, too


def levels(edges: Edges, inputs: Inputs, tick_hz: float) -> Levels | None:
    """The levels of inputs between edges, in the order of time; None where nothing tells a revolution."""
    if len(edges.tick) < 2:
        return None
    found: list[tuple[float, int | None, Levels]] = []
    rises = inputs.changes.of(inputs.changes.high)
    at = np.searchsorted(edges.tick, rises.tick)
    high = np.average(edges.new[:-1, None] >> np.arange(3) & 1, axis=0, weights=lasting(edges))
    for way in _ways(edges, inputs, tick_hz):
        wrong = _wrong(_by_revolution(edges, way), high)
        if wrong.revolutions < LEAST:
            continue
        n = np.bincount(rises.input[way.known[at]], minlength=3)
        apart = np.abs(np.log((n + 1.0) / (np.abs(way.step).sum() + 1.0)))[np.arange(3) != way.input]
        unlikely = float(wrong.share.min(axis=1).sum() + ALL_WRONG * wrong.share.sum()) + UNLIKE * float(apart.min())
        found.append((unlikely - (ENCODER if way.input is None else 0.0), way.input, wrong))
    if not found:
        return None
    most = max(wrong.revolutions for _, _, wrong in found)
    _, told_by, best = min(found, key=lambda each: each[0] - MISSES * each[2].revolutions / most)
    if np.count_nonzero(best.share.max(axis=1) > 0.5) > 1 or best.share.min(axis=1).sum() > SMEARED:
        return None
    if told_by is None:  # what the encoder does wrong other inputs do not see
        for number in range(3):
            others = [f.share[number] for _, by, f in found if by not in (None, number)
                      and f.revolutions > BY_OTHERS * best.revolutions]  # fmt: skip
            if others and max(map(max, others)) < SEEN_BY_OTHERS * best.share[number].max():
                for each in (best.share, best.halves, best.whole):
                    each[number] = 0
    return best


def _ways(edges: Edges, inputs: Inputs, tick_hz: float) -> Iterator[_Way]:
    """By the encoder, and by each input, that rises once in a revolution."""
    together = np.append(np.diff(edges.stretch) == 0, False)
    as_it_should = math.isnan(inputs.ratio) or abs(abs(inputs.ratio) - 1.0) < ALIKE
    for ratio in (1.0,) if as_it_should else (1.0, abs(inputs.ratio)):  # an input that is away spoils the ratio, too
        omega, place = edges.omega / max(ratio, 1e-9), edges.theta / max(ratio, 1e-9) / math.tau
        same = np.append(omega[1:] * omega[:-1] > 0.0, False)
        yield _way(place, (np.abs(omega) >= SLOW) & same & together, None)
    for number in range(3):
        rises = inputs.changes.of((inputs.changes.input == number) & inputs.changes.high)
        if len(rises) < 3:
            continue
        lasts = np.diff(rises.tick) / tick_hz
        alike = np.maximum(lasts[1:], lasts[:-1]) < STEADY * np.minimum(lasts[1:], lasts[:-1])
        alike &= np.diff(rises.stretch[1:]) == 0
        alike &= np.diff(rises.stretch[:-1]) == 0
        chain = np.cumsum(np.insert(~alike, 0, True))
        even = (np.bincount(chain)[chain] >= IN_CHAIN) & (lasts < math.tau / SLOW)
        place = np.interp(edges.tick, rises.tick, np.arange(len(rises)), math.nan, math.nan)
        told = np.isfinite(place)
        known = np.zeros(len(place), bool)
        known[told] = even[np.minimum(place[told].astype(np.int64), len(even) - 1)]
        yield _way(place, known & together, number)


def _way(place: Floats, known: Bools, number: int | None) -> _Way:
    step = np.append(np.diff(place), math.nan)
    known = known & np.isfinite(step)
    return _Way(place, known, np.where(known, step, 0.0), number)


def _by_revolution(edges: Edges, way: _Way) -> Floats:
    """(3, r, BINS) share of each part of each revolution in which each input was 1."""
    known, step = way.known, way.step
    gone = np.abs(step)
    path = np.concatenate([[0.0], np.cumsum(gone)[:-1]])
    forth = known & (step >= 0.0)
    ahead = np.append(known[:-1] & known[1:] & (forth[1:] == forth[:-1]), False)  # goes on after the next edge
    starts = np.flatnonzero(known & ~np.insert(ahead[:-1], 0, False))
    ends = np.flatnonzero(known & ~ahead) + 1
    lo, hi = (f(way.place[starts], way.place[ends]) for f in (np.minimum, np.maximum))
    n = np.maximum(np.floor(hi) - np.ceil(lo), 0.0).astype(np.int64)
    run = np.repeat(np.arange(len(n)), n)
    first = np.ceil(lo)[run] + np.arange(len(run)) - np.repeat(np.cumsum(n) - n, n)
    every = -(-len(run) // MOST_REVOLUTIONS) or 1
    use = np.arange(len(run)) // IN_A_ROW % every == 0
    run, first = run[use], first[use]
    at = path[starts][run, None] + np.abs(first[:, None] + np.arange(BINS + 1) / BINS - way.place[starts][run, None])
    high = np.empty((3, len(run), BINS))
    for number in range(3):
        behind = np.concatenate([[0.0], np.cumsum(gone * (edges.new >> number & 1))[:-1]])
        high[number] = np.abs(np.diff(np.interp(at, path, behind), axis=1)) * BINS
    if way.input is None:
        return high
    constant = ((high < 1e-6) | (high > 1.0 - 1e-6)).all(axis=2).sum(axis=0)
    moves = constant < 2  # else one input alone changes: it bounces
    return _turned_alike(high[:, moves], run[moves]) if moves.any() else high[:, moves]


def _turned_alike(high: Floats, run: Ints) -> Floats:
    """With the parts in one order, where a shaft that turns back shows them the other way round.

    Revolutions in which it turns round are left out, and those beside them.
    """
    wave = np.exp(2j * math.pi * (np.arange(BINS) + 0.5) / BINS)
    sums = high @ wave  # (3, r)
    own = int(np.argmax(np.abs((sums / np.maximum(np.abs(sums), 1e-9)).sum(axis=1))))  # 1 in the same parts of all
    middle = float(np.angle(sums[own].sum()))
    apart = (sums * np.exp(-1j * middle)).imag
    along = np.linalg.eigh(apart @ apart.T)[1][:, -1] @ apart  # the order in which the others follow, and how clearly
    clear = np.flatnonzero(np.abs(along) > UNCLEAR * float(np.median(np.abs(along))))
    if not len(clear):
        return high[:, :0]
    here = np.arange(len(run))
    last = clear[np.maximum(np.searchsorted(clear, here, "right") - 1, 0)]
    after = clear[np.minimum(np.searchsorted(clear, here), len(clear) - 1)]
    last, after = np.where(run[last] == run, last, after), np.where(run[after] == run, after, last)
    back = along[last] < 0.0
    turned = (2 * round(middle / math.tau * BINS) - 1 - np.arange(BINS)) % BINS
    high[:, back] = high[:, back][:, :, turned]
    turns = np.flatnonzero(back[1:] != back[:-1])
    known = (back == (along[after] < 0.0)) & (run[last] == run)
    known[turns] = known[turns + 1] = False
    return high[:, known]


def _wrong(by_revolution: Floats, high: Floats) -> Levels:
    """Where inputs had the wrong level, by what they mostly have in each part of a revolution."""
    wrong = _off(by_revolution)
    misled = (wrong.max(axis=0) > 0.5).all(axis=0)  # one to 0 and another to 1 at once: no wires, told wrongly
    if misled.any():
        wrong = _off(by_revolution[:, ~misled])
    share = wrong.sum(axis=2) / max(1, wrong.shape[2])
    halves, whole = (np.count_nonzero(wrong > limit, axis=2) for limit in (PARTLY, WHOLLY))
    return Levels(share, halves, whole, wrong.shape[2], high)


def _off(high: Floats) -> Floats:
    """(3, 2, r) how much of each half revolution in which an input should have the other level it had 0, and 1."""
    found = np.zeros((3, 2, high.shape[1]))
    if not high.shape[1]:
        return found
    for number, own in enumerate(high):
        mean = own.mean(axis=0)
        mean = (np.roll(mean, 1) + mean + np.roll(mean, -1)) / 3.0
        should = mean > 0.5 * (mean.max() + mean.min())
        parts = [should != bool(level) for level in (0, 1)]
        for _ in range(BESIDE):
            parts = [part & np.roll(part, 1) & np.roll(part, -1) for part in parts]
        if np.ptp(mean) < FOLLOWS or not all(part.any() for part in parts):  # mostly it does not change at all
            parts[int(mean.mean() < 0.5)][:] = False
            parts[int(mean.mean() > 0.5)][:] = True
        for level, part in enumerate(parts):
            if part.any():
                found[number, level] = own[:, part].mean(axis=1) if level else 1.0 - own[:, part].mean(axis=1)
    return found
