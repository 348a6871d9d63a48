"""A motion profile as its TOML says it, checked: every key is known, every number is one, and an error says which step.

max_current_A = 5
steps = [
  { speed_rpm = 500, ramp_s = 0.5, for_s = 2 },
  { load_torque_Nm = 0.1, for_s = 1, mark = "load step" },
  { repeat = 3, steps = [
    { speed_rpm = -500, ramp_s = 0.4, for_s = 1, mark = "reversal" },
    { speed_rpm = 500, ramp_s = 0.4, for_s = 1 },
  ] },
]
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

from bench.errors import BenchError
from bench.files import read_toml
from bench.motion.profile import CURRENT, OF_DRIVE, OF_LOAD, UNITS, Profile, Sine, Step
from bench.signal.sources import source_names, source_number
from protocol.text import did_you_mean

TOP = ("steps", "name", "max_current_A", "max_speed_rpm")
STEP = (*OF_DRIVE, *OF_LOAD, "for_s", "ramp_s", "set", "observer", "mark")
REPEAT = ("repeat", "steps")
SINE = ("amplitude", "frequency_Hz", "offset", "phase_deg")
IN = UNITS | {"for_s": "s", "ramp_s": "s", "frequency_Hz": "Hz", "phase_deg": "deg",
              "max_current_A": "A", "max_speed_rpm": "r/min"}  # fmt: skip
"""The unit that a key has."""
MOST = 10_000
"""Steps, repeats written out."""
SHORTEST = 0.01
"""s of a step: a host keeps to less than that only roughly."""
DEEPEST = 2
"""Repeats within each other."""


def read_profile(source: Path | str | Mapping[str, Any]) -> Profile:
    """The profile in a TOML file, or in a mapping of the same keys. BenchError, with the step, for what cannot be."""
    if isinstance(source, Mapping):
        return profile_of(source, "the profile")
    path = Path(source)
    return profile_of(read_toml(path, "profile"), str(path))


def profile_of(data: Mapping[str, Any], where: str) -> Profile:
    """The profile that plain data, as of a TOML file, say; errors call it `where`. BenchError likewise."""
    _known(data, TOP, where)
    steps = tuple(islice(_steps(data, "", where, 0), MOST + 1))
    if len(steps) > MOST:
        raise BenchError(f"{where} has more than {MOST} steps, repeats written out: repeat less")
    current, speed = (
        _number(data[key], key, where, above=0.0) if key in data else None for key in ("max_current_A", "max_speed_rpm")
    )
    free = next((step for step in steps if CURRENT in step.targets), None)
    if free is not None and speed is None:
        raise BenchError(
            f"{free.place} of {where} gives {CURRENT}, with which the motor turns as fast as its load lets it: write "
            "max_speed_rpm at the top of the file, the speed at which it is switched off"
        )
    if free is None and speed is not None:
        raise BenchError(f"max_speed_rpm in {where} is for steps with {CURRENT}, and there are none: leave it out")
    profile = Profile(steps, _text(data.get("name", ""), "name", where), where, current, speed)
    try:
        profile.acts  # noqa: B018  # where a step cannot follow the one before
    except BenchError as error:
        raise BenchError(f"{where}, {error}") from None
    return profile


def _steps(data: Mapping[str, Any], number: str, where: str, depth: int) -> Iterator[Step]:
    """The steps of a file or of a repeat in it, which is step `number`, repeats written out."""
    what = f"step {number} of {where}" if number else where
    given, inside = data.get("steps"), f"{number}." if number else ""
    if not isinstance(given, list) or not given:
        raise BenchError(f"{what} has no steps: write steps = [{{ speed_rpm = 500, for_s = 2 }}, …]")
    written = [list(islice(_step(one, f"{inside}{k}", where, depth), MOST + 1)) for k, one in enumerate(given, 1)]
    rounds = 1
    if number:
        rounds = data["repeat"]
        if isinstance(rounds, bool) or not isinstance(rounds, int) or not 1 <= rounds <= MOST:
            raise BenchError(f"repeat in {what} must be a whole number from 1 to {MOST}, got {rounds!r}")
    for _ in range(rounds):
        for steps in written:
            yield from steps


def _step(given: Any, number: str, where: str, depth: int) -> Iterator[Step]:
    what = f"step {number} of {where}"
    if not isinstance(given, Mapping):
        raise BenchError(f"{what} must be a table such as {{ speed_rpm = 500, for_s = 2 }}, got {given!r}")
    if "repeat" in given or "steps" in given:
        _known(given, REPEAT, what)
        if "repeat" not in given:
            raise BenchError(f"{what} has steps and does not say how often: add repeat = 3")
        if depth >= DEEPEST:
            raise BenchError(f"{what} repeats within a repeat within a repeat: write the inner one out")
        yield from _steps(given, number, where, depth + 1)
        return
    _known(given, STEP, what)
    targets = {key: _target(given[key], key, what) for key in UNITS if key in given}
    for of in (OF_DRIVE, OF_LOAD):
        if len(two := [key for key in of if key in targets]) > 1:
            raise BenchError(f"{what} has both {two[0]} and {two[1]}, and one machine can follow only one: choose")
    ramp = _number(given["ramp_s"], "ramp_s", what, above=0.0) if "ramp_s" in given else 0.0
    if ramp and not any(isinstance(target, float) for target in targets.values()):
        raise BenchError(f"{what} has ramp_s and nothing that ramps: add {' or '.join(OF_DRIVE)} as a number")
    if "for_s" not in given and not ramp:
        raise BenchError(f"{what} does not say how long it takes: add for_s = 1")
    seconds = _number(given.get("for_s", ramp), "for_s", what, least=SHORTEST)
    if ramp > seconds:
        raise BenchError(f"{what} ends after for_s = {seconds:g} s, before its ramp_s = {ramp:g} s are over")
    name = _text(given.get("mark", f"step {number}"), "mark", what)
    if not name:
        raise BenchError(f"mark in {what} is empty: give it a name, or leave it out")
    yield Step(name, seconds, targets, ramp, _sets(given, what), number=number)


def _sets(given: Mapping[str, Any], what: str) -> dict[str, float]:
    """Parameters of the drive that a step sets."""
    table = given.get("set", {})
    if not isinstance(table, Mapping):
        raise BenchError(f"set in {what} must be a table such as {{ k_p_vt = 12.0 }}, got {table!r}")
    sets = {name: _number(value, f"set.{name}", what) for name, value in table.items()}
    if "observer" in given:
        name = _text(given["observer"], "observer", what)
        if (source := source_number(name)) is None:
            hint = did_you_mean(name, source_names(), f"there are {', '.join(source_names())}")
            raise BenchError(f"observer in {what} is '{name}': {hint}")
        if "observer" in sets:
            raise BenchError(f"{what} gives the observer twice, by observer and by set: leave one out")
        sets["observer"] = float(source)
    return sets


def _target(value: Any, key: str, what: str) -> float | Sine:
    if not isinstance(value, Mapping):
        return _number(value, key, what, form=f"a number of {UNITS[key]}, or {{ amplitude = …, frequency_Hz = … }}")
    _known(value, SINE, f"{key} in {what}")
    for needed in SINE[:2]:
        if needed not in value:
            raise BenchError(f"{key} in {what} is a sine without {needed}: it needs {' and '.join(SINE[:2])}")
    inner = f"{key} in {what}"
    return Sine(
        _number(value["amplitude"], "amplitude", inner, above=0.0),
        _number(value["frequency_Hz"], "frequency_Hz", inner, above=0.0),
        _number(value.get("offset", 0.0), "offset", inner),
        _number(value.get("phase_deg", 0.0), "phase_deg", inner),
    )


def _number(
    value: Any, key: str, what: str, *, above: float = -math.inf, least: float = -math.inf, form: str = ""
) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        form = form or "a number" + (f" of {IN[key]}" if key in IN else "")
        raise BenchError(f"{key} in {what} must be {form}, got {value!r}")
    unit = f" {IN[key]}" if key in IN else ""
    if not math.isfinite(value):
        raise BenchError(f"{key} in {what} must be finite, got {value!r}")
    if value <= above:
        raise BenchError(f"{key} in {what} must be more than {above:g}{unit}, got {value:g}")
    if value < least:
        raise BenchError(f"{key} in {what} must be at least {least:g}{unit}, got {value:g}")
    return float(value)


def _text(value: Any, key: str, what: str) -> str:
    if not isinstance(value, str) or not value.isprintable():
        raise BenchError(f"{key} in {what} must be text in one line, got {value!r}")
    return value


def _known(given: Mapping[str, Any], known: tuple[str, ...], what: str) -> None:
    """Raise BenchError for a key that is not known; one with another unit, or none, is told the right one."""
    for key in given:
        if key not in known:
            stems = {name.rpartition("_")[0]: name for name in known if name in IN}
            stem = next((stem for stem in sorted(stems, key=len, reverse=True) if f"{key}_".startswith(f"{stem}_")), "")
            hint = f"{stem.replace('_', ' ')} is given in {IN[stems[stem]]}: write {stems[stem]}" if stem else ""
            hint = hint or did_you_mean(key, known, f"there are {', '.join(known)}")
            raise BenchError(f"unknown key {key} in {what}: {hint}")
