"""slcan's text against lines written by hand, a scalar reading of the same rules, and python-can's own slcan."""

from __future__ import annotations

import os
import re
import select
import tty
from itertools import pairwise

import can
import numpy as np
import pytest
from can.interfaces.slcan import slcanBus
from can_rows import CLASSIC_MESSAGES, FD_MESSAGES, Records, record, record_of
from hypothesis import given
from hypothesis import strategies as st

from protocol.canmap.frame import BRS, CAN_RECORD, ERROR, ESI, EXTENDED, FD_LENGTHS, FDF, REMOTE
from protocol.canmap.slcan import BITRATES, DATA_BITRATES, MAX_LINE, MAX_REPLIES, SlcanParser, encode


def joined(records: list[Records]) -> Records:
    return np.concatenate([np.empty(0, CAN_RECORD), *records])


TABLE = [
    (b"t1002AA55\r", record(0x100, b"\xaa\x55")),
    (b"t0000\r", record(0)),
    (b"t7FF80123456789ABCDEF\r", record(0x7FF, bytes.fromhex("0123456789ABCDEF"))),
    (b"T000001234DEADBEEF\r", record(0x123 | EXTENDED, bytes.fromhex("DEADBEEF"))),
    (b"T1FFFFFFF0\r", record(0x1FFFFFFF | EXTENDED)),
    (b"r1003\r", record(0x100 | REMOTE, length=3)),
    (b"R000001008\r", record(0x100 | EXTENDED | REMOTE, length=8)),
    (b"d1232BEEF\r", record(0x123, b"\xbe\xef", FDF)),
    (b"D000001239" + b"00" * 11 + b"7F\r", record(0x123 | EXTENDED, bytes(11) + b"\x7f", FDF)),
    (b"b123F" + b"C3" * 64 + b"\r", record(0x123, b"\xc3" * 64, FDF | BRS)),
    (b"B1ABCDEF0E" + b"5A" * 48 + b"\r", record(0x1ABCDEF0 | EXTENDED, b"\x5a" * 48, FDF | BRS)),
]
IDS = [line[:12].decode().strip() for line, _ in TABLE]


@pytest.mark.parametrize(("line", "frame"), TABLE, ids=IDS)
def test_lines_by_hand(line: bytes, frame: Records) -> None:
    assert encode(frame) == line
    parser = SlcanParser()
    assert parser.feed(line, 12.5).tobytes() == with_time(frame, 12.5).tobytes()
    assert parser.feed(line[:1] + line[1:].lower(), 0.0).tobytes() == frame.tobytes()
    assert (parser.malformed, parser.replies) == (0, [])
    stamped = line[:-1] + b"EA5F\r"  # 59.999 s
    assert encode(with_time(frame, 179.9995), stamped=True) == stamped
    assert SlcanParser().feed(stamped, 0.0).tobytes() == frame.tobytes()  # read past


def with_time(records: Records, time: float) -> Records:
    timed = records.copy()
    timed["time"] = time
    return timed


def test_error_passive_bit_has_no_place() -> None:
    assert encode(record(1, b"", FDF | ESI)) == b"d0010\r"


@pytest.mark.parametrize(
    ("frame", "names"),
    [
        (record(ERROR | 4, bytes(8)), "0x20000004"),
        (record(0x800), "0x00000800"),
        (record(1, bytes(12)), "length 12"),
        (record(1, bytes(9), FDF), "length 9"),
        (record(1 | REMOTE, b"", FDF), "flags 4"),
        (record(1, b"", BRS), "flags 1"),
        (joined([record(1), record(2), record(0x7FFF)]), "0x00007FFF"),
    ],
)
def test_frames_that_slcan_cannot_write(frame: Records, names: str) -> None:
    with pytest.raises(ValueError, match=f"slcan has no line for a frame with .*{names}"):
        encode(frame)


DAMAGED = [
    *b"t1002AA5 t1002AA55AA t1002AA t1002AA5G t1G02AA55 t10 t100 t tt1002AA55 x1002AA55 zz".split(),
    *(b"t1002 A55", b"t1002AA5\x00", b"t1002AA5\xff", b"z\x00", b"\x80\x81", b"\n", b"V\x00"),
    *b"t8000 tFFF0 T200000000 T0000012 R0000010".split(),  # 12 bits, 30 bits, too few digits
    *(b"t1009" + b"00" * 8, b"t100900" + b"00" * 8, b"r1009", b"r1001AA"),  # classic DLC above 8, a remote frame's data
    *(b"d1239" + b"00" * 9, b"b123F" + b"00" * 63, b"b123F" + b"00" * 65, b"b123F" + b"00" * 67),  # lengths of CAN FD
    b"B000001230" + b"0" * 400,
]


@pytest.mark.parametrize("line", DAMAGED, ids=lambda line: line[:14])
def test_damaged_lines_are_counted_and_are_no_frames(line: bytes) -> None:
    parser = SlcanParser()
    frames = parser.feed(b"t0010\r" + line + b"\rt0020\r", 0.0)
    assert frames["id"].tolist() == [1, 2]
    assert parser.malformed == 1
    assert parser.replies == []


def test_lines_that_are_no_frames_are_put_aside_with_their_place() -> None:
    parser = SlcanParser()
    frames = parser.feed(b"\rz\rt0010\rZ\r\aV1013\rt0020\rt0030\rNA123\rF00\rO\rS8\rs0014\rCANable 2.0\r", 0.0)
    assert frames["id"].tolist() == [1, 2, 3]
    early = [(b"", 0), (b"z", 0), (b"Z", 1), (b"\a", 1), (b"V1013", 1)]
    late = [(text, 3) for text in (b"NA123", b"F00", b"O", b"S8", b"s0014", b"CANable 2.0")]
    assert parser.replies == early + late
    assert parser.malformed == 0


def test_replies_are_bounded_and_the_rest_counted() -> None:
    parser = SlcanParser()
    parser.feed(b"\r" * (MAX_REPLIES + 7), 0.0)
    assert len(parser.replies) == MAX_REPLIES
    assert parser.replies_dropped == 7


def test_a_run_without_an_end_is_dropped_and_counted_once() -> None:
    parser = SlcanParser()
    parser.feed(b"t" * MAX_LINE, 0.0)
    assert parser.malformed == 0
    for _ in range(50):
        assert len(parser.feed(b"t001" * 1000, 0.0)) == 0
        assert parser.malformed == 1
        assert len(parser._rest) <= MAX_LINE + 1  # it takes no memory
    assert parser.feed(b"t0010\rt0020\r", 0.0)["id"].tolist() == [2]  # the first is still a part of the run
    assert parser.malformed == 1


def test_time_is_that_of_the_end_of_the_line() -> None:
    parser = SlcanParser()
    assert parser.feed(b"t0010\rt00", 1.0)["time"].tolist() == [1.0]
    assert parser.feed(b"20\r", 2.0)["time"].tolist() == [2.0]


@st.composite
def frames(draw: st.DrawFn) -> Records:
    extended, kind = draw(st.booleans()), draw(st.sampled_from(["data", "remote", "fd", "brs"]))
    number = draw(st.integers(0, 0x1FFFFFFF if extended else 0x7FF)) | (EXTENDED if extended else 0)
    if kind == "remote":
        return record(number | REMOTE, length=draw(st.integers(0, 8)))
    flags = {"data": 0, "fd": FDF, "brs": FDF | BRS}[kind]
    length = draw(st.sampled_from(FD_LENGTHS if flags else range(9)))
    return record(number, draw(st.binary(min_size=length, max_size=length)), flags)


def text_of(frame: Records) -> bytes:
    """One frame's line in plain Python."""
    number, flags = int(frame["id"][0]), int(frame["flags"][0])
    length = int(frame["length"][0])
    letter = {0: "t", FDF: "d", FDF | BRS: "b"}[flags] if not number & REMOTE else "r"
    head = f"{letter.upper()}{number & 0x1FFFFFFF:08X}" if number & EXTENDED else f"{letter}{number & 0x7FF:03X}"
    data = "" if number & REMOTE else frame["data"][0, :length].tobytes().hex().upper()
    return f"{head}{can.util.len2dlc(length):X}{data}\r".encode()


@given(st.lists(frames(), max_size=30), st.lists(st.integers(0, 3000), max_size=8))
def test_round_trip_with_cuts_anywhere(sent: list[Records], cuts: list[int]) -> None:
    text = encode(joined(sent))
    assert text == b"".join(text_of(frame) for frame in sent)
    parser = SlcanParser()
    places = [0, *sorted(min(cut, len(text)) for cut in cuts), len(text)]
    pieces = [parser.feed(text[a:b], 0.0) for a, b in pairwise(places)]
    assert joined(pieces).tobytes() == joined(sent).tobytes()
    assert parser.malformed == 0


_LINE = re.compile(
    rb"(?:([tdb])([0-7][0-9a-fA-F]{2})|([TDB])([01][0-9a-fA-F]{7}))([0-9a-fA-F])((?:[0-9a-fA-F]{2})*)"
    rb"|(?:(r)([0-7][0-9a-fA-F]{2})|(R)([01][0-9a-fA-F]{7}))([0-8])((?:[0-9a-fA-F]{4})?)"
)


def is_frame(line: bytes) -> bool:
    """The rules of a frame's line, one line at a time."""
    found = _LINE.fullmatch(line)
    if not found:
        return False
    if found[7] or found[9]:
        return True
    dlc, size = int(found[5], 16), len(found[6]) // 2
    if (found[1] or found[3]) in (b"t", b"T") and dlc > 8:
        return False
    return size in (FD_LENGTHS[dlc], FD_LENGTHS[dlc] + 2)


def is_reply(line: bytes) -> bool:
    return line in (b"", b"z") or (line[:1] == b"F" and line.isascii())


HEADS = [b"t100", b"T00000100", b"r100", b"R10000000", b"d1FF", b"B0000ABC", b"t8FF", b"D20000000", b"F", b"z", b""]
LINES = st.tuples(
    st.sampled_from(HEADS),
    st.sampled_from([b"0", b"1", b"2", b"3", b"9", b""]),
    st.sampled_from(
        [b"", b"aA", b"5555", b"012345", b"ABCDEF01", b"0" * 10, b"0" * 24, b"0" * 28, b"0", b"GG", b"\xff"]
    ),
    st.sampled_from([b"\r", b"\r", b"\r", b"\a"]),
).map(b"".join)


@given(st.lists(LINES, max_size=60).map(b"".join), st.integers(0, 600))
def test_rubbish_is_read_as_the_rules_say(text: bytes, cut: int) -> None:
    parser = SlcanParser()
    count = sum(len(parser.feed(piece, 0.0)) for piece in (text[:cut], text[cut:]))
    lines = re.findall(rb"([^\r\a]*)([\r\a])", text)
    ended = [line for line, end in lines if end == b"\r"]
    belled = [line for line, end in lines if end == b"\a"]
    assert count == sum(map(is_frame, ended))
    assert [reply.text for reply in parser.replies] == [
        b"\a" if end == b"\a" else line for line, end in lines if end == b"\a" or is_reply(line)
    ]
    assert parser.malformed == sum(map(bool, belled)) + sum(not is_frame(x) and not is_reply(x) for x in ended)


def test_bit_rates_are_those_of_python_can() -> None:
    assert {rate: command.decode() for rate, command in BITRATES.items()} == slcanBus._BITRATES
    theirs = {rate: command for rate, command in slcanBus._DATA_BITRATES.items() if rate}
    ours = {rate: command.decode() for rate, command in DATA_BITRATES.items()}
    assert ours == theirs | {8_000_000: "Y8"}


def test_python_can_reads_what_we_write_and_we_read_what_it_writes() -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    bus, parser = slcanBus(os.ttyname(slave), sleep_after_open=0), SlcanParser()
    assert os.read(master, 100) == b"O\r"
    for msg in CLASSIC_MESSAGES + FD_MESSAGES:
        os.write(master, encode(record_of(msg)))
        got = bus.recv(5.0)
        assert got.equals(msg, timestamp_delta=None), f"{got} is not {msg}"
        bus.send(msg)
        frame = np.empty(0, CAN_RECORD)
        while not len(frame) and select.select([master], [], [], 5.0)[0]:
            frame = parser.feed(os.read(master, 65536), 0.0)
        assert frame.tobytes() == record_of(msg).tobytes(), str(msg)
    assert parser.malformed == 0
    bus.shutdown()
    os.close(slave)
    os.close(master)
