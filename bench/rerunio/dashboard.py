"""The views of a run, as a rerun blueprint.

Left, the last half minute (bands from minima and maxima); in the middle, every sample of the last moments; right, the
stator plane, losses and logs. The same blueprint serves the live view and the file. A view that the run's channels
cannot fill is left out. Nothing here logs data.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

from bench.analysis.colours import GROUND
from bench.recording.info import Mark, RunInfo, ns_from_tick
from bench.rerunio import schema
from bench.rerunio.plane import X_RANGE, Y_RANGE, Plane
from bench.rerunio.plots import TREND, Line, Plot, plots

HALL = 0.1  # seconds that the Hall view shows
HALL_QUERIED = 0.3  # of which it is told, for the code that its first moments begin with
LEGEND_SHARE = 0.27  # of a plot's width, left free of data for its legend
ROWS, MOST_ROWS = 3, 5  # of plots in a column: beside plots that the vocabulary knows, and without any
WIDTH = 1.5  # of a line, in points
COARSE = 10.0  # s that plots of samples show where there are only minima and maxima

Span = tuple[rrb.TimeRangeBoundary, rrb.TimeRangeBoundary]


def blueprint(
    run: RunInfo, marks: Sequence[Mark] = (), whole: tuple[int, int] | None = None, coarse: bool = False
) -> rrb.Blueprint:
    """The dashboard of a run; with `marks`, those of an acceptance run over its whole length below the rest.

    `whole`: first and last tick of a recorded run, which the long plots show all of; `coarse`: where samples are mostly
    left out, so that the others show more than the last moments.
    """
    found = plots(run)
    if whole is not None:
        found = {key: _of_all(plot, coarse) for key, plot in found.items()}
    trend = None if whole is None else _ticks(run, *whole)
    states = _lanes(
        f"Drive, last {TREND:g} s" if trend is None else "Drive", schema.DRIVE,
        trend or _span(TREND), trend or _span(TREND / (1 - LEGEND_SHARE)),
    )  # fmt: skip
    hall = _lanes(
        f"Hall sensors a, b, c and sector, last {HALL:g} s", schema.HALL_LANES, _span(HALL_QUERIED), _span(HALL)
    )
    trends = _rows([plot for plot in found.values() if plot.entity == schema.TREND], trend)
    waves = _rows([plot for plot in found.values() if plot.entity == schema.FAST])
    columns = [_column(trends, [states]), _column(waves, [hall] if run.hall else []), _texts(Plane(run).contents)]
    shares = [5, 5, 4.4]
    views: rrb.Container = rrb.Horizontal(
        *(column for column in columns if column),
        column_shares=[share for share, column in zip(shares, columns, strict=True) if column],
    )
    if marks:
        views = rrb.Vertical(views, _marked(run, marks), row_shares=[8, 1])
    return rrb.Blueprint(
        views,
        rrb.TopPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=schema.TIMELINE, play_state="following"),
    )


def _of_all(plot: Plot, coarse: bool) -> Plot:
    """A plot of a recorded run: what is long shows all of it."""
    if plot.entity == schema.TREND:
        return replace(plot, name=plot.name.rpartition(", last")[0])
    if coarse:
        return replace(plot, name=f"{plot.name.rpartition(', last')[0]}, last {COARSE:g} s", seconds=COARSE)
    return plot


def _rows(found: Sequence[Plot], whole: Span | None = None) -> list[rrb.View | rrb.Container]:
    """A column's plots from top to bottom; those for which there is no room share the last place, as tabs."""
    known = sum(not plot.by_unit for plot in found)
    room = max(ROWS, MOST_ROWS - known)
    views: list[rrb.View | rrb.Container] = [_view(plot, whole) for plot in found]
    return views if len(views) <= room else [*views[: room - 1], rrb.Tabs(*views[room - 1 :], active_tab=0)]


def _column(rows: Sequence[rrb.View | rrb.Container], lanes: Sequence[rrb.View]) -> rrb.Container | None:
    """Plots, and below them timelines of states; None without either."""
    shares = [3.0] * len(rows) + [2.5] * len(lanes)
    return rrb.Vertical(*rows, *lanes, row_shares=shares) if shares else None


def _texts(stator: str) -> rrb.Container:
    """The column of the stator plane, left out where `stator`, what it shows, is empty, and of the texts."""
    losses = rrb.TextDocumentView(name="Losses [counts]", origin=f"/{schema.HEALTH_TEXT}")
    log = rrb.TextLogView(
        name="Log",
        origin="/log",
        contents=["/log/**"],
        columns=rrb.TextLogColumns(timeline_columns=[schema.TIMELINE], text_log_columns=["loglevel", "body"]),
    )
    summary = rrb.TextDocumentView(name="Run and summary", origin=f"/{schema.SUMMARY}")
    if not stator:
        return rrb.Vertical(losses, log, summary, row_shares=[2.6, 3.9, 5])
    plane = rrb.Spatial2DView(
        name=f"Stator plane: {stator}",
        origin="/stator",
        contents=["/stator/**"],
        background=GROUND,
        visual_bounds=rrb.VisualBounds2D(x_range=X_RANGE, y_range=Y_RANGE),
    )
    return rrb.Vertical(plane, losses, rrb.Tabs(log, summary, name="Texts"), row_shares=[5, 2.6, 3.9])


def _marked(run: RunInfo, marks: Sequence[Mark]) -> rrb.StateTimelineView:
    span = _ticks(run, min(mark.first_tick for mark in marks), max(mark.last_tick for mark in marks))
    return _lanes("Marks", schema.ACCEPTANCE, span, span)


def _lanes(name: str, entity: str, queried: Span, shown: Span) -> rrb.StateTimelineView:
    return rrb.StateTimelineView(
        name=name, origin="/", contents=[f"/{entity}"], time_ranges=_queried(queried), time_view=_shown(shown)
    )


def _view(plot: Plot, whole: Span | None) -> rrb.TimeSeriesView:
    """A plot of the last moments, or of the span `whole`."""
    shown = whole or _span(plot.seconds / (1 - LEGEND_SHARE))
    return time_series(plot, {plot.entity: plot.lines}, whole or _span(plot.seconds), shown)


def time_series(plot: Plot, lines: Mapping[str, Sequence[Line]], queried: Span, shown: Span) -> rrb.TimeSeriesView:
    """A view with the name and range of `plot`, of `lines` by entity, over the time `shown`."""
    return rrb.TimeSeriesView(
        name=plot.name,
        origin="/",
        contents=[f"/{entity}" for entity in lines],
        overrides={entity: [_series(line) for line in its] for entity, its in lines.items()},
        axis_y=rrb.ScalarAxis(range=plot.y_range) if plot.y_range else None,
        background=rrb.archetypes.PlotBackground(color=GROUND, show_grid=True),
        plot_legend=rrb.PlotLegend(visible=True, corner=rrb.Corner2D.LeftTop),
        time_ranges=_queried(queried),
        axis_x=_shown(shown),
    )


def _series(line: Line) -> rrb.Visualizer:
    return rr.SeriesLines(names=line.name, colors=line.colour, widths=WIDTH, aggregation_policy="MinMax").visualizer(
        mappings=[
            VisualizerComponentMapping(
                target="Scalars:scalars",
                source_kind=ComponentSourceKind.SourceComponent,
                source_component=line.component,
            )
        ]
    )


def _ticks(run: RunInfo, first: int, last: int) -> Span:
    """From one device tick to another."""
    start, end = (
        rrb.TimeRangeBoundary.absolute(seconds=float(ns_from_tick(tick, run.tick_hz)) / 1e9) for tick in (first, last)
    )
    return start, end


def _span(seconds: float) -> Span:
    """The last `seconds` up to the cursor."""
    return rrb.TimeRangeBoundary.cursor_relative(seconds=-seconds), rrb.TimeRangeBoundary.cursor_relative()


def _queried(span: Span) -> rrb.VisibleTimeRange:
    return rrb.VisibleTimeRange(schema.TIMELINE, start=span[0], end=span[1])


def _shown(span: Span) -> rrb.TimeAxis:
    return rrb.TimeAxis(view_range=rr.TimeRange(start=span[0], end=span[1]))
