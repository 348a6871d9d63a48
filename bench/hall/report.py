"""A check for people, as rows of tables and lines, and for programs, as plain data. Nothing here measures or prints."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from bench.findings.health import Health
from bench.findings.wiring import AS_SPECIFIED
from bench.hall.turning import Turned
from bench.report.words import number
from bench.signal.hall_edges import Edge, Passages, largest
from bench.signal.trace import INPUTS, Trace
from bench.signal.verdict import Verdict
from bench.signal.waveforms.sectors import NUMERALS, SECTORS

WIDTH = 79
OUTCOMES = {Verdict.PASS: "healthy", Verdict.FAIL: "fault", Verdict.INVALID: "cannot_tell"}
"""Words of JSON."""
EDGE_HEADERS = ("edge", "forward", "reverse", "+-95 %", "passed", "hyst.", "jitter", "width")
SENSOR_HEADERS = ("sensor", "duty, %", "false pulses", "1/s")
CURRENT_HEADERS = ("current, A", "false pulses", "1/s")
EDGE_TITLE = (
    "Edge angles in electrical degrees; ideal: 0, 60 … 300; passed: forward/reverse;",
    "width: of the sector that starts there",
)


def edge_rows(health: Health) -> list[list[str]]:
    """A row for each edge; none where none was passed. A width makes sense with the wiring as specified only."""
    measured = health.measured
    if not any(passages.n for edge in measured.edges for passages in (edge.up, edge.down)):
        return []
    return [
        [
            f"{NUMERALS[edge.sector]:<3} {edge.name}",
            number(_angle(edge.up), ".2f", "-"),
            number(_angle(edge.down), ".2f", "-"),
            number(math.degrees(largest(passages.half_width for passages in (edge.up, edge.down))), ".2f", "-"),
            f"{edge.up.n}/{edge.down.n}",
            number(math.degrees(edge.hysteresis), ".2f", "-"),
            number(math.degrees(largest(passages.jitter for passages in (edge.up, edge.down))), ".2f", "-"),
            number(math.degrees(width), ".1f", "-"),
        ]
        for edge, width in zip(measured.edges, _widths(health), strict=True)
    ]


def sensor_rows(health: Health, seconds: float) -> list[list[str]]:
    """A row for each sensor."""
    return [
        [name, number(100.0 * duty, ".1f", "-"), str(n), f"{n / seconds:.3g}"]
        for name, duty, n in zip(INPUTS, health.measured.duty, health.pulses.by_input, strict=True)
    ]


def current_rows(health: Health) -> list[list[str]]:
    """A row for each range of the current, each of the same time; none without false pulses or currents."""
    bins = health.pulses.bins if health.pulses.n else ()
    return [[f"{one.lo:.2f} to {one.hi:.2f}", str(one.n), f"{one.rate:.3g}"] for one in bins]


def fact_rows(health: Health, trace: Trace, turned: Turned) -> list[list[str]]:
    """Names and values of all that is no table of its own."""
    codes, turns, measured, emf = health.codes, health.turns, health.measured, health.emf
    rows = [
        ["turned", turned.how],
        ["el. revolutions", f"{turns.up:.1f} forward, {turns.down:.1f} reverse"],
        ["data", f"{trace.samples} samples in {trace.seconds:.1f} s, {codes.edges} edges"],
        ["illegal codes", f"{codes.illegal_samples} samples, {codes.illegal} edges; {codes.skipped} sectors skipped"],
    ]
    if turns.n_p is not None and trace.encoder and not math.isnan(turns.ratio):
        rows.append(["pole pairs", f"{turns.n_p} in the drive; {turns.n_p * turns.ratio:.2f} by the Hall edges"])
    if not math.isnan(measured.delay):
        within = measured.delay_half_width * 1e6
        seen = "early" if measured.delay < 0.0 else "late"
        rows.append([f"edges seen {seen}", f"by {abs(measured.delay) * 1e6:.1f} us +- {within:.1f} us (95 %)"])
    if not math.isnan(health.delays.back_emf):
        rows.append(["back-EMF", f"{health.delays.back_emf * 1e6:+.0f} us from the encoder"])
    if emf is not None and not emf.reversed:
        zero = round(math.degrees(emf.zero), 1) + 0.0  # no -0.0
        rows.append(["encoder's zero", f"{zero:.1f} deg ahead of the back-EMF, over {emf.n} samples"])
    left_out = [
        f"{n} {'edge' if n == 1 else 'edges'} {why}"
        for n, why in (
            (trace.unplaced, "next to a gap"),
            (trace.slow, "at nearly zero speed"),
            (measured.outliers, "as outliers"),
        )
        if n
    ]
    if left_out:
        rows.append(["left out", ", ".join(left_out)])
    dropped = trace.dropped
    if dropped:
        rows.append(["lost", f"{dropped[0][2]}" + (f", and {len(dropped) - 1} more" if len(dropped) > 1 else "")])
    return rows


def verdict_lines(health: Health, remarks: Sequence[str]) -> list[str]:
    """What was found, why, and what to do, within `WIDTH` columns."""
    lines = [line for remark in remarks for line in _wrapped("note: ", remark)]
    for finding in health.findings:
        lines += _wrapped("FAULT: ", finding.cause)
        for evidence in finding.evidence:
            lines += _wrapped("  because ", evidence)
        lines += _wrapped("  action: ", finding.advice)
    for note in health.notes:
        lines += _wrapped("note: ", note.cause)
    for missing in health.missing:
        lines += _wrapped("inconclusive: ", missing)
    if health.wiring is not None and not health.findings:
        lines += _wrapped(
            "HEALTHY: " if health.verdict is Verdict.PASS else "so far: ",
            f"wired as specified, which explains {100.0 * health.wiring.share:.1f} % of {health.wiring.n} samples; "
            f"next best: {health.wiring.runner_up}, {100.0 * health.wiring.runner_up_share:.1f} %",
        )
    return lines


def as_json(health: Health, trace: Trace, turned: Turned, source: str) -> dict[str, Any]:
    """All of it as plain data; unknown values are null."""
    measured, turns, emf, wiring, found = health.measured, health.turns, health.emf, health.wiring, health.pulses
    return {
        "source": source,
        "outcome": OUTCOMES[health.verdict],
        "exit_code": health.exit_code,
        "findings": [asdict(finding) for finding in health.findings],
        "missing": list(health.missing),
        "notes": [asdict(note) for note in health.notes],
        "turned": turned.how,
        "remarks": list(turned.remarks),
        "seconds": trace.seconds,
        "samples": trace.samples,
        "turns_up": turns.up,
        "turns_down": turns.down,
        "n_p": turns.n_p,
        "n_p_by_hall": None if turns.n_p is None else _plain(turns.n_p * turns.ratio),
        "edges": [_edge_json(edge, width) for edge, width in zip(measured.edges, _widths(health), strict=True)],
        "delay_s": _plain(measured.delay),
        "back_emf_delay_s": _plain(health.delays.back_emf),
        "duty": {name: _plain(duty) for name, duty in zip(INPUTS, measured.duty, strict=True)},
        "false_pulses": {
            "n": found.n,
            "per_second": found.rate,
            "by_input": dict(zip(INPUTS, found.by_input, strict=True)),
            "widest_s": _plain(found.widest),
            "by_current": [{"from_a": b.lo, "to_a": b.hi, "n": b.n, "per_second": b.rate} for b in found.bins],
            "excess_with_current_sigma": _plain(found.excess),
        },
        "codes": {
            "illegal_samples": health.codes.illegal_samples,
            "illegal_edges": health.codes.illegal,
            "skipped_sectors": health.codes.skipped,
            "edges": health.codes.edges,
        },
        "wiring": None if wiring is None else wiring._asdict(),
        "back_emf": None
        if emf is None
        else {
            "zero_deg": math.degrees(emf.zero),
            "reversed": emf.reversed,
            "clear": emf.clear,
            "spread_deg": _plain(math.degrees(emf.spread)),
            "n": emf.n,
        },
        "left_out": {"unplaced": trace.unplaced, "slow": trace.slow, "outliers": measured.outliers},
        "lost": [words for _, _, words in trace.dropped],
    }


def _edge_json(edge: Edge, width: float) -> dict[str, Any]:
    return {
        "sector": edge.sector + 1,
        "edge": edge.name,
        "ideal_deg": math.degrees(edge.ideal),
        **{
            way: {
                "angle_deg": _plain(_angle(passages)),
                "half_width_95_deg": _plain(math.degrees(passages.half_width)),
                "jitter_deg": _plain(math.degrees(passages.jitter)),
                "n": passages.n,
            }
            for way, passages in (("up", edge.up), ("down", edge.down))
        },
        "hysteresis_deg": _plain(math.degrees(edge.hysteresis)),
        "sector_width_deg": _plain(math.degrees(width)),
    }


def _widths(health: Health) -> tuple[float, ...]:
    specified = health.wiring is not None and health.wiring.best == AS_SPECIFIED
    return health.measured.widths if specified else (math.nan,) * SECTORS


def _angle(passages: Passages) -> float:
    """deg from -30 to 330, so that what belongs at 0 is not found near 360."""
    return (math.degrees(passages.angle) + 30.0) % 360.0 - 30.0


def _plain(value: float) -> float | None:
    return None if math.isnan(value) else float(value)


def _wrapped(head: str, text: str) -> list[str]:
    return textwrap.wrap(head + text, WIDTH, subsequent_indent=" " * len(head))
