"""Parameters that are changed while the motor turns: each change is a mark with both values, the end puts all back."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Protocol

from bench.device.node import Node
from bench.errors import BenchError, NodeError
from bench.rig.restore import try_all
from protocol.signals import Flag

STEP = 1.05
"""Factor of one step."""
OF_RANGE = 1e-3  # a step from 0, as a share of the way to the end of the range


class Tunable(Protocol):
    """What a drive of a rig is here."""

    node: Node
    parameters: dict[str, float]
    marked: Callable[[str, int], object]

    def set(self, name: str, value: float) -> None:
        """Set a parameter, which the end of the rig puts back."""


class Tuning(Mapping[str, float]):
    """Parameters of a drive by name, as they are; `tuning["k_p_vt"] = 900` sets one, and marks that.

    Raises NodeError for a name that the drive does not have, or that it does not let one set while it runs.
    """

    def __init__(self, drive: Tunable, names: tuple[str, ...]) -> None:
        self._drive = drive
        records = {record.name: record for record in drive.node.descriptor.parameters}
        if unknown := [name for name in names if name not in records]:
            drive.node.parameter(unknown[0])  # raises, with what is near
        for flag, why in ((Flag.READ_ONLY, "can only be read"), (Flag.IDLE_ONLY, "is set with the outputs off only")):
            if refused := [name for name in names if records[name].flags & flag]:
                raise NodeError(f"{refused[0]} {why}: it cannot be tuned")
        self._records = {name: records[name] for name in names}
        self.before = {name: drive.node.parameter(name).value for name in names}
        """The values before the tuning began."""

    def __getitem__(self, name: str) -> float:
        self._require(name)
        return self._drive.parameters.get(name, self.before[name])

    def __setitem__(self, name: str, value: float) -> None:
        before, node = self[name], self._drive.node
        self._drive.set(name, value)
        now = self[name]
        if now == before:
            return
        unit = f" {self._records[name].unit.symbol}".rstrip()
        tick = node.client.changed[node.number, name].tick
        self._drive.marked(f"{name} {before:.6g} -> {now:.6g}{unit}", tick)

    def __iter__(self) -> Iterator[str]:
        return iter(self._records)

    def __len__(self) -> int:
        return len(self._records)

    def step(self, name: str, steps: int) -> None:
        """Change one by 5 % for each step, up or down; a whole number by 1; within its range. Raises NodeError."""
        self._require(name)
        now, known = self[name], self._drive.node.parameter(name)
        if self._records[name].flags & Flag.WHOLE:
            wanted = now + steps
        elif now == 0.0:
            wanted = OF_RANGE * (known.hi if steps > 0 else -abs(known.lo)) * abs(steps)
        else:
            wanted = now * STEP ** (steps if now > 0.0 else -steps)
        self[name] = min(max(wanted, known.lo), known.hi)

    def put_back(self) -> None:
        """Give all the values from before; all of it is tried, the first error is raised at the end."""
        changed = [name for name in reversed(list(self)) if self[name] != self.before[name]]
        try_all([partial(self.__setitem__, name, self.before[name]) for name in changed])

    def changes(self) -> str:
        """What has another value than before, in words; empty where nothing has."""
        changed = {name: now for name, now in self.items() if now != self.before[name]}
        return ", ".join(f"{name} {self.before[name]:.6g} -> {now:.6g}" for name, now in changed.items())

    def _require(self, name: str) -> None:
        if name not in self._records:
            raise BenchError(f"{name} is not tuned: name it at the beginning; it is {', '.join(self._records)}")
