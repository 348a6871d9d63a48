"""Writes the report of an acceptance run: one self-contained HTML file, to read on a screen or on paper.

Everything in it comes from a `RunResult` and the pictures beside it; nothing is measured or judged here, and nothing
is fetched when it is read. Whatever a test, a drive or a log says is text in it, never markup.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from markupsafe import Markup, escape

from bench.accept.naming import in_words
from bench.accept.report import words
from bench.accept.report.subject import SHOWN, drive, subject
from bench.accept.report_files import keep_only
from bench.accept.results import Figure, Measurement, RunResult, TestResult, Verdict, gaps, tightest
from bench.errors import BenchError
from bench.files import write
from bench.report.html import embedded, page
from protocol.text import counted

NAME = "report.html"
MOST_ROWS = 12  # of a table on one page; a test of more shows measurements that did not pass and folds the others
FAILED = (Verdict.FAIL,)
NOT_JUDGED = (Verdict.ERROR, Verdict.INVALID)


class ReportError(BenchError):
    """The report cannot be written."""


@dataclass(frozen=True)
class _Test:
    """A test with what the template needs besides: its anchor, its pictures, the rows to show and to fold."""

    anchor: str
    result: TestResult
    figures: tuple[tuple[str, str], ...]  # data URI, caption
    shown: tuple[Measurement, ...]
    folded: tuple[Measurement, ...]
    unmade: bool  # it had measurements to make and made none

    @property
    def label(self) -> str:
        """Its name for people."""
        return self.result.label or in_words(self.result.name)

    @property
    def folding(self) -> str:
        """What the rows that are folded are."""
        if self.unmade:
            return f"{counted(len(self.folded), 'measurement')}, none made"
        if self.shown:
            return f"{len(self.folded)} more: {words.passed(self.folded)}"
        return f"{counted(len(self.folded), 'measurement')}: {words.passed(self.folded)}"

    @property
    def short(self) -> bool:
        """Whether it has its place on one page."""
        return (self.unmade or not self.folded) and not self.result.log and len(self.figures) <= 1

    @property
    def recording(self) -> str:
        """Relative address of its recording; empty without one."""
        return quote(self.result.recording)


@dataclass(frozen=True)
class _Finding:
    """A measurement that did not pass, or, without a measurement, a test that did not."""

    test: _Test
    verdict: Verdict
    why: str
    measurement: Measurement | None = None


def write_report(run: RunResult, directory: Path) -> Path:
    """Write `directory`/report.html and return its path; figures are read from `directory`/<their path>.

    What an earlier report left there is deleted. Raises ReportError for a figure that is not there, and BenchError
    where the file cannot be written.
    """
    tests = [_test(number, result, directory) for number, result in enumerate(run.tests, 1)]
    text = page(
        __package__ or "",
        "template.html.j2",
        _FILTERS,
        run=run,
        tests=tests,
        verdicts=[m.verdict for m in run.measurements if not words.for_information(m)],
        drive=drive(run),
        subject=subject(run),
        identity={key: value for key, value in run.identity.items() if key not in SHOWN},
        meaning=words.meaning(run),
        gaps=gaps(run.tests),
        by_id={test.result.node_id: test for test in tests},
        failed=list(_findings(tests, FAILED)),
        not_judged=list(_findings(tests, NOT_JUDGED)),
        units={parameter.name: parameter.unit for parameter in run.parameters},
        parameters=sorted(run.parameters, key=lambda p: p.value == p.default),
        whole=MOST_ROWS,
    )
    path = directory / NAME
    write(path, text, f"report {path}")
    made = {name for test in run.tests for name in (test.recording, *(f.path for f in test.figures)) if name}
    try:
        keep_only(directory, {NAME, *made})
    except OSError as error:
        raise ReportError(f"report {directory}: what an earlier one left cannot be deleted: {error}") from None
    return path


def _test(number: int, result: TestResult, directory: Path) -> _Test:
    many = len(result.measurements) > MOST_ROWS
    unmade = all(m.value is None for m in result.measurements)
    fold = [unmade or (many and m.verdict is Verdict.PASS) for m in result.measurements]
    return _Test(
        anchor=f"test-{number}",
        result=result,
        figures=tuple((_embedded(figure, result, directory), figure.caption) for figure in result.figures),
        shown=tuple(m for m, folded in zip(result.measurements, fold, strict=True) if not folded),
        folded=tuple(m for m, folded in zip(result.measurements, fold, strict=True) if folded),
        unmade=unmade and bool(fold),
    )


def _embedded(figure: Figure, test: TestResult, directory: Path) -> str:
    path = directory / figure.path
    try:
        return embedded(path)
    except OSError as error:
        raise ReportError(f"figure {path} of test {test.name} cannot be read: {error.strerror}") from None


def _findings(tests: list[_Test], verdicts: tuple[Verdict, ...]) -> Iterator[_Finding]:
    """What ended with one of `verdicts`, in their order: measurements, and tests that none of theirs speaks for.

    A test that made none of its measurements is one of the latter, whatever became of them.
    """
    for verdict in verdicts:
        for test in tests:
            found = [m for m in test.result.measurements if m.verdict is verdict and not test.unmade]
            for measurement in found:
                yield _Finding(test, verdict, measurement.why, measurement)
            if test.result.verdict is verdict and not found:
                why = ": ".join(text for text in (test.folding if test.unmade else "", test.result.why) if text)
                yield _Finding(test, verdict, why)


def _breakable(name: str) -> Markup:
    """A name that may be wrapped after its dots, underscores and slashes."""
    text = str(escape(name))
    for sign in "._/":
        text = text.replace(sign, f"{sign}<wbr>")
    return Markup(text)  # escaped above


_FILTERS = (
    _breakable, in_words, tightest, words.duration, words.for_information, words.limits_text, words.made,
    words.margin_text, words.number, words.paragraphs, words.place, words.setting, words.span_text, words.tally,
    words.value_text, words.zone,
)  # fmt: skip
