"""The views of a run, as a rerun blueprint.

Left, the last half minute (bands from minima and maxima); in the middle, every sample of the last moments; right, the
stator plane, the state of drive and telemetry, losses and logs. The same blueprint serves the live view and the file.
Views exist only for channels that are streamed. Nothing here logs data.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

from bench.rerunio import plane, schema

TREND, WAVE, HALL = 25.0, 0.2, 0.1  # seconds that the views show
ERROR_RANGE = (-32.0, 32.0)  # degrees: the start from an unknown position in a sector errs by up to 30
DARK = (14, 16, 17)  # what the colours are made for, also in a light theme
LEGEND_SHARE = 0.27  # of a plot's width, left free of data for its legend


@dataclass(frozen=True)
class Line:
    """One line of a plot: where its numbers are, what it is called, its colour."""

    component: str
    name: str
    colour: tuple[int, int, int]
    width: float = 1.5


@dataclass(frozen=True)
class Plot:
    """A time series plot of lines of one entity."""

    name: str
    entity: str
    lines: tuple[Line, ...]
    seconds: float
    y_range: tuple[float, float] | None = None


def plots(run: schema.RunInfo) -> dict[str, Plot]:
    """The plots that the run's channels allow, by key, with what each of them shows."""
    estimates = run.position_estimates if run.position_reference else ()
    errors = tuple(Line(schema.error_component(n), f"{schema.label(n)} [°]", schema.colour(n)) for n in estimates)
    mechanical = run.n_p is not None
    speeds = [
        Line(schema.speed_component(n, mechanical), f"{schema.label(n)} [r/min]", schema.colour(n)) for n in run.speeds
    ]
    if run.has(schema.SPEED_REFERENCE):
        component = schema.mean_component(schema.speed_component(schema.SPEED_REFERENCE, mechanical))
        speeds.append(Line(component, "reference, mean [r/min]", schema.colour(schema.SPEED_REFERENCE)))
    currents = [Line(schema.value_component(n), f"{n} [A]", schema.colour(n)) for n in schema.DQ_CURRENTS if run.has(n)]
    currents += [
        Line(schema.mean_component(schema.value_component(n)), f"{schema.label(n)}, mean [A]", schema.colour(n))
        for n in schema.DQ_REFERENCES
        if run.has(n)
    ]
    angles = [n for n in (run.position_reference, *run.position_estimates) if n]
    amperes = 1.08 * plane.nice_ceiling(run.i_max)
    kind = "mechanical" if mechanical else "electrical"
    last, now = f"last {TREND:g} s", f"last {WAVE:g} s"
    found = {
        "error_trend": Plot(
            f"Position error, electrical [°], min/max, {last}", schema.TREND, errors, TREND, ERROR_RANGE
        ),
        "speed": Plot(f"Speed, {kind} [r/min], min/max, {last}", schema.TREND, tuple(speeds), TREND),
        "dq": Plot(f"d/q currents [A], min/max, {last}", schema.TREND, tuple(currents), TREND),
        "position": Plot(
            f"Rotor position, electrical [rad], {now}",
            schema.FAST,
            _values(run, angles, "rad"),
            WAVE,
            (-3.3, 3.3),
        ),
        "error": Plot(f"Position error, electrical [°], {now}", schema.FAST, errors, WAVE, ERROR_RANGE),
        "phases": Plot(
            f"Phase currents [A], {now}",
            schema.FAST,
            _values(run, ("i_a", "i_b", "i_c"), "A"),
            WAVE,
            (-amperes, amperes),
        ),
    }
    return {key: plot for key, plot in found.items() if plot.lines}


def blueprint(run: schema.RunInfo, marks: Sequence[schema.Mark] = ()) -> rrb.Blueprint:
    """The dashboard of a run; with `marks`, those of an acceptance run over its whole length below the rest."""
    found = {key: _view(plot) for key, plot in plots(run).items()}
    last = f"last {TREND:g} s"
    states = rrb.StateTimelineView(
        name=f"Drive, {last}",
        origin="/",
        contents=[f"/{schema.DRIVE}"],
        time_ranges=_queried(TREND),
        time_view=_shown(TREND),
    )
    hall = rrb.StateTimelineView(
        name=f"Hall sensors a, b, c and sector, last {HALL:g} s",
        origin="/",
        contents=[f"/{schema.HALL}"],
        time_ranges=_queried(HALL),
        time_view=_shown(HALL, legend=False),
    )
    stator = rrb.Spatial2DView(
        name="Stator plane: rotor axes, current [A], voltage and back-EMF [V]",
        origin="/stator",
        contents=["/stator/**"],
        background=DARK,
        visual_bounds=rrb.VisualBounds2D(x_range=plane.X_RANGE, y_range=plane.Y_RANGE),
    )
    losses = rrb.TextDocumentView(name="Losses [counts]", origin=f"/{schema.HEALTH_TEXT}")
    texts = rrb.Tabs(
        rrb.TextLogView(
            name="Log",
            origin="/log",
            contents=["/log/**"],
            columns=rrb.TextLogColumns(timeline_columns=[schema.TIMELINE], text_log_columns=["loglevel", "body"]),
        ),
        rrb.TextDocumentView(name="Run and summary", origin=f"/{schema.SUMMARY}"),
        name="Texts",
    )
    left = [found[key] for key in ("error_trend", "speed", "dq") if key in found]
    middle = [found[key] for key in ("position", "error", "phases") if key in found]
    views: rrb.Container = rrb.Horizontal(
        rrb.Vertical(*left, states, row_shares=[3] * len(left) + [2.5]),
        rrb.Vertical(*middle, hall, row_shares=[3] * len(middle) + [2.5]),
        rrb.Vertical(stator, losses, texts, row_shares=[5, 2.6, 3.9]),
        column_shares=[5, 5, 4.4],
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


def _marked(run: schema.RunInfo, marks: Sequence[schema.Mark]) -> rrb.StateTimelineView:
    ends = [min(mark.first_tick for mark in marks), max(mark.last_tick for mark in marks)]
    start, end = (
        rrb.TimeRangeBoundary.absolute(seconds=float(schema.ns_from_tick(tick, run.tick_hz)) / 1e9) for tick in ends
    )
    return rrb.StateTimelineView(
        name="Acceptance, all that was measured",
        origin="/",
        contents=[f"/{schema.ACCEPTANCE}"],
        time_ranges=rrb.VisibleTimeRange(schema.TIMELINE, start=start, end=end),
        time_view=rrb.TimeAxis(view_range=rr.TimeRange(start=start, end=end)),
    )


def _values(run: schema.RunInfo, names: Iterable[str], unit: str) -> tuple[Line, ...]:
    return tuple(
        Line(schema.value_component(name), f"{schema.label(name)} [{unit}]", schema.colour(name))
        for name in names
        if run.has(name)
    )


def _view(plot: Plot) -> rrb.TimeSeriesView:
    lines = [
        rr.SeriesLines(names=line.name, colors=line.colour, widths=line.width, aggregation_policy="MinMax").visualizer(
            mappings=[
                VisualizerComponentMapping(
                    target="Scalars:scalars",
                    source_kind=ComponentSourceKind.SourceComponent,
                    source_component=line.component,
                )
            ]
        )
        for line in plot.lines
    ]
    return rrb.TimeSeriesView(
        name=plot.name,
        origin="/",
        contents=[f"/{plot.entity}"],
        overrides={plot.entity: lines},
        axis_y=rrb.ScalarAxis(range=plot.y_range) if plot.y_range else None,
        background=rrb.archetypes.PlotBackground(color=DARK, show_grid=True),
        plot_legend=rrb.PlotLegend(visible=True, corner=rrb.Corner2D.LeftTop),
        time_ranges=_queried(plot.seconds),
        axis_x=_shown(plot.seconds),
    )


def _span(seconds: float) -> tuple[rrb.TimeRangeBoundary, rrb.TimeRangeBoundary]:
    return rrb.TimeRangeBoundary.cursor_relative(seconds=-seconds), rrb.TimeRangeBoundary.cursor_relative()


def _queried(seconds: float) -> rrb.VisibleTimeRange:
    start, end = _span(seconds)
    return rrb.VisibleTimeRange(schema.TIMELINE, start=start, end=end)


def _shown(seconds: float, legend: bool = True) -> rrb.TimeAxis:
    start, end = _span(seconds / (1 - LEGEND_SHARE) if legend else seconds)
    return rrb.TimeAxis(view_range=rr.TimeRange(start=start, end=end))
