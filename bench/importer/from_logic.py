"""Logic analysers: VCD (by pyvcd), sigrok's sessions, and the raw Hall captures of moteus; by exact times of changes.

Changes of a VCD file and of a session are kept in memory, some 20 bytes each.
"""

from __future__ import annotations

import configparser
import re
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bench.errors import BenchError
from bench.importer.files import reading, stream
from bench.importer.from_arrays import extra
from bench.importer.source import RATES, TICK_HZ, Arrays, Batch, Column, Memory, Table, Wanted
from bench.importer.units import quantity
from protocol.signals import Unit
from protocol.text import counted, printable

MOST_LINES = 64
MOST_TICKS = 1 << 62
MOST_UNPACKED = 1 << 40
"""Bytes that a session may unpack to: 12 h of a byte at 24 MHz."""
BLOCK = 1 << 22
RATE = 30_000.0
"""Samples a second of moteus's captures."""
_UNITS = {"s": 0, "ms": 3, "us": 6, "ns": 9, "ps": 12, "fs": 15}


def changes(
    format: str, names: list[str], ticks: list[int], levels: Any, tick_hz: int, about: Mapping[str, Any],
    left_out: list[str],
) -> Memory:  # fmt: skip
    """A table of lines by their changes; `levels` (changes, lines)."""
    found = np.asarray(levels)
    columns: Arrays = {"time": np.asarray(ticks, np.int64)}
    columns |= {name: found[:, k] for k, name in enumerate(names)}
    table = Table("", tuple(Column(name) for name in columns), "time", tick_hz=tick_hz, held=True)
    return Memory({"": columns}, (table,), format, about, left_out=left_out)


# -- VCD ------------------------------------------------------------------------------------------------------------


def vcd(path: Path) -> Memory:
    """Lines of one bit, and numbers of up to 32. Raises BenchError."""
    reader = extra("vcd.reader", "pyvcd", "a VCD file")
    with (
        reading(path, "VCD file", reader.VCDParseError, ValueError, UnicodeError, RecursionError),
        stream(path) as file,
    ):
        return _Vcd(path, reader, file).read()


class _Vcd:
    """A VCD file, token by token."""

    def __init__(self, path: Path, reader: Any, file: Any) -> None:
        self._path, self._kind = path, reader.TokenKind
        self._tokens = reader.tokenize(file)
        self._up, self._down = 1, 1  # ticks of ours for one of the file
        self.tick_hz = 0
        self._left_out: list[str] = []

    def read(self) -> Memory:
        """All of it."""
        ids = self._header()
        names = [name for name, _ in ids.values()]
        of = {code: k for k, code in enumerate(ids)}
        level = np.full(len(ids), np.nan)
        ticks: list[int] = []
        rows: list[Any] = []
        now, changed = 0, False
        for token in self._tokens:
            kind = token.kind
            if kind is self._kind.CHANGE_TIME:
                if changed:
                    ticks.append(now)
                    rows.append(level.astype(np.float32))
                    changed = False
                after = token.data * self._up // self._down
                if not now <= after < MOST_TICKS:
                    wrong = "goes back" if after < now else "is beyond all clocks"
                    raise BenchError(f"{self._path}: time {wrong} at #{token.data} (line {token.span.start.line})")
                now = after
            elif kind in (self._kind.CHANGE_SCALAR, self._kind.CHANGE_VECTOR):
                k = of.get(token.data.id_code)
                if k is not None:
                    level[k], changed = self._value(token.data.value), True
        ticks.append(now)
        rows.append(level.astype(np.float32))
        if len(rows) < 3:
            raise BenchError(f"{self._path}: no line changes")
        about = {"timescale_s": self._down / self._up / self.tick_hz}
        return changes("vcd", names, ticks, rows, self.tick_hz, about, self._left_out)

    @staticmethod
    def _value(value: Any) -> float:
        """A bit or a number; NaN for what is unknown (x) or driven by nobody (z)."""
        if isinstance(value, int):
            return float(value)
        return float(int(value, 2)) if value and not set(value) - {"0", "1"} else np.nan

    def _header(self) -> dict[str, tuple[str, int]]:
        """Names and widths by the code of a line."""
        ids: dict[str, tuple[str, int]] = {}
        scope: list[str] = []
        for token in self._tokens:
            if token.kind is self._kind.TIMESCALE:
                self._timescale(int(token.timescale.magnitude), str(token.timescale.unit.value))
            elif token.kind is self._kind.SCOPE:
                scope.append(token.scope.ident)
            elif token.kind is self._kind.UPSCOPE:
                scope = scope[:-1]
            elif token.kind is self._kind.VAR:
                self._variable(token.var, ids, scope)
            elif token.kind is self._kind.ENDDEFINITIONS:
                break
        if not ids:
            raise BenchError(f"{self._path} has no lines")
        if not self.tick_hz:
            raise BenchError(f"{self._path} tells no timescale")
        return ids

    def _variable(self, var: Any, ids: dict[str, tuple[str, int]], scope: list[str]) -> None:
        taken = {name for name, _ in ids.values()}
        name = var.reference if var.reference not in taken else ".".join((*scope, var.reference))
        if (
            var.type_.value in ("real", "realtime", "string", "event")
            or var.size > 32
            or var.id_code in ids
            or name in taken
        ):
            self._left_out.append(f"{printable(var.reference)}: {var.type_.value} of {counted(var.size, 'bit')}")
        elif len(ids) >= MOST_LINES:
            self._left_out.append(f"{printable(var.reference)}: more than {MOST_LINES} lines")
        else:
            ids[var.id_code] = name, var.size

    def _timescale(self, magnitude: int, unit: str) -> None:
        if not magnitude:
            raise BenchError(f"{self._path}: its timescale is 0 {unit}")
        per_s = 10 ** _UNITS[unit]
        self.tick_hz = min(per_s // magnitude if per_s >= magnitude else 1, TICK_HZ)
        self._up, self._down = self.tick_hz * magnitude, per_s


# -- sigrok ---------------------------------------------------------------------------------------------------------


def sigrok(path: Path) -> Memory:
    """A session: its logic lines; what is analogue is left out. Raises BenchError."""
    errors = (zipfile.BadZipFile, KeyError, ValueError, NotImplementedError, RuntimeError, configparser.Error)
    with reading(path, "sigrok session", *errors), zipfile.ZipFile(path) as file:
        told = configparser.ConfigParser(strict=False, interpolation=None)
        told.read_string(file.read("metadata")[: 1 << 20].decode("utf-8", "replace"))
        section = next((name for name in told.sections() if name.startswith("device")), None)
        if section is None or "samplerate" not in told[section]:
            raise BenchError(f"{path}: its metadata tell no sample rate")
        device = told[section]
        rate = _sample_rate(device["samplerate"])
        unit = int(device.get("unitsize", "1"))
        probes = {int(key[5:]) - 1: name for key, name in device.items() if re.fullmatch(r"probe\d+", key)}
        fitting = bool(probes) and min(probes) >= 0 and max(probes) < 8 * unit
        if not 1 <= rate <= RATES[1] or unit not in (1, 2, 4, 8) or not fitting:
            raise BenchError(f"{path}: its metadata do not fit together: {counted(unit, 'byte')} a sample, {rate} Hz, "
                             f"{counted(len(probes), 'line')}")  # fmt: skip
        capture = device.get("capturefile", "logic-1")
        members = [name for name in file.namelist() if re.fullmatch(re.escape(capture) + r"(-\d+)?", name)]
        members.sort(key=lambda name: int(name.rpartition("-")[2]) if name != capture else 0)
        size = sum(file.getinfo(name).file_size for name in members)
        if not members or size > MOST_UNPACKED:
            raise BenchError(f"{path}: {f'it unpacks to {size >> 30} GiB' if members else f'{capture} is not in it'}")
        ticks, words = _changed_words(file, members, np.dtype(f"<u{unit}"))
    lines = sorted(probes)
    levels = (words[:, None] >> np.array(lines, words.dtype)) & 1
    left_out = [f"{printable(value)}: analogue" for key, value in device.items() if re.fullmatch(r"analog\d+", key)]
    names = [probes[line] for line in lines]
    if len(set(names)) < len(names):
        names = [f"{name} ({line})" for line, name in zip(lines, names, strict=True)]
    return changes("sigrok", names, ticks, levels.astype(np.uint8), rate, {"samplerate_hz": rate}, left_out)


def _changed_words(file: zipfile.ZipFile, members: list[str], dtype: np.dtype[Any]) -> tuple[Any, Any]:
    """Sample numbers at which the word changes, the first and the last one too, and the words."""
    ticks, words, n, last, rest = [], [], 0, None, b""
    for member in members:
        with file.open(member) as data:
            while block := data.read(BLOCK):
                block = rest + block
                usable = len(block) - len(block) % dtype.itemsize
                rest, found = block[usable:], np.frombuffer(block[:usable], dtype)
                if not len(found):
                    continue
                before = found[:1] ^ 1 if last is None else last
                at = np.flatnonzero(np.diff(found, prepend=before) != 0)
                ticks.append(n + at)
                words.append(found[at])
                n, last = n + len(found), found[-1:]
    if last is None or n < 2:
        raise BenchError("it holds no samples")
    return np.concatenate([*ticks, [n - 1]]), np.concatenate([*words, last])


def _sample_rate(text: str) -> int:
    rate = quantity(text, Unit.HZ)
    if rate is None:
        raise BenchError(f"sample rate '{printable(text)[:30]}' is none")
    return round(min(rate, 1e12))


# -- moteus ---------------------------------------------------------------------------------------------------------


class MoteusFile:
    """Hall codes at 30 kHz, three bytes a sample: 0x5a, code, 0; it may begin within one. Raises BenchError."""

    format = "moteus"
    together = True
    left_out: tuple[str, ...] = ()
    HEADERS = 5

    def __init__(self, path: Path) -> None:
        self._path = path
        with reading(path), stream(path) as file:
            begin = file.read(3 * self.HEADERS + 3)
        starts = [k for k in range(3) if len(begin) > k + 12 and all(byte == 0x5A for byte in begin[k : k + 15 : 3])]
        if not starts:
            raise BenchError(f"{path} is no capture of moteus: no 0x5a in every third byte")
        self._first = starts[0]
        self.tables = (Table("", (Column("hall"),), rate=RATE),)
        self.about: Mapping[str, Any] = {"source": "moteus debug stream, servo.emit_debug"}

    def batches(self, wanted: Wanted) -> Iterator[Batch]:
        """See `Source`."""
        row = 0
        with reading(self._path), stream(self._path) as file:
            file.read(self._first)
            while block := file.read(3 << 16):
                block += b"\0" if len(block) % 3 == 2 else b""  # the last sample has its code
                packed = np.frombuffer(block[: len(block) - len(block) % 3], np.uint8).reshape(-1, 3)
                wrong = np.flatnonzero((packed[:, 0] != 0x5A) | (packed[:, 1] > 7) | (packed[:, 2] != 0))
                if len(wrong):
                    raise BenchError(
                        f"{self._path}: sample {row + int(wrong[0])} is damaged: bytes "
                        f"{' '.join(f'{byte:02x}' for byte in packed[wrong[0]])}, 5a, 0 to 7 and 0 were expected"
                    )
                yield {table: {"hall": packed[:, 1]} for table in wanted}
                row += len(packed)

    def line(self, table: str, row: int) -> str:
        """See `Source`."""
        return f"in sample {row}"
