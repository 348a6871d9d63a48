"""The results as one HTML file. Nothing is fetched when it is read."""

from __future__ import annotations

from typing import Any

from bench.conforming.claim import by_level, claim, looks_at
from bench.conforming.run import Run
from bench.conforming.verdicts import Verdict
from bench.reports.html import page
from protocol.text import printable, told

CLASSES = {Verdict.PASSED: "PASS", Verdict.FAILED: "FAIL", Verdict.UNKNOWN: "INVALID", Verdict.NOT_APPLICABLE: "NONE"}
OF_CLAIM = {True: "PASS", False: "FAIL", None: "INVALID"}


def as_html(run: Run, about_run: dict[str, Any]) -> str:
    """The page: first what was not tested or not observed, then every check with its evidence."""
    found = claim(run)
    unseen = [result for result in run.results if result.verdict is Verdict.UNKNOWN]
    failed = [result for result in run.results if result.verdict is Verdict.FAILED]
    return page(
        __package__ or "",
        "report.html.j2",
        {"shown": lambda text: printable(str(text)), "look": CLASSES.__getitem__, "looks_at": looks_at},
        run=run,
        claim=found,
        claim_look=OF_CLAIM[found.conforms],
        about={key.replace("_", " "): told(value) for key, value in about_run.items()},
        counts={str(verdict): run.count(verdict) for verdict in Verdict},
        unseen=unseen,
        failed=failed,
        levels=by_level(run.results),
    )
