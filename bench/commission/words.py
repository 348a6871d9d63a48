"""How a commissioning says what it has found: titles, values and intervals, for the terminal and the report."""

from __future__ import annotations

import math
from collections.abc import Iterable

from bench.commission.quantity import Converters, Quantity

PREFIXES = {-12: "p", -9: "n", -6: "u", -3: "m", 0: "", 3: "k"}
TITLES = {
    "u_dc": "DC link voltage", "noise": "noise of a current sensor", "R_s": "resistance of a phase",
    "U_dead": "dead time's volts", "t_dead": "dead time, effective", "L_d": "L_d without current",
    "L_q": "L_q without current", "L_d_half": "L_d at half the current", "L_q_half": "L_q at half the current",
    "n_p": "electrical turns in one of the shaft", "encoder_zero": "encoder's zero", "psi_f": "flux linkage",
    "psi_f_blind": "flux linkage, without the encoder", "L_d_run": "L_d at speed", "L_q_run": "L_q under torque",
    "encoder_delay": "delay of the encoder", "current_delay": "delay of the currents", "J": "inertia of the shaft",
    "b": "viscous friction", "tau_c": "dry friction", "hall_offset": "Hall ring", "hall_delay": "delay of Hall edges",
    "step_misfit": "a step of i_d against the model", "R_rough": "resistance, rough", "L_rough": "inductance, rough",
    "i_held": "current held for the ammeter",
}  # fmt: skip
"""Of the quantities that are shown; others stand in files only."""
ROUGH = {"R_rough": "R_s", "L_rough": "L_d"}
"""Which are shown only where the better one was not found."""


def table(found: Iterable[Quantity], converters: Converters) -> tuple[list[str], list[list[str]]]:
    """Titles of columns, and a row for each quantity to be shown; absolute values where an instrument tells them."""
    by_name = {quantity.name: quantity for quantity in found}
    shown = [q for name, q in by_name.items() if name in TITLES and ROUGH.get(name) not in by_name]
    own = (converters.volts_gain, converters.amperes_gain) == (1.0, 1.0)
    titles = ["quantity", "value", "95 %, drive's units", "mostly", *([] if own else ["absolute"]), "95 %, absolute",
              "mostly"]  # fmt: skip
    return titles, [_row(quantity, converters, own) for quantity in shown]


def _row(quantity: Quantity, known: Converters, own: bool) -> list[str]:
    absolute, unit = quantity.absolute_value(known), quantity.unit
    return [
        TITLES[quantity.name], told(quantity.value, unit), _width(quantity, quantity.value, quantity.half_width),
        quantity.dominated_by, *([] if own else [told(absolute, unit)]),
        _width(quantity, absolute, quantity.absolute_half_width(known)), quantity.absolutely_dominated_by(known),
    ]  # fmt: skip


def _width(quantity: Quantity, value: float, half_width: float) -> str:
    share = 100.0 * half_width / abs(value) if value else math.inf
    if quantity.unit == "rad" or quantity.name == "step_misfit" or share >= 100.0:
        return f"+- {told(half_width, quantity.unit, 2)}"
    return f"+- {share:.2g} %"


def told(value: float, unit: str, digits: int = 4) -> str:
    """As a person reads it: angles in degrees, shares in percent, others with the prefix of the unit that fits."""
    if unit == "rad":
        return f"{_rounded(math.degrees(value), digits)} deg"
    if unit == "1":
        return f"{_rounded(100.0 * value, digits)} %"
    exponent = 3 * math.floor(math.log10(abs(value)) / 3.0) if value else 0
    exponent = min(max(exponent, min(PREFIXES)), max(PREFIXES))
    return f"{_rounded(value / 10.0**exponent, digits)} {PREFIXES[exponent]}{unit}".rstrip()


def _rounded(value: float, digits: int) -> str:
    return f"{float(f'{value:.{digits}g}'):g}"
