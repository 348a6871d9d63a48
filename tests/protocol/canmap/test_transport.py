"""Transfers by hand: frames written out from SPEC.md, chapter 16, and everything that can happen to them."""

from __future__ import annotations

import random
from zlib import crc32

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.canmap.frame import BRS, CAN_RECORD, EXTENDED, FD_LENGTHS, FDF
from protocol.canmap.ids import CanClass, CanId, parse_id, stream_id
from protocol.canmap.transport import CanCounters, Reassembler, TransferEncoder
from protocol.framing import Frame

TO_HOST = CanId(CanClass.TO_HOST, 3, 0)


def message(payload: bytes, type_: int = 0x11, tid: int = 0x1234, node: int = 3) -> bytes:
    header = bytes((type_, 0x11)) + tid.to_bytes(2, "little") + len(payload).to_bytes(2, "little")
    return header + bytes((node, 0)) + payload


def data_of(records: bytes) -> list[bytes]:
    return [r["data"][: r["length"]].tobytes() for r in np.frombuffer(records, CAN_RECORD)]


def feed(receiver: Reassembler, frames: list[bytes]) -> list[bytes]:
    return [out for frame in frames if (out := receiver.feed(frame)) is not None]


@pytest.fixture
def counters() -> CanCounters:
    return CanCounters()


@pytest.fixture
def receiver(counters: CanCounters) -> Reassembler:
    return Reassembler(3, counters)


# -- identifiers ------------------------------------------------------------------------------------------------------


def test_identifiers_by_hand() -> None:
    assert CanId(CanClass.STOP, 0, 0).pack(False) == 0x000
    assert CanId(CanClass.STATUS, 1, 4).pack(False) == 0x114
    assert CanId(CanClass.TO_DEVICE, 15, 2).pack(False) == 0x2F2
    assert CanId(CanClass.EDGES, 2, 15).pack(True) == EXTENDED | 0x0242142F
    assert stream_id(1, 3).pack(False) == 0x513
    assert stream_id(1, 19).pack(False) == 0x613


def test_identifiers_of_others_are_none() -> None:
    assert parse_id(0x7FF, False) is None  # class 7
    assert parse_id(0x114, True) is None  # a base identifier where extended ones are used
    assert parse_id(EXTENDED | 0x02421114, False) is None
    assert parse_id(EXTENDED | 0x02421114, True) == CanId(CanClass.STATUS, 1, 4)
    assert parse_id(EXTENDED | 0x02422114, True) is None  # another prefix
    assert parse_id(0x20000004, False) is None  # an error frame
    assert parse_id(0x40000114, False) is None  # a remote frame


# -- encoding, by hand ------------------------------------------------------------------------------------------------


def test_a_message_that_fits_is_one_classic_frame() -> None:
    assert data_of(TransferEncoder(False, False).encode(TO_HOST, message(b"\x07"))) == [
        bytes.fromhex("11 11 34 12 01 00 07 E0")
    ]


def test_longer_ones_are_cut_with_toggle_and_crc() -> None:
    encoder = TransferEncoder(False, False)
    encoder.encode(TO_HOST, message(b""))
    payload = bytes(range(0x20, 0x2A))
    crc = crc32(message(payload)).to_bytes(4, "little")
    frames = data_of(encoder.encode(TO_HOST, message(payload)))
    assert (
        frames
        == [
            bytes.fromhex("11 11 34 12 0A 00 20 A1"),  # start, toggle 1, transfer id 1
            payload[1:8] + b"\x01",
            payload[8:] + crc + b"\x61",
        ]
    )


def test_fd_frames_have_their_lengths_and_switch_the_rate() -> None:
    records = np.frombuffer(TransferEncoder(True, True).encode(TO_HOST, message(bytes(70))), CAN_RECORD)
    assert records["length"].tolist() == [64, 20]  # 63 + 17 of 76 + 4 bytes
    assert (records["flags"] == FDF | BRS).all()
    assert (records["id"] == EXTENDED | 0x02421330).all()
    one = np.frombuffer(TransferEncoder(True, False).encode(TO_HOST, message(b"123456")), CAN_RECORD)[0]
    assert one["length"] == 16
    assert one["data"][:16].tobytes() == message(b"123456")[:6] + b"123456" + bytes(3) + b"\xe0"


def test_transfer_ids_count_for_each_identifier() -> None:
    encoder = TransferEncoder(False, False)
    tails = [data_of(encoder.encode(TO_HOST, message(b"")))[0][-1] for _ in range(33)]
    assert tails == [0xE0 | n for n in [*range(32), 0]]
    assert data_of(encoder.encode(CanId(CanClass.TO_HOST, 4, 0), message(b"")))[0][-1] == 0xE0


# -- decoding ---------------------------------------------------------------------------------------------------------


@given(st.binary(max_size=1024), st.booleans(), st.integers(0, 255))
def test_round_trip(payload: bytes, fd: bool, type_: int) -> None:
    counters = CanCounters()
    frames = data_of(TransferEncoder(fd, False).encode(TO_HOST, message(payload, type_)))
    assert all(len(frame) in FD_LENGTHS[: 16 if fd else 9] for frame in frames)
    assert feed(Reassembler(3, counters), frames) == [message(payload, type_)]
    assert counters == CanCounters(transfers=1)


def transfers(n: int = 6, fd: bool = False) -> tuple[list[bytes], list[list[bytes]]]:
    """Messages and their frames, on one identifier."""
    encoder = TransferEncoder(fd, False)
    rng = np.random.default_rng(1)
    messages = [message(rng.bytes(20 + 100 * fd + k), tid=k + 1) for k in range(n)]
    return messages, [data_of(encoder.encode(TO_HOST, each)) for each in messages]


def test_every_single_lost_frame_costs_its_transfer_only(counters: CanCounters) -> None:
    messages, frames = transfers()
    flat = [(k, frame) for k, each in enumerate(frames) for frame in each]
    for lost in range(len(flat)):
        counters = CanCounters()
        got = feed(Reassembler(3, counters), [frame for at, (_, frame) in enumerate(flat) if at != lost])
        assert got == [each for k, each in enumerate(messages) if k != flat[lost][0]], lost
        last = lost == len(flat) - 1  # nothing tells that the last frame is missing
        assert counters.aborted + counters.orphans + counters.bad_crc + counters.bad_length >= (0 if last else 1)


def test_every_pair_of_lost_frames_never_makes_a_wrong_message() -> None:
    messages, frames = transfers(4)
    flat = [frame for each in frames for frame in each]
    for a in range(len(flat)):
        for b in range(a + 1, len(flat)):
            got = feed(Reassembler(3, CanCounters()), [f for at, f in enumerate(flat) if at not in (a, b)])
            assert set(got) <= set(messages)
            assert len(got) >= 2


@pytest.mark.parametrize("fd", [False, True])
def test_every_frame_doubled_changes_nothing_and_is_counted(fd: bool, counters: CanCounters) -> None:
    messages, frames = transfers(fd=fd)
    doubled = [frame for each in frames for frame in each for _ in range(2)]
    assert feed(Reassembler(3, counters), doubled) == messages
    assert counters.duplicates == len(doubled) // 2


def test_a_new_start_ends_what_is_under_way(receiver: Reassembler, counters: CanCounters) -> None:
    messages, frames = transfers(2)
    assert feed(receiver, frames[0][:-1] + frames[1]) == messages[1:]
    assert counters.aborted == 1


def test_toggle_error_and_stray_frames(receiver: Reassembler, counters: CanCounters) -> None:
    _, (frames, *_) = transfers(1)
    wrong = frames[1][:-1] + bytes([frames[1][-1] ^ 0x20])
    assert feed(receiver, [frames[0], wrong, *frames[2:]]) == []
    assert (counters.aborted, counters.orphans) == (1, len(frames) - 2)
    assert receiver.feed(b"") is None
    assert receiver.feed(bytes(7) + b"\x80") is None  # a start with toggle 0
    assert counters.orphans == len(frames)


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
    assert counters.bad_length == 4


@given(st.lists(st.binary(max_size=64), max_size=60))
def test_random_frames_never_raise_and_hardly_ever_pass(frames: list[bytes]) -> None:
    counters = CanCounters()
    for out in feed(Reassembler(3, counters), frames):
        assert len(out) == 8 + int.from_bytes(out[4:6], "little")
    assert counters.transfers <= len(frames)


def test_interleaved_identifiers_do_not_disturb_each_other() -> None:
    encoder = TransferEncoder(False, False)
    rng = random.Random(3)
    ids = [CanId(CanClass.TO_HOST, node, slot) for node in (1, 2) for slot in (0, 1)]
    messages = {i: [message(rng.randbytes(rng.randrange(60)), node=i.node) for _ in range(20)] for i in ids}
    queues = {i: [f for m in messages[i] for f in data_of(encoder.encode(i, m))] for i in ids}
    receivers = {i: Reassembler(i.node, CanCounters()) for i in ids}
    got: dict[CanId, list[bytes]] = {i: [] for i in ids}
    while any(queues.values()):
        i = rng.choice([i for i in ids if queues[i]])
        if (out := receivers[i].feed(queues[i].pop(0))) is not None:
            got[i].append(out)
    assert got == messages


def test_frame_pack_is_the_message_that_a_transfer_carries() -> None:
    assert Frame(0x11, 0x11, 0x1234, 3, b"abc").pack() == message(b"abc")
