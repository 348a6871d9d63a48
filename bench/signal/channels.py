"""Which channel of a drive is which: found by unit and flag, as the descriptor has them, never by name alone."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

from bench.signal.sources import source_short
from protocol.descriptor import Channel
from protocol.signals import Flag, Signal, Unit


def flagged(channels: Iterable[Channel | Signal], unit: Unit, *flags: Flag) -> str:
    """Name of the first channel in `unit` with the first of the `flags` that any has; empty if none has one."""
    of_unit = [channel for channel in channels if channel.unit == unit]
    return next((channel.name for flag in flags for channel in of_unit if channel.flags & flag), "")


def reference_angle(channels: Iterable[Channel | Signal]) -> str:
    """Name of the angle that position estimates are compared with: the encoder's; empty without one."""
    return flagged(channels, Unit.RAD, Flag.REFERENCE)


def speed_channel(channels: Iterable[Channel | Signal], parameters: Mapping[str, float]) -> str:
    """Name of the speed in rad/s to go by: the encoder's, else that of the angle that the drive uses, else the first.

    `channels` are those that are streamed. Empty where none has the flag REFERENCE or ESTIMATE.
    """
    speeds = [channel for channel in channels if channel.unit == Unit.RAD_PER_S]
    if reference := flagged(speeds, Unit.RAD_PER_S, Flag.REFERENCE):
        return reference
    own = f"omega_{source_short(parameters.get('observer', math.nan))}"
    estimates = [channel.name for channel in speeds if channel.flags & Flag.ESTIMATE]
    return own if own in estimates else next(iter(estimates), "")


def role(channel: Channel | Signal) -> str:
    """What a channel is to a host, in a word: reference, estimate, truth, or empty."""
    flags = (Flag.REFERENCE, Flag.ESTIMATE, Flag.TRUTH)
    return next((flag.name.lower() for flag in flags if channel.flags & flag and flag.name), "")
