"""Two aligned runs in one rerun recording: A below /a, B below /b, on the time after what they are aligned at.

The views are those of the dashboard, one for each quantity, with the lines of both: A as ever, B paler.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import cast

import rerun as rr
import rerun.blueprint as rrb

from bench.record.info import RunInfo, ns_from_tick
from bench.record.times import Side
from bench.signal.colours import RGB
from bench.view.dashboard import absolute, time_series, without_panels
from bench.view.log import RunLog
from bench.view.plots import LEGEND_SHARE, Plot, plots
from bench.view.shifted import Shifted
from bench.view.viewing import LOT, closeups, rrd_file, show

A, B = "a", "b"
PALE = 0.55  # share of white in B's colours
BRIGHT = 200  # of each part of a colour that would not become paler to see: it becomes darker


def write_overlay(path: Path, a: Side, b: Side, lot: float = LOT) -> None:
    """Write both runs for rerun's viewer, `lot` s of signal a message.

    The file appears, or replaces an earlier one, when it is whole. Raises RecordingError.
    """
    infos = _alike(a.run.info, b.run.info)
    whole = replace(infos[0], recording_id=f"{infos[0].recording_id}-{infos[1].recording_id}")
    with rrd_file(path, whole) as stream:
        span = [float(ns_from_tick(tick - a.zero, a.run.info.tick_hz)) / 1e9 for tick in (a.first, a.last)]
        stream.send_blueprint(_blueprint(_common(*infos), *span))
        for entity, laid, info in ((A, a, infos[0]), (B, b, infos[1])):
            shifted = Shifted(stream, entity, int(ns_from_tick(laid.zero, info.tick_hz)))
            log = RunLog(cast(rr.RecordingStream, shifted), info, lot)
            log.start()
            show(laid.run, log, laid.first, laid.last, closeups(laid.run, laid.first, laid.last))
            log.finish()


def _alike(a: RunInfo, b: RunInfo) -> tuple[RunInfo, RunInfo]:
    """Both, with speeds in the same unit: mechanical where the pole pairs of both are known."""
    if a.n_p and b.n_p:
        return a, b
    one, other = (
        replace(info, parameters={name: value for name, value in info.parameters.items() if name != "n_p"})
        for info in (a, b)
    )
    return one, other


def _common(a: RunInfo, b: RunInfo) -> RunInfo:
    """A with the channels that B has in the same unit."""
    units = {channel.name: channel.unit for channel in b.channels}
    return replace(a, channels=tuple(c for c in a.channels if units.get(c.name) == c.unit))


def _blueprint(run: RunInfo, first: float, last: float) -> rrb.Blueprint:
    """The views of both runs; `first`, `last`: s, what they show."""
    span = absolute(first, last)
    room = (last - first) * LEGEND_SHARE / (1 - LEGEND_SHARE)
    wide = absolute(first - room, last)
    views = [
        time_series(
            plot,
            {
                f"{A}/{plot.entity}": [replace(line, name=f"A {line.name}") for line in plot.lines],
                f"{B}/{plot.entity}": [
                    replace(line, name=f"B {line.name}", colour=pale(line.colour)) for line in plot.lines
                ],
            },
            span,
            wide,
        )
        for plot in _once(plots(run).values())
    ]
    logs = rrb.TextLogView(name="Logs of A and B", origin="/", contents=["/a/log/**", "/b/log/**"])
    return without_panels(rrb.Vertical(rrb.Grid(*views), logs, row_shares=[6, 1]) if views else logs)


def _once(found: Iterable[Plot]) -> list[Plot]:
    """One plot for each quantity: the first, which is the long one, where there are two of the same channels."""
    shown: dict[tuple[tuple[str, bool, str], ...], Plot] = {}
    for plot in found:
        lines = tuple((line.channel, line.error, line.derived) for line in plot.lines)
        shown.setdefault(lines, replace(plot, name=plot.title))
    return list(shown.values())


def pale(colour: RGB) -> RGB:
    """The colour of B's line where A's is `colour`."""
    towards = 0 if min(colour) >= BRIGHT else 255
    red, green, blue = (round(part + PALE * (towards - part)) for part in colour)
    return red, green, blue
