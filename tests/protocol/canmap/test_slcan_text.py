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


@given(st.lists(frames(), max_size=30), st.lists(st.integers(0, 3000), max_size=8), st.integers(0, 200_000))
def test_round_trip_with_cuts_anywhere(sent: list[Records], cuts: list[int], ms: int) -> None:
    records = joined(sent)
    lines = [text_of(frame) for frame in sent]
    text = encode(records)
    assert text == b"".join(lines)
    parser = SlcanParser()
    places = [0, *sorted(min(cut, len(text)) for cut in cuts), len(text)]
    pieces = [parser.feed(text[a:b], 0.0) for a, b in pairwise(places)]
    assert joined(pieces).tobytes() == records.tobytes()
    stamped = encode(with_time(records, ms / 1000 + 0.0005), stamped=True)  # in ms of the minute
    assert stamped == b"".join(line[:-1] + b"%04X\r" % (ms % 60_000) for line in lines)
    lower = b"".join(line[:1] + line[1:].lower() for line in lines)
    for other in (stamped, lower):  # the stamps are read past
        assert parser.feed(other, 12.5).tobytes() == with_time(records, 12.5).tobytes()
    assert (parser.malformed, parser.replies) == (0, [])


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
    return re.fullmatch(b"z?|F[ -~]*", line) is not None


HEADS = b"t100 T00000100 r100 R10000000 d1FF b1FF B0000ABC t8FF T20000000 D20000000 t1G0 t10 t F z zz".split()
DATA = [b"", b"aA", b"5555", b"012345", b"ABCDEF01", *(b"0" * n for n in (1, 10, 24, 28, 126, 128, 400))]
LINES = st.tuples(
    st.sampled_from([*HEADS, b"", b"\x80", b"t\x00", b"\n"]),
    st.sampled_from([b"0", b"1", b"2", b"3", b"9", b"F", b""]),
    st.sampled_from([*DATA, b"GG", b"5 55", b"\x00", b"\xff"]),
    st.sampled_from([b"\r", b"\r", b"\r", b"\a"]),
).map(b"".join)


@given(st.lists(LINES, max_size=60).map(b"".join), st.integers(0, 600))
def test_rubbish_is_read_as_the_rules_say(text: bytes, cut: int) -> None:
    parser = SlcanParser()
    count = sum(len(parser.feed(piece, 0.0)) for piece in (text[:cut], text[cut:]))
    lines = re.findall(rb"([^\r\n\a]*)(\r\n|[\r\n\a])", text)
    lines = [(line, end if end == b"\a" else b"\r") for line, end in lines]
    ended = [line for line, end in lines if end == b"\r"]
    belled = [line for line, end in lines if end == b"\a"]
    assert count == sum(map(is_frame, ended))
    assert [reply.text for reply in parser.replies] == [
        b"\a" if end == b"\a" else line for line, end in lines if end == b"\a" or is_reply(line)
    ]
    assert parser.malformed == sum(map(bool, belled)) + sum(not is_frame(x) and not is_reply(x) for x in ended)


@given(st.lists(frames(), max_size=12), st.sampled_from([b"\r\n", b"\n"]), st.integers(1, 40))
def test_lines_may_end_as_println_ends_them(sent: list[Records], end: bytes, step: int) -> None:
    """However the bytes are cut: a carriage return and its line feed may come apart. An empty line is one answer."""
    parser = SlcanParser()
    text = b"".join(text_of(frame)[:-1] + end + end for frame in sent)
    pieces = [parser.feed(text[k : k + step], 0.0) for k in range(0, len(text), step)]
    assert joined(pieces).tobytes() == joined(sent).tobytes()
    assert [reply.text for reply in parser.replies] == [b""] * len(sent)
    assert parser.malformed == 0


def test_the_first_line_that_cannot_be_read_is_kept() -> None:
    parser = SlcanParser()
    parser.feed(b"t0010\rReady: CAN at 500k\r\nt00X0\rdone\r", 0.0)
    assert (parser.malformed, parser.strange) == (3, b"Ready: CAN at 500k")
    other = SlcanParser()
    other.feed(b"t00X0\r", 0.0)
    assert other.strange == b"t00X0"


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
