"""A bench for PMSM drives with Hall sensors, from Python: connect, turn, record, estimate, score.

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
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from bench.analysis.capture import Capture
    from bench.errors import BenchError
    from bench.rig.drive import DriveTripped
    from bench.rig.envelope import Envelope
    from bench.rig.rig import Rig
    from bench.rig.settings import Settings
    from bench.scoring.board import Scoreboard
    from protocol import __version__

__all__ = [
    "BenchError", "Capture", "DriveTripped", "Envelope", "Rig", "Settings", "__version__", "connect", "estimate",
    "pieces", "read", "score",
]  # fmt: skip

_HOMES = {
    "BenchError": "bench.errors", "Capture": "bench.analysis.capture", "DriveTripped": "bench.rig.drive",
    "Envelope": "bench.rig.envelope", "Rig": "bench.rig.rig", "Settings": "bench.rig.settings",
    "__version__": "protocol",
}  # fmt: skip


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
        settings: what a bench.toml says, or its path; None: ./bench.toml, if there is one.

    Returns:
        The rig. `rig.drive` takes setpoints (the first one starts it), `rig.load` brakes, `rig.record(seconds)` gives
        a `Capture`, `rig.wait(seconds)` lets the bench go on. Only while such a call runs is the drive's watchdog fed:
        compute after the `with` block, or a physical drive switches itself off.

    Raises:
        BenchError: the drive is not at rest, nobody agrees, a channel or a limit that it does not have.
        HbpError: the link cannot be opened, or nothing answers.
    """
    from bench.rig.envelope import Envelope
    from bench.rig.notebook import open_rig
    from bench.rig.rig import Recording
    from bench.rig.settings import read_settings

    if settings is None or isinstance(settings, str | Path):
        settings = read_settings(None if settings is None else Path(settings))
    recording = Recording(None if save is None else Path(save), viewer=viewer, overwrite=overwrite)
    return open_rig(target, settings, limits or Envelope(), yes, channels, recording)


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
    from bench.recording.reader import Run, capture_of
    from bench.recording.times import ticks_between

    run = Run(path)
    return capture_of(run, *ticks_between(run, begin, end), channels)


def pieces(
    path: str | Path, begin: float | None = None, end: float | None = None, channels: Sequence[str] | None = None
) -> Iterator[Capture]:
    """The same as captures of ten seconds or less, one after the other, for recordings of any length.

    Each has the Hall edges up to its last sample, and in `dropped` what was lost since the one before.
    """
    from bench.recording.reader import Run, captures
    from bench.recording.times import ticks_between

    run = Run(path)
    return captures(run, *ticks_between(run, begin, end), channels)


def estimate(capture: Capture, observer: str, /, **settings: float) -> Capture:
    """The capture with an observer's estimates beside it, as channels `theta_<short>_host` and `omega_<short>_host`.

    Args:
        capture: samples at every PWM period, with the inputs that observers have: codes, voltages, currents.
        observer: name or short name, as `bench replay --list` shows them.
        settings: drive parameters for the observer, in their units, such as `k_p=900`; else those of the capture.

    Raises:
        BenchError: an observer, a setting or a channel that there is not, or a setting out of range.
    """
    from bench.observers.replay import estimate_capture

    return estimate_capture(capture, observer, settings)


def score(*runs: Capture | str | Path, observers: Sequence[str] = ()) -> Scoreboard:
    """How good position estimates are, with the encoder as the reference: those in the runs, and observers run on them.

    Args:
        runs: captures, or paths of recordings; several are pooled.
        observers: names, as `bench score --observer` takes them; none: all.

    Returns:
        `.pooled[name]` holds an observer's figures, angles in electrical degrees, the best first; `.by_file` those of
        each run; `.as_json()` all of it as plain data.

    Raises:
        BenchError: a run without encoder or samples, a name that is nowhere.
    """
    from bench.scoring.board import score as board

    return board([Path(run) if isinstance(run, str) else run for run in runs], observers)
