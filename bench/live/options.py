"""What `bench live` was asked for."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

from bench.live.manoeuvres import Act, show
from bench.rig.needs import NEEDS, require
from bench.rig.rig import Rig
from bench.rig.settings import Settings
from bench.signal.sources import source_number

WATCHING = Act("watching", math.inf, 0.0, 0.0, None)


@dataclass(frozen=True)
class LiveOptions:
    """What `bench live` was asked for; r/min, A and Hz as on the command line."""

    target: str | None = None
    speed_rpm: float | None = None
    load_a: float | None = None
    current_a: float | None = None
    """Most that the motor may get, A peak; None: what bench.toml says that it is rated for, else the drive's limit."""
    observer: str | None = None
    duration: float | None = None
    save: Path | None = None
    overwrite: bool = False
    viewer: str = "auto"
    channels: tuple[str, ...] | None = None
    rate_hz: float | None = None
    fit: bool = False
    yes: bool = False
    clear_faults: bool = False
    host_observers: bool = False
    keep: float | None = None
    """Record as a ring of so many s, see `bench.record.ring`."""
    split: float | None = None
    """Begin a new run after so many s."""
    note: str = ""
    """What the run is about, for the recording."""
    trigger: tuple[str, ...] = ()
    """Conditions that mark the run, see `bench.live.triggers`."""
    tune: tuple[str, ...] = ()
    """Parameters that are changed from the keyboard meanwhile."""
    estimate: tuple[str, ...] = ()
    """Observers to run on the host, whose estimates are shown and recorded beside the drive's."""
    web_port: int | None = None
    settings: Settings = field(default_factory=Settings)
    """Of the station: who and where it is, the rated current, and the simulated drive's configuration."""

    @property
    def current(self) -> float:
        """A that the motor may get at most; inf: as much as the drive lets one ask for."""
        if self.current_a is not None:
            return self.current_a
        return math.inf if self.embedded else self.settings.rated.get("current", math.inf)

    @property
    def embedded(self) -> bool:
        """Whether the simulated drive is started as a child."""
        return self.target in (None, "sim")

    @property
    def show(self) -> bool:
        """Whether the scripted show is played: nothing but the simulated drive was asked for."""
        return self.target is None and self.speed_rpm is None and self.load_a is None

    @property
    def passive(self) -> bool:
        """Whether the drive is only watched."""
        return not self.show and self.speed_rpm is None and self.load_a is None

    def acts(self, rig: Rig) -> tuple[Act, ...]:
        """What will be done to the motor; empty when it is only watched. NodeError for what a drive lacks."""
        drive = rig.drive.node
        if self.show:
            require(drive, "the show", NEEDS["the show"])
            return show(*(drive.parameter(name).value for name in ("omega_m_max", "i_max")))
        if self.passive:
            return ()
        source = source_number(self.observer) if self.observer else None
        title = f"{self.speed_rpm or 0:g} r/min, {self.load_a or 0:g} A"
        return (Act(title, math.inf, self.speed_rpm or 0.0, self.load_a or 0.0, source),)
