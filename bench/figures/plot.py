"""All standard figures of a run: one pass over it, then a short one for the spectrum; files, or why there is none."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from bench.analysis.channels import reference_angle
from bench.analysis.chunks import between, contiguous, no_edges, part
from bench.analysis.error_bins import ErrorByAngle, ErrorBySpeed, angle_bins
from bench.analysis.position import position_error
from bench.figures import current_plane, error_by_angle, error_by_speed, hall_edges, spectrum
from bench.figures.motion import Motion, Piece
from bench.recording.layout import EDGES, SAMPLES
from bench.recording.reader import Run
from bench.recording.recording import readable
from bench.reports.style import FONT_SIZE, save
from protocol.streams import EdgeChunk, SampleChunk

NAMES = ("spectrum", "error_by_angle", "error_by_speed", "current_plane", "hall_edges")
NO_SAMPLES = "no samples"
NOT_STEADY = "the shaft never turns steadily above 10 r/min"
RECORD = "record all channels (bench live --save)"


@dataclass
class Plot:
    """A figure, or why there is none."""

    name: str
    figure: Figure | None = None
    why: str = ""
    """Empty where it was drawn."""
    words: str = ""
    """What it says, in a line."""
    over: str = ""
    """What part of the run it is of; empty for all of it."""
    numbers: dict[str, Any] = field(default_factory=dict)


def draw_all(run: Run, first: int, last: int) -> list[Plot]:
    """The figures of the ticks `first` to `last` of a run. BenchError without samples, or where its clock goes back."""
    readable(run)
    names = [channel.name for channel in run.config(SAMPLES).channels]
    estimates = run.info.position_estimates if run.info.position_reference else ()
    estimates = tuple(name for name in estimates if name in names)
    motion, steady = Motion(run), spectrum.SteadyStretch()
    by_angle = {name: ErrorByAngle() for name in estimates}
    by_speed = ErrorBySpeed(motion.rate, run.info.n_p or 1)
    plane = current_plane.CurrentPlane(run.info.i_max, run.info.has(*current_plane.REFERENCES))
    edges = hall_edges.HallEdges()
    why = _not_there(run, names)
    n = 0
    for chunk in run.pieces(SAMPLES, first, last):
        assert isinstance(chunk, SampleChunk)
        n += len(chunk)
        for piece in motion.pieces(chunk):
            steady.add(piece)
            _add_errors(piece, by_angle, by_speed)
            if not why["current_plane"]:
                plane.add(piece)
        if not why["hall_edges"]:
            edges.add(chunk, _edges_with(run, edges, first, int(chunk.tick[-1])))
    if not n:
        why = dict.fromkeys(NAMES, NO_SAMPLES)
    found = {
        "spectrum": lambda: _spectrum(run, steady.longest, motion),
        "error_by_angle": lambda: _by_angle(by_angle, motion),
        "error_by_speed": lambda: _by_speed(by_speed, motion, "r/min" if run.info.n_p else "electrical r/min"),
        "current_plane": lambda: _plane(plane),
        "hall_edges": lambda: _edges(edges),
    }
    drawn = [Plot(name, why=why[name]) if why[name] else found[name]() for name in NAMES]
    for each in drawn:
        if each.figure is not None:
            _title(each.figure, run, each.over or f"{run.at(first)} … {run.at(last)}")
    return drawn


def write(drawn: Plot, path: Path) -> None:
    """Write a figure that was drawn as PNG, or as SVG where `path` says so. Raises OSError."""
    assert drawn.figure is not None
    if path.suffix == ".svg":
        with rc_context({"svg.hashsalt": "hallbench"}):  # the same figure makes the same bytes
            drawn.figure.savefig(path, format="svg", metadata={"Date": None, "Creator": None})
    else:
        save(drawn.figure, path)


def _not_there(run: Run, names: list[str]) -> dict[str, str]:
    """By figure, which channel is missing; empty for none."""
    why = dict.fromkeys(NAMES, "")
    if not any(name in names for name in (*spectrum.PHASES, *spectrum.VECTOR)):
        why["spectrum"] = f"no phase current and no i_d, i_q: {RECORD}"
    if not reference_angle(run.config(SAMPLES).channels):
        no_encoder = "no angle flagged REFERENCE: needs an encoder"
        why |= dict.fromkeys(("error_by_angle", "error_by_speed", "hall_edges"), no_encoder)
    elif not any(name in names for name in run.info.position_estimates):
        no_estimate = f"no angle flagged ESTIMATE: {RECORD}, or bench replay"
        why |= dict.fromkeys(("error_by_angle", "error_by_speed"), no_estimate)
    if missing := [name for name in current_plane.CURRENTS if not run.info.has(name)]:
        why["current_plane"] = f"no {', '.join(missing)} in A: {RECORD}"
    if not why["hall_edges"]:
        if EDGES not in run.names:
            why["hall_edges"] = "no Hall edges: the drive streams none, or the shaft was at rest"
        elif "hall" not in names:
            why["hall_edges"] = f"no channel hall: {RECORD}"
    return why


def _edges_with(run: Run, edges: hall_edges.HallEdges, first: int, last: int) -> EdgeChunk:
    """The edges that came with samples up to tick `last`."""
    found = run.chunk(EDGES, edges.before() or first, last)
    return found if isinstance(found, EdgeChunk) else no_edges(run.config(EDGES))


def _spectrum(run: Run, stretch: spectrum.Stretch | None, motion: Motion) -> Plot:
    name = "spectrum"
    if stretch is None:
        return Plot(name, why=motion.why or NOT_STEADY)
    last = min(stretch.last, stretch.first + round(spectrum.LONGEST * run.info.tick_hz))
    samples = run.chunk(SAMPLES, stretch.first, last)
    assert isinstance(samples, SampleChunk)
    rows = max(contiguous(between(samples, stretch.first, last)), key=lambda rows: rows.stop - rows.start)
    try:
        found = spectrum.currents(part(samples, rows.start, rows.stop), stretch.rpm, run.info.n_p or 1)
    except ValueError as error:
        return Plot(name, why=str(error))
    return Plot(
        name, spectrum.draw(found), words=spectrum.words(found), over=f"steady {spectrum.stretch(found)}",
        numbers=spectrum.as_json(found),
    )  # fmt: skip


def _add_errors(piece: Piece, by_angle: Mapping[str, ErrorByAngle], by_speed: ErrorBySpeed) -> None:
    """Add the steady samples of a piece with an encoder."""
    if piece.theta is None or piece.rpm is None or piece.phases is None:
        return
    steady = piece.phases.steady
    theta, rpm = piece.theta[steady], piece.rpm[steady]
    bins = angle_bins(np.nan_to_num(theta))
    for name, sums in by_angle.items():
        error = np.degrees(position_error(theta, piece.samples.physical(name)[steady]))
        sums.add(bins, error, rpm < 0)
        by_speed.add(name, rpm, error)


def _by_angle(sums: Mapping[str, ErrorByAngle], motion: Motion) -> Plot:
    name, found = "error_by_angle", {name: of for name, of in sums.items() if of.n.any()}
    if not found:
        return Plot(name, why=motion.why or NOT_STEADY)
    of = error_by_angle
    return Plot(name, of.draw(found), words=of.words(found), numbers=of.as_json(found))


def _by_speed(sums: ErrorBySpeed, motion: Motion, unit: str) -> Plot:
    name, found = "error_by_speed", sums.result()
    if not found:
        return Plot(name, why=motion.why or NOT_STEADY)
    of = error_by_speed
    return Plot(name, of.draw(found, unit), words=of.words(found), numbers=of.as_json(found, sums.width))


def _plane(sums: current_plane.CurrentPlane) -> Plot:
    name, found = "current_plane", sums.result()
    if found is None:
        return Plot(name, why="the drive is never RUNNING")
    of = current_plane
    return Plot(name, of.draw(found), words=of.words(found), numbers=of.as_json(found))


def _edges(collected: hall_edges.HallEdges) -> Plot:
    name, found = "hall_edges", collected.result()
    if found is None:
        return Plot(name, why="no Hall edge of a turning shaft: it was at rest")
    of = hall_edges
    return Plot(name, of.draw(found), words=of.words(found), numbers=of.as_json(found))


def _title(figure: Figure, run: Run, over: str) -> None:
    """Run, drive and span above a figure."""
    identity = run.info.identity
    drive = " ".join(str(identity[key]) for key in ("name", "serial") if identity.get(key))
    title = f"{run.path.name}{f', {drive}' if drive else ''}, {over}"
    figure.suptitle(title, fontsize=FONT_SIZE, color="0.3", x=0.01, ha="left")
