"""The scoreboard as one HTML file with its plots in it. Nothing is fetched when it is read."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from matplotlib import rc_context
from matplotlib.figure import Figure

from bench.report.html import embedded, page
from bench.report.style import save
from bench.report.words import date, number
from bench.score.board import PHASES, Figures, Scoreboard, partly
from bench.score.plots import draw_error_by_angle, draw_error_by_speed, draw_error_over_time, speeds
from bench.score.table import HEADERS, legend, row
from bench.score.tracks import Track
from protocol.text import printable

COLUMNS = ("n", "bias", "std", "rms", "max", "p99")
NAMES = {
    "moving": "all motion",
    "error": "steady",
    "transient": "transients",
    "start_up": "start-up",
    "reversal": "reversal",
    "speed": "speed, steady [r/min]",
}

SAID = {
    "name": "", "serial": "serial number ", "firmware": "firmware ", "motor": "motor: ", "station": "station: ",
    "operator": "operator: ",
}  # fmt: skip
"""Of a recording's identity, in this order, each behind what it is."""


def as_html(board: Scoreboard) -> str:
    """The page."""
    # a $ in the name of an observer is no mathematics
    with TemporaryDirectory(prefix="hallbench-") as folder, rc_context({"text.parse_math": False}):
        picture = Path(folder) / "figure.png"
        observers = [
            {
                "name": name,
                "figures": figures,
                "groups": [(NAMES[key], figures[key]) for key in (*PHASES, "speed")],
                "partly": partly(figures, board.tracks),
                "by_speed": [(speeds(bin), figures["by_speed"][bin]) for bin in figures["by_speed"]],
                "costs": _costs(figures),
                "over_time": [
                    (Path(track.path).name, _embedded(draw_error_over_time(track, name), picture))
                    for track in board.tracks
                    if name in track.kinds and track.stretches
                ],
                "by_angle": _embedded(draw_error_by_angle(board.tracks, name), picture),
            }
            for name, figures in board.pooled.items()
        ]
        return page(
            __package__ or "",
            "report.html.j2",
            (_figure,),
            board=board,
            headers=HEADERS,
            columns=COLUMNS,
            legend=" ".join(legend(board)),
            rows=[_row(name, figures) for name, figures in board.pooled.items()],
            partly={name: partly(figures, board.tracks) for name, figures in board.pooled.items()},
            files=[
                (track.path, _provenance(track), [_row(name, f) for name, f in board.by_file[track.path].items()])
                for track in board.tracks
            ],
            by_speed=_embedded(draw_error_by_speed(board.pooled, board.noun), picture),
            observers=observers,
        )


def _row(name: str, figures: Figures) -> list[str]:
    _, *numbers = row(name, figures)
    return [name, *(number.replace("-", "−") for number in numbers)]


def _provenance(track: Track) -> str:
    """What was recorded, where and when, and what of it counts."""
    said = {key: printable(str(track.identity.get(key) or "")) for key in SAID}
    about = "".join(f"{words}{said[key]}; " for key, words in SAID.items() if said[key])
    began = sum(n for why, n in track.restarts.items() if why.startswith("lost"))
    by = f" by hallbench {track.recorded_by}" if track.recorded_by else ""
    return (
        f"{about}{date(track.started)}{by}; "
        f"{track.samples} samples, {track.samples / track.rate:.1f} s at {track.rate:g} Hz; "
        f"{track.lost} lost, {track.dropped + track.unknown} not scored, observers restarted {began} times"
    )


def _costs(figures: Figures) -> str:
    """Lags and cost in words; undefined values are omitted."""
    known = (
        ("the angle {} by {} µs", figures["lag"]["angle_us"]),
        ("the speed {} by {} µs", figures["lag"]["speed_us"]),
        ("a step takes {1} ns on this machine", figures["step_ns"]),
    )
    words = "; ".join(
        text.format("leads" if value < 0 else "lags", _rounded(abs(value)))
        for text, value in known
        if value is not None
    )
    return words.capitalize() if words else ""


def _rounded(value: float) -> str:
    """Three digits, without an exponent."""
    return f"{float(f'{value:.3g}'):.10g}"


def _embedded(figure: Figure, picture: Path) -> str:
    save(figure, picture)
    return embedded(picture)


def _figure(value: float | int | None) -> str:
    return f"{value}" if isinstance(value, int) else number(value, ".3f").replace("-", "−")
