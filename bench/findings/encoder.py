"""The encoder that all is measured by: its zero and its direction, where the back-EMF tells them."""

from __future__ import annotations

import math
from collections.abc import Iterator

from bench.findings.finding import Finding, degrees, percent
from bench.findings.thresholds import DISPLACED, ZERO
from bench.signal.reference import BackEmf

TELL = "record u_alpha, u_beta, i_a and i_b while the drive turns the motor: its back-EMF shows which"


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
    if abs(off) > ZERO:
        yield Finding(
            "encoder_zero",
            f"the encoder's zero is {degrees(off)} off",
            (f"theta_enc is {degrees(off)} ahead of the rotor flux", *evidence),
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
