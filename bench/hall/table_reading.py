"""What a table of Hall sensors tells, and what not.

`examined` judges one, `compared` compares two, `configuration` makes one of the simulated drive.

The middle k of a sector is half the sum of edges k and k + 1, so six middles do not tell six edges:

- Edges that lie by turns ahead and behind leave all middles in place. That is a duty that all three sensors share;
  widths are known as far as it is 50 %. Places of sensors, (e_k + e_k+3) / 2 = m_k - m_k+1 + m_k+2, are known.
- The middles with signs by turns sum to -180 deg, wherever the edges lie. Rounding leaves up to three counts of that. A
  rotor that turns unevenly moves edges, and does not show; one that jumps over parts of sectors does.
- Edges that scatter by s each make a middle scatter by s / sqrt(2), a sensor's place against the mean of three by
  s / sqrt(3), and its duty against theirs by as much. How large s is the table does not tell: `TABLE_SCATTER`.

Where edges are stored, a duty by itself scatters by s / sqrt(2).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import NamedTuple

import numpy as np

from bench.errors import BenchError
from bench.findings.finding import Finding, degrees
from bench.findings.thresholds import DISPLACED, SURE, TABLE_SCATTER
from bench.findings.wiring import CENTRES, Wired, hats, ways
from bench.hall.learn import HATS, OFFSET, Learnt, within
from bench.hall.tables import COUNT, DETECT, Floats, HallTable
from bench.signal.hall_edges import mean_angle
from bench.signal.position import wrap, wrapped
from bench.signal.trace import INPUTS
from bench.signal.verdict import Verdict
from bench.signal.waveforms.sectors import SECTOR_WIDTH, SECTORS
from protocol.signals import SECTOR_OF_CODE
from protocol.text import printable

MIDDLE_OF = 0.5 * (np.eye(SECTORS) + np.roll(np.eye(SECTORS), 1, axis=1))
"""Middles by edges."""
BY_TURNS = np.resize([1.0, -1.0], SECTORS)
ROUNDING = 3.0 * COUNT
"""rad, that rounding leaves at most of the sum with signs by turns."""
MOST_MISSING = 2.0 * ROUNDING
"""rad, that may be left of it. Of a dozen public tables one has more, 28 counts."""
EDGE_SCATTER = math.sqrt(2.0) * TABLE_SCATTER[1]
"""rad, standard deviation of an edge in a bad detection, and of the difference between entries of two."""
FITS = math.sqrt(2.0) * sum(TABLE_SCATTER) / 2.0
"""rad rms, that may be left where an exchange explains the difference of two tables."""
MEASURE = "`bench hall check` measures it"


@dataclass(frozen=True)
class Reading:
    """What a table tells."""

    table: HallTable
    wired: Wired
    """How the inputs would be wired with the least changes, and where the ring then stands."""
    edges: Floats
    """(6,) rad of the edge that opens each sector of the table; of middles, with a shared duty of 50 %."""
    displaced: Floats
    """(3,) rad by which sensors a, b, c stand ahead of their places, against the mean of the three."""
    duty: Floats
    """(3,) share of 1; of middles, with 50 % in the mean."""
    missing: float
    """rad, sum of the middles with signs by turns, plus half a turn; NaN of edges."""
    verdict: Verdict
    findings: tuple[Finding, ...]
    unknown: tuple[str, ...]

    @property
    def widths(self) -> Floats:
        """(6,) rad of the sectors."""
        widths: Floats = np.diff(self.edges, append=self.edges[0] + math.tau)
        return widths

    @property
    def sector(self) -> tuple[int, ...]:
        """Sector 0..5 of each of the table's codes, by the wiring."""
        return tuple(SECTOR_OF_CODE[_sensed(code, self.wired)] for code in self.table.codes)


def examined(table: HallTable) -> Reading:
    """What the table tells of the sensors, and whether something is wrong with them."""
    regular = SECTOR_WIDTH * np.arange(SECTORS)
    off = table.middles - regular
    mean = float(off.mean())
    missing = math.nan
    edges = table.edges
    if edges is None:
        missing = float(BY_TURNS @ (off - mean))
        edges = mean + regular - SECTOR_WIDTH / 2.0 + np.linalg.pinv(MIDDLE_OF) @ (off - mean)
    mask = inverted_input(table.codes)
    codes = [code ^ mask for code in table.codes]
    rises, falls = np.zeros(3), np.zeros(3)
    for k, code in enumerate(codes):
        number = (code ^ codes[k - 1]).bit_length() - 1
        (rises if code >> number & 1 else falls)[number] = edges[k]
    on = (falls - rises) % math.tau
    found = ways(rises + on / 2.0, mask)
    if not found or np.diff(edges, append=edges[0] + math.tau).min() <= 0.0:
        raise BenchError(f"{table.source}: no three sensors that change twice in a turn have this table: {DETECT}")
    wired = min(found, key=lambda w: (w.changes, w.inverted.bit_count(), abs(w.ring)))
    centres = rises + on / 2.0 + math.pi * (wired.inverted != mask)
    displaced = wrap(centres - CENTRES[list(wired.sensors)] - wired.ring)
    verdict, findings, unknown = _judged(table, displaced, on / 2.0 - math.pi / 2.0, missing)
    return Reading(table, wired, edges, displaced, on / math.tau, missing, verdict, findings, unknown)


def inverted_input(codes: Sequence[int]) -> int:
    """The bit of the input that is inverted where 000 and 111 are among the codes; else 0."""
    unseen = min(code for code in range(8) if code not in codes)
    return unseen if unseen.bit_count() < 2 else unseen ^ 7


def _sensed(code: int, wired: Wired) -> int:
    """What sensors a, b, c are, by what the inputs read."""
    code ^= wired.inverted
    return sum((code >> at & 1) << sensor for at, sensor in enumerate(wired.sensors))


def _judged(
    table: HallTable, displaced: Floats, duty: Floats, missing: float
) -> tuple[Verdict, tuple[Finding, ...], tuple[str, ...]]:
    """`duty` (3,): rad by which each edge of a sensor lies too far out."""
    place_sd = EDGE_SCATTER / math.sqrt(3.0)
    duty_sd = place_sd if table.edges is None else EDGE_SCATTER / math.sqrt(2.0)
    if abs(missing) > MOST_MISSING:
        words = f"the table contradicts itself: no edges have these middles, by {degrees(abs(missing))}"
        return Verdict.INVALID, (), (f"{words}; rounding makes {degrees(ROUNDING)} at most: {DETECT}",)
    findings, unknown = [], []
    for number, name in enumerate(INPUTS):
        for code, off, sd, words, advice in (
            ("displaced", displaced[number], place_sd, f"sensor {name} is displaced by", f"move sensor {name}"),
            ("duty", duty[number], duty_sd, f"sensor {name}'s edges lie apart from where they belong, each by",
             f"look at the magnet in front of sensor {name}, and at its pull-up"),
        ):  # fmt: skip
            sure = SURE * sd
            told, known = f"{words} {degrees(off)}", f"a table tells that to +-{degrees(sure)} at worst"
            if abs(off) > DISPLACED + sure:
                findings.append(Finding(code, told, (known,), advice))
            elif abs(off) > DISPLACED:
                unknown.append(f"{told}; from {degrees(DISPLACED, 0)} on it is a fault, but {known}: {MEASURE}")
    verdict = Verdict.FAIL if findings else Verdict.INVALID if unknown else Verdict.PASS
    return verdict, tuple(findings), tuple(unknown)


def configuration(reading: Reading) -> tuple[Learnt, str]:
    """What a drive has to know of these sensors, and the sections that give the simulated motor the same ones.

    BenchError for a table that contradicts itself. Where the ring is unknown it stands at 0.
    """
    if abs(reading.missing) > MOST_MISSING:
        raise BenchError(f"{reading.table.source}: {reading.unknown[0]}")
    wired, ring = reading.wired, reading.wired.ring if reading.table.absolute else 0.0
    opened = dict(zip(reading.sector, reading.edges, strict=True))
    delta = tuple(wrapped(wired.ring + k * SECTOR_WIDTH - opened[k]) for k in range(SECTORS))
    swap, inverted = hats(wired)
    settings = {OFFSET: ring, HATS[0]: swap, HATS[1]: inverted}
    motor = [
        f"# Hall sensors: {reading.table.tool}'s table {printable(reading.table.source)}",
        "[hall]",
        f"offset_deg = {math.degrees(ring):.3f}",
        f"delta_deg = [{', '.join(f'{math.degrees(value):.3f}' for value in delta)}]",
        "",
    ]
    if wired.changes:
        motor += ["[wiring]", f"hall_swap = {int(swap)}", f"hall_invert = {int(inverted)}", ""]
    return within(Learnt(delta, delta, TABLE_SCATTER[1], {}, settings)), "\n".join(motor) + "\n"


class Comparison(NamedTuple):
    """How the second of two tables differs from the first."""

    same: bool
    """Whether all that differs is within what two detections of one motor differ by."""
    codes: tuple[int, ...]
    """That both have, in the order of the first table; empty where the codes that were not seen are not the same."""
    differences: Floats
    """(n,) rad by code, the second less the first; less their mean where a ring is unknown."""
    explanations: tuple[str, ...]
    """The simplest changes that make the second of the first, as likely each; empty for none."""


def compared(first: HallTable, second: HallTable) -> Comparison:
    """Compare two tables, entry by entry; what they share needs no sensor to have moved."""
    ours, theirs = (dict(zip(t.codes, t.middles, strict=True)) for t in (first, second))
    known = first.absolute and second.absolute
    common = tuple(code for code in first.codes if code in theirs)
    differences = wrap(np.array([theirs[code] - ours[code] for code in common]))
    if not known:
        differences = wrap(differences - mean_angle(differences))
    alike = len(common) == SECTORS
    if alike and rms(differences) <= EDGE_SCATTER:
        return Comparison(True, common, differences, ())
    found: list[list[str]] = []
    for sensors in permutations(range(3)):
        for inverted in range(8):
            for way in (1, -1):
                made = {_sensed(code, Wired(sensors, 0, 0.0)) ^ inverted: way * angle for code, angle in ours.items()}
                if made.keys() != theirs.keys():
                    continue
                off = np.array([theirs[code] - angle for code, angle in made.items()])
                turned = mean_angle(off)
                if rms(wrap(off - turned)) <= FITS:
                    found.append(_changes(sensors, inverted, way, turned if known else 0.0))
    least = min(map(len, found), default=0)
    names = tuple(dict.fromkeys("; ".join(words) for words in found if len(words) == least))
    return Comparison(False, common if alike else (), differences if alike else np.array([]), names)


def rms(values: Floats) -> float:
    """Root of the mean square of (n,) values."""
    return float(np.sqrt(np.mean(values**2)))


def _changes(sensors: tuple[int, ...], inverted: int, way: int, turned: float) -> list[str]:
    """In words, one each; two phases that are exchanged turn the angle round, about 0, 120 or -120 deg."""
    words = []
    off = [INPUTS[k] for k in range(3) if sensors[k] != k]
    if off:
        words.append(f"sensors {' and '.join(off)} exchanged" if len(off) == 2 else "all three sensors rotated")
    if inverted:
        which = ", ".join(INPUTS[k] for k in range(3) if inverted >> k & 1)
        words.append(f"input{'s' * (len(which) > 1)} {which} inverted")
    third = abs(wrapped(3.0 * turned)) / 3.0 <= EDGE_SCATTER
    if way < 0:
        words.append("two phases of the motor exchanged")
    if not words or (abs(turned) > EDGE_SCATTER and not (way < 0 and third)):
        words.append(
            f"rotated by {degrees(turned)}{', as by phases that are rotated' * (third and abs(turned) > SECTOR_WIDTH)}"
        )
    return words
