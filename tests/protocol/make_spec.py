"""Writes the generated tables of SPEC.md, between `<!-- name -->` and `<!-- end -->`, and the numbers in c/hbp.h.

A test compares. Channels and parameters come from `protocol.signals`, codes from `protocol.codes`.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable
from enum import IntEnum, IntFlag
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from protocol import codes
from protocol.signals import (
    DRIVE_CHANNELS,
    DRIVE_PARAMETERS,
    INPUT_OF_SENSOR,
    LESSONS,
    LOAD_CHANNELS,
    LOAD_PARAMETERS,
    AngleSource,
    Flag,
    HallSwap,
    Injection,
    Parameter,
    RawType,
    Signal,
    Status,
    Unit,
    hall_map,
)

SPEC = Path(__file__).resolve().parents[2] / "protocol" / "SPEC.md"
HEADER = SPEC.with_name("c") / "hbp.h"
SCALES = {3.141592653589793 / 32768: "π/32768", 1 / 1024: "1/1024", 1 / 16384: "1/16384"}


def table(head: tuple[str, ...], rows: Iterable[tuple[object, ...]]) -> str:
    """Return a Markdown table."""
    lines = [head, ("---",) * len(head), *rows]
    return "".join("| " + " | ".join(str(cell) for cell in line) + " |\n" for line in lines)


def flags(value: Flag) -> str:
    own = Flag.CHANNEL | Flag.PARAMETER
    return ", ".join(str(flag.name) for flag in Flag if flag & value and not flag & own)


def channels(signals: tuple[Signal, ...]) -> str:
    return table(
        ("id", "name", "type", "unit", "scale", "flags", "meaning"),
        (
            (s.id, f"`{s.name}`", s.raw.name.lower(), s.unit.symbol or "–", SCALES.get(s.scale, f"{s.scale:g}"),
             flags(s.flags), s.about)
            for s in signals
        ),
    )  # fmt: skip


def parameters(items: tuple[Parameter, ...]) -> str:
    return table(
        ("id", "name", "unit", "from", "to", "flags", "meaning"),
        ((p.id, f"`{p.name}`", p.unit.symbol or "–", f"{p.lo:g}", f"{p.hi:g}", flags(p.flags), p.about) for p in items),
    )


def hall_inputs() -> str:
    """Return which input each sensor is on, and the map for straight inputs, by `hall_swap_hat`."""
    return table(
        ("`hall_swap_hat`", "sensor a is on input", "b on", "c on", "codes of the input words 0 to 7, none inverted"),
        (
            (int(swap), *("abc"[k] for k in INPUT_OF_SENSOR[swap]), " ".join(map(str, hall_map(swap, 0))))
            for swap in HallSwap
        ),
    )


def comments(kind: type) -> dict[str, str]:
    """Return the comment behind each member in the source."""
    source = Path(sys.modules[kind.__module__].__file__ or "").read_text(encoding="utf-8")
    body = source.split(f"class {kind.__name__}(", 1)[1].split("\nclass ", 1)[0]
    return dict(re.findall(r"^    (\w+) = [^#\n]+?  # (.*)$", body, re.MULTILINE))


def enum(kind: type[IntEnum] | type[IntFlag], meaning: str | None) -> str:
    notes = comments(kind)
    number = "0x{:02X}".format if issubclass(kind, codes.MessageType) else str
    members = [(number(int(m)), m.name) for m in kind]
    if meaning is None:
        return table(("value", "name"), members)
    return table(
        ("value", "name", meaning),
        [(*m, notes.get(str(m[1]), "").removeprefix("detail: ").removeprefix("arg: ")) for m in members],
    )


TABLES = {
    "drive channels": lambda: channels(DRIVE_CHANNELS),
    "load machine channels": lambda: channels(LOAD_CHANNELS),
    "drive parameters": lambda: parameters(DRIVE_PARAMETERS),
    "load machine parameters": lambda: parameters(LOAD_PARAMETERS),
    "units": lambda: table(("value", "name", "unit"), [(int(u), u.name, u.symbol or "–") for u in Unit]),
    "raw types": lambda: table(("value", "type"), [(int(t), t.name.lower()) for t in RawType]),
    "record flags": lambda: enum(Flag, "meaning"),
    "status bits": lambda: enum(Status, "meaning"),
    "angle sources": lambda: enum(AngleSource, None),
    "lessons": lambda: table(("value", "parameter"), ((k, f"`{name}`") for k, name in enumerate(LESSONS))),
    "injections": lambda: enum(Injection, None),
    "Hall inputs": hall_inputs,
    "Hall wires exchanged": lambda: enum(HallSwap, "meaning"),
    "states": lambda: enum(codes.DriveState, None),
    "faults": lambda: enum(codes.Fault, "meaning"),
    "commands": lambda: enum(codes.Command, None),
    "setpoint modes": lambda: enum(codes.SetpointMode, "meaning"),
    "stream events": lambda: enum(codes.StreamEvent, "meaning"),
    "roles": lambda: enum(codes.Role, None),
    "features": lambda: enum(codes.Feature, "meaning"),
    "error codes": lambda: enum(codes.ErrorCode, "`detail`"),
    "capture states": lambda: enum(codes.CaptureState, "meaning"),
    "capture triggers": lambda: enum(codes.CaptureTrigger, "what freezes it"),
    "test signals": lambda: enum(codes.TestSignal, "what it is added to"),
    "event codes": lambda: enum(codes.EventCode, "`arg`"),
}


def filled(text: str) -> str:
    """Return the text with its tables as they must be."""
    for name, make in TABLES.items():
        pattern = re.compile(rf"(<!-- {name} -->\n).*?(<!-- end -->)", re.DOTALL)
        assert len(pattern.findall(text)) == 1, f"no place for the table {name!r}"
        text = pattern.sub(lambda found, make=make: found[1] + "\n" + make() + "\n" + found[2], text)
    return text


C_ENUMS: dict[str, type[IntEnum] | type[IntFlag]] = {
    "TYPE": codes.MessageType,
    "ROLE": codes.Role,
    "FEATURE": codes.Feature,
    "STATE": codes.DriveState,
    "COMMAND": codes.Command,
    "FAULT": codes.Fault,
    "MODE": codes.SetpointMode,
    "STREAM": codes.StreamEvent,
    "EVENT": codes.EventCode,
    "TRIGGER": codes.CaptureTrigger,
    "CAPTURE": codes.CaptureState,
    "TEST": codes.TestSignal,
    "ERROR": codes.ErrorCode,
    "RAW": RawType,
    "UNIT": Unit,
    "FLAG": Flag,
}


def c_enum(word: str, kind: type[IntEnum] | type[IntFlag]) -> str:
    """Return `enum { HBP_WORD_NAME = 1, … };` with what the source says of each."""
    notes = comments(kind)
    number = "0x{:02X}".format if kind is codes.MessageType else str
    lines = []
    for member in kind:
        note = notes.get(str(member.name), "")
        text = f"    HBP_{word}_{member.name} = {number(int(member))},"
        lines.append(f"{text} /* {note} */" if note else text)
    return "enum {\n" + "\n".join(lines) + "\n};\n"


def c_filled(text: str) -> str:
    """Return the header with its numbers as they must be."""
    enums = "\n".join(c_enum(word, kind) for word, kind in C_ENUMS.items())
    pattern = re.compile(r"(/\* <codes> .*?\*/\n).*?(/\* </codes> \*/)", re.DOTALL)
    assert len(pattern.findall(text)) == 1
    return pattern.sub(lambda found: found[1] + enums + found[2], text)


if __name__ == "__main__":
    for path, made in ((SPEC, filled), (HEADER, c_filled)):
        path.write_text(made(path.read_text(encoding="utf-8")), encoding="utf-8")
        print(path)
