"""Which of a drive's angles comes late: the encoder's, that of the Hall edges, or that of the back-EMF.

Only differences between them can be measured (`bench.signal.delays`). An encoder that is late makes both others lead by
as much, late Hall sensors make the edges lag alone, if the back-EMF is taken to be on time.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from enum import Enum

from bench.findings.finding import Finding, degrees
from bench.findings.thresholds import LATE
from bench.signal.delays import AGREE, CLOSE, Delays

ASK_BACK_EMF = "let the drive turn the motor faster, and record u_alpha, u_beta, i_a and i_b: the back-EMF shows which"
ASK_EDGES = "record Hall edges at several speeds: they show which"
OF_ANOTHER_TIME = "currents and voltages are sampled at another time"


class Late(Enum):
    """What is late, or early."""

    NONE = "none"
    ENCODER = "encoder"
    HALL = "hall"
    BOTH = "both"
    UNCLEAR = "unclear"


def blame(found: Delays) -> tuple[Late, str]:
    """What is late by these delays, and how that is known, in words; where several causes fit, all are named."""
    edges, emf, by_count = found
    known = [abs(delay) - off for delay, off in ((edges, by_count if math.isnan(emf) else 0.0), (emf, 0.0))]
    if all(beyond < LATE for beyond in known if not math.isnan(beyond)):
        return Late.NONE, ""
    edges_differ, emf_differs = _against(edges, "Hall edges", ""), _against(emf, "back-EMF", "s")
    if math.isnan(emf):
        other = "they are late" if edges > 0.0 else "the time stamps of samples are late against those of edges"
        return Late.UNCLEAR, f"{edges_differ}: the encoder is {_late(-edges)}, or {other}; {ASK_BACK_EMF}"
    if math.isnan(edges):
        return Late.UNCLEAR, f"{emf_differs}: the encoder is {_late(-emf)}, or {OF_ANOTHER_TIME}; {ASK_EDGES}"
    if abs(edges - emf) < max(AGREE, CLOSE * abs(emf)):
        return Late.ENCODER, f"the encoder is {_late(-emf)}: {emf_differs}, and {edges_differ}"
    if abs(emf) < LATE and edges > 0.0:
        return Late.HALL, f"the Hall edges are {_late(edges)}: encoder and back-EMF agree"
    if abs(emf) < LATE:
        return Late.UNCLEAR, (
            f"{edges_differ}, and the back-EMF does not: no sensor sees an edge before it happens, so the time stamps "
            f"of samples are late against those of edges"
        )
    if abs(edges) < LATE:
        return Late.UNCLEAR, (
            f"{emf_differs}, and the Hall edges do not: encoder and Hall edges are both {_late(-emf)}, or "
            f"{OF_ANOTHER_TIME}; these data do not separate the two"
        )
    return Late.BOTH, (
        f"the encoder is {_late(-emf)} and the Hall edges are {_late(edges - emf)}, if the back-EMF is on time: "
        f"{emf_differs}, and {edges_differ}"
    )


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
    seems = (
        f"every estimate appears to lead by omega times that: {degrees(-delay * omega_max)} at the drive's top speed"
    )
    yield Finding(
        "encoder_late",
        cause,
        (why, seems) if math.isfinite(omega_max) else (why,),
        "sample the encoder together with the currents; look for a filter or a slow interface",
    )


def _against(delay: float, what: str, ending: str) -> str:
    return f"the {what} {'lag' if delay > 0.0 else 'lead'}{ending} the encoder by {1e6 * abs(delay):.0f} us"


def _late(delay: float) -> str:
    return f"{1e6 * abs(delay):.0f} us {'late' if delay > 0.0 else 'early'}"
