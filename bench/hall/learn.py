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

from bench import files
from bench.analysis.waveforms.sectors import SECTORS
from bench.device.node import Node
from bench.errors import BenchError, NodeError
from bench.hall.health import Health, Outcome
from bench.rig.restore import not_put_back, put_back
from protocol.errors import HbpError
from protocol.signals import DRIVE_PARAMETERS
from sim.observers.hall_edges import EDGES

ENOUGH = math.radians(0.5)
"""rad, the widest half of a 95 % confidence interval with which an edge is learnt: the hysteresis of good sensors."""
PARAMETERS = {record.name: record for record in DRIVE_PARAMETERS if record.name in EDGES}


@dataclass(frozen=True)
class Learnt:
    """Ideal minus actual angle of the edges that open sectors I to VI, rad, each (6,)."""

    edge_up: tuple[float, ...]
    edge_down: tuple[float, ...]

    def parameters(self) -> dict[str, float]:
        """By the names of the drive's parameters."""
        return dict(zip(EDGES, self.edge_up + self.edge_down, strict=True))


def learnt(health: Health) -> Learnt:
    """The edges of a healthy check. BenchError, with what to do, where they are not to be used."""
    if health.outcome is Outcome.FAULT:
        more = f" (and {len(health.findings) - 1} more)" if len(health.findings) > 1 else ""
        first = health.findings[0]
        raise BenchError(f"no edges learnt: {first.cause}{more}; {first.advice}; then learn again")
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
        lo, hi = PARAMETERS[name].lo, PARAMETERS[name].hi
        if not lo <= value <= hi:
            raise BenchError(f"no edges learnt: {name} = {value:.3f} rad is not in {lo:g}..{hi:g} rad: move the sensor")
    return result


def write(drive: Node, found: Learnt) -> None:
    """Set the drive's parameters and read them back; where one is refused, all are put back as they were.

    BenchError for a refusal, and for a value that is not what was written.
    """
    values = found.parameters()
    before = {name: drive.parameter(name).value for name in values}
    try:
        for name, value in values.items():
            drive.set(name, value)
            stored = drive.parameter(name).value
            if stored != float(np.float32(value)):
                raise NodeError(f"{name} reads {stored:g} after {value:g} was written: nothing was changed")
    except BaseException:
        try:
            put_back(drive, before)
        except (BenchError, HbpError) as error:
            raise NodeError(f"{error}{not_put_back(before)}") from error
        raise


def save(path: Path, found: Learnt) -> None:
    """Write a .json by that ending, else a .toml, as the simulated drive's configuration has it. Raises BenchError."""
    if path.suffix == ".json":
        text = json.dumps({"unit": "rad", "edge_up": found.edge_up, "edge_down": found.edge_down}, indent=1) + "\n"
    else:
        rows = [f"{name} = [{', '.join(f'{v:.6f}' for v in values)}]" for name, values in vars(found).items()]
        about = f"# ideal minus actual angle of the {SECTORS} Hall edges, rad, opening sectors I to VI"
        text = "\n".join(["[firmware.hall_edges]", about, *rows, ""])
    files.write(path, text, f"--out {path}")


def check_out(path: Path) -> None:
    """BenchError unless the name says in which form the edges are to be written."""
    if path.suffix not in (".toml", ".json"):
        raise BenchError(f"--out {path}: the name must end in .toml or .json")
