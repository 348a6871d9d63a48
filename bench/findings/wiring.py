"""Which wiring of the Hall sensors explains what was seen: exchanged, rotated, inverted, open or shorted wires.

One fault at a time is looked for. The encoder is the reference: its zero is taken to be right. One that reads 120 deg
too little looks like sensors rotated a on b, b on c, c on a, one that reads 120 deg too much like the other rotation;
off by any other multiple of 60 deg it looks like no known wiring. Nothing here measures where the edges lie
(`waveforms.edge_offsets` does).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bench.findings.encoder import TELL
from bench.findings.finding import Finding, percent
from bench.findings.sensors import deltas, stuck, together
from bench.findings.thresholds import LEAST_SEEN, LEAST_SHARE, MARGIN
from bench.signal.hall_edges import Measured, mean_angle
from bench.signal.position import wrap
from bench.signal.reference import BackEmf
from bench.signal.trace import INPUTS, SLOW, Floats, Trace
from bench.signal.waveforms.samples import checked
from bench.signal.waveforms.sectors import SECTOR_WIDTH, SECTORS, sector_of_angle
from protocol.signals import SECTOR_OF_CODE

AS_SPECIFIED = "as specified"
NONE_KNOWN = "none of the known wirings"
INVERTED = " inverted"
STUCK = dict(stuck(name, level) for name in INPUTS for level in (0, 1))
"""What to do, by the cause."""
SHIFTS, FEW = 72, 20_000
"""Constants in a turn, and samples, with which an angle that is off by one is looked for."""


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


class Wires:
    """The Hall codes of a run over the encoder's angle, in pieces."""

    def __init__(self) -> None:
        self._counts = np.zeros((SECTORS, 8), np.int64)

    def add(self, theta: NDArray[np.float64], hall: NDArray[np.uint8]) -> None:
        """Samples: electrical angle, rad, and code. One that is not finite, or no code, tells nothing of the wires."""
        told = np.isfinite(theta) & (hall < 8)
        self._counts += tally(theta[told], hall[told])

    def findings(self) -> Iterator[Finding]:
        """The wiring, where it is a known fault."""
        if self._counts.sum(axis=1).min() >= LEAST_SEEN:
            found = Diagnosis(*explained(self._counts), int(self._counts.sum()), 0)
            yield from miswired(found, zero_known=False)


def miswired(found: Diagnosis, zero_known: bool) -> Iterator[Finding]:
    """A wiring that is a known fault. `zero_known`: whether the back-EMF tells the zero of the encoder."""
    if found.best in (AS_SPECIFIED, NONE_KNOWN):
        return
    evidence = [f"that explains {percent(found.share)} of {found.n} samples; next best: {next_best(found)}"]
    if not zero_known and "rotated" in found.best:
        evidence.append("an encoder zero that is 120 deg off looks the same; the back-EMF would tell")
    advice = STUCK.get(found.best, "connect each sensor to the input of its name")
    if found.best.endswith(INVERTED):
        advice = f"correct the polarity of {found.best.removesuffix(INVERTED)}"
    yield Finding("wiring", found.best, tuple(evidence), advice)


def next_best(found: Diagnosis) -> str:
    """The runner-up, in words."""
    return f"{found.runner_up}, explains {percent(found.runner_up_share)}"


def wires(trace: Trace, theta: Floats, wiring: Diagnosis, measured: Measured, emf: BackEmf | None) -> Iterator[Finding]:
    """A wiring that is not as specified; `theta`: of the rotor flux, as far as that is known."""
    zero_known = emf is not None
    if wiring.best != NONE_KNOWN:
        yield from miswired(wiring, zero_known)
        return
    nearest = f"the nearest of the known wirings, {next_best(wiring)} of {wiring.n} samples"
    moving = np.abs(trace.some.omega) >= SLOW
    for backwards in (False, True):
        fit = _shifted(-theta if backwards else theta, trace, moving)
        if fit is None:
            continue
        shift = -mean_angle(np.array(deltas(measured, emf)))
        share = percent(fit.share)
        explained = f"with a constant angle offset, the specified wiring explains {share} of {fit.n} samples"
        if backwards:
            yield Finding(
                "encoder_reversed",
                "the encoder counts in the wrong direction, or two Hall wires are exchanged and the ring rotated",
                (explained + " if the encoder counts in the wrong direction", nearest),
                f"correct the encoder's direction first; {TELL}",
            )
            return
        yield together(shift, (explained, nearest), zero_known)
        return
    yield Finding(
        "wiring",
        "no single wiring fault explains the Hall codes",
        (nearest,),
        "there may be two faults, or an intermittent contact: test wire by wire, then check again",
    )


def inverted_by_codes(changed: NDArray[np.int64]) -> Iterator[Finding]:
    """An inverted input makes 000 and 111 of two codes, which then never come.

    `changed` (8, 8): how many edges there are from each code to each. No encoder is needed.
    """
    counts = changed.sum(axis=0)
    n = int(counts.sum())
    if min(counts[0], counts[7]) < 0.1 * n:
        return
    for number, name in enumerate(INPUTS):
        alone = 1 << number
        if counts[alone] + counts[7 - alone] == 0:
            yield Finding(
                "wiring",
                f"sensor {name} inverted",
                (
                    f"{counts[0]} edges to 000 and {counts[7]} to 111 of {n}, "
                    f"none to {alone:03b} or {7 - alone:03b} (c b a)",
                ),
                f"correct the polarity of sensor {name}",
            )
            return


def _shifted(theta: Floats, trace: Trace, moving: NDArray[np.bool_]) -> Diagnosis | None:
    """How well the specified wiring explains the codes to an angle that is off by the constant for which it does best.

    None where that is not well enough.
    """
    few = np.flatnonzero(moving)[:: max(1, np.count_nonzero(moving) // FEW)]
    fits = [diagnose(theta[few] - math.tau * k / SHIFTS, trace.some.hall[few]) for k in range(SHIFTS)]
    return max((fit for fit in fits if fit.best == AS_SPECIFIED), key=lambda fit: fit.share, default=None)
