"""A simulated drive that does as it should and says what is not so, over any link: before its session encodes it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from protocol.descriptor import Descriptor
from protocol.device.records import Samples, made
from protocol.messages import Heartbeat
from sim.ports.device import SimulatedDevice

Records = np.ndarray[Any, Any]


def of_edges(device: SimulatedDevice, lie: Callable[[Records], Records]) -> SimulatedDevice:
    """`lie` makes of EDGES records what is sent."""
    push = device.drive.push_edges
    device.drive.push_edges = lambda records: push(lie(records.copy()))  # type: ignore[method-assign]
    return device


def of_samples(device: SimulatedDevice, lie: Callable[[Records], Records]) -> SimulatedDevice:
    """`lie` makes of samples, of all channels, what is sent."""
    push, every = device.drive.push_samples, frozenset(channel.name for channel in device.drive.app.channels)

    def pushed(index: int, tick: int, raw: Samples) -> None:
        push(index, tick, lie(made(raw, every).copy()))

    device.drive.push_samples = pushed  # type: ignore[method-assign]
    return device


def of_heartbeats(device: SimulatedDevice, lie: Callable[[Heartbeat], dict[str, object]]) -> SimulatedDevice:
    """`lie` says which fields of a heartbeat are something else."""
    tell = device.drive.heartbeat

    def told() -> Heartbeat:
        heartbeat = tell()
        return replace(heartbeat, **lie(heartbeat))  # type: ignore[arg-type]

    device.drive.heartbeat = told  # type: ignore[method-assign]
    return device


def of_flags(device: SimulatedDevice, name: str, more: int) -> SimulatedDevice:
    """The descriptor gives the channel `name` `more` flags."""
    drive = device.drive
    channels = [replace(c, flags=c.flags | more) if c.name == name else c for c in drive.app.channels]
    drive.descriptor = Descriptor.of(channels, drive.app.parameters)
    drive._blobs._fixed[0] = drive.descriptor.pack()
    return device
