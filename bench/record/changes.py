"""Parameters that were set during a run: each change once, with the time that the drive tells, where it tells one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from bench.device.heard import ParameterSet
from bench.signal.parameters import Change, ParameterCourse

NEAR = 20_000_000  # ticks, 1 s of the fastest clock that drives have: a set and the event that tells it are not farther


def settled(changes: Iterable[ParameterSet]) -> tuple[ParameterSet, ...]:
    """The same without what this host has dated, where the node's own event tells of it too, in the order they came."""
    kept = list(changes)
    for told in [change for change in kept if change.exact]:
        same = [c for c in kept if not c.exact and c[1:4] == told[1:4] and abs(c.tick - told.tick) <= NEAR]
        if same:
            kept.remove(min(same, key=lambda change: abs(change.tick - told.tick)))
    return tuple(kept)


def course(initial: Mapping[str, float], changes: Iterable[ParameterSet]) -> ParameterCourse:
    """Parameters of one node over a run; `changes` are its own, all of one boot, each once (see `settled`)."""
    return ParameterCourse(initial, (Change(c.tick, c.name, c.value) for c in changes))
