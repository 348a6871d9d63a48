"""What `bench live` was asked for."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, replace
from pathlib import Path

from bench.device.node import Node
from bench.live.manoeuvres import show
from bench.motion.profile import LOAD_CURRENT, SPEED, Profile, Sine, Step
from bench.rig.needs import NEEDS, require
from bench.rig.settings import Settings
from bench.signal.sources import source_number


@dataclass(frozen=True)
class LiveOptions:
    """What `bench live` was asked for; r/min, A and Hz as on the command line."""

    target: str | None = None
    speed_rpm: float | None = None
    load_a: float | None = None
    current_a: float | None = None
    """Most that the motor may get, A peak; None: what bench.toml says that it is rated for, else the drive's limit."""
    profile: Profile | None = None
    """What is asked for, in the place of one speed and one load."""
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
        if self.profile is not None and self.profile.max_current is not None:
            return self.profile.max_current
        return math.inf if self.embedded else self.settings.rated.get("current", math.inf)

    @property
    def embedded(self) -> bool:
        """Whether the simulated drive is started as a child."""
        return self.target in (None, "sim")

    @property
    def show(self) -> bool:
        """Whether the scripted show is played: nothing but the simulated drive was asked for."""
        return self.target is None and self._nothing_asked

    @property
    def passive(self) -> bool:
        """Whether the drive is only watched."""
        return not self.show and self._nothing_asked

    @property
    def _nothing_asked(self) -> bool:
        return self.speed_rpm is None and self.load_a is None and self.profile is None

    def asked(self, drive: Node) -> Profile | None:
        """What will be done to the motor of a drive; None when it is only watched.

        NodeError for what a drive lacks, BenchError for a profile that cannot be repeated where it would have to be.
        """
        if self.show:
            require(drive, "the show", NEEDS["the show"])
            return show(*(drive.parameter(name).value for name in ("omega_m_max", "i_max")))
        if self.passive:
            return None
        source = source_number(self.observer) if self.observer else None
        sets = {} if source is None else {"observer": float(source)}
        if self.profile is not None:
            first, *others = self.profile.steps
            profile = replace(self.profile, steps=(replace(first, sets=dict(first.sets) | sets), *others))
            if self.duration is not None and self.duration > profile.seconds:
                deque(profile.timed(2.0 * profile.seconds), 0)  # whether its first step can follow its last one
            return profile
        title = f"{self.speed_rpm or 0:g} r/min, {self.load_a or 0:g} A"
        targets: dict[str, float | Sine] = {SPEED: self.speed_rpm or 0.0}
        if self.load_a is not None:
            targets[LOAD_CURRENT] = self.load_a
        return Profile((Step(title, math.inf, targets, sets=sets, title=title),))
