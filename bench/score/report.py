"""Writes the scoreboard as one HTML file with its figures in it. Nothing is fetched when it is read."""

from __future__ import annotations

import base64
from pathlib import Path
from tempfile import TemporaryDirectory

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from bench.acceptance.style import save
from bench.errors import BenchError
from bench.score.board import PHASES, Scoreboard
from bench.score.plots import draw_error_by_angle, draw_error_by_speed, draw_error_over_time
from bench.score.table import HEADERS, LEGEND, row

COLUMNS = ("n", "bias", "std", "rms", "max", "p99")
NAMES = {
    "moving": "all motion",
    "error": "steady",
    "transient": "transients",
    "start_up": "start-up",
    "reversal": "reversal",
    "speed": "speed, steady [r/min]",
}


def write_report(board: Scoreboard, path: Path) -> None:
    """Write `path`. Raises BenchError where that fails."""
    first = board.tracks[0]
    with TemporaryDirectory(prefix="hallbench-") as folder:
        picture = Path(folder) / "figure.png"
        observers = [
            {
                "name": name,
                "figures": figures,
                "groups": [(NAMES[key], figures[key]) for key in (*PHASES, "speed")],
                "pictures": [
                    *([_embedded(draw_error_over_time(first, name), picture)] if name in first.kinds else []),
                    _embedded(draw_error_by_angle(board.tracks, name), picture),
                ],
            }
            for name, figures in board.pooled.items()
        ]
        page = (
            _environment()
            .get_template("report.html.j2")
            .render(
                board=board,
                headers=HEADERS,
                columns=COLUMNS,
                legend=" ".join(LEGEND),
                rows=[row(name, figures) for name, figures in board.pooled.items()],
                files={
                    file: [row(name, figures) for name, figures in found.items()]
                    for file, found in board.by_file.items()
                },
                by_speed=_embedded(draw_error_by_speed(board.pooled), picture),
                observers=observers,
            )
        )
    try:
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise BenchError(f"--html {path} cannot be written: {error.strerror}") from None


def _embedded(figure: Figure, picture: Path) -> str:
    save(figure, picture)
    return "data:image/png;base64," + base64.b64encode(picture.read_bytes()).decode("ascii")


def _figure(value: float | int | None) -> str:
    if value is None:
        return "–"
    return f"{value}" if isinstance(value, int) else f"{value:.3f}".replace("-", "−")


def _environment() -> Environment:
    environment = Environment(
        loader=ChoiceLoader([PackageLoader("bench.score", ""), PackageLoader("bench.acceptance.report", "")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["figure"] = _figure
    return environment
