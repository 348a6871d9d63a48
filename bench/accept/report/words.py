"""How the report says things: digits, times, counts, text from docstrings, the place of a value between its limits.

Pure functions of plain values; nothing here knows HTML.
"""

from __future__ import annotations

import inspect
import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence

from bench.accept.results import Measurement, RunResult, Verdict
from bench.report.words import plain
from bench.signal.limits import YES_NO, Limits
from bench.signal.sources import source_name
from protocol.text import counted

STEPS = 300  # into which the room between limits is divided at least: what the last digit stands for
MOST_DECIMALS = 9
NOTHING = "–"
NOT_A_NUMBER = "NaN"
NBSP = "\N{NO-BREAK SPACE}"
ZONE = (20.0, 80.0)  # % of a bar's length that the permitted values take up, where they have both ends


def number(value: float, decimals: int | None = None) -> str:
    """`value` with that many decimals; without, as many as its own size calls for."""
    if not math.isfinite(value):
        return NOT_A_NUMBER if math.isnan(value) else ("∞" if value > 0 else "−∞")
    if abs(value) >= 1e9 or 0 < abs(value) < 1e-6:
        return _minus(f"{value:.4g}")
    return _minus(f"{value:.{(_decimals(value) if decimals is None else decimals)}f}")


def value_text(measurement: Measurement) -> str:
    """The value with its unit."""
    value, limits = measurement.value, measurement.nearest
    if value is None:
        return NOTHING
    if limits.unit == YES_NO:
        return NOT_A_NUMBER if math.isnan(value) else limits.told(value)
    return f"{number(value, digits(value, limits))} {limits.unit}".rstrip()


def limits_text(limits: Limits) -> tuple[str, str]:
    """The limits, and where they come from if they are shares of a rating."""
    text = str(limits).replace("-", "−")
    first, bracket, rest = text.partition(" (")
    return (first, rest.removesuffix(")")) if bracket and limits.scaled else (text, "")


def margin_text(measurement: Measurement) -> str:
    """The margin, signed, and its share of the room that there is; an answer has none."""
    if measurement.limits.unit == YES_NO:
        return NOTHING
    value, margin, share = measurement.value, measurement.margin, measurement.share
    if value is None or margin is None or not math.isfinite(margin):
        return NOTHING
    sign = "+" if margin > 0 else ""
    percent = "" if share is None or abs(share) > 99 else f" ({_minus(f'{100 * share:.0f}')}{NBSP}%)"
    return f"{sign}{number(margin, digits(value, measurement.nearest))}{percent}"


def digits(value: float, limits: Limits) -> int:
    """Decimals for a value between limits: fine enough for the room there, none for a count.

    More where rounding would move it onto a limit: what is outside must look outside.
    """
    ends = [limit for limit in (limits.lo, limits.hi) if limit is not None]
    if not math.isfinite(value):
        return 0
    if not limits.unit and all(float(number).is_integer() for number in (value, *ends)):
        return 0
    width = max(ends) - min(ends) if len(ends) == 2 else 0.0
    decimals = _decimals(width or max(map(abs, (value, *ends))))
    while decimals < MOST_DECIMALS and any(value != end and round(value, decimals) == end for end in ends):
        decimals += 1
    return decimals


def meaning(run: RunResult) -> str:
    """What the verdict of a run says, in a sentence."""
    tests = [test.verdict for test in run.tests]
    failed, passed, skipped = (tests.count(v) for v in (Verdict.FAIL, Verdict.PASS, Verdict.SKIPPED))
    tested = f"{passed} of {counted(len(tests), 'test')} passed, {skipped} {'was' if skipped == 1 else 'were'} skipped"
    match run.verdict:
        case Verdict.PASS if passed < len(tests):
            return f"All that was tested is within its limits: {tested}."
        case Verdict.PASS:
            return "All measurements are within their limits."
        case Verdict.FAIL if run.spec is not None and _within_limits(run):
            return f"The drive is within its limits, but not as specified by {run.spec.name}."
        case Verdict.FAIL:
            unjudged = tests.count(Verdict.ERROR) + tests.count(Verdict.INVALID)
            others = f", {unjudged} could not be judged" if unjudged else ""
            return f"The drive did not pass: {failed} of {counted(len(tests), 'test')} failed{others}."
        case Verdict.INCOMPLETE if not passed:
            return "Nothing was tested."
        case Verdict.INCOMPLETE:
            return f"Not everything was tested: {tested}."
        case Verdict.INVALID:
            return "The data are insufficient for a verdict."
        case Verdict.ABORTED:
            return f"The run was ended early: {passed} of {counted(len(tests), 'test')} passed."
    return "The bench is at fault: there is no verdict on the drive."


def _within_limits(run: RunResult) -> bool:
    """Whether nothing but a spec has failed it: no measurement by its limits, and no test by anything else."""
    good = (Verdict.PASS, Verdict.SKIPPED)
    left = [
        [m.failed for m in test.measurements if m.verdict not in good] for test in run.tests if test.verdict not in good
    ]
    return all(failed and set(failed) == {"specified"} for failed in left)


def zone(limits: Limits) -> tuple[float, float] | None:
    """From where to where a bar is permitted, in % of its length; None where there are no limits."""
    if limits.lo is None and limits.hi is None:
        return None
    return (0.0 if limits.lo is None else ZONE[0], 100.0 if limits.hi is None else ZONE[1])


def place(measurement: Measurement) -> float | None:
    """Where on a bar the value lies, in % of its length, held to its ends; None where there is nothing to show."""
    value, limits = measurement.value, measurement.nearest
    lo, hi = limits.lo, limits.hi
    if value is None or math.isnan(value) or (lo is None and hi is None) or limits.unit == YES_NO:
        return None
    if lo is not None and hi is not None:
        start, width, length = lo, hi - lo, ZONE[1] - ZONE[0]
    elif hi is not None:
        start, width, length = hi - abs(hi), abs(hi), ZONE[1]
    else:
        start, width, length = lo or 0.0, abs(lo or 0.0), 100 - ZONE[0]
    if width == 0:  # a limit of 0, or two that are one: on it, below or above
        edge = ZONE[1] if lo is None else ZONE[0] if hi is None else 50.0
        return edge if value == start else (0.0 if value < start else 100.0)
    offset = 0.0 if lo is None else ZONE[0]
    return min(100.0, max(0.0, offset + length * (value - start) / width))


def for_information(measurement: Measurement) -> bool:
    """Whether it has a value and nothing that this could fail."""
    both = (measurement.limits, measurement.specified or measurement.limits)
    return measurement.verdict is Verdict.PASS and all(limits.lo is None and limits.hi is None for limits in both)


def passed(measurements: Sequence[Measurement]) -> str:
    """How many of these, none of which did not pass, did so, and how many could not do otherwise."""
    free = sum(map(for_information, measurements))
    return f"{len(measurements) - free} passed, {free} for information" if free else "all passed"


def tally(verdicts: Iterable[Verdict]) -> list[tuple[Verdict, int]]:
    """How many of each verdict, in the order of `Verdict`; those that do not occur are left out."""
    counts = Counter(verdicts)
    return [(verdict, counts[verdict]) for verdict in Verdict if counts[verdict]]


def made(measurements: Sequence[Measurement]) -> str:
    """How many there are and, where some were not made, of how many."""
    number = sum(measurement.value is not None for measurement in measurements)
    return str(number) if number == len(measurements) else f"{number} of {len(measurements)}"


def span_text(span: tuple[float, float]) -> str:
    """A stretch of a recording."""
    return f"{span[0]:.3f} … {span[1]:.3f} s"


def duration(seconds: float) -> str:
    """A time that somebody waited."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s"


def paragraphs(text: str) -> list[str]:
    """Paragraphs of a docstring, filled: only indented lines and items of lists keep their own lines."""
    blocks = re.split(r"\n\s*\n", inspect.cleandoc(text.replace("`", "")))
    return [re.sub(r"\n(?![ \t]|[-*] )", " ", block) for block in blocks if block.strip()]


def setting(value: float, name: str) -> str:
    """The value of a drive's parameter; that of `observer` with the name of the angle source."""
    source = source_name(value) if name == "observer" else ""
    return plain(value) + (f" ({source})" if source else "")


def _decimals(scale: float) -> int:
    if scale == 0:
        return 0
    return min(MOST_DECIMALS, max(0, math.ceil(math.log10(STEPS / abs(scale)))))


def _minus(text: str) -> str:
    return text.replace("-", "−") if float(text) else text.replace("-", "")
