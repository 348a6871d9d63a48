"""What a detector yields."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """Something that is wrong."""

    code: str
    """For scripts: edge_records, hall_codes, dead, contact, bounce, pulses, wiring, hall_setting, displaced, duty,
    late_edges, magnet, unsteady, pole_pairs, encoder_zero, encoder_reversed, encoder_late, encoder_slipped,
    encoder_slips, encoder_drifts, encoder_eccentric; of a commissioning also motor_phases, heavy; of a run also
    flux_linkage, resistance, inductance, speed, position_error, current, current_sum, not_finite, heartbeat; of notes
    ring, index, delays."""
    cause: str
    evidence: tuple[str, ...] = ()
    advice: str = ""

    @property
    def line(self) -> str:
        """Cause and evidence in one line, as the result of a run has them."""
        return ": ".join(filter(None, (self.cause, "; ".join(self.evidence))))


def degrees(angle: float, places: int = 1) -> str:
    """An angle in rad as evidence has it: in degrees."""
    return f"{math.degrees(angle):.{places}f} deg"


def percent(share: float) -> str:
    """A share of 0..1 as evidence has it."""
    return f"{100.0 * float(share):.1f} %"
