"""The views of a run, as a rerun blueprint.

First page: left, the last half minute (bands from minima and maxima); in the middle, the last electrical
revolution; right, the stator plane, the run in words and its log. Second page: what the last second comes to. The same
blueprint serves the live view and the file, which has a third page: every sample of the last moments. A view that the
run's channels cannot fill is left out. Nothing here logs data.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

from bench.record.info import Mark, RunInfo, ns_from_tick
from bench.signal.colours import BAD, GROUND
from bench.view import last_second, plane, schema, scope_picture
from bench.view.extent import Extent
from bench.view.last_second import LastSecond
from bench.view.plane import Plane
from bench.view.plots import LEGEND_SHARE, TREND, WAVE, Line, Plot, plots, returns
from bench.view.scope import scopes
from bench.view.states import drive_entity

HALL = 0.1  # seconds that the Hall view shows
HALL_QUERIED = 0.2  # more of which it is told, for the code that its first moments begin with
SECTORS_SHOWN = 15  # in the Hall view, if the speed is known: so that each has room for its name
LEAST_HALL, MOST_HALL = 0.005, 2.0  # s
ROWS, MOST_ROWS = 3, 5  # of plots in a column: beside plots that the vocabulary knows, and without any
WIDTH, MARK = 1.5, 3.0  # of a line and a mark, in points
COARSE = 10.0  # s that plots of samples show where there are only minima and maxima

SECOND_NAMES = {
    schema.BY_ANGLE: "Mean error over electrical angle [°]",
    schema.HARMONICS: "Current harmonics 2 to 20 [%]",
    schema.LATE: "Hall edges late by [°], sectors 1 to 6",
}

Span = tuple[rrb.TimeRangeBoundary, rrb.TimeRangeBoundary]
Shown = rrb.View | rrb.Container


def blueprint(
    run: RunInfo,
    marks: Sequence[Mark] = (),
    whole: tuple[int, int] | None = None,
    close: float = WAVE,
    coarse: bool = False,
    sector: float | None = None,
    extents: Mapping[str, Extent] | None = None,
    page: int = 0,
) -> rrb.Blueprint:
    """The dashboard of a run; with `marks`, those of an acceptance run over its whole length below the rest.

    `whole`: first and last tick of a recorded run, which the long plots show all of; `close`: how much of it the others
    show, s; `coarse`: where samples are mostly left out, so that those show more than the last moments. `sector`: how
    long a sector lasts, s, where the speed is known; `extents`: how far the long plots reach, by their key, where that
    is known; `page`: the one that it opens at, from 0.
    """
    found = plots(run)
    if whole is not None:
        found = {
            key: _of_all(plot, COARSE if coarse else close, (extents or {}).get(key)) for key, plot in found.items()
        }
    trend = None if whole is None else _ticks(run, *whole)
    states = lanes(
        f"Drive, last {TREND:g} s" if whole is None else "Drive", drive_entity(run),
        trend or _span(TREND), None if whole is None else _wide(run, *whole),
    )  # fmt: skip
    second_page = _last_second(run, found, whole)
    apart = {"bus"} if second_page else set()
    trends = [plot for key, plot in found.items() if plot.entity == schema.TREND and key not in apart]
    columns = [
        _column(_rows(trends, run, whole), [states], 2.7 / 3.0),
        _column(_revolutions(run), _returns(run, whole) if run.hall else [], 0.22),
        _texts(Plane(run).contents),
    ]
    shares = [5, 5, 4.4]
    views: rrb.Container = rrb.Horizontal(
        *(column for column in columns if column),
        column_shares=[share for share, column in zip(shares, columns, strict=True) if column],
        name="Run",
    )
    if marks:
        views = rrb.Vertical(views, _marked(run, marks), row_shares=[8, 1], name="Run")
    samples = None if whole is None else _samples(run, found, coarse, sector)
    pages = [page for page in (views, second_page, samples) if page]
    return without_panels(rrb.Tabs(*pages, active_tab=page) if len(pages) > 1 else views, play_state="following")


def without_panels(views: Shown, **time: Any) -> rrb.Blueprint:
    """Views without the viewer's panels, but for the time line; `time`: what that is told besides."""
    hidden = (panel(state="hidden") for panel in (rrb.TopPanel, rrb.BlueprintPanel, rrb.SelectionPanel))
    return rrb.Blueprint(views, *hidden, rrb.TimePanel(state="collapsed", timeline=schema.TIMELINE, **time))


def _of_all(plot: Plot, close: float, extent: Extent | None) -> Plot:
    """A plot of a recorded run: what is long shows all of it, and says how far it goes."""
    if plot.entity == schema.TREND:
        name = plot.name.rpartition(", min/max, last")[0]
        if extent is None:
            return replace(plot, name=name)
        return replace(plot, name=f"{name}, {extent.words}", y_range=extent.shown or plot.y_range,
                       marked=extent.shown is not None)  # fmt: skip
    return replace(plot, name=f"{plot.title}, last {close:.2g} s", seconds=close)


def _rows(found: Sequence[Plot], run: RunInfo, whole: tuple[int, int] | None) -> list[Shown]:
    """A column's plots from top to bottom; those for which there is no room share the last place, as tabs."""
    known = sum(not plot.by_unit for plot in found)
    room = max(ROWS, MOST_ROWS - known)
    views: list[Shown] = [_view(plot, run, whole) for plot in found]
    return views if len(views) <= room else [*views[: room - 1], rrb.Tabs(*views[room - 1 :], active_tab=0)]


def _revolutions(run: RunInfo) -> list[Shown]:
    """The last revolution: one view, or several as tabs."""
    views = []
    for k, (entity, lanes) in enumerate(scopes(run).items()):
        name = f"Last electrical revolution, more {k}" if k else "Last electrical revolution"
        views.append(_plane(name, entity, scope_picture.X_RANGE, scope_picture.y_range(len(lanes))))
    return [*views] if len(views) < 2 else [rrb.Tabs(*views, active_tab=0)]


def _samples(run: RunInfo, found: Mapping[str, Plot], coarse: bool, sector: float | None) -> rrb.Container | None:
    """The third page of a recording: its last moments over time, sample by sample; None where there is nothing."""
    views: list[rrb.View] = [_view(plot, run, None) for plot in found.values() if plot.entity == schema.FAST]
    if run.hall:
        seconds = HALL if sector is None else min(MOST_HALL, max(LEAST_HALL, SECTORS_SHOWN * sector))
        name = f"Hall sensors and sector, last {seconds:.2g} s{', where there are samples' if coarse else ''}"
        views.append(lanes(name, schema.HALL_LANES, _span(seconds + HALL_QUERIED), _span(seconds)))
    return rrb.Grid(*views, grid_columns=min(3, len(views)), name="Samples") if views else None


def _returns(run: RunInfo, whole: tuple[int, int] | None) -> list[rrb.Container]:
    """Bounces and pulses of the Hall sensors, side by side: there is room for legends of three lines."""
    queried, shown = (_span(TREND), _span(TREND)) if whole is None else (_ticks(run, *whole), _wide(run, *whole))
    views = [time_series(plot, {plot.entity: plot.lines}, queried, shown) for plot in returns(run)]
    return [rrb.Horizontal(*views)] if views else []


def _column(rows: Sequence[Shown], lanes: Sequence[Shown], share: float) -> rrb.Container | None:
    """Views, and below them lanes or counts, of which each is `share` times as high as one of them; None without."""
    shares = [1.0] * len(rows) + [share] * len(lanes)
    return rrb.Vertical(*rows, *lanes, row_shares=shares) if shares else None


def _texts(stator: str) -> rrb.Container:
    """The column of the stator plane, left out where `stator`, what it shows, is empty, and of the texts."""
    log = rrb.TextLogView(
        name="Log",
        origin="/log",
        contents=["/log/**"],
        columns=rrb.TextLogColumns(timeline_columns=[schema.TIMELINE], text_log_columns=["loglevel", "body"]),
    )
    words = rrb.TextDocumentView(name="Losses; summary at the end", origin=f"/{schema.RUN_TEXT}")
    if not stator:
        return rrb.Vertical(words, log, row_shares=[6, 5])
    view = _plane("Stator plane", "stator", plane.X_RANGE, plane.Y_RANGE)
    return rrb.Vertical(view, words, log, row_shares=[4.4, 4, 3.1])


def _plane(name: str, entity: str, x: tuple[float, float], y: tuple[float, float]) -> rrb.Spatial2DView:
    """Vectors below an entity, from and to these places on either axis."""
    bounds = rrb.VisualBounds2D(x_range=x, y_range=y)
    return rrb.Spatial2DView(
        name=name, origin=f"/{entity}", contents=[f"/{entity}/**"], background=GROUND, visual_bounds=bounds
    )


def _last_second(run: RunInfo, found: Mapping[str, Plot], whole: tuple[int, int] | None) -> rrb.Container | None:
    """The second page: what the last second comes to, and the DC link; None where there is nothing of it."""
    made = LastSecond(run).views
    if not made:
        return None
    views: list[rrb.View] = [_of_second(view) for view in made]
    if "bus" in found:
        views.append(_view(found["bus"], run, whole))
    views.append(rrb.TextDocumentView(name="In numbers", origin=f"/{schema.NUMBERS}"))
    return rrb.Grid(*views, grid_columns=min(3, len(views)), name="Last second")


def _of_second(view: str) -> rrb.View:
    if view == schema.DQ:
        return _plane("Current vector, last 0.2 s", schema.DQ, last_second.X_RANGE, last_second.Y_RANGE)
    return rrb.BarChartView(
        name=SECOND_NAMES[view],
        origin=f"/{view}",
        contents=[f"/{view}/**"],
        background=rrb.archetypes.PlotBackground(color=GROUND, show_grid=True),
        plot_legend=rrb.PlotLegend(visible=True, corner=rrb.Corner2D.RightTop),
    )


def _marked(run: RunInfo, marks: Sequence[Mark]) -> rrb.StateTimelineView:
    span = _ticks(run, min(mark.first_tick for mark in marks), max(mark.last_tick for mark in marks))
    return lanes("Marks", schema.ACCEPTANCE, span, span)


def lanes(name: str, entity: str, queried: Span, shown: Span | None) -> rrb.StateTimelineView:
    """Timelines of states over the time `shown`, or over all of what there is of `queried`."""
    return rrb.StateTimelineView(
        name=name, origin="/", contents=[f"/{entity}"],
        time_ranges=_queried(queried), time_view=None if shown is None else _shown(shown),
    )  # fmt: skip


def _view(plot: Plot, run: RunInfo, whole: tuple[int, int] | None) -> rrb.TimeSeriesView:
    """A plot of the last moments, or of the ticks `whole`.

    A live plot of the last half minute shows what there is of it, beside the room that its guide makes for the legend.
    """
    queried, shown = _span(plot.seconds), _span(plot.seconds / (1 - LEGEND_SHARE))
    if plot.entity == schema.FAST:
        return time_series(plot, {plot.entity: plot.lines} | _guide(plot, schema.GUIDE), queried, shown)
    lines = {plot.entity: plot.lines} | _guide(plot, schema.ROOM)
    if plot.marked:
        lines[schema.BEYOND] = (replace(plot.lines[0], component=plot.beyond, name="beyond", colour=BAD, points=True),)
    if whole is None:
        return time_series(plot, lines, shown, None)
    return time_series(plot, lines, _ticks(run, *whole), _wide(run, *whole))


def _guide(plot: Plot, entity: str) -> dict[str, Sequence[Line]]:
    """The line that makes room in a plot and is not seen: it bears the name of another, so that the legend has one."""
    first = plot.lines[0]
    unseen = replace(first, component=plot.guide, unseen=True)
    return {entity: (unseen,)} if plot.least or entity == schema.ROOM else {}


def time_series(
    plot: Plot, lines: Mapping[str, Sequence[Line]], queried: Span, shown: Span | None
) -> rrb.TimeSeriesView:
    """A view with the name and range of `plot`, of `lines` by entity, over the time `shown`, or all of `queried`."""
    return rrb.TimeSeriesView(
        name=plot.name,
        origin="/",
        contents=[f"/{entity}" for entity in lines],
        overrides={entity: [_series(line) for line in its] for entity, its in lines.items()},
        axis_y=rrb.ScalarAxis(range=plot.y_range) if plot.y_range else None,
        background=rrb.archetypes.PlotBackground(color=GROUND, show_grid=True),
        plot_legend=rrb.PlotLegend(visible=True, corner=rrb.Corner2D.LeftTop),
        time_ranges=_queried(queried),
        axis_x=None if shown is None else _shown(shown),
    )


def _series(line: Line) -> rrb.Visualizer:
    colour = (*line.colour, 0) if line.unseen else line.colour
    looks: rr.SeriesLines | rr.SeriesPoints
    if line.points:
        looks = rr.SeriesPoints(names=line.name, colors=colour, markers="cross", marker_sizes=MARK)
    else:
        looks = rr.SeriesLines(names=line.name, colors=colour, widths=WIDTH, aggregation_policy="MinMax")
    return looks.visualizer(
        mappings=[
            VisualizerComponentMapping(
                target="Scalars:scalars",
                source_kind=ComponentSourceKind.SourceComponent,
                source_component=line.component,
            )
        ]
    )


def _wide(run: RunInfo, first: int, last: int) -> Span:
    """From one device tick to another, with room for a legend before."""
    return _ticks(run, first - round((last - first) * LEGEND_SHARE / (1 - LEGEND_SHARE)), last)


def _ticks(run: RunInfo, first: int, last: int) -> Span:
    """From one device tick to another."""
    return absolute(*(float(ns_from_tick(tick, run.tick_hz)) / 1e9 for tick in (first, last)))


def absolute(first: float, last: float) -> Span:
    """From one time to another, s."""
    return rrb.TimeRangeBoundary.absolute(seconds=first), rrb.TimeRangeBoundary.absolute(seconds=last)


def _span(seconds: float) -> Span:
    """The last `seconds` up to the cursor."""
    return rrb.TimeRangeBoundary.cursor_relative(seconds=-seconds), rrb.TimeRangeBoundary.cursor_relative()


def _queried(span: Span) -> rrb.VisibleTimeRange:
    return rrb.VisibleTimeRange(schema.TIMELINE, start=span[0], end=span[1])


def _shown(span: Span) -> rrb.TimeAxis:
    return rrb.TimeAxis(view_range=rr.TimeRange(start=span[0], end=span[1]))
