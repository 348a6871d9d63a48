"""What a run has shown: the claim, its exit code, and all of it as plain data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from bench.conform.checks import Check, Result
from bench.conform.levels import CAN, LEVELS, MOTION
from bench.conform.run import Run
from bench.conform.verdicts import WORDS
from bench.device.description import describe
from bench.rig.outcome import RunOutcome
from bench.signal.verdict import Verdict
from bench.signal.versions import PROGRAM
from protocol import __version__
from protocol.framing import MAJOR, MINOR
from protocol.text import counted


@dataclass(frozen=True)
class Claim:
    """`level`: the highest one that was shown, -1 for none; `conforms` is None where nothing is decided.

    A level is shown if checks of it passed, those without which it is nothing (`Check.critical`) among them. `missing`:
    what was run, and is not shown for that.
    """

    level: int
    conforms: bool | None
    words: str
    untested: tuple[str, ...]
    missing: tuple[str, ...]

    @property
    def verdict(self) -> str:
        """In a word, for a heading."""
        return {True: "CONFORMS", False: "DOES NOT CONFORM", None: "INCONCLUSIVE"}[self.conforms]


def claim(run: Run) -> Claim:
    """What can be said of the device after a run."""
    tested = [number for number in range(MOTION + 1) if _passed(run.results, number)]
    missing = {number: found for number in range(len(LEVELS)) if (found := _missing(run.results, number))}
    level = next((n - 1 for n in range(MOTION + 2) if n not in tested or n in missing), MOTION)
    untested = [f"level {n} ({LEVELS[n]})" for n in range(level + 1, MOTION + 1) if n not in tested]
    not_shown = [f"level {n} ({LEVELS[n]}), which needs {', '.join(ids)}" for n, ids in missing.items()]
    failed, unknown = _ids(run.results, Verdict.FAIL), _ids(run.results, Verdict.INVALID)
    passed = run.count(Verdict.PASS)
    spoken = f"{MAJOR}.{min(run.hello.minor, MINOR)}"
    if failed:
        conforms: bool | None = False
        these = f"{counted(len(failed), 'check')} failed: {', '.join(failed)}"
        words = f"does not conform to HBP {spoken}: {these}; {passed} passed"
    elif why := run.ended or run.loses or ("no check passed" if level < 0 else ""):
        conforms, words = None, f"inconclusive: {why}; {counted(passed, 'check')} passed"
    else:
        conforms = True
        on_can = ", on CAN" if _passed(run.results, CAN) and CAN not in missing else ""
        words = f"conforms to HBP {spoken} at level {level}{on_can}: {counted(passed, 'check')} passed"
    if unknown:
        few = ", ".join(unknown[:6]) + (f" and {len(unknown) - 6} more" if len(unknown) > 6 else "")
        words += f", {len(unknown)} unknown: {few}"
    if not_shown:
        words += f"; not shown: {'; '.join(not_shown)}"
    if untested:
        words += f"; not tested: {', '.join(untested)}"
    return Claim(level, conforms, words, tuple(untested), tuple(not_shown))


def _missing(results: Sequence[Result], level: int) -> list[str]:
    """The critical checks of a level that are unknown."""
    found = (result for result in results if result.check.level == level and result.check.critical)
    return [result.check.id for result in found if result.verdict is Verdict.INVALID]


def _passed(results: Sequence[Result], level: int) -> bool:
    return any(result.verdict is Verdict.PASS for result in results if result.check.level == level)


def _ids(results: Sequence[Result], verdict: Verdict) -> list[str]:
    return [result.check.id for result in results if result.verdict is verdict]


def outcome(run: Run) -> RunOutcome:
    """How it ended; `findings` are the checks that failed, and troubles."""
    found, failed = claim(run), _ids(run.results, Verdict.FAIL)
    if failed or (not run.loses and (run.troubles or (run.ended and not run.signal))):
        verdict = Verdict.FAIL
    elif run.signal:
        verdict = Verdict.ABORTED
    else:
        verdict = Verdict.INCOMPLETE if found.missing or run.loses else Verdict.PASS
    return RunOutcome.of(verdict, found.words, (*failed, *run.troubles), unsafe=run.unsafe, signum=run.signal)


def about(run: Run, station: dict[str, Any], started: str) -> dict[str, Any]:
    """What was looked at, when and where: plain data for every kind of report."""
    return {"target": run.options.target} | describe(run.hello) | station | {"started": started, PROGRAM: __version__}


def as_data(run: Run, about_run: dict[str, Any]) -> dict[str, Any]:
    """All of it, for JSON."""
    found = claim(run)
    return {
        "about": about_run,
        "level": run.options.level,
        "claim": found.words,
        "conforms": found.conforms,
        "conforms_at_level": found.level if found.conforms else None,
        "not_tested": list(found.untested),
        "not_shown": list(found.missing),
        "counts": {words: run.count(verdict) for verdict, words in WORDS.items()},
        "ended_early": run.ended,
        "outputs_may_be_on": run.unsafe,
        "troubles": run.troubles,
        "checks": [check_data(result.check) | {
            "verdict": WORDS[result.verdict], "evidence": result.evidence, "seconds": result.seconds,
        } for result in run.results],
    }  # fmt: skip


def check_data(check: Check) -> dict[str, Any]:
    """What a check is, as plain data."""
    return {
        "id": check.id, "level": check.level, "needs_level": check.needs, "requirements": list(check.cites),
        "spec": check.says, "looks_at": looks_at(check), "on": str(check.carrier),
    }  # fmt: skip


def looks_at(check: Check) -> str:
    """What a check finds out, in a sentence."""
    return " ".join((check.body.__doc__ or "").split("\n\n")[0].split())


def by_level(results: Sequence[Result]) -> list[tuple[str, list[Result]]]:
    """Results under the names of their levels, those that there are."""
    found = []
    for number, name in enumerate(LEVELS):
        rows = [result for result in results if result.check.level == number]
        if rows:
            found.append((f"level {number}: {name}", rows))
    return found
