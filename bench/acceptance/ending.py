"""What becomes of a drive that has not answered STOP: its own watchdog is what is left.

Nothing here feeds the watchdog, or sends anything.
"""

from __future__ import annotations

from contextlib import suppress

from bench.node import Node
from protocol.codes import fault_names
from protocol.errors import HbpError
from protocol.messages import DriveState, Heartbeat

WATCHDOG = 1.5  # s in which a drive that is no longer fed should have switched itself off
ENERGISED = (DriveState.ARMED, DriveState.RUNNING)


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
