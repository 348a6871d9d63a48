"""Hands measured Hall edges to the drive's parameters `edge_up_1` … `edge_down_6`, or to a file, if they are sure.

Refuses, before anything is written, where a check finds a fault, where confidence is too low, and where an edge is
farther off than the parameters reach. Nothing here energises anything or stores parameters for the next boot.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.acceptance.ending import put_back
from bench.acceptance.waveforms.sectors import SECTORS
from bench.errors import BenchError, NodeError
from bench.hall.health import Health, Outcome
from bench.node import Node

ENOUGH = math.radians(0.5)
"""rad, the widest half of a 95 % confidence interval with which an edge is learnt: the hysteresis of good sensors."""
REACH = 0.506
"""rad, as far off as the parameters go."""


@dataclass(frozen=True)
class Learnt:
    """Ideal minus actual angle of the edges that open sectors I to VI, rad, each (6,)."""

    edge_up: tuple[float, ...]
    edge_down: tuple[float, ...]

    def parameters(self) -> dict[str, float]:
        """By the names of the drive's parameters."""
        return {
            f"{name}_{number}": value
            for name, values in (("edge_up", self.edge_up), ("edge_down", self.edge_down))
            for number, value in enumerate(values, 1)
        }


def learnt(health: Health) -> Learnt:
    """The edges of a healthy check. BenchError, with what to do, where they are not to be used."""
    if health.outcome is Outcome.FAULT:
        more = f" (and {len(health.findings) - 1} more)" if len(health.findings) > 1 else ""
        raise BenchError(f"no edges learnt: {health.findings[0].cause}{more}; put it right and learn again")
    if health.outcome is Outcome.CANNOT_TELL:
        raise BenchError(f"no edges learnt: {health.missing[0]}")
    widest = health.measured.widest()
    if not widest <= ENOUGH:
        raise BenchError(
            f"no edges learnt: one is known to +-{math.degrees(widest):.2f} deg only (95 %, "
            f"{health.measured.least()} passages), {math.degrees(ENOUGH):g} deg are needed: let the shaft turn longer"
        )
    edges = health.measured.edges
    result = Learnt(tuple(e.delta(e.up) for e in edges), tuple(e.delta(e.down) for e in edges))
    for name, value in result.parameters().items():
        if abs(value) > REACH:
            raise BenchError(f"no edges learnt: {name} = {value:.3f} rad is beyond {REACH} rad: move the sensor")
    return result


def write(drive: Node, found: Learnt) -> None:
    """Set the drive's parameters and read them back; where one is refused, all are put back as they were.

    BenchError for a drive without them, for a refusal, and for a value that is not what was written.
    """
    values = found.parameters()
    if absent := [name for name in values if not drive.has_parameter(name)]:
        raise BenchError(
            f"node {drive.number} has no parameter {absent[0]}: write the edges to a file (--out) for its firmware"
        )
    before = {name: drive.parameter(name).value for name in values}
    try:
        for name, value in values.items():
            drive.set(name, value)
            stored = drive.parameter(name).value
            if stored != float(np.float32(value)):
                raise NodeError(f"{name} reads {stored:g} after {value:g} was written: nothing was changed")
    except BaseException:
        put_back(drive, before)
        raise


def save(path: Path, found: Learnt) -> None:
    """Write a .toml, as the simulated drive's configuration has it, or a .json. BenchError for another suffix."""
    check_suffix(path)
    if path.suffix == ".json":
        text = json.dumps({"unit": "rad", "edge_up": found.edge_up, "edge_down": found.edge_down}, indent=1) + "\n"
    else:
        rows = [f"{name} = [{', '.join(f'{v:.6f}' for v in values)}]" for name, values in vars(found).items()]
        about = f"# ideal minus actual angle of the {SECTORS} Hall edges, rad, opening sectors I to VI"
        text = "\n".join(["[firmware.hall_edges]", about, *rows, ""])
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise BenchError(f"cannot write {path}: {error.strerror}") from None


def check_suffix(path: Path) -> None:
    """BenchError unless the edges can be written to a file of that name."""
    if path.suffix not in (".toml", ".json"):
        raise BenchError(f"--out {path}: the name must end in .toml or .json")
