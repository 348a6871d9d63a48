"""Transfers beyond their vectors: identifiers of others, lengths of CAN FD frames, and what a host must not believe."""

from __future__ import annotations

import random

import numpy as np
import pytest
from can_rows import parts

from protocol.canmap.frame import BRS, CAN_RECORD, EXTENDED, FDF
from protocol.canmap.ids import CanClass, CanId, parse_id
from protocol.canmap.transport import CanCounters, Reassembler, TransferEncoder

TO_HOST = CanId(CanClass.TO_HOST, 3, 0)


def message(payload: bytes, type_: int = 0x11, tid: int = 0x1234, node: int = 3) -> bytes:
    header = bytes((type_, 0x11)) + tid.to_bytes(2, "little") + len(payload).to_bytes(2, "little")
    return header + bytes((node, 0)) + payload


def feed(receiver: Reassembler, frames: list[bytes]) -> list[bytes]:
    return [out for frame in frames if (out := receiver.feed(frame)) is not None]


@pytest.fixture
def counters() -> CanCounters:
    return CanCounters()


@pytest.fixture
def receiver(counters: CanCounters) -> Reassembler:
    return Reassembler(3, counters)


def test_identifiers_of_others_are_none() -> None:
    assert parse_id(0x7FF, False) is None  # class 7
    assert parse_id(0x114, True) is None  # a base identifier where extended ones are used
    assert parse_id(EXTENDED | 0x02421114, False) is None
    assert parse_id(EXTENDED | 0x02421114, True) == CanId(CanClass.STATUS, 1, 4)
    assert parse_id(EXTENDED | 0x02422114, True) is None  # another prefix
    assert parse_id(0x20000004, False) is None  # an error frame
    assert parse_id(0x40000114, False) is None  # a remote frame


def test_fd_frames_have_their_lengths_and_switch_the_rate() -> None:
    records = np.frombuffer(TransferEncoder(True, True).encode(TO_HOST, message(bytes(70))), CAN_RECORD)
    assert records["length"].tolist() == [64, 20]  # 63 + 17 of 76 + 4 bytes
    assert (records["flags"] == FDF | BRS).all()
    assert (records["id"] == EXTENDED | 0x02421330).all()
    ((_, one, _),) = parts(TransferEncoder(True, False).encode(TO_HOST, message(b"123456")))
    assert one == message(b"123456")[:6] + b"123456" + bytes(3) + b"\xe0"


def transfers(n: int) -> tuple[list[bytes], list[list[bytes]]]:
    """Messages and their frames, on one identifier."""
    encoder = TransferEncoder(False, False)
    rng = np.random.default_rng(1)
    messages = [message(rng.bytes(20 + k), tid=k + 1) for k in range(n)]
    return messages, [[data for _, data, _ in parts(encoder.encode(TO_HOST, each))] for each in messages]


def test_every_pair_of_lost_frames_never_makes_a_wrong_message() -> None:
    messages, frames = transfers(4)
    flat = [frame for each in frames for frame in each]
    for a in range(len(flat)):
        for b in range(a + 1, len(flat)):
            got = feed(Reassembler(3, CanCounters()), [f for at, f in enumerate(flat) if at not in (a, b)])
            assert set(got) <= set(messages)
            assert len(got) >= 2


def test_damage_is_found_by_the_crc(counters: CanCounters) -> None:
    _, (frames, *_) = transfers(1)
    rng = random.Random(1)
    for _ in range(200):
        damaged = [bytearray(frame) for frame in frames]
        frame = rng.randrange(len(damaged))
        damaged[frame][rng.randrange(len(damaged[frame]) - 1)] ^= 1 << rng.randrange(8)
        assert feed(Reassembler(3, counters), [bytes(each) for each in damaged]) == []
    assert counters.bad_crc + counters.bad_length == 200
    assert counters.bad_crc > 100


def test_an_endless_transfer_is_given_up(receiver: Reassembler, counters: CanCounters) -> None:
    toggle = 0x20
    receiver.feed(bytes(7) + b"\xa0")
    for n in range(1000):
        toggle ^= 0x20
        receiver.feed(n.to_bytes(7, "little") + bytes([toggle]))
    assert counters.aborted == 1
    assert len(receiver._body) < 1100


def test_a_length_that_lies(receiver: Reassembler, counters: CanCounters) -> None:
    for claimed in (0, 2, 200, 65535):
        frame = bytes.fromhex("11 11 34 12") + claimed.to_bytes(2, "little") + b"\x07" + b"\xe0"
        assert receiver.feed(frame) is None
    assert receiver.feed(b"") is None
    assert (counters.bad_length, counters.orphans) == (4, 1)
