"""Measures a loop: loads the test signal into the drive, lets it repeat, and takes reference and output down.

The drive is started here, within what was announced, and stopped on every way out; with that its test signal is off,
because the parameters of one are VOLATILE. Nothing here asks for consent or draws.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from bench.errors import BenchError
from bench.files import finite
from bench.response.loops import SPEED, Loop, waveform
from bench.rig.rig import Rig
from bench.signal.capture import Capture
from bench.signal.sources import source_names, source_number, source_short
from bench.signal.units import RPM
from bench.signal.waveforms.frequency_response import FrequencyResponse, Margins, frequency_response
from protocol.descriptor import Channel

NEED = "bench response"
PERIODS = 8
"""Cycles of the test signal that are measured where nothing else is asked for."""
LEADS = 2
"""Cycles before them, in which what was before dies out."""
AT_LIMIT = 0.98
"""Share of a limit from which it counts as reached."""
SELDOM = 0.001
"""Share of the samples that may be at a limit before the loop counts as limited."""
SETTLE = 0.5
"""s for which a current is on, or a speed held, before the test signal begins."""
VOLTAGES = ("u_alpha", "u_beta", "u_dc")


@dataclass(frozen=True)
class Asked:
    """What is measured, from `lowest` to `highest` Hz.

    `amplitude` is in A of the current loop, in mechanical rad/s of the speed loop; `bias`, A, is the d current beside
    it. `speed_rpm`: the speed meanwhile, 0 at rest.
    """

    loop: Loop
    lowest: float
    highest: float
    amplitude: float
    bias: float = 0.0
    speed_rpm: float = 0.0
    periods: int = PERIODS
    observer: str | None = None


@dataclass(frozen=True)
class Measured:
    """A loop's response; `remarks`: why it may not be that of a linear loop."""

    asked: Asked
    response: FrequencyResponse
    margins: Margins
    remarks: tuple[str, ...]
    capture: Capture
    """What it was measured on."""

    def as_json(self) -> dict[str, Any]:
        """Plain data; None for what is undefined."""
        found = self.response
        lines = zip(found.f, found.closed, found.open, found.coherence, found.deviation, strict=True)
        told: dict[str, Any] = finite({
            "asked": asdict(self.asked) | {"loop": self.asked.loop.name},
            "margins": {name: each._asdict() for name, each in self.margins._asdict().items()},
            "lines": [
                {"hz": float(f), "gain": float(abs(closed)), "phase_deg": math.degrees(np.angle(closed)),
                 "open_gain": float(abs(opened)), "open_phase_deg": math.degrees(np.angle(opened)),
                 "coherence": float(coherence), "deviation": float(deviation)}
                for f, closed, opened, coherence, deviation in lines
            ],
            "remarks": list(self.remarks),
        })  # fmt: skip
        return told


def channels(rig: Rig, asked: Asked) -> tuple[Channel, ...]:
    """What is streamed: reference and output of the loop, and what tells that a limit was reached."""
    node = rig.drive.node
    there = {channel.name for channel in node.descriptor.channels}
    wanted = [asked.loop.reference, _output(rig, asked), "i_q_ref", *VOLTAGES]
    return node.channels([name for name in dict.fromkeys(wanted) if name in there])


def measure(rig: Rig, asked: Asked, progress: Callable[[str], None] = lambda _: None) -> Measured:
    """Measure the loop of a rig that streams `channels` at the PWM rate; the drive is stopped after it.

    BenchError for what the drive cannot do, and for samples that were lost.
    """
    node = rig.drive.node
    turns_hz = asked.speed_rpm / 60.0
    wave = waveform(node.identity.pwm_hz, node.waveform_room(), asked.lowest, asked.highest, turns_hz)
    seconds = (LEADS + asked.periods) * wave.periods / node.identity.pwm_hz
    with _running(rig, asked), rig.drive.excited(asked.loop.excited, wave, asked.amplitude):
        progress(f"{asked.loop.name} loop: {asked.periods} cycles of the test signal, {seconds:.1f} s")
        capture = rig.record(seconds)
    output = _output(rig, asked)
    n = asked.periods * wave.periods
    _require_complete(capture, n, node.identity.pwm_hz)
    reference, answer = (capture[name][-n:] for name in (asked.loop.reference, output))
    try:
        found = frequency_response(
            reference, answer, wave.periods, wave.lines, node.identity.pwm_hz, float(asked.loop.late)
        )
    except ValueError as error:
        raise BenchError(f"the {asked.loop.name} loop cannot be measured: {error}") from None
    return Measured(asked, found, found.margins(), tuple(_remarks(capture, asked.loop, n)), capture)


@contextmanager
def _running(rig: Rig, asked: Asked) -> Iterator[None]:
    """The drive runs as it is to be measured; it is stopped at the end."""
    drive = rig.drive
    try:
        drive.start(asked.observer)
        if asked.loop is SPEED or asked.speed_rpm:
            drive.speed(rpm=asked.speed_rpm, i_d=asked.bias)
        else:
            drive.current(0.0, asked.bias)
        rig.wait(SETTLE + abs(asked.speed_rpm * RPM) / drive.parameters.get("alpha_m_max", math.inf))
        yield
    finally:
        drive.stop()


def _output(rig: Rig, asked: Asked) -> str:
    """The channel of what the loop controls: of the speed loop, of the control's angle source."""
    if asked.loop.output:
        return asked.loop.output
    node = rig.drive.node
    if asked.observer is None and not node.has_parameter("observer"):
        raise BenchError("the drive does not tell its angle source (parameter observer): name it with --observer")
    number = node.parameter("observer").value if asked.observer is None else source_number(asked.observer)
    if number is None:
        raise BenchError(f"no angle source '{asked.observer}'; available: {', '.join(source_names())}")
    return f"omega_{source_short(number)}"


def _require_complete(capture: Capture, n: int, pwm_hz: int) -> None:
    if capture.samples.config.decimation != 1:
        rate = capture.rate
        raise BenchError(
            f"the link carries {rate:g} samples a second of these channels, and a response needs every PWM period "
            f"({pwm_hz} Hz): use a faster link"
        )
    if capture.dropped:
        raise BenchError(f"samples were lost meanwhile: {capture.dropped[0][2]}; measure again, on a faster link")
    if len(capture) < n:
        raise BenchError(f"{len(capture)} samples came, {n} are needed")


def _remarks(capture: Capture, loop: Loop, n: int) -> Iterator[str]:
    """Limits that were reached, by which the loop is not linear: its response is that of no loop."""
    names = set(capture.names)
    if names.issuperset(VOLTAGES):
        size = np.hypot(capture["u_alpha"][-n:], capture["u_beta"][-n:])
        share = float(np.mean(size > AT_LIMIT * capture["u_dc"][-n:] / math.sqrt(3.0)))
        if share > SELDOM:
            yield f"the voltage was at its limit in {100 * share:.3g} % of the time: use a smaller amplitude or speed"
    i_max = capture.parameters.get("i_max")
    if loop is SPEED and i_max and "i_q_ref" in names:
        share = float(np.mean(np.abs(capture["i_q_ref"][-n:]) > AT_LIMIT * i_max))
        if share > SELDOM:
            yield f"the current was at its limit in {100 * share:.3g} % of the time: use a smaller amplitude"
