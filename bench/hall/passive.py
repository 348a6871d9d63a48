"""Watches a shaft that somebody turns by hand. Energises nothing, and leaves state, faults and parameters alone.

So it also works on a drive that keeps a fault because of its Hall sensors, and beside a power stage that is off.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

from bench.findings.thresholds import LEAST_REACH
from bench.hall.turning import Turned, way
from bench.rig.rig import Rig
from protocol.descriptor import Channel

WATCHED = ("hall", "status", "theta_enc", "omega_enc", "i_a", "i_b")
FURTHER = "at least one revolution each way, and allow more time (--duration)"
LOOK = 0.5  # s between looks at how far it turned


def watched(rig: Rig) -> tuple[Channel, ...]:
    """Those of the channels that are watched which the drive has."""
    node = rig.drive.node
    there = {channel.name for channel in node.descriptor.channels}
    return node.channels([name for name in WATCHED if name in there])


def watch(rig: Rig, seconds: float, progress: Callable[[str], None]) -> Turned:
    """Record for `seconds`, or until the shaft was turned far enough both ways, or Ctrl-C.

    Raises BenchError without samples; HbpError.
    """
    first, end = rig.tick(), rig.client.now() + seconds
    with suppress(KeyboardInterrupt):
        while (left := end - rig.client.now()) > 0:
            rig.wait(min(LOOK, left))
            gone = way(rig.recorder, first)
            turned = f"{gone.up:.1f} electrical revolutions forward, {gone.down:.1f} reverse"
            if gone.reach < LEAST_REACH:
                turned += f", over {gone.reach:.1f}: go on in one direction"
            progress(f"turn the shaft by hand: {turned}, {left:.0f} s left")
            if gone.enough:
                break
    return Turned(rig.between(first, rig.recorder.newest), "by hand", further=FURTHER)
