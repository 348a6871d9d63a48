"""What a file's columns seem to be: by a tool's preset, by their names and units, and by which lines change.

Nothing is taken for an angle or a speed whose unit nobody tells. What was guessed is said before it is used.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np

from bench.importer.mapping import VOCABULARY, ChannelColumn, HallColumns, Mapping, preset, presets
from bench.importer.source import Source, Table, numbers
from bench.importer.units import scale_of
from protocol.signals import Unit
from protocol.text import printable

_CURRENT = r"(?:i|current|curr|phase_?current|i_?phase|iphase|phase)"
_NAMES = {
    "theta_enc": r"theta|angle|(?:encoder|enc|rotor|shaft|motor|mech|el|electrical|mechanical)_?(?:angle|position|pos)|"
                 r"position|pos|theta_e|theta_m",
    "omega_enc": r"(?:(?:motor|shaft|rotor|encoder|mech|el)_?)?(?:speed|velocity|vel|rpm)|omega(?:_[em])?",
    "i_a": rf"{_CURRENT}_?[au]|i_?a|[au]_?current",
    "i_b": rf"{_CURRENT}_?[bv]|i_?b|[bv]_?current",
    "i_c": rf"{_CURRENT}_?[cw]|i_?c|[cw]_?current",
    "i_d": rf"{_CURRENT}_?d|d_?(?:axis_)?current|id_meas(?:ured)?",
    "i_q": rf"{_CURRENT}_?q|q_?(?:axis_)?current|iq_meas(?:ured)?",
    "i_d_ref": r"i_?d_?(?:ref|setpoint|set|cmd|target)",
    "i_q_ref": r"i_?q_?(?:ref|setpoint|set|cmd|target)",
    "u_alpha": r"[uv]_?alpha",
    "u_beta": r"[uv]_?beta",
    "u_dc": r"[uv]_?(?:dc|bus|bat|batt)|(?:dc_?)?bus_?voltage|dc_?link(?:_?voltage)?|supply_?voltage|input_voltage",
    "omega_ref": r"(?:speed|velocity|omega|rpm)_?(?:ref|setpoint|set|cmd|target)",
}  # fmt: skip
_LINES = (
    r"(?:digital_?)?(?:hall|hs|h)_?(?:sensor_?|input_?)?{}", r"{}_?hall",
)  # fmt: skip
_OF_SENSORS = ("abc", "uvw", "123", "012")
_CODE = r"(?:digital_?)?halls?(?:_?(?:state|code|sensors?|value|input|inputs|bits|abc|uvw))?"


@dataclass(frozen=True)
class Guess:
    """A mapping with what was not told of it."""

    mapping: Mapping
    guessed: frozenset[str]
    """Channels of it that nobody has told, and `hall`."""
    words: tuple[str, ...]
    """What was guessed, and what might be meant but is not sure."""


def complete(source: Source, told: Mapping) -> Guess:
    """The mapping with what the file seems to have beside what was told."""
    words: list[str] = []
    mapping = _with_preset(source, told, words)
    channels = dict(mapping.channels)
    taken = {*mapping.named, *(table.time or "" for table in source.tables)}
    guessed = {name for name in channels if name not in told.channels}
    hall = mapping.hall
    if not hall.named and (found := _hall(source, taken)):
        hall = found
        guessed.add("hall")
        words.append(f"Hall inputs: {', '.join(map(printable, found.named))}")
        taken |= set(found.named)
    for name, pattern in _NAMES.items():
        if name not in channels and mapping.others:
            column, sure = _channel(source, mapping, name, pattern, taken)
            if column is not None and sure:
                channels[name] = column
                guessed.add(name)
                taken.add(column.column)
                unit = column.unit or VOCABULARY[name].unit.symbol
                words.append(f"{name}: {printable(column.column)}{f', {unit}' if unit else ''}")
            elif column is not None:
                words.append(
                    f"{printable(column.column)} may be {name}, but nothing tells its unit: --channel "
                    f"'{name}={column.column}:UNIT'"
                )
    return Guess(mapping.model_copy(update={"channels": channels, "hall": hall}), frozenset(guessed), tuple(words))


def _with_preset(source: Source, told: Mapping, words: list[str]) -> Mapping:
    """The mapping, with the preset whose columns the file has, or with its own names where they are patterns."""
    chosen = told
    if not any(True for _ in told.named) and not told.units:
        for name in presets():
            shipped = preset(name)
            if shipped.signature and all(_matching(source, pattern) for pattern in shipped.signature):
                words.append(f"it is written as {name} writes: preset {name}")
                chosen = shipped
                break
    channels = {
        name: column.model_copy(update={"column": found})
        for name, column in chosen.channels.items()
        if (
            found := _matching(source, column.column)
            or ("" if chosen is not told or "*" in column.column else column.column)
        )
    }
    hall = chosen.hall
    if "*" in hall.column:
        hall = hall.model_copy(update={"column": _matching(source, hall.column)})
    update = {"channels": channels, "hall": hall}
    if chosen is not told:
        time = told.time.model_copy(update={
            key: getattr(told.time, key) or getattr(chosen.time, key) for key in ("column", "unit", "rate_hz")
        })  # fmt: skip
        update |= {"time": time, "motor": told.motor, "format": told.format, "text": told.text, "others": told.others}
    return chosen.model_copy(update=update)


def _columns(source: Source) -> Iterator[tuple[Table, str, str]]:
    for table in source.tables:
        for column in table.columns:
            if column.name != table.time:
                yield table, column.name, column.unit


def _matching(source: Source, pattern: str) -> str:
    """The shortest name that fits a pattern, upper and lower case alike; empty for none."""
    names = [name for _, name, _ in _columns(source)] + [table.time or "" for table in source.tables]
    if pattern in names:
        return pattern
    return min((n for n in names if n and fnmatchcase(n.lower(), pattern.lower())), key=len, default="")


def _plain(name: str) -> str:
    """A name without its path, in small letters."""
    last = re.split(r"[/.]", name)[-1] or name
    return re.sub(r"[^a-z0-9]+", "_", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", last).lower()).strip("_")


def _channel(
    source: Source, mapping: Mapping, name: str, pattern: str, taken: set[str]
) -> tuple[ChannelColumn | None, bool]:
    """A column that seems to be a channel, and whether its unit is known."""
    wanted = VOCABULARY[name].unit
    for _, column, unit in _columns(source):
        if column in taken:
            continue
        plain = _plain(column)
        if plain == name:
            return ChannelColumn(column=column), True
        if not re.fullmatch(pattern, plain):
            continue
        unit = mapping.units.get(column, unit)
        if not unit and plain.endswith("rpm"):
            unit = "rpm"
        scale = scale_of(unit) if unit else None
        if scale is None or scale.unit == Unit.NONE:
            return ChannelColumn(column=column), False
        if scale.unit == wanted:
            frame = re.match(r"(el|electrical|mech|mechanical|shaft)(?:_|$)|.*_(e|m)$", plain)
            if frame and scale.electrical is None:
                unit = f"{'el' if (frame[1] or frame[2]).startswith('e') else 'mech'} {unit}"
            return ChannelColumn(column=column, unit=unit), True
    return None, False


def _hall(source: Source, taken: set[str]) -> HallColumns | None:
    """Three lines, or a code, by their names; or the three lines that change."""
    names = {_plain(name): name for _, name, _ in _columns(source) if name not in taken}
    for form in _LINES:
        for letters in _OF_SENSORS:
            found = [next((n for p, n in names.items() if re.fullmatch(form.format(x), p)), "") for x in letters]
            if all(found):
                return HallColumns(columns=(found[0], found[1], found[2]))
    for plain, name in names.items():
        if re.fullmatch(_CODE, plain):
            return HallColumns(column=name)
    for table in source.tables:
        if table.held and (lines := _changing(source, table, taken)) and len(lines) == 3:
            return HallColumns(columns=(lines[0], lines[1], lines[2]))
    return None


def _changing(source: Source, table: Table, taken: set[str]) -> list[str]:
    """Lines of 0 and 1 of a table that change."""
    names = [name for name in table.names if name != table.time and name not in taken]
    seen: dict[str, set[float]] = {name: set() for name in names}
    for batch in source.batches({table.name: names}) if names else ():
        for name, values in batch[table.name].items():
            found = numbers(values)
            seen[name] |= set(np.unique(found[np.isfinite(found)] if found.dtype.kind == "f" else found)[:3].tolist())
    return [name for name, values in seen.items() if values == {0, 1}]
