"""Faults of the Hall wiring, put in on purpose: by the rig's fault insertion, or by a person who is asked.

A rig inserts faults where the load machine's node has the parameters `hall_open`, `hall_swap` and `hall_glitch`, as
the simulated one has, and shorts wires where it has `hall_short`. A person breaks and exchanges wires as well, also
while the motor turns, but makes no false pulses. What was put in goes away at the test's end, once the drive is off.
"""

from __future__ import annotations

from collections.abc import Collection
from contextlib import suppress
from typing import TYPE_CHECKING

import pytest

from bench.errors import BenchError
from bench.rig.loads import NodeLoad

if TYPE_CHECKING:
    from bench.rig.rig import Rig

WIRES = {"a": 1, "b": 2, "c": 4}
PAIRS = {"ab": 1, "bc": 2, "ca": 3}
PARAMETERS = ("hall_open", "hall_swap", "hall_glitch")
SHORT = "hall_short"
PLACEMENT = tuple(f"hall_delta_{s}" for s in range(1, 7))


def offered(rig: Rig, parameters: Collection[str]) -> NodeLoad | None:
    """The load machine if it has all these parameters: by `PARAMETERS` the rig itself inserts faults, by `PLACEMENT` it
    moves the Hall sensors.
    """
    load = rig.load
    return load if isinstance(load, NodeLoad) and all(map(load.node.has_parameter, parameters)) else None


class HallFaults:
    """The Hall wires between motor and drive."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._node = offered(rig, PARAMETERS)
        self._by_hand = False  # a person has put one in
        rig.at_end.append(self._put_right)

    def open(self, wire: str) -> None:
        """Break the wire `a`, `b` or `c`; the drive's input is pulled up."""
        self._set("hall_open", WIRES[wire], f"Disconnect the wire of Hall sensor {wire}")

    def short(self, wire: str) -> None:
        """Short the wire to ground; the test is skipped where the rig cannot."""
        if self._node is None or not self._node.node.has_parameter(SHORT):
            pytest.skip("needs a rig that shorts Hall wires")
        self._node.set(SHORT, WIRES[wire])

    def swap(self, pair: str) -> None:
        """Exchange two wires: `ab`, `bc` or `ca`."""
        self._set("hall_swap", PAIRS[pair], f"Exchange the wires of the Hall sensors {pair[0]} and {pair[1]}")

    def glitches(self, per_second: float) -> None:
        """Short false pulses; the test is skipped where the rig cannot make them."""
        if self._node is None:
            pytest.skip("needs a rig that makes false pulses on the Hall wires")
        self._node.set("hall_glitch", per_second)

    def clear(self) -> None:
        """Everything as it belongs."""
        if self._node is not None:
            for name in (*PARAMETERS, SHORT):
                if self._node.node.has_parameter(name):
                    self._node.set(name, 0.0)
        elif self._by_hand:
            self._rig.ask("Put the Hall wires back as they belong")
            self._by_hand = False

    def _put_right(self) -> None:
        """What the rig has put in goes with the load's parameters."""
        with suppress(BenchError):  # the drive is off, and nobody may be there any more
            if self._node is None:
                self.clear()

    def _set(self, name: str, value: float, words: str) -> None:
        if self._node is not None:
            self._node.set(name, value)
        else:
            self._by_hand = True
            self._rig.ask(words)
