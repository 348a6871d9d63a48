"""Parameters by name, with what is known of each: unit, range, default, flags, group, meaning."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.errors import BenchError
from bench.param.groups import GROUPS, OTHER
from protocol.codes import Role
from protocol.signals import DRIVE_PARAMETERS, LOAD_PARAMETERS, Flag, Parameter
from protocol.text import did_you_mean

if TYPE_CHECKING:
    import pandas as pd

NO_FLAGS = Flag(0)
_FLAGS = (Flag.IDLE_ONLY, Flag.READ_ONLY, Flag.VOLATILE, Flag.WHOLE)


def vocabulary(role: str) -> Mapping[str, Parameter]:
    """The shared vocabulary's parameters of a role (`drive`, `load`), by name; those of a drive for any other."""
    known = LOAD_PARAMETERS if role == Role.LOAD.name.lower() else DRIVE_PARAMETERS
    return {parameter.name: parameter for parameter in known}


@dataclass(frozen=True)
class ParameterEntry:
    """One parameter, in its unit. What nobody tells is None, or empty."""

    name: str
    value: float
    unit: str = ""
    default: float | None = None
    lo: float | None = None
    hi: float | None = None
    flags: Flag = NO_FLAGS
    meaning: str = ""

    @property
    def group(self) -> str:
        """The group that its flags tell: identity, calibration, tuning, limits, or other."""
        return next((name for flag, name in GROUPS.items() if flag & self.flags), OTHER)

    @property
    def changed(self) -> bool:
        """Whether it has another value than its default."""
        return self.default is not None and not same(self.value, self.default)

    @property
    def lasts(self) -> bool:
        """Whether it stays as it is when the motor stops; what does not is in no dump and no difference."""
        return not self.flags & Flag.VOLATILE

    @property
    def loadable(self) -> bool:
        """Whether it can be written, and stays written."""
        return self.lasts and not self.flags & Flag.READ_ONLY

    def as_json(self) -> dict[str, Any]:
        """It as plain data."""
        return {
            "name": self.name,
            "value": self.value,
            "unit": self.unit,
            "default": self.default,
            "lo": self.lo,
            "hi": self.hi,
            "group": self.group,
            "flags": flag_words(self.flags),
            "changed": self.changed,
            "meaning": self.meaning,
        }


@dataclass(frozen=True)
class Parameters(Mapping[str, float]):
    """A mapping from names to values; `entries` tell more. `title` says whose they are, to a person.

    `identity` is what the device says of itself, as `bench.device.description.describe` has it, as far as it is known.
    """

    title: str
    entries: Mapping[str, ParameterEntry]
    identity: Mapping[str, Any] = field(default_factory=dict)

    def __getitem__(self, name: str) -> float:
        return self.entries[name].value

    def __iter__(self) -> Iterator[str]:
        return iter(self.entries)

    def __len__(self) -> int:
        return len(self.entries)

    def __repr__(self) -> str:
        return f"{len(self)} parameters of {self.title}"

    @property
    def serial(self) -> str:
        """Serial number of the device; empty where it is not told."""
        return str(self.identity.get("serial", ""))

    def entry(self, name: str) -> ParameterEntry:
        """What is known of one. BenchError, naming what is near, where there is none."""
        if name not in self.entries:
            hint = did_you_mean(name, self.entries, f"it has {len(self)}, which bench param list shows")
            raise BenchError(f"{self.title} has no parameter '{name}': {hint}")
        return self.entries[name]

    def chosen(self, groups: Sequence[str] = (), changed: bool = False) -> list[ParameterEntry]:
        """Those of some groups (none given: all), or of these that differ from their defaults, in the drive's order."""
        return [
            entry
            for entry in self.entries.values()
            if (not groups or entry.group in groups) and (entry.changed or not changed)
        ]

    def to_pandas(self) -> pd.DataFrame:
        """A row for each, by name."""
        import pandas as pd

        rows = [entry.as_json() for entry in self.entries.values()]
        return pd.DataFrame(rows).set_index("name") if rows else pd.DataFrame()


def flag_words(flags: Flag) -> list[str]:
    """What its flags say beside its group, as words."""
    return [(flag.name or "").lower().replace("_", " ") for flag in _FLAGS if flag & flags]


def same(a: float, b: float) -> bool:
    """Whether two values are one to a device: equal as float32, or neighbours there."""
    one, other = np.float32(a), np.float32(b)
    return bool(one == other or np.nextafter(one, other) == other)


def shortest(value: float, point: bool = False) -> str:
    """The shortest decimal that is this float32; with `point` as TOML has floats, so 900.0 in the place of 900."""
    text = str(np.float32(value))
    if np.float32(float(text)) != np.float32(value):  # twice rounded
        text = repr(float(value))
    return text if point else text.removesuffix(".0")
