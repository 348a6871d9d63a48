"""`bench response` from target to result: limits, consent, rig, measurement. Nothing here prints."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from bench.errors import BenchError
from bench.response.experiment import NEED, PERIODS, Asked, Measured, channels, measure
from bench.response.loops import CURRENT, LOOPS
from bench.rig.connection import SIM, open_target
from bench.rig.consent import at_most, check_limits, require_consent
from bench.rig.envelope import Envelope
from bench.rig.interrupts import signals_as_exceptions
from bench.rig.lock import alone_on
from bench.rig.outputs import Recording
from bench.rig.rig import Plan, Rig
from bench.rig.screen import Screen
from bench.rig.settings import read_settings
from bench.signal.units import RPM

REST_CURRENT = 2.0  # A that the current loop gets at most where nothing else is asked for
SPEED_RPM = 500.0
HIGHEST = {"current": 2000.0, "speed": 100.0}
SPAN = 100.0  # highest frequency over the lowest
BIAS, AMPLITUDE = 0.6, 0.3  # shares of the highest current
SWING = 0.05  # of the speed


@dataclass(frozen=True)
class Options:
    """What was asked for; r/min, A and Hz as on the command line, None for the default."""

    target: str
    loop: str
    highest: float | None = None
    lowest: float | None = None
    amplitude: float | None = None
    current_a: float | None = None
    speed_rpm: float | None = None
    observer: str | None = None
    periods: int = PERIODS
    save: Path | None = None
    overwrite: bool = False
    yes: bool = False
    config: Path | None = None
    operator: str = ""


def respond(options: Options, screen: Screen, confirm: Callable[[str], bool] | None) -> Measured:
    """Measure the loop. Raises BenchError and HbpError; the drive is off again, and as it was."""
    loop = LOOPS[options.loop]
    speed = options.speed_rpm if options.speed_rpm is not None else 0.0 if loop is CURRENT else SPEED_RPM
    amplitude = options.amplitude
    if loop is not CURRENT and amplitude is None:
        amplitude = SWING * abs(speed)
    if loop is not CURRENT and not amplitude:
        raise BenchError("the speed loop at rest: name the amplitude in r/min with --amplitude")
    swing = 0.0 if loop is CURRENT or amplitude is None else amplitude
    wanted = options.current_a if options.current_a is not None else REST_CURRENT if loop is CURRENT else math.inf
    envelope = Envelope(abs(speed) + swing, wanted)
    station = read_settings(None)
    settings = replace(station, operator=options.operator or station.operator, config=options.config, load="none")
    plan = Plan(
        lambda: open_target(options.target, settings, "response"), options.target, settings, envelope,
        virtual=options.target == SIM, held=alone_on(options.target),
    )  # fmt: skip
    with signals_as_exceptions(), Rig(plan) as rig:
        drive = rig.drive.node
        rig.require(NEED)
        check_limits(drive, Envelope(envelope.rpm, math.inf if options.current_a is None else wanted))
        rig.require_rest()
        most = min(wanted, drive.parameter("i_max").value) if drive.has_parameter("i_max") else wanted
        highest = options.highest or HIGHEST[loop.name]
        asked = Asked(
            loop, options.lowest or highest / SPAN, highest,
            amplitude=(amplitude or AMPLITUDE * most) if loop is CURRENT else swing * RPM,
            bias=_bias(most, amplitude) if loop is CURRENT else 0.0,
            speed_rpm=speed, periods=options.periods, observer=options.observer,
        )  # fmt: skip
        require_consent(drive, options.target, at_most(drive, envelope), options.yes, confirm)
        rig.prepare([channels(rig, asked)], Recording(options.save, {"test": "response"}))
        return measure(rig, asked, screen.progress)


def _bias(most: float, amplitude: float | None) -> float:
    """The d current, A, beside the test signal, at most twice its amplitude; BenchError where there is no room."""
    swing = AMPLITUDE * most if amplitude is None else amplitude
    if not 2.0 * swing <= most:
        raise BenchError(
            f"an amplitude of {swing:g} A beside a current that keeps its sign needs {2 * swing:g} A; {most:g} A are "
            "allowed (--current, and the drive's i_max)"
        )
    return min(BIAS * most, most - swing) if amplitude is None else max(swing, min(2.0 * swing, most - swing))
