"""What changes in a device's parameters, as it changes: by the device's own events, and by asking for the rest."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import cycle
from typing import NamedTuple

from bench.device.client import POLL
from bench.device.heard import Changes, ParameterSet
from bench.device.node import Node
from bench.param.table import Parameters, same

ASKS = 0.02  # s from one question to the next, of a device that tells nothing by itself
ALSO_ASKS = 0.2  # s, of one that does: an event may be lost


class Watched(NamedTuple):
    """A parameter has changed. `seconds`: device time, as the device told it; else of the newest that was heard."""

    seconds: float
    name: str
    before: float
    value: float
    exact: bool


def watch(node: Node, parameters: Parameters, seconds: float = math.inf) -> Iterator[Watched]:
    """Each change of `parameters`, which a device has now, for so many s of the link's clock. Raises HbpError."""
    client, values, told = node.client, dict(parameters), list[ParameterSet]()
    sink = Changes(node.number, told.append)
    client.sinks.append(sink)
    end, period = client.now() + seconds, ALSO_ASKS if node.identity.minor else ASKS
    names, due = cycle(values), client.now() + period
    hz = node.identity.tick_hz
    try:
        while client.now() < end:
            client.poll(min(POLL, max(end - client.now(), 0.0)))
            if values and client.now() >= due:
                name = next(names)
                value, due = node.parameter(name).value, client.now() + period
                told.append(ParameterSet(client.newest(node.number), node.number, name, value))
            while told:
                change = told.pop(0)
                before, values[change.name] = values[change.name], change.value
                if not same(before, change.value):
                    yield Watched(change.tick / hz, change.name, before, change.value, change.exact)
    finally:
        client.sinks.remove(sink)
