"""What was found, as parameters that `bench param load` takes, with their intervals as comments."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from bench.commission.quantity import Converters, Quantity
from bench.param.table import Parameters

SAME = {"R_s": "R_s_hat", "t_dead": "dead_time_hat", "psi_f": "psi_f_hat", "J": "J_hat"}
"""Parameters that are a quantity as it was found, by its name."""
NAMED_ALIKE = (
    "encoder_zero", "hall_offset", *(f"edge_{way}_{sector}" for way in ("up", "down") for sector in range(1, 7)),
)  # fmt: skip


def parameters_of(found: Mapping[str, Quantity]) -> dict[str, Quantity]:
    """By the drive's parameter what it should be, of what was found."""
    told = {parameter: found[name] for name, parameter in SAME.items() if name in found}
    told |= {name: found[name] for name in NAMED_ALIKE if name in found}
    if {"L_d_half", "L_q_half"} <= found.keys():
        d, q = found["L_d_half"], found["L_q_half"]
        parts = {name: max(d.parts.get(name, 0.0), q.parts.get(name, 0.0)) for name in {**d.parts, **q.parts}}
        parts["saliency"] = 0.5 * abs(d.value - q.value)
        told["L_s_hat"] = Quantity("L_s", "H", 0.5 * (d.value + q.value), parts, volts=1.0, amperes=-1.0)
    return told


def loadable(
    found: Mapping[str, Quantity], settings: Mapping[str, float], of: Parameters, converters: Converters
) -> tuple[Parameters, list[str]]:
    """What the drive takes of what was found and of `settings`, which follow from it; what it does not take, in words.

    `of`: the drive's parameters, which tell names, ranges and meanings.
    """
    entries, left = {}, []
    measured = parameters_of(found)
    values = {name: quantity.value for name, quantity in measured.items()}
    for name, value in {**settings, **values}.items():
        if name not in of.entries:
            left.append(f"the drive has no parameter {name}")
            continue
        entry = of.entries[name]
        lo = value if entry.lo is None else entry.lo
        hi = value if entry.hi is None else entry.hi
        if not lo <= value <= hi:
            left.append(f"{name} = {value:.4g} {entry.unit} is beyond the drive's range, {lo:g} to {hi:g}")
            continue
        known = f"95 %: {interval(measured[name], converters)}" if name in measured else "by what was found"
        entries[name] = replace(entry, value=value, meaning=known)
    return Parameters(of.title, entries, of.identity), left


def interval(quantity: Quantity, converters: Converters) -> str:
    """Both intervals in words, for a comment; the absolute value where it is another."""
    by, absolute = quantity.dominated_by, quantity.absolute_value(converters)
    other = f"{absolute:.5g} " if absolute != quantity.value else ""
    return (
        f"+- {quantity.half_width:.2g} in the drive's own volts and amperes{f', mostly {by}' if by else ''}; "
        f"{other}+- {quantity.absolute_half_width(converters):.2g} absolute"
    )
