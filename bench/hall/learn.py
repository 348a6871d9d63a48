"""Hands Hall edges, measured or learned, to the drive's parameters, or to a file, if they are sure.

`edge_up_1` … `edge_down_6`, and how sure they are, `edge_sd`; where the ring stands and how it is wired, `hall_offset`,
`hall_swap_hat` and `hall_invert_hat`, where the drive has them; what a filter has learned of the motor too, if asked
for. Refuses, before anything is written, where a check finds a fault that those do not mend, where the same evidence
contradicts what was measured, where confidence is too low, and where a value is farther off than its parameter reaches.
Nothing here energises anything.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from bench import files
from bench.device.node import Node
from bench.errors import BenchError, NodeError
from bench.findings import wiring
from bench.findings.encoder import SLIPS, TELL, ahead
from bench.findings.finding import Finding, degrees, percent
from bench.findings.health import Health
from bench.findings.thresholds import (
    BEATS,
    HYSTERESIS,
    LEARN_ASIDE,
    LEARN_LEG,
    LEARN_MOTOR,
    LEARN_SD,
    LEARN_WITHIN,
    SET,
)
from bench.findings.wiring import Wired, hats
from bench.hall.lessons import Lessons
from bench.rig.restore import not_put_back, put_back
from bench.signal.edge_fit import OPENS
from bench.signal.hall_inputs import Net
from bench.signal.position import wrapped
from bench.signal.verdict import Verdict
from bench.signal.waveforms.sectors import SECTOR_WIDTH, SECTORS
from protocol.errors import HbpError
from protocol.messages import Fault
from protocol.signals import DRIVE_PARAMETERS
from sim.observers.hall_edges import EDGES

ZERO = math.radians(0.5)
"""rad, to which the zero of an encoder is known, rms: it is in every edge that the encoder measures."""
NORMAL_95 = 1.96  # standard deviations to the half width of 95 %
PARAMETERS = {record.name: record for record in DRIVE_PARAMETERS}
OFFSET, HATS = "hall_offset", ("hall_swap_hat", "hall_invert_hat")
SETTABLE = frozenset({"wiring", "hall_setting"})
"""Findings that parameters of the drive mend."""
SLOWER = "let the drive capture its edges, or turn it slower"
BOTH_WAYS = "turn the shaft forward, in reverse and forward again, at two speeds or more"
ADVICE = "or give the firmware {} (docs/firmware.md, step 5)"
DIRECTION = (
    "the Hall codes come in reverse order: that the encoder counts in the right direction is taken for granted, no "
    f"back-EMF tells it. Verify it: start the motor forward by its Hall sensors, slowly; if it does not run, {TELL}"
)


@dataclass(frozen=True)
class Learnt:
    """Ideal minus actual angle of the edges that open sectors I to VI, rad, each (6,)."""

    edge_up: tuple[float, ...]
    edge_down: tuple[float, ...]
    edge_sd: float
    """rad, standard deviation of all of a way together."""
    motor: Mapping[str, float] = field(default_factory=dict)
    """Parameters of the motor, by name."""
    settings: Mapping[str, float] = field(default_factory=dict)
    """Where the ring stands and how it is wired: those of `hall_offset` and the two others that the drive has."""
    assumed: str = ""
    """What was taken for granted, and how to verify it, in words."""

    def parameters(self) -> dict[str, float]:
        """By the names of the drive's parameters."""
        edges = dict(zip(EDGES, self.edge_up + self.edge_down, strict=True))
        return {**self.settings, **edges, "edge_sd": self.edge_sd, **self.motor}


def learnt(health: Health, parameters: Mapping[str, float]) -> Learnt:
    """The edges of a check, and the settings that make it healthy; `parameters`: those that the drive has.

    BenchError, with what to do, where they are not to be used.
    """
    _require_none_but(health, SETTABLE)
    if health.verdict is Verdict.INVALID:
        raise BenchError(f"no edges learned: {health.missing[0]}")
    measured = health.measured
    wired = _wired(health, parameters)
    widest, most = measured.widest(), math.degrees(LEARN_WITHIN)
    coarse, step = health.resolution > LEARN_WITHIN, degrees(BEATS * health.resolution)
    if not widest <= LEARN_WITHIN:
        raise BenchError(
            f"no edges learned: the least certain is known to +-{math.degrees(widest):.2f} deg (95 %, "
            f"{measured.least()} passages); +-{most:g} deg are needed: "
            + (f"a step of the times and angles is {step}: {SLOWER}" if coarse else "turn the shaft longer")
        )
    _require_consistent(health)
    settings = _settings(wired, parameters)
    offset = settings.get(OFFSET, 0.0)
    up: list[float] = []
    down: list[float] = []
    for sector, (sensor, rises) in enumerate(OPENS):
        at = wired.sensors.index(sensor)
        edge = measured.edges[OPENS.index((at, rises ^ bool(wired.inverted >> at & 1)))]
        for way, passages in ((up, edge.up), (down, edge.down)):
            way.append(wrapped(offset + sector * SECTOR_WIDTH - passages.angle))
    assumed = DIRECTION if measured.inputs.ratio < 0.0 and health.emf is None else ""
    return within(Learnt(tuple(up), tuple(down), _standard_deviation(health), {}, settings, assumed))


def require_no_fault(health: Health, parameters: Mapping[str, float]) -> None:
    """BenchError, with what to do, where a check found a fault, or the ring not where the drive takes it to stand."""
    _require_none_but(health, frozenset())
    if not health.measured.blind:
        _wired(health, parameters)


def _require_none_but(health: Health, mended: frozenset[str]) -> None:
    left = [finding for finding in health.findings if finding.code not in mended]
    if left:
        raise _refusal(left[0], len(left) - 1)


def _refusal(first: Finding, more: int, besides: str = "") -> BenchError:
    others = f" (and {more} more)" if more else ""
    return BenchError(f"no edges learned: {first.cause}{others}; {first.advice}{besides}; then learn again")


def _wired(health: Health, parameters: Mapping[str, float]) -> Wired:
    """The wiring to be taken: with as little changed as the drive's parameters can tell, and the ring nearest.

    BenchError where they can tell none.
    """
    declared, hats = parameters.get(OFFSET), all(name in parameters for name in HATS)
    target = declared or 0.0
    found = wiring.possible(health.measured, health.emf)
    fit = [w for w in found if (hats or not w.changes) and (declared is not None or w.off(target) < SET)]
    if fit:
        return min(fit, key=lambda w: (w.changes, w.inverted.bit_count(), w.off(target)))
    needed = [OFFSET] * (declared is None) + [*HATS] * (not hats)
    lacking = ADVICE.format(", ".join(needed))
    if health.findings:
        raise _refusal(health.findings[0], len(health.findings) - 1, f", {lacking}")
    stands = " or ".join(degrees(w.ring) for w in found if not w.changes) or "an unknown angle"
    raise BenchError(
        f"no edges learned: the ring stands at {stands}, the drive takes it to stand at 0: turn it, {lacking}"
    )


def _settings(wired: Wired, parameters: Mapping[str, float]) -> dict[str, float]:
    """What the drive's parameters have to be, those that it has; codes came through the wiring that it has now."""
    settings = {}
    if OFFSET in parameters:
        settings[OFFSET] = parameters[OFFSET] if wired.off(parameters[OFFSET]) < SET else wired.ring
    if all(name in parameters for name in HATS):
        settings |= dict(zip(HATS, hats(wired, int(parameters[HATS[0]]), int(parameters[HATS[1]])), strict=True))
    return settings


def _require_consistent(health: Health) -> None:
    """BenchError where the evidence contradicts the edges by less than a fault, but more than they are to be known."""
    fit, sd, words = health.measured.fit, _standard_deviation(health), ""
    if fit is not None:
        both, aside = float(np.mean(fit.hysteresis)), fit.aside / max(1, fit.passages + fit.aside)
        moves, of_times = [abs(step.size) for step in fit.common.steps], BEATS * health.resolution
        largest = max([*moves, fit.common.drifted])
        if (moves or fit.common.drifted > LEARN_WITHIN) and largest < of_times:
            words = (
                f"all edges moved by up to {degrees(largest)} together, less than a step of the times and angles that "
                f"were recorded ({degrees(of_times)}): {SLOWER}"
            )
        elif moves and not _index(health):
            slips = ", ".join(degrees(step.size) for step in fit.common.steps)
            words = f"all edges moved by {slips} while the shaft turned, as an encoder that slips makes them; {SLIPS}"
        elif fit.common.drifted > LEARN_WITHIN:
            words = f"all edges drifted by {degrees(fit.common.drifted)}: the encoder loses counts; {SLIPS}"
        elif aside > LEARN_ASIDE:
            words = f"{percent(aside)} of the passages lie far from their edges; run bench hall check"
        elif both < -LEARN_WITHIN:
            words = f"all edges have a hysteresis of {degrees(both)}, which no sensor has: the encoder slips or is late"
            words += f"; {SLIPS}; {BOTH_WAYS}"
        elif sd > LEARN_SD:
            words = (
                f"edges are known to {degrees(sd)} (standard deviation): a hysteresis of {degrees(both)} in the mean"
            )
            words += f" may hide a slip of the encoder, or a delay; {BOTH_WAYS}"
    if words:
        raise BenchError(f"no edges learned: {words}; then learn again")


def _index(health: Health) -> bool:
    """Whether the jump that there is was made right by an index pulse, beyond doubt."""
    return any(note.code == "index" for note in health.notes)


def _standard_deviation(health: Health) -> float:
    """`edge_sd`: all that an edge may be off by, the encoder's zero, its drift and what the hysteresis may hide."""
    measured, fit = health.measured, health.measured.fit
    parts = [ZERO, ahead(health.emf), measured.widest() / NORMAL_95]
    if fit is not None:
        both = float(np.mean(fit.hysteresis))
        parts += [fit.common.drifted, 0.0 if _index(health) else np.nan_to_num(fit.common.scatter)]
        if not _to_and_fro_again(measured.inputs.net):  # the encoder may have slipped where the shaft turned back
            parts.append(max(HYSTERESIS[1] - both, both - HYSTERESIS[0]) / 2.0)
        if math.isnan(measured.delay):  # in the hysteresis are the delays of rising and of falling edges
            parts.append(float(np.max(np.abs(fit.hysteresis))) / 2.0)
    return math.hypot(*parts)


def _to_and_fro_again(net: Net) -> bool:
    """Whether the shaft went one way, the other, and the first again: a slip is then told from hysteresis."""
    steps = np.diff(net.sectors)
    starts = np.flatnonzero(np.diff(np.sign(steps), prepend=0))
    legs = np.add.reduceat(steps, starts) if len(starts) else steps
    ways = np.sign(legs[np.abs(legs) >= LEARN_LEG * SECTORS])
    return int(np.count_nonzero(np.diff(ways))) >= 2


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
    return within(Learnt(tuple(edges[:6]), tuple(edges[6:]), sd, of_motor))


def within(found: Learnt) -> Learnt:
    """BenchError for what a parameter does not reach."""
    for name, value in found.parameters().items():
        lo, hi, unit = PARAMETERS[name].lo, PARAMETERS[name].hi, PARAMETERS[name].unit.symbol
        if not lo <= value <= hi:
            what = "move the sensor" if name in EDGES else "implausible"
            raise BenchError(f"no edges learned: {name} = {value:.3g} {unit} is outside {lo:g}..{hi:g} {unit}: {what}")
    return found


def write(drive: Node, found: Learnt) -> dict[str, tuple[float, float]]:
    """Set the drive's parameters and read them back; where one is refused, all are put back as they were.

    What each was, and is: a drive need not have `edge_sd`, and settings that are right are left alone. BenchError for a
    refusal, and for a value that is not what was written.
    """
    values = found.parameters()
    if not drive.has_parameter("edge_sd"):
        del values["edge_sd"]
    before = {name: drive.parameter(name).value for name in values}
    right = [name for name in found.settings if before[name] == float(np.float32(values[name]))]
    for name in right:
        del values[name], before[name]
    changed = {name: (before[name], value) for name, value in values.items()}
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
    heard = drive.next_heartbeat()
    if any(name in changed for name in HATS) and heard is not None and heard.faults == Fault.HALL:
        with suppress(BenchError, HbpError):
            drive.clear_faults()  # a code that was none is one now
    return changed


def save(path: Path, found: Learnt, motor: str = "") -> None:
    """Write a .json by that ending, else a .toml, as the simulated drive's configuration has it. Raises BenchError.

    `motor`: sections of that configuration that say where the edges of its motor lie; they go before, into a .toml.
    """
    if path.suffix == ".json":
        edges = {"unit": "rad", "edge_up": found.edge_up, "edge_down": found.edge_down, "edge_sd": found.edge_sd}
        text = json.dumps({**edges, **_whole(found.settings), **found.motor}, indent=1) + "\n"
    else:
        text = motor + toml(found)
    files.write(path, text, f"--out {path}")


def toml(found: Learnt) -> str:
    """The sections of a configuration of the simulated drive that say what its firmware knows of the edges."""
    of_drive = [f"{name} = {value:.6g}" for name, value in {**found.motor, **_whole(found.settings)}.items()]
    ways = {"edge_up": found.edge_up, "edge_down": found.edge_down}
    rows = [f"{name} = [{', '.join(f'{v:.6f}' for v in values)}]" for name, values in ways.items()]
    about = f"# ideal minus actual angle of the {SECTORS} Hall edges, rad, opening sectors I to VI"
    rows.append(f"edge_sd = {found.edge_sd:.6f} # standard deviation common to all edges of one direction")
    head = ["[firmware]", *of_drive, ""] if of_drive else []
    return "\n".join([*head, "[firmware.hall_edges]", about, *rows, ""])


def _whole(settings: Mapping[str, float]) -> dict[str, float]:
    return {name: int(value) if name in HATS else value for name, value in settings.items()}


def check_out(path: Path) -> None:
    """BenchError unless the name says in which form the edges are to be written."""
    if path.suffix not in (".toml", ".json"):
        raise BenchError(f"--out {path}: the name must end in .toml or .json")
