"""Where the edges of Hall sensors lie: sensors off their places, uneven magnets, edges that come late or do not repeat.

A sensor stands where its edges lie against those of the others: real rings sit at any angle, and their sensors some
degrees off (`DISPLACED`). What repeats in each turn of the shaft is the magnet's, or the encoder disc's; what is left
over is jitter. Nothing here knows a wiring.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from bench.findings.finding import Finding, degrees, percent
from bench.findings.thresholds import (
    ASIDE,
    BLIND_PASSAGES,
    DISPLACED,
    ECCENTRIC,
    EVEN_MAGNETS,
    LATE_EDGES,
    LEAST_PASSAGES,
    LEFT,
    MOVES,
    PAIR_OFF,
    PAIRS_OFF,
    SCATTER,
    SCATTER_ALL,
    SINE,
    SURE,
    SWINGING,
    TOGETHER,
    TOLD_EVEN,
    TOLD_LATE,
    TWICE,
)
from bench.signal.edge_fit import EACH, OPENS, EdgeFit
from bench.signal.hall_edges import Measured
from bench.signal.trace import INPUTS, Floats
from bench.signal.waveforms.sectors import NUMERALS, SECTORS

SEEN_BY = (-1, 0, 0, 0, 0, 1)
"""By edge: one magnet passes sensor a, then b, then c, the last of them in the revolution after that of the first."""
ONCE_A_TURN = "turn the shaft for more whole turns, and let the drive know n_p: that tells which repeat once a turn"


def places(measured: Measured) -> Iterator[Finding]:
    """Sensors that stand off their places against the others, or are 1 over much more or less than half a turn."""
    fit = measured.fit
    if fit is None:
        return
    off, uneven = measured.placement, measured.unevenness
    worst = int(np.argmax(np.abs(off)))
    rest = np.delete(off, worst)
    each = abs(rest[0] - rest[1]) / 2.0 > DISPLACED  # else they stand right, and the mean is off by the one
    at_one_speed = bool(np.isnan(fit.delay).all()) and measured.blind
    withins, duties = measured.placement_half_width[0], measured.duty_half_width * math.pi
    for number, name in enumerate(INPUTS):
        both = [OPENS.index((number, rises)) for rises in (True, False)]
        edges = " and ".join(NUMERALS[edge] for edge in sorted(both))
        within = float(withins[number])
        told = "; ".join(f"{other} {degrees(float(by))}" for other, by in zip(INPUTS, off, strict=True))
        if abs(off[number]) - within > DISPLACED and (each or number == worst):
            others = 1.5 * float(off[number])
            yield Finding(
                "displaced",
                f"sensor {name} is displaced by {degrees(others)} against the other two (edges {edges})",
                (f"from the mean of the three: {told} (95 % to {degrees(within, 2)})",),
                f"move sensor {name} by {degrees(-others)}, or let the drive learn its edges (bench hall learn)",
            )
        moves = measured.blind and np.nanmax(fit.jitter[both]) > MOVES * np.nanmedian(fit.jitter)  # with the speed, say
        if abs(uneven[number]) - duties[number] > DISPLACED and not moves:
            late = ("falling" if uneven[number] > 0.0 else "rising") if at_one_speed else ""
            yield Finding(
                "duty",
                f"sensor {name} is 1 over {percent(measured.duty[number])} of a revolution"
                + (f", or its {late} edges come late" if late else ""),
                (f"its edges {edges} lie {degrees(float(uneven[number]))} from where they belong, to either side",),
                f"look at the magnet in front of sensor {name}, its distance and its threshold"
                + ("; with the shaft at two speeds the check tells which" if late else ""),
            )


def magnets(measured: Measured, resolution: float) -> Iterator[Finding]:
    """Edges that lie elsewhere in each pole pair and repeat with each turn of the shaft; `resolution`: rad rms."""
    fit = measured.fit
    if fit is None or not fit.apart or resolution > PAIRS_OFF / 2.0:  # its steps beat with the speed
        return
    pairs, of_turn = fit.pairs.shape[1], fit.pairs.mean(axis=0)
    of_pair = np.array([np.roll(own, by) for own, by in zip(fit.pairs, SEEN_BY, strict=True)]).mean(axis=0)
    by_chance = float(np.nanmean(fit.jitter**2)) * fit.pairs.size / max(1, fit.passages)
    most_by_chance = by_chance * (1.0 + SURE * math.sqrt(2.0 / fit.pairs.size))
    size = math.sqrt(max(0.0, float(np.mean(fit.pairs**2)) - most_by_chance))
    off = PAIR_OFF + SURE * math.sqrt(by_chance / SECTORS)  # of a pole pair: the mean of its edges
    repeats = f"each edge repeats to {degrees(float(np.nanmean(fit.jitter)), 2)} from turn to turn of the shaft"
    worst = int(np.argmax(np.abs(of_pair - np.median(of_pair))))
    alone = float(of_pair[worst] - np.median(of_pair))
    wave = np.exp(2j * math.pi * np.arange(pairs) / pairs)
    sine = 2.0 * abs(np.vdot(wave, of_turn)) / pairs / float(np.sinc(1.0 / pairs)) if pairs > 2 else 0.0
    uneven = of_turn - 2.0 / pairs * (np.vdot(wave, of_turn) * wave).real
    alike, rest = np.delete(of_pair, worst), max(1, pairs - 3)
    one = abs(alone) > off and alike.var() * (pairs - 1) / max(1, pairs - 2) <= uneven.var() * pairs / rest
    swings = not one and sine > max(ECCENTRIC * pairs, SINE) and uneven.std() < LEFT * of_turn.std()
    both = f"all edges move by {degrees(sine)} once a turn"
    if swings and pairs >= TOLD_EVEN and uneven.std() * math.sqrt(pairs / rest) < EVEN_MAGNETS:
        yield Finding(
            "encoder_eccentric",
            f"the encoder's disc or the magnet ring is eccentric: {both}",
            (f"that is {degrees(sine / pairs, 2)} of the shaft; {repeats}",),
            "centre the disc on the shaft, or the ring; what the back-EMF does not follow is the encoder's",
        )
        return
    if swings:
        yield Finding(
            "magnet",
            f"the magnets are uneven, or their ring or the encoder's disc is eccentric: {both}",
            (f"of {pairs} pole pairs uneven ones may do that by chance; {repeats}",),
            "look at the disc and the ring with a dial gauge; magnets that are uneven move the back-EMF, too",
        )
        return
    if abs(alone) > off and pairs > 1:
        yield Finding(
            "magnet",
            f"the magnets of one pole pair of {pairs} stand {degrees(alone)} off (electrical)",
            (f"all its edges are off by that from those of the others; {repeats}",),
            "look for a magnet that is loose or was placed wrongly; the sensors are well",
        )
    elif size > PAIRS_OFF:
        yield Finding(
            "magnet",
            f"the magnets are uneven: edges of the {pairs} pole pairs differ by {degrees(size)} rms",
            (f"{repeats}, so it is neither jitter nor a sensor",),
            "use observers that know each edge of a turn of the shaft (edge_kalman), or a motor with better magnets",
        )


def late_edges(measured: Measured, step: float) -> Iterator[Finding]:
    """Rising or falling edges of a sensor that come late; `step`: s between the times that edges can have."""
    fit = measured.fit
    if fit is None or np.isnan(fit.delay).all():
        return
    after = _late(fit, measured.blind) - step
    sure = after - SURE * fit.delay_sd
    which = (sure > LATE_EDGES) & (sure * fit.fastest > SCATTER) | (sure * fit.fastest > DISPLACED)
    told = not measured.blind or (fit.unexplained < EACH and fit.fastest > TWICE * fit.slowest)
    if which.any() and told:
        yield Finding(
            "late_edges",
            f"{_kinds(which)} come up to {1e6 * float(_late(fit, measured.blind)[which].max()):.0f} us late",
            (_each_late(fit, measured.blind),),
            "look at the pull-ups and the filters of these inputs: an open collector falls sharply and rises late",
        )


def _late(fit: EdgeFit, blind: bool) -> Floats:
    return fit.delay - np.min(fit.delay) if blind else fit.delay


def _kinds(which: NDArray[np.bool_]) -> str:
    """Kinds of edges (3, 2) in words."""
    ways = ("rising", "falling")
    inputs = [", ".join(np.array(list(INPUTS))[which[:, k]]) for k in (0, 1)]
    return " and ".join(f"the {ways[k]} edges of {inputs[k]}" for k in (0, 1) if inputs[k])


def _each_late(fit: EdgeFit, blind: bool) -> str:
    apart, most = fit.delay[:, 0] - fit.delay[:, 1], degrees(float(_late(fit, blind).max()) * fit.fastest)
    if blind and np.ptp(apart) == 0.0:
        first, then = ("rising", "falling") if apart[0] > 0.0 else ("falling", "rising")
        within = 4e6 * float(fit.delay_sd[0, 0])
        return (
            f"{first} edges come {1e6 * abs(float(apart[0])):.0f} us later than {then} ones (95 % to {within:.0f} us): "
            f"{most} at the fastest"
        )
    told = "; ".join(
        f"{name} {1e6 * rise:.0f} and {1e6 * fall:.0f} us" for name, (rise, fall) in zip(INPUTS, fit.delay, strict=True)
    )
    return (
        f"rising and falling edges are late by: {told} (95 % to {2e6 * float(fit.delay_sd.max()):.0f} us), against "
        f"{'their mean' if blind else 'the encoder'}: {most} at the fastest"
    )


def delays(measured: Measured) -> Iterator[Finding]:
    """Edges that come late by less than harms: a note."""
    fit = measured.fit
    if fit is not None and not np.isnan(fit.delay).all():
        apart = fit.delay - np.min(fit.delay)
        if (apart - SURE * fit.delay_sd > TOLD_LATE).any():
            yield Finding("delays", _each_late(fit, measured.blind))


def enough(measured: Measured) -> bool:
    """Whether every edge was passed often enough that it can be judged."""
    least = BLIND_PASSAGES if measured.blind else LEAST_PASSAGES
    return measured.fit is not None and int(measured.fit.n.sum(axis=1).min()) >= least


def adrift(fit: EdgeFit, resolution: float) -> Iterator[str]:
    """Why edges say nothing of the sensors: they all scatter together."""
    most, aside = _scatter(fit)
    if fit.together > TOGETHER and (most > math.hypot(SCATTER, resolution) or aside > ASIDE * fit.passages):
        yield (
            f"edges scatter by {degrees(most)} rms, and {aside} lie far off, all of them alike for a while: "
            "the encoder slips or loses counts, or the speed changes too fast; turn the shaft evenly, and check again"
        )


def unexplained(measured: Measured, resolution: float) -> Iterator[str]:
    """Why edges that scatter say nothing of the sensors: pole pairs are not told apart."""
    fit = measured.fit
    if fit is None or fit.apart:
        return
    most, aside = _scatter(fit)
    if most > math.hypot(SCATTER_ALL, resolution) or aside > ASIDE * (fit.passages + fit.aside):
        yield (
            f"edges scatter by {degrees(most)} rms, and {aside} lie far off, as play, a bad sensor or uneven magnets "
            f"make them: {ONCE_A_TURN}"
        )


def _scatter(fit: EdgeFit) -> tuple[float, int]:
    return float(np.nanmax(fit.jitter, initial=0.0)), fit.aside - fit.first_aside


def unsteady(measured: Measured, resolution: float) -> Iterator[Finding]:
    """Edges that do not repeat; `resolution`: rad rms that the times and angles are not known to."""
    fit = measured.fit
    if fit is None or not fit.passages or abs(fit.together) > TOGETHER or (measured.blind and fit.speed < SWINGING):
        return
    most = math.hypot(SCATTER_ALL if measured.blind else SCATTER, 1.5 * resolution)
    far = [
        (float(fit.jitter[k, way]), k, way)
        for k in range(6)
        for way in (0, 1)
        if fit.apart and fit.n[k, way] > 3 and fit.jitter[k, way] > most
    ]
    if far:
        worst, k, way = max(far)
        number, rises = OPENS[k]
        edge = f"{INPUTS[number]} {'rises' if rises == (way == 0) else 'falls'}"
        yield Finding(
            "unsteady",
            f"{len(far)} of 12 passages scatter by more than {degrees(most)}",
            (
                f"the worst: {edge}, {degrees(worst, 2)} rms over {fit.n[k, way]} passages; times and angles are known "
                f"to {degrees(resolution, 2)}",
            ),
            "look for play between magnet and shaft, a sensor at its threshold, and a noisy supply",
        )
    elif fit.apart and fit.aside - fit.first_aside > ASIDE * (fit.passages + fit.aside):
        yield Finding(
            "unsteady",
            f"{percent(fit.aside / (fit.passages + fit.aside))} of the edges lie far from their places",
            (f"{fit.aside} of {fit.passages + fit.aside}, in no order that a magnet, a delay or the encoder has",),
            "look for a sensor at its threshold, a noisy supply, and lost edges; then check again",
        )
