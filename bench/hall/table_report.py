"""How a table of Hall sensors is shown, and the difference of two: rows, lines and plain data."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from bench.findings.finding import degrees
from bench.hall.table_reading import EDGE_SCATTER, ROUNDING, Comparison, Reading, inverted_input, rms
from bench.hall.tables import HallTable
from bench.signal.position import wrapped
from bench.signal.trace import INPUTS
from bench.signal.verdict import Verdict
from bench.signal.waveforms.sectors import NUMERALS


def headline(reading: Reading) -> list[list[str]]:
    """Names and values of what is told of all sensors together."""
    table, wired = reading.table, reading.wired
    middle = inverted_input(table.codes).bit_length() - 1
    order = " ".join(map(str, table.codes))
    apart = (
        f"60 deg apart, {INPUTS[middle]} in the middle, or {INPUTS[middle]} inverted"
        if middle >= 0
        else "120 deg apart: codes 0 and 7 are never seen"
    )
    rows = [["made by", table.tool], ["codes, forward", order], ["sensors", apart]]
    reverse = "; or two phases are, for the codes come in reverse order" * ("exchanged" in wired.name)
    rows.append(["wires", wired.name + reverse])
    if table.absolute:
        stands = math.degrees(wired.ring) % 60.0
        away = abs(wrapped(6.0 * (wired.ring - math.radians(30.0)))) / 6.0
        usual = ", where most rings have theirs" if math.degrees(away) < 5.0 else "; most rings have 30"
        rows.append(["ring", f"sector I opens at {degrees(wired.ring)}; edges at {stands:.1f} deg mod 60{usual}"])
    else:
        rows.append(["ring", "unknown: an ODrive keeps it elsewhere"])
    if math.isfinite(reading.missing):
        rows.append(["contradiction", f"{degrees(abs(reading.missing))}; rounding makes up to {degrees(ROUNDING)}"])
    return rows


SECTOR_HEADERS = ("sector", "code", "middle, deg", "opens, deg", "width, deg")
SENSOR_HEADERS = ("input", "displaced, deg", "duty, %")


def sector_rows(reading: Reading) -> list[list[str]]:
    """A row for each sector of the table."""
    columns = zip(
        reading.sector, reading.table.codes, reading.table.middles, reading.edges, reading.widths, strict=True
    )
    return [
        [NUMERALS[sector], f"{code} ({code:03b})", *(f"{math.degrees(angle) % 360.0:.1f}" for angle in angles)]
        for sector, code, *angles in columns
    ]


def sensor_rows(reading: Reading) -> list[list[str]]:
    """A row for each input."""
    return [
        [INPUTS[k], f"{math.degrees(reading.displaced[k]):+.1f}", f"{100.0 * reading.duty[k]:.1f}"] for k in range(3)
    ]


def verdict_lines(reading: Reading) -> Iterator[str]:
    """In words: what is wrong, what is not known, and what a table of this kind cannot tell."""
    for finding in reading.findings:
        yield f"FAULT: {finding.line}; {finding.advice}"
    for words in reading.unknown:
        yield f"inconclusive: {words}"
    if reading.verdict is Verdict.PASS:
        yield (
            f"no fault seen: the sensor farthest from its place is {degrees(float(np.abs(reading.displaced).max()))} "
            "off (of real motors 2.4 deg in the median, 8.4 at most); detections of one motor differ by 1.8 to 5.4 deg"
        )
    if reading.table.edges is None:
        yield (
            "not told: middles of sectors are the same whatever duty the three sensors share; widths and duty are "
            "those with 50 %"
        )


def as_json(reading: Reading) -> dict[str, Any]:
    """Plain data, angles in degrees."""
    table, wired = reading.table, reading.wired
    return {
        "source": table.source,
        "tool": table.tool,
        "codes": list(table.codes),
        "sectors": [sector + 1 for sector in reading.sector],
        "middles_deg": np.degrees(table.middles).tolist(),
        "edges_deg": np.degrees(reading.edges).tolist(),
        "widths_deg": np.degrees(reading.widths).tolist(),
        "edges_told": table.edges is not None,
        "wires": wired.name,
        "wired_sensors": [INPUTS[sensor] for sensor in wired.sensors],
        "wired_inverted": [INPUTS[number] for number in range(3) if wired.inverted >> number & 1],
        "ring_deg": math.degrees(wired.ring) if table.absolute else None,
        "sensors": {
            INPUTS[k]: {"displaced_deg": math.degrees(reading.displaced[k]), "duty": float(reading.duty[k])}
            for k in range(3)
        },
        "contradiction_deg": math.degrees(abs(reading.missing)),
        "verdict": reading.verdict,
        "findings": [{"code": f.code, "cause": f.cause, "evidence": list(f.evidence), "advice": f.advice}
                     for f in reading.findings],
        "unknown": list(reading.unknown),
    }  # fmt: skip


COMPARISON_HEADERS = ("code", "first, deg", "second, deg", "difference, deg")


def comparison_rows(first: HallTable, second: HallTable, told: Comparison) -> list[list[str]]:
    """A row for each code that both tables have."""
    ours, theirs = (dict(zip(t.codes, np.degrees(t.middles), strict=True)) for t in (first, second))
    return [
        [str(code), f"{ours[code] % 360.0:.1f}", f"{theirs[code] % 360.0:.1f}", f"{math.degrees(off):+.1f}"]
        for code, off in zip(told.codes, told.differences, strict=True)
    ]


def comparison_lines(told: Comparison) -> Iterator[str]:
    """In words: whether two detections of one motor differ like that, and what would make the one of the other."""
    within = f"what two detections of one motor differ by ({degrees(EDGE_SCATTER)} rms at most)"
    if told.same:
        yield f"same: {degrees(rms(told.differences))} rms apart, within {within}"
    elif told.explanations:
        yield f"different, by more than {within}, but the second is the first with: {', or '.join(told.explanations)}"
    else:
        yield f"different, by more than {within}: no exchange of wires or phases, inversion or rotation makes it so"


def comparison_json(second: HallTable, told: Comparison) -> dict[str, Any]:
    """Plain data, angles in degrees."""
    return {
        "source": second.source,
        "same": told.same,
        "codes": list(told.codes),
        "differences_deg": np.degrees(told.differences).tolist(),
        "explanations": list(told.explanations),
    }
