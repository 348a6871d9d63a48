"""All checks, in the order in which they run."""

from __future__ import annotations

from bench.conform import (
    blobs,
    can,
    capture,
    capture_states,
    capture_triggers,
    commission,
    data,
    feeding,
    identity,
    link,
    means,
    motion,
    moving,
    parameters,
    setpoints,
    states,
    streams,
)
from bench.conform.checks import TABLE, Carrier, Check

MODULES = (
    link,
    identity,
    parameters,
    blobs,
    streams,
    data,
    capture,
    capture_triggers,
    means,
    states,
    feeding,
    setpoints,
    capture_states,
    commission,
    motion,
    moving,
    can,
)
"""In the order in which their checks run; those of a module run as they stand in its text."""


def checks() -> list[Check]:
    """Those of all levels."""
    places = {module.__name__: place for place, module in enumerate(MODULES)}
    return sorted(TABLE.values(), key=lambda check: places[check.body.__module__])


def chosen(level: int, bus: bool) -> list[Check]:
    """Those that run at a level: of CAN too, on a bus, where they need no more."""
    return [check for check in checks() if check.needs <= level and (check.carrier is not Carrier.BUS or bus)]
