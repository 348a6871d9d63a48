"""Puts faults of Hall sensors, made by formula, before the judge of `bench hall check`; makes docs/hall-faults.md.

python docs/make_hall_faults.py [--quick] [--only FAULT] [--first N] [--case NAME] [--healthy N] [--live] [--wrong N]

Without options: all faults, sizes, motors and speeds, 5 seeds each, and the page is written. --quick: one seed each;
--only: faults with this in their name; --first: seeds from N on, of cases that nobody has looked at; --case: one case,
with all that was said; --healthy: N drives that nothing is wrong with instead, and how often the intervals hold
that are stated of where their sensors stand; --live: before the judge of `bench
live`, piece by piece; --wrong: how many wrong verdicts of each fault and size are shown. Only a whole run, without
options, writes the page.
"""

from __future__ import annotations

import argparse
import os
import sys
import traceback
from collections import Counter
from collections.abc import Iterable, Sequence
from multiprocessing import Pool
from pathlib import Path
from typing import NamedTuple

import numpy as np

DOCS = Path(__file__).parent
PAGE = DOCS / "hall-faults.md"
sys.path.insert(0, str(DOCS.parent))  # for `tests`

from bench.findings.finding import Finding  # noqa: E402
from bench.findings.health import examine  # noqa: E402
from bench.hall.trace import trace  # noqa: E402
from bench.live.plausible import Plausibility  # noqa: E402
from bench.signal.capture import Capture  # noqa: E402
from bench.signal.hall_edges import measure  # noqa: E402
from bench.signal.position import ErrorTable  # noqa: E402
from tests.bench.hall_cases.drives import healthy  # noqa: E402
from tests.bench.hall_cases.faults import FAULTS, Case, Fault, by_name, cases  # noqa: E402
from tests.bench.hall_cases.recording import Recording, pieces  # noqa: E402

OUTCOMES = ("right", "cannot tell", "missed", "wrong")


class Said(NamedTuple):
    """A verdict, and findings: code and words; `missing`: why there is no verdict."""

    verdict: str
    findings: tuple[tuple[str, str], ...]
    missing: str = ""


class Result(NamedTuple):
    """What was said of a case, and whether it is right."""

    case: str
    outcome: str
    said: Said
    large: bool
    held: tuple[bool, ...] = ()
    """Of a healthy drive: whether each sensor's true place is within what is stated."""


def judged(capture: Capture, live: bool) -> Said:
    """What the judge says of a recording."""
    try:
        if live:
            run = Plausibility(capture.samples.config, True, capture.parameters)
            for piece in pieces(capture):
                run.take(piece)
            found: Sequence[Finding] = run.implausible(ErrorTable())
            return Said("FAIL" if found else "PASS", _words(found))
        health = examine(trace(capture))
    except Exception:
        return Said("ERROR", (("error", traceback.format_exc(limit=-3)),))
    return Said(str(health.verdict), _words(health.findings), "; ".join(health.missing))


def _words(findings: Iterable[Finding]) -> tuple[tuple[str, str], ...]:
    return tuple((finding.code, finding.cause) for finding in findings)


def try_case(asked: tuple[Case, bool]) -> Result:
    """Judge a case; `asked`: and whether as a live run."""
    case, live = asked
    said = judged(case.recording.capture(), live)
    return Result(case.name, case.judged(said.verdict, said.findings), said, case.large)


def try_healthy(asked: tuple[int, bool]) -> Result:
    """Judge a drive that nothing is wrong with."""
    seed, live = asked
    made = healthy(seed)
    capture = made.capture()
    said = judged(capture, live)
    outcome = "wrong" if said.findings else "cannot tell" if said.verdict == "INVALID" else "right"
    return Result(f"healthy/{seed}", outcome, said, False, () if live else held(made, capture))


def held(made: Recording, capture: Capture) -> tuple[bool, ...]:
    """Whether each sensor's true place, against the mean of the three, lies in the interval that is stated of it."""
    measured = measure(trace(capture))
    if measured.fit is None:
        return ()
    off = np.abs(measured.placement - np.radians(np.subtract(made.sensors.displaced, np.mean(made.sensors.displaced))))
    half_width = measured.placement_half_width[0]
    return tuple((off <= half_width)[np.isfinite(off)].tolist())


def page(results: Sequence[Result]) -> str:
    """docs/hall-faults.md."""
    rows = [
        "# What `bench hall check` says of faults",
        "",
        "Made by `python docs/make_hall_faults.py`, of recordings by formula (`tests/bench/hall_cases/`).",
        "",
        "Each fault, in several sizes, is tried on three motors (six pole pairs with ideal sensors; any with sensors "
        "as real ones are, anywhere on the shaft; four or eight pole pairs with sensors at 30 mod 60 deg), turned both "
        "ways at up to 24 and up to 120 electrical revolutions a second (of five seeds three as `bench hall check` "
        "does it, one run up and let go, one by hand), with an encoder and without. A seed draws all else: which "
        "sensor, when, whether voltages were recorded, whether the drive knows where its ring sits. "
        "Angles are electrical.",
        "",
        "Each cell has per cent of: right, cannot tell, missed, wrong; a dot is none. Where a fault is smaller than "
        "it needs be to be named, or the recording cannot show it, saying that nothing is wrong is right too.",
        "",
        f"{summary(results)}",
        "",
        "| what is wrong | size | with an encoder | without |",
        "|---|---|---|---|",
    ]  # fmt: skip
    for fault in FAULTS.values():
        for size in fault.sizes:
            cells = [_cell(results, fault, size, encoder) for encoder in ("encoder", "none")]
            about = (
                f"{fault.about}; named from {fault.smallest:g} {fault.unit}".rstrip() if fault.smallest else fault.about
            )
            about = about if size == fault.sizes[0] else ""
            shown = f"{size:g} {fault.unit}".rstrip() if len(fault.sizes) > 1 else ""
            rows.append(f"| {about} | {shown} | {' | '.join(cells)} |")
    return "\n".join(rows) + "\n"


def _cell(results: Sequence[Result], fault: Fault, size: float, encoder: str) -> str:
    found = [r for r in results if r.case.startswith(f"{fault.name}/{size:g}/") and r.case.split("/")[4] == encoder]
    counts = Counter(r.outcome for r in found)
    return (
        " ".join(f"{100 * counts[what] / len(found):.0f}" if counts[what] else "·" for what in OUTCOMES)
        if found
        else ""
    )


def summary(results: Sequence[Result]) -> str:
    """One line."""
    counts, n = Counter(r.outcome for r in results), max(1, len(results))
    told = ", ".join(f"{what} {counts[what]} ({100 * counts[what] / n:.1f} %)" for what in OUTCOMES)
    good = 100.0 * (counts["right"] + counts["cannot tell"]) / n
    large = sum(r.outcome == "wrong" and r.large for r in results)
    return (
        f"{n} recordings: {told}; right or cannot tell {good:.1f} %, wrong accusations of faults to be named {large}."
    )


def table(results: Sequence[Result]) -> None:
    """By fault and size, with what was said instead."""
    print(f"{'fault':<24}{'size':>8}   right  can't missed  wrong   what was said where it was not right")
    groups: dict[tuple[str, str], list[Result]] = {}
    for result in results:
        fault, _, size = result.case.partition("/")
        groups.setdefault((fault, size.partition("/")[0] if fault != "healthy" else ""), []).append(result)
    for (name, size), found in groups.items():
        counts = Counter(r.outcome for r in found)
        said = Counter(" + ".join(sorted({c for c, _ in r.said.findings})) or r.said.verdict
                       for r in found if r.outcome in ("missed", "wrong"))  # fmt: skip
        told = ", ".join(f"{what} {n}" for what, n in said.most_common(5))
        size = size + ("" if any(r.large for r in found) else "*")
        print(f"{name:<24}{size:>8}  {'  '.join(f'{counts[o]:5d}' for o in OUTCOMES)}   {told}")
    print("* nothing is to be named of any of them")


def detail(result: Result) -> str:
    """What was said, in full."""
    lines = [f"{result.outcome}: {result.case}: {result.said.verdict} {result.said.missing}"]
    if not result.case.startswith("healthy/"):
        its = by_name(result.case).expected
        right, allowed = (", ".join(sorted(codes)) or "nothing" for codes in (its.right, its.allowed))
        if its.right and not result.large:
            right += ", if at all"
        lines.append(f"    to be said: {right} ({its.inputs or 'any input'}); allowed: {allowed}")
    return "\n".join([*lines, *(f"    {code}: {words}" for code, words in result.said.findings)])


def main() -> None:
    """Run, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--only", default="")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--case", default="")
    parser.add_argument("--healthy", type=int, default=0)
    parser.add_argument("--live", action="store_true")
    parser.add_argument("--wrong", type=int, default=3)
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    asked = parser.parse_args()
    if asked.case:
        seed = asked.case.removeprefix("healthy/")
        one = (
            try_healthy((int(seed), asked.live)) if seed != asked.case else try_case((by_name(asked.case), asked.live))
        )
        print(detail(one))
        return
    with Pool(asked.processes) as pool:
        if asked.healthy:
            results = pool.map(try_healthy, [(seed, asked.live) for seed in range(asked.healthy)], 4)
        else:
            chosen = cases(asked.only, asked.quick, first=asked.first)
            results = pool.map(try_case, [(case, asked.live) for case in chosen], 8)
    shown: Counter[str] = Counter()
    for result in results:
        fault = "/".join(result.case.split("/")[:2]) if not asked.healthy else result.case
        if result.outcome in ("wrong", "missed") and shown[fault] < asked.wrong:
            shown[fault] += 1
            print(detail(result))
    table(results)
    print(summary(results))
    if stated := [each for result in results for each in result.held]:
        share = 100.0 * sum(stated) / len(stated)
        print(f"{share:.1f} % of {len(stated)} stated intervals of 95 % hold the sensor's place")
    if len(sys.argv) == 1:
        PAGE.write_text(page(results))


if __name__ == "__main__":
    main()
