"""What is wrong with Hall sensors, their wires or the encoder they are compared with: causes in words, with evidence.

A cause is named only on evidence that tells it from the others, and every one comes with its numbers. In this order:
is there enough to go by; inputs that are dead or make contact now and then; bounces and false pulses; whether the
encoder turns with the sectors; its jumps, zero, direction and delay; the wiring and the ring; where the sensors stand.
What is found first may hide the rest: then that is all that is said. The encoder's zero, where no back-EMF was
recorded, is taken to be right, and the words say what else it may be.

Nothing here talks to a drive or prints.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from bench.findings import edges, encoder, late, records, sensors, wiring
from bench.findings.finding import Finding, percent
from bench.findings.sensors import Codes
from bench.findings.thresholds import (
    CLOUDED,
    HIDDEN,
    LEAST_PASSAGES,
    LEAST_REACH,
    LEAST_TURNS,
    LOST_SHARE,
)
from bench.findings.wiring import Diagnosis, diagnose
from bench.signal import hall_edges, pulses, reference
from bench.signal.chunks import edges_lost
from bench.signal.delays import Delays, delays_of
from bench.signal.hall_edges import Measured
from bench.signal.hall_inputs import UNSURE, Inputs
from bench.signal.levels import levels
from bench.signal.pulses import Pulses
from bench.signal.reference import BackEmf, Turns
from bench.signal.trace import INPUTS, SLOW, Trace
from bench.signal.verdict import Verdict
from bench.signal.waveforms.sectors import steps_between

UNKNOWN = Delays(math.nan, math.nan)


@dataclass(frozen=True)
class Health:
    """The result of a check."""

    verdict: Verdict
    """PASS: healthy. FAIL: something is wrong. INVALID: the data are insufficient for either."""
    findings: tuple[Finding, ...]
    missing: tuple[str, ...]
    """Why no more can be said, and what to do about it."""
    notes: tuple[Finding, ...]
    """What is no fault, and should be known."""
    turns: Turns
    measured: Measured
    pulses: Pulses
    codes: Codes
    emf: BackEmf | None
    delays: Delays
    wiring: Diagnosis | None
    resolution: float
    """rad rms to which an edge is known at the mean speed."""

    @property
    def exit_code(self) -> int:
        """Of the command: 0 healthy, 1 something is wrong, 2 the data are insufficient."""
        return self.verdict.exit_code


def examine(trace: Trace, further: str = "", still_named: bool = False) -> Health:
    """Name what is wrong. `further`: how to turn the shaft more if it turned too little, in words.

    `still_named`: whether wires are named even then, by samples: a motor that cannot start turns no further.
    """
    measured = hall_edges.measure(trace)
    inputs = measured.inputs
    turns, found_pulses, codes = reference.turns(trace, inputs), pulses.count(trace, inputs), _codes(trace, inputs)
    health = Health(
        Verdict.INVALID, (), (), (), turns, measured, found_pulses, codes, None, UNKNOWN, None,
        resolution(trace, measured),
    )  # fmt: skip
    if contradicting := tuple(records.contradicting(trace)):  # all else would follow from it
        return replace(health, verdict=Verdict.FAIL, findings=contradicting)
    if lost := _lost(trace, inputs):
        return replace(health, missing=(lost,))
    missing: list[str] = []
    covered = max(inputs.reach, _reach(trace))
    if not turns.total >= LEAST_TURNS or covered < LEAST_REACH:
        missing.append(
            f"only {np.nan_to_num(turns.total):.1f} electrical revolutions"
            + (f", to and fro over {covered:.1f}" if turns.total >= LEAST_TURNS else "")
            + ": turn the shaft forward and reverse"
            + (f", {further}" if further else "")
        )
        findings: list[Finding] = [*wiring.by_samples(trace)] if still_named else []
    else:
        candidates = [*sensors.away(inputs, levels(trace.edges, inputs, trace.tick_hz))]
        dead = [*sensors.dead(trace, inputs, covered, candidates)]
        candidates = [] if dead else candidates
        findings = dead or [*sensors.contacts(candidates, codes)]
        broken = bool(findings)
        if dead or not broken:  # a contact that opens makes bounces and pulses
            away = {} if dead else dict(sensors.unsure(inputs, candidates))
            missing += away.values()
            well = "" if away else "".join(name for name in INPUTS if name not in sensors.named(dead))
            findings += [*sensors.bounces(inputs, found_pulses, well), *sensors.false_pulses(found_pulses, well)]
            missing += sensors.bounces_or_pulses(found_pulses, well)
        if not broken:
            by_encoder = trace.encoder and not math.isnan(inputs.ratio)
            health = (_by_encoder if by_encoder else _blind)(trace, health, steady=not findings and not away)
    findings += health.findings
    missing += health.missing
    verdict = Verdict.FAIL if findings else Verdict.INVALID if missing else Verdict.PASS
    return replace(health, verdict=verdict, findings=tuple(findings), missing=tuple(missing))


def _by_encoder(trace: Trace, health: Health, steady: bool) -> Health:
    """What edges, encoder and back-EMF tell of each other; `steady`: whether no input disturbs the edges."""
    measured, turns, fit = health.measured, health.turns, health.measured.fit
    if fit is None:
        return replace(health, missing=("no edges were passed at a speed that is known: turn the shaft on in one way",))
    clouded = fit.aside > CLOUDED * (fit.passages + fit.aside) or measured.inputs.scatter > UNSURE
    if not steady and (clouded or measured.inputs.away > HIDDEN):
        return replace(health, missing=("what disturbs the inputs hides where their edges lie: mend that first",))
    least = encoder.harms(health.resolution)
    jumps = [step for step in fit.common.steps if abs(step.size) >= least]
    if contradicting := list(encoder.lines(measured, fit, turns, jumps, least, steady)):
        return replace(health, findings=tuple(contradicting))
    since = max((step.tick for step in fit.common.steps), default=0)
    emf, declared = reference.back_emf(trace, since), trace.parameters.get("hall_offset")
    first, sure = encoder.first_turn(measured, jumps, turns, declared, emf) or (None, False)
    jumped = list(encoder.slipped(measured, fit, jumps, first, least, turns.n_p))
    index = () if first is None or sure else (encoder.index_or_slip(first, trace.tick_hz),)
    if steady and (adrift := tuple(edges.adrift(fit, health.resolution))):
        return replace(health, findings=tuple(jumped), missing=index + (() if jumped else adrift))
    delays = delays_of(trace, measured, since)
    findings: list[Finding] = [*jumped, *(() if jumped else encoder.zero(emf))]
    notes: list[Finding] = []
    if first is not None and sure:
        notes.append(encoder.index_note(first, trace.tick_hz))
    possible = wiring.possible(measured, emf)
    reversed_too = any(finding.code == "encoder_reversed" for finding in findings)
    if not jumped and not reversed_too:  # the back-EMF's delay is that of an encoder that counts up
        findings += late.late(delays, _fastest(trace))
    wired = [] if jumped else list(wiring.order(possible, declared, emf is not None))
    findings += [finding for finding in wired if not (reversed_too and finding.code == "encoder_reversed")]
    if edges.enough(measured):
        findings += [*edges.places(measured), *(() if jumped else edges.magnets(measured, health.resolution))]
        if steady and not jumped and not any(finding.code == "encoder_late" for finding in findings):
            findings += edges.late_edges(measured, trace.time_step)
        findings += edges.unsteady(measured, health.resolution) if steady and not findings else ()
    thin = [
        *index,
        *(() if jumps else encoder.slip_or_late(measured, fit)),
        *_thin(turns, measured),
        *(() if findings or not steady else edges.unexplained(measured, health.resolution)),
    ]
    notes += [*wiring.ring(possible, emf is not None), *_delays(measured, findings)]
    return replace(
        health, findings=tuple(findings), missing=tuple(thin), notes=tuple(notes), emf=emf,
        delays=delays, wiring=_explained(trace, measured, since),
    )  # fmt: skip


def _blind(trace: Trace, health: Health, steady: bool) -> Health:
    """What the edges tell of each other, without an encoder; `steady`: as before."""
    measured = health.measured
    findings = list(wiring.missing_codes(measured))
    if steady and edges.enough(measured):
        findings += [*edges.places(measured), *edges.late_edges(measured, trace.time_step)]
        findings += [] if findings else edges.unsteady(measured, health.resolution)
    missing = (
        "no encoder was recorded: without one, exchanged wires, the angle of the ring and a delay that all edges share "
        "are not known; the sensors were judged against each other; record theta_enc, or fit an encoder for the check",
    )
    return replace(health, findings=tuple(findings), missing=missing, notes=_delays(measured, findings))


def _delays(measured: Measured, findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Edges that come late, unless a finding says so."""
    return () if any(finding.code == "late_edges" for finding in findings) else tuple(edges.delays(measured))


def _explained(trace: Trace, measured: Measured, since: int) -> Diagnosis | None:
    """How much of the samples the wiring explains, with the ring where it was found; None where that is not known."""
    some = trace.some
    use = (np.abs(some.omega) >= SLOW) & (some.tick >= since)
    if math.isnan(measured.ring) or measured.inputs.inverted or measured.inputs.ratio < 0.0:
        return None
    try:
        return diagnose(some.theta[use] - measured.ring, some.hall[use])
    except ValueError:
        return None


def _lost(trace: Trace, inputs: Inputs) -> str:
    """Why nothing is judged where so many edges were lost that only an encoder tells how far the shaft went."""
    edges = trace.came + trace.lost_edges
    if not trace.came and edges_lost(trace.dropped):
        return "all Hall edges were lost: mend the link, and check again"
    if trace.lost_edges <= LOST_SHARE * edges or (trace.encoder and not math.isnan(inputs.ratio)):
        return ""
    left = "hardly a revolution came whole" if trace.encoder else "without an encoder nothing tells what they were"
    share = percent(trace.lost_edges / edges)
    return f"{trace.lost_edges} of {edges} Hall edges were lost ({share}), and {left}: mend the link, and check again"


def _reach(trace: Trace) -> float:
    """Electrical revolutions between the farthest places that the encoder was at, as the sectors count them."""
    theta = trace.some.theta[np.isfinite(trace.some.theta)]
    return float(np.ptp(theta)) / math.tau if len(theta) else 0.0


def resolution(trace: Trace, measured: Measured) -> float:
    """rad rms to which an edge is known at the mean speed: by the steps of the times, and of the encoder's angle."""
    speed = 0.0 if measured.fit is None else measured.fit.speed
    return math.hypot(trace.time_step * speed, trace.count) / math.sqrt(12.0)


def _fastest(trace: Trace) -> float:
    """The largest speed that the drive allows, electrical rad/s; inf where it does not tell."""
    parameters = trace.parameters
    return parameters.get("n_p", math.inf) * parameters.get("omega_m_max", math.inf)


def _codes(trace: Trace, inputs: Inputs) -> Codes:
    illegal = np.zeros((8, 8), bool)
    none = [inputs.inverted, 7 ^ inputs.inverted]
    illegal[none] = illegal[:, none] = True
    far = np.abs(steps_between(*(np.indices((8, 8)) ^ inputs.inverted))) != 1.0
    lead_there, skipped, edges = (int(trace.changed[which].sum()) for which in (illegal, ~illegal & far, ...))
    return Codes(int(trace.codes[none].sum()), trace.samples, lead_there, skipped, edges)


def _thin(turns: Turns, measured: Measured) -> list[str]:
    words = []
    if min(turns.up, turns.down) < LEAST_TURNS:
        words.append(
            f"only {turns.up:.1f} electrical revolutions forward and {turns.down:.1f} reverse; at least "
            f"{LEAST_TURNS:g} each way are needed"
        )
    elif measured.least() < LEAST_PASSAGES:
        words.append(
            f"an edge was passed only {measured.least()} times in one direction: turn the shaft longer, "
            f"for at least {LEAST_PASSAGES} passages"
        )
    return words
