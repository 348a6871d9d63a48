"""All standard figures of a run: one pass over it, then a short one for the spectrum; files, or why there is none."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from bench.motion.read import read_profile
from bench.plot import current_plane, error_by_angle, error_by_speed, hall_edges, profile, spectrum
from bench.plot.motion import Motion, Piece
from bench.record.layout import EDGES, SAMPLES
from bench.record.reader import Run, captures
from bench.record.recording import readable
from bench.report.style import FONT_SIZE, save
from bench.signal.channels import reference_angle
from bench.signal.chunks import between, contiguous, part
from bench.signal.error_bins import ErrorByAngle, ErrorBySpeed, angle_bins
from bench.signal.position import position_error
from protocol.streams import SampleChunk

NAMES = ("spectrum", "error_by_angle", "error_by_speed", "current_plane", "hall_edges")
PROFILE = "profile"
NOT_STEADY = "the shaft never turns steadily above 10 r/min"
AT_REST = "no Hall edge of a turning shaft: it was at rest"
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
    why = _not_there(run, names)
    for piece in motion.pieces(captures(run, first, last)):
        steady.add(piece)
        _add_errors(piece, by_angle, by_speed)
        if not why["current_plane"]:
            plane.add(piece)
    still, unit = motion.why or NOT_STEADY, "r/min" if run.info.n_p else "electrical r/min"
    found = {
        "spectrum": lambda: _spectrum(run, steady.longest, motion),
        "error_by_angle": lambda: _of({name: of for name, of in by_angle.items() if of.n.any()}, still, error_by_angle),
        "error_by_speed": lambda: _of(by_speed.result(), still, error_by_speed, unit),
        "current_plane": lambda: _of(plane.result(), "the drive is never RUNNING", current_plane),
        "hall_edges": lambda: _of(hall_edges.edges_of(run, first, last), AT_REST, hall_edges),
    }
    drawn = [replace(Plot("", why=why[name]) if why[name] else found[name](), name=name) for name in NAMES]
    for each in drawn:
        if each.figure is not None:
            _title(each.figure, run, each.over or f"{run.at(first)} … {run.at(last)}")
    return drawn


def draw_profile(path: Path) -> Plot:
    """The figure of the motion profile in a file. BenchError where it is none."""
    asked = read_profile(path)
    figure = profile.draw(asked)
    named = f"{path.name}, {asked.name}" if asked.name else path.name
    figure.suptitle(f"{named}: {asked.seconds:g} s", fontsize=FONT_SIZE, color="0.3", x=0.01, ha="left")
    return Plot(PROFILE, figure, words=profile.words(asked), numbers=profile.as_json(asked))


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
        why |= dict.fromkeys(("error_by_angle", "error_by_speed"), no_encoder)
    elif not any(name in names for name in run.info.position_estimates):
        no_estimate = f"no angle flagged ESTIMATE: {RECORD}, or bench replay"
        why |= dict.fromkeys(("error_by_angle", "error_by_speed"), no_estimate)
    if missing := [name for name in current_plane.CURRENTS if not run.info.has(name)]:
        why["current_plane"] = f"no {', '.join(missing)} in A: {RECORD}"
    if EDGES not in run.names:
        why["hall_edges"] = "no Hall edges: the drive streams none, or the shaft was at rest"
    elif "hall" not in names:
        why["hall_edges"] = f"no channel hall: {RECORD}"
    return why


def _spectrum(run: Run, stretch: spectrum.Stretch | None, motion: Motion) -> Plot:
    if stretch is None:
        return Plot("", why=motion.why or NOT_STEADY)
    last = min(stretch.last, stretch.first + round(spectrum.LONGEST * run.info.tick_hz))
    samples = run.chunk(SAMPLES, stretch.first, last)
    assert isinstance(samples, SampleChunk)
    rows = max(contiguous(between(samples, stretch.first, last)), key=lambda rows: rows.stop - rows.start)
    try:
        found = spectrum.currents(part(samples, rows.start, rows.stop), stretch.rpm, run.info.n_p or 1)
    except ValueError as error:
        return Plot("", why=str(error))
    return Plot(
        "", spectrum.draw(found), words=spectrum.words(found), over=f"steady {spectrum.stretch(found)}",
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


def _of(found: Any, why: str, figure: Any, *more: Any) -> Plot:
    """The figure of what a module has `found`, or `why` there is nothing; `more`: what its `draw` takes besides."""
    if not found:
        return Plot("", why=why)
    return Plot("", figure.draw(found, *more), words=figure.words(found), numbers=figure.as_json(found))


def _title(figure: Figure, run: Run, over: str) -> None:
    """Run, drive and span above a figure."""
    identity = run.info.identity
    drive = " ".join(str(identity[key]) for key in ("name", "serial") if identity.get(key))
    title = f"{run.path.name}{f', {drive}' if drive else ''}, {over}"
    figure.suptitle(title, fontsize=FONT_SIZE, color="0.3", x=0.01, ha="left")
