"""Where a check gets its data: a recording, or a drive that turns its motor, or is turned by hand, for it.

A drive is energised only with consent, and only by `bench.hall.turning`; it is at rest when the data are handed out,
and the link is closed, with every parameter as it was, on leaving. Nothing here measures.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from bench.device.node import Node
from bench.errors import BenchError
from bench.files import RRD, RUN, check_output
from bench.hall import lessons
from bench.hall.passive import watch, watched
from bench.hall.trace import Recorded
from bench.hall.turning import Turned, Turner
from bench.rig.connection import SIM, open_target
from bench.rig.consent import at_most, check_limits, require_consent
from bench.rig.envelope import Envelope
from bench.rig.interrupts import signals_as_exceptions
from bench.rig.lock import alone_on
from bench.rig.outputs import Recording
from bench.rig.rig import Plan, Rig
from bench.rig.screen import Screen
from bench.rig.settings import Settings, read_settings
from bench.signal.trace import STATOR

CURRENT = 2.0  # A that the motor gets at most where nothing else is asked for


@dataclass(frozen=True)
class Options:
    """What was asked for; r/min, A and s as on the command line."""

    source: str
    """A target, or the path of a recording."""
    speed_rpm: float = 240.0
    current_a: float | None = None
    """None: 2 A, or less where the drive allows less."""
    passive: bool = False
    duration: float = 60.0
    """s that the shaft is watched at most, with `passive`."""
    yes: bool = False
    config: Path | None = None
    """Configuration of the simulated drive."""
    operator: str = ""
    save: Path | None = None
    overwrite: bool = False
    write: bool = False
    """Write the edge angles to the drive,"""
    store: bool = False
    """and have it store them."""
    by: str = "encoder"
    """What measures them: `encoder`, `filter` (the host's Kalman filter) or `drive` (its own filter)."""

    begin: float | None = None
    end: float | None = None
    """The part of a recording that is looked at, device time in s; None: from its beginning, to its end."""

    @property
    def recorded(self) -> bool:
        """Whether the source is a recording."""
        named = self.source.endswith((RUN, RRD))
        return self.source != SIM and (named or os.path.isfile(self.source) or os.path.isdir(self.source))

    @property
    def needs(self) -> tuple[str, ...]:
        """Applications of `bench.rig.needs` that this is."""
        check = "bench hall check --passive" if self.passive else "bench hall check"
        learn = {"filter": (check, "bench hall learn --by filter"), "drive": ("bench hall learn --by drive",)}
        write = ("bench hall learn --write",) if self.write else ()
        store = ("bench hall learn --store",) if self.store else ()
        return (*learn.get(self.by, (check,)), *write, *store)

    @property
    def reads(self) -> bool:
        """Whether the drive is asked what it has learned, and nothing turns."""
        return self.by == "drive"


@dataclass(frozen=True)
class Source:
    """What there is to measure, and the drive that it came from, at rest; None with a recording."""

    turned: Turned
    drive: Node | None


@contextmanager
def opened(options: Options, screen: Screen, confirm: Callable[[str], bool] | None) -> Iterator[Source]:
    """Read the recording, or turn the drive's shaft. `confirm` asks a person, None where there is nobody.

    Raises BenchError and HbpError for what the user can mend.
    """
    if options.recorded:
        from bench.record.reader import Run

        recorded = Recorded(Run(options.source), options.begin, options.end, screen.note)
        yield Source(Turned(recorded, "recorded"), None)
        return
    if options.save is not None:
        check_output(options.save, str(options.save), options.overwrite, recording=True)
    station = read_settings(None)
    still = options.passive or options.reads
    operator, load = options.operator or station.operator, "none" if still else "node"
    settings = Settings(
        station=station.station, operator=operator, config=options.config, load=load, encoder=station.encoder
    )
    current = options.current_a
    plan = Plan(
        lambda: open_target(options.source, settings, "hall"),
        options.source,
        settings,
        Envelope(options.speed_rpm, CURRENT if current is None else current),
        virtual=options.source == SIM,
        passive=still,
        held=alone_on(options.source),
    )
    recording = Recording(options.save, {"test": "hall"})
    with signals_as_exceptions(), Rig(plan) as rig:
        drive = rig.drive.node
        rig.require(*options.needs)
        if options.reads:
            rig.prepare([lessons.channels(rig)], recording)
            turned = Turned(lessons.read(rig), "not turned")
        elif options.passive:
            rig.prepare([watched(rig)], recording)
            turned = watch(rig, options.duration, screen.progress)
        else:
            check_limits(drive, Envelope(options.speed_rpm, math.inf if current is None else current))
            rig.require_rest()
            require_consent(drive, options.source, at_most(drive, plan.envelope), options.yes, confirm)
            rig.prepare(recording=recording, needed=frozenset(STATOR))
            if options.by == "filter" and rig.samples is not None:
                from bench.replay.estimators import unfit

                if why := unfit(rig.samples, lessons.taught_by()):
                    raise BenchError(f"the Kalman filter cannot run on this stream: {why}")
            turned = Turner(rig, options.speed_rpm, screen.progress).spin()
        drive.stop_streams()  # nobody reads them while somebody measures
        yield Source(turned, drive)
