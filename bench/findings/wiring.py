"""Which wiring of the Hall sensors explains what was seen: exchanged, rotated, inverted, open or shorted wires.

Edges tell the order of the codes and where the ring then stands (`order`): wires that are rotated look like a ring that
is turned by 120 deg, three inverted inputs like one turned by 180, and sensors 60 deg apart like one inverted input.
Where the drive does not say where its ring stands, none of that is a fault. Samples alone tell it where the encoder's
zero and the ring are as specified (`diagnose`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import permutations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bench.findings.encoder import TELL, ahead
from bench.findings.finding import Finding, degrees, percent
from bench.findings.sensors import stuck
from bench.findings.thresholds import LEAST_SEEN, LEAST_SHARE, MARGIN, NAMED, SET, ZERO
from bench.signal.edge_fit import OPENS
from bench.signal.hall_edges import Measured, mean_angle
from bench.signal.position import wrap, wrapped
from bench.signal.reference import BackEmf
from bench.signal.trace import INPUTS, Trace
from bench.signal.waveforms.samples import checked
from bench.signal.waveforms.sectors import SECTOR_WIDTH, SECTORS, sector_of_angle
from protocol.signals import INPUT_OF_SENSOR, SECTOR_OF_CODE

AS_SPECIFIED = "as specified"
NONE_KNOWN = "none of the known wirings"
INVERTED = " inverted"
STUCK = dict(stuck(name, level) for name in INPUTS for level in (0, 1))
"""What to do, by the cause."""
CONNECT = "connect each sensor to the input of its name"
LEARN = "`bench hall learn --write` tells the drive where the edges are"


class Diagnosis(NamedTuple):
    """The wiring that explains most, in words, and the next one."""

    best: str
    """Such as "as specified" or "sensor b open (always 1)"; "none of the known wirings" below a share of 0.95."""
    share: float
    """0..1, of the samples in a sector that the best wiring explains, averaged over the six sectors."""
    runner_up: str
    """The next best; where `best` names none, the best of all."""
    runner_up_share: float
    n: int
    """Samples used."""
    left_out: int
    """Samples too near to an edge."""


def diagnose(theta: ArrayLike, hall: NDArray[np.integer[Any]], margin: float = MARGIN) -> Diagnosis:
    """Compares the Hall codes `hall` (n,), 0..7 with bit 0 = sensor a, with what each wiring gives at `theta` (n,) rad.

    `theta` is the electrical angle by the encoder, wrapped or not. Samples within `margin` (rad) of an ideal edge are
    left out. Each sector counts alike, however long the rotor stood in it.

    Raises ValueError for unfit samples or codes, for a margin that leaves nothing, and where the rotor was not in all
    six sectors.
    """
    (theta,) = checked(theta=theta)
    hall = np.asarray(hall)
    if hall.shape != theta.shape:
        raise ValueError(f"hall: shape {hall.shape}, but theta has {theta.shape}")
    if not (hall.min() >= 0 and hall.max() <= 7):
        raise ValueError(f"a Hall code is 0..7, got {hall.min()} to {hall.max()}")
    if not 0 <= margin < SECTOR_WIDTH / 2.0:
        raise ValueError(f"margin must be from 0 to below 30 deg, got {math.degrees(margin):g} deg")
    counts = tally(theta, hall, margin)
    n = int(counts.sum())
    return Diagnosis(*explained(counts), n, len(theta) - n)


def tally(theta: NDArray[np.float64], hall: NDArray[np.integer[Any]], margin: float = MARGIN) -> NDArray[np.int64]:
    """How many samples in each sector had each code, shape (6, 8); `theta` finite, codes 0..7, any number of them."""
    clear = np.abs(wrap(theta * SECTORS)) >= margin * SECTORS
    sector = sector_of_angle(theta[clear])
    counts = np.bincount(sector * 8 + hall[clear].astype(np.int64), minlength=SECTORS * 8)
    return counts.reshape(SECTORS, 8)


def explained(counts: NDArray[np.int64]) -> tuple[str, float, str, float]:
    """The wiring that explains most of a `tally`, and the next, each with its share: the first fields of `Diagnosis`.

    ValueError where the rotor was not in all six sectors.
    """
    samples = counts.sum(axis=1, keepdims=True)
    if not samples.all():
        missing = ", ".join(f"{60 * s}..{60 * s + 60}" for s in np.flatnonzero(samples[:, 0] == 0))
        raise ValueError(f"no samples at {missing} deg (electrical): turn the rotor through all six sectors")
    seen = counts / samples  # [s, c]: share of the samples in sector s that had the code c
    shares = {name: float(seen[range(SECTORS), codes].mean()) for name, codes in _WIRINGS.items()}
    ranked = sorted(shares, key=shares.__getitem__, reverse=True)
    if shares[ranked[0]] < LEAST_SHARE:
        ranked.insert(0, NONE_KNOWN)
    best, runner_up = ranked[:2]
    return best, shares.get(best, shares[runner_up]), runner_up, shares[runner_up]


def _wirings() -> dict[str, list[int]]:
    """What the drive reads in sectors 0..5, by the name of the wiring."""
    specified = [SECTOR_OF_CODE.index(s) for s in range(SECTORS)]
    a, b, c = 1, 2, 4

    def routed(*sensors: int) -> list[int]:
        """The codes with these sensors on the inputs a, b and c."""
        return [sum(bit for bit, sensor in zip((a, b, c), sensors, strict=True) if code & sensor) for code in specified]

    wirings = {
        AS_SPECIFIED: specified,
        "sensors a and b exchanged": routed(b, a, c),
        "sensors b and c exchanged": routed(a, c, b),
        "sensors c and a exchanged": routed(c, b, a),
        "sensors rotated (a on b, b on c, c on a)": routed(c, a, b),
        "sensors rotated (a on c, b on a, c on b)": routed(b, c, a),
    }
    for sensor, bit in zip(INPUTS, (a, b, c), strict=True):
        wirings[f"sensor {sensor}{INVERTED}"] = [code ^ bit for code in specified]
        wirings[stuck(sensor, 1)[0]] = [code | bit for code in specified]
        wirings[stuck(sensor, 0)[0]] = [code & ~bit for code in specified]
    return wirings


_WIRINGS = _wirings()


def by_samples(trace: Trace) -> Iterator[Finding]:
    """The wiring, where it is a known fault, of a shaft that turned too little to be measured: by codes over the angle.

    Where the drive does not say where its ring sits, wires that are rotated look like a ring that is turned.
    """
    declared, some = trace.parameters.get("hall_offset"), trace.some
    told = np.isfinite(some.theta)
    counts = tally(some.theta[told] - (declared or 0.0), some.hall[told])
    if trace.codes.any() and counts.sum(axis=1).min() >= LEAST_SEEN:
        found = Diagnosis(*explained(counts), int(counts.sum()), 0)
        if declared is not None or "rotated" not in found.best:
            yield from miswired(found, zero_known=False)


def miswired(found: Diagnosis, zero_known: bool) -> Iterator[Finding]:
    """A wiring that is a known fault. `zero_known`: whether the back-EMF tells the zero of the encoder."""
    if found.best in (AS_SPECIFIED, NONE_KNOWN):
        return
    evidence = [f"that explains {percent(found.share)} of {found.n} samples; next best: {next_best(found)}"]
    if not zero_known and "rotated" in found.best:
        evidence.append("an encoder zero that is 120 deg off looks the same; the back-EMF would tell")
    advice = STUCK.get(found.best, CONNECT)
    if found.best.endswith(INVERTED):
        advice = f"correct the polarity of {found.best.removesuffix(INVERTED)}"
    yield Finding("wiring", found.best, tuple(evidence), advice)


def next_best(found: Diagnosis) -> str:
    """The runner-up, in words."""
    return f"{found.runner_up}, explains {percent(found.runner_up_share)}"


class Wired(NamedTuple):
    """A way in which the three inputs may be wired, and where the ring then stands."""

    sensors: tuple[int, ...]
    """By input: 0..2, the sensor that is on it."""
    inverted: int
    """Bits of the inputs that are inverted."""
    ring: float
    """rad, of the edge that opens sector I."""

    def off(self, target: float) -> float:
        """rad by which the ring then stands from where it is taken to."""
        return abs(wrapped(self.ring - target))

    @property
    def changes(self) -> int:
        """How many things are not as specified."""
        return (self.sensors != (0, 1, 2)) + (self.inverted > 0)

    @property
    def name(self) -> str:
        """In words."""
        a, b, c = (f"{INPUTS[sensor]} on {INPUTS[self.sensors.index(sensor)]}" for sensor in range(3))
        off = [INPUTS[number] for number in range(3) if self.sensors[number] != number]
        turned = [INPUTS[number] for number in range(3) if self.inverted >> number & 1]
        words = [
            {0: "", 2: f"sensors {' and '.join(off if off != ['a', 'c'] else off[::-1])} exchanged"}.get(
                len(off), f"sensors rotated ({a}, {b}, {c})"
            )
        ]
        if len(turned) == 3:
            words.append("all three inputs inverted")
        elif turned:
            words.append(f"sensor {' and '.join(turned)}{INVERTED}")
        return ", ".join(filter(None, words)) or AS_SPECIFIED


CENTRES = np.radians([30.0, 150.0, 270.0])
"""Where a ring at 0 has the middle of what each sensor is 1 over."""


def possible(measured: Measured, emf: BackEmf | None) -> list[Wired]:
    """All ways of wiring that explain the order of the codes and the edges; by the rotor flux, as far as known."""
    fit = measured.fit
    if fit is None or measured.blind:
        return []
    rises, falls = (fit.place[[OPENS.index((number, high)) for number in range(3)]] for high in (True, False))
    centres = math.copysign(1.0, measured.inputs.ratio) * (rises + (falls - rises) % math.tau / 2.0)
    centres = emf.zero - centres if emf is not None and emf.reversed else centres - ahead(emf)
    return ways(centres, measured.inputs.inverted)


def ways(centres: NDArray[np.float64], inverted: int) -> list[Wired]:
    """All ways of wiring with inputs a, b, c at 1 around these angles (3,), rad, once `inverted` ones are undone."""
    found = []
    for sensors in permutations(range(3)):
        rings = centres - CENTRES[list(sensors)]
        ring = mean_angle(rings)
        if np.abs(wrap(rings - ring)).max() < SECTOR_WIDTH:
            found += [Wired(sensors, inverted, ring), Wired(sensors, inverted ^ 7, mean_angle(rings + math.pi))]
    return found


def hats(wired: Wired, swap: int = 0, inverted: int = 0) -> tuple[float, float]:
    """`hall_swap_hat` and `hall_invert_hat` for that wiring, as seen by a drive that has these two now."""
    now = INPUT_OF_SENSOR[swap]
    swapped = INPUT_OF_SENSOR.index(tuple(now[wired.sensors.index(k)] for k in range(3)))
    return float(swapped), float(inverted ^ sum((wired.inverted >> k & 1) << now[k] for k in range(3)))


def order(found: list[Wired], declared: float | None, zero_known: bool) -> Iterator[Finding]:
    """Inputs that are not wired as specified, and a ring that is not where the drive takes it to be.

    `declared`: the drive's `hall_offset`, rad; None where it has none: the ring may then stand anywhere.
    """
    target = declared or 0.0
    there = [wired for wired in found if wired.changes == 0]
    near = sorted((w for w in found if w.changes == 1 and w.off(target) < NAMED), key=lambda w: w.off(target))
    or_zero = () if zero_known else ("an encoder whose zero is off by as much looks the same; the back-EMF would tell",)
    if there:
        [ring] = there
        within = SET if zero_known else SET + ZERO
        if declared is None or ring.off(declared) <= within:
            return
        stands = f"the ring stands at {degrees(ring.ring)}, and the drive takes it to stand at {degrees(declared)}"
        if near:
            yield Finding("wiring", near[0].name, (f"else {stands}", *or_zero), f"{CONNECT}; else {LEARN}")
            return
        yield Finding("hall_setting", f"{stands} (hall_offset)", or_zero, LEARN)
        return
    if not found:
        return
    connect = CONNECT if declared is None else f"{CONNECT}; else {LEARN}"
    [inverted] = {w.inverted for w in found if w.inverted in (0, 1, 2, 4)} or {0}
    straight = [w for w in found if w.sensors == (0, 1, 2)]
    ways = ", ".join(f"{w.name} with the ring at {degrees(w.ring)}" for w in found if w.inverted == inverted)
    if inverted:
        name = INPUTS[inverted.bit_length() - 1]
        apart = f"sensors 60 deg apart, {name} in the middle"
        cause = (
            f"sensor {name}{INVERTED}, or {apart}"
            if straight
            else f"{apart}, or sensor {name}{INVERTED} and others exchanged"
        )
        yield Finding(
            "wiring", cause, (f"two codes are missing, and 000 and 111 come in turn; {ways}",),
            f"correct the polarity of sensor {name}, in the firmware if its sensors are 60 deg apart; {LEARN}",
        )  # fmt: skip
    elif near:
        yield Finding(
            "wiring", near[0].name, (f"the codes come in the reverse order of the encoder: {ways}", *or_zero), connect
        )
    elif zero_known:
        yield Finding("wiring", "two Hall wires are exchanged", (f"the codes come in reverse order: {ways}",), connect)
    else:
        yield Finding(
            "encoder_reversed",
            "the encoder counts in the wrong direction, or two Hall wires are exchanged and the ring rotated",
            (f"the codes come in the reverse order of the encoder: {ways}",),
            f"correct the encoder's direction first; {TELL}",
        )


def ring(found: list[Wired], zero_known: bool) -> Iterator[Finding]:
    """Where the ring stands, and what would make it seem to stand there: a note, no fault."""
    for wired in found:
        if wired.changes:
            continue
        by = "the rotor flux" if zero_known else "the encoder's zero"
        other = [w.name for w in found if w.changes == 1 and w.off(0.0) < NAMED and w.inverted in (0, 7)]
        seems = f"; {other[0]} would look the same" if other else ""
        yield Finding("ring", f"the ring stands at {degrees(wired.ring)} by {by} (hall_offset){seems}")


def missing_codes(measured: Measured) -> Iterator[Finding]:
    """Of an inverted input 000 and 111 come in turn, and two codes never: no encoder is needed to see that."""
    number = measured.inputs.inverted.bit_length() - 1
    if number >= 0:
        yield Finding(
            "wiring",
            f"sensor {INPUTS[number]}{INVERTED}, or sensors 60 deg apart, {INPUTS[number]} in the middle",
            ("two codes are missing, and 000 and 111 come in turn",),
            f"correct the polarity of sensor {INPUTS[number]}, in the firmware if its sensors are 60 deg apart",
        )
