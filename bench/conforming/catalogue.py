"""All checks, in the order in which they run: that of the imports below, and within a module that of the text."""

from __future__ import annotations

from bench.conforming import can, data, identity, link, motion, parameters, setpoints, states, streams
from bench.conforming.checks import TABLE, Carrier, Check

MODULES = (link, identity, parameters, streams, data, states, setpoints, motion, can)


def checks() -> list[Check]:
    """Those of all levels."""
    return list(TABLE.values())


def chosen(level: int, bus: bool) -> list[Check]:
    """Those that run at a level: of CAN too, on a bus, where they need no more."""
    return [check for check in checks() if check.needs <= level and (check.carrier is not Carrier.BUS or bus)]
