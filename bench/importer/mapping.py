"""What of a file is what: the one mapping that options, a TOML file, a preset, a guess and Python come to.

[time]
column = "Time"            # or rate_hz = 30000 where the file has none
unit = "ms"

[hall]
columns = ["D0", "D1", "D2"]    # sensors a, b, c; or column = "hall", with bits = [0, 1, 2] of it

[motor]
n_p = 15

[channels.theta_enc]
column = "Position"
unit = "mech turns"        # "el deg" …
sign = -1
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import tomli_w
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from bench.errors import BenchError
from bench.importer import FORMATS
from bench.importer.units import scale_of
from protocol.signals import DRIVE_CHANNELS
from protocol.text import did_you_mean, either

VOCABULARY = {signal.name: signal for signal in DRIVE_CHANNELS if signal.name != "hall"}
"""Channels that everything else here knows; `hall` has a section of its own."""


def _require_unit(word: str, of: str) -> None:
    if word and scale_of(word) is None:
        raise ValueError(f"{of}: unit '{word}' is unknown; use SI, or such as deg, turns, rpm, mA, ms, \"mech deg\"")


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class TimeColumn(_Section):
    """The time of each row: a column, or how many rows a second there are."""

    column: str = ""
    unit: str = ""
    """Empty: as the file says."""
    none: bool = False
    """Whether what seems to be the time is not used."""
    rate_hz: float = Field(default=0.0, ge=0.0, le=1e9, allow_inf_nan=False)
    """Without a column, of the rows; with one, the rate that samples are made at. 0: as they are."""

    @model_validator(mode="after")
    def _known(self) -> TimeColumn:
        _require_unit(self.unit, "time")
        return self


class HallColumns(_Section):
    """The Hall inputs: three lines, or the bits of one number."""

    columns: tuple[str, str, str] | tuple[()] = ()
    """Sensors a, b, c."""
    column: str = ""
    bits: tuple[int, int, int] = (0, 1, 2)
    """Of sensors a, b, c in `column`."""
    threshold: float | None = Field(default=None, allow_inf_nan=False)
    """Of lines that are voltages, as the file has them; None: half way between their lowest and highest."""

    @model_validator(mode="after")
    def _one(self) -> HallColumns:
        if self.columns and self.column:
            raise ValueError("hall: give either columns or column")
        if len(set(self.columns)) not in (0, 3):
            raise ValueError(f"hall: columns name one line twice: {', '.join(self.columns)}")
        if len(set(self.bits)) != 3 or not all(0 <= bit < 32 for bit in self.bits):
            raise ValueError("hall: bits must be three different ones of 0..31")
        return self

    @property
    def named(self) -> tuple[str, ...]:
        """The columns that are looked at."""
        return self.columns or ((self.column,) if self.column else ())


class ChannelColumn(_Section):
    """A channel: (column * scale + offset) * sign, in `unit`."""

    column: str
    unit: str = ""
    """Empty: as the file says, else SI."""
    scale: float = Field(default=1.0, allow_inf_nan=False)
    offset: float = Field(default=0.0, allow_inf_nan=False)
    sign: Literal[1, -1] = 1

    @model_validator(mode="after")
    def _known(self) -> ChannelColumn:
        _require_unit(self.unit, self.column)
        if self.scale == 0.0:
            raise ValueError(f"{self.column}: scale must not be 0")
        return self


class Text(_Section):
    """How a text file is written; empty: as it seems."""

    separator: str = ""
    decimal: str = ""
    encoding: str = ""
    layout: Literal["", "wide", "long"] = ""
    """long: each row has a time, a name and a value."""
    names: tuple[str, ...] = ()
    """Of the columns, where the file has no header."""


class Motor(_Section):
    """What the file cannot know of the motor."""

    n_p: int | None = Field(default=None, ge=1, le=64)
    """Pole pairs."""
    counts_per_turn: float | None = Field(default=None, gt=0.0, allow_inf_nan=False)
    """Of an encoder whose angle is in counts."""


class Mapping(_Section):
    """All of it."""

    format: str = ""
    text: Text = Text()
    time: TimeColumn = TimeColumn()
    hall: HallColumns = HallColumns()
    motor: Motor = Motor()
    channels: dict[str, ChannelColumn] = {}
    units: dict[str, str] = {}
    """Of columns of which the file does not tell it, or tells it wrongly."""
    others: bool = True
    """Whether columns that are not named come along under their own names."""
    signature: tuple[str, ...] = ()
    """Of a preset: columns by which a file of its tool is known."""

    @model_validator(mode="after")
    def _known(self) -> Mapping:
        if self.format and self.format not in FORMATS:
            raise ValueError(f"format '{self.format}' is unknown; there are {', '.join(FORMATS)}")
        for column, unit in self.units.items():
            _require_unit(unit, column)
        for name in self.channels:
            if name not in VOCABULARY:
                hint = did_you_mean(name, VOCABULARY, f"there are {', '.join(VOCABULARY)}")
                raise ValueError(f"channel '{name}' is unknown; {hint}")
        return self

    @property
    def named(self) -> Iterator[str]:
        """The columns that it names."""
        yield from filter(None, (self.time.column, *self.hall.named))
        yield from (channel.column for channel in self.channels.values())


def mapping_of(data: Any, what: str) -> Mapping:
    """A mapping from plain data; `what` names it to the user. Raises BenchError of one line."""
    try:
        return Mapping.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        words = first["msg"].removeprefix("Value error, ")
        got = "" if first["type"] in ("value_error", "missing") else f", got {str(first['input'])[:60]!r}"
        raise BenchError(f"{what}: {where}{': ' if where else ''}{words}{got}") from None


@cache
def presets() -> tuple[str, ...]:
    """Names of those that are shipped."""
    files = resources.files("bench.importer").joinpath("presets").iterdir()
    return tuple(sorted(file.name.removesuffix(".toml") for file in files if file.name.endswith(".toml")))


@cache
def preset(name: str) -> Mapping:
    """The one of that name."""
    text = resources.files("bench.importer").joinpath("presets", f"{name}.toml").read_text("utf-8")
    return mapping_of(tomllib.loads(text), name)


def read(name: str) -> Mapping:
    """The mapping in a TOML file, or a preset by its name. BenchError for what is neither, or not right."""
    if name in presets():
        return preset(name)
    try:
        return mapping_of(tomllib.loads(Path(name).read_text("utf-8-sig")), name)
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or "it is no text"
        raise BenchError(f"--map {name}: {why}; there are the presets {either(presets())}") from None
    except tomllib.TOMLDecodeError as error:
        raise BenchError(f"{name} is no TOML: {error}") from None


def to_toml(mapping: Mapping) -> str:
    """The mapping as `read` takes it."""
    return tomli_w.dumps(mapping.model_dump(exclude_defaults=True, exclude={"signature"}))
