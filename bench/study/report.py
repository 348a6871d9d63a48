"""The answers of a study as one HTML file with its plots in it. Nothing is fetched when it is read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from matplotlib import rc_context
from matplotlib.figure import Figure

from bench.files import check_directory, check_output, write
from bench.report.html import embedded, page
from bench.report.style import save
from bench.study.answers import About, Answers, answer, answers, drives_of, lines, unknown_words
from bench.study.plots import draw_indices, draw_measurement, draw_pairs, draw_yields
from bench.study.rows import Rows
from bench.study.statistics import Estimate, figure, percent, span

__all__ = ["About", "answer", "answers", "lines", "write_report"]

NAME = "report.html"
PANELS = 12  # measurements with a picture: those with the least room
BARS = 6  # charts of indices in a picture


def write_report(folder: Path, rows: Rows, about: About, overwrite: bool = False, found: Answers | None = None) -> Path:
    """Write `folder`/report.html and return its path; `found` are the answers where they are there already.

    BenchError where it exists, unless `overwrite`, or cannot be written.
    """
    path = folder / NAME
    check_directory(folder, f"report {path}", make=True)
    folder.mkdir(parents=True, exist_ok=True)
    check_output(path, f"report {path}", overwrite)
    write(path, as_html(rows, about, found or answer(rows, about)), f"report {path}")
    return path


def as_html(rows: Rows, about: About, found: Answers) -> str:
    """The page."""
    names = list(dict.fromkeys(each.name for each in found.capability if each.sd))[:PANELS]
    told = [[each for each in found.sensitivity if each.indices and each.name == name] for name in names]
    told = [made for made in told if made]
    there = [design for design in rows.designs if any(each.design == design for made in told for each in made)]
    vary = [pair for pair in found.value_pairs if pair.sd_of_a > 0.0 and pair.name in names]
    # a $ in a name is no mathematics
    with TemporaryDirectory(prefix="hallbench-") as place, rc_context({"text.parse_math": False}):
        picture = Path(place) / "figure.png"

        def drawn(make: Callable[..., Figure], *given: Any) -> str:
            save(make(*given), picture)
            return embedded(picture)

        known = [each for each in found.yields if each.share]
        return page(
            __package__ or "",
            "report.html.j2",
            (unknown_words, _figure, _share, _about, _estimate, _stacked),
            about=about,
            found=found,
            limits=rows.limits,
            many=len(rows.designs) > 1,
            design=rows.designs[0] if rows.designs else "",
            judged=[each for each in found.capability if each.sides],
            others=[each for each in found.capability if not each.sides],
            few=next((side.too_few for each in found.capability for side in each.sides if side.too_few), ""),
            yields=drawn(draw_yields, known, rows.designs) if known else "",
            pairs=drawn(draw_pairs, vary) if vary else "",
            panels={name: drawn(draw_measurement, *_of(name, rows, about, found)) for name in names},
            charts=[drawn(draw_indices, told[k : k + BARS], there) for k in range(0, len(told), BARS)],
            why={each.why for each in found.sensitivity if each.why},
            total=bool(about.saltelli),
        )


def _of(name: str, rows: Rows, about: About, found: Answers) -> tuple[Any, ...]:
    """What the picture of a measurement is drawn of: by design, in order."""
    drives = {rows.designs[each.design]: each for each in drives_of(rows, about)}
    mine = {each.design: each for each in found.capability if each.name == name}
    there = [design for design in rows.designs if design in mine]
    made = [each for each in found.sensitivity if each.name == name]
    return [mine[design] for design in there], [drives[design] for design in there], made


def _figure(value: float) -> str:
    return figure(value).replace("-", "−")


def _share(found: Estimate | float | None) -> str:
    """A share, with its interval if it has one."""
    if isinstance(found, Estimate):
        return f"{percent(found.value)} ({span(found, share=True)})"
    return "–" if found is None else percent(found)


def _estimate(found: Estimate | None) -> str:
    """A value, and its interval in brackets."""
    three = [f"{end:.3g}".replace("-", "−") for end in found or ()]
    return "{} ({} … {})".format(*three) if three else "–"


def _about(found: Estimate) -> str:
    """An interval that may be open."""
    return f"{_figure(found.value)} ({span(found).replace('-', '−')})"


def _stacked(text: str) -> str:
    """The interval below the value."""
    return text.replace(" (", "\n(")
