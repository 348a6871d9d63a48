"""The Hall sensors: inputs that never change, sensors off their places, edges that do not stand still, false pulses.

A sensor stands where its edges lie by the rotor flux, as far as that is known; nothing here knows a wiring.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bench.findings.encoder import TELL, ahead
from bench.findings.finding import Finding, degrees, percent
from bench.findings.thresholds import DISPLACED, IMPLAUSIBLE, PULSE_RATE, PULSES, SCATTER, STILL
from bench.signal.hall_edges import OPENS, Measured, largest, mean_angle
from bench.signal.position import wrap
from bench.signal.pulses import Pulses
from bench.signal.reference import BackEmf, Turns
from bench.signal.trace import INPUTS, Trace
from bench.signal.waveforms.sectors import NUMERALS, SECTOR_WIDTH


@dataclass(frozen=True)
class Codes:
    """Codes and edges that no rotor makes, false pulses taken out."""

    illegal_samples: int
    """Samples with the code 000 or 111, those within false pulses too."""
    samples: int
    illegal: int
    """Edges to or from 000 or 111."""
    skipped: int
    """Edges over a sector, between legal codes."""
    edges: int


def dead(trace: Trace, turns: Turns) -> Iterator[Finding]:
    """Inputs that never change while others, or the encoder, tell that the shaft turns."""
    changes, codes = trace.changes(), np.arange(8)
    told = ", ".join(f"{name} {n}" for name, n in zip(INPUTS, changes, strict=True))
    for number, name in enumerate(INPUTS):
        high = float(trace.codes[codes >> number & 1 == 1].sum()) / trace.samples
        if changes[number] > STILL * max(*changes, 1) or STILL < high < 1.0 - STILL:
            continue
        level = round(high)
        cause, advice = stuck(name, level)
        yield Finding(
            "dead",
            cause,
            (
                f"input {name} reads {level} in {percent(high if level else 1.0 - high)} of {trace.samples} "
                f"samples, over {turns.total:.1f} electrical revolutions",
                f"changes of the inputs: {told}",
            ),
            advice,
        )


def stuck(name: str, level: int) -> tuple[str, str]:
    """Cause and advice for the input `name` that always reads `level`."""
    if level:
        return f"sensor {name} open (always 1)", f"measure the wire of sensor {name}, its supply and its pull-up"
    advice = f"look for a short from the wire of sensor {name} to ground, or a dead sensor"
    return f"sensor {name} shorted (always 0)", advice


def in_their_sectors(measured: Measured, emf: BackEmf | None) -> bool:
    """Whether every edge lies within half a sector of its place: so does none where wires are not as specified."""
    return all(abs(delta) < SECTOR_WIDTH / 2.0 for delta in deltas(measured, emf))


def places(measured: Measured, emf: BackEmf | None) -> Iterator[Finding]:
    """Sensors that stand off their places, and edges that do not stand still; the wiring is as specified."""
    off_place = deltas(measured, emf)
    pairs = [[OPENS.index((number, rises)) for rises in (True, False)] for number in range(len(INPUTS))]
    off = [float(mean_angle(np.array([off_place[s] for s in pair]))) for pair in pairs]
    common = float(np.median(off))
    if abs(common) > DISPLACED:
        lie = "edges I to VI lie " + ", ".join(degrees(-delta) for delta in off_place) + " from their ideal angles"
        yield together(-common, (lie,), emf is not None)
    else:
        common = 0.0
    for number, name in enumerate(INPUTS):
        rise, fall = pairs[number]
        both = sorted((rise, fall))
        numbers = " and ".join(NUMERALS[s] for s in both)
        lie = " and ".join(degrees(-off_place[s]) for s in both)
        widest = largest(p.half_width for s in both for p in (measured.edges[s].up, measured.edges[s].down))
        evidence = (f"edges that open {numbers} lie {lie} from their ideal angles (95 % to {degrees(widest, 2)})",)
        if abs(off[number] - common) > DISPLACED:
            yield Finding(
                "displaced",
                f"sensor {name} is displaced by {degrees(common - off[number])} (edges {numbers})",
                evidence,
                f"move sensor {name} by {degrees(off[number] - common)}",
            )
        uneven = float(wrap(np.array([off_place[rise] - off_place[fall]]))[0]) / 2.0
        if abs(uneven) > DISPLACED:
            yield Finding(
                "duty",
                f"sensor {name} is 1 over {percent(measured.duty[number])} of a revolution",
                evidence,
                f"look at the magnet in front of sensor {name}, its distance and its threshold",
            )
    unsteady = [
        (edge, passages) for edge in measured.edges for passages in (edge.up, edge.down) if passages.jitter > SCATTER
    ]
    if unsteady:
        edge, passages = max(unsteady, key=lambda pair: pair[1].jitter)
        yield Finding(
            "unsteady",
            f"{len(unsteady)} of 12 passages scatter by more than {degrees(SCATTER)}",
            (f"the worst: {edge.name}, {degrees(passages.jitter, 2)} rms over {passages.n} passages",),
            "look for play between magnet and shaft, a sensor at its threshold, and a noisy supply",
        )


def together(shift: float, evidence: tuple[str, ...], zero_known: bool) -> Finding:
    """All sensors are off by one angle, rad, or the encoder is, unless its zero is known."""
    words = f"all Hall sensors are displaced by {degrees(shift)} together"
    if zero_known:
        return Finding("ring", words, evidence, "rotate the sensor ring")
    return Finding("encoder_zero", f"{words}, or the encoder's zero is off by as much", evidence, TELL)


def implausible(codes: Codes, found: Pulses) -> Iterator[Finding]:
    """Codes that neither the wiring nor false pulses explain."""
    n = codes.illegal + codes.skipped
    if n <= max(3.0, IMPLAUSIBLE * codes.edges, 0.2 * found.n):
        return
    yield Finding(
        "implausible",
        "a Hall wire makes intermittent contact",
        (f"of {codes.edges} edges, {codes.illegal} lead to or from 000 or 111 and {codes.skipped} skip a sector",),
        "move connectors and wires one by one while the shaft turns, and watch this count",
    )


def false_pulses(found: Pulses) -> Iterator[Finding]:
    """Pulses too short for any rotor."""
    if found.n < PULSES or found.rate < PULSE_RATE:
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


def deltas(measured: Measured, emf: BackEmf | None) -> list[float]:
    """Ideal minus actual angle of each edge, rad in [-pi, pi): by the rotor flux, as far as that is known."""
    zero = ahead(emf)
    deltas: list[float] = wrap(np.array([edge.mean_delta + zero for edge in measured.edges])).tolist()
    return deltas
