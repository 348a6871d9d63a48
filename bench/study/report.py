"""The answers of a study as one HTML file with its plots in it. Nothing is fetched when it is read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from matplotlib import rc_context
from matplotlib.figure import Figure

from bench.files import check_directory, check_output, write
from bench.report.html import embedded, page
from bench.report.style import save
from bench.study.answers import About, Answers, answer, answers, drives_of, lines, unknown_words
from bench.study.capability import WANTED, Capability, Side
from bench.study.pairs import ValuePair, YieldPair
from bench.study.plots import draw_indices, draw_measurement, draw_pairs, draw_yields
from bench.study.rows import Rows
from bench.study.sensitivity import Index, Sensitivity
from bench.study.statistics import Estimate, figure, percent, span
from bench.study.worst import Worst
from bench.study.yields import Yield

__all__ = ["About", "answer", "answers", "lines", "write_report"]

NAME = "report.html"
PANELS = 12  # measurements with a picture: those with the least room
BARS = 8  # charts of indices in a picture
MOST = 40  # rows of a table, before the rest is folded
LIMITS = (
    "measurement", "limit", "n", "mean", "sd", "seen", "Cpk", "away [sd]", "three sigma", "seen beyond",
    "if normal", f"{100 * WANTED:g} % keep",
)  # fmt: skip
Cells = list[str]


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
    many = len(rows.designs) > 1
    judged = [each for each in found.capability if each.sides]
    # a $ in a name is no mathematics
    with TemporaryDirectory(prefix="hallbench-") as place, rc_context({"text.parse_math": False}):
        picture = Path(place) / "figure.png"

        def drawn(make: Callable[..., Figure], *given: Any) -> str:
            save(make(*given), picture)
            return embedded(picture)

        told = [each for each in found.sensitivity if each.indices and each.design == rows.designs[0]]
        charts = [told[first : first + BARS] for first in range(0, min(len(told), PANELS), BARS)]
        return page(
            __package__ or "",
            "report.html.j2",
            (_minus,),
            about=about,
            found=found,
            many=many,
            yields=[_yield_row(each) for each in found.yields],
            yield_picture=drawn(draw_yields, found.yields, rows.designs) if any(y.share for y in found.yields) else "",
            limits=LIMITS,
            tables=[
                ("", [row for each in judged[:MOST] for row in _limit_rows(each, many)]),
                ("more", [row for each in judged[MOST:] for row in _limit_rows(each, many)]),
                ("without limits", [_plain_row(each, many) for each in found.capability if not each.sides]),
            ],
            few=_few(judged),
            panels=[(words, drawn(draw_measurement, *given)) for words, given in _panels(rows, about, found)],
            charts=[drawn(draw_indices, chart) for chart in charts],
            indices=[row for each in found.sensitivity for row in _index_rows(each, many)],
            total=bool(about.saltelli),
            design=rows.designs[0] if rows.designs else "",
            no_indices=dict.fromkeys(each.why for each in found.sensitivity if each.why),
            worst=[_worst_row(each) for each in found.worst],
            yield_pairs=[_yield_pair_row(each) for each in found.yield_pairs],
            value_pairs=[_value_pair_row(each) for each in found.value_pairs],
            pair_picture=drawn(draw_pairs, shown) if (shown := _comparable(found.value_pairs)) else "",
        )


def _minus(text: str) -> str:
    """With a proper minus sign in the place of the one before a number."""
    return text.replace(" -", " −").replace("(-", "(−") if not text.startswith("-") else "−" + _minus(text[1:])


def _with(found: Estimate | None, form: str = ".3g") -> str:
    """A value, and its interval in brackets."""
    return "–" if found is None else f"{found.value:{form}} ({found.lo:{form}} … {found.hi:{form}})"


def _share(found: Estimate | None) -> str:
    """The same of a share."""
    return "–" if found is None else f"{percent(found.value)} ({span(found, share=True)})"


def _name(found: Capability | Sensitivity, many: bool) -> str:
    return f"{found.name}, {found.design}" if many else found.name


def _yield_row(found: Yield) -> Cells:
    known = found.share
    return [
        found.test, found.design, percent(known.value) if known else "not known",
        span(known, share=True) if known else "", f"{found.passed} of {found.passed + found.failed}",
        unknown_words(found) if found.unknown else "",
    ]  # fmt: skip


def _limit_rows(found: Capability, many: bool) -> list[Cells]:
    return [_limit_row(found, side, many, first=k == 0) for k, side in enumerate(found.sides)]


def _limit_row(found: Capability, side: Side, many: bool, first: bool) -> Cells:
    least, _, most = found.quantiles.values()
    doubt = " (not normal)" if found.not_normal and found.sd else ""
    common = [
        f"{found.n}" + (f", {found.missing} without" if found.missing else ""), figure(found.mean), figure(found.sd),
        f"{figure(least)} … {figure(most)}", _with(found.cpk) + (doubt if found.cpk else ""),
    ]  # fmt: skip
    sign = "≤" if side.side == "hi" else "≥"
    return [
        _name(found, many) if first else "", f"{sign} {figure(side.limit)} {found.unit}".rstrip(),
        *(common if first else [""] * len(common)), _with(side.away), side.three_sigma,
        f"{side.beyond} of {side.n}: {_share(side.share)}", _share(None if found.not_normal else side.by_theory),
        f"{sign} {figure(side.wanted.value)} ({_keep(side)})",
    ]  # fmt: skip


def _keep(side: Side) -> str:
    if side.side == "hi":
        return span(side.wanted)
    turned = Estimate(-side.wanted.value, -side.wanted.hi, -side.wanted.lo)
    if side.too_few:
        return f"at most {figure(-turned.lo)}"
    return span(side.wanted)


def _plain_row(found: Capability, many: bool) -> Cells:
    least, _, most = found.quantiles.values()
    return [
        _name(found, many),
        "",
        f"{found.n}",
        figure(found.mean),
        figure(found.sd),
        f"{figure(least)} … {figure(most)}",
    ]


def _few(judged: Sequence[Capability]) -> str:
    return next((words for each in judged for side in each.sides if (words := side.too_few)), "")


def _panels(rows: Rows, about: About, found: Answers) -> list[tuple[str, tuple[Any, ...]]]:
    """By measurement what its caption says, and what its picture is drawn of."""
    by_design = {rows.designs[drives.design]: drives for drives in drives_of(rows, about)}
    made = []
    for name in list(dict.fromkeys(each.name for each in found.capability))[:PANELS]:
        mine = [each for each in found.capability if each.name == name]
        mine.sort(key=lambda each: rows.designs.index(each.design))
        indices = [each for each in found.sensitivity if each.name == name]
        words = f"{name}: {rows.limits[name].about}" if name in rows.limits and rows.limits[name].about else name
        made.append((words, (mine, [by_design[each.design] for each in mine], indices)))
    return made


def _index_rows(found: Sensitivity, many: bool) -> list[Cells]:
    noise = (
        [[_name(found, many), "noise, from repetition to repetition", _share(found.noise), ""]] if found.noise else []
    )
    return [[_name(found, many), *_index(each)] for each in found.indices if each.matters] + noise


def _index(found: Index) -> Cells:
    return [found.input, _share(found.first), _share(found.total) if found.total else ""]


def _worst_row(found: Worst) -> Cells:
    margin = f"{100.0 * found.share:.3g} %" if abs(found.share) < 1e6 else "beyond" if found.share < 0 else "–"
    unusual = ", ".join(f"{name} {figure(value)} ({away:+.1f} sd)" for name, value, away in found.unusual)
    return [
        found.test, found.design, found.verdict, found.measurement.removeprefix(f"{found.test}."),
        f"{figure(found.value)}, {found.limits}" if found.measurement else "failed by none of its measurements",
        margin, unusual, found.replay,
    ]  # fmt: skip


def _yield_pair_row(found: YieldPair) -> Cells:
    return [found.test, found.b, found.verdict, f"{found.only_a}", f"{found.only_b}", f"{found.n}", f"{found.p:.2g}"]


def _value_pair_row(found: ValuePair) -> Cells:
    better = _share(found.better)
    return [found.name, found.b, found.verdict, better, _with(found.spread), f"{found.n}", f"{found.p:.2g}"]


def _comparable(pairs: Sequence[ValuePair]) -> list[ValuePair]:
    """The pairs to draw: of the first measurements, that vary."""
    names = list(dict.fromkeys(pair.name for pair in pairs if pair.sd_of_a > 0.0))[: 2 * PANELS]
    return [pair for pair in pairs if pair.name in names and pair.sd_of_a > 0.0]
