"""Text from outside: what a terminal would obey, and what would read otherwise than it is, becomes visible."""

from __future__ import annotations

import struct
import sys
import unicodedata

import pytest

from protocol.descriptor import Descriptor
from protocol.messages import Log
from protocol.payload import text_from_wire
from protocol.signals import Flag, RawType
from protocol.text import printable

DANGEROUS = {"Cc", "Cf", "Cs", "Zl", "Zp"}  # controls, bidi and zero width, surrogates, line and paragraph ends


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("motor drive 3, 5 µs, Ω", "motor drive 3, 5 µs, Ω"),
        ("\x1b[2J\x1b]0;title\x07", r"\x1b[2J\x1b]0;title\x07"),
        ("a\r\nb\tc\x7f\x9b", r"a\r\nb\tc\x7f\x9b"),
        ("safe\u202efas\u2066\u200f\u061c", r"safe\u202efas\u2066\u200f\u061c"),
        ("a\u200bb\ufeffc\u2028d\u2029e\u0085", r"a\u200bb\ufeffc\u2028d\u2029e\x85"),
        ("\ud800\U000e0041", r"\ud800\U000e0041"),
        ("", ""),
    ],
)
def test_what_is_not_to_be_printed_is_escaped(text: str, shown: str) -> None:
    assert printable(text) == shown
    assert printable(shown) == shown


def test_nothing_dangerous_is_left() -> None:
    dangerous = (c for c in map(chr, range(sys.maxunicode + 1)) if unicodedata.category(c) in DANGEROUS)
    shown = printable("".join(dangerous))
    assert shown.isascii()
    assert shown.isprintable()


def test_names_and_log_lines_are_escaped_as_they_come_in() -> None:
    assert text_from_wire(b"a\x1b[2J\0junk") == r"a\x1b[2J"
    assert Log.unpack(b"\x06over\rwritten\0").text == r"over\rwritten\x00"
    record = struct.pack("<HBBHHff16s", 1, RawType.I16, 0, Flag.CHANNEL, 0, 1.0, 0.0, "i\u202e_a".encode())
    assert Descriptor.unpack(record).channel(r"i\u202e_a").id == 1
