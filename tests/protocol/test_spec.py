"""SPEC.md agrees with the code: generated tables are current; the vectors hold the tables of messages."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Iterator

import hbp_reference as reference
import make_spec
import pytest

from protocol import messages
from protocol.framing import Frame, encode_frame
from protocol.messages import Hello, MessageType, Payload
from protocol.requirements import requirements
from protocol.streams import EDGE_RECORD, STREAM_HEADER
from protocol.validity import RECORD_BYTES

TEXT = make_spec.SPEC.read_text(encoding="utf-8")
MESSAGES = make_spec.SPEC.with_name("vectors") / "messages.json"
HEADER_NAMES = ["stream", "flags", "n", "cfg_id", "seq", "index", "tick"]  # of STREAM_HEADER
RECORD = struct.Struct("<HBBHHff16s")  # of the descriptor
RECORD_NAMES = ["id", "type", "unit", "flags", "reserved", "scale", "offset", "name"]
CODES = {"B": "u8", "H": "u16", "I": "u32", "Q": "u64", "f": "f32", "16s": "text16", "24s": "text24"}


def test_generated_tables_are_current() -> None:
    assert make_spec.filled(TEXT) == TEXT
    header = make_spec.HEADER.read_text(encoding="utf-8")
    assert make_spec.c_filled(header) == header


def test_requirements_are_numbered_and_say_must_should_or_may() -> None:
    found = requirements()
    assert len(found) == len(re.findall(r"\[\d+\.\d+\s+[DH]+\]", TEXT))
    numbers: dict[int, list[int]] = {}
    for number, each in found.items():
        chapter, count = map(int, number.split("."))
        numbers.setdefault(chapter, []).append(count)
        heading = TEXT[: TEXT.index(f"[{number} ")].rpartition("\n## ")[2].partition(".")[0]
        assert chapter == (int(heading) if heading.isdigit() else 0), number
        row = TEXT.partition(f"[{number} ")[0].endswith("| ")
        assert row or re.search(r"\b(must|should|may)\b", each.text), number
        assert not re.search(r"\bshall\b", each.text), number
    for chapter, counts in numbers.items():
        assert sorted(counts) == list(range(1, len(counts) + 1)), chapter


def walk(layout: struct.Struct) -> Iterator[tuple[int, str]]:
    """Yield offset and code of each field and padding of a struct."""
    offset = 0
    for count, code in re.findall(r"(\d*)([a-zA-Z])", layout.format):
        for unit in [count + code] if code in "sx" else [code] * int(count or 1):
            yield offset, unit
            offset += struct.calcsize("<" + unit)


def rows_of(layout: struct.Struct, names: list[str]) -> list[list[str]]:
    """Return [offset, type, name] of each field and padding of a struct."""
    left = iter(names)
    return [
        [str(at), f"pad {unit[:-1] or 1}", ""] if unit.endswith("x") else [str(at), CODES[unit], next(left)]
        for at, unit in walk(layout)
    ]


def table_after(mark: str) -> list[list[str]]:
    """Return off, type and field of each row of the byte table of SPEC.md that follows a mark."""
    assert TEXT.count(mark) == 1, mark
    table = TEXT.split(mark, 1)[1].split("| off ", 1)[1].split("\n\n", 1)[0]
    return [[cell.strip() for cell in line.strip("|").split("|")][:3] for line in table.splitlines()[2:]]


def laid_out(message: str, values: dict) -> bytes:
    """Return a message's bytes as its table has them."""
    out, left = b"", set(values)
    mark = "`ErrorReply`, with the flags" if message == "ErrorReply" else f"`{message}`\n\n"
    for offset, kind, name in table_after(mark):
        assert int(offset) == len(out)
        value = values.get(name)
        if kind.startswith("pad"):
            out += bytes(int(kind[4:]))
        elif kind:
            out += reference.fields((kind, len(value) if isinstance(value, list) else value))
        elif name == "u16 each":
            out += reference.fields(*(("u16", number) for number in values["channels"]))
        else:
            out += bytes.fromhex(value) if name == "data" else value.encode()
        left.discard(name)
    assert not left
    return out


@pytest.mark.parametrize("case", json.loads(MESSAGES.read_text(encoding="utf-8")), ids=lambda case: case["name"])
def test_vectors_of_messages_are_as_the_tables_say(case: dict) -> None:
    payload = laid_out(case["name"], case["fields"]) if case["fields"] else b""
    assert bytes.fromhex(case["body_hex"])[8:] == payload


KINDS = sorted(
    {*messages.REQUESTS.values(), *messages.REPLIES.values(), *messages.UNSOLICITED.values(), messages.ErrorReply},
    key=lambda kind: kind.__name__,
)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if not kind._LAYOUT.size], ids=lambda kind: kind.__name__)
def test_empty_messages_are_said_to_be_empty(kind: type[Payload]) -> None:
    assert f"`{kind.__name__}`" in TEXT


def test_every_type_has_its_chapter() -> None:
    for kind in MessageType:
        assert re.search(rf"^### .*\b{int(kind):02x} {kind.name}\b", TEXT, re.MULTILINE | re.IGNORECASE), kind


def test_stream_header_edge_and_descriptor_record() -> None:
    assert table_after("DATA and EDGES begin with the same 16 bytes") == rows_of(STREAM_HEADER, HEADER_NAMES)
    assert EDGE_RECORD.names is not None
    assert table_after("A record of EDGES is") == rows_of(struct.Struct("<IBBH"), list(EDGE_RECORD.names))
    assert EDGE_RECORD.itemsize == 8
    assert table_after("Blob 0 is an array of 32-byte records") == rows_of(RECORD, RECORD_NAMES)
    assert RECORD.size == RECORD_BYTES


def test_the_printed_frame() -> None:
    assert encode_frame(Frame(1, 1, 1, 0, Hello(0x12345678).pack())).hex(" ") in TEXT


def test_hall_codes_of_neighbours_differ_in_one_sensor() -> None:
    rows = re.findall(r"^\| (\d) \| [IV]+ \| [^|]+\| (\d) (\d) (\d) \| (\d) \|$", TEXT, re.MULTILINE)
    codes = [int(row[4]) for row in rows]
    assert [int(row[0]) for row in rows] == list(range(6))
    assert all(int("".join(row[1:4]), 2) == int(row[4]) for row in rows)
    assert sorted(codes) == [1, 2, 3, 4, 5, 6]
    assert all((a ^ b).bit_count() == 1 for a, b in zip(codes, codes[1:] + codes[:1], strict=True))
