"""A check for people, as rows of tables and lines, and for programs, as plain data. Nothing here measures or prints."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np

from bench.findings.health import Health
from bench.findings.wiring import AS_SPECIFIED
from bench.hall.turning import Turned
from bench.report.words import number
from bench.signal.hall_edges import Edge, Passages, largest
from bench.signal.trace import INPUTS, Floats, Ints, Trace
from bench.signal.verdict import Verdict
from bench.signal.waveforms.sectors import NUMERALS, SECTORS
from protocol.text import counted

WIDTH = 79
MATTERS = 0.5
"""Of the jitter, from which on the resolution of edge times is told."""
SIGMA_95 = 1.96
OUTCOMES = {Verdict.PASS: "healthy", Verdict.FAIL: "fault", Verdict.INVALID: "cannot_tell"}
"""Words of JSON."""
EDGE_HEADERS = ("edge", "forward", "reverse", "+-95 %", "passed", "hyst.", "jitter")
WIDTH_HEADERS = ("sector", *NUMERALS)
SENSOR_HEADERS = ("sensor", "displaced", "forward", "reverse", "+-95 %", "duty, %", "+-95 %")
INPUT_HEADERS = ("input", "rise, us", "fall, us", "+-95 %", "bounces", "1/s", "pulses", "1/s")
CURRENT_HEADERS = ("current, A", "false pulses", "1/s")


class Shown(NamedTuple):
    """A table, with the lines above it."""

    title: tuple[str, ...]
    headers: tuple[str, ...]
    rows: list[list[str]]


def tables(health: Health, seconds: float) -> list[Shown]:
    """Those that have something to tell; `seconds`: how long the inputs were watched."""
    measured = health.measured
    first, second, *_, last = (f"{math.degrees(edge.ideal):.1f}".removesuffix(".0") for edge in measured.edges)
    ideal = "their mean is set to" if measured.blind else "ideal:"
    speed = "at standstill" if _delays_known(health) else "at the speed that the shaft had"
    late = (
        "rise: how much later rising edges come than falling ones"
        if measured.blind
        else "rise, fall: how late these edges come, against the encoder"
    )
    found = (
        Shown(
            (
                f"Edge angles in electrical degrees; {ideal} {first}, {second} … {last};",
                f"{speed}; passed: forward/reverse",
            ),
            EDGE_HEADERS,
            edge_rows(health),
        ),
        Shown(("Sectors' widths in electrical degrees",), WIDTH_HEADERS, width_rows(health)),
        Shown(("Sensors against the mean of the three, in electrical degrees",), SENSOR_HEADERS, sensor_rows(health)),
        Shown((f"Inputs; {late}",), INPUT_HEADERS, input_rows(health, seconds)),
        Shown((), CURRENT_HEADERS, current_rows(health)),
    )  # fmt: skip
    return [shown for shown in found if shown.rows]


def edge_rows(health: Health) -> list[list[str]]:
    """A row for each edge; none where none was passed."""
    measured = health.measured
    if not any(passages.n for edge in measured.edges for passages in (edge.up, edge.down)):
        return []
    return [
        [
            f"{NUMERALS[edge.sector]:<3} {edge.name}",
            number(_angle(edge, edge.up), "z.2f", "-"),
            number(_angle(edge, edge.down), "z.2f", "-"),
            number(math.degrees(largest(passages.half_width for passages in (edge.up, edge.down))), "z.2f", "-"),
            f"{edge.up.n}/{edge.down.n}",
            number(math.degrees(edge.hysteresis), "z.2f", "-"),
            number(math.degrees(largest(passages.jitter for passages in (edge.up, edge.down))), "z.2f", "-"),
        ]
        for edge in measured.edges
    ]


def width_rows(health: Health) -> list[list[str]]:
    """The widths and their confidence; none where the wiring is not as specified: they make no sense then."""
    widths = np.degrees(_widths(health))
    if np.isnan(widths).any():
        return []
    within = np.degrees(health.measured.widths_half_width)
    return [["width", *(f"{one:.2f}" for one in widths)], ["+-95 %", *(f"{one:.2f}" for one in within)]]


def sensor_rows(health: Health) -> list[list[str]]:
    """A row for each sensor; none where no edges were passed."""
    measured = health.measured
    if measured.fit is None:
        return []
    angles = np.degrees([measured.placement, *measured.placement_each_way, measured.placement_half_width[0]])
    duties = 100.0 * np.array([measured.duty, measured.duty_half_width])
    return [
        [name, *(number(value, "z.2f", "-") for value in column), *(number(value, "z.2f", "-") for value in duty)]
        for name, column, duty in zip(INPUTS, angles.T, duties.T, strict=True)
    ]


def input_rows(health: Health, seconds: float) -> list[list[str]]:
    """A row for each input."""
    late, within = _late(health)
    late[:, 0] -= late[:, 1] if health.measured.blind else 0.0
    late[:, 1] = math.nan if health.measured.blind else late[:, 1]
    counts = zip(health.pulses.bounces, health.pulses.by_input, strict=True)
    return [
        [
            name,
            *(number(1e6 * value, ".1f", "-") for value in (*late[k], within[k])),
            *(text for n in both for text in (str(n), f"{n / seconds:.3g}")),
        ]
        for k, (name, both) in enumerate(zip(INPUTS, counts, strict=True))
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
        *_motion_rows(health, trace.lost_edges),
        ["data", f"{trace.samples} samples in {trace.seconds:.1f} s, {codes.edges} edges"],
        ["illegal codes", f"{codes.illegal_samples} samples, {codes.illegal} edges; {codes.skipped} sectors skipped"],
    ]
    if turns.n_p is not None and trace.encoder and not math.isnan(turns.ratio):
        rows.append(["pole pairs", f"{turns.n_p} in the drive; {turns.n_p * turns.ratio:.2f} by the Hall edges"])
    elif measured.blind and measured.fit is not None:
        n_p = measured.fit.n_p
        known = "" if turns.n_p is None else f"{turns.n_p} in the drive"
        rows.append(
            ["pole pairs", f"{n_p}, by edges that repeat with the shaft" if n_p else known or "not seen by the edges"]
        )
    rows += _precision_rows(health, trace)
    if not math.isnan(measured.delay):
        within = (measured.delay_half_width + measured.delay_by_count) * 1e6
        seen = "early" if measured.delay < 0.0 else "late"
        rows.append([f"edges seen {seen}", f"by {abs(measured.delay) * 1e6:.1f} us +- {within:.1f} us (95 %)"])
    if measured.blind and measured.fit is not None and not _delays_known(health):
        rows.append(["edges seen late", "not known: the speed did not change enough to tell"])
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


def _motion_rows(health: Health, lost: int) -> list[list[str]]:
    """How the shaft went by the sectors, and how fast where edges were measured; `lost`: edges that did not come."""
    steps, fit = health.measured.inputs.steps, health.measured.fit
    up, down, turned_round = _steps(steps)
    net = f"net unknown: {counted(lost, 'edge')} lost" if lost else f"{up - down:+d} net"
    rows = [["sectors", f"{up} forward, {down} reverse, {net}"]]
    if turned_round and not lost:
        rows.append(["turned round", "once" if turned_round == 1 else f"{turned_round} times"])
    if fit is not None:
        slow, fast = fit.slowest / math.tau, fit.fastest / math.tau
        n_p = health.turns.n_p or fit.n_p
        rpm = f" ({60 * slow / n_p:.0f} to {60 * fast / n_p:.0f} r/min)" if n_p else ""
        rows.append(["speeds", f"{slow:.3g} to {fast:.3g} el. revolutions/s{rpm}"])
    return rows


def _precision_rows(health: Health, trace: Trace) -> list[list[str]]:
    """Where the ring stands, how far pole pairs differ, and how well times are known where that matters."""
    measured, fit, rows = health.measured, health.measured.fit, []
    if fit is None:
        return []
    if not math.isnan(measured.ring) and measured.inputs.ratio > 0.0:
        within = math.degrees(measured.ring_half_width)
        rows.append(["ring", f"at {math.degrees(measured.ring):.2f} +- {within:.2f} deg (95 %) by theta_enc"])
    if fit.apart and fit.pairs.shape[1] > 1:
        uneven = math.degrees(float(np.sqrt(np.mean(fit.pairs**2))))
        rows.append(["unevenness", f"edges of {fit.pairs.shape[1]} pole pairs differ by {uneven:.2f} deg rms"])
    step, known = trace.time_step, health.resolution
    if known > MATTERS * float(np.nanmedian(fit.jitter)):
        counts = f", {math.degrees(trace.count):.2g} deg" if trace.count else ""
        told = f"to {math.degrees(known):.2f} deg rms at mean speed (steps of {1e6 * step:.3g} us{counts})"
        rows.append(["edges known", told])
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
    up, down, turned_round = _steps(measured.inputs.steps)
    slowest, fastest = (math.nan,) * 2 if measured.fit is None else (measured.fit.slowest, measured.fit.fastest)
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
        "turns_net": None if trace.lost_edges else (up - down) / SECTORS,
        "steps": {"up": up, "down": down, "reversals": None if trace.lost_edges else turned_round},
        "omega_rad_s": {"slowest": _plain(slowest), "fastest": _plain(fastest)},
        "n_p": turns.n_p,
        "n_p_by_hall": None if turns.n_p is None else _plain(turns.n_p * turns.ratio),
        "n_p_by_edges": (measured.fit.n_p if measured.fit is not None else 0) or None,
        "ring_deg": _plain(math.degrees(measured.ring)),
        "ring_half_width_95_deg": _plain(math.degrees(measured.ring_half_width)),
        "edges": [_edge_json(edge, width) for edge, width in zip(measured.edges, _widths(health), strict=True)],
        "sector_widths_deg": _list(np.degrees(_widths(health))),
        "sector_widths_half_width_95_deg": _list(np.degrees(measured.widths_half_width)),
        "sensors": {name: _sensor_json(health, k) for k, name in enumerate(INPUTS)},
        "delay_s": _plain(measured.delay),
        "back_emf_delay_s": _plain(health.delays.back_emf),
        "at_standstill": _delays_known(health),
        "duty": {name: _plain(duty) for name, duty in zip(INPUTS, measured.duty, strict=True)},
        "bounces": {
            "n": sum(found.bounces),
            "by_input": dict(zip(INPUTS, found.bounces, strict=True)),
            "widest_s": _plain(found.bounce_width[1]),
        },
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
                "angle_deg": _plain(_angle(edge, passages)),
                "half_width_95_deg": _plain(math.degrees(passages.half_width)),
                "jitter_deg": _plain(math.degrees(passages.jitter)),
                "n": passages.n,
            }
            for way, passages in (("up", edge.up), ("down", edge.down))
        },
        "hysteresis_deg": _plain(math.degrees(edge.hysteresis)),
        "sector_width_deg": _plain(math.degrees(width)),
    }


def _sensor_json(health: Health, k: int) -> dict[str, Any]:
    measured, (late, within) = health.measured, _late(health)
    blind, (up, down), (half_width, each_way) = (
        measured.blind, measured.placement_each_way, measured.placement_half_width,
    )  # fmt: skip
    angles = {
        "displaced_deg": measured.placement,
        "displaced_half_width_95_deg": half_width,
        "displaced_up_deg": up,
        "displaced_down_deg": down,
        "displaced_each_way_half_width_95_deg": each_way,
    }
    rise, fall = late[k]
    return {
        **{name: _plain(math.degrees(values[k])) for name, values in angles.items()},
        "duty_half_width_95": _plain(measured.duty_half_width[k]),
        "rising_late_s": None if blind else _plain(rise),
        "falling_late_s": None if blind else _plain(fall),
        "rising_after_falling_s": _plain(rise - fall),
        "late_half_width_95_s": _plain(within[k]),
    }


def _late(health: Health) -> tuple[Floats, Floats]:
    """(3, 2) s by which rising and falling edges are late, and (3,) half a 95 % interval; blind, of the difference."""
    fit, blind = health.measured.fit, health.measured.blind
    if fit is None:
        return np.full((3, 2), math.nan), np.full(3, math.nan)
    together = blind and np.ptp(fit.delay) != 0.0 and np.ptp(fit.delay[:, 0]) == 0.0  # one difference was fitted
    within = fit.delay_sd.sum(axis=1) if together else np.hypot(*fit.delay_sd.T) if blind else fit.delay_sd.max(axis=1)
    return fit.delay.copy(), SIGMA_95 * within


def _delays_known(health: Health) -> bool:
    fit = health.measured.fit
    return fit is not None and not bool(np.isnan(fit.delay).any())


def _steps(steps: Ints) -> tuple[int, int, int]:
    """Sectors forward and in reverse, and how often the shaft turned round."""
    ways = np.sign(steps[steps != 0])
    return int(steps[steps > 0].sum()), int(-steps[steps < 0].sum()), int(np.count_nonzero(np.diff(ways)))


def _widths(health: Health) -> tuple[float, ...]:
    blind = health.measured.blind and not health.measured.inputs.inverted
    specified = health.wiring is not None and health.wiring.best == AS_SPECIFIED
    return health.measured.widths if specified or blind else (math.nan,) * SECTORS


def _angle(edge: Edge, passages: Passages) -> float:
    """deg from -30 to 390, so that it is near to where the edge belongs, at 0 or 350."""
    angle = math.degrees(edge.ideal) - math.degrees(edge.delta(passages))
    return angle - 360.0 * ((angle > 390.0) - (angle < -30.0))


def _list(values: Floats) -> list[float | None]:
    return [_plain(value) for value in values.tolist()]


def _plain(value: float) -> float | None:
    return None if math.isnan(value) else float(value)


def _wrapped(head: str, text: str) -> list[str]:
    return textwrap.wrap(head + text, WIDTH, subsequent_indent=" " * len(head))
