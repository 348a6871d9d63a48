"""What a person's instruments say of a drive's converters: a voltmeter at the DC link, an ammeter in a phase.

A reading tells a gain, the drive's volts or amperes over the true ones, as well as the instrument is made. It stands in
the place of what is assumed of every drive where it is the more accurate of the two, or where it contradicts that.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from bench.commission.quantity import Converters
from bench.commission.refusal import Refused

VOLTMETER, AMMETER = 0.005, 0.01
"""Accuracy of a handheld instrument, of its reading, where nobody tells it."""
IMPLAUSIBLE = 0.15
"""By which a drive's reading may differ from an instrument's: beyond it one of them measures something else."""
CONTRADICTS = 2.0
"""Times both standard deviations, from which a reading counts although it is the less accurate."""


@dataclass(frozen=True)
class Reading:
    """Of an instrument, in V or A, with its accuracy, relative: the most by which its maker lets it be wrong."""

    value: float
    accuracy: float

    @property
    def sd(self) -> float:
        """Standard deviation, relative, of an error that is anywhere within the accuracy."""
        return self.accuracy / math.sqrt(3.0)


@dataclass(frozen=True)
class Ammeter:
    """An instrument in a phase, a, b or c, with its accuracy; `read` asks a person what it has shown, in A."""

    phase: str
    accuracy: float
    read: Callable[[str], float]


def by_voltmeter(step: str, own: float, own_sd: float, read: Reading, of: Converters) -> tuple[Converters, list[str]]:
    """Converters, and what is to be known, of a drive that measures `own` V (sd in V) where a voltmeter reads that."""
    gain, sd = own / read.value, math.hypot(read.sd, own_sd / own)
    counts, remarks = _counts(step, f"voltmeter reads {read.value:g} V, the drive {own:.4g} V", gain, sd, of.volts)
    return replace(of, volts=sd, volts_gain=gain) if counts else of, remarks


def by_ammeter(step: str, own: float, own_sd: float, read: Reading, of: Converters) -> tuple[Converters, list[str]]:
    """The same of the currents; `own`: A of a phase, by the drive, less what its sensor differs by from the mean."""
    gain, sd, usual = own / read.value, math.hypot(read.sd, own_sd / own), of.common_amperes
    counts, remarks = _counts(step, f"ammeter reads {read.value:g} A, the drive {own:.4g} A", gain, sd, usual)
    return replace(of, measured_amperes=sd, amperes_gain=gain) if counts else of, remarks


def _counts(step: str, words: str, gain: float, sd: float, usual: float) -> tuple[bool, list[str]]:
    """Whether a reading counts, and what is to be known of it. Refused where it cannot be of the same thing."""
    if not abs(gain - 1.0) < IMPLAUSIBLE:
        raise Refused(
            step, f"the {words}: they do not measure the same thing, or one of them is wrong; check where it is "
            "connected, its range, and what was typed"
        )  # fmt: skip
    off = f"the {words}, {100.0 * (gain - 1.0):+.2g} %"
    if abs(gain - 1.0) > CONTRADICTS * math.hypot(sd, usual):
        return True, [f"{off}: more than is usual of a drive; absolute values go by the instrument"]
    if sd < usual:
        return True, []
    return False, [f"{off}: they agree, and the instrument is no more accurate than the drive is assumed to be"]
