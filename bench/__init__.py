"""A bench for PMSM drives with Hall sensors, from Python: connect, turn, record, estimate, score, check, plot.

    import bench

    with bench.connect("sim") as rig:                      # or "serial:/dev/ttyACM0": asks before anything turns
        rig.drive.speed(rpm=500)
        rig.load.torque(0.2)                                # N·m
        rig.wait(0.5)
        run = rig.record(2.0)                               # a Capture
    print(run["i_q"].mean(), run.units["i_q"])
    again = bench.estimate(run, "edge_kalman")
    print(bench.score(again).pooled["replayed_ek"]["moving"]["rms"], "deg")

`docs/notebook.md` tells the rest. Importing this package opens nothing and loads next to nothing.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from bench.compare.compare import Comparison
    from bench.errors import BenchError
    from bench.export.export import Exported
    from bench.findings.health import Health
    from bench.measure.measure import Statistics
    from bench.param.table import Parameters
    from bench.plot.plot import Plot
    from bench.record.recording import Recording, Source
    from bench.rig.drive import DriveTripped
    from bench.rig.envelope import Envelope
    from bench.rig.notebook import Simulated
    from bench.rig.rig import Rig
    from bench.rig.settings import Settings
    from bench.score.board import Scoreboard
    from bench.signal.capture import Capture
    from protocol import __version__

__all__ = [
    "BenchError", "Capture", "DriveTripped", "Envelope", "Recording", "Rig", "Settings", "__version__", "capture",
    "compare", "connect", "estimate", "export", "hall", "measure", "open", "parameters", "pieces", "plot", "read",
    "score",
]  # fmt: skip

_HOMES = {
    "BenchError": "bench.errors", "Capture": "bench.signal.capture", "DriveTripped": "bench.rig.drive",
    "Envelope": "bench.rig.envelope", "Recording": "bench.record.recording", "Rig": "bench.rig.rig",
    "Settings": "bench.rig.settings", "__version__": "protocol",
}  # fmt: skip

for _folder in (
    "capture",
    "compare",
    "export",
    "hall",
    "measure",
    "plot",
    "score",
):  # binds its name, before the function that stays
    import_module(f"{__name__}.{_folder}")


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__} has no attribute {name}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return __all__


def connect(
    target: str | None = None,
    *,
    yes: bool = False,
    limits: Envelope | None = None,
    channels: Sequence[str] | str | None = None,
    save: str | Path | None = None,
    overwrite: bool = False,
    viewer: str = "none",
    settings: Settings | str | Path | None = None,
    **simulated: Unpack[Simulated],
) -> Rig:
    """Connect to a drive and stream it. Use it as a context manager: however that is left, the outputs are off after.

    Args:
        target: as on the command line: `serial:/dev/ttyACM0`, `tcp:HOST:PORT`, `can:INTERFACE/CHANNEL`, or `sim`, a new
            simulated drive in virtual time. None: $BENCH_TARGET, what bench.toml says, or `sim`.
        yes: the shaft is clear: a physical drive may be energised. Without it somebody is asked at the first setpoint.
        limits: the most that will be asked for, r/min and A; the drive's own `i_max` is lowered to it meanwhile.
        channels: names of channels to stream, as `--channels`, such as "+theta_ek"; None: all but those on request and
            the plant's own.
        save: a run to record to, such as `a.run`; `overwrite` replaces one that is there.
        viewer: a dashboard meanwhile: `native`, `web`, `auto`, or `none`; its address is printed.
        settings: what a bench.toml says, or its path; None: bench.toml here or in a folder above, if there is one.
        simulated: of the simulated drive: `config`, the path of a configuration, the name of a motor, or a mapping such
            as {"motor": {"R_s": 0.4}}, in the place of keys of bench.toml's; and `seed`, of its noise: two runs with
            one seed are equal.

    Returns:
        The rig. `rig.drive` takes setpoints (the first one starts it), `rig.load` brakes, `rig.record(seconds)` gives
        a `Capture`, `rig.wait(seconds)` lets the bench go on. Only while such a call runs is the drive's watchdog fed:
        compute after the `with` block, or a physical drive switches itself off.

    Raises:
        BenchError: the drive is not at rest, nobody agrees, a channel or a limit that it does not have, a configuration
            or a seed for a drive that is not simulated.
        HbpError: the link cannot be opened, or nothing answers.
    """
    from bench.rig.envelope import Envelope
    from bench.rig.notebook import open_rig
    from bench.rig.outputs import Recording
    from bench.rig.settings import read_settings

    if settings is None or isinstance(settings, str | Path):
        settings = read_settings(None if settings is None else Path(settings))
    recording = Recording(None if save is None else Path(save), viewer=viewer, overwrite=overwrite)
    return open_rig(target, settings, limits or Envelope(), yes, channels, recording, simulated)


def capture(
    time: Any,
    values: Mapping[str, Any],
    *,
    edges: tuple[Any, Any] | None = None,
    units: Mapping[str, str] | None = None,
    n_p: int | None = None,
) -> Capture:
    """Arrays of any origin as a capture, by the way that `bench import` goes.

    Args:
        time: of each sample, s, shape (n,), or samples a second.
        values: arrays (n,) by name. Names of a drive's channels, as `theta_enc` and `i_q`, mean what they mean there,
            in SI units and electrical radians where `units` does not say otherwise; `hall` is the Hall code.
        edges: times in s and Hall codes, (m,) each: the code from each time on, the first one that at the beginning.
            None: those of `hall`, known to a sample.
        units: by name, such as {"theta_enc": "mech deg", "i_q": "mA"}.
        n_p: pole pairs of the motor; None: as the Hall codes tell against a mechanical angle, if they do.

    Raises:
        BenchError: arrays that do not fit together, a time that goes back, a unit that is none.
    """
    from bench.importer.api import capture

    return capture(time, values, edges, units or {}, n_p)


def open(path: str | Path) -> Recording:
    """A recorded run, for pandas: `.samples`, `.edges`, `.marks`, `.events`, `.notes` are DataFrames by device time.

    `.info` is what is known of the run, `.read(begin, end, channels)` a part of it as a capture, and iterating gives
    all of it as `pieces`. DataFrames need pandas: `pip install 'hallbench[pandas]'`.

    Raises BenchError where `path` holds no recording.
    """
    from bench.record.recording import Recording

    return Recording(path)


def read(
    path: str | Path, begin: float | None = None, end: float | None = None, channels: Sequence[str] | None = None
) -> Capture:
    """A recording as a capture: samples and Hall edges exactly as they came, and where some were lost.

    Args:
        path: a recorded run.
        begin, end: device time in s, both included; None: from its beginning, to its end.
        channels: names of those that are read; None: all. A few are read faster, and take less memory.

    Raises:
        BenchError: no recording, no samples in that time, a channel that it does not have, or more than fits into
            memory.
    """
    return open(path).read(begin, end, channels)


def pieces(
    path: str | Path, begin: float | None = None, end: float | None = None, channels: Sequence[str] | None = None
) -> Iterator[Capture]:
    """The same as captures of ten seconds or less, one after the other, for recordings of any length.

    Each has the Hall edges up to its last sample, and in `dropped` what was lost since the one before.
    """
    return open(path).pieces(begin, end, channels)


def estimate(capture: Capture, observer: str, /, **settings: float) -> Capture:
    """The capture with an observer's estimates beside it, as channels `theta_<short>_host` and `omega_<short>_host`.

    Args:
        capture: Hall codes and edges; at every PWM period voltages and currents, for observers that need them.
        observer: name or short name, as `bench replay --list` shows them.
        settings: drive parameters for the observer, in their units, such as `k_p=900`; else those of the capture.

    Raises:
        BenchError: an observer, a setting or a channel that there is not, or a setting out of range.
    """
    from bench.replay.replay import estimate_capture

    return estimate_capture(capture, observer, settings)


def score(*runs: Source, observers: Sequence[str] = (), reference: str = "auto", **settings: float) -> Scoreboard:
    """How good position estimates are, against a reference: those in the runs, and observers run on them.

    Args:
        runs: captures, recordings, or paths of recordings; several are pooled.
        observers: names, as `bench score --observer` takes them; none: all.
        reference: encoder; edges, the run's own at steady speed; the name of an observer or a recorded estimate, from
            which differences are then told, not errors; auto: the encoder, else edges.
        settings: drive parameters for the observers, such as `n_p=15`; else those of the run.

    Returns:
        `.pooled[name]` holds an observer's figures, angles in electrical degrees, the best first; `.to_pandas()` the
        same as a table; `.by_file` those of each run; `.as_json()` all of it as plain data.

    Raises:
        BenchError: a run without the reference or samples, a name that is nowhere, a setting out of range.
    """
    from bench.score.board import score as board

    paths = [Path(run) if isinstance(run, str) else run for run in runs]
    return board(paths, observers, reference=reference, settings=settings)


def hall(run: Source, begin: float | None = None, end: float | None = None) -> Health:
    """What is wrong with the Hall sensors, their wires or the encoder, as `bench hall check` finds it in a recording.

    Args:
        run: a capture, a recording, or the path of one, in which the shaft turned both ways.
        begin, end: device time in s, both included; None: from its beginning, to its end.

    Returns:
        `.verdict` is PASS, FAIL or INVALID; `.findings` name causes, with evidence and advice; `.missing` says
        why no more can be said; `.measured.to_pandas()` is the table of the edges.

    Raises:
        BenchError: no samples, no Hall edges, no channel `hall`.
    """
    from bench.findings.health import examine
    from bench.hall.trace import Recorded, trace
    from bench.record.recording import run_of
    from bench.signal.capture import Capture

    if isinstance(run, Capture) and begin is None and end is None:
        return examine(trace(run))
    return examine(trace(Recorded(run_of(run), begin, end)))


def parameters(source: str | Path, node: int | None = None) -> Parameters:
    """Parameters with unit, range, default, group and meaning, as `bench param list` shows them. Changes nothing.

    Args:
        source: a target, a dump of `bench param`, or a recorded run, as it began.
        node: of a target, the number of the device on the link; None: the one that answers.

    Returns:
        A mapping of values by name; `.entries[name]` tells more of each, `.to_pandas()` all of it as a table.

    Raises:
        BenchError: a file that is no dump, a node that is not there, a link that is in use.
        HbpError: the link cannot be opened, or nothing answers.
    """
    from bench.param.sources import read

    return read(str(source), node)


def compare(
    a: Source,
    b: Source,
    *,
    align: str = "begin",
    begin: float | None = None,
    end: float | None = None,
    channels: Sequence[str] = (),
) -> Comparison:
    """The differences of two runs that are more than noise, as `bench compare` finds them.

    Args:
        a, b: captures, recordings, or paths of recordings.
        align: what time 0 is in both: "begin", a mark, or an event such as "START"; "NAME#2" is the second one.
        begin, end: s after time 0, both included; None: as far as both go.
        channels: names of those that are compared; none: all that both have.

    Returns:
        `.rows`, also as `.to_pandas()`, are B less A with its standard error and a verdict; `.events` and `.parameters`
        are those that differ.

    Raises:
        BenchError: a run without samples, a name that is nowhere, no time in common.
    """
    from bench.compare.alignment import aligned
    from bench.compare.compare import compare as compare_sides
    from bench.record.recording import readable

    return compare_sides(*aligned(readable(a), readable(b), align, begin, end), channels)


def measure(
    run: Source,
    channels: Sequence[str] | None = None,
    begin: float | str | None = None,
    end: float | str | None = None,
) -> Statistics:
    """What lies between two cursors, as `bench measure` finds it.

    Args:
        run: a capture, a recording, or the path of one.
        channels: names of those that are measured; None: all.
        begin, end: device time in s, both included, or the name of a mark or an event; None: the first sample, the
            last.

    Returns:
        `.rows`, also as `.to_pandas()`: mean, rms, standard deviation, extremes, slope, frequency and the values at
        both cursors of each channel; `.between`: samples, gaps, Hall edges and revolutions; `.as_json()` all of it as
        plain data.

    Raises:
        BenchError: no samples there, a channel or a name that is nowhere, a drive that rebooted meanwhile.
    """
    from bench.compare.alignment import seconds_of
    from bench.measure.measure import measure as measured
    from bench.record.recording import run_of

    opened = run_of(run)
    return measured(opened, channels, seconds_of(opened, begin), seconds_of(opened, end, last=True))


def plot(run: Source, begin: float | None = None, end: float | None = None) -> dict[str, Plot]:
    """The standard plots of a run, as `bench plot` draws them, by name.

    Args:
        run: a capture, a recording, or the path of one.
        begin, end: device time in s, both included; None: from its beginning, to its end.

    Returns:
        `["spectrum"].figure` is a matplotlib Figure, None where it cannot be drawn: `.why` says why. `.numbers` are the
        plotted values, `.words` what they say in a line.

    Raises:
        BenchError: no samples, or a drive that rebooted meanwhile.
    """
    from bench.plot.plot import draw_all
    from bench.record.recording import readable
    from bench.record.times import ticks_of

    opened = readable(run)
    return {each.name: each for each in draw_all(opened, *ticks_of(opened, begin, end))}


def export(
    run: Source,
    path: str | Path,
    begin: float | None = None,
    end: float | None = None,
    channels: Sequence[str] | None = None,
    *,
    overwrite: bool = False,
) -> Exported:
    """Write a run in the format of another tool, which the ending of `path` says, as `bench export` does.

    Args:
        run: a capture, a recording, or the path of one.
        path: a file that ends in .csv, .mf4, .mat, .npz, .rrd or .parquet; tables that it cannot hold are beside it.
        begin, end: device time in s, both included; None: from its beginning, to its end.
        channels: names of those that are wanted; None: all.
        overwrite: replace files that are there.

    Returns:
        `.files` by what they hold, `.rows` by table, `.notes` for whoever asked.

    Raises:
        BenchError: an ending that is unknown, a file that exists, a name that is nowhere.
    """
    from bench.export.export import export as write
    from bench.record.recording import run_of

    return write(run_of(run), Path(path), None, begin, end, channels, overwrite)
