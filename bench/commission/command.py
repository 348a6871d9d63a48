"""`bench commission` from target to result: limits, consent, rig, the steps one by one. Nothing here prints."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from bench.commission.commissioned import Commissioned
from bench.commission.comparison import compared
from bench.commission.meters import Ammeter, Reading
from bench.commission.outcome import Outcome
from bench.commission.refusal import Refused
from bench.commission.sequence import Step, chosen
from bench.commission.stand import NEED, Stand, channels
from bench.commission.steps import turn
from bench.errors import BenchError
from bench.files import RUN, check_directory, check_output, write
from bench.param import history
from bench.param.sources import of_node
from bench.rig.connection import SIM, open_target
from bench.rig.consent import check_limits, require_consent
from bench.rig.envelope import Envelope
from bench.rig.interrupts import signals_as_exceptions
from bench.rig.lock import alone_on
from bench.rig.outputs import Recording
from bench.rig.person import Ask
from bench.rig.rig import Plan, Rig
from bench.rig.screen import Screen
from bench.rig.settings import Settings, read_settings
from bench.signal.units import RPM
from bench.signal.verdict import Verdict
from bench.signal.versions import PROGRAM
from protocol import __version__
from protocol.messages import Feature

RUN_NAME = f"commission{RUN}"
FOUND, REPORT = "found.json", "report.html"


@dataclass(frozen=True)
class Options:
    """What was asked for; A and r/min as on the command line, None for the default. `steps`: None for all."""

    target: str
    steps: tuple[str, ...] | None = None
    current_a: float | None = None
    speed_rpm: float | None = None
    pole_pairs: int | None = None
    """As a person knows them, for a drive without an encoder."""
    report: Path | None = None
    overwrite: bool = False
    yes: bool = False
    config: Path | None = None
    operator: str = ""
    voltmeter: Reading | None = None
    """At the DC link, read while the drive is at rest."""
    ammeter: Ammeter | None = None
    before: Mapping[str, Any] | None = None
    """An earlier commissioning that this one is compared with, see `bench.commission.comparison.read`."""


def commission(
    options: Options, screen: Screen, confirm: Callable[[str], bool] | None, ask: Ask | None = None
) -> Commissioned:
    """Take the steps. Raises BenchError and HbpError; the drive is off again, and as it was.

    `confirm` asks a person before anything is energised, `ask` before each further step; None where there is nobody.
    After a step that can claim nothing, those that need it are not taken, and after a trip none: what was found stands,
    and `refused` says why.
    """
    steps = chosen(options.steps, options.ammeter is not None)
    if options.ammeter is not None and ask is None:
        raise BenchError("an ammeter needs somebody at a terminal, who reads it while the current is held")
    if options.report is not None:
        check_directory(options.report, f"--report {options.report}", make=True)
        options.report.mkdir(parents=True, exist_ok=True)
        check_output(options.report / REPORT, f"report {options.report / REPORT}", options.overwrite)
    envelope = Envelope(_announced_rpm(steps, options), math.inf if options.current_a is None else options.current_a)
    station = read_settings(None)
    settings = replace(station, operator=options.operator or station.operator, config=options.config, load="none")
    plan = Plan(
        lambda: open_target(options.target, settings, "commission"), options.target, settings, envelope, ask,
        virtual=options.target == SIM, held=alone_on(options.target),
    )  # fmt: skip
    with signals_as_exceptions(), Rig(plan) as rig:
        node = rig.drive.node
        rig.require(NEED)
        check_limits(node, envelope)
        rig.require_rest()
        i_max = _agreed_current(rig, options)
        rig.drive.envelope = agreed_to = replace(envelope, current=i_max, rpm=_agreed_rpm(rig, steps, envelope))
        agreed = options.yes or bool(node.identity.features & Feature.SIMULATED)
        said = {step: f"{step.name}: {step.announcement(agreed_to)}" for step in steps}
        if energising := [step for step in steps if step.energises]:
            for step in () if agreed else energising:
                screen.note(f"will do {said[step]}")
            require_consent(node, options.target, rig.drive.envelope, options.yes, confirm)
        done = Commissioned(of_node(node, options.target), i_max, about=_about(options, settings, agreed_to.rpm))
        recording = Recording(_in(options.report, RUN_NAME), {"test": "commission"}, overwrite=options.overwrite)
        rig.prepare([channels(rig)], recording, held=True, full=True)
        began = rig.tick()
        stand = Stand(rig, i_max, options.voltmeter, options.ammeter)
        stand.pole_pairs, stand.by_hand = options.pole_pairs, ask is not None and not agreed
        done.outcomes = stand.outcomes
        missing: set[str] = set()
        for step in steps:
            if missing & set(step.needs) or rig.drive.faults or rig.drive.ran_away:
                missing.add(step.name)
                continue
            screen.note(said[step])
            if step in energising[1:] and ask is not None and not agreed:
                speed = f", and up to {agreed_to.rpm:.0f} r/min" if step.spins else ", and turns" if step.turns else ""
                rig.ask(f"see that the shaft is free for {step.name}, with up to {i_max:g} A{speed}")
            screen.progress(step.name)
            if not _take(rig, stand, step, done, partial(_write, options.report)):
                missing.add(step.name)
        done.converters = stand.converters
        done.seconds = (rig.tick() - began) / rig.recorder.tick_hz
    if options.before is not None and done.found:
        done.comparison = compared(options.before, done.as_json())
    if options.report is not None:
        from bench.commission.report import as_html

        _dump(options.report / FOUND, done.as_json())
        write(options.report / REPORT, as_html(options.report, done), f"report {options.report / REPORT}")
    return done


def _about(options: Options, settings: Settings, rpm: float) -> dict[str, Any]:
    """What a report and a later comparison say of this one."""
    volts, amperes = options.voltmeter, options.ammeter
    instruments = []
    if volts is not None:
        instruments.append(f"a voltmeter that reads {volts.value:g} V, to {100.0 * volts.accuracy:g} %")
    if amperes is not None:
        instruments.append(f"an ammeter in phase {amperes.phase}, to {100.0 * amperes.accuracy:g} %")
    return {
        "started": history.now(), "target": options.target,
        "motor": settings.motor, "station": settings.station, "operator": settings.operator,
        "rpm": rpm, "instruments": instruments, PROGRAM: __version__,
    }  # fmt: skip


def _agreed_current(rig: Rig, options: Options) -> float:
    """A: what was asked for, or of a simulated drive its i_max. BenchError where nobody has named it."""
    if options.current_a is not None:
        return options.current_a
    node = rig.drive.node
    if node.identity.features & Feature.SIMULATED and node.has_parameter("i_max"):
        return float(node.parameter("i_max").value)
    raise BenchError("no measurement gives the largest current that the motor bears: name it with --current A")


def _announced_rpm(steps: Sequence[Step], options: Options) -> float:
    """r/min, that may be asked for before the drive is known; inf for its own limit."""
    if not any(step.turns for step in steps):
        return 0.0
    slow = turn.SPEED / RPM / turn.MARGIN
    if options.speed_rpm is not None:
        return options.speed_rpm if any(step.spins for step in steps) else min(slow, options.speed_rpm)
    return math.inf if any(step.spins for step in steps) else slow


def _agreed_rpm(rig: Rig, steps: Sequence[Step], envelope: Envelope) -> float:
    """r/min: what was asked for, or of a simulated drive its limit. BenchError where nobody has named it."""
    node = rig.drive.node
    own = node.parameter("omega_m_max").value / RPM if node.has_parameter("omega_m_max") else math.inf
    if math.isinf(envelope.rpm) and not node.identity.features & Feature.SIMULATED:
        raise BenchError(
            "no measurement gives the largest speed that the shaft bears: name it with --speed R/MIN, or take steps "
            f"that do not spin it (--step {','.join(step.name for step in steps if not step.turns)})"
        )
    return min(envelope.rpm, own)


def _take(rig: Rig, stand: Stand, step: Step, done: Commissioned, written: Callable[[Step, Outcome], None]) -> bool:
    """Take one step, and whether it has found what it is for."""
    first = rig.tick() / rig.recorder.tick_hz
    try:
        outcome = step.perform(stand)
        for refused in outcome.refused:
            done.refuse(refused)
        verdict = Verdict.PASS
    except Refused as refused:
        done.refuse(refused)
        verdict = Verdict.FAIL
    rig.mark(step.name, (first, rig.recorder.newest / rig.recorder.tick_hz), verdict)
    if verdict is Verdict.PASS:
        written(step, outcome)
    return verdict is Verdict.PASS


def _write(report: Path | None, step: Step, outcome: Outcome) -> None:
    """The evidence of a step: its picture, and all that is in it as numbers."""
    if report is None:
        return
    from bench.commission.draw import draw
    from bench.report.style import save

    save(draw(outcome.evidence), report / f"{step.name}.png")
    _dump(report / f"{step.name}.json", outcome.evidence.as_json())


def _dump(path: Path, data: object) -> None:
    write(path, json.dumps(data, indent=1, allow_nan=False) + "\n", str(path))


def _in(report: Path | None, name: str) -> Path | None:
    return None if report is None else report / name
