"""Tables of Hall sensors that other tools made: `parsed` reads one, `table_reading` says what it tells.

VESC stores the middle of each code's sector: a current in the d axis drags the rotor round and back, so its flux lies
where that is (mcpwm_foc_hall_detect in vedderb/bldc), 0 on phase a. Of an angle it keeps whole counts of 1.8 deg,
rounded down. ODrive and moteus store edges. ODrive counts codes 1 3 2 6 4 5 as 0 to 5 and keeps the angle at which
count k begins: from that of count 0 on, in sixths (hall_edge_phcnt, 0.5), or in turns (edge0 … edge5, 0.6). Where the
rotor is then it has elsewhere, so the ring is unknown. moteus puts the differences of the six edges to their ideal
places, and lines between, into motor.offset.0 … 63 (its compute_hall_offset_table).
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.dumps.read import MOTEUS, ODRIVE, VESC, Dump, read
from bench.errors import BenchError
from bench.findings.sensors import stuck
from bench.signal.position import wrap
from bench.signal.trace import INPUTS
from bench.signal.waveforms.sectors import SECTOR_WIDTH, SECTORS
from protocol.signals import SECTOR_OF_CODE

Floats = NDArray[np.float64]
CODES = tuple(SECTOR_OF_CODE.index(sector) for sector in range(SECTORS))
"""In the order of a shaft that turns forward, sensors as specified."""
COUNT = math.tau / 200.0
"""rad, of an entry of a VESC."""
UNSEEN = 255
OFFSETS = 64
"""Entries of moteus' motor.offset."""
DETECT = "detect again: no load on the shaft, a current that turns it evenly, and slowly"


@dataclass(frozen=True)
class HallTable:
    """Where the sectors of six codes lie, in the order in which the electrical angle rises."""

    source: str
    tool: str
    codes: tuple[int, ...]
    """0..7, bit 0 = sensor a; the first is the one with the smallest angle."""
    middles: Floats
    """(6,) rad, rising, less than a turn."""
    edges: Floats | None = None
    """(6,) rad of the edge that opens each sector; None where only middles are stored."""
    absolute: bool = True
    """Whether 0 is the rotor flux on phase a."""


def parsed(text: str, axis: int | None = None) -> HallTable:
    """The table that somebody typed, eight entries of a VESC or six edges of an ODrive, or that a file holds.

    BenchError for what is no table, and for one that no three sensors have.
    """
    name = text if len(text) <= 80 else f"{text[:77]}..."
    words = [word for word in re.split(r"[\s,;]+", text.strip(" \t[](){}")) if word]
    if len(words) > 1 and all(re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", word) for word in words):
        if axis is not None:
            raise BenchError(f"--axis {axis}: a table that is typed has none")
        numbers = [float(word) for word in words]
        if len(numbers) == 8:
            return _vesc(name, numbers)
        if len(numbers) == SECTORS:
            return _odrive(name, numbers, CODES)
        raise BenchError(f"{name}: {len(numbers)} numbers; a VESC's table has 8 entries, an ODrive's 6 edges")
    if len(words) > 4 and "," in text and not os.path.lexists(text):
        raise BenchError(f"{name} is neither a file nor numbers: a VESC's table has 8 entries, an ODrive's 6 edges")
    return of_dump(read(Path(text), axis))


def of_dump(dump: Dump) -> HallTable:
    """The table that a file holds. BenchError for none."""
    return {VESC: _of_vesc, ODRIVE: _of_odrive, MOTEUS: _of_moteus}[dump.tool](dump)


def _of_vesc(dump: Dump) -> HallTable:
    entries = [dump.number(f"foc_hall_table_{code}") for code in range(8)]
    numbers = [entry for entry in entries if entry is not None]
    if len(numbers) < 8:
        raise BenchError(f"{dump.path} has no table of Hall sensors: foc_hall_table_0 to 7 are not all there")
    return _vesc(str(dump.path), numbers)


def _vesc(source: str, entries: Sequence[float]) -> HallTable:
    """Of eight entries, by code."""
    for code, entry in enumerate(entries):
        if entry != UNSEEN and not (entry.is_integer() and 0 <= entry <= 200):
            raise BenchError(f"{source}: entry {code} is {entry:g}; a VESC has 0 to 200, and 255 for a code not seen")
    seen = [code for code in range(8) if entries[code] != UNSEEN]
    _require_six(source, seen)
    if sorted(entries[code] for code in seen) == [1, 2, 3, 4, 5, 6]:
        raise BenchError(f"{source} is the table of BLDC mode, steps without angles: foc_hall_table is needed")
    middles = {code: COUNT * ((entries[code] % 200) + 0.5) for code in seen}
    codes = sorted(seen, key=lambda code: middles[code])
    for before, code in pairwise(codes):
        if middles[before] == middles[code]:
            raise BenchError(f"{source}: codes {before} and {code} are at one angle: {DETECT}")
    return _in_order(HallTable(source, VESC, tuple(codes), np.array([middles[code] for code in codes])))


def _require_six(source: str, seen: Sequence[int]) -> None:
    """BenchError, with what that means, unless six codes were seen and the missing two are opposite."""
    unseen = [code for code in range(8) if code not in seen]
    if len(unseen) == 2 and sum(unseen) == 7:
        return
    if not seen:
        raise BenchError(f"{source}: no code was seen: Hall sensors were not detected yet, or have no supply")
    stuck_at = [
        (INPUTS[number], level) for number in range(3) for level in (0, 1)
        if len(seen) in (3, 4) and all(code >> number & 1 == level for code in seen)
    ]  # fmt: skip
    words = f"codes {', '.join(map(str, seen))} were seen" if len(seen) < 8 else "all eight codes were seen"
    if len(stuck_at) == 1:
        cause, advice = stuck(*stuck_at[0])
        raise BenchError(f"{source}: {words}: {cause}; {advice}, then detect again")
    raise BenchError(f"{source}: {words}, three sensors give six, all but two opposite ones: {DETECT}")


def _in_order(table: HallTable) -> HallTable:
    """BenchError unless one sensor changes from each code to the next."""
    for before, code in zip(table.codes, (*table.codes[1:], table.codes[0]), strict=True):
        if (before ^ code).bit_count() != 1:
            raise BenchError(f"{table.source}: code {code} comes after {before}, two sensors at once: {DETECT}")
    return table


def _of_odrive(dump: Dump) -> HallTable:
    edges = [dump.number(f"hall_encoder.config.edge{k}") for k in range(SECTORS)]
    calibrated, polarity = "hall_encoder.config.edges_calibrated", dump.whole("hall_encoder.config.hall_polarity")
    direction = 1
    if None in edges:
        listed = dump.values.get("encoder.config.hall_edge_phcnt")
        edges = [None] * SECTORS
        if isinstance(listed, list) and len(listed) == SECTORS:
            edges = [Dump(dump.path, ODRIVE, {"hall_edge_phcnt": one}).number("hall_edge_phcnt") for one in listed]
        calibrated, polarity = "", dump.whole("encoder.config.hall_polarity")
        direction = dump.whole("encoder.config.direction") or 1
    numbers = [direction * edge for edge in edges if edge is not None]
    if len(numbers) < SECTORS:
        raise BenchError(f"{dump.path} has no table of Hall edges: neither edge0 to edge5 nor hall_edge_phcnt")
    if dump.values.get(calibrated) is False or [abs(n) for n in numbers] in ([0, 1, 2, 3, 4, 5], [0] * SECTORS):
        raise BenchError(f"{dump.path}: this ODrive's Hall edges were never calibrated")
    polarity = polarity or 0
    if not 0 <= polarity <= 7:
        raise BenchError(f"{dump.path}: hall_polarity = {polarity}, three sensors have 0 to 7")
    return _odrive(str(dump.path), numbers, tuple(code ^ polarity for code in CODES))


def _odrive(source: str, edges: Sequence[float], codes: Sequence[int]) -> HallTable:
    """Edge k is where code k begins as codes go up: in turns, or in sixths of one where any is above 1."""
    whole = 1.0 if max(map(abs, edges)) <= 1.0 else float(SECTORS)
    if max(map(abs, edges)) > whole:
        raise BenchError(
            f"{source}: an edge of an ODrive is in turns, 0 to 1, or in sixths, 0 to 6; got {max(edges):g}"
        )
    begins = np.array(edges) * (math.tau / whole)
    steps = wrap(np.diff(begins, append=begins[0]))
    if abs(round(float(steps.sum()) / math.tau)) != 1 or not (np.sign(steps) == np.sign(steps[0])).all():
        raise BenchError(f"{source}: the six edges of an ODrive do not follow each other round: calibrate them again")
    return _of_edges(source, ODRIVE, begins, codes, absolute=False)


def _of_edges(source: str, tool: str, begins: Floats, codes: Sequence[int], absolute: bool) -> HallTable:
    """`begins` (6,) rad: where each code begins as codes go up, whichever way the angle goes then."""
    if wrap(np.diff(begins, append=begins[0]))[0] < 0.0:  # code k lies between the edges k + 1 and k
        begins, codes = np.roll(begins, -1)[::-1], codes[::-1]
    first = int(np.argmin(begins % math.tau))
    begins, codes = np.roll(begins, -first), (*codes[first:], *codes[:first])
    edges = begins[0] % math.tau + np.concatenate([[0.0], np.cumsum(np.diff(begins) % math.tau)])
    middles = 0.5 * (edges + np.append(edges[1:], edges[0] + math.tau))
    return _in_order(HallTable(source, tool, tuple(codes), middles, edges, absolute))


def _of_moteus(dump: Dump) -> HallTable:
    path, poles = dump.path, dump.whole("motor.poles") or 0
    if dump.whole("motor_position.sources.0.type") != 4:
        raise BenchError(
            f"{path}: motor_position.sources.0.type is not 4: this moteus does not commutate by Hall sensors"
        )
    table = [dump.number(f"motor.offset.{k}") for k in range(OFFSETS)]
    offsets = np.array([entry for entry in table if entry is not None])
    if len(offsets) < OFFSETS or not offsets.any():
        raise BenchError(f"{path}: this moteus takes its Hall edges to be ideal (motor.offset has no table of them)")
    # compute_hall_offset_table: entry k is for a place between two edges, and lies on the line between theirs
    place = (np.arange(OFFSETS) + 0.5) / OFFSETS * (3.0 * poles) % SECTORS
    sector = place.astype(int)
    weights = np.zeros((OFFSETS, SECTORS))
    weights[np.arange(OFFSETS), sector] = 1.0 - (place - sector)
    weights[np.arange(OFFSETS), (sector + 1) % SECTORS] += place - sector
    deltas, _, rank, _ = np.linalg.lstsq(weights, offsets, rcond=1e-6)
    if rank < SECTORS or np.abs(weights @ deltas - offsets).max() > 0.25 * COUNT:
        raise BenchError(f"{path}: motor.offset is no table of Hall edges for {poles} poles")
    sign = -1 if (dump.number("motor_position.sources.0.sign") or 1) < 0 else 1
    sign *= -1 if dump.whole("motor.phase_invert") else 1
    zero = dump.whole("motor_position.sources.0.offset") or 0
    polarity = dump.whole(f"aux{dump.whole('motor_position.sources.0.aux_number') or 1}.hall.polarity") or 0
    codes = [CODES[(k * sign - zero) % SECTORS] ^ (polarity & 7) for k in range(SECTORS)]
    return _of_edges(str(path), MOTEUS, np.arange(SECTORS) * SECTOR_WIDTH + deltas, codes, absolute=True)
