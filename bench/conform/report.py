"""The results as one HTML file. Nothing is fetched when it is read."""

from __future__ import annotations

from typing import Any

from bench.conform.claim import by_level, claim, looks_at
from bench.conform.run import Run
from bench.conform.verdicts import WORDS
from bench.report.html import page
from bench.report.words import NOT_STATED, date, labelled
from bench.signal.verdict import Verdict
from protocol.text import printable

OF_CLAIM = {True: Verdict.PASS, False: Verdict.FAIL, None: Verdict.INVALID}


def as_html(run: Run, about_run: dict[str, Any]) -> str:
    """The page: first what was not tested or not observed, then every check with its evidence."""
    found = claim(run)
    unseen = [result for result in run.results if result.verdict is Verdict.INVALID]
    failed = [result for result in run.results if result.verdict is Verdict.FAIL]
    return page(
        __package__ or "",
        "report.html.j2",
        (_words, _prose, _shown, looks_at),
        run=run,
        claim=found,
        claim_look=OF_CLAIM[found.conforms],
        name=about_run["name"],
        about=_about(about_run),
        counts=[(verdict, count) for verdict in WORDS if (count := run.count(verdict))],
        unseen=unseen,
        failed=failed,
        levels=by_level(run.results),
    )


def _about(about_run: dict[str, Any]) -> list[tuple[str, str]]:
    """The device and the bench, in pairs of words; whatever nobody has stated of the bench is named as well."""
    told = about_run | {key: about_run.get(key) or NOT_STATED for key in ("station", "operator", "motor")}
    return [labelled(key, value) for key, value in (told | {"started": date(told["started"])}).items()]


def _words(verdict: Verdict) -> str:
    return WORDS[verdict]


def _shown(text: object) -> str:
    return printable(str(text))


def _prose(text: str) -> str:
    """Text of SPEC or of a docstring, without the marks of code."""
    return text.replace("`", "")
