"""The Hall inputs: those that never change, contacts that come and go, edges that bounce, false pulses.

Nothing here knows where a sensor stands, or which wire is which (`edges`, `wiring`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.findings.finding import Finding, percent
from bench.findings.thresholds import (
    BOUNCES,
    BROKEN,
    DEAD_TURNS,
    LONG,
    OFTEN_AWAY,
    ONE_SIDED,
    PULSE_RATE,
    PULSES,
    SEEN_OF,
    SELDOM_AWAY,
    SHORTLY,
    STILL,
)
from bench.signal import levels
from bench.signal.hall_inputs import Inputs
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


def dead(trace: Trace, inputs: Inputs, turned: float) -> Iterator[Finding]:
    """Inputs that never change while the shaft goes round, or stop to; `turned`: electrical revolutions covered."""
    changes, edges = trace.changes(), trace.edges
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
    theta, stretch = edges.theta[last:behind] / (math.tau * inputs.ratio), edges.stretch[last:behind]
    known = np.isfinite(theta)
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


def contacts(trace: Trace, inputs: Inputs, codes: Codes) -> Iterator[Finding]:
    """Wires that make contact now and then: an input that reads one level where it should read the other.

    False pulses do that to both levels, last less than `LONG`, and are not in the way of a whole half revolution.
    """
    found = levels.levels(trace.edges, inputs, trace.tick_hz)
    if found is None:
        return
    returns, turns = inputs.returns, sum(inputs.turns)
    if found.revolutions < SEEN_OF * min(turns, levels.MOST_REVOLUTIONS):
        return
    alike = (found.halves.max(axis=1) >= OFTEN_AWAY).all() and not found.whole.any()
    for number, name in enumerate(INPUTS):
        level = int(np.argmax(found.share[number]))
        halves, whole = int(found.halves[number, level]), int(found.whole[number, level])
        sides = [(returns.input == number) & (returns.high == bool(way)) for way in (level, 1 - level)]
        long = int(np.count_nonzero(sides[0] & ~returns.at_edge & (returns.width > LONG)))
        one_sided = found.halves[number, 1 - level] <= ONE_SIDED * halves
        lasting = halves >= SELDOM_AWAY and whole + long >= BROKEN
        if not lasting and found.share[number, level] < SHORTLY:  # else what closes shortly returns as well
            this, other = (int(np.count_nonzero(side)) for side in sides)
            one_sided &= other <= 0.5 * max(this, halves)
        if alike or not one_sided or not (lasting or halves >= OFTEN_AWAY):
            continue
        share = percent(float(found.share[number, level]))
        whole_too = f", in {whole} of them all the way" if whole else ""
        yield Finding(
            "contact",
            f"the wire of sensor {name} makes intermittent contact",
            (
                f"in {halves} of {found.revolutions} half revolutions it reads {level} where it should read "
                f"{1 - level}{whole_too}, {share} of the way; in {found.halves[number, 1 - level]} the other way round",
                f"of {codes.edges} edges, {codes.illegal} lead to or from 000 or 111 and {codes.skipped} skip a sector",
                *(() if whole or long else ("interference to one level only does that too, where a pull-up is weak",)),
            ),
            f"move the connector and the wire of sensor {name} while the shaft turns, and watch this count",
        )


def away(inputs: Inputs) -> Iterator[tuple[str, str]]:
    """Inputs, by name, that went away for longer than a false pulse lasts, too seldom to say why; and that in words."""
    returns = inputs.returns
    for number, name in enumerate(INPUTS):
        width = returns.width[(returns.input == number) & ~returns.at_edge]
        if len(width) and width.max() > LONG:
            yield (
                name,
                (
                    f"input {name} went away and came back {len(width)} times, for up to {1e3 * width.max():.1f} ms: "
                    f"a contact that opens, or interference; move wire {name} while the shaft turns for longer"
                ),
            )


def bounces(inputs: Inputs, found: Pulses, well: str) -> Iterator[Finding]:
    """Inputs that change more than once at an edge; `well`: those of which it is asked."""
    ratio = f"{abs(inputs.ratio):.3f} electrical revolutions by the encoder for each by the sectors, returns left out"
    agrees = () if math.isnan(inputs.ratio) else (ratio,)
    for number, name in enumerate(INPUTS):
        n, edges = found.bounces[number], int(np.count_nonzero(inputs.changes.input == number))
        if n < PULSES or n < BOUNCES * edges or name not in well:
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


def named(findings: Iterable[Finding]) -> str:
    """Names of the inputs that findings are of."""
    return "".join(name for name in INPUTS if any(f" {name} " in f"{finding.cause} " for finding in findings))
