"""`python -m tests.campaign [NAME …]`: long tests that the suite leaves out, all seeds, motors and faults.

    python -m tests.campaign --list            names, and how many tests each has
    python -m tests.campaign motors sabotage   these; without a name all of them
    python -m tests.campaign -n 4              in four workers (2 without it)
    python -m tests.campaign --again           also those that passed before on this commit

A test with `@pytest.mark.campaign("NAME")` belongs to a campaign, and to no suite. What passed is kept below .campaign,
for each commit, as it comes: a campaign that was interrupted goes on where it was. Other options go to pytest. Ends as
pytest does, and with 0 where nothing was left to do.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import sys
import tempfile
from collections import Counter
from pathlib import Path

import pytest

from tests.choice import commit

KEPT = Path(".campaign")
NAMES = "HALLBENCH_TESTS_CAMPAIGN_NAMES"  # for tests/conftest.py, in every worker: the campaigns, "" for all
PASSED = "HALLBENCH_TESTS_CAMPAIGN_PASSED"  # and a file of the tests that need not run again


def names_of(item: pytest.Item) -> list[str]:
    """The campaigns of a test."""
    return [str(name) for mark in item.iter_markers("campaign") for name in mark.args]


def wanted(items: list[pytest.Item]) -> list[pytest.Item]:
    """Those of the campaigns that were asked for which have not passed yet."""
    names = set(os.environ.get(NAMES, "").split())
    file = os.environ.get(PASSED)
    passed = passed_in(Path(file)) if file else set()
    return [item for item in items if (not names or names & set(names_of(item))) and item.nodeid not in passed]


def known() -> set[str]:
    """The names of all campaigns, as the marks in the files say."""
    files = Path(__file__).parent.rglob("test_*.py")
    return {name for file in files for name in re.findall(r'\bcampaign[(=]"([\w-]+)"', file.read_text())}


def passed_in(file: Path) -> set[str]:
    """The tests that a file of a campaign names; a line that was cut off counts for nothing."""
    lines = file.read_text().splitlines() if file.exists() else []
    return {json.loads(line) for line in lines if line.endswith('"')}


class Results:
    """Keeps what passes, and sums up by campaign."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._counts = Counter[tuple[str, str]]()

    def pytest_collection_finish(self, session: pytest.Session) -> None:
        """Count what there is, for --list."""
        self._counts.update((name, "tests") for item in session.items for name in names_of(item))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Keep a test that passed; count it for its campaigns."""
        if report.when == "call" and report.passed:
            self._file.parent.mkdir(exist_ok=True)
            with self._file.open("a") as file:
                file.write(json.dumps(report.nodeid) + "\n")
        if report.when == "call" or not report.passed:
            names = next((value for key, value in report.user_properties if key == "campaigns"), [])
            self._counts.update((name, report.outcome) for name in names)

    def lines(self, *outcomes: str) -> list[str]:
        """A line for each campaign."""
        return [
            f"{name:14} " + ", ".join(f"{self._counts[name, o]} {o}" for o in outcomes if self._counts[name, o])
            for name in sorted({name for name, outcome in self._counts if outcome in outcomes})
        ]

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """How the campaigns went."""
        terminalreporter.section(f"campaigns on {commit()}")
        for line in self.lines("passed", "failed", "skipped", "xfailed"):
            terminalreporter.write_line(line)


def main() -> int:
    """Run pytest with the tests of the campaigns that were named."""
    parser = argparse.ArgumentParser(prog="python -m tests.campaign", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("-n", default="2", metavar="N", help="workers")
    parser.add_argument("--list", action="store_true", help="say which campaigns there are")
    parser.add_argument("--again", action="store_true", help="also what passed before on this commit")
    options, others = parser.parse_known_intermixed_args()
    if unknown := set(options.names) - known():
        parser.error(f"no campaign {', '.join(sorted(unknown))}: there are {', '.join(sorted(known()))}")
    file = KEPT / f"{commit()}.jsonl"
    results = Results(file)
    os.environ[NAMES] = " ".join(options.names)
    if options.list:
        pytest.main(["-o", "addopts=", "--campaign", "--collect-only", "-p", "no:terminal", *others], plugins=[results])
        print("\n".join(results.lines("tests")))
        return 0
    with tempfile.TemporaryDirectory() as folder:  # as it is now, the same for every worker
        if file.exists() and not options.again:
            os.environ[PASSED] = str(shutil.copy(file, folder))
        code = pytest.main(["--campaign", "-n", options.n, *others], plugins=[results])
    return 0 if code == pytest.ExitCode.NO_TESTS_COLLECTED and PASSED in os.environ else int(code)


if __name__ == "__main__":
    sys.exit(main())
