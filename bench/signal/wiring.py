"""Which wiring of the Hall sensors explains what was seen: exchanged, rotated, inverted, open or shorted wires.

One fault at a time is looked for. The encoder is the reference: its zero is taken to be right. One that reads 120 deg
too little looks like sensors rotated a on b, b on c, c on a, one that reads 120 deg too much like the other rotation;
off by any other multiple of 60 deg it looks like no known wiring. Nothing here measures where the edges lie
(`waveforms.edge_offsets` does) or talks to a drive.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bench.signal.position import wrap
from bench.signal.waveforms.samples import checked
from bench.signal.waveforms.sectors import SECTOR_WIDTH, SECTORS, sector_of_angle
from protocol.signals import SECTOR_OF_CODE

AS_SPECIFIED = "as specified"
NONE_KNOWN = "none of the known wirings"
LEAST_SHARE = 0.95
"""Share of samples that a wiring must explain to be named."""
MARGIN = math.radians(12.0)
"""From an ideal edge, rad: as far as Hall sensors may be misplaced, with what hysteresis and delay add."""


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
    for sensor, bit in (("a", a), ("b", b), ("c", c)):
        wirings[f"sensor {sensor} inverted"] = [code ^ bit for code in specified]
        wirings[f"sensor {sensor} open (always 1)"] = [code | bit for code in specified]
        wirings[f"sensor {sensor} shorted (always 0)"] = [code & ~bit for code in specified]
    return wirings


_WIRINGS = _wirings()
