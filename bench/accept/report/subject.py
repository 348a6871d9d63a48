"""What a report is about: the drive, its motor, the bench, who made it and with what."""

from __future__ import annotations

from typing import NamedTuple

from bench.accept.report.words import duration
from bench.accept.results import RunResult
from bench.report.words import NOT_STATED, date
from bench.signal.limits import RATED_CURRENT, RATED_SPEED
from bench.signal.versions import PROGRAM
from protocol.text import told

MOTOR = {
    "n_p": "pole pairs", "R_s_hat": "resistance", "L_s_hat": "inductance", "psi_f_hat": "flux linkage",
    "J_hat": "inertia",
}  # fmt: skip
"""The drive's parameters that say which motor it has."""
MILLI = ("H", "V·s", "Ω")  # units of which motors have thousandths
SHOWN = ("name", "serial", "firmware", "build")  # of an identity, in the subject itself


class Row(NamedTuple):
    """A line of it. Without `text` there is a line to write on."""

    label: str
    text: str
    note: str = ""


def subject(run: RunResult) -> list[Row]:
    """All lines, whether anybody has said them or not."""
    said = {key: told(run.identity[key]) if run.identity.get(key) else "" for key in SHOWN}
    silent = f"{NOT_STATED} by the drive" if run.identity else "no drive answered"
    firmware = ", build ".join(text for text in (said["firmware"], said["build"]) if text)
    changed = sum(measurement.limits.overridden for measurement in run.measurements)
    software = _software(run)
    rows = [
        Row("Drive", said["name"], "" if said["name"] else silent),
        Row("Serial number", said["serial"], "" if said["serial"] else silent),
        Row("Firmware", firmware, "" if firmware else silent),
        Row("Motor", run.motor, motor(run) if run.motor else "; ".join(t for t in (NOT_STATED, motor(run)) if t)),
        Row("Station", run.station, "" if run.station else NOT_STATED),
        Row("Operator", run.operator, "" if run.operator else NOT_STATED),
        Row("Date and time", date(run.started), f"took {duration(run.wall_seconds)}"),
        Row("Link", run.target, "the simulated drive" if run.target == "sim" else ""),
        Row("Software", software, "" if software else NOT_STATED),
    ]
    if changed:
        rows.append(Row("Limits", f"{changed} of {len(run.measurements)} are from bench.toml, and marked"))
    return rows


def motor(run: RunResult) -> str:
    """What the drive holds its motor for, by its parameters, and the ratings that the tests used."""
    found = {parameter.name: parameter for parameter in run.parameters}
    said = [f"{words} {_value(found[name].value, found[name].unit)}" for name, words in MOTOR.items() if name in found]
    said += [f"{rating} {run.rig[rating]}" for rating in (RATED_SPEED, RATED_CURRENT) if rating in run.rig]
    return f"by the drive's parameters: {', '.join(said)}" if said else ""


def drive(run: RunResult) -> str:
    """Name and serial number in one line, for titles; the target if no drive answered."""
    name, serial = (run.identity.get(key) for key in ("name", "serial"))
    return ", serial number ".join(told(text) for text in (name or run.target, serial) if text)


def _software(run: RunResult) -> str:
    names = {PROGRAM: PROGRAM, "python": "Python"}
    return ", ".join(f"{name} {run.versions[key]}" for key, name in names.items() if key in run.versions)


def _value(value: float, unit: str) -> str:
    if unit in MILLI and 0.0 < abs(value) < 0.1:
        return f"{1e3 * value:.4g} m{unit}"
    return f"{value:.4g} {unit}".rstrip()
