"""A mapping put on a file: which column of which table becomes which channel, by which factor."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, count

from bench.errors import BenchError
from bench.importer.mapping import VOCABULARY, ChannelColumn, HallColumns
from bench.importer.mapping import Mapping as Mapped
from bench.importer.source import RATES, Column, Source, Table
from bench.importer.units import Scale, scale_of
from protocol.signals import Flag, Unit
from protocol.text import counted, did_you_mean, printable

AS_SECONDS = "taken as s (--time-unit)"
MOST = 250
"""Channels of a run."""
TURNING = (Unit.RAD, Unit.RAD_PER_S)
"""Units of which it matters whether they are the shaft's or the rotor flux's."""


@dataclass(frozen=True)
class Input:
    """A channel: physical value = column * factor + offset, in `unit`."""

    name: str
    table: str
    column: str
    unit: Unit
    factor: float
    offset: float = 0.0
    flags: Flag = Flag.CHANNEL
    electrical: bool | None = True
    """Whether `factor` makes electrical angles or speeds; False: mechanical ones; None: nobody has said."""
    own: bool = False
    """Whether it came along under its own name."""
    guessed: bool = False
    """Whether nobody has said that it is this channel."""

    @property
    def wraps(self) -> bool:
        """Whether it is an angle in [-pi, pi)."""
        return bool(self.flags & Flag.WRAPS)


@dataclass(frozen=True)
class Plan:
    """What is made of a file."""

    tables: Mapping[str, Table]
    """Those that are used, by name."""
    inputs: tuple[Input, ...]
    hall: HallColumns
    lines: tuple[tuple[str, str], ...]
    """Table and column of the Hall inputs: three, or the one that has their bits; none without them."""
    time_factor: Mapping[str, float]
    """s by table: what a unit of its time column is."""
    n_p: int | None
    left_out: tuple[str, ...]
    """Columns that do not come along, and why."""
    notes: tuple[str, ...]

    @property
    def wanted(self) -> dict[str, list[str]]:
        """Columns by table."""
        found: dict[str, list[str]] = {name: [] for name in self.tables}
        for of, column in (*((one.table, one.column) for one in self.inputs), *self.lines):
            found[of].append(column)
        for name, table in self.tables.items():
            found[name] += [table.time] if table.time else []
        return {name: list(dict.fromkeys(columns)) for name, columns in found.items()}

    def with_n_p(self, n_p: int | None, electrical: Mapping[str, bool]) -> Plan:
        """The same, with what was found of those that nobody had said: the pole pairs, and whose angles they are."""
        inputs = tuple(replace(one, electrical=electrical.get(one.name, one.electrical)) for one in self.inputs)
        return replace(self, n_p=n_p, inputs=inputs)

    def electrical(self) -> Plan:
        """The same with electrical angles and speeds. BenchError where the pole pairs are not known."""
        inputs: list[Input] = []
        notes = list(self.notes)
        taken = {one.name for one in self.inputs}
        for one in self.inputs:
            if one.guessed and (one.electrical is None or (not one.electrical and self.n_p is None)):
                name = free_name(one.column, taken)
                notes.append(
                    f"{printable(one.column)} comes along as {name}: nothing tells "
                    + (f"whether it is mechanical or electrical: --channel '{one.name}={one.column}:mech deg' or such"
                       if one.electrical is None else "the pole pairs, to make it electrical: --pole-pairs")
                )  # fmt: skip
                inputs.append(replace(one, name=name, flags=Flag.CHANNEL, own=True))
                continue
            if one.electrical is None:
                what = one.unit.symbol if one.unit == Unit.RAD else "speed"
                raise BenchError(
                    f"{one.column}, which becomes {one.name}: nobody says whether it is the shaft's or the rotor "
                    f"flux's ({what}): --channel '{one.name}={one.column}:mech {one.unit.symbol}' with --pole-pairs, "
                    f"or ':el {one.unit.symbol}'"
                )
            if not one.electrical:
                if self.n_p is None:
                    raise BenchError(f"{one.column} is mechanical and {one.name} electrical: give --pole-pairs")
                one = replace(one, factor=one.factor * self.n_p, offset=one.offset * self.n_p, electrical=True)
            inputs.append(one)
        return replace(self, inputs=tuple(inputs), notes=tuple(notes))


def plan(source: Source, mapping: Mapped, guessed: Collection[str] = ()) -> Plan:
    """Put a mapping on what was opened. Raises BenchError for a column that there is not, or that does not fit."""
    inputs = [
        replace(_mapped(source, name, column, mapping), guessed=name in guessed)
        for name, column in mapping.channels.items()
    ]
    lines = tuple(find(source, name, "Hall input") for name in mapping.hall.named)
    used = {(one.table, one.column) for one in inputs} | set(lines)
    times = {name: _time(source, table, mapping) for name, table in named_tables(source).items()}
    others, left_out = _others(source, mapping, used, times, inputs) if mapping.others else ([], [])
    inputs += others
    tables = dict.fromkeys([*(one.table for one in inputs), *(table for table, _ in lines)])
    if not tables:
        for table, _, _ in times.values():
            if table.time is None and not table.rate:
                raise _untimed(table)
        raise BenchError("nothing to import: no column is named, and none has numbers")
    chosen, factors, notes = {}, {}, []
    for name in tables:
        table, factor, told = times[name]
        if table.time is None and not table.rate:
            raise _untimed(table)
        chosen[name], factors[name] = table, factor
        notes += [told] if told and told not in notes else []
    n_p = mapping.motor.n_p
    return Plan(chosen, tuple(inputs), mapping.hall, lines, factors, n_p, tuple(left_out), tuple(notes))


def _untimed(table: Table) -> BenchError:
    return BenchError(
        f"{_of(table)}no column tells the time; there are {_names(table)}: give --time COLUMN, or --rate HZ, samples a "
        "second"
    )


def named_tables(source: Source) -> dict[str, Table]:
    """Its tables by name."""
    return {table.name: table for table in source.tables}


def find(source: Source, wanted: str, what: str) -> tuple[str, str]:
    """Table and column by a name such as `speed` or `group/speed`. BenchError for none, or for several."""
    found = [
        (table.name, column.name)
        for table in source.tables
        for column in table.columns
        if wanted in (column.name, f"{table.name}/{column.name}")
    ]
    exact = [one for one in found if f"{one[0]}/{one[1]}" == wanted] or found
    if len(exact) == 1:
        return exact[0]
    if exact:
        where = ", ".join(f"{table}/{column}" for table, column in exact[:5])
        raise BenchError(f"{what}: {len(exact)} columns are named '{printable(wanted)}': choose one of {where}")
    known = [column.name for table in source.tables for column in table.columns]
    hint = did_you_mean(wanted, known, f"there are {', '.join(map(printable, known[:30]))}")
    raise BenchError(f"{what}: no column '{printable(wanted)}'; {hint}")


def _time(source: Source, table: Table, mapping: Mapped) -> tuple[Table, float, str]:
    """The table with the time that is wanted of it, what a unit of that is in s, and words about it."""
    told = mapping.time
    if told.none and not table.held:
        table = replace(table, time=None, rate=0.0, tick_hz=0)
    if told.column:
        there = [name for name in table.names if told.column in (name, f"{table.name}/{name}")]
        if not there and not table.time and not table.rate and len(source.tables) == 1:
            find(source, told.column, "time")
        if there:
            table = replace(table, time=there[0], rate=0.0, tick_hz=0 if there[0] != table.time else table.tick_hz)
    elif told.rate_hz and not table.held and not table.rate and table.time is None:
        table = replace(table, rate=told.rate_hz)
    if table.rate and not RATES[0] <= table.rate <= RATES[1]:
        raise BenchError(f"{_of(table)}{table.rate:g} rows a second are no rate: give --time '' and --rate HZ")
    if table.time is None or table.tick_hz:
        return table, 1.0 / table.tick_hz if table.tick_hz else 1.0, ""
    unit = next(column.unit for column in table.columns if column.name == table.time)
    in_name = re.search(r"[\[(]([^\])]+)[\])]$", table.time)  # of which nothing is known
    word = told.unit or unit or (in_name[1] if in_name else "")
    scale = scale_of(word) if word else None
    if scale is None or scale.unit != Unit.S:
        why = f"unit '{word}' is no time" if word else "the file does not say the unit"
        if word:
            raise BenchError(f"time column {table.time}: {why}: give --time-unit s, ms, us or ns")
        return table, 1.0, f"time column {table.time}: {why}: {AS_SECONDS}"
    return table, scale.factor, ""


def _mapped(source: Source, name: str, told: ChannelColumn, mapping: Mapped) -> Input:
    """A channel of the vocabulary."""
    table, column = find(source, told.column, name)
    signal = VOCABULARY[name]
    unit = told.unit or mapping.units.get(column, _column(source, table, column).unit)
    scale = _fitting(signal.unit, scale_of(unit) if unit else None, unit, name, mapping)
    factor, offset = told.sign * scale.factor * told.scale, told.sign * scale.factor * told.offset
    electrical = scale.electrical if signal.unit in TURNING else True
    flags = signal.flags & ~Flag.ON_REQUEST
    return Input(name, table, column, signal.unit, factor, offset, flags, electrical)


def _column(source: Source, table: str, name: str) -> Column:
    return next(column for column in named_tables(source)[table].columns if column.name == name)


def _fitting(wanted: Unit, scale: Scale | None, word: str, name: str, mapping: Mapped) -> Scale:
    """What makes `wanted` of a unit. BenchError where it is something else."""
    if scale is None or (scale.unit == Unit.NONE and wanted != Unit.NONE):
        if word.strip("[](){} -"):
            raise BenchError(f"{name}: unit '{word}' is unknown: give it, such as :{wanted.symbol}")
        return Scale(wanted, 1.0, None)
    if scale.unit == wanted:
        return scale
    if scale.unit == Unit.HZ and wanted == Unit.RAD_PER_S:
        return Scale(wanted, scale.factor * math.tau, scale.electrical)
    if scale.unit == Unit.COUNT and wanted in TURNING:
        per_turn = mapping.motor.counts_per_turn
        if per_turn is None:
            raise BenchError(f"{name} is in counts: how many a turn? --counts-per-turn N")
        return Scale(wanted, math.tau / per_turn, scale.electrical or False)
    raise BenchError(f"{name}: unit '{word}' is not {wanted.symbol or 'a number'} or what can be made so")


def _others(
    source: Source, mapping: Mapped, used: set[tuple[str, str]],
    times: Mapping[str, tuple[Table, float, str]], named: Sequence[Input],
) -> tuple[list[Input], list[str]]:  # fmt: skip
    """Columns that come along under their own names, and those that do not, with the reason."""
    taken = {*VOCABULARY, "hall", *(one.name for one in named)}
    found: list[Input] = []
    left_out: list[str] = [*source.left_out]
    names = [column.name for table in source.tables for column in table.columns]
    rest = [
        (table, column)
        for table in source.tables
        for column in table.columns
        if (table.name, column.name) not in used and column.name != times[table.name][0].time
    ]
    for table, column in rest:
        if not (times[table.name][0].time or times[table.name][0].rate):
            left_out.append(f"{printable(column.name)}: nothing tells its time")
            continue
        if len(found) + len(named) >= MOST:
            raise BenchError(
                f"it has {counted(len(rest), 'column')}, and a run takes {MOST} channels: name those that are wanted "
                "(--channel), and --only-named"
            )
        alone = names.count(column.name) == 1
        name = free_name(column.name if alone else f"{table.name}_{column.name}", taken)
        taken.add(name)
        word = mapping.units.get(column.name, column.unit)
        scale = scale_of(word) or Scale(Unit.NONE, 1.0)
        unit = Unit.NONE if word.endswith("/s") and scale.unit == Unit.COUNT else scale.unit
        found.append(Input(name, table.name, column.name, unit, scale.factor, own=True))
    return found, left_out


def free_name(name: str, taken: set[str]) -> str:
    """A name made of a column's that no other has."""
    plain = re.sub(r"[^\w.]+", "_", name).strip("_.")[:60] or "column"
    tries = chain([plain], (f"{plain}_{k}" for k in count(1)))
    return next(one for one in (t if t.lower() not in ("t", "tick", "index") else f"{t}_" for t in tries)
                if one not in taken)  # fmt: skip


def _names(table: Table) -> str:
    return ", ".join(map(printable, table.names[:20])) + (" …" if len(table.names) > 20 else "")


def _of(table: Table) -> str:
    return f"{table.name}: " if table.name else ""
