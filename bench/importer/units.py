"""Units as files write them, and what it takes to make SI of them."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace

from bench.signal.units import RPM
from protocol.signals import Unit

TURN = math.tau
_KNOWN: dict[Unit, dict[str, float]] = {
    Unit.S: {
        "s": 1.0, "sec": 1.0, "secs": 1.0, "second": 1.0, "seconds": 1.0, "ms": 1e-3, "msec": 1e-3,
        "milliseconds": 1e-3, "us": 1e-6, "usec": 1e-6, "microseconds": 1e-6, "ns": 1e-9, "nsec": 1e-9,
        "nanoseconds": 1e-9, "ps": 1e-12, "min": 60.0,
    },
    Unit.A: {"A": 1.0, "amp": 1.0, "amps": 1.0, "ampere": 1.0, "mA": 1e-3, "uA": 1e-6, "kA": 1e3},
    Unit.V: {"V": 1.0, "volt": 1.0, "volts": 1.0, "mV": 1e-3, "uV": 1e-6, "kV": 1e3},
    Unit.RAD: {
        "rad": 1.0, "radian": 1.0, "radians": 1.0, "mrad": 1e-3, "deg": TURN / 360, "degree": TURN / 360,
        "degrees": TURN / 360, "rev": TURN, "revs": TURN, "revolution": TURN, "revolutions": TURN, "turn": TURN,
        "turns": TURN, "cycles": TURN,
    },
    Unit.RAD_PER_S: {
        "rad/s": 1.0, "deg/s": TURN / 360, "rpm": RPM, "r/min": RPM, "1/min": RPM, "min-1": RPM, "u/min": RPM,
        "rev/min": RPM, "krpm": 1e3 * RPM, "rev/s": TURN, "r/s": TURN, "turn/s": TURN, "turns/s": TURN,
        "rps": TURN,
    },
    Unit.RAD_PER_S2: {"rad/s^2": 1.0, "rad/s2": 1.0},
    Unit.NM: {"Nm": 1.0, "N.m": 1.0, "N*m": 1.0, "mNm": 1e-3, "Ncm": 1e-2, "Nmm": 1e-3},
    Unit.W: {"W": 1.0, "watt": 1.0, "watts": 1.0, "mW": 1e-3, "kW": 1e3},
    Unit.HZ: {
        "Hz": 1.0, "kHz": 1e3, "MHz": 1e6, "GHz": 1e9, "Sa/s": 1.0, "kSa/s": 1e3, "MSa/s": 1e6, "GSa/s": 1e9,
        "S/s": 1.0, "kS/s": 1e3, "MS/s": 1e6, "GS/s": 1e9, "samples/s": 1.0,
    },
    Unit.OHM: {"Ohm": 1.0, "ohms": 1.0, "mOhm": 1e-3},
    Unit.H: {"H": 1.0, "mH": 1e-3, "uH": 1e-6},
    Unit.VS: {"V*s": 1.0, "Vs": 1.0, "Wb": 1.0, "mWb": 1e-3},
    Unit.KGM2: {"kg*m^2": 1.0, "kgm2": 1.0},
    Unit.DEG_C: {"degC": 1.0, "C": 1.0},
    Unit.COUNT: {"counts": 1.0, "count": 1.0, "cnt": 1.0, "cnts": 1.0, "inc": 1.0, "counts/s": 1.0, "cnt/s": 1.0},
    Unit.NONE: {"": 1.0, "-": 1.0, "1": 1.0, "%": 1e-2},
}  # fmt: skip
_ELECTRICAL = {"erpm": ("rpm", True), "edeg": ("deg", True), "erad": ("rad", True)}
_QUANTITY = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)(?![\d.])\s*(.*)", re.DOTALL)
_FRAME = re.compile(r"^(mech(?:anical)?\.?|el(?:ec(?:trical)?)?\.?)[ _]+", re.IGNORECASE)


@dataclass(frozen=True)
class Scale:
    """A unit: `factor` makes the SI unit `unit` of it. `electrical`: of the rotor flux, or of the shaft; None: open."""

    unit: Unit
    factor: float
    electrical: bool | None = None


def scale_of(word: str) -> Scale | None:
    """What a unit is, "mech" or "el" before it; None for one that is not known."""
    plain = word.strip().strip("[](){}").strip()
    for wrong, right in (("µ", "u"), ("μ", "u"), ("°", "deg"), ("Ω", "Ohm"), ("·", "*"), ("²", "^2"), ("º", "deg")):
        plain = plain.replace(wrong, right)
    electrical = None
    if frame := _FRAME.match(plain):
        electrical, plain = frame[1].lower().startswith("e"), plain[frame.end() :]
    if plain.lower() in _ELECTRICAL:
        plain, electrical = _ELECTRICAL[plain.lower()]
    plain = plain.replace(" ", "")
    found = _EXACT.get(plain) or _ANY_CASE.get(plain.lower())
    return replace(found, electrical=electrical) if found else None


_EXACT = {word: Scale(unit, factor) for unit, words in _KNOWN.items() for word, factor in words.items()}
_ANY_CASE: dict[str, Scale] = {}
for _word, _scale in _EXACT.items():
    _ANY_CASE.setdefault(_word.lower(), _scale)
for _word in ("mv", "mw", "ma", "c", "h"):  # M and m, C and c are not the same
    if _word not in _EXACT:
        _ANY_CASE.pop(_word, None)


def quantity(text: str, unit: Unit, usual: str = "") -> float | None:
    """`24 MHz` in the SI unit that is wanted; in `usual` where it has no unit. None for what is not of that unit."""
    found = _QUANTITY.fullmatch(text)
    word = (found[2].strip() or usual.strip()) if found else ""
    scale = scale_of(word) if word else Scale(unit, 1.0)
    return float(found[1]) * scale.factor if found and scale and scale.unit == unit else None


def split(header: str) -> tuple[str, str]:
    """Name and unit of a header such as `speed [rpm]`, `Time(s)` or `i_q (A)`; no unit is empty."""
    found = re.fullmatch(r"\s*(.*?)\s*[\[({<]\s*([^\[\](){}<>]*?)\s*[\])}>]\s*", header)
    if found and found[1] and scale_of(found[2]) is not None:
        return found[1].strip(), found[2]
    return header.strip(), ""
