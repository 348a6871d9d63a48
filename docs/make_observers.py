"""Records the simulated drive over its whole range and scores all observers on it; makes docs/observers.md and figures.

python docs/make_observers.py [--page]

The page's words are in docs/observers/*.md.j2, every measured number in it in docs/observers/numbers.json. With --page
nothing is run: the page is made again from the words and these numbers. The noise is that of a run's name, so the same
version gives the same numbers again, but for the times of a step.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from protocol.signals import AngleSource
from sim.observers.catalogue import CATALOGUE

DOCS = Path(__file__).parent
PARTS = DOCS / "observers"
NUMBERS = PARTS / "numbers.json"
PAGE = DOCS / "observers.md"


def main() -> None:
    """Run, draw, write."""
    if sys.argv[1:] != ["--page"]:
        NUMBERS.write_text(json.dumps(run(), indent=1) + "\n")
    PAGE.write_text(page())


def run() -> dict[str, Any]:
    """All numbers of the page; its figures are drawn on the way."""
    from observers import figures, measures, recordings

    with tempfile.TemporaryDirectory() as folder:
        paths = recordings.record(Path(folder))
        seen = measures.Seen(paths["steady"])
        numbers: dict[str, Any] = rounded(
            measures.scored(paths, Path(folder)) | measures.measured(paths, seen) | {"in_loop": measures.closed_loops()}
        )
        figures.draw(paths, seen, numbers, PARTS)
    return numbers


def rounded(value: Any) -> Any:
    """Five digits of every number, so that the file is short."""
    if isinstance(value, dict):
        return {key: rounded(part) for key, part in value.items()}
    if isinstance(value, list):
        return [rounded(part) for part in value]
    return float(f"{value:.5g}") if isinstance(value, float) else value


def page(numbers: Mapping[str, Any] | None = None) -> str:
    """The page from its words and some numbers, those of the last run by default."""
    words = Environment(
        loader=FileSystemLoader(PARTS), undefined=StrictUndefined, keep_trailing_newline=True, trim_blocks=True
    )
    words.filters["n"] = number
    own = DOCS / "examples" / "own_observer"
    return words.get_template("observers.md.j2").render(
        **(numbers or json.loads(NUMBERS.read_text())),
        sections=[path.name.removesuffix(".md.j2") for path in PARTS.glob("*.md.j2")],
        own_observer=(own / "smoothed_average.py").read_text().rstrip(),
        own_project=(own / "pyproject.toml").read_text().rstrip(),
        next_source=max(AngleSource) + 1,
        needs={name: CATALOGUE[name].needs.words for name in CATALOGUE if (PARTS / f"{name}.md.j2").is_file()},
    )


def number(value: float | None, places: int | None = None) -> str:
    """Three digits, or so many places; – where there is nothing."""
    if value is None:
        return "–"
    if places is None:
        places = 0 if abs(value) >= 100 else 1 if abs(value) >= 10 else 2
    return f"{round(value, places) + 0.0:.{places}f}"


if __name__ == "__main__":
    main()
