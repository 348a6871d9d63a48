"""`bench.toml`: what stays the same from run to run on one bench.

    target = "serial:/dev/ttyACM0"     # as on the command line; "sim" is the simulated drive in virtual time
    station = "bench 3"                # which bench this is, for recordings and reports
    operator = "A. Person"             # who runs it; --operator says it for one run
    motor = "type 42, no. 17"          # which motor the drive has; --motor says it for one run
    config = "my-motor.toml"           # figures of the simulated drive, where target is "sim"

    [rig]
    load = "node"                      # "node" (number 2 on the link), "none", "person", a target, "FILE.py:Class"
    person = true                      # somebody is there to turn knobs and pull wires when asked

    [rated]
    speed_rpm = 2000                   # what tests ask for shares of; without it what the drive's limits say
    current = 5.0                      # A, peak

    [limits]
    "fig08_steady.error_std_proposed" = { hi = 6.0 }     # as `bench accept --list` names it

Reads and checks the file; it opens no link.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from numbers import Real
from pathlib import Path
from typing import Any

from bench.device.simulator import configuration
from bench.errors import BenchError
from bench.files import write
from bench.signal.limits import Limits
from protocol.errors import TargetError
from protocol.links.target import parse_target
from protocol.text import did_you_mean

FILE = "bench.toml"
_TOP = dict.fromkeys(("target", "station", "operator", "motor", "config"), str) | dict.fromkeys(
    ("rig", "rated", "limits"), dict
)
_RIG = {"load": str, "person": bool}
_RATED = {"speed_rpm": Real, "current": Real}
LOADS = ("node", "none", "person")
MUCH_ALIKE = 0.85  # from this ratio on (difflib) a name is taken for another that is misspelt


@dataclass(frozen=True)
class Settings:
    """What a `bench.toml` says; everything has a default."""

    path: Path | None = None
    target: str = ""
    station: str = ""
    """Which bench this is."""
    operator: str = ""
    """Who runs it."""
    motor: str = ""
    """Which motor the drive has."""
    config: Path | None = None
    """Of the simulated drive,"""
    overrides: Mapping[str, Any] = field(default_factory=dict)
    """and what stands in the place of its keys, by section or dotted key."""
    seed: int | None = None
    """Of the simulated drive's noise; None: one of its own for each test."""
    load: str = "node"
    person: bool = False
    rated: Mapping[str, float] = field(default_factory=dict)
    """What the drive is rated for, where its own limits do not say it: `speed_rpm`, `current`."""
    limits: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    def apply(self, names: Collection[str], limits: Limits) -> Limits:
        """`limits` of a measurement that goes by `names`, with what the file says in their place.

        BenchError if the file names it twice, or leaves no room between the limits.
        """
        given = sorted(name for name in names if name in self.limits)
        if len(given) > 1:
            raise BenchError(f"[limits] in {self.path} names one measurement twice: {' and '.join(given)}")
        if not given:
            return limits
        own = self.limits[given[0]]
        if limits.of:  # shares of a rating that is not known yet: the file's are none
            limits = replace(limits, lo=None, hi=None, of="")
        try:
            return replace(limits, lo=own.get("lo", limits.lo), hi=own.get("hi", limits.hi), plus=0.0, overridden=True)
        except ValueError as error:
            raise BenchError(f"[limits] in {self.path}: {error}") from None

    def check_names(self, tests: Mapping[str, Collection[str]]) -> list[str]:
        """Names of limits for other tests than these, as `require_known`: `bench.toml` serves several runs."""
        return require_known(self.limits, f"[limits] in {self.path}", tests)


def require_known(names: Collection[str], where: str, tests: Mapping[str, Collection[str]]) -> list[str]:
    """Those of `names`, which stand `where`, that are of other tests than these, which map to what they measure.

    BenchError for what one of these tests does not measure, for what is no TEST.MEASUREMENT, and for a name that is
    much like one of theirs. Names with other numbers in them are not alike: they are other working points.
    """
    known = [f"{test}.{measured}" for test, all_measured in tests.items() for measured in all_measured]
    elsewhere = []
    for name in sorted(set(names) - set(known)):
        ours = "." not in name or any(name.startswith(f"{test}.") for test in tests)
        among = known if ours else [other for other in known if _numbers(other) == _numbers(name)]
        hint = did_you_mean(name, among, cutoff=0.6 if ours else MUCH_ALIKE)
        if ours or hint:
            hint = hint or "bench accept --list shows all of them"
            raise BenchError(f"{where} names '{name}', which no test measures: {hint}")
        elsewhere.append(name)
    return elsewhere


def read_settings(path: Path | None) -> Settings:
    """Read `path`, or `bench.toml` in the present directory if there is one. BenchError for what cannot be used."""
    file = path or Path(FILE)
    try:
        data = tomllib.loads(file.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        if path is None:
            return Settings()
        raise BenchError(f"no file {path}") from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise BenchError(f"cannot read {file}: {error}") from None
    except RecursionError:
        raise BenchError(f"cannot read {file}: it is nested too deeply") from None
    rig, rated = data.get("rig", {}), data.get("rated", {})
    for table, known, prefix in ((data, _TOP, ""), (rig, _RIG, "rig."), (rated, _RATED, "rated.")):
        _check(table, known, prefix, file)
    for key, value in rated.items():
        if not 0.0 < value < math.inf:
            raise BenchError(f"rated.{key} in {file} must be more than 0, got {value!r}")
    config, load = data.get("config"), rig.get("load", "node")
    if load not in LOADS and ".py:" not in load:
        try:
            parse_target(load)
        except TargetError as error:
            forms = f"{', '.join(LOADS)}, FILE.py:Class or a target"
            raise BenchError(f"rig.load in {file} must be {forms}: {error}") from None
    return Settings(
        path=file,
        **{name: data.get(name, "") for name in ("target", "station", "operator", "motor")},
        config=None if config is None else configuration(file.parent / config, config),
        load=load,
        person=rig.get("person", False),
        rated={key: float(value) for key, value in rated.items()},
        limits={name: read_limits(name, value, str(file)) for name, value in data.get("limits", {}).items()},
    )


def write_rated(path: Path | None, told: Mapping[str, float | None]) -> None:
    """Write what is told to [rated] of `path`, or of `bench.toml` in the present directory; all else stays as it is.

    BenchError where the file says otherwise, or cannot be written.
    """
    file = path or Path(FILE)
    there = read_settings(path).rated
    given = {key: value for key, value in told.items() if value is not None and there.get(key) != value}
    for key in given.keys() & there.keys():
        raise BenchError(f"{file} says [rated] {key} = {there[key]:g}, not {given[key]:g}: change it there")
    if not given:
        return
    before = file.read_bytes().decode() if file.exists() else ""
    mark, end = "\ufeff"[: before.startswith("\ufeff")], "\r\n" if "\r\n" in before else "\n"
    lines = before.removeprefix(mark).replace("\r\n", "\n").removesuffix("\n").split("\n") if before else []
    at = next((k for k, line in enumerate(lines, 1) if re.fullmatch(r"\s*\[\s*rated\s*\]\s*(#.*)?", line)), 0)
    if not at:
        lines += [*([""] if lines else []), "[rated]"]
        at = len(lines)
    lines[at:at] = [f"{key} = {value!r}" for key, value in given.items()]
    text = "\n".join(lines) + "\n"
    try:
        tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise BenchError(f"[rated] does not fit into {file} ({error}): write it there by hand") from None
    write(file, mark + text.replace("\n", end), str(file))


def _numbers(name: str) -> list[str]:
    return re.findall(r"\d+", name)


def _check(table: Mapping[str, Any], known: Mapping[str, type], prefix: str, file: Path) -> None:
    for key, value in table.items():
        if key not in known:
            there = f"there are {', '.join(prefix + k for k in known)}"
            hint = did_you_mean(key, known, there, f"did you mean {prefix}{{}}?")
            raise BenchError(f"unknown key {prefix}{key} in {file}: {hint}")
        if not isinstance(value, known[key]) or (known[key] is Real and isinstance(value, bool)):
            word = {str: "text", bool: "true or false", dict: "a table", Real: "a number"}[known[key]]
            raise BenchError(f"{prefix}{key} in {file} must be {word}, got {value!r}")


def read_limits(name: str, value: Any, where: str) -> dict[str, float]:
    """Limits of a measurement as a TOML has them; BenchError for what are none."""
    if not isinstance(value, dict) or not value or not set(value) <= {"lo", "hi"}:
        raise BenchError(f"limits.{name!r} in {where} must look like {{ lo = 0.0, hi = 1.0 }}, got {value!r}")
    for bound in value.values():
        if isinstance(bound, bool) or not isinstance(bound, int | float) or not math.isfinite(bound):
            raise BenchError(f"limits.{name!r} in {where} must be finite numbers, got {bound!r}")
    return {key: float(bound) for key, bound in value.items()}
