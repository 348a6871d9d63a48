"""The encoder that all is measured by: its zero, its direction, its lines, and whether it stays with the shaft.

Net sectors tell how far the shaft turned, whatever bounces. What moves all edges together is the encoder's doing: a
jump at a moment is a coupling or a disc that slipped, or an index pulse that came; a drift is counts that get lost.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from bench.findings.finding import Finding, degrees, percent
from bench.findings.thresholds import (
    BACKWARDS,
    BEATS,
    CLOUDED,
    DISPLACED,
    DRIFTS,
    LATE,
    LATE_EDGES,
    MOST_LATE,
    NEAR_ONE,
    NO_HYSTERESIS,
    OFTEN,
    SET,
    SLIPPED,
    SURE,
    WANDERS,
    WHOLE,
    WITH_EACH,
    ZERO,
)
from bench.signal.edge_fit import MOST_STEPS, EdgeFit, Step
from bench.signal.hall_edges import Measured
from bench.signal.hall_inputs import UNSURE
from bench.signal.position import wrapped
from bench.signal.reference import BackEmf, Turns

TELL = "record u_alpha, u_beta, i_a and i_b while the drive turns the motor: its back-EMF shows which"
BY_HAND = (
    "turn the shaft by one revolution by hand: theta_enc then passes n_p electrical revolutions, if its lines are right"
)
WAYS = "turn the shaft forward, in reverse and forward again, at two speeds: that tells which"
SLIPS = "look for a slipping coupling, a loose disc, and lost counts"


def zero(emf: BackEmf | None) -> Iterator[Finding]:
    """Zero and direction of the encoder, where the back-EMF tells."""
    if emf is None:
        return
    evidence = (
        f"by the back-EMF of {emf.n} samples, {percent(emf.clear)} of it constant in that frame"
        + ("" if math.isnan(emf.spread) else f"; forward and reverse agree to {degrees(emf.spread, 2)}"),
    )
    if emf.reversed:
        yield Finding(
            "encoder_reversed",
            "the encoder counts in the wrong direction",
            (f"theta_enc falls while the rotor flux turns forward; their sum is {degrees(emf.zero)}", *evidence),
            "exchange the encoder's tracks A and B, or its direction in the firmware; then check again",
        )
        return
    off = ahead(emf)
    if abs(off) - np.nan_to_num(emf.spread) > ZERO:
        yield Finding(
            "encoder_zero",
            f"the encoder's zero is {degrees(off)} off",
            (f"theta_enc is {degrees(off)} ahead of the rotor flux", *evidence),
            "align the encoder's zero with the rotor flux: edge angles are measured from it",
        )


def ahead(emf: BackEmf | None) -> float:
    """rad by which `theta_enc` is ahead of the rotor flux; 0 where that is not known, or less than its uncertainty.

    Errors of the inductance and of the timing turn the back-EMF one way going up and the other going down: half of what
    they differ by tells how far the mean is to be believed. Where only one direction was seen, nothing tells.
    """
    if emf is None or emf.reversed:
        return 0.0
    within = DISPLACED if math.isnan(emf.spread) else 2.0 * emf.spread
    return emf.zero if abs(emf.zero) > within else 0.0


def harms(resolution: float) -> float:
    """rad by which all edges may jump, or drift; `resolution`: rad rms to which an edge is known.

    The steps of times beat with the speed, and jump and drift as well.
    """
    return max(SLIPPED, BEATS * resolution)


def lines(
    measured: Measured, fit: EdgeFit, turns: Turns, large: list[Step], least: float, even: bool
) -> Iterator[Finding]:
    """Encoder and sectors that do not turn alike: pole pairs, lines, or an encoder that slips all the time.

    `large`: its jumps that harm, being more than `least`; `even`: whether no input disturbs the edges.
    """
    per_hall, scatter, n_p = measured.inputs.ratio, measured.inputs.scatter, turns.n_p
    counted = (
        f"{turns.by_hall:.1f} electrical revolutions by the sectors, {turns.total:.1f} by the encoder: "
        f"{abs(per_hall):.3f} for each"
    )
    if measured.blind:
        yield Finding("encoder_slips", "the encoder does not turn with the shaft", (counted,), SLIPS)
        return
    as_it_is = abs(measured.scale) == 1.0  # then edges tell more than the ratio, which pulses scatter
    steady = (as_it_is or scatter < UNSURE) and fit.aside < CLOUDED * (fit.passages + fit.aside)
    precise = abs(measured.scale) / (1.0 - fit.common.drift / math.tau)
    like = abs(precise - 1.0) < NEAR_ONE
    together = max(WANDERS * least, WITH_EACH * math.sqrt(float(np.nanmean(fit.jitter**2))))
    wanders = even and (fit.common.astray >= OFTEN or fit.common.scatter > together)
    if steady and like and len(large) <= MOST_STEPS and not wanders:
        return
    if not steady or like:
        yield Finding(
            "encoder_slips",
            "the encoder does not follow the shaft: it goes ahead and falls back again and again",
            (
                counted,
                f"from revolution to revolution that scatters by {percent(scatter)}, and all edges together by "
                f"{degrees(fit.common.scatter)} rms",
            ),
            SLIPS,
        )
        return
    factor = 1.0 / precise
    share = f"{factor:.3g} times" if factor > 1.0 else f"1/{precise:.3g} of"
    words = f"the encoder has {share} the lines that the drive takes it to have"
    if n_p is None:
        yield Finding("pole_pairs", f"n_p is wrong, or {words}", (counted,), BY_HAND)
        return
    fits = n_p * factor
    repeats = f"the ratio is steady to {percent(scatter)}, and edges repeat with it"
    if round(fits) == n_p:
        yield Finding("encoder_slips", "the encoder goes ahead of the shaft, or falls back", (counted, repeats), SLIPS)
        return
    if abs(fits - round(fits)) < WHOLE * max(1.0, fits / 10.0) and round(fits) >= 1:
        yield Finding(
            "pole_pairs",
            f"wrong number of pole pairs: {n_p} in the drive, {round(fits)} would fit; or {words}",
            (counted, f"{n_p} x {factor:.3f} = {fits:.2f} pole pairs; {repeats}"),
            f"{BY_HAND}; else set n_p to {round(fits)}",
        )
        return
    yield Finding(
        "encoder_slips",
        f"{words}: no number of pole pairs fits, or it is geared, or loses counts all the time",
        (counted, f"{n_p} x {factor:.3f} = {fits:.2f} pole pairs, which no motor has; {repeats}"),
        f"{BY_HAND}; {SLIPS}",
    )


def first_turn(
    measured: Measured, large: list[Step], turns: Turns, declared: float | None, emf: BackEmf | None
) -> tuple[Step, bool] | None:
    """The one jump within the first turn of the shaft, and whether an index pulse surely made it; None where none did.

    An index pulse puts right an angle that was wrong, a slip puts wrong one that was right: by the back-EMF `emf` after
    it, or by the ring, which the drive takes to stand at `declared`.
    """
    net = measured.inputs.net
    if len(large) != 1 or turns.n_p is None:
        return None
    [step] = large
    before = net.sectors[net.tick <= step.tick]
    if len(before) and float(before.max() - before.min()) / 6.0 > turns.n_p + 1:
        return None
    if emf is not None and not emf.reversed:
        after, within = emf.zero, ZERO
    elif declared is not None:
        after, within = measured.ring - declared, SET
    else:
        return step, False
    well, was_well = (abs(wrapped(off)) <= within for off in (after, after - step.size))
    return None if was_well and not well else (step, well and not was_well)


def slipped(
    measured: Measured, fit: EdgeFit, large: list[Step], index: Step | None, least: float, n_p: int | None
) -> Iterator[Finding]:
    """Its jumps but for that of the index, and counts that get lost; `least`: what `harms`."""
    tick_hz = measured.tick_hz
    if len(large) >= OFTEN:
        yield Finding(
            "encoder_slips",
            f"the encoder slips again and again, by up to {degrees(max(abs(s.size) for s in large))} (electrical)",
            (f"{len(large)} jumps of all edges together, the first at {large[0].tick / tick_hz:.2f} s",),
            SLIPS,
        )
        return
    for step in large:
        if step is index:
            continue
        yield Finding(
            "encoder_slipped",
            f"the encoder slipped by {degrees(step.size)} (electrical) at {step.tick / tick_hz:.2f} s",
            (
                f"all edges are off by that from then on; otherwise a revolution's edges agree to "
                f"{degrees(fit.common.scatter, 2)}",
            ),
            "look for a loose disc or coupling, or counts lost at that moment; the Hall sensors did not move",
        )
    a_turn = measured.inputs.reach < DRIFTS * (n_p or 1)  # a disc may swing as well
    if fit.common.drifted > least and not a_turn:
        yield Finding(
            "encoder_drifts",
            f"the encoder drifts from the sectors by {degrees(fit.common.drift, 2)} a revolution (electrical)",
            (f"{degrees(fit.common.drifted)} between the farthest places; all edges move alike",),
            "look for counts that get lost (cable, supply, speed limit of the counter) and for a wrong number of lines",
        )
    elif not large:
        yield from _between(measured, fit)


def _between(measured: Measured, fit: EdgeFit) -> Iterator[Finding]:
    """All edges apart by the direction: no sensor's hysteresis is so large, or below zero."""
    both, late, harmless = _by_way(measured, fit)
    if harmless:
        return
    slip = f"the encoder slipped by {degrees(both)} (electrical) between the two directions"
    code, cause = "encoder_slipped", slip
    if late < MOST_LATE:
        code = "encoder_late" if both < 0.0 else "late_edges"
        cause = f"edges come {1e6 * late:.0f} us {'late' if both > 0.0 else 'before the encoder'}, or {slip}"
    why = "no sensor has a hysteresis below zero" if both < 0.0 else "sensors that are well have 0.2 to 2 deg"
    yield Finding(code, cause, (f"passed forward, all edges lie {degrees(both)} later than in reverse: {why}",), WAYS)


def slip_or_late(measured: Measured, fit: EdgeFit) -> Iterator[str]:
    """All edges apart by the direction, as a delay that does no harm makes them, or a slip."""
    both, late, harmless = _by_way(measured, fit)
    if both and harmless:
        yield (
            f"passed forward, all edges lie {degrees(both)} later than in reverse: they come {1e6 * late:.0f} us "
            f"{'late' if both > 0.0 else 'early'}, or the encoder slipped; {WAYS}"
        )


def _by_way(measured: Measured, fit: EdgeFit) -> tuple[float, float, bool]:
    """rad by which all edges lie later forward than in reverse, 0 where sensors do so; and s that they then are late.

    inf where the delay is known, and taken out; and whether such a delay does no harm.
    """
    both, sure = float(fit.hysteresis.mean()), SURE * float(fit.hysteresis_sd.max())
    if not (both < BACKWARDS - sure or both > NO_HYSTERESIS + sure):
        return 0.0, 0.0, True
    late = abs(both) / (2.0 * fit.speed) if math.isnan(measured.delay) else math.inf
    return both, late, late < (LATE if both < 0.0 else LATE_EDGES)


def index_note(index: Step, tick_hz: float) -> Finding:
    """An index pulse came: a note, no fault."""
    return Finding(
        "index",
        f"theta_enc jumped by {_jump(index, tick_hz)}: the index pulse came; what was before is measured by what came "
        "after",
    )


def index_or_slip(step: Step, tick_hz: float) -> str:
    """A jump that the index pulse may have made as well as a slip."""
    return (
        f"theta_enc jumped by {_jump(step, tick_hz)}: the index pulse came, or the encoder slipped; check again "
        "without switching the drive off: an index comes once"
    )


def _jump(step: Step, tick_hz: float) -> str:
    return f"{degrees(step.size)} at {step.tick / tick_hz:.2f} s, in the first turn of the shaft"
