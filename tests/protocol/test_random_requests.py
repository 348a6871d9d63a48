"""What HBP 1.1 added, asked at random: every answer is the one that the tables of SPEC.md give, and nothing is raised.

Fields are right, wrong in one or several places, or noise, and payloads are cut and lengthened. What is due is worked
out here from the tables alone; where the capture is, and which streams run, the device tells.
"""

from __future__ import annotations

import math
import struct
from random import Random

import numpy as np
import pytest
from small_drive import frames_in, identity, pack_edges

from protocol.device.session import DeviceLink, TxQueue
from protocol.framing import MAJOR, Frame, encode_frame
from protocol.messages import (
    REPLIES,
    CaptureReply,
    CaptureState,
    Command,
    ErrorCode,
    ErrorReply,
    Fault,
    Feature,
    MessageType,
    PayloadError,
    StreamInfo,
)
from tests.choice import sampled
from tests.protocol.test_same_captures import Capturing, rows

TICKS, ROOM, WAVE_BYTES, EDGE = 1000, 3000, 600, 8
WIDTHS = {channel.id: np.dtype(channel.raw.dtype).itemsize for channel in Capturing.channels}
KNOWN = [*WIDTHS]
NEW = Feature.CAPTURE | Feature.MEANINGS | Feature.WAVEFORM | Feature.MEANS
HERE, CAMPAIGN, SEEDS = 1000, 100_000, 10
Due = tuple[int, float] | None
"""Which refusal, with its detail; None: it is answered."""


def one_of(chance: Random, usual: list[int], bits: int) -> int:
    """A number that is likely to mean something, or any of so many bits."""
    return chance.choice(usual) if chance.random() < 0.85 else chance.getrandbits(bits)


def ids(chance: Random) -> list[int]:
    """Channels, most of them known, sometimes none, sometimes twice."""
    return [one_of(chance, KNOWN, 16) for _ in range(chance.choice([0, 1, 1, 2, 3, 9]))]


def wrong_channel(chosen: list[int]) -> Due:
    """The refusal of the first channel that the device has not, or that comes twice; None if there is none."""
    for k, each in enumerate(chosen):
        if each not in WIDTHS:
            return ErrorCode.UNKNOWN_ID, each
        if each in chosen[:k]:
            return ErrorCode.BAD_VALUE, each
    return None


def a_level(chance: Random) -> float:
    return chance.choice([0.0, 1.0, -3.5, 1e30, math.nan, math.inf, -math.inf, chance.uniform(-100, 100)])


class Asking:
    """A device with all of it, and what it must say to a payload."""

    def __init__(self, seed: int) -> None:
        self.chance = Random(seed)
        self.edges = self.chance.random() < 0.8
        self.app = Capturing()
        self.link = DeviceLink(TxQueue())
        features = NEW | (Feature.EDGES if self.edges else Feature(0))
        self.session = self.link.add(self.app, identity(features=features, capture_bytes=ROOM, tick_hz=16_000_000))
        self.link.advance(0)
        self.index, self.tid = 0, 0
        self.wave = bytearray(WAVE_BYTES)
        self.meanings = b"".join(f"{name} {text}\n".encode() for name, text in self.app.meanings.items())
        self.answers = [0, 0]

    def ask(self, kind: int, payload: bytes) -> Frame:
        """The one answer to a request."""
        self.tid = self.tid % 0xFFFF + 1
        self.link.receive(encode_frame(Frame(kind, MAJOR, self.tid, 1, payload)))
        (answer,) = [frame for frame in frames_in(self.link.data_to_send()) if frame.is_reply]
        assert (answer.type, answer.tid) == (kind, self.tid)
        return answer

    def capture(self) -> CaptureReply:
        return CaptureReply.unpack(self.ask(MessageType.CAPTURE_STATUS, b"").payload)

    # -- what happens meanwhile -----------------------------------------------------------------------------------

    def meanwhile(self) -> None:
        """Periods pass, edges come, faults trip and are cleared, the test signal is switched."""
        chance = self.chance
        what = chance.random()
        if what < 0.25:
            n = chance.choice([1, 2, 30, 700])
            if self.edges and chance.random() < 0.5:
                at = np.array([self.index * TICKS + chance.randrange(n * TICKS) for _ in range(2)])
                self.session.push_edges(pack_edges(np.sort(at), np.array([1, 3]), np.array([3, 1]), False, at * 0))
            self.session.push_samples(self.index, self.index * TICKS, rows(self.index, n))
            self.index += n
            self.link.advance(self.index * TICKS)
        elif what < 0.27:
            self.session.fault(Fault.OVERCURRENT)
            self.ask(
                MessageType.STATE_CMD, struct.pack("<BxxxI", Command.FAULT_CLEAR, int(self.session.machine.faults))
            )
        elif what < 0.32:
            self.app.values["test"] = float(chance.choice([0, 0, 2]))
        elif what < 0.34:
            mask = struct.pack("<I", chance.choice([1, 2, 0xFFFFFFFF]))
            self.ask(chance.choice([MessageType.STREAM_START, MessageType.STREAM_STOP]), mask)

    # -- what is asked, and what is due ---------------------------------------------------------------------------

    def blob(self, number: int) -> int | None:
        """The length of a blob, None where there is none."""
        told = self.capture()
        frozen = told.size if told.state == CaptureState.FROZEN else None
        descriptor = 32 * (len(self.app.channels) + len(self.app.parameters))
        return {0: descriptor, 1: frozen, 3: len(self.meanings), 4: WAVE_BYTES}.get(number)

    def blob_write(self) -> tuple[bytes, Due]:
        chance = self.chance
        number = one_of(chance, [4, 4, 4, 4, 0, 1, 3, 2], 8)
        offset = one_of(chance, [0, 1, WAVE_BYTES - 4, WAVE_BYTES, WAVE_BYTES + 1, 0xFFFFFFFC], 32)
        data = chance.randbytes(chance.choice([0, 1, 4, 5, 99]))
        length = len(data) + chance.choice([0] * 12 + [1, -1, 300])
        payload = struct.pack("<BxHI", number, length & 0xFFFF, offset) + data
        total = self.blob(number)
        due: Due = None
        if length & 0xFFFF != len(data):
            due = ErrorCode.BAD_LENGTH, len(payload)
        elif total is None:
            due = ErrorCode.UNKNOWN_ID, number
        elif number != 4:
            due = ErrorCode.READ_ONLY, number
        elif offset + len(data) > total:
            due = ErrorCode.OUT_OF_RANGE, total
        elif self.app.values["test"]:
            due = ErrorCode.BUSY, number
        else:
            self.wave[offset : offset + len(data)] = data
        return payload, due

    def blob_read(self) -> tuple[bytes, Due]:
        number = one_of(self.chance, [4, 3, 1, 1, 0, 2], 8)
        total = self.blob(number)
        offset = one_of(self.chance, [0, 7, total or 0, (total or 0) + 1], 32)
        payload = struct.pack("<BxHI", number, self.chance.getrandbits(16), offset)
        if total is None:
            return payload, (ErrorCode.UNKNOWN_ID, number)
        return payload, (ErrorCode.OUT_OF_RANGE, total) if offset > total else None

    def capture_arm(self) -> tuple[bytes, Due]:
        chance = self.chance
        trigger = one_of(chance, [*range(11), 0, 0, 1, 1, 1], 8)
        decimation, level, chosen = one_of(chance, [1, 1, 3, 7, 0], 16), a_level(chance), ids(chance)
        before, after = (one_of(chance, [0, 1, 5, 100, 0xFFFFFFFF], 32) for _ in range(2))
        channel, edges = one_of(chance, KNOWN, 16), one_of(chance, [0, 0, 3, 60, 375, 376], 16)
        n = len(chosen) + chance.choice([0] * 15 + [1, -1])
        fixed = trigger, chance.choice([0, 0, 77]), decimation, before, after, level, channel, edges, n & 0xFFFF
        payload = struct.pack("<BBHIIfHHH", *fixed) + struct.pack(f"<{len(chosen)}H", *chosen)
        if n != len(chosen):
            return payload, (ErrorCode.BAD_LENGTH, len(payload))
        told = self.capture()
        if trigger > 10:
            return payload, (ErrorCode.BAD_VALUE, trigger)
        if trigger == 0:
            return payload, None
        if told.state == CaptureState.FROZEN:
            return payload, (ErrorCode.BUSY, told.number)
        if not decimation or not after:
            return payload, (ErrorCode.BAD_VALUE, 0)
        if not math.isfinite(level):
            return payload, (ErrorCode.BAD_VALUE, level)
        if not chosen:
            return payload, (ErrorCode.BAD_VALUE, 0)
        if due := wrong_channel(chosen):
            return payload, due
        if 2 <= trigger <= 6 and channel not in WIDTHS:
            return payload, (ErrorCode.UNKNOWN_ID, channel)
        if trigger >= 9 and not self.edges:
            return payload, (ErrorCode.NOT_SUPPORTED, trigger)
        fits = max(0, ROOM - EDGE * edges) // sum(WIDTHS[each] for each in chosen)
        return payload, (ErrorCode.DOES_NOT_FIT, fits) if before + after > fits else None

    def stream_set(self) -> tuple[bytes, Due]:
        chance = self.chance
        stream, event = one_of(chance, [0, 1, 2, 4], 8), one_of(chance, [3, 3, 3, 0, 1, 2], 8)
        decimation, chosen = one_of(chance, [1, 10, 0], 16), ids(chance)
        n = len(chosen) + chance.choice([0] * 15 + [1, -1])
        payload = struct.pack("<BBHHH", stream, event, decimation, 20, n & 0xFFFF)
        payload += struct.pack(f"<{len(chosen)}H", *chosen)
        if n != len(chosen):
            return payload, (ErrorCode.BAD_LENGTH, len(payload))
        if stream > 3:
            return payload, (ErrorCode.OUT_OF_RANGE, 3)
        if event not in (0, 2, 3) or (event == 2 and not self.edges):
            return payload, (ErrorCode.NOT_SUPPORTED, event)
        if event == 2 and chosen:
            return payload, (ErrorCode.BAD_VALUE, len(chosen))
        if event != 2 and (not decimation or not chosen):
            return payload, (ErrorCode.BAD_VALUE, 0)
        if event != 2 and (due := wrong_channel(chosen)):
            return payload, due
        info = self.ask(MessageType.STREAM_GET, struct.pack("<Bxxx", stream))
        running = not info.is_error and StreamInfo.unpack(info.payload).running
        return payload, (ErrorCode.BUSY, stream) if running else None

    def once(self) -> None:
        """Let something happen, ask, and compare."""
        self.meanwhile()
        kind, make = self.chance.choice(
            [
                (MessageType.BLOB_WRITE, self.blob_write), (MessageType.BLOB_READ, self.blob_read),
                (MessageType.CAPTURE_ARM, self.capture_arm), (MessageType.CAPTURE_ARM, self.capture_arm),
                (MessageType.STREAM_SET, self.stream_set), (MessageType.CAPTURE_STATUS, lambda: (b"", None)),
            ]
        )  # fmt: skip
        if self.chance.random() < 0.05:
            self._noise(kind)
            return
        payload, due = make()
        answer = self.ask(kind, payload)
        if due is None:
            assert not answer.is_error, (kind.name, payload.hex(), ErrorReply.unpack(answer.payload))
            REPLIES[kind].unpack(answer.payload)
        else:
            assert answer.is_error, (kind.name, payload.hex(), due)
            error = ErrorReply.unpack(answer.payload)
            told, detail = error.code, np.float32(due[1])
            assert (told, error.request) == (due[0], kind), (payload.hex(), error, due)
            assert np.array_equal(np.float32(error.detail), detail, equal_nan=True), (payload.hex(), error, due)
        self.answers[due is not None] += 1

    def _noise(self, kind: MessageType) -> None:
        """Bytes that mean nothing: answered, once, with a refusal or as what they happen to be."""
        wave = self.chance.randbytes(self.chance.randrange(40))
        answer = self.ask(kind, wave)
        if kind == MessageType.BLOB_WRITE and not answer.is_error:
            offset = struct.unpack_from("<I", wave, 4)[0]
            self.wave[offset : offset + len(wave) - 8] = wave[8:]
        if not answer.is_error:
            try:
                REPLIES[kind].unpack(answer.payload)
            except PayloadError as error:
                raise AssertionError(f"{kind.name} {wave.hex()}") from error


def asked(seed: int, times: int) -> Asking:
    """A device after so many requests; its blobs are what was written."""
    asking = Asking(seed)
    for _ in range(times):
        asking.once()
    assert min(asking.answers) > times // 10
    assert bytes(asking.app.waveform.view(np.uint8)) == bytes(asking.wave)
    return asking


@pytest.mark.parametrize("seed", sampled("random requests", range(SEEDS), 2, campaign="requests"))
def test_requests_at_random_are_answered_as_the_tables_say(seed: int) -> None:
    asked(seed, HERE)


@pytest.mark.campaign("requests")
@pytest.mark.parametrize("seed", range(1000, 1000 + SEEDS))
def test_a_million_of_them(seed: int) -> None:
    asked(seed, CAMPAIGN)
