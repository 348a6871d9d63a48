"""Captures, blobs and volatile parameters: the device side in C says what the one in Python says, byte for byte.

Of edges that found no room, C knows only how many came since its ring of records began anew: there it may tell fewer
than Python, but never none.
"""

from __future__ import annotations

from random import Random
from zlib import crc32

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from small_drive import (
    CHANNELS,
    DEFAULTS,
    PARAMETERS,
    SmallDrive,
    frames_in,
    identity,
    pack_edges,
    samples,
    whole_blob,
    wire_of,
)

from protocol.device.compiled import CompiledLink
from protocol.device.session import DeviceLink, TxQueue
from protocol.framing import ERROR, Frame
from protocol.messages import (
    BlobRead,
    BlobReply,
    BlobWrite,
    CaptureArm,
    CaptureReply,
    CaptureState,
    CaptureStatus,
    CaptureTrigger,
    Command,
    Fault,
    Feature,
    Hello,
    MessageType,
    ParamSet,
    Request,
    StateCommand,
)
from protocol.signals import Flag, Parameter, RawType, Signal, Unit
from tests.choice import examples
from tests.devices.device import TICK_HZ
from tests.protocol.test_same_answers import loose
from tests.tools import needs

pytestmark = needs("C compiler")

BOOT = 0xB0071D
TICKS = 1000  # in a PWM period
ROOM = 1000  # bytes of memory
NEW = Feature.CAPTURE | Feature.MEANINGS | Feature.WAVEFORM
VOLATILE = Flag.PARAMETER | Flag.VOLATILE
KINDS = tuple(
    Signal(10 + raw, f"as_{raw.name.lower()}", Unit.A, raw, scale, Flag.CHANNEL | Flag.ON_REQUEST, "", offset)
    for raw, scale, offset in (
        (RawType.U8, 0.5, 0.0), (RawType.I8, -0.25, 1.0), (RawType.U16, 0.125, -3.0), (RawType.I16, -2.0, 0.0),
        (RawType.U32, 1.0, 0.0), (RawType.I32, -1.0, 5.0), (RawType.F32, 2.0, 0.5),
    )
)  # fmt: skip
IDS = [channel.id for channel in (*CHANNELS, *KINDS)]


class Capturing(SmallDrive):
    """A small drive with a channel of each type, a test signal and meanings."""

    channels = (*CHANNELS, *KINDS)
    parameters = (
        *PARAMETERS,
        Parameter(105, "test", Unit.NONE, 0, 5, VOLATILE | Flag.WHOLE, ""),
        Parameter(106, "forced_speed", Unit.RAD_PER_S, -1e4, 1e4, VOLATILE, ""),
    )

    def __init__(self) -> None:
        super().__init__()
        self.values |= {"test": 0.0, "forced_speed": 0.0}
        self.meanings = {"i_a": "current of phase a", "gain": "how much of it, in µs", "test": "what is tested"}
        self.waveform = np.zeros(300, np.int16)

    def default_param(self, name: str) -> float:
        return float(np.float32(DEFAULTS.get(name, 0.0)))


class Few(Capturing):
    """One that holds channels of its own choice until a fault."""

    fault_channels = ("as_f32", "hall", "status")


def rows(index0: int, n: int) -> np.ndarray:
    """Samples in which each value follows from its index, and which go up and down."""
    index = (index0 + np.arange(n)) // 7
    noise = (index * 2654435761 >> 7) % 4096
    raw = np.zeros(n, [(channel.name, channel.raw.dtype) for channel in Capturing.channels])
    small = samples(index0, n)
    for channel in CHANNELS:
        raw[channel.name] = small[channel.name]
    for channel in KINDS:
        value = noise % 41 - 20 if channel.raw.dtype[1] in "if" else noise % 41
        raw[channel.name] = value.astype(channel.raw.dtype)
    raw["as_f32"][noise % 41 == 3] = np.nan
    return raw


OFF = CaptureArm(CaptureTrigger.OFF)


def an_arm(chance: Random) -> CaptureArm:
    """A CAPTURE_ARM that is right, as a rule, or has one thing or two that are wrong."""
    level = chance.choice([0.0, 0.5, -1.0, 2.0, 5.0, 10.0, -30.0, chance.uniform(-40, 40)])
    trigger = chance.choice(list(CaptureTrigger)[1:])
    values = {
        "trigger": trigger,
        "decimation": chance.choice([1, 1, 1, 2, 3, 10]),
        "before": chance.choice([0, 3, 9, 30]),
        "after": chance.choice([2, 3, 4, 15]),
        "level": chance.choice([2e-5, 2.6e-4]) if trigger is CaptureTrigger.PULSE else level,
        "channel": chance.choice(IDS),
        "edges": chance.choice([0, 1, 3, 10, 30]),
        "channels": tuple(chance.sample(IDS, chance.randint(1, 4))),
    }
    wrong = {
        "trigger": chance.choice([11, 255]),
        "flags": chance.randint(0, 255),
        "decimation": 0,
        "before": chance.choice([10_000, 1 << 31, (1 << 32) - 1]),
        "after": chance.choice([0, 10_000, 1 << 31]),
        "level": chance.choice([float("inf"), float("nan"), -1.0]),
        "channel": chance.randint(0, 20),
        "edges": chance.choice([124, 125, 65535]),
        "channels": tuple(chance.randint(0, 20) for _ in range(chance.randint(0, 4))),
    }
    for name in chance.sample(list(wrong), chance.choice([0, 0, 0, 0, 1, 2])):
        values[name] = wrong[name]
    return CaptureArm(**values)


def a_request(chance: Random) -> Request:
    data = chance.randbytes(chance.randint(0, 40))
    return chance.choice(
        [
            *[an_arm(chance) for _ in range(6)],
            OFF,
            BlobRead(chance.choice([0, 1, 1, 3, 4, 5]), chance.randint(0, 1024), chance.randint(0, ROOM)),
            BlobWrite(chance.choice([4, 4, 4, 4, 0, 1, 3, 9]), len(data), chance.randint(0, 602), data),
            ParamSet(chance.choice([101, 105, 106]), chance.choice([0.0, 1.0, 2.0, 7.0])),
            *[StateCommand(Command.ARM, BOOT), StateCommand(Command.START, 0)] * 2,
            StateCommand(Command.STOP, 0),
            *[StateCommand(Command.FAULT_CLEAR, bits) for bits in (2, 32, 34)],
            Hello(chance.randint(0, 9), 1, 1, chance.choice([128, 1024])),
        ]
    )


class Pair:
    """The same drive behind both device sides, and what both said last."""

    def __init__(self, kind: type[Capturing] = Capturing, features: Feature = NEW | Feature.EDGES, tick0: int = 77):
        self.tick0 = tick0
        self.python, self.c = DeviceLink(TxQueue(1 << 24)), CompiledLink(1 << 20)
        self.links = self.python, self.c
        self.period, self._tid, self._code = 0, 0, 1
        self._chance = np.random.default_rng(3)
        self.said: list[Frame] = []
        told = identity(tick_hz=TICK_HZ, pwm_hz=TICK_HZ // TICKS, features=features, capture_bytes=ROOM, tick0=tick0)
        for link in self.links:
            link.add(kind(), told)
            link.advance(tick0)
        self.compare()

    def compare(self) -> None:
        frames = [frames_in(link.data_to_send()) for link in self.links]
        beats = [[frame for frame in each if frame.type == MessageType.HEARTBEAT] for each in frames]
        news = [[frame for frame in each if frame.type != MessageType.HEARTBEAT] for each in frames]
        lost = [[edges_lost(frame) for frame in each] for each in news]
        for python, c in zip(*lost, strict=True):
            assert (c > 0) == (python > 0)
            assert c <= python
        assert [loose(without_lost(frame)) for frame in news[1]] == [loose(without_lost(frame)) for frame in news[0]]
        assert beats[1] == beats[0]
        python, c = (link.sessions[1] for link in self.links)
        assert c.channels == python.channels
        for name in ("values", "states", "outputs_on"):
            assert getattr(c.app, name) == getattr(python.app, name)
        assert (c.app.waveform == python.app.waveform).all()
        self.said = news[1]

    def ask(self, request) -> Frame:
        """The answer of both."""
        self._tid = self._tid % 0xFFFF + 1
        for link in self.links:
            link.receive(wire_of(request, self._tid))
        self.compare()
        (answer,) = (frame for frame in self.said if frame.is_reply)
        return answer

    def fault(self, bits: Fault) -> None:
        for link in self.links:
            link.sessions[1].fault(bits)
        self.compare()

    def run(self, n: int, edges: float = 0.2) -> None:
        """Periods, in each of which an edge comes with this chance, at any tick of it."""
        index = self.period + np.flatnonzero(self._chance.random(n) < edges)
        ticks = self.tick0 + index * TICKS - self._chance.integers(0, TICKS, len(index))
        codes = np.array([self._code, *self._chance.integers(0, 8, len(index))])
        back = np.flatnonzero(self._chance.random(len(index)) < 0.3) + 1
        codes[back[back > 1]] = codes[back[back > 1] - 2]  # it takes the last one back
        self._code = int(codes[-1])
        old, new = codes[:-1], codes[1:]
        changed = old ^ new
        illegal = np.isin(new, (0, 7)) | (changed & (changed - 1) > 0)
        for link in self.links:
            session = link.sessions[1]
            session.push_edges(pack_edges(ticks, old, new, illegal, ticks))
            session.push_samples(self.period, self.tick0 + self.period * TICKS, rows(self.period, n))
            link.advance(self.tick0 + (self.period + n - 1) * TICKS)
        self.period += n
        self.compare()

    def status(self) -> CaptureReply:
        return CaptureReply.unpack(self.ask(CaptureStatus()).payload)

    def blob(self) -> bytes:
        """Blob 1, read in parts."""
        return whole_blob(lambda request: BlobReply.unpack(self.ask(request).payload))


def edges_lost(frame: Frame) -> int:
    if frame.type not in (MessageType.CAPTURE_ARM, MessageType.CAPTURE_STATUS) or frame.flags & ERROR:
        return 0
    return CaptureReply.unpack(frame.payload).edges_lost


def without_lost(frame: Frame) -> Frame:
    if not edges_lost(frame):
        return frame
    return Frame(frame.type, frame.flags, frame.tid, frame.node, frame.payload[:28] + bytes(4) + frame.payload[32:])


@examples(12, 2000, campaign="c")
@given(st.integers(0, (1 << 32) - 1))
def test_c_captures_what_python_captures(seed: int) -> None:
    chance = Random(seed)
    edges = chance.choice([0.02, 0.3])
    near_the_end = (1 << 32) - chance.randint(1, 400) * TICKS + 3  # of what 32 bits of ticks can count
    features = NEW | Feature.EDGES * chance.randint(0, 1)
    pair = Pair(chance.choice([Capturing, Few]), features, chance.choice([77, near_the_end]))
    for _ in range(40):
        match chance.randint(0, 16):
            case 0:
                pair.fault(chance.choice([Fault.HALL, Fault.OVERCURRENT]))
            case kind if kind < 9:
                pair.ask(a_request(chance))
            case _:
                pair.run(chance.choice([1, 1, 2, 3, 5, 10, 11, 30, 40, 100, 300]), edges)
        held = pair.status()
        if held.state is CaptureState.FROZEN:
            data = pair.blob()
            assert (len(data), crc32(data)) == (held.size, held.crc)
            if chance.randint(0, 3):
                pair.ask(OFF)
