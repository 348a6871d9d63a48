"""The views of a capture out of the drive's memory: all of it, sample by sample, by unit, its trigger at time 0."""

from __future__ import annotations

import rerun.blueprint as rrb

from bench.record.info import RunInfo
from bench.view import schema
from bench.view.dashboard import absolute, lanes, time_series, without_panels
from bench.view.plots import LEGEND_SHARE, waves_by_unit

SHARES = (6.0, 1.4)  # of plots, and of what is below them


def blueprint(run: RunInfo, first: float, last: float) -> rrb.Blueprint:
    """A plot for each unit from `first` to `last`, s after the trigger; Hall code, words and log below them."""
    span = absolute(first, last)
    wide = absolute(first - (last - first) * LEGEND_SHARE / (1 - LEGEND_SHARE), last)
    plots = [time_series(plot, {plot.entity: plot.lines}, span, wide) for plot in waves_by_unit(run)]
    words = rrb.TextDocumentView(name="The capture", origin=f"/{schema.RUN_TEXT}")
    log = rrb.TextLogView(name="Log", origin="/log", contents=["/log/**"])
    hall = [lanes("Hall sensors and sector", schema.HALL_LANES, span, wide)] if run.hall else []
    below = rrb.Horizontal(*hall, words, log)
    views = rrb.Vertical(rrb.Grid(*plots), below, row_shares=list(SHARES)) if plots else below
    return without_panels(views)
