"""What was found, as parameters that `bench param load` takes, with their intervals as comments."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from bench.commission.quantity import COVERAGE, Converters, Quantity
from bench.param import dump, history
from bench.param.table import Parameters

REASON = "found by bench commission"


def parameters_of(found: Mapping[str, Quantity]) -> dict[str, Quantity]:
    """By the drive's parameter what it should be, of what was found."""
    told: dict[str, Quantity] = {}
    if "R_s" in found:
        told["R_s_hat"] = found["R_s"]
    if {"L_d_half", "L_q_half"} <= found.keys():
        d, q = found["L_d_half"], found["L_q_half"]
        parts = {name: max(d.parts.get(name, 0.0), q.parts.get(name, 0.0)) for name in {**d.parts, **q.parts}}
        parts["saliency"] = 0.5 * abs(d.value - q.value)
        told["L_s_hat"] = Quantity("L_s", "H", 0.5 * (d.value + q.value), parts, volts=1.0, amperes=-1.0)
    if "t_dead" in found:
        told["dead_time_hat"] = found["t_dead"]
    return told


def toml(found: Mapping[str, Quantity], of: Parameters, converters: Converters) -> tuple[str, list[str]]:
    """A dump of what was found, and what the drive does not take of it, in words.

    `of`: the drive's parameters, which tell names, ranges and meanings.
    """
    entries, left = {}, []
    for name, quantity in parameters_of(found).items():
        if name not in of.entries:
            left.append(f"the drive has no parameter {name}")
            continue
        entry = of.entries[name]
        lo = quantity.value if entry.lo is None else entry.lo
        hi = quantity.value if entry.hi is None else entry.hi
        if not lo <= quantity.value <= hi:
            left.append(f"{name} = {quantity.value:.4g} {entry.unit} is beyond the drive's range, {lo:g} to {hi:g}")
            continue
        meaning = f"95 %: {interval(quantity, converters)}"
        entries[name] = replace(entry, value=quantity.value, meaning=meaning)
    told = Parameters(of.title, entries, of.identity)
    return dump.text(told, history.now(), history.who(), REASON), left


def interval(quantity: Quantity, converters: Converters) -> str:
    """Both intervals in words, for a comment."""
    absolute = COVERAGE * quantity.absolute(converters)
    by = quantity.dominated_by
    return (
        f"+- {quantity.half_width:.2g} in the drive's own volts and amperes{f', mostly {by}' if by else ''}; "
        f"+- {absolute:.2g} absolute"
    )
