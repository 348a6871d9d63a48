"""Parameters as a file that a person reads, edits and keeps under version control: TOML, one parameter a line.

Comments tell unit, range, default and meaning; nobody reads them back. What cannot be loaded, because it is read-only,
stands in a table of its own, and what does not last is left out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tomli_w

from bench.errors import BenchError
from bench.files import read_toml
from bench.param.groups import GROUP_MEANINGS, GROUP_NAMES
from bench.param.table import (
    NO_FLAGS,
    ParameterEntry,
    Parameters,
    same,
    shortest,
    vocabulary,
)
from protocol import __version__
from protocol.signals import Flag
from protocol.text import printable

FORMAT = 1
_ABOUT = ("drive", "node", "role", "firmware", "serial", "build", "schema_crc")
_TABLES = {"dump": dict, "parameters": dict, "read_only": dict, "reasons": dict, "format": int}


@dataclass(frozen=True)
class Reason:
    """Why a parameter is not at its default: its last change."""

    before: float
    value: float
    when: str
    who: str
    reason: str


@dataclass(frozen=True)
class Dump:
    """A dump that was read."""

    path: Path
    parameters: Parameters
    """Those that can be loaded, and those that are read-only."""
    about: Mapping[str, Any] = field(default_factory=dict)


def text(
    parameters: Parameters, when: str, who: str, reason: str = "", reasons: Mapping[str, Reason] | None = None
) -> str:
    """A dump of a device's parameters. `when` and `who`: of the dump, `reason`: why it is made."""
    identity = parameters.identity
    about = {**{key: identity.get("name" if key == "drive" else key, "") for key in _ABOUT}, "when": when, "who": who}
    header = about | ({"reason": reason} if reason else {}) | {"hallbench": __version__}
    entries = list(parameters.entries.values())
    lines = [
        "# Parameters of a device, by bench param dump. `bench param load FILE TARGET` shows what differs, asks, and",
        "# writes the values of [parameters] back. Comments: unit, range, default, meaning.",
        f"format = {FORMAT}",
        "",
        "[dump]",
        *(f"{key} = {_toml(value)}" for key, value in header.items()),
        "",
        "[parameters]",
        *_grouped([entry for entry in entries if entry.loadable]),
    ]
    read_only = [entry for entry in entries if entry.lasts and not entry.loadable]
    if read_only:
        lines += ["", "[read_only]  # what the device tells and does not let one set", *_lines(read_only)]
    told = {entry.name: (reasons or {})[entry.name] for entry in entries if entry.name in (reasons or {})}
    if told:
        lines += ["", "[reasons]  # the last change of each parameter that is not at its default, where one is known"]
    for name, why in told.items():
        values = {"before": why.before, "value": why.value}
        said = {"when": why.when, "who": why.who, "reason": why.reason}
        pairs = [f"{key} = {shortest(value, point=True)}" for key, value in values.items()]
        pairs += [f"{key} = {_toml(value)}" for key, value in said.items()]
        lines.append(f"{_key(name)} = {{ {', '.join(pairs)} }}")
    return "\n".join(lines) + "\n"


def _grouped(entries: Sequence[ParameterEntry]) -> list[str]:
    lines: list[str] = []
    for group in GROUP_NAMES:
        if members := [entry for entry in entries if entry.group == group]:
            lines += [*([""] if lines else []), f"# {group}: {GROUP_MEANINGS[group]}", *_lines(members)]
    return lines


def _lines(entries: Sequence[ParameterEntry]) -> list[str]:
    """One line for each parameter, with the comments below each other."""
    pairs = [f"{_key(entry.name)} = {shortest(entry.value, point=not entry.flags & Flag.WHOLE)}" for entry in entries]
    width = max(map(len, pairs), default=0)
    return [f"{pair.ljust(width)}  # {_comment(entry)}".rstrip() for pair, entry in zip(pairs, entries, strict=True)]


def _comment(entry: ParameterEntry) -> str:
    words = [entry.unit] if entry.unit else []
    if entry.lo is not None and entry.hi is not None:
        words.append(f"{shortest(entry.lo)} to {shortest(entry.hi)}")
    if entry.default is not None:
        words.append(f"default {shortest(entry.default)}")
    comment = ", ".join(words) + (f": {entry.meaning}" if entry.meaning else "")
    return printable(" ".join(comment.split()))


def _key(name: str) -> str:
    """A name as a key of TOML: a device may have names that are none."""
    return name if name and all(c.isascii() and (c.isalnum() or c in "_-") for c in name) else _toml(name)


def _toml(value: Any) -> str:
    """A value as TOML has it, on one line."""
    return tomli_w.dumps({"x": value}).removeprefix("x = ").rstrip("\n")


def read(path: Path) -> Dump:
    """Read a dump. BenchError, naming the file and what is wrong in it, for what is none."""
    data = read_toml(path, "dump")
    if not isinstance(data.get("parameters"), dict):
        raise BenchError(f"{path} is no dump of parameters: it has no table [parameters]")
    for key, value in data.items():
        if key not in _TABLES or not isinstance(value, _TABLES[key]):
            raise BenchError(f"{path}: '{key}' does not belong into a dump; it has {', '.join(_TABLES)}")
    if data.get("format", FORMAT) != FORMAT:
        raise BenchError(f"{path} has format {data['format']}, this version reads {FORMAT}: update hallbench")
    about = data.get("dump", {})
    known, entries = vocabulary(str(about.get("role", ""))), {}
    for table, flag in (("parameters", NO_FLAGS), ("read_only", Flag.READ_ONLY)):
        for name, value in data.get(table, {}).items():
            if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
                raise BenchError(f"{path}: {name} must be a finite number, got {value!r}")
            if name in entries:
                raise BenchError(f"{path}: {name} stands in [parameters] and in [read_only]: remove one")
            record = known.get(name)
            unit, meaning = ("", "") if record is None else (record.unit.symbol, record.about)
            kind = flag | (NO_FLAGS if record is None else record.flags & ~Flag.READ_ONLY)
            entries[name] = ParameterEntry(name, float(value), unit, flags=kind, meaning=meaning)
    identity = {("name" if key == "drive" else key): about[key] for key in _ABOUT if key in about}
    return Dump(path, Parameters(str(path), entries, identity), about)


def listed_reasons(parameters: Parameters, last: Mapping[str, Reason]) -> dict[str, Reason]:
    """Of the last changes that are known, those that made parameters what they are, and not at their defaults."""
    return {
        name: last[name]
        for name, entry in parameters.entries.items()
        if name in last and entry.changed and same(last[name].value, entry.value)
    }
