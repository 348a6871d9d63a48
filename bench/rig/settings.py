"""`bench.toml`: what stays the same from run to run on one bench.

    target = "serial:/dev/ttyACM0"     # as on the command line; "sim" is the simulated drive in virtual time
    station = "bench 3"                # which bench this is, for recordings and reports
    operator = "A. Person"             # who runs it; --operator says it for one run
    motor = "type 42, no. 17"          # which motor the drive has; --motor says it for one run
    config = "my-motor.toml"           # figures of the simulated drive, where target is "sim"

    [rig]
    load = "node"                      # "node" (number 2 on the link), "none", "person", a target, "FILE.py:Class"
    person = true                      # somebody is there to turn knobs and pull wires when asked
    encoder = false                    # none is mounted, whatever the drive tells: nothing is compared with it

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
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from numbers import Real
from pathlib import Path
from typing import Any

from bench.device.simulator import configuration
from bench.errors import BenchError
from bench.files import found_above, write
from bench.signal.limits import Limits
from bench.system import of_another_user
from protocol.errors import TargetError
from protocol.links.target import parse_target
from protocol.text import did_you_mean

FILE = "bench.toml"
_TOP = dict.fromkeys(("target", "station", "operator", "motor", "config"), str) | dict.fromkeys(
    ("rig", "rated", "limits"), dict
)
_RIG = {"load": str, "person": bool, "encoder": bool}
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
    encoder: bool = True
    """Whether the encoder that a drive tells of is mounted."""
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


def settings_file() -> Path | None:
    """`bench.toml` of the present directory, or of the nearest one above it; None where there is none.

    BenchError for one above that belongs to another user: it may name a drive, and code, that nobody here has chosen.
    """
    file = found_above(FILE)
    if file is not None and file.is_absolute() and of_another_user(file):
        words = f"go to {file.parent} to use it, or put a {FILE} of your own here (an empty one will do)"
        raise BenchError(f"{file} belongs to another user: {words}")
    return file


def read_settings(path: Path | None) -> Settings:
    """Read `path`, or where that is None the `settings_file`, if there is one. BenchError for what cannot be used."""
    file = path or settings_file()
    if file is None:
        return Settings()
    try:
        text = file.read_text(encoding="utf-8-sig")
        data = tomllib.loads(text)
    except FileNotFoundError:
        raise BenchError(f"no file {file}") from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise BenchError(f"cannot read {file}: {error}") from None
    except RecursionError:
        raise BenchError(f"cannot read {file}: it is nested too deeply") from None
    place = partial(_Place, file, text)
    for keys, known in (((), _TOP), (("rig",), _RIG), (("rated",), _RATED)):
        _check(data.get(keys[0], {}) if keys else data, known, keys, place)
    rig, rated = data.get("rig", {}), data.get("rated", {})
    for key, value in rated.items():
        if not 0.0 < value < math.inf:
            raise BenchError(f"rated.{key} in {place('rated', key)} must be more than 0, got {value!r}")
    target, config, load = data.get("target", ""), data.get("config"), rig.get("load", "node")
    check_load(load, f"rig.load in {place('rig', 'load')}")
    if target not in ("", "sim"):
        try:
            parse_target(target)
        except TargetError as error:
            raise BenchError(f"target in {place('target')}: {error}") from None
    return Settings(
        path=file,
        target=target,
        **{name: data.get(name, "") for name in ("station", "operator", "motor")},
        config=None if config is None else configuration(file.parent / config, config),
        load=load,
        person=rig.get("person", False),
        encoder=rig.get("encoder", True),
        rated={key: float(value) for key, value in rated.items()},
        limits={
            name: read_limits(name, value, place("limits", name)) for name, value in data.get("limits", {}).items()
        },
    )


def check_load(load: str, what: str) -> None:
    """BenchError, which begins with `what`, for a load that no bench has."""
    if load in LOADS or ".py:" in load:
        return
    try:
        parse_target(load)
    except TargetError as error:
        raise BenchError(f"{what} must be {', '.join(LOADS)}, FILE.py:Class or a target: {error}") from None


def write_rated(path: Path | None, told: Mapping[str, float | None]) -> None:
    """Write what is told to [rated] of `path`, of the `settings_file`, or of a new one here; all else stays as it is.

    BenchError where the file says otherwise, or cannot be written.
    """
    file = path or settings_file() or Path(FILE)
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


class _Place:
    """Where the key stands that `keys` lead to, as FILE:LINE; it is looked for when that is shown."""

    def __init__(self, file: Path, text: str, *keys: str) -> None:
        self._file, self._text, self._keys = file, text, keys

    def __str__(self) -> str:
        lines = self._text.split("\n")
        for number in range(1, len(lines) + 1):
            with suppress(tomllib.TOMLDecodeError):  # a value goes on on the next line
                if self._has(tomllib.loads("\n".join(lines[:number]))):
                    return f"{self._file}:{number}"
        return str(self._file)

    def _has(self, table: Any) -> bool:
        for key in self._keys:
            if not isinstance(table, dict) or key not in table:
                return False
            table = table[key]
        return True


def _check(table: Any, known: Mapping[str, type], keys: tuple[str, ...], place: Callable[..., _Place]) -> None:
    prefix = "".join(f"{key}." for key in keys)
    for key, value in table.items():
        where = place(*keys, key)
        if key not in known:
            there = f"there are {', '.join(prefix + k for k in known)}"
            hint = did_you_mean(key, known, there, f"did you mean {prefix}{{}}?")
            raise BenchError(f"unknown key {prefix}{key} in {where}: {hint}")
        if not isinstance(value, known[key]) or (known[key] is Real and isinstance(value, bool)):
            word = {str: "text", bool: "true or false", dict: "a table", Real: "a number"}[known[key]]
            raise BenchError(f"{prefix}{key} in {where} must be {word}, got {value!r}")


def read_limits(name: str, value: Any, where: object) -> dict[str, float]:
    """Limits of a measurement as a TOML has them; BenchError for what are none."""
    if not isinstance(value, dict) or not value or not set(value) <= {"lo", "hi"}:
        raise BenchError(f"limits.{name!r} in {where} must look like {{ lo = 0.0, hi = 1.0 }}, got {value!r}")
    for bound in value.values():
        if isinstance(bound, bool) or not isinstance(bound, int | float) or not math.isfinite(bound):
            raise BenchError(f"limits.{name!r} in {where} must be finite numbers, got {bound!r}")
    return {key: float(bound) for key, bound in value.items()}
