"""The exact length of CAN frames, against a frame written out as a string of bits, and against published figures."""

from __future__ import annotations

import numpy as np
import pytest
from can_rows import record
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.canmap.frame import BRS, CAN_RECORD, ESI, EXTENDED, FD_LENGTHS, FDF, REMOTE, BusRates
from sim.ports.can_bits import count_bits, frame_bits, frame_seconds

CLASSIC = BusRates(1_000_000)
FD = BusRates(1_000_000, 5_000_000)


def bits_of(row: np.ndarray) -> tuple[int, int]:
    nominal, fast = count_bits(row)[0].tolist()
    return nominal, fast


# The oracle: ISO 11898-1:2015 as strings of "0" and "1".


def crc_15(bits: str) -> str:
    """Remainder of the bits as a polynomial, by long division in whole numbers."""
    divisor = 0b1100010110011001  # x15 + x14 + x10 + x8 + x7 + x4 + x3 + 1
    rest = int(bits, 2) << 15
    while rest.bit_length() > 15:
        rest ^= divisor << (rest.bit_length() - 16)
    return f"{rest:015b}"


def stuff(bits: str) -> str:
    sent = ""
    for bit in bits:
        sent += bit
        if sent.endswith("00000"):
            sent += "1"
        elif sent.endswith("11111"):
            sent += "0"
    return sent


def written_out(row: np.ndarray) -> tuple[int, int]:
    can_id, length, flags = int(row["id"][0]), int(row["length"][0]), int(row["flags"][0])
    data = "".join(f"{byte:08b}" for byte in row["data"][0, :length].tolist())
    remote = "1" if can_id & REMOTE else "0"
    end = "1" + "0" + "1" + "1" * 7 + "111"  # CRC delimiter, ACK, ACK delimiter, end of frame, interframe space
    if can_id & EXTENDED:
        identifier = f"{can_id & 0x1FFFFFFF:029b}"
        head = "0" + identifier[:11] + "11" + identifier[11:] + remote
    else:
        head = "0" + f"{can_id & 0x7FF:011b}" + remote + "0"
    if not flags & FDF:
        body = head + ("00" if can_id & EXTENDED else "0") + f"{length:04b}" + ("" if remote == "1" else data)
        return len(stuff(body + crc_15(body)) + end), 0
    to_brs = head + "10" + ("1" if flags & BRS else "0")
    body = to_brs + ("1" if flags & ESI else "0") + f"{FD_LENGTHS.index(length):04b}" + data
    dynamic = stuff(body[:-1]) + body[-1]  # behind the last bit there is a fixed stuff bit instead
    crc_field = "s" * 4 + "c" * (17 if length <= 16 else 21)
    fixed = "".join("|" + crc_field[k : k + 4] for k in range(0, len(crc_field), 4))
    total = len(dynamic + fixed + end)
    if not flags & BRS:
        return total, 0
    slow = len(stuff(to_brs) + end)
    return slow, total - slow


def test_the_oracle_has_the_published_crc() -> None:
    # CRC-15/CAN in the catalogue of parametrised CRC algorithms: check value of "123456789"
    assert crc_15("".join(f"{byte:08b}" for byte in b"123456789")) == f"{0x059E:015b}"


# Data whose runs of equal bits touch and cross the limit, beside any bytes.
runs = st.lists(st.sampled_from([0x00, 0xFF, 0x0F, 0xF0, 0x1E, 0xE1, 0x3C, 0xC3, 0x78, 0x87, 0xF8, 0x07]), min_size=64)
payloads = st.one_of(st.binary(min_size=64, max_size=64), runs.map(lambda each: bytes(each[:64])))
base_ids = st.one_of(st.integers(0, 0x7FF), st.sampled_from([0, 0x7FF, 0x078, 0x41E, 0x787]))
extended_ids = st.one_of(st.integers(0, 0x1FFFFFFF), st.sampled_from([0, 0x1FFFFFFF, 0x01E1F0F0, 0x1E1F0F0F]))
ids = st.one_of(base_ids, extended_ids.map(lambda each: each | EXTENDED))


@st.composite
def frames(draw: st.DrawFn) -> np.ndarray:
    can_id, data = draw(ids), draw(payloads)
    if draw(st.booleans()):
        flags = FDF | draw(st.sampled_from([0, BRS, ESI, BRS | ESI]))
        return record(can_id, data[: draw(st.sampled_from(FD_LENGTHS))], flags)
    if draw(st.booleans()):
        return record(can_id, data[: draw(st.integers(0, 8))])
    return record(can_id | REMOTE, length=draw(st.integers(0, 8)))


@settings(deadline=None)
@given(frames())
def test_bits_are_those_of_the_frame_written_out_and_no_more_than_the_worst_case(row: np.ndarray) -> None:
    can_id, length, flags = int(row["id"][0]), int(row["length"][0]), int(row["flags"][0])
    nominal, fast = frame_bits(row.tobytes())
    assert bits_of(row) == written_out(row) == (nominal, fast)
    assert frame_seconds(row, FD)[0] == pytest.approx(nominal / 1e6 + fast / 5e6)
    rates = FD if flags & BRS else CLASSIC
    extended, fd = bool(can_id & EXTENDED), bool(flags & FDF)
    worst = rates.seconds(0 if can_id & REMOTE else length, extended=extended, fd=fd, worst=True)
    assert frame_seconds(row, FD)[0] <= worst * (1.0 + 1e-12)


@pytest.mark.parametrize("extended", [0, EXTENDED])
@pytest.mark.parametrize(
    ("rates", "flags", "length"), [(CLASSIC, 0, 8), (FD, FDF | BRS, 8), (FD, FDF | BRS, 24), (FD, FDF | BRS, 64)]
)
def test_random_frames_take_the_average_time(extended: int, rates: BusRates, flags: int, length: int) -> None:
    rng = np.random.default_rng(3)
    rows = np.zeros(3000, CAN_RECORD)
    rows["id"] = rng.integers(0, 0x20000000 if extended else 0x800, len(rows)) | extended
    rows["flags"], rows["length"] = flags, length
    rows["data"] = rng.integers(0, 256, (len(rows), 64))
    expected = rates.seconds(length, extended=bool(extended))
    assert frame_seconds(rows, rates).mean() == pytest.approx(expected, rel=0.006)


def test_fd_frame_of_iso_16845_by_hand() -> None:
    # ISO 16845-1, 8.1.6, CAN FD case 1. Up to BRS stuff bits come behind 0 0000, 1111 and 000 0 (with the stuff bit
    # before): 17 + 3 + 13 bits. Then ESI 0, DLC 1110, and 11111000: one stuff bit. Each 01111000 then completes five
    # zeros and five ones: 47 x 2. CRC-21: 4 + 21 + 7.
    row = record(0x078, b"\xf8" + b"\x78" * 47, FDF | BRS)
    assert bits_of(row) == (17 + 3 + 13, 1 + 4 + 8 * 48 + 1 + 47 * 2 + 4 + 21 + 7)


def test_no_records_take_no_time() -> None:
    assert frame_seconds(np.zeros(0, CAN_RECORD), CLASSIC).shape == (0,)
