"""How a test ends: every step is tried whatever another raises, parameters go back, a drive that is deaf is watched.

A drive that has not answered STOP has its own watchdog left. Nothing here feeds a watchdog, or energises anything.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import partial

from bench.node import Node
from protocol.codes import fault_names
from protocol.errors import HbpError
from protocol.messages import DriveState, Heartbeat

WATCHDOG = 1.5  # s in which a drive that is no longer fed should have switched itself off
ENERGISED = (DriveState.ARMED, DriveState.RUNNING)


def try_all(steps: Iterable[Callable[[], object]]) -> None:
    """Take every step, whatever one of them raises; raise the first of that at the end."""
    first: Exception | None = None
    for step in steps:
        try:
            step()
        except Exception as error:
            first = first or error
    if first is not None:
        raise first


def put_back(node: Node, before: dict[str, float]) -> None:
    """Set the parameters of `node` to the values `before`, in that order, and take out of it what was set.

    One that is refused stays there and keeps no other from being set; the first error is raised at the end.
    """

    def set_one(name: str) -> None:
        node.set(name, before[name])
        del before[name]

    try_all([partial(set_one, name) for name in before])


def not_put_back(before: Mapping[str, float], where: str = "") -> str:
    """What `put_back` has left of `before`, as a part of a sentence; empty where that is nothing."""
    names = ", ".join(f"{name} (was {value:g})" for name, value in before.items())
    return f"; not put back{where}: {names}" if names else ""


def watch_it_stop(drive: Node, last: Heartbeat | None) -> str:
    """Go on, for `WATCHDOG` s at most, until `drive` is off. What its heartbeats after `last` showed, in words."""
    newest = last

    def off() -> bool:
        nonlocal newest
        newest = drive.client.heartbeats.get(drive.number)
        return newest is not None and newest is not last and newest.state not in ENERGISED

    with suppress(HbpError):
        drive.client.wait(off, WATCHDOG)
    if newest is None or newest is last:
        return "nothing was heard of the drive since, whose watchdog should have switched its outputs off"
    if newest.state in ENERGISED:
        return f"{WATCHDOG:g} s later the drive is still {newest.state.name}: switch its supply off"
    faults = ", ".join(fault_names(newest.faults))
    return f"the drive was then seen to be {newest.state.name}" + (f" ({faults})" if faults else "")
