"""Hands Hall edges, measured or learned, to the drive's parameters, or to a file, if they are sure.

`edge_up_1` … `edge_down_6`, and how sure they are, `edge_sd`; what a filter has learned of the motor too, if asked for.
Refuses, before anything is written, where a check finds a fault, where confidence is too low, and where a value is
farther off than its parameter reaches. Nothing here energises anything.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from bench import files
from bench.device.node import Node
from bench.errors import BenchError, NodeError
from bench.findings.health import Health
from bench.findings.thresholds import LEARN_MOTOR, LEARN_SD, LEARN_WITHIN
from bench.hall.lessons import Lessons
from bench.rig.restore import not_put_back, put_back
from bench.signal.verdict import Verdict
from bench.signal.waveforms.sectors import SECTORS
from protocol.errors import HbpError
from protocol.signals import DRIVE_PARAMETERS
from sim.observers.hall_edges import EDGES

ZERO = math.radians(0.5)
"""rad, to which the zero of an encoder is known, rms: it is in every edge that the encoder measures."""
NORMAL_95 = 1.96  # standard deviations to the half width of 95 %
PARAMETERS = {record.name: record for record in DRIVE_PARAMETERS}


@dataclass(frozen=True)
class Learnt:
    """Ideal minus actual angle of the edges that open sectors I to VI, rad, each (6,)."""

    edge_up: tuple[float, ...]
    edge_down: tuple[float, ...]
    edge_sd: float
    """rad, standard deviation of all of a way together."""
    motor: Mapping[str, float] = field(default_factory=dict)
    """Parameters of the motor, by name."""

    def parameters(self) -> dict[str, float]:
        """By the names of the drive's parameters."""
        edges = dict(zip(EDGES, self.edge_up + self.edge_down, strict=True))
        return {**edges, "edge_sd": self.edge_sd, **self.motor}


def learnt(health: Health) -> Learnt:
    """The edges of a healthy check. BenchError, with what to do, where they are not to be used."""
    require_no_fault(health)
    if health.verdict is Verdict.INVALID:
        raise BenchError(f"no edges learned: {health.missing[0]}")
    widest, most = health.measured.widest(), math.degrees(LEARN_WITHIN)
    if not widest <= LEARN_WITHIN:
        raise BenchError(
            f"no edges learned: the least certain is known to +-{math.degrees(widest):.2f} deg (95 %, "
            f"{health.measured.least()} passages); +-{most:g} deg are needed: turn the shaft longer"
        )
    edges = health.measured.edges
    up, down = tuple(e.delta(e.up) for e in edges), tuple(e.delta(e.down) for e in edges)
    return _within(Learnt(up, down, math.hypot(ZERO, widest / NORMAL_95)))


def require_no_fault(health: Health) -> None:
    """BenchError, with what to do, where a check found a fault."""
    if health.verdict is Verdict.FAIL:
        more = f" (and {len(health.findings) - 1} more)" if len(health.findings) > 1 else ""
        first = health.findings[0]
        raise BenchError(f"no edges learned: {first.cause}{more}; {first.advice}; then learn again")


def taught(lessons: Lessons, motor: bool) -> Learnt:
    """What a filter has learned; of the motor what it is sure of, if asked for. BenchError where it is not sure."""
    sd = max(lessons.of[name].sd for name in EDGES)
    if not sd <= LEARN_SD:
        raise BenchError(
            f"no edges learned: {lessons.whose} knows them to {math.degrees(sd):.1f} deg (standard deviation); "
            f"{math.degrees(LEARN_SD):g} deg are needed: turn the shaft longer and faster, both directions, under load"
        )
    edges = [lessons.of[name].value for name in EDGES]
    of_motor = {
        name: lessons.of[name].value
        for name, share in LEARN_MOTOR.items()
        if motor and name in lessons.of and lessons.of[name].sd <= share * abs(lessons.of[name].value)
    }
    return _within(Learnt(tuple(edges[:6]), tuple(edges[6:]), sd, of_motor))


def _within(found: Learnt) -> Learnt:
    """BenchError for what a parameter does not reach."""
    for name, value in found.parameters().items():
        lo, hi, unit = PARAMETERS[name].lo, PARAMETERS[name].hi, PARAMETERS[name].unit.symbol
        if not lo <= value <= hi:
            what = "move the sensor" if name in EDGES else "implausible"
            raise BenchError(f"no edges learned: {name} = {value:.3g} {unit} is outside {lo:g}..{hi:g} {unit}: {what}")
    return found


def write(drive: Node, found: Learnt) -> int:
    """Set the drive's parameters and read them back; where one is refused, all are put back as they were.

    How many were set: a drive need not have `edge_sd`. BenchError for a refusal, and for a value that is not what was
    written.
    """
    values = found.parameters()
    if not drive.has_parameter("edge_sd"):
        del values["edge_sd"]
    before = {name: drive.parameter(name).value for name in values}
    try:
        for name, value in values.items():
            drive.set(name, value)
            stored = drive.parameter(name).value
            if stored != float(np.float32(value)):
                raise NodeError(f"{name} reads back {stored:g} after writing {value:g}: nothing was changed")
    except BaseException:
        try:
            put_back(drive, before)
        except (BenchError, HbpError) as error:
            raise NodeError(f"{error}{not_put_back(before)}") from error
        raise
    return len(values)


def save(path: Path, found: Learnt) -> None:
    """Write a .json by that ending, else a .toml, as the simulated drive's configuration has it. Raises BenchError."""
    if path.suffix == ".json":
        edges = {"unit": "rad", "edge_up": found.edge_up, "edge_down": found.edge_down, "edge_sd": found.edge_sd}
        text = json.dumps({**edges, **found.motor}, indent=1) + "\n"
    else:
        motor = [f"{name} = {value:.6g}" for name, value in found.motor.items()]
        ways = {"edge_up": found.edge_up, "edge_down": found.edge_down}
        rows = [f"{name} = [{', '.join(f'{v:.6f}' for v in values)}]" for name, values in ways.items()]
        about = f"# ideal minus actual angle of the {SECTORS} Hall edges, rad, opening sectors I to VI"
        rows.append(f"edge_sd = {found.edge_sd:.6f} # standard deviation common to all edges of one direction")
        head = ["[firmware]", *motor, ""] if motor else []
        text = "\n".join([*head, "[firmware.hall_edges]", about, *rows, ""])
    files.write(path, text, f"--out {path}")


def check_out(path: Path) -> None:
    """BenchError unless the name says in which form the edges are to be written."""
    if path.suffix not in (".toml", ".json"):
        raise BenchError(f"--out {path}: the name must end in .toml or .json")
