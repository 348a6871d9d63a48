"""What each Hall input did: where it changed for good, and where it changed and was soon back.

An input that is back before the shaft has gone a part of an electrical revolution saw no edge of the rotor twice: the
two changes are a return. One at the place of an edge is a bounce, one elsewhere a pulse, a long one a contact that
opened. How far the shaft went meanwhile is told by its speed, never by a fixed time. Where it does not turn, or turns
round, nothing is a return: a shaft that trembles about an edge passes it each time.

Revolutions are those of the sectors, with their sign: what returns sums to nothing. A motor with one input inverted, or
with sensors 60 deg apart, has 000 and 111 among its codes and lacks two others, which `usual` finds out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.signal.trace import SLOW, Edges, Floats, Ints
from bench.signal.waveforms.sectors import SECTOR_WIDTH, SECTORS, steps_between

Bools = NDArray[np.bool_]
INVERTED = (0, 1, 2, 4)
"""Inputs that may be inverted beside the others, as bits; all three inverted, or two, look like a turned ring."""
RETURNS, EVEN_RETURNS, BLIND_RETURNS = math.radians(75.0), math.radians(25.0), math.radians(10.0)
"""rad that the shaft may have gone when an input is back, with an encoder and without: edges of one input are more than
120 deg apart, wherever sensors of motors were found. Without one, a shaft that rocks goes back by a fifth of a sector,
but not among sectors that last about alike."""
TURNS_ROUND = 0.2
"""Of the speed at the edges around, with which a shaft that turns round between them may undo an edge itself."""
CHAIN = 4
"""Returns in a row that may belong to one edge, besides the first."""
EVEN = 1.4
"""Times the quickest of three sectors, that the slowest lasts where they are about alike."""
SWAYS = 15.0
"""Electrical rad/s below which no sectors are alike: a driven shaft may sway there and its sectors last alike."""
NEAR = math.radians(15.0)
"""rad from an edge of the same input within which a return is at that edge."""
MOSTLY = 0.5
"""Of the returns that do not lie at edges by chance, that must lie there where an input bounces."""
CHANCE = 1e-4
"""With which so many of them would lie at edges, wherever they came, below which they belong there."""
STOPPED = 0.02
"""Ratio of encoder to sectors, below which the encoder does not turn."""
ALIKE = 0.1
"""By which that ratio may differ from one where encoder and sectors turn alike."""
UNSURE = 0.03
"""Scatter of that ratio, as a share of it, above which it is no better than one."""
PAUSE = 3.0
"""Times the quicker of the two beside it, that a sector lasts in which the shaft stood."""


class Net(NamedTuple):
    """Sectors gone, where each was first reached; each array (k,). A reversal is believed after three sectors."""

    at: Ints
    """Indices of edges,"""
    tick: Ints
    """and their ticks."""
    sectors: Ints
    """Since the first edge, with their sign."""


@dataclass(frozen=True)
class Changes:
    """Changes of single inputs, each array (m,), in the order of time."""

    input: Ints
    """0..2: a, b, c."""
    high: Bools
    """Whether it rose."""
    tick: Ints
    theta: Floats
    """Electrical angle by the encoder, rad, unwrapped; NaN without one."""
    omega: Floats
    """Electrical speed, rad/s, by the encoder, else by the Hall edges; 0 where the shaft does not turn."""
    stretch: Ints
    """Of the edges, without a gap."""
    sectors: Ints
    """Gone since the first edge."""

    def __len__(self) -> int:
        return len(self.tick)

    def of(self, which: Bools | Ints) -> Changes:
        """Some of them."""
        return Changes(*(getattr(self, name)[which] for name in Changes.__annotations__))


@dataclass(frozen=True)
class Returns:
    """Changes that were soon undone, each array (k,)."""

    input: Ints
    high: Bools
    """Whether the input was 1 meanwhile."""
    tick: Ints
    width: Floats
    """s."""
    travel: Floats
    """rad that the shaft went meanwhile."""
    near: Bools
    """Whether it was within `NEAR` of an edge of the same input,"""
    at_edge: Bools
    """or followed one that was."""
    current: Floats
    """Size of the current vector then, A; NaN where no current was recorded."""

    def __len__(self) -> int:
        return len(self.tick)


@dataclass(frozen=True)
class Inputs:
    """What three Hall inputs did."""

    inverted: int
    """Bits of the input that is inverted beside the others; 0: none is."""
    net: Net
    changes: Changes
    """Without what returned."""
    returns: Returns
    ratio: float
    """Electrical revolutions by the encoder for each by the sectors, below 0 where it counts the other way; NaN without
    an encoder, and where too little tells."""
    scatter: float
    """Of that ratio from revolution to revolution, as a share of it; NaN likewise."""

    @property
    def turns(self) -> tuple[float, float]:
        """Electrical revolutions by the sectors, in the order of the codes and against it."""
        steps = np.diff(self.net.sectors, prepend=0)
        return float(steps[steps > 0].sum()) / SECTORS, float(-steps[steps < 0].sum()) / SECTORS

    @property
    def reach(self) -> float:
        """Electrical revolutions between the farthest places that the shaft was at."""
        return float(np.ptp(self.net.sectors)) / SECTORS if len(self.net.sectors) else 0.0

    @property
    def away(self) -> float:
        """rad for each of its edges that the input that returns the most is away."""
        away = np.bincount(self.returns.input, self.returns.travel, minlength=3)
        return float((away / np.maximum(np.bincount(self.changes.input, minlength=3), 1)).max())

    @property
    def steps(self) -> Ints:
        """(m,) sectors gone at each change, with their sign, those of a shaft that sways too."""
        changes, code, n = self.changes, np.full(len(self.changes) + 1, self.inverted), np.arange(len(self.changes))
        for number in range(3):
            own = np.flatnonzero(changes.input == number)
            if len(own):
                last = np.searchsorted(own, n, "right") - 1
                levels = np.where(last < 0, ~changes.high[own[0]], changes.high[own[last]])
                code[1:] ^= levels.astype(np.int64) << number
                code[0] ^= int(not changes.high[own[0]]) << number
        gone: Ints = steps_between(code[:-1], code[1:]).astype(np.int64)
        return gone


def read(edges: Edges, tick_hz: float) -> Inputs:
    """What the inputs did by their edges, in the order of time."""
    inverted = usual(edges)
    net = net_sectors(edges, inverted)
    ratio, scatter = _ratio(edges.theta[net.at], net.sectors, edges.stretch[net.at])
    unsure = scatter > UNSURE and abs(math.log2(max(abs(ratio), 0.1))) < 1.0  # pulses hide it
    if unsure or (not abs(abs(ratio) - 1.0) < ALIKE and _half_turns(edges) >= 2):  # or an input misses edges
        ratio = math.copysign(1.0, ratio)
    if abs(ratio) > STOPPED:
        omega, most = edges.omega / ratio, np.full(len(edges.tick), RETURNS)
        omega = np.where(np.abs(omega) >= SLOW, omega, 0.0)  # NaN too
    else:
        omega, even = speed_by_sectors(edges.tick / tick_hz, net, edges.stretch)
        most = np.where(even, EVEN_RETURNS, BLIND_RETURNS)
    sectors = np.append(net.sectors, 0)
    sectors_at = sectors[np.searchsorted(net.at, np.arange(len(edges.tick)), "right") - 1]
    kept, gone = [], []
    for number in range(3):
        at = np.flatnonzero((edges.old ^ edges.new) >> number & 1)
        high = edges.new[at] >> number & 1 == 1
        stays, first, second = _settled(edges.tick[at] / tick_hz, high, omega[at], edges.stretch[at], most[at])
        one = Changes(
            np.full(len(at), number),
            high,
            edges.tick[at],
            edges.theta[at],
            omega[at],
            edges.stretch[at],
            sectors_at[at],
        )
        own = _returned(one, stays, first, second, tick_hz, edges.current[at])
        kept.append(one.of(_first_of_bounces(one, stays, first, own, tick_hz)))
        gone.append(own)
    changes = Changes(*(np.concatenate([getattr(one, name) for one in kept]) for name in Changes.__annotations__))
    returns = Returns(*(np.concatenate([getattr(one, name) for one in gone]) for name in Returns.__annotations__))
    order = np.argsort(changes.tick, kind="stable")
    return Inputs(inverted, net, changes.of(order), returns, ratio, scatter)


def usual(edges: Edges) -> int:
    """Which input is inverted beside the others, as bits: with it, the two codes that are none are the rarest.

    By the time that each code lasted, standing left out; 0 where no input inverted explains the codes much better.
    """
    if len(edges.tick) < 2:
        return 0
    weight = np.bincount(edges.new[:-1] & 7, lasting(edges), minlength=8)
    none = [float(weight[mask] + weight[7 ^ mask]) / float(weight.sum() or 1.0) for mask in INVERTED]
    best = int(np.argmin(none))
    return INVERTED[best] if none[best] < 0.1 and none[0] > max(0.2, 3.0 * none[best]) else 0


def lasting(edges: Edges) -> Floats:
    """How long each code lasted until the next, ticks (n - 1,), two edges or more; standing counts little."""
    lasts = np.diff(edges.tick).astype(np.float64)
    return np.clip(lasts, None, 3.0 * float(np.median(lasts)))


def net_sectors(edges: Edges, inverted: int) -> Net:
    """Sectors gone, by the codes with the bits `inverted`."""
    gone = np.cumsum(steps_between(edges.old ^ inverted, edges.new ^ inverted)).astype(np.int64)
    at = reached(gone)
    return Net(at, edges.tick[at], gone[at])


def reached(gone: Ints) -> Ints:
    """Where sectors, counted with their sign (n,), were first reached; a reversal is believed after three."""
    at: list[int] = []
    reach, way = 0, 1
    for k, now in enumerate(gone.tolist()):
        ahead = (now - reach) * way
        if ahead > 0 or ahead < -2:  # two false pulses, one up and one down, are no reversal
            way = way if ahead > 0 else -way
            reach = now
            at.append(k)
    return np.array(at, np.int64)


def _ratio(theta: Floats, sectors: Ints, stretch: Ints) -> tuple[float, float]:
    """Angle by the encoder for that by the sectors, over whole revolutions in one direction, and its scatter.

    Over none in which edges may have been lost.
    """
    way = np.concatenate([[0.0], np.cumsum(np.sign(np.diff(sectors)))]) if len(sectors) else np.zeros(0)
    first = np.arange(0, len(sectors) - SECTORS, SECTORS // 2)
    last = first + SECTORS
    gone = sectors[last] - sectors[first]
    one_way = (np.abs(way[last] - way[first]) == SECTORS) & np.isfinite(theta[last] - theta[first])
    one_way &= stretch[last] == stretch[first]
    ratios = (theta[last] - theta[first])[one_way] / (SECTOR_WIDTH * gone[one_way])
    if len(ratios) < 3:
        return math.nan, math.nan
    middle = float(np.median(ratios))
    return middle, float(np.median(np.abs(ratios - middle))) / max(abs(middle), 1e-9)


def _half_turns(edges: Edges) -> int:
    """How many inputs change once in half a revolution of the encoder, over most of the way."""
    n = 0
    for number in range(3):
        way = np.abs(np.diff(edges.theta[(edges.old ^ edges.new) >> number & 1 == 1]))
        way = np.sort(way[np.isfinite(way)])
        if len(way) > SECTORS:
            middle = float(way[np.searchsorted(np.cumsum(way), 0.5 * way.sum())])
            n += abs(middle / math.pi - 1.0) < 0.2
    return n


def speed_by_sectors(t: Floats, net: Net, stretch: Ints) -> tuple[Floats, Bools]:
    """Electrical speed, rad/s, at edges at the times `t` (n,) s, by the quickest of the sectors around; 0 at a stand.

    It is 0 also where edges were lost among these, by `stretch` (n,): nobody saw which way the shaft went. And whether
    these sectors lasted about alike.

    A shaft that is pushed about as it stands goes back for a fifth of such a sector, and more: that is no return.
    """
    n = len(net.at)
    if n < 4:
        return np.zeros(len(t)), np.zeros(len(t), bool)
    lasts = np.maximum(np.diff(t[net.at]), 1e-9)
    inside = np.clip(np.searchsorted(net.at, np.arange(len(t)), "right") - 1, 1, n - 3)
    around = np.array([lasts[inside - 1], lasts[inside], lasts[inside + 1]])
    gone = np.diff(net.sectors)
    ways = np.sign([gone[inside - 1], gone[inside], gone[inside + 1]])
    whole = stretch[net.at][inside - 1] == stretch[net.at][inside + 2]
    steady = whole & (np.abs(ways.sum(axis=0)) == 3) & (lasts[inside] < PAUSE * np.minimum(around[0], around[2]))
    even = steady & (around.max(axis=0) < EVEN * around.min(axis=0)) & (around.min(axis=0) < SECTOR_WIDTH / SWAYS)
    return np.where(steady, ways[0] * SECTOR_WIDTH / around.min(axis=0), 0.0), even


def _settled(t: Floats, high: Bools, omega: Floats, stretch: Ints, most: Floats) -> tuple[Ints, Ints, Ints]:
    """Which changes stay when the shortest stays at a level are taken out first, and those taken out, pair by pair."""
    stays = np.arange(len(t))
    first, second = [stays[:0]], [stays[:0]]
    while len(stays) > 1:
        a, b = stays[:-1], stays[1:]
        on_its_way = (omega[a] * omega[b] > 0.0) & (high[a] != high[b]) & (stretch[a] == stretch[b])
        travel = np.where(on_its_way, 0.5 * np.abs(omega[a] + omega[b]) * (t[b] - t[a]), math.inf)
        around = np.concatenate([[math.inf], travel, [math.inf]])
        goes = np.flatnonzero((travel < most[a]) & (travel <= around[:-2]) & (travel < around[2:]))
        if not len(goes):
            break
        first.append(a[goes])
        second.append(b[goes])
        stays = np.delete(stays, np.concatenate([goes, goes + 1]))
    one, two = np.concatenate(first), np.concatenate(second)
    if len(stays) > 1:  # where the shaft turns round, it undoes changes itself
        after = np.clip(np.searchsorted(stays, one), 1, len(stays) - 1)
        before, behind = omega[stays[after - 1]], omega[stays[after]]
        slow = np.abs(omega[one]) < TURNS_ROUND * np.minimum(np.abs(before), np.abs(behind))
        goes_on = ~slow | (before * behind >= 0.0)
        one, two = one[goes_on], two[goes_on]
    return stays, one, two


def by_chance(returns: Returns, which: Bools) -> float:
    """The chance with which so many of these returns lie at edges wherever they came; 1 where most of them do not."""
    n = int(np.count_nonzero(which))
    if not n:
        return 1.0
    expected = float(np.minimum((2.0 * NEAR + returns.travel[which]) / math.pi, 1.0).sum())
    near, at_edge = (int(np.count_nonzero(both[which])) for both in (returns.near, returns.at_edge))
    return _at_least(near, n, expected / n) if at_edge > expected + MOSTLY * (n - expected) else 1.0


def _at_least(k: int, n: int, share: float) -> float:
    """The chance that k or more of n come to lie where each of them lies with a chance of `share`."""
    log_factorial = np.concatenate([[0.0], np.cumsum(np.log(np.arange(1.0, n + 1.0)))])
    i = np.arange(k, n + 1)
    ways = log_factorial[n] - log_factorial[i] - log_factorial[n - i]
    p = min(max(share, 1e-9), 1.0 - 1e-9)
    return float(np.exp(ways + i * math.log(p) + (n - i) * math.log(1.0 - p)).sum())


def _first_of_bounces(one: Changes, stays: Ints, first: Ints, returns: Returns, tick_hz: float) -> Ints:
    """The changes that stay, those of an input that bounces moved to where the level first came."""
    near = returns.at_edge & (returns.travel < NEAR)
    if by_chance(returns, returns.travel < NEAR) > CHANCE:
        return stays
    early = np.sort(first[near])
    reach = NEAR / np.maximum(np.abs(one.omega[stays]), 1e-9) * tick_hz
    since = np.searchsorted(one.tick[early], one.tick[stays] - reach)
    found = np.append(early, len(one))[since]
    there = found < stays
    there[there] &= one.high[found[there]] == one.high[stays[there]]
    return np.where(there, found, stays)


def _returned(one: Changes, stays: Ints, first: Ints, second: Ints, tick_hz: float, current: Floats) -> Returns:
    """The changes of one input that were undone."""
    width = (one.tick[second] - one.tick[first]) / tick_hz
    size = np.abs(one.omega[first] + one.omega[second]) / 2.0
    apart = np.full(len(first), math.inf)
    if len(stays):
        kept = one.tick[stays]
        after = np.searchsorted(kept, one.tick[first])
        left = np.abs(one.tick[first] - kept[np.maximum(after - 1, 0)])
        right = np.abs(kept[np.minimum(after, len(kept) - 1)] - one.tick[second])
        apart = np.minimum(left, right) / tick_hz * size
    near = apart < NEAR
    order = np.argsort(one.tick[first], kind="stable")
    lasted = np.maximum(width[order[1:]], width[order[:-1]]) * size[order[1:]]
    gap = (one.tick[first[order[1:]]] - one.tick[second[order[:-1]]]) / tick_hz * size[order[1:]]
    for _ in range(CHAIN):  # one after a return at an edge is at it, too
        after = order[1:][(gap < np.minimum(NEAR, 2.0 * lasted)) & (apart[order[:-1]] < NEAR)]
        apart[after] = 0.0
    return Returns(
        one.input[first], one.high[first], one.tick[first], width, width * size, near, apart < NEAR, current[first]
    )  # fmt: skip
