"""Two commissionings of one motor: what has changed beyond both intervals, and what that means where it is known.

Compared is what `found.json` has, because a dump of parameters has no intervals, in the drive's own units; of two
drives, whose gains differ, in absolute ones. What a change means is said only where it is well beyond both intervals,
and as far as one cause does just that: a wrong accusation is worse than none.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.commission.words import TITLES, told
from bench.errors import BenchError
from bench.signal.position import wrapped

COPPER = 0.00393
"""1/K, by which copper's resistance grows, at 20 C."""
MAGNETS = 0.002
"""1/K, by which the flux of the magnets falls at most: ferrites; others a tenth to half as much."""
HOTTEST = 130.0
"""K, beyond which a winding has no warmth to explain its resistance."""
SURE = 1.5
"""Times both half widths from which it is said what a change means: twenty quantities are compared at once."""
ALIKE = 0.01
"""By which agreed currents may differ for inductances beside a current to be the same quantity."""
SECTORS = tuple(f"edge_{way}_{sector}" for way in ("up", "down") for sector in range(1, 7))
INDUCTANCES = ("L_d", "L_q", "L_d_half", "L_q_half")
SHAFT = ("J", "b", "tau_c")
NAMES = (
    "R_s", *INDUCTANCES, "t_dead", "n_p", "encoder_zero", "psi_f", *SHAFT, "hall_offset", "hall_delay",
    *SECTORS,
)  # fmt: skip


@dataclass(frozen=True)
class Change:
    """Of one quantity, in SI units; `width`: the sum of the half widths of both 95 % intervals."""

    name: str
    unit: str
    old: float
    new: float
    width: float

    @property
    def by(self) -> float:
        """New less old; of an angle the shorter way."""
        return float(wrapped(self.new - self.old)) if self.unit == "rad" else self.new - self.old

    @property
    def share(self) -> float:
        """Of the old value."""
        return self.by / abs(self.old) if self.old else math.inf

    @property
    def beyond(self) -> bool:
        """Whether the two intervals have nothing in common."""
        return abs(self.by) > self.width

    @property
    def sure(self) -> int:
        """1 or -1 for what has grown or fallen well beyond both intervals, else 0."""
        return 0 if abs(self.by) <= SURE * self.width else 1 if self.by > 0.0 else -1

    @property
    def span(self) -> tuple[float, float]:
        """Between which the share is."""
        return self.share - self.width / abs(self.old), self.share + self.width / abs(self.old)

    @property
    def title(self) -> str:
        """What it is called."""
        return TITLES.get(self.name, self.name.replace("_", " "))

    @property
    def moved(self) -> str:
        """By how much, in words."""
        return told(self.by, self.unit, 2) if self.unit == "rad" or not self.old else f"{100.0 * self.share:+.2g} %"

    @property
    def row(self) -> list[str]:
        """In words: title, old, new, change, and whether that is beyond both intervals."""
        old, new = (told(value, self.unit) for value in (self.old, self.new))
        return [self.title, old, new, self.moved, "yes" if self.beyond else "no"]


OWN, ABSOLUTE = ("value", "half_width"), ("absolute", "absolute_half_width")
"""Keys of a quantity in such a file; each may be null."""
COLUMNS = ["quantity", "old", "new", "change", "beyond both intervals"]


@dataclass(frozen=True)
class Comparison:
    """Of an old and a new commissioning."""

    changes: Mapping[str, Change]
    words: tuple[str, ...]
    """What it means, a sentence each."""
    when: str = ""
    """When the old one was made; ISO 8601, empty where it does not tell."""

    @property
    def rows(self) -> list[list[str]]:
        """All quantities that were compared; of Hall edges those that are beyond both intervals."""
        return [each.row for name, each in self.changes.items() if name not in SECTORS or each.beyond]

    def as_json(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "when": self.when, "words": list(self.words),
            "changes": {name: {"old": each.old, "new": each.new, "width": each.width, "beyond": each.beyond}
                        for name, each in self.changes.items()},
        }  # fmt: skip


def read(path: Path) -> dict[str, Any]:
    """What a commissioning has written as JSON. BenchError for another file."""
    try:
        data = json.loads(path.read_text("utf-8"))
        for each in data["quantities"].values():
            str(each["unit"]), [float(each[key] or 0.0) for key in (*OWN, *ABSOLUTE)]
        data["drive"].get("serial")
    except OSError as error:
        raise BenchError(f"{path} cannot be read: {error.strerror}") from None
    except (ValueError, KeyError, TypeError, AttributeError):
        raise BenchError(
            f"{path} is not what bench commission writes by --json, nor found.json of its --report: a dump of "
            "parameters has no intervals to compare by"
        ) from None
    return dict(data)


def compared(old: Mapping[str, Any], new: Mapping[str, Any]) -> Comparison:
    """Compare two of them, see `read`."""
    serials = [data["drive"].get("serial") for data in (old, new)]
    same = serials[0] == serials[1]
    value, width = OWN if same else ABSOLUTE
    left = [] if same else ["another drive, whose volts and amperes are its own: absolute values are compared"]
    currents = [float(data.get("current") or math.nan) for data in (old, new)]
    halves = abs(currents[0] - currents[1]) <= ALIKE * currents[0]
    changes = {}
    for name in NAMES:
        if not halves and name.endswith("_half"):
            continue
        a, b = (data["quantities"].get(name, {}) for data in (old, new))
        if None not in (a.get(value), b.get(value), a.get(width), b.get(width)):
            changes[name] = Change(name, a["unit"], float(a[value]), float(b[value]), float(a[width] + b[width]))
    return Comparison(changes, (*left, *meanings(changes)), str(old.get("about", {}).get("started", "")))


def meanings(changes: Mapping[str, Change]) -> list[str]:
    """What the changes mean, where that is known, a sentence each."""
    if not changes:
        return ["the two have no quantity in common that is compared"]
    sure = {name: each for name, each in changes.items() if each.sure}
    if "n_p" in sure and round(sure["n_p"].new) != round(sure["n_p"].old):
        return [f"{sure['n_p'].new:.0f} pole pairs, and {sure['n_p'].old:.0f} before: it is another motor"]
    gain, explained = _converters(changes)
    shaft = {name: each for name, each in sure.items() if name not in explained}
    told = [*([gain] if gain else _electrical(changes)), *_power_stage(sure), *_shaft(shaft), *_places(sure)]
    barely = [each.title for name, each in changes.items() if each.beyond and name not in sure]
    if barely:
        told.append(f"beyond both intervals, but barely: {', '.join(barely)}; measure again to be sure")
    return told or ["nothing has changed beyond both intervals"]


def _electrical(changes: Mapping[str, Change]) -> list[str]:
    """Of resistance, flux and inductances, where no converter explains them."""
    R, psi = (changes.get(name) for name in ("R_s", "psi_f"))
    told = []
    if R is not None and psi is not None and R.sure and psi.sure:
        told.append(_warmth(R, psi))
    elif R is not None and R.sure:
        told.append(_resistance(R, psi))
    elif psi is not None and psi.sure:
        told.append(_flux(psi, R))
    if moved := [changes[name] for name in INDUCTANCES if name in changes and changes[name].sure]:
        words = "warmth does not change inductances; turns that are shorted, or another motor, would"
        told.append(f"{_named(moved)}: {words}")
    return told


def _converters(changes: Mapping[str, Change]) -> tuple[str, set[str]]:
    """Which gain explains that all inductances have moved as R has, and the flux too, or not at all; empty for none.

    With the names, among those of the shaft, that have moved as the torque does by that gain.
    """
    R, psi = (changes.get(name) for name in ("R_s", "psi_f"))
    moved = [changes[name] for name in INDUCTANCES if name in changes]
    if R is None or psi is None or not R.sure or not moved:
        return "", set()
    if not all(each.sure and _overlap(R.span, each.span) for each in moved):
        return "", set()
    if psi.sure and _overlap(R.span, psi.span):
        torque = R.span
        words = (
            f"resistance, inductances and flux have all changed by {R.moved}, as if the drive measured its DC link by "
            "another gain: compare it with a voltmeter (--voltmeter)"
        )
    elif not psi.beyond:
        least, most = R.span
        torque = 1.0 / (1.0 + most) - 1.0, 1.0 / (1.0 + least) - 1.0
        words = (
            f"resistance and inductances have changed by {R.moved} and the flux has not, as if the drive measured its "
            "currents by another gain: compare them with an ammeter (--ammeter)"
        )
    else:
        return "", set()
    return words, {name for name in SHAFT if name in changes and _overlap(torque, changes[name].span)}


def _named(changes: Sequence[Change]) -> str:
    return ", ".join(f"{each.title} {each.moved}" for each in changes)


def _overlap(one: tuple[float, float], other: tuple[float, float]) -> bool:
    return one[0] <= other[1] and other[0] <= one[1]


def _beside(other: Change | None, name: str) -> str:
    if other is None:
        return f"; the {name} was not compared"
    return f", and the {name} has {'barely' if other.beyond else 'not'} changed"


def _warmth(R: Change, psi: Change) -> str:
    kelvin = R.share / COPPER
    both = f"resistance {R.moved}, flux {psi.moved}"
    if R.sure == psi.sure:
        return f"{both}: no single cause that is known does both; cannot tell"
    if R.sure < 0:
        return f"{both}: the motor is colder, its winding by about {-kelvin:.0f} K"
    least, most = -psi.span[1], MAGNETS * R.span[1] / COPPER
    if kelvin > HOTTEST or least > most:
        return (
            f"{both}: more than warmth does (the winding would be {kelvin:.0f} K warmer, and a magnet loses "
            f"{100.0 * MAGNETS:g} % per K at most); measure again when all of it is cold: what is missing then is lost"
        )
    return f"{both}: the motor is warmer, its winding by about {kelvin:.0f} K, and its magnets are too"


def _resistance(R: Change, psi: Change | None) -> str:
    kelvin = R.share / COPPER
    told = f"resistance {R.moved}{_beside(psi, 'flux')}"
    if R.sure < 0:
        return f"{told}: the winding is {-kelvin:.0f} K colder, or its wires are shorter"
    if kelvin > HOTTEST:
        return f"{told}: more than warmth does; look for a contact, a wire or a crimp that resists"
    return (
        f"{told}: a winding that is {kelvin:.0f} K warmer, or a contact or wires that resist; measure again when all "
        "of it is cold"
    )


def _flux(psi: Change, R: Change | None) -> str:
    told = f"flux {psi.moved}{_beside(R, 'resistance')}"
    if psi.sure > 0:
        return f"{told}: magnets that were warm then, or another motor; cannot tell"
    return (
        f"{told}: the magnets are demagnetised in part, unless they are still warm from before; measure again when all "
        "of it is cold"
    )


def _power_stage(sure: Mapping[str, Change]) -> list[str]:
    if "t_dead" not in sure:
        return []
    _, old, new, *_ = sure["t_dead"].row
    return [f"dead time {old}, now {new}: another power stage, or another setting of it"]


def _shaft(sure: Mapping[str, Change]) -> list[str]:
    told = []
    if "J" in sure:
        words = "something is attached now" if sure["J"].sure > 0 else "something was attached then"
        told.append(f"inertia {sure['J'].moved}: {words}, or another rotor")
    frictions = [sure[name] for name in ("tau_c", "b") if name in sure]
    grown = [each for each in frictions if each.sure > 0]
    if grown:
        words = "bearings, a seal, colder grease, or something that drags; turn the shaft by hand"
        told.append(f"{_named(grown)}: {words}")
    elif frictions:
        told.append(f"{_named(frictions)}: bearings that have run in, or warmer grease")
    return told


def _places(sure: Mapping[str, Change]) -> list[str]:
    told = []
    if "encoder_zero" in sure:
        told.append(
            f"encoder's zero by {sure['encoder_zero'].moved} (electrical): it has turned on the shaft, or it has no "
            "index and counts from where it was switched on"
        )
    edges = [sure[name] for name in SECTORS if name in sure]
    if "hall_offset" in sure:
        told.append(f"Hall ring by {sure['hall_offset'].moved} (electrical): it has slipped, or was put on anew")
    elif edges:
        most = max(edges, key=lambda each: abs(each.by))
        told.append(
            f"{len(edges)} of 12 Hall edges have moved, by {most.moved} (electrical) at most, and the ring has not: "
            "a sensor, or where it switches"
        )
    return told
