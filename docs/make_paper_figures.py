"""Runs the paper's experiments on the simulated drive; makes docs/paper.md and docs/paper/*.png of what they measured.

python docs/make_paper_figures.py

The page's words are in docs/paper/paper.md.j2; every number of ours in it is a measurement of that run. The simulated
drive's noise is that of a test's name, so the same version gives the same numbers again.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from PIL import Image

from bench.accept.results import RunResult, run_from_json

DOCS = Path(__file__).parent
PICTURES = DOCS / "paper"
COMMAND = ["bench", "accept", "-k", "table1 or fig"]
COLOURS = 128  # of a figure on the page
LARGEST = 150_000  # bytes of a figure


def main() -> None:
    """Run, draw, write."""
    with tempfile.TemporaryDirectory() as folder:
        report, results = Path(folder, "report"), Path(folder, "results.json")
        subprocess.run(
            [sys.executable, "-m", *COMMAND, "sim", "--report", str(report), "--json", str(results)],
            stdin=subprocess.DEVNULL,
            check=True,
        )
        write(run_from_json(json.loads(results.read_text())), report)


def write(run: RunResult, report: Path) -> None:
    """The page and its figures from a run and the directory of its report."""
    for test in run.tests:
        for figure in test.figures:
            shrink(report / figure.path, PICTURES / Path(figure.path).name)
    words = Environment(loader=FileSystemLoader(PICTURES), undefined=StrictUndefined, keep_trailing_newline=True)
    command = f'{" ".join(COMMAND[:-1])} "{COMMAND[-1]}"'
    (DOCS / "paper.md").write_text(words.get_template("paper.md.j2").render(m=reader(run), command=command))


def reader(run: RunResult) -> Callable[[str], str]:
    """What the page asks for numbers: a measurement by name, three digits of it or two places."""
    values = {measurement.name: measurement.value for measurement in run.measurements}

    def number(name: str) -> str:
        value = values[name]
        if value is None:
            raise SystemExit(f"{name} was not measured: see the run")
        places = 0 if abs(value) >= 100 else 1 if abs(value) >= 10 else 2
        return f"{round(value, places) + 0.0:.{places}f}"

    return number


def shrink(source: Path, target: Path) -> None:
    """A figure with fewer colours, for the page. Raises SystemExit if it is still large."""
    picture = Image.open(source).convert("RGB")
    picture.quantize(COLOURS, dither=Image.Dither.NONE).save(target, optimize=True)
    if (size := target.stat().st_size) > LARGEST:
        raise SystemExit(f"{target} has {size} bytes, more than {LARGEST}: take fewer COLOURS")


if __name__ == "__main__":
    main()
