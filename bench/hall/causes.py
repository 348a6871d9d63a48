"""One kind of fault each: from measurements to findings, causes in words with the evidence for them.

Thresholds are wide enough for the paper's motor, one of whose sensors stands 6.4 deg off. What is looked at first, and
what a finding makes of the rest, is `bench.hall.health`'s to say.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.hall import edges, reference
from bench.hall.edges import OPENS, Measured
from bench.hall.pulses import Pulses
from bench.hall.reference import BackEmf, Turns
from bench.signal.delays import Delays, Late, blame
from bench.signal.position import wrap
from bench.signal.trace import INPUTS, SLOW, Floats, Trace
from bench.signal.waveforms.sectors import NUMERALS
from bench.signal.wiring import AS_SPECIFIED, NONE_KNOWN, Diagnosis, diagnose
from sim.observers.hall_speed import SECTOR_WIDTH

STILL = 0.01
"""Share of time, and of the changes of the others, in which an input that never changes may have changed."""
DISPLACED = math.radians(8.0)
"""Off its place, from which on a sensor is displaced."""
ZERO = math.radians(2.5)
"""Off the rotor flux, from which on the encoder's zero is off: more than the back-EMF is wrong by."""
SCATTER = math.radians(2.0)
"""Jitter from which on an edge is unsteady."""
PULSES, PULSE_RATE = 3, 0.1
"""False pulses, in all and in a second, that are a fault."""
IMPLAUSIBLE = 0.005
"""Share of edges to an illegal code or over a sector, beyond which a wiring that is right does not explain them."""
SAME, OTHER = 0.9, 0.95
"""How well edges repeat with the pole pairs that are right, at least (0..1); with others, to be believed."""
MULTIPLE = 0.75
"""Electrical turns by Hall inputs for one by the encoder, below which the drive's pole pairs are a multiple of the
motor's: edges repeat with both."""
SHIFTS, FEW = 72, 20_000
"""Constants in a turn, and samples, with which an angle that is off by one is looked for."""
TELL = "record u_alpha, u_beta, i_a and i_b while the drive turns the motor: its back-EMF shows which"


@dataclass(frozen=True)
class Finding:
    """Something that is wrong."""

    code: str
    """For scripts: dead, pole_pairs, encoder_zero, encoder_reversed, encoder_slips, encoder_late, wiring, displaced,
    ring, duty, unsteady, pulses, implausible."""
    cause: str
    evidence: tuple[str, ...]
    advice: str


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
        yield Finding(
            "dead",
            f"sensor {name} open (always 1)" if level else f"sensor {name} shorted (always 0)",
            (
                f"input {name} reads {level} in {_percent(high if level else 1.0 - high)} of {trace.samples} "
                f"samples, over {turns.total:.1f} electrical revolutions",
                f"changes of the inputs: {told}",
            ),
            f"measure the wire of sensor {name}, its supply and its pull-up"
            if level
            else f"look for a short from the wire of sensor {name} to ground, or a dead sensor",
        )


def inverted_by_codes(trace: Trace) -> Iterator[Finding]:
    """An inverted input makes 000 and 111 of two codes, which then never come."""
    counts = trace.changed.sum(axis=0)
    n = int(counts.sum())
    if min(counts[0], counts[7]) < 0.1 * n:
        return
    for number, name in enumerate(INPUTS):
        alone = 1 << number
        if counts[alone] + counts[7 - alone] == 0:
            yield Finding(
                "wiring",
                f"sensor {name} inverted",
                (
                    f"{counts[0]} edges to 000 and {counts[7]} to 111 of {n}, "
                    f"none to {alone:03b} or {7 - alone:03b} (c b a)",
                ),
                f"correct the polarity of sensor {name}",
            )
            return


def pole_pairs(trace: Trace, turns: Turns) -> Iterator[Finding]:
    """Edges that do not repeat with the encoder's angle."""
    n_p = turns.n_p
    if n_p is None or not math.isfinite(turns.ratio):
        return
    as_assumed = reference.repeats(trace.edges, 1.0)
    if as_assumed >= SAME and turns.ratio > MULTIPLE:
        return
    measured = n_p * turns.ratio
    near = range(max(1, math.floor(0.9 * measured - 1.0)), math.ceil(1.1 * measured + 1.0) + 1)
    fits = {n: reference.repeats(trace.edges, n / n_p) for n in near}
    best = max(fits, key=fits.__getitem__)
    counted = (
        f"{turns.by_hall:.1f} electrical revolutions by the Hall inputs, {turns.total:.1f} by the encoder with "
        f"n_p = {n_p}: "
        f"{n_p} x {turns.ratio:.3f} = {measured:.2f} pole pairs"
    )
    if best != n_p and fits[best] >= OTHER:
        yield Finding(
            "pole_pairs",
            f"wrong number of pole pairs: {n_p} in the drive, {best} would fit",
            (
                counted,
                f"edges repeat to {_scatter(fits[best])} with {best} pole pairs, to {_scatter(as_assumed)} with {n_p}",
            ),
            f"set the drive's parameter n_p to {best}, then check again: edges and wiring can only be checked then",
        )
        return
    yield Finding(
        "encoder_slips",
        "the encoder does not follow the shaft: no number of pole pairs makes the edges repeat",
        (counted, f"edges repeat to {_scatter(fits[best])} at best, with {best} pole pairs"),
        "look for a slipping coupling, lost counts or a wrong line count",
    )


def encoder(emf: BackEmf | None) -> Iterator[Finding]:
    """Zero and direction of the encoder, where the back-EMF tells."""
    if emf is None:
        return
    evidence = (
        f"by the back-EMF of {emf.n} samples, {_percent(emf.clear)} of it constant in that frame"
        + ("" if math.isnan(emf.spread) else f"; forward and reverse agree to {_deg(emf.spread, 2)}"),
    )
    if emf.reversed:
        yield Finding(
            "encoder_reversed",
            "the encoder counts in the wrong direction",
            (f"theta_enc falls while the rotor flux turns forward; their sum is {_deg(emf.zero)}", *evidence),
            "exchange the encoder's tracks A and B, or its direction in the firmware; then check again",
        )
        return
    zero = ahead(emf)
    if abs(zero) > ZERO:
        yield Finding(
            "encoder_zero",
            f"the encoder's zero is {_deg(zero)} off",
            (f"theta_enc is {_deg(zero)} ahead of the rotor flux", *evidence),
            "align the encoder's zero with the rotor flux: edge angles are measured from it",
        )
        return


def ahead(emf: BackEmf | None) -> float:
    """rad by which `theta_enc` is ahead of the rotor flux; 0 where that is not known, or less than its uncertainty.

    Errors of the inductance and of the timing turn the back-EMF one way going up and the other going down: half of what
    they differ by tells how far the mean is to be believed. Where only one direction was seen, nothing tells.
    """
    if emf is None or emf.reversed:
        return 0.0
    within = DISPLACED if math.isnan(emf.spread) else 2.0 * emf.spread
    return emf.zero if abs(emf.zero) > within else 0.0


def late(found: Delays, omega_max: float) -> Iterator[Finding]:
    """An encoder that is late, or early; `omega_max`: the largest speed that the drive allows, electrical rad/s.

    Hall edges that are late are none: they are measured, and taken out. That they come before the rotor cannot be, so
    those that seem to are found even where nothing else tells what is late.
    """
    what, words = blame(found)
    if what not in (Late.ENCODER, Late.BOTH) and not (what is Late.UNCLEAR and found.edges < 0.0):
        return
    cause, _, why = words.partition(": ")
    delay = found.edges if math.isnan(found.back_emf) else found.back_emf
    seems = f"every estimate appears to lead by omega times that: {_deg(-delay * omega_max)} at the drive's top speed"
    yield Finding(
        "encoder_late",
        cause,
        (why, seems) if math.isfinite(omega_max) else (why,),
        "sample the encoder together with the currents; look for a filter or a slow interface",
    )


def wires(trace: Trace, theta: Floats, wiring: Diagnosis, measured: Measured, emf: BackEmf | None) -> Iterator[Finding]:
    """A wiring that is not as specified; `theta`: of the rotor flux, as far as that is known."""
    zero_known = emf is not None
    next_best = f"{wiring.runner_up}, explains {_percent(wiring.runner_up_share)}"
    if wiring.best != NONE_KNOWN:
        evidence = [f"that explains {_percent(wiring.share)} of {wiring.n} samples; next best: {next_best}"]
        if not zero_known and "rotated" in wiring.best:
            evidence.append("an encoder zero that is 120 deg off looks the same; no back-EMF was recorded to decide")
        exchanged = "exchanged" in wiring.best or "rotated" in wiring.best
        advice = "connect each sensor to the input of its name" if exchanged else "correct the polarity of that sensor"
        yield Finding("wiring", wiring.best, tuple(evidence), advice)
        return
    nearest = f"the nearest of the known wirings, {next_best} of {wiring.n} samples"
    moving = np.abs(trace.some.omega) >= SLOW
    for backwards in (False, True):
        fit = _shifted(-theta if backwards else theta, trace, moving)
        if fit is None:
            continue
        shift = -edges.mean_angle(np.array(_deltas(measured, emf)))
        share = _percent(fit.share)
        explained = f"with a constant angle offset, the specified wiring explains {share} of {fit.n} samples"
        if backwards:
            yield Finding(
                "encoder_reversed",
                "the encoder counts in the wrong direction, or two Hall wires are exchanged and the ring rotated",
                (explained + " if the encoder counts in the wrong direction", nearest),
                f"correct the encoder's direction first; {TELL}",
            )
            return
        words = (
            f"all Hall sensors are displaced by {_deg(shift)} together"
            if zero_known
            else f"the encoder's zero is {_deg(shift)} off, or all Hall sensors are displaced by as much"
        )
        yield Finding(
            "ring" if zero_known else "encoder_zero",
            words,
            (explained, nearest),
            "rotate the sensor ring" if zero_known else TELL,
        )
        return
    yield Finding(
        "wiring",
        "no single wiring fault explains the Hall codes",
        (nearest,),
        "there may be two faults, or an intermittent contact: test wire by wire, then check again",
    )


def in_their_sectors(measured: Measured, emf: BackEmf | None) -> bool:
    """Whether every edge lies within half a sector of its place: so does none where wires are not as specified."""
    return all(abs(delta) < SECTOR_WIDTH / 2.0 for delta in _deltas(measured, emf))


def places(measured: Measured, emf: BackEmf | None) -> Iterator[Finding]:
    """Sensors that stand off their places, and edges that do not stand still; the wiring is as specified."""
    deltas = _deltas(measured, emf)
    pairs = [[OPENS.index((number, rises)) for rises in (True, False)] for number in range(len(INPUTS))]
    off = [float(edges.mean_angle(np.array([deltas[s] for s in pair]))) for pair in pairs]
    common = float(np.median(off))
    if abs(common) > DISPLACED:
        yield Finding(
            "ring" if emf is not None else "encoder_zero",
            f"all Hall sensors are displaced by {_deg(-common)} together"
            + ("" if emf is not None else ", or the encoder's zero is off by as much"),
            ("edges I to VI lie " + ", ".join(_deg(-delta) for delta in deltas) + " from their ideal angles",),
            "rotate the sensor ring" if emf is not None else TELL,
        )
    else:
        common = 0.0
    for number, name in enumerate(INPUTS):
        rise, fall = pairs[number]
        both = sorted((rise, fall))
        numbers = " and ".join(NUMERALS[s] for s in both)
        lie = " and ".join(_deg(-deltas[s]) for s in both)
        widest = edges.largest(p.half_width for s in both for p in (measured.edges[s].up, measured.edges[s].down))
        evidence = (f"edges that open {numbers} lie {lie} from their ideal angles (95 % to {_deg(widest, 2)})",)
        if abs(off[number] - common) > DISPLACED:
            yield Finding(
                "displaced",
                f"sensor {name} is displaced by {_deg(common - off[number])} (edges {numbers})",
                evidence,
                f"move sensor {name} by {_deg(off[number] - common)}",
            )
        uneven = float(wrap(np.array([deltas[rise] - deltas[fall]]))[0]) / 2.0
        if abs(uneven) > DISPLACED:
            yield Finding(
                "duty",
                f"sensor {name} is 1 over {_percent(measured.duty[number])} of a revolution",
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
            f"{len(unsteady)} of 12 passages scatter by more than {_deg(SCATTER)}",
            (f"the worst: {edge.name}, {_deg(passages.jitter, 2)} rms over {passages.n} passages",),
            "look for play between magnet and shaft, a sensor at its threshold, and a noisy supply",
        )


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


def _shifted(theta: Floats, trace: Trace, moving: NDArray[np.bool_]) -> Diagnosis | None:
    """How well the specified wiring explains the codes to an angle that is off by the constant for which it does best.

    None where that is not well enough.
    """
    few = np.flatnonzero(moving)[:: max(1, np.count_nonzero(moving) // FEW)]
    fits = [diagnose(theta[few] - math.tau * k / SHIFTS, trace.some.hall[few]) for k in range(SHIFTS)]
    return max((fit for fit in fits if fit.best == AS_SPECIFIED), key=lambda fit: fit.share, default=None)


def _deltas(measured: Measured, emf: BackEmf | None) -> list[float]:
    """Ideal minus actual angle of each edge, rad in [-pi, pi): by the rotor flux, as far as that is known."""
    zero = ahead(emf)
    deltas: list[float] = wrap(np.array([edge.mean_delta + zero for edge in measured.edges])).tolist()
    return deltas


def _scatter(length: float) -> str:
    """Scatter of angles whose mean unit vector is so long: Mardia and Jupp, Directional Statistics, 2000, (2.3.11)."""
    return f"{math.degrees(math.sqrt(max(0.0, -2.0 * math.log(max(length, 1e-12))))):.1f} deg"


def _deg(angle: float, places: int = 1) -> str:
    return f"{math.degrees(angle):.{places}f} deg"


def _percent(share: float) -> str:
    return f"{100.0 * float(share):.1f} %"
