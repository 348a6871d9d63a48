"""Where Hall edges lie by the encoder, fitted: every edge of a whole turn of the shaft has its place and its history.

What moves all edges together, revolution by revolution, is the encoder's: steps at a moment, a drift with the angle.
What is left belongs to single edges: a place, a hysteresis, a delay of rising and of falling edges of each input, what
each pole pair adds, and at last jitter. Passages far from all that are set aside and counted, after the fit.

Angles are electrical, rad, in the order of the codes: those of an encoder that counts the other way have the other
sign. Nothing here knows what is right.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.signal.hall_inputs import Inputs
from bench.signal.position import wrap
from bench.signal.trace import Floats, Ints
from bench.signal.waveforms.sectors import SECTOR_WIDTH, SECTORS

OPENS = ((2, False), (1, True), (0, False), (2, True), (1, False), (0, True))
"""By sector: the input (0..2) that changes where it opens, and whether it rises, to a shaft that turns up."""
SPREAD = 0.1
"""Of speeds about their mean, as a share of them, below which no delay is fitted."""
MOST_STEPS = 4
"""Steps that are told one by one; with more the encoder just slips."""
STEP, DRIFT = math.radians(0.5), math.radians(0.3)
"""rad, the smallest step, and drift in all, that are looked for."""
BEYOND = 30.0
"""F statistic from which on a step or a drift is believed: they are looked for at every moment."""
ABOVE, SURE, ALONE = 2.0, 3.0, math.radians(5.0)
"""Times what is left of revolutions, rms, that a step must be, and times what edges that scatter each by themselves
leave of their mean; and rad, where one revolution alone lies before it."""
USUAL = math.radians(1.0)
"""rad of hysteresis that sensors have: 0.2 to 2 deg."""
LEAST_REACH = 3
"""Revolutions between the farthest places of the shaft, with which what all edges do is looked for."""
LEAST_BEHIND, WHOLE = 2, 4
"""Revolutions after a step, and edges that each must have; before it one does: an index pulse comes soon."""
FAR = 6.0
"""Times the scatter,"""
LEAST_FAR = math.radians(1.5)
"""but at least so far from its place lies a passage that is set aside."""
ASTRAY = math.radians(3.0)
"""rad by which a revolution is far from what explains the others, if it is by more than `FAR` too."""
WILD = math.radians(25.0)
"""rad from the median of its kind, beyond which a passage does not count at first, unless they scatter by more."""
MOST_PAIRS, REPEATS = 40, 0.3
"""Pole pairs that are looked for, and the share of the scatter that must repeat with each turn of the shaft then."""
SWINGS, SWING = 20.0, math.radians(1.0)
"""Electrical revolutions a second, at which the speed of a driven motor swings once in each of them, and by how much,
sine and cosine rms: as 1/v^2, seen in recordings of real motors."""
UNLIKE = 4.0
"""Standard errors by which a delay must differ from those of the other edges, to be one of its own."""
WELL = math.radians(1.0)
"""Standard error of a place, above which delays cannot be told from it: then none are."""
EACH = 0.7
"""Of the mean square that is left of edges, that delays must leave to be told without an encoder."""
MODEL = math.radians(0.1)
"""rad to which the place of an edge is known without an encoder, whatever its scatter."""
CHANGES = 0.02
"""Share by which the delay of a pull-up changes with speed, where no encoder shows it."""
SLOWEST, UNEVEN = 0.15, 12.0
"""Of the fast revolutions, below which slow ones count for nothing; and revolutions a second at which a driven motor is
uneven by more than 5 deg within each."""
MOST, ROW = 50_000, 360
"""Passages that are fitted at most, and how many in a row."""
VISITS = 3.0
"""Passages of each edge of a turn of the shaft, in the mean, with which pole pairs are told apart."""
CHANGE = 0.1
"""Share by which a revolution may differ from the one before, where no encoder tells how the speed changed."""


class Step(NamedTuple):
    """All edges jumped together."""

    tick: int
    """Of the first edge after it."""
    size: float
    """rad, by which `theta_enc` went ahead."""


class _Jump(NamedTuple):
    """Of all revolutions of one direction from one on."""

    at: int
    """The first that is wholly after it."""
    within: bool
    """Whether it came within the one before, else between the two."""


@dataclass(frozen=True)
class Common:
    """What all edges do together, by the encoder."""

    steps: tuple[Step, ...]
    drift: float
    """rad in a revolution of the angle by which the encoder falls back or goes ahead; 0 where none is seen."""
    drifted: float
    """rad between the farthest places that it drifted to."""
    scatter: float
    """rad, of the mean of a revolution, that nothing explains."""
    astray: int
    """How often one, or some in a row, were far from that."""


NOTHING = Common((), 0.0, 0.0, math.nan, 0)


@dataclass(frozen=True)
class EdgeFit:
    """The six edges by the sectors that they open, and the inputs; NaN where the passages do not tell."""

    place: Floats
    """(6,) rad, at standstill, in the middle of the hysteresis."""
    hysteresis: Floats
    """(6,) rad, passed upwards minus downwards."""
    delay: Floats
    """(3, 2) s by which rising and falling edges of each input are seen late, against the encoder."""
    covariance: Floats
    """(12, 12) rad^2 of places and hysteresis; 0 where these are not known."""
    delay_sd: Floats
    """Standard errors."""
    jitter: Floats
    """(6, 2) rad, upwards and downwards, what is left."""
    n: Ints
    """(6, 2) passages."""
    pairs: Floats
    """(6, n_p) rad, what each pole pair adds to each edge; (6, 1) zeros where they are not told apart."""
    apart: bool
    """Whether they are."""
    common: Common
    n_p: int
    """Pole pairs, by edges that repeat; 0 where that was not looked for, or not seen."""
    aside: int
    """Passages that were far from all that,"""
    first_aside: int
    """and how many of them came before all others."""
    together: float
    """How much what is left of one passage is like that of the next one, 1 for the same: of sensors it is not."""
    unexplained: float
    """Share of the mean square of edges that delays leave; 1 where none were fitted."""
    speed: float
    """rad/s, mean size of the speed,"""
    slowest: float
    """and that which a twentieth of the edges does not reach,"""
    fastest: float
    """and that which a twentieth exceeds."""

    @property
    def passages(self) -> int:
        """All that were used."""
        return int(self.n.sum())

    @property
    def place_sd(self) -> Floats:
        """Standard errors of the places, rad (6,)."""
        return np.sqrt(np.diag(self.covariance)[:SECTORS])

    @property
    def hysteresis_sd(self) -> Floats:
        """Standard errors of the hysteresis, rad (6,)."""
        return np.sqrt(np.maximum(np.diag(self.covariance)[SECTORS:], 0.0))

    def sd(self, weights: Floats) -> Floats:
        """Standard errors, rad (k,), of sums of places, or of places and hysteresis, with weights (k, 6) or (k, 12)."""
        known = self.covariance[: weights.shape[1], : weights.shape[1]]
        errors: Floats = np.sqrt(np.maximum(np.sum(weights @ known * weights, axis=1), 0.0))
        return errors


class _Passages(NamedTuple):
    """Edges that were passed, each array (m,), in the order of time."""

    edge: Ints  # 0..5
    up: Ints  # 1 up, -1 down, in the order of the codes
    input: Ints
    falls: Ints  # 0 rises, 1 falls
    tick: Ints
    angle: Floats  # rad, unwrapped
    omega: Floats
    off: Floats  # rad, from where ideal sensors had it, wrapped


def fitted(inputs: Inputs, ratio: float, n_p: int | None, step: float) -> EdgeFit | None:
    """Fit them; `ratio`: what the encoder's angle is divided by, -1 where it falls in the order of the codes.

    `step`: s between the times that edges can have.

    None without passages.
    """
    at = _some(_passages(inputs, ratio))
    if len(at.edge) < SECTORS:
        return None
    pairs = _told_apart(n_p, at)
    middle = float(np.angle(np.exp(1j * at.off).mean()))
    turn = np.round((at.angle - SECTOR_WIDTH * at.edge - middle) / math.tau).astype(np.int64)
    own = np.zeros(len(turn))
    for again in (True, False):  # what single edges do is in the way of what all do, and the other way round
        common, moved = _common(at._replace(off=wrap(at.off - own)), turn, pairs)
        found = _single(at, at.off - moved, turn % pairs, pairs, common, pairs == n_p)
        if again:
            own, use = _of_their_own(at, found, turn % pairs), _apart_from_steps(at, common)
            at, turn, own = _chosen(at, use), turn[use], own[use]
    return _beating(found, step, at.omega)


def _apart_from_steps(at: _Passages, common: Common) -> NDArray[np.bool_]:
    """All passages but those on either side of a step, whose angle may lie between samples before it and after it."""
    use = np.ones(len(at.tick), bool)
    for step in common.steps:
        after = int(np.searchsorted(at.tick, step.tick))
        use[max(after - 1, 0) : after + 1] = False
    return use


def _some(at: _Passages) -> _Passages:
    """Of more than `MOST` passages some in a row each, evenly spread."""
    every = -(-len(at.edge) // MOST) or 1
    use = np.arange(len(at.edge)) // ROW % every == 0
    return at if every == 1 else _chosen(at, use)


def _chosen(at: _Passages, use: Any) -> _Passages:
    return _Passages(*(column[use] for column in at))


def _of_their_own(at: _Passages, found: EdgeFit, pair: Ints) -> Floats:
    """By how much each passage is off, rad, because its edge is not like the others."""
    places = wrap(found.place - SECTOR_WIDTH * np.arange(SECTORS))
    own: Floats = wrap(places - np.angle(np.nanmean(np.exp(1j * places))))[at.edge]
    own = own + found.pairs[at.edge, pair] - found.pairs.mean(axis=0)[pair]
    for values, by in ((found.hysteresis, 0.5 * at.up), (found.delay.ravel(), at.omega)):
        if np.isfinite(values).all():
            each = values - values.mean()
            own = own + each[at.edge if values is found.hysteresis else 2 * at.input + at.falls] * by
    return own


def _passages(inputs: Inputs, ratio: float, blind: bool = False) -> _Passages:
    changes = inputs.changes
    changes = changes.of((changes.omega != 0.0) & (blind | np.isfinite(changes.theta)))
    up = np.sign(changes.omega).astype(np.int64)
    high = changes.high ^ (inputs.inverted >> changes.input & 1 == 1)
    edge = _OPENED[changes.input, (high == (up > 0)).astype(np.int64)]
    angle = changes.theta / ratio
    off = wrap(angle - SECTOR_WIDTH * edge)
    return _Passages(edge, up, changes.input, (~changes.high).astype(np.int64), changes.tick, angle, changes.omega, off)


def fitted_blind(inputs: Inputs, tick_hz: float, n_p: int | None, step: float) -> EdgeFit | None:
    """Fit them without an encoder: by the share that each sector has of a whole electrical revolution.

    The mean of all places, of all delays and of every hysteresis is unknown then, and taken as 0. None without a
    stretch of two revolutions in one direction.
    """
    at = _passages(inputs, 1.0, blind=True)
    if len(at.edge) < 2 * SECTORS:
        return None
    passed = _numbered(at)
    at = at._replace(angle=SECTOR_WIDTH * passed.astype(np.float64))
    use, off, omega = _against_revolution(at.tick / tick_hz, passed, at.up)
    at = _Passages(at.edge[use], at.up[use], at.input[use], at.falls[use], at.tick[use], at.angle[use], omega, off)
    at = _some(at)
    off = at.off
    if len(at.edge) < 2 * SECTORS:
        return None
    pairs = _told_apart(n_p, at) if n_p else 1
    turn = np.round(at.angle / SECTOR_WIDTH).astype(np.int64) // SECTORS
    if n_p is None and (seen := _repeating(at, turn, off)):
        found = replace(_single(at, off, turn % seen, seen, NOTHING, True, tick_hz), n_p=seen)
    else:
        found = _single(at, off, turn % pairs, pairs, NOTHING, pairs == n_p, tick_hz)
    return _beating(found, step, at.omega)


def _beating(found: EdgeFit, step: float, omega: Floats) -> EdgeFit:
    """With what steps of the times, `step` s, add to the errors, which scatter does not show; `omega` (m,).

    While the speed beats with them an edge of a pole pair is told too late by one part of a step in every turn: for
    as long as a revolution takes as many steps, or one more.
    """
    alike = np.unique(np.floor(math.tau / (2.0 * step * omega)), return_counts=True)[1] / len(omega)
    each = float(np.mean(np.square(step * omega))) / 12.0 * float(alike @ alike) / found.pairs.shape[1]
    more = np.repeat([each, 4.0 * each * np.isfinite(found.hysteresis).all()], SECTORS)
    return replace(found, covariance=found.covariance + np.diag(more))


def _repeating(at: _Passages, turn: Ints, off: Floats) -> int:
    """The pole pairs, by edges that repeat in each turn of the shaft; 0 where none is seen to.

    The first number with which one half of the turns predicts the other half about as well as any does.
    """
    both = bool(np.ptp(at.up))
    terms = _columns(at, both, 6 * varied(at.omega, 2 * at.edge + (at.up < 0)), True, True)
    left = _least_squares(terms, off)[1]
    near = np.abs(left) < FAR * 1.4826 * float(np.median(np.abs(left)))
    edge, turn, left = at.edge[near], turn[near], left[near]
    told = {}
    for n in range(1, MOST_PAIRS + 1):
        slot, half = edge + SECTORS * (turn % n), turn // n % 2 == 0
        if len(left) < 2 * VISITS * SECTORS * n:
            break
        rest = 0.0
        for which in (half, ~half):
            count = np.bincount(slot[which], minlength=SECTORS * n)
            mean = np.bincount(slot[which], left[which], minlength=SECTORS * n) / np.maximum(count, 1)
            rest += float(np.sum((left[~which] - mean[slot[~which]]) ** 2))
        told[n] = 1.0 - rest / float(np.sum(left**2))
    best = max(told.values(), default=0.0)
    return next((n for n, share in told.items() if share > 0.9 * best), 0) if best > REPEATS else 0


def _told_apart(n_p: int | None, at: _Passages) -> int:
    """The pole pairs, where their edges were passed so often that they can be told apart; else 1."""
    return n_p if n_p is not None and len(at.edge) >= VISITS * SECTORS * n_p else 1


def _numbered(at: _Passages) -> Ints:
    """The number of each edge that was passed, six in a revolution, growing upwards."""
    apart, up = np.diff(at.edge), at.up
    on, turned = up[1:] == up[:-1], up[1:] != up[:-1]
    step = np.where(up[1:] > 0, (apart - on) % SECTORS + on, -((-apart - on) % SECTORS + on))
    step = np.where(turned, np.where(up[1:] > 0, apart % SECTORS, -(-apart % SECTORS)), step)
    return np.concatenate([at.edge[:1], at.edge[0] + np.cumsum(step)]).astype(np.int64)


def _against_revolution(t: Floats, passed: Ints, up: Ints) -> tuple[Ints, Floats, Floats]:
    """Edges that have a revolution on either side: which, how late, rad, and the speed there, rad/s.

    The mean time of the edges of a revolution around an edge is the time of an even one, whatever their places; what
    the acceleration adds is taken out by the revolutions before and after it.
    """
    n, whole, half = len(t), SECTORS, SECTORS // 2
    if n < 2 * whole + 1:
        return np.zeros(0, np.int64), np.zeros(0), np.zeros(0)
    j = np.arange(whole, n - whole)
    j = j[passed[j + whole] - passed[j - whole] == 2 * whole * up[j]]
    even, _ = even_times(t, j, whole)
    omega = up[j] * math.tau / (t[j + half] - t[j - half])
    steady = np.abs(t[j + whole] - 2.0 * t[j] + t[j - whole]) < 0.5 * CHANGE * (t[j + whole] - t[j - whole])
    size = np.abs(omega) / math.tau
    if steady.any():
        fast = float(np.quantile(size[steady], 0.9))
        steady &= size > max(SLOWEST * fast, min(UNEVEN, 0.6 * fast))
    return j[steady], ((t[j] - even) * omega)[steady], omega[steady]


def even_times(t: Floats, j: Ints, whole: int) -> tuple[Floats, Floats]:
    """When the edges `j`, (k,), of an even ring were passed, s, of edges at `t` with `whole` in a turn; and the change
    of the time from edge to edge from one to the next, s. Each must have a turn on either side.
    """
    half = whole // 2
    ends = [0.5] if whole % 2 == 0 else []
    share = np.array([*ends, *[1.0] * (2 * half + 1 - 2 * len(ends)), *ends]) / whole
    ahead = np.arange(-half, half + 1)
    bend = (t[j + whole] - 2.0 * t[j] + t[j - whole]) / whole**2
    even = sum(weight * t[j + k] for weight, k in zip(share, ahead, strict=True)) - 0.5 * float(share @ ahead**2) * bend
    return even, bend


_OPENED = np.array([[OPENS.index((number, rises)) for rises in (False, True)] for number in range(3)])


# -- what all edges do together ------------------------------------------------------------------------------------


def _common(at: _Passages, number: Ints, pairs: int) -> tuple[Common, Floats]:
    """What all edges do together, and how far each passage was moved by it, rad (m,); hysteresis and delay are not.

    `number` (m,): of the revolution.
    """
    key, pair = 4 * number + at.up, number % pairs
    turn = np.cumsum(np.concatenate([[False], np.diff(key) != 0]))
    of_turn = _level(at, turn)
    count = np.bincount(turn)
    used = count >= WHOLE
    if np.count_nonzero(used) < 4 or np.ptp(number) < LEAST_REACH:
        return NOTHING, np.zeros(len(turn))
    mean = {name: np.bincount(turn, getattr(at, name))[used] / count[used] for name in ("up", "angle", "omega")}
    first = np.searchsorted(turn, np.flatnonzero(used))
    y = np.unwrap(of_turn[used])
    base = _base(mean["up"], mean["omega"], pair[first], pairs if len(y) >= VISITS * pairs else 1)
    about = wrap(at.off - of_turn[turn])
    each = float(np.sqrt(np.mean(wrap(about - _medians(about, at.edge, SECTORS)[at.edge]) ** 2) / SECTORS))
    steps, drift = _steps_and_drift(y, base, mean["angle"], each)
    if len(steps) == 1:
        steps = [_likelier(steps[0], base, y, mean["up"])]
    terms = [base, *([mean["angle"][:, None]] if drift else []), _jumps(steps, len(y))]
    weights, left = _least_squares(np.hstack(terms), y)
    rest = weights[base.shape[1] :]
    moved, drifted, slope = np.zeros(len(turn)), 0.0, 0.0
    if drift:
        slope = float(rest[0])
        drifted = abs(slope) * float(np.ptp(mean["angle"]))
        moved += slope * (at.angle - float(at.angle[0]))
    found = []
    for (k, _), size in zip(steps, rest[1 if drift else 0 :], strict=False):
        tick = _moment(at, turn, np.flatnonzero(used)[max(k - 1, 0)], of_turn[used][max(k - 2, 0)], float(size))
        found.append(Step(tick, float(size)))
        moved -= size * (at.tick < tick)  # against what follows: an index pulse makes it right
    return Common(tuple(sorted(found)), slope * math.tau, drifted, *_astray(np.hstack(terms), y, left, each)), moved


def _astray(terms: Floats, y: Floats, left: Floats, each: float) -> tuple[float, int]:
    """Scatter of revolutions, rad, by the sum of what is left, not of its squares, so that one does not spoil the rest;
    and how often some are far off."""
    for _ in range(10):
        left = _least_squares(terms, y, 1.0 / np.maximum(np.abs(left), MODEL))[1]
    scatter = 1.4826 * float(np.median(np.abs(left))) * math.sqrt(len(y) / max(1, len(y) - terms.shape[1]))
    astray = np.abs(left) > max(FAR * max(scatter, each), ASTRAY)
    return scatter, int(np.count_nonzero(astray & ~np.insert(astray[:-1], 0, False)))


def _likelier(step: _Jump, base: Floats, y: Floats, up: Floats) -> _Jump:
    """The step, or one at another reversal that explains as much and leaves a hysteresis that sensors rather have.

    With forward, reverse and forward again a step at the first reversal differs from one at the second in nothing else.
    """
    turned = np.flatnonzero(np.diff(up)) + 1
    if len(turned) < 2 or np.abs(turned - step.at).min() > 1:
        return step
    of_way = [np.array_equal(column, 0.5 * up) for column in base.T].index(True)
    found = []
    for k in (step, *(_Jump(k, False) for k in turned[np.abs(turned - step.at) > 1].tolist())):
        weights, left = _least_squares(np.hstack([base, _jumps([k], len(y))]), y)
        found.append((float(left @ left), abs(float(weights[of_way]) - USUAL), k))
    return min((unusual, k) for rest, unusual, k in found if rest <= 1.5 * found[0][0])[1]


def _moment(at: _Passages, turn: Ints, revolution: int, before: float, size: float) -> int:
    """The tick of the first edge after a step in a revolution or the two after it; `before`: the level until then."""
    near = np.flatnonzero((turn >= revolution) & (turn <= revolution + 2))
    beyond = np.abs(wrap(at.off[near] - before)) > np.abs(wrap(at.off[near] - before - size))
    fit = np.cumsum(np.where(beyond, -1, 1))  # how many before it are below, less how many are not
    return int(at.tick[min(int(near[np.argmax(fit)]) + 1, len(turn) - 1)]) if fit.max() > 0 else int(at.tick[near[0]])


def _level(at: _Passages, turn: Ints) -> Floats:
    """By how much the edges of each revolution are off together, rad, wrapped; edges have places of their own."""
    place = np.zeros(SECTORS)
    for _ in range(3):
        unit = np.exp(1j * (at.off - place[at.edge]))
        mean = np.bincount(turn, unit.real) + 1j * np.bincount(turn, unit.imag)
        level = np.angle(mean)
        about = wrap(at.off - place[at.edge] - level[turn])
        level = wrap(level + _medians(about, turn, len(level)))
        own = wrap(at.off - level[turn])
        place = _medians(own, at.edge, SECTORS)
        place = np.nan_to_num(place - np.nanmean(place)) if np.isfinite(place).any() else np.zeros(SECTORS)
    return level


def _medians(values: Floats, group: Ints, groups: int) -> Floats:
    """The median in each group; NaN in an empty one."""
    order = np.argsort(values)
    order = order[np.argsort(group[order].astype(np.min_scalar_type(groups)), kind="stable")]  # radix sort: 2 bytes
    count = np.bincount(group, minlength=groups)
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    ordered = np.append(values[order], math.nan)
    low, high = first + np.maximum(count - 1, 0) // 2, first + count // 2
    return np.where(count > 0, 0.5 * (ordered[low] + ordered[np.minimum(high, len(values))]), math.nan)


def _base(up: Floats, omega: Floats, pair: Ints, pairs: int) -> Floats:
    """Columns that a revolution's level may have without a fault: both directions, speed, pole pairs."""
    columns = [(pair == k).astype(float) - (pair == pairs - 1) for k in range(pairs - 1)]
    columns.append(np.ones(len(up)))
    if np.ptp(up):
        columns.append(0.5 * up)
    if varied(omega, up):
        columns.append(omega)
    return np.array(columns).T


def varied(omega: Floats, kind: Ints | Floats) -> bool:
    """Whether speeds differ enough within each kind that a delay shows."""
    size = np.abs(omega)
    which = np.unique(kind, return_inverse=True)[1]
    off = size - (np.bincount(which, size) / np.bincount(which))[which]
    return bool(off.std() > SPREAD * math.sqrt(float(np.mean(size**2))))


def _steps_and_drift(y: Floats, base: Floats, angle: Floats, each: float) -> tuple[list[_Jump], bool]:
    """Between which revolutions the level jumps, and whether it drifts: what explains most comes first.

    `each`: rad to which edges that scatter each by themselves tell a level.
    """
    steps: list[_Jump] = []
    drift, n = False, len(y)
    terms = base
    while len(steps) < MOST_STEPS + 1:
        weights, left = _least_squares(terms, y)
        freedom = n - len(weights) - 1
        if freedom < 3:
            break
        gain, size = _gain_of_steps(terms, left)
        k = int(np.argmax(gain))
        best, large, drifts = float(gain[k]), abs(size[k]) > STEP, False
        if not drift:
            other = _least_squares(terms, angle)[1]
            square = float(other @ other)
            slope = float(other @ left) / square if square > 0.05 * n * float(np.var(angle)) else 0.0
            if slope * slope * square > best:
                best, drifts = slope * slope * square, True
                large = abs(slope) * float(np.ptp(angle)) > DRIFT
        after = max(float(left @ left) - best, 1e-12)
        if not large or best < BEYOND * after / freedom:
            break
        if drifts:
            drift = True
        else:
            steps.append(_best_jump(k, terms, y, freedom))
        terms = np.hstack([base, *([angle[:, None]] if drift else []), _jumps(steps, n)])
    weights, left = _least_squares(terms, y)
    least = max(ABOVE * math.sqrt(float(left @ left) / max(1, n - len(weights))), SURE * each)
    large = np.abs(weights[base.shape[1] + drift :])
    return [k for k, size in zip(steps, large, strict=False) if size > (least if k.at > 1 + k.within else ALONE)], drift


def _best_jump(k: int, terms: Floats, y: Floats, freedom: int) -> _Jump:
    """The jump before revolution k, unless one within this revolution, or the one before, explains much more."""
    found = [
        (float(np.square(_least_squares(np.hstack([terms, _jumps([jump], len(y))]), y)[1]).sum()), jump)
        for jump in (_Jump(k, False), _Jump(k, True), _Jump(k + 1, True))
    ]
    rest, within = min(found[1:])
    return within if found[0][0] > (1.0 + BEYOND / freedom) * rest else found[0][1]


def _gain_of_steps(terms: Floats, left: Floats) -> tuple[Floats, Floats]:
    """By how much a step before each revolution lowers the sum of squares, beside `terms`; and its size."""
    n = len(terms)
    orthogonal = np.linalg.qr(terms)[0]
    behind = np.cumsum(orthogonal[::-1], axis=0)[::-1]  # [k]: sum over k and after
    square = np.arange(n, 0, -1) - np.sum(behind**2, axis=1)
    along = np.cumsum(left[::-1])[::-1]
    free = square > 0.05 * np.minimum(np.arange(n), np.arange(n, 0, -1))
    free[0] = free[n - LEAST_BEHIND + 1 :] = False
    size = np.where(free, along / np.where(free, square, 1.0), 0.0)
    return size * size * np.where(free, square, 0.0), size


def _jumps(steps: Sequence[_Jump], n: int) -> Floats:
    """Columns of jumps (n,), and then of the revolutions within which they came, whose own level lies in between."""
    after = [np.arange(n) >= step.at for step in steps]
    within = [np.arange(n) == step.at - 1 for step in steps if step.within]
    return np.array([*after, *within], np.float64).reshape(-1, n).T


def _least_squares(terms: Floats, y: Floats, trust: Floats | float = 1.0) -> tuple[Floats, Floats]:
    """The weights of columns (m, p) that come nearest to `y`, and what is left; those that others make up get none.

    `trust` (m,): weights of the squares.
    """
    weights = _inverse(terms, trust) @ (terms.T @ (trust * y))
    return weights, y - terms @ weights


def _inverse(terms: Floats, trust: Floats | float = 1.0) -> Floats:
    """(p, p), of the squares of columns (m, p), with 0 for what others make up."""
    weighted = terms * np.reshape(trust, (-1, 1))
    size = np.sqrt(np.sum(terms * weighted, axis=0))
    size[size == 0.0] = 1.0
    scale = np.outer(size, size)
    inverse: Floats = np.linalg.pinv(terms.T @ weighted / scale, rcond=1e-10, hermitian=True) / scale
    return inverse


# -- what single edges do ------------------------------------------------------------------------------------------


def _single(
    at: _Passages, off: Floats, pair: Ints, pairs: int, common: Common, apart: bool, blind_tick_hz: float = 0.0
) -> EdgeFit:
    """Places, hysteresis and delays, `off` (m,) rad from ideal sensors, once what all do together is taken out.

    `blind_tick_hz`: ticks a second where no encoder told the angles; the speed is then taken to swing in each
    revolution, and errors are those of stretches of a second.
    """
    middle = np.angle(np.exp(1j * off).mean())
    y = wrap(off - middle)
    kind = 2 * at.edge + (at.up < 0)
    both, blind = bool((at.up > 0).any() and (at.up < 0).any()), blind_tick_hz > 0.0
    timed = varied(at.omega, kind) and float(np.ptp(at.angle)) > LEAST_REACH * math.tau
    trust = np.abs(at.omega) ** (-2.0 * blind)
    each = timed and (_left(at, y, both, 1, 6) < EACH if blind else _apart_late(at, y, both, pair, pairs))
    unexplained = _left(at, y, both, 0, 6 if each else 1) if timed else 1.0
    moved = [at.tick < step.tick for step in common.steps] + ([at.angle - at.angle.mean()] if common.drift else [])
    known_moves = np.array(moved, float).reshape(len(moved), len(y)).T  # fitted again beside places and delays
    for delays, swings in [(6, blind)] * each + [(1, blind), (1, False)] * timed + [(0, False)]:
        terms = np.hstack([_columns(at, both, delays, swings, blind), known_moves])
        weights, left, good, own = _settled(at, y, terms, pair, pairs, trust)
        if blind:
            covariance = _by_stretches(terms[good], left[good], trust[good], at.tick[good] / blind_tick_hz)
        else:
            covariance = _by_kind(terms[good], left[good], kind[good])
        n_good = int(np.count_nonzero(good))
        freedom = max(1, n_good - terms.shape[1] - SECTORS * (pairs - 1))
        covariance *= n_good / freedom
        if np.diag(covariance)[:SECTORS].max() < WELL**2:
            break
    if blind:
        covariance[:SECTORS, :SECTORS] += _unknown(at.omega[good], swings)
    place, hysteresis, delay = _apart(weights, both, delays, blind)
    delay_sd = _apart(np.sqrt(np.maximum(np.diag(covariance), 0.0)), both, delays, blind, sign=1.0)[2]
    delay_sd = np.hypot(delay_sd, delay * CHANGES * blind)
    known = 2 * SECTORS if both else SECTORS
    of_edges = np.zeros((2 * SECTORS, 2 * SECTORS))
    of_edges[:known, :known] = covariance[:known, :known]
    n = np.bincount(kind[good], minlength=2 * SECTORS)
    square = np.bincount(kind[good], left[good] ** 2, minlength=2 * SECTORS)
    jitter = np.sqrt(square / np.where(n > 1, n, math.nan) * n_good / freedom)
    speed = np.abs(at.omega)
    lies = wrap(place + middle + SECTOR_WIDTH * np.arange(SECTORS))
    met = n.reshape(SECTORS, 2).sum(axis=1) > 0
    return EdgeFit(
        np.where(met, lies, math.nan), hysteresis, delay, of_edges, delay_sd, jitter.reshape(SECTORS, 2),
        n.reshape(SECTORS, 2), own, apart, common, 0, int(np.count_nonzero(~good)),
        int(np.argmax(np.append(good, True))), _together(left), unexplained, float(speed.mean()),
        *(float(np.quantile(speed, share)) for share in (0.05, 0.95)),
    )  # fmt: skip


def _together(left: Floats) -> float:
    """How much each of (m,) rad is like the next one."""
    off = np.exp(1j * left) - 1.0
    return float(np.vdot(off[1:], off[:-1]).real / max(float(np.vdot(off, off).real), 1e-12))


def _settled(
    at: _Passages, y: Floats, terms: Floats, pair: Ints, pairs: int, trust: Floats
) -> tuple[Floats, Floats, NDArray[np.bool_], Floats]:
    """Weights of the columns, what is left (m,), which passages count, and what each pole pair adds (6, pairs).

    `trust` (m,): weights of the squares.
    """
    kind, slot = 2 * at.edge + (at.up < 0), at.edge * pairs + pair
    off = np.abs(wrap(y - _medians(y, kind, 2 * SECTORS)[kind]))
    good = off <= np.maximum(FAR * 1.4826 * _medians(off, kind, 2 * SECTORS), WILD)[kind]
    own = np.zeros((SECTORS, pairs))
    for _ in range(3):
        weights, _ = _least_squares(terms[good], (y - own[at.edge, pair])[good], trust[good])
        left = wrap(y - terms @ weights)
        if pairs > 1:
            count = np.maximum(np.bincount(slot[good], minlength=SECTORS * pairs), 1)
            mean = np.bincount(slot[good], left[good], minlength=SECTORS * pairs) / count
            own = mean.reshape(SECTORS, pairs)
            own = own - own.mean(axis=1, keepdims=True)
            left = left - own[at.edge, pair]
        scatter = 1.4826 * _medians(np.where(good, np.abs(left), math.inf), kind, 2 * SECTORS)
        good = np.abs(left) <= np.maximum(FAR * np.nan_to_num(scatter, posinf=0.0), LEAST_FAR)[kind]
    return weights, left, good, own


def _columns(at: _Passages, both: bool, delays: int, swings: bool, blind: bool) -> Floats:
    """Columns of places, of hysteresis where both directions were seen, of delays, and of a speed that swings.

    `delays`: 6 of rising and falling edges of each input; 1 of all edges, or without an encoder of what all rising ones
    are later than all falling ones.
    """
    edges = at.edge[:, None] == np.arange(SECTORS)
    columns = [edges.astype(float)]
    if both:
        columns.append(edges * (0.5 * at.up)[:, None])
    if delays == 1:
        columns.append((((0.5 - at.falls) if blind else 1.0) * at.omega)[:, None])
    elif delays:
        columns.append((2 * at.input + at.falls == np.arange(SECTORS)[:, None]).T * at.omega[:, None])
    if swings:
        slow = (math.tau * SWINGS / at.omega) ** 2
        angle = SECTOR_WIDTH * at.edge
        columns.append(np.array([slow * np.cos(angle), slow * np.sin(angle)]).T)
    return np.hstack(columns)


def _left(at: _Passages, y: Floats, both: bool, few: int, more: int) -> float:
    """What more delays leave of the mean square, without an encoder: a speed that swings explains some of it."""
    rest = []
    for delays in (few, more):
        left = np.abs(_least_squares(_columns(at, both, delays, True, True), y)[1])
        rest.append(float(np.mean(np.minimum(left, FAR * float(np.median(left))) ** 2)))
    return rest[1] / max(rest[0], 1e-12)


def _apart_late(at: _Passages, y: Floats, both: bool, pair: Ints, pairs: int) -> bool:
    """Whether the inputs' delays differ beyond doubt, with an encoder."""
    kind = 2 * at.edge + (at.up < 0)
    terms = _columns(at, both, SECTORS, False, False)
    weights, left, good, _ = _settled(at, y, terms, pair, pairs, np.ones(len(y)))
    error = np.sqrt(np.maximum(np.diag(_by_kind(terms[good], left[good], kind[good])), 0.0))[-SECTORS:]
    delay = weights[-SECTORS:]
    sure = 1.0 / np.maximum(error, 1e-9) ** 2
    return bool((np.abs(delay - np.sum(delay * sure) / np.sum(sure)) > UNLIKE * error).any())


def _apart(weights: Floats, both: bool, delays: int, blind: bool, sign: float = -1.0) -> tuple[Floats, Floats, Floats]:
    """Places, hysteresis, delays; `sign`: 1 for errors."""
    unknown = np.full(SECTORS, math.nan)
    hysteresis = weights[SECTORS : 2 * SECTORS] if both else unknown
    first = 2 * SECTORS if both else SECTORS
    if delays == 1:
        late = np.full((3, 2), weights[first])
        late *= [0.5, 0.5 * sign] if blind else [1.0, 1.0]
    else:
        late = (weights[first : first + SECTORS] if delays else unknown).reshape(3, 2)
    return weights[:SECTORS], hysteresis, late


def _by_kind(terms: Floats, left: Floats, kind: Ints) -> Floats:
    """Covariance of the weights (p, p); each kind of passage scatters by its own."""
    scatter = np.bincount(kind, left**2, minlength=2 * SECTORS) / np.maximum(
        np.bincount(kind, minlength=2 * SECTORS) - 1, 1
    )
    inverse = _inverse(terms)
    return inverse @ ((terms * scatter[kind][:, None]).T @ terms) @ inverse


def _by_stretches(terms: Floats, left: Floats, trust: Floats, t: Floats) -> Floats:
    """Covariance of the weights (p, p), where what is left of one edge is like that of those around it."""
    long = max(1.0, float(np.ptp(t)) / 40.0)
    stretch = np.floor((t - t[0]) / long).astype(np.int64)
    sums = np.zeros((int(stretch[-1]) + 1, terms.shape[1]))
    np.add.at(sums, stretch, terms * (trust * left)[:, None])
    inverse = _inverse(terms, trust)
    return inverse @ (sums.T @ sums) @ inverse


def _unknown(omega: Floats, swings: bool) -> Floats:
    """Covariance (6, 6) of places without an encoder that no scatter shows; `swings`: whether the swing was fitted."""
    angle = SECTOR_WIDTH * np.arange(SECTORS)
    swing = 0.0 if swings else SWING * float(np.average((math.tau * SWINGS / omega) ** 2, weights=omega**-2.0))
    return MODEL**2 * np.eye(SECTORS) + swing**2 * np.cos(angle[:, None] - angle)
