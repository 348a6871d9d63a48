"""Runs the shipped study of Hall placement and makes docs/study.md and the study's report of it.

python docs/make_study.py [--page] [--workers N]

The page's words are in docs/studies/study.md.j2, its numbers in docs/studies/hall-placement.json. With --page nothing
is run. On one core it takes some three minutes.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from bench.study.about import about
from bench.study.report import answer, answers, write_report
from bench.study.run import StudyOptions, run
from bench.study.store import open_study, read_rows

DOCS = Path(__file__).parent
PARTS = DOCS / "studies"
STUDY = PARTS / "hall-placement.toml"
NUMBERS, REPORT = PARTS / "hall-placement.json", PARTS / "hall-placement.html"


class Screen:
    """Progress on standard output."""

    def note(self, text: str) -> None:
        """A line."""
        print(text, flush=True)

    def progress(self, text: str) -> None:
        """A line, too: it is a command for few."""
        print(text, end="\r", flush=True)


def main() -> None:
    """Run and write."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--page", action="store_true")
    parser.add_argument("--workers", type=int, default=None)
    given = parser.parse_args()
    if not given.page:
        NUMBERS.write_text(json.dumps(study(given.workers), indent=1) + "\n")
    (DOCS / "study.md").write_text(page(json.loads(NUMBERS.read_text())))


def study(workers: int | None, samples: int | None = None, report: Path = REPORT) -> dict[str, Any]:
    """Run it, write its report, and return what the page tells."""
    with tempfile.TemporaryDirectory(prefix="hallbench-") as made:
        folder = Path(made, "hall-placement.study")
        run(StudyOptions(STUDY, folder, samples, workers), Screen(), time.monotonic)
        rows, told = read_rows(folder), about(open_study(folder), Path("hall-placement.study"), folder)
        found = answer(rows, told)
        report.write_bytes(write_report(folder, rows, told, found=found).read_bytes())
        every = answers(rows, told, found)
    keep = {name: every[name] for name in ("drives", "yields", "yield_pairs")}
    values = [{k: one[k] for k in VALUE} for one in every["value_pairs"] if ".control." in one["name"]]
    rounded: dict[str, Any] = _rounded(keep | {"value_pairs": values})
    return rounded


VALUE = ("name", "a", "b", "unit", "n", "difference", "verdict")


def _rounded(value: Any) -> Any:
    """Four digits: what intervals can tell, and files that change little."""
    if isinstance(value, dict):
        return {key: _rounded(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_rounded(one) for one in value]
    return float(f"{value:.4g}") if isinstance(value, float) else value


def page(numbers: dict[str, Any]) -> str:
    """The page."""
    environment = Environment(
        loader=FileSystemLoader(PARTS), undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
        keep_trailing_newline=True,
    )  # fmt: skip
    environment.filters |= {"share": share}
    designs = list(dict.fromkeys(one["design"] for one in numbers["yields"]))
    tests = list(dict.fromkeys(one["test"] for one in numbers["yields"]))
    yields = {(one["test"], one["design"]): one for one in numbers["yields"]}
    return environment.get_template("study.md.j2").render(n=numbers, designs=designs, tests=tests, yields=yields)


def share(found: dict[str, Any]) -> str:
    """A yield with its interval, %."""
    value, lo, hi = (100 * found["share"][key] for key in ("value", "lo", "hi"))
    return f"{value:.3g} ({lo:.3g} … {hi:.3g})"


if __name__ == "__main__":
    main()
