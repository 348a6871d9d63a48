"""A small but whole drive for the session tests: a table of parameters and a switch, no motor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from types import MappingProxyType

import numpy as np

from protocol.device.compiled import CompiledLink, CompiledSession
from protocol.device.session import DeviceLink, DeviceSession, Identity, TxQueue
from protocol.errors import Refused
from protocol.framing import MAJOR, Deframer, Frame, encode_frame, parse_frame
from protocol.messages import BlobRead, BlobReply, DriveState, ErrorCode, Fault, Feature, Request, Role, SetpointMode
from protocol.signals import Flag, Parameter, RawType, Signal, Unit
from protocol.streams import EDGE_ILLEGAL, EDGE_RECORD
from tests.devices import FULL
from tests.devices import build as build_device
from tests.devices import vocabulary as words
from tests.devices.device import TICK_HZ
from tests.devices.virtual import VirtualLink
from tests.devices.vocabulary import Vocabulary

TICKS = 1250  # in a PWM period
CHANNELS = (
    Signal(1, "hall", Unit.NONE, RawType.U8, 1.0, Flag.CHANNEL, ""),
    Signal(2, "status", Unit.NONE, RawType.U8, 1.0, Flag.CHANNEL, ""),
    Signal(3, "theta", Unit.RAD, RawType.I16, np.pi / 32768, Flag.CHANNEL | Flag.WRAPS, ""),
    Signal(4, "i_a", Unit.A, RawType.I16, 1 / 1024, Flag.CHANNEL, ""),
    Signal(5, "count", Unit.COUNT, RawType.U32, 1.0, Flag.CHANNEL, ""),
)
PARAMETERS = (
    Parameter(101, "gain", Unit.NONE, 1e-4, 1e5, Flag.PARAMETER, ""),
    Parameter(102, "n_p", Unit.NONE, 1, 64, Flag.PARAMETER | Flag.IDLE_ONLY | Flag.WHOLE, ""),
    Parameter(103, "serial", Unit.NONE, 0, 1e6, Flag.PARAMETER | Flag.READ_ONLY, ""),
    Parameter(104, "watchdog", Unit.S, 0.05, 1.0, Flag.PARAMETER | Flag.IDLE_ONLY, ""),
)
DEFAULTS = {"gain": 2.5, "n_p": 6.0, "serial": 42.0, "watchdog": 0.2}


class SmallDrive:
    """Implements `DeviceApp`; remembers what it was told."""

    channels = CHANNELS
    parameters = PARAMETERS
    meanings = MappingProxyType({"theta": "angle, ±π", "gain": "of everything"})

    def __init__(self) -> None:
        self.waveform = np.zeros(256, np.int16)
        self.outputs_on = False
        self.values = {name: float(np.float32(value)) for name, value in DEFAULTS.items()}
        self.states: list[DriveState] = []
        self.setpoints: list[tuple[SetpointMode, float, float]] = []
        self.persisting = Fault(0)
        self.commits = 0
        self.calls = 0

    def enter_state(self, state: DriveState) -> None:
        self.states.append(state)
        self.outputs_on = state is DriveState.RUNNING

    def clear_faults(self, faults: Fault) -> Fault:
        return faults & self.persisting

    def setpoint(self, mode: SetpointMode, value: float, value2: float) -> None:
        if mode is not SetpointMode.SPEED:
            raise Refused("speed only", ErrorCode.NOT_SUPPORTED, mode)
        if abs(value) > 300:
            raise Refused("too fast", ErrorCode.OUT_OF_RANGE, 300)
        self.setpoints.append((mode, value, value2))

    def get_param(self, name: str) -> float:
        return self.values[name]

    def default_param(self, name: str) -> float:
        return float(np.float32(DEFAULTS[name]))

    def set_param(self, name: str, value: float) -> None:
        self.calls += 1
        self.values[name] = value

    def commit(self) -> None:
        self.commits += 1


FEATURES = ~Feature(0)
"""Of all versions."""


def identity(node: int = 1, boot_id: int = 0xB0071D, **changes: object) -> Identity:
    values = {
        "role": Role.DRIVE,
        "name": "small",
        "firmware": "1.0",
        "features": Feature.EDGES,
        "capture_bytes": 4096,
    } | changes
    return Identity(node=node, boot_id=boot_id, **values)


def small_link(tx: TxQueue | None = None, **changes: object) -> tuple[DeviceLink, DeviceSession, SmallDrive]:
    """Return a link with one small drive that has booted."""
    link = DeviceLink(tx)
    app = SmallDrive()
    session = link.add(app, identity(**changes))
    link.advance(0)
    return link, session, app


def small_link_in_c(**changes: object) -> tuple[CompiledLink, CompiledSession, SmallDrive]:
    """Return the same behind the device side in C."""
    link, app = CompiledLink(), SmallDrive()
    session = link.add(app, identity(**changes))
    link.advance(0)
    return link, session, app


SMALL = replace(
    FULL, name="small", firmware="1.0", serial="", build="", modes=FULL.modes[:1],
    channels=tuple(
        words.Channel(each.id, each.name, each.raw, each.unit, each.flags, each.scale, lambda s: s.hall)
        for each in CHANNELS
    ),
    parameters=tuple(
        words.Parameter(p.id, p.name, *map(float, np.float32([DEFAULTS[p.name], p.lo, p.hi])), p.unit, p.flags)
        for p in PARAMETERS
    ),
)  # fmt: skip
"""The same drive for `tests.devices`."""


class AloneLink(VirtualLink):
    """A drive by SPEC.md alone: a link, its session and its app in one."""

    def __init__(self, vocabulary: Vocabulary = SMALL) -> None:
        super().__init__(can=False)
        self._now = Fraction(0)
        self.device = build_device(vocabulary, clock=self.clock)
        self.device.boot_id = 0xB0071D
        self.device.attach(self.carrier)

    def receive(self, data: bytes) -> None:
        self.write(data)

    def advance(self, tick: int) -> None:
        self._now = Fraction(tick, TICK_HZ)
        self.device.advance()

    def data_to_send(self) -> bytes:
        data = bytes(self.port.to_host)
        self.port.to_host.clear()
        return data

    @property
    def values(self) -> dict[int, float]:
        return self.device.values

    @property
    def states(self) -> list[DriveState]:
        """The present one."""
        return [self.device.state]

    @property
    def outputs_on(self) -> bool:
        return self.device.outputs_on

    def fault(self, bits: Fault) -> None:
        self.device.trip(bits)


def small_link_alone(features: Feature = SMALL.features) -> tuple[AloneLink, AloneLink, AloneLink]:
    """Return the same by SPEC.md alone."""
    made = AloneLink(SMALL.without(features=features))
    made.advance(0)
    return made, made, made


def wire_of(message: Request, tid: int = 0, node: int = 1) -> bytes:
    return encode_frame(Frame(message.TYPE, MAJOR, tid, node, message.pack()))


def whole_blob(read: Callable[[BlobRead], BlobReply], part: int = 1000, number: int = 1) -> bytes:
    """A blob, read in parts."""
    data, total = b"", 1
    while len(data) < total:
        reply = read(BlobRead(number, part, len(data)))
        data, total = data + reply.data, reply.total
    return data


def frames_in(data: bytes) -> list[Frame]:
    """Return the frames of what an end has to send, all of it."""
    return [parse_frame(raw) for raw in Deframer().feed(b"\0" + data)]


def samples(index0: int, n: int) -> np.ndarray:
    """Return n samples of all channels in which every value is a function of the index."""
    index = index0 + np.arange(n)
    raw = np.zeros(n, [(c.name, c.raw.dtype) for c in CHANNELS])
    raw["hall"] = 1 + index % 6
    raw["status"] = 3
    raw["theta"] = index * 7 % 65536 - 32768
    raw["i_a"] = index % 2001 - 1000
    raw["count"] = index & 0xFFFFFFFF
    return raw


def pack_edges(tick, hall_old, hall_new, illegal, encoder):
    """Edges as wire records (EDGE_RECORD): ticks and encoder counts are cut to 32 and 16 bits."""
    records = np.zeros(len(tick), EDGE_RECORD)
    records["tick"] = tick & 0xFFFFFFFF
    records["codes"] = hall_old | hall_new << 3 | np.where(illegal, EDGE_ILLEGAL, 0).astype(np.uint8)
    records["encoder"] = encoder & 0xFFFF
    return records


def edges_at(ticks):
    """Edges from code 1 to 3, as wire records; the encoder stands where the tick does."""
    ticks = np.asarray(ticks, np.int64)
    ones = np.ones(len(ticks), np.uint8)
    return pack_edges(ticks, ones, ones * 3, ones > 5, ticks)
