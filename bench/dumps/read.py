"""A configuration file of VESC Tool, ODrive or moteus_tool, as names and values.

Which of the three it is follows from its text, never from its name. Whoever reads it may have got it from anywhere:
its size is bounded, XML may declare nothing, and a value counts only where it is a finite number.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import ParseError, fromstring

from bench.errors import BenchError
from bench.files import leaves

MOST_BYTES = 10_000_000
VESC, ODRIVE, MOTEUS = "VESC", "ODrive", "moteus"
KNOWN = "VESC Tool's XML, odrivetool's JSON and the text of moteus_tool --dump-config are known"
AXIS = re.compile(r"axis(\d+)\.")


@dataclass(frozen=True)
class Dump:
    """What a file says."""

    path: Path
    tool: str
    values: Mapping[str, Any]
    """By name, of JSON dotted; of ODrive those of one axis, without its number: `motor.config.pole_pairs`."""
    notes: tuple[str, ...] = ()

    def number(self, *names: str) -> float | None:
        """The first of these that the file has; None for none. BenchError where that is no finite number."""
        name = next((name for name in names if name in self.values), "")
        if not name:
            return None
        given, number = self.values[name], math.nan
        with suppress(TypeError, ValueError, OverflowError):
            number = math.nan if isinstance(given, bool) else float(given)
        if not math.isfinite(number):
            raise BenchError(f"{self.path}: {name} = {str(given)[:40]} is not a finite number")
        return number

    def whole(self, *names: str) -> int | None:
        """The same, where it is to be a whole number."""
        number = self.number(*names)
        if number is not None and not number.is_integer():
            raise BenchError(f"{self.path}: {next(n for n in names if n in self.values)} = {number:g} is not whole")
        return None if number is None else int(number)


def read(path: Path, axis: int | None = None) -> Dump:
    """Read the file; of an ODrive with two axes the one with this number, or the first. BenchError for any other."""
    data = _data(path)
    start = data.lstrip(b"\xef\xbb\xbf \t\r\n")[:1]
    if axis is not None and start != b"{":
        raise BenchError(f"--axis {axis}: {path} is not of an ODrive, and has one motor")
    if start == b"<" or data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return Dump(path, VESC, _xml(path, data))
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise BenchError(f"{path} is neither XML nor text: {KNOWN}") from None
    return _odrive(path, text, axis) if start == b"{" else Dump(path, MOTEUS, _lines(path, text))


def _data(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            data = file.read(MOST_BYTES + 1)
    except (OSError, ValueError) as error:  # the latter: a name that can be none
        raise BenchError(f"{path} cannot be read: {getattr(error, 'strerror', error)}") from None
    if len(data) > MOST_BYTES:
        raise BenchError(f"{path} is larger than {MOST_BYTES // 1_000_000} MB: that is no configuration of a motor")
    return data


def _xml(path: Path, data: bytes) -> dict[str, str]:
    try:
        root = fromstring(data, forbid_dtd=True)
    except DefusedXmlException:
        raise BenchError(f"{path} declares a document type or entities, which VESC Tool never does: refused") from None
    except (ParseError, ValueError, LookupError) as error:  # the latter two: an encoding
        raise BenchError(f"{path} is not valid XML: {error}") from None
    if root.tag != "MCConfiguration":
        raise BenchError(f"{path} holds <{str(root.tag)[:40]}>, not <MCConfiguration>: save the motor's configuration")
    values: dict[str, str] = {}
    for element in root:
        name = re.sub("__+", "_", str(element.tag))  # foc_hall_table__1 since vesc_tool 3, foc_hall_table_1 before
        text = (element.text or "").strip()
        if values.setdefault(name, text) != text:
            raise BenchError(f"{path} has {name} twice: {values[name][:40]} and {text[:40]}")
    return values


def _odrive(path: Path, text: str, axis: int | None) -> Dump:
    try:
        found = dict(leaves(json.loads(text)))
    except (ValueError, RecursionError) as error:
        words = "nested too deeply" if isinstance(error, RecursionError) else error
        raise BenchError(f"{path} is not valid JSON: {words}") from None
    there = sorted({int(of[1]) for name in found if (of := AXIS.match(name)) and len(of[1]) < 3})
    chosen = axis if axis is not None else next(iter(there), 0)
    if chosen not in there:
        had = f"it has {', '.join(f'axis{n}' for n in there)}" if there else KNOWN
        raise BenchError(f"{path} has no axis{chosen} of an ODrive: {had}")
    values = {}
    for name, value in found.items():
        number = re.match(r"(axis|hall_encoder)(\d+)\.", name)
        if number is None or int(number[2]) == chosen:
            values[re.sub(r"^axis\d+\.|(?<=^hall_encoder)\d+", "", name)] = value
    more = axis is None and len(there) > 1
    return Dump(path, ODRIVE, values, (f"axis{chosen} of {len(there)} is taken; --axis chooses",) if more else ())


def _lines(path: Path, text: str) -> dict[str, str]:
    values: dict[str, str] = {}
    for line in text.splitlines():
        words = line.split("#")[0].removeprefix("conf set ").split()
        if len(words) == 2:
            values[words[0]] = words[1]
    if "motor.poles" not in values:
        raise BenchError(f"{path} is no configuration of a motor: {KNOWN}")
    return values
