"""All standard figures of a run: one pass over it, then a short one for the spectrum; files, or why there is none."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from matplotlib import rc_context
from matplotlib.figure import Figure

from bench.analysis.channels import reference_angle
from bench.analysis.chunks import between, contiguous, no_edges, part
from bench.figures import current_plane, error_by_angle, error_by_speed, hall_edges, spectrum
from bench.figures.motion import Motion
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
    by_angle, by_speed = (
        error_by_angle.ErrorByAngle(estimates),
        error_by_speed.ErrorBySpeed(estimates, motion.rate, run.info.n_p or 1),
    )
    plane = current_plane.CurrentPlane(run.info.i_max, run.info.has(*current_plane.REFERENCES))
    edges = hall_edges.HallEdges()
    why = _not_there(run, names)
    n = 0
    for chunk in run.pieces(SAMPLES, first, last):
        assert isinstance(chunk, SampleChunk)
        n += len(chunk)
        for piece in motion.pieces(chunk):
            steady.add(piece)
            by_angle.add(piece)
            by_speed.add(piece)
            if not why["current_plane"]:
                plane.add(piece)
        if not why["hall_edges"]:
            edges.add(chunk, _edges_with(run, edges, first, int(chunk.tick[-1])))
    if not n:
        why = dict.fromkeys(NAMES, NO_SAMPLES)
    still, unit = motion.why or NOT_STEADY, "r/min" if run.info.n_p else "electrical r/min"
    found: dict[str, tuple[Any, ...]] = {
        "error_by_angle": (error_by_angle, by_angle.result(), still),
        "error_by_speed": (error_by_speed, by_speed.result(), still, (unit,), (by_speed.width,)),
        "current_plane": (current_plane, plane.result(), "the drive is never RUNNING"),
        "hall_edges": (hall_edges, edges.result(), "no Hall edge of a turning shaft: it was at rest"),
    }
    currents = Plot("spectrum", why=why["spectrum"])
    drawn = [currents if currents.why else _spectrum(run, steady.longest, motion)]
    drawn += [Plot(name, why=why[name]) if why[name] else _plot(name, *of) for name, of in found.items()]
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


def _plot(name: str, of: Any, found: Any, why: str, how: tuple[Any, ...] = (), by: tuple[Any, ...] = ()) -> Plot:
    """What was `found`, as its module `of` draws it with `how` and writes it with `by`; `why` there is nothing."""
    if not found:
        return Plot(name, why=why)
    return Plot(name, of.draw(found, *how), words=of.words(found), numbers=of.as_json(found, *by))


def _title(figure: Figure, run: Run, over: str) -> None:
    """Run, drive and span above a figure."""
    identity = run.info.identity
    drive = " ".join(str(identity[key]) for key in ("name", "serial") if identity.get(key))
    title = f"{run.path.name}{f', {drive}' if drive else ''}, {over}"
    figure.suptitle(title, fontsize=FONT_SIZE, color="0.3", x=0.01, ha="left")
