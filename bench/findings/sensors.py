"""The Hall inputs: those that never change, contacts that come and go, edges that bounce, false pulses.

Nothing here knows where a sensor stands, or which wire is which (`edges`, `wiring`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.findings.finding import Finding, percent
from bench.findings.thresholds import (
    AS_OFTEN,
    BESIDES,
    BOUNCES,
    BROKEN,
    DEAD_TURNS,
    FEW_BESIDE,
    FEW_LONG,
    LONG,
    MANY,
    OFTEN_AWAY,
    OFTENER,
    ONE_SIDED,
    PART,
    PULSE_RATE,
    PULSES,
    SEEN_OF,
    SELDOM,
    SELDOM_AWAY,
    SHORTLY,
    STILL,
)
from bench.signal.chunks import edges_lost
from bench.signal.hall_inputs import STOPPED, Inputs
from bench.signal.levels import MOST_REVOLUTIONS, Levels
from bench.signal.pulses import Pulses
from bench.signal.trace import INPUTS, Edges, Trace


@dataclass(frozen=True)
class Codes:
    """Codes and edges that no rotor makes, those of false pulses too."""

    illegal_samples: int
    """Samples with one of the two codes that are none."""
    samples: int
    illegal: int
    """Edges to or from them."""
    skipped: int
    """Edges over a sector, between legal codes."""
    edges: int


def dead(trace: Trace, inputs: Inputs, turned: float, candidates: Sequence[Away]) -> Iterator[Finding]:
    """Inputs that never change while the shaft goes round, or stop to; `turned`: electrical revolutions covered.

    `candidates`: inputs that are away, by which nothing tells that the shaft turns where there is no encoder.
    """
    changes, edges = trace.changes(), trace.edges
    if not len(edges.tick) and edges_lost(trace.dropped):
        return
    if not len(edges.tick) and turned >= DEAD_TURNS and np.count_nonzero(trace.codes) != 1:
        yield Finding(
            "dead",
            "no Hall edge came while the shaft turned: all three sensors are dead, or the drive does not see edges",
            (f"{turned:.1f} electrical revolutions by the encoder",),
            "measure the supply of the sensors; if their levels change, look at the drive's edge capture",
        )
        return
    told = ", ".join(f"{name} {n}" for name, n in zip(INPUTS, changes, strict=True))
    for number, name in enumerate(INPUTS):
        high = float(trace.codes[np.arange(8) >> number & 1 == 1].sum()) / max(1, int(trace.codes.sum()))
        flips = np.flatnonzero((edges.old ^ edges.new) >> number & 1)
        if changes[number] <= STILL * max(*changes, 1) and not STILL < high < 1.0 - STILL and turned >= 1.0:
            level = round(high)
            cause, advice = stuck(name, level)
            share = percent(high if level else 1.0 - high)
            evidence = f"input {name} reads {level} in {share} of {trace.samples} samples, over {turned:.1f} electrical"
            yield Finding("dead", cause, (f"{evidence} revolutions", f"changes of the inputs: {told}"), advice)
        elif len(flips) and _stopped(inputs, edges, flips):
            if not abs(inputs.ratio) > STOPPED and any(one.name != name for one in candidates):
                continue
            after = _gone(inputs, edges, int(flips[-1]))
            level = int(edges.new[flips[-1]] >> number & 1)
            cause, advice = stuck(name, level)
            since = edges.tick[flips[-1]] / trace.tick_hz
            yield Finding(
                "dead",
                f"{cause.removesuffix(')')} since {since:.2f} s)",
                (
                    f"input {name} changed {len(flips)} times until then, and not once in {after:.1f} turns after",
                    f"changes of the inputs: {told}",
                ),
                advice,
            )


def _stopped(inputs: Inputs, edges: Edges, flips: NDArray[np.int64]) -> bool:
    """Whether an input is silent at the end for much longer than ever before: a contact comes back."""
    after = _gone(inputs, edges, int(flips[-1]))
    if after < DEAD_TURNS:
        return False
    longest = np.argsort(np.diff(flips))[-3:]
    return after > 3.0 * max((_gone(inputs, edges, int(flips[k]), int(flips[k + 1])) for k in longest), default=0.0)


def _gone(inputs: Inputs, edges: Edges, last: int, until: int | None = None) -> float:
    """Electrical revolutions that the shaft went away after an edge; without an encoder, those that two inputs show.

    The most within a stretch: between stretches there may have been edges that were not kept.
    """
    behind = len(edges.tick) if until is None else until + 1
    turns = abs(inputs.ratio) > STOPPED
    theta, stretch = (
        edges.theta[last:behind] / (math.tau * (inputs.ratio if turns else 1.0)),
        edges.stretch[last:behind],
    )
    known = np.isfinite(theta) & turns
    if known.any():
        return _farthest(theta[known], stretch[known])
    net = inputs.net
    since, end = max(0, int(np.searchsorted(net.at, last)) - 1), int(np.searchsorted(net.at, behind))
    return _farthest(net.sectors[since:end] / 2.0, edges.stretch[net.at[since:end]])


def _farthest(places: NDArray[np.float64], stretch: NDArray[np.int64]) -> float:
    """The most by which places (n,) in one stretch are apart; 0 of none."""
    if not len(places):
        return 0.0
    starts = np.flatnonzero(np.diff(stretch, prepend=stretch[0] - 1))
    return float((np.maximum.reduceat(places, starts) - np.minimum.reduceat(places, starts)).max())


def stuck(name: str, level: int) -> tuple[str, str]:
    """Cause and advice for the input `name` that always reads `level`."""
    if level:
        return f"sensor {name} open (always 1)", f"measure the wire of sensor {name}, its supply and its pull-up"
    advice = f"look for a short from the wire of sensor {name} to ground, or a dead sensor"
    return f"sensor {name} shorted (always 0)", advice


class Away(NamedTuple):
    """An input that reads one level where it should read the other, and hardly ever the other way round."""

    name: str
    level: int
    halves: int
    """Half revolutions with a part that is wrong,"""
    whole: int
    """and those that are wrong wholly."""
    other: int
    """Half revolutions with a part that is wrong the other way round."""
    share: float
    """Of the way, that is wrong."""
    long: int
    """Returns that lasted longer than a false pulse does."""

    @property
    def lasting(self) -> bool:
        """Whether no interference lasts so long so often."""
        return self.halves >= SELDOM_AWAY and self.whole + self.long >= BROKEN


def away(inputs: Inputs, found: Levels | None) -> Iterator[Away]:
    """Inputs that are away to one level; false pulses lead to both, and last less than `LONG`."""
    returns = inputs.returns
    if found is None:
        return
    few = found.revolutions < SEEN_OF * min(sum(inputs.turns), MOST_REVOLUTIONS)
    for number, name in enumerate(INPUTS):
        level = int(np.argmax(found.share[number]))
        halves, whole, other = int(found.halves[number, level]), int(found.whole[number, level]), 1 - level
        there, back = ((returns.input == number) & (returns.high == bool(way)) for way in (level, other))
        n, n_back = int(np.count_nonzero(there)), int(np.count_nonzero(back))
        long = int(np.count_nonzero(there & ~returns.at_edge & (returns.width > LONG)))
        share = float(found.share[number, level])
        one = Away(name, level, halves, whole, int(found.halves[number, other]), share, long)
        by_time = (1.0 - 2.0 * found.high[number]) * (1.0 - 2.0 * level)
        if few and by_time < share / 2.0:  # revolutions were told wrongly
            continue
        one_sided = halves > 0 and one.other <= ONE_SIDED * halves and share > BESIDES * found.share.max()
        if share < SHORTLY:  # else what closes shortly returns as well
            one_sided = one_sided and n_back <= max(AS_OFTEN * max(n, halves), FEW_BESIDE * halves * one.lasting)
        edges_moved = share * found.revolutions < PART * halves and n < AS_OFTEN * halves
        if one_sided and not edges_moved:
            yield one


def contacts(candidates: Sequence[Away], codes: Codes) -> Iterator[Finding]:
    """Wires that make contact now and then; of all three alike it is an interference."""
    if len(candidates) == 3 and not any(one.whole for one in candidates):
        return
    for one in candidates:
        if not one.lasting and one.halves < OFTEN_AWAY:
            continue
        whole_too = f", {one.whole} times all the way" if one.whole else ""
        lasts = one.whole or one.long
        yield Finding(
            "contact",
            f"the wire of sensor {one.name} makes intermittent contact",
            (
                f"in {one.halves} half revolutions it reads {one.level} where it should read {1 - one.level}"
                f"{whole_too}, {percent(one.share)} of the way; in {one.other} the other way round",
                f"of {codes.edges} edges, {codes.illegal} lead to or from 000 or 111 and {codes.skipped} skip a sector",
                *(() if lasts else ("interference to one level only does that too, where a pull-up is weak",)),
            ),
            f"move the connector and the wire of sensor {one.name} while the shaft turns, and watch this count",
        )


def unsure(inputs: Inputs, candidates: Iterable[Away]) -> Iterator[tuple[str, str]]:
    """Inputs, by name, that were away for longer than a false pulse lasts, too seldom to say why; and that in words."""
    returns = inputs.returns
    one_sided = {one.name for one in candidates if one.whole + one.long or one.halves >= PULSES}
    n, changes = int(np.count_nonzero(~returns.at_edge)), _changes(inputs)
    for number, name in enumerate(INPUTS):
        width = returns.width[(returns.input == number) & ~returns.at_edge]
        long = len(width) > 0 and width.max() > (LONG if n >= MANY else FEW_LONG)
        seldom = changes[number] < min(SELDOM * np.median(changes), np.median(changes) - OFTEN_AWAY)
        if name in one_sided or (long and n >= PULSES) or (seldom and n):
            most = f", for up to {1e3 * width.max():.1f} ms" if len(width) else ""
            words = f"input {name} had the wrong level now and then{most}: a contact that opens, or interference"
            yield name, f"{words}; move wire {name} while the shaft turns for longer"


def bounces(inputs: Inputs, found: Pulses, well: str) -> Iterator[Finding]:
    """Inputs that change more than once at an edge; `well`: those of which it is asked."""
    ratio = f"{abs(inputs.ratio):.3f} electrical revolutions by the encoder for each by the sectors, returns left out"
    agrees = () if math.isnan(inputs.ratio) else (ratio,)
    changes = _changes(inputs)
    for number, name in enumerate(INPUTS):
        n, edges = found.bounces[number], int(changes[number])
        if not found.sure[number] or n < max(PULSES, BOUNCES * edges) or name not in well:
            continue
        if edges > OFTENER * np.median(changes):
            continue
        middle, widest = (1e6 * width for width in found.bounce_width)
        yield Finding(
            "bounce",
            f"sensor {name} bounces: its input returns at {percent(min(1.0, n / max(edges, 1)))} of its edges",
            (
                f"{n} returns at {edges} edges, each within a small part of a sector of one; half of them within "
                f"{middle:.0f} us, the longest {widest:.0f} us",
                *agrees,
            ),
            f"give input {name} hysteresis (a Schmitt trigger) and a filter, or let the firmware ignore a return",
        )


def bounces_or_pulses(found: Pulses, well: str) -> Iterator[str]:
    """Inputs that return at edges, and so seldom that pulses may have fallen there; `well`: as before."""
    for name, n, sure in zip(INPUTS, found.bounces, found.sure, strict=True):
        if n >= PULSES and not sure and name in well:
            yield f"input {name} returned at {n} of its edges: a bounce, or false pulses; turn the shaft for longer"


def false_pulses(found: Pulses, well: str) -> Iterator[Finding]:
    """Inputs that are back before the shaft can have gone a small part of a sector; `well`: as before."""
    own = sum(n for name, n in zip(INPUTS, found.by_input, strict=True) if name in well)
    if own < PULSES or found.rate * own / found.n < PULSE_RATE:
        return
    evidence = [
        f"{found.n} pulses of at most {found.widest * 1e6:.1f} us, {found.rate:.3g} a second; "
        + ", ".join(f"{name} {n}" for name, n in zip(INPUTS, found.by_input, strict=True))
    ]
    if found.bins and not math.isnan(found.excess):
        low, high = found.bins[0], found.bins[-1]
        evidence.append(
            ("they increase with current" if found.with_current else "they do not increase with current")
            + f": {low.rate:.3g} a second at {low.lo:.2f} to {low.hi:.2f} A, {high.rate:.3g} at {high.lo:.2f} to "
            f"{high.hi:.2f} A ({found.excess:+.1f} standard deviations)"
        )
    yield Finding(
        "pulses",
        "false pulses on the Hall wires (EMI)",
        tuple(evidence),
        "route the Hall wires away from the phases, shield or twist them, add a filter of some microseconds",
    )


def _changes(inputs: Inputs) -> NDArray[np.int64]:
    """(3,) how often each input changed for good."""
    return np.bincount(inputs.changes.input, minlength=3)


def named(findings: Iterable[Finding]) -> str:
    """Names of the inputs that findings are of."""
    return "".join(name for name in INPUTS if any(f" {name} " in f"{finding.cause} " for finding in findings))
