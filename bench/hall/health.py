"""What is wrong with Hall sensors, their wires or the encoder they are compared with: causes in words, with evidence.

A cause is named only on evidence that tells it from the others, and every one comes with its numbers. In this order:
is there enough to go by; inputs that never change; pole pairs; the encoder's zero, direction and delay; the wiring
(one fault of it at a time); where the sensors stand; false pulses. The encoder's zero, where no back-EMF was recorded,
is taken to be right unless the wiring then makes no sense, and the words say what else it may be.

Nothing here talks to a drive or prints.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bench.findings import encoder, late, pole_pairs, sensors, wiring
from bench.findings.finding import Finding
from bench.findings.sensors import Codes
from bench.findings.thresholds import LEAST_PASSAGES, LEAST_TURNS
from bench.findings.wiring import AS_SPECIFIED, Diagnosis, diagnose
from bench.rig.outcome import RunOutcome
from bench.signal import hall_edges, pulses, reference
from bench.signal.delays import AGREE, Delays, delays_of
from bench.signal.hall_edges import Measured
from bench.signal.pulses import Pulses
from bench.signal.reference import BackEmf, Turns
from bench.signal.trace import SLOW, Trace
from bench.signal.verdict import Verdict
from bench.signal.waveforms.sectors import steps_between


@dataclass(frozen=True)
class Health:
    """The result of a check."""

    verdict: Verdict
    """PASS: healthy. FAIL: something is wrong. INVALID: the data are insufficient for either."""
    findings: tuple[Finding, ...]
    missing: tuple[str, ...]
    """Why no more can be said, and what to do about it."""
    turns: Turns
    measured: Measured
    pulses: Pulses
    codes: Codes
    emf: BackEmf | None
    delays: Delays
    wiring: Diagnosis | None

    @property
    def exit_code(self) -> int:
        """Of the command: 0 healthy, 1 something is wrong, 2 the data are insufficient."""
        return RunOutcome.of(self.verdict).exit_code


def examine(trace: Trace, further: str = "") -> Health:
    """Name what is wrong. `further`: how to turn the shaft more if it turned too little, in words."""
    turns, measured, found_pulses = reference.turns(trace), hall_edges.measure(trace.edges), pulses.count(trace)
    codes = _codes(trace)
    findings: list[Finding] = []
    missing: list[str] = []
    emf: BackEmf | None = None
    delays = Delays(measured.delay if measured.delay_half_width < AGREE else math.nan, math.nan)
    diagnosis: Diagnosis | None = None
    if not turns.total >= LEAST_TURNS:
        missing.append(
            f"only {np.nan_to_num(turns.total):.1f} electrical revolutions: turn the shaft forward and reverse"
            + (f", {further}" if further else "")
        )
    elif dead := list(sensors.dead(trace, turns)):
        findings += dead
    elif not trace.encoder:
        findings += wiring.inverted_by_codes(trace.changed)
        missing.append(
            "no encoder was recorded: without one, exchanged wires and displaced sensors are not detected; "
            "record theta_enc, or fit an encoder for the check"
        )
    elif contradicting := list(pole_pairs.of_edges(trace.edges, turns)):
        findings += contradicting
    else:
        emf = reference.back_emf(trace)
        delays = delays._replace(back_emf=delays_of(trace).back_emf)
        findings += [*encoder.zero(emf), *late.late(delays, _fastest(trace))]
        # that of the rotor flux, where the back-EMF says that the encoder's is another
        some = trace.some
        theta = emf.zero - some.theta if emf is not None and emf.reversed else some.theta - encoder.ahead(emf)
        moving = np.abs(some.omega) >= SLOW
        try:
            diagnosis = diagnose(theta[moving], some.hall[moving])
        except ValueError as error:
            missing.append(f"wiring unknown: {error}")
        else:
            as_specified, forwards = diagnosis.best == AS_SPECIFIED, emf is None or not emf.reversed
            found: list[Finding] = []
            if forwards and (as_specified or sensors.in_their_sectors(measured, emf)):
                found = [*sensors.places(measured, emf), *sensors.implausible(codes, found_pulses)]
            if not as_specified and not found:
                found = list(wiring.wires(trace, theta, diagnosis, measured, emf))
            findings += found
        missing += _thin(turns, measured)
    findings += sensors.false_pulses(found_pulses)
    verdict = Verdict.FAIL if findings else Verdict.INVALID if missing else Verdict.PASS
    return Health(
        verdict, tuple(findings), tuple(missing), turns, measured, found_pulses, codes, emf, delays, diagnosis
    )


def _fastest(trace: Trace) -> float:
    """The largest speed that the drive allows, electrical rad/s; inf where it does not tell."""
    parameters = trace.parameters
    return parameters.get("n_p", math.inf) * parameters.get("omega_m_max", math.inf)


def _codes(trace: Trace) -> Codes:
    illegal = np.zeros((8, 8), bool)
    illegal[[0, 7]] = illegal[:, [0, 7]] = True
    far = np.abs(steps_between(*np.indices((8, 8)))) != 1.0
    lead_there, skipped, edges = (int(trace.changed[which].sum()) for which in (illegal, ~illegal & far, ...))
    return Codes(int(trace.codes[[0, 7]].sum()), trace.samples, lead_there, skipped, edges)


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
