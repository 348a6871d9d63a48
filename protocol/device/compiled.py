"""The device side in C (protocol/c) behind a `DeviceApp`: what a firmware runs, with a drive in Python.

It is compiled when it is first used, by the system's C compiler, and kept in the user's cache directory. `CompiledLink`
takes the place of `session.DeviceLink`, and `protocol.canmap.compiled.CompiledCan` that of `CanDevice`. No I/O, no
clock.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from platformdirs import user_cache_path

from protocol.descriptor import sample_dtype
from protocol.device.app import DeviceApp, Identity
from protocol.errors import Refused
from protocol.messages import DriveState, Fault, SetpointMode

SOURCE = Path(__file__).parents[1] / "c"
FILES = ("hbp.c", "hbp_can.c", "host/shim.c")
FLAGS = ("-std=c99", "-O2", "-fPIC", "-shared")
TX_BYTES = 1 << 13  # of encoded frames; what else waits are samples, in the pools
OPTIONS = {
    "HBP_RX_MAX": 1024,
    "HBP_TX_MAX": 1024,
    "HBP_TX_BYTES": TX_BYTES,
    "HBP_CHANNELS": 256,
    "HBP_POOLS": 4,
    "HBP_EDGES": 1 << 14,
    "HBP_HOSTS": 16,
    "HBP_CRC_TABLE": 256,
    "HBP_CAN_BYTES": 64,
    "HBP_CAN_MESSAGES": 1024,
    "HBP_CAN_TRANSFERS": 34,
}
MIN_POOL = 1 << 12  # bytes


class NoCompiler(Exception):
    """The C device side cannot be compiled here."""


def compiler() -> list[str]:
    """The system's C compiler: `$CC`, else cc, gcc or clang. Raises NoCompiler."""
    if given := os.environ.get("CC"):
        return shlex.split(given)
    for name in ("cc", "gcc", "clang"):
        if found := shutil.which(name):
            return [found]
    raise NoCompiler("no C compiler: install gcc or clang, or set CC to one")


@cache
def library(pool: int, frames: int) -> ctypes.CDLL:
    """The device side as a shared library, compiled if need be.

    Args:
        pool: bytes of samples that may wait in a stream.
        frames: stream frames that may wait on a CAN bus, a power of two.

    Raises:
        NoCompiler: there is no compiler, or it fails.
    """
    options = OPTIONS | {"HBP_POOL_BYTES": pool, "HBP_CAN_STREAMED": frames}
    command = [*compiler(), *FLAGS, *(f"-D{name}={value}" for name, value in options.items())]
    digest = hashlib.sha256(repr(command).encode())
    for file in sorted(SOURCE.rglob("*.[ch]")):
        digest.update(file.read_bytes())
    target = user_cache_path("hallbench", appauthor=False) / f"hbp-{digest.hexdigest()[:16]}.so"
    if not target.exists():
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=target.parent) as folder:
                made = Path(folder, target.name)
                done = subprocess.run(
                    [*command, "-o", made, *(SOURCE / name for name in FILES)], capture_output=True, text=True
                )
                if done.returncode:
                    raise NoCompiler(f"{command[0]} cannot compile {SOURCE}: {done.stderr.strip()[:500]}")
                os.replace(made, target)
        except OSError as error:
            raise NoCompiler(f"cannot compile {SOURCE}: {error}") from None
    return _declared(ctypes.CDLL(str(target)))


_U8, _U16, _U32, _U64 = ctypes.c_uint8, ctypes.c_uint16, ctypes.c_uint32, ctypes.c_uint64
_F32, _SIZE, _ANY, _TEXT = ctypes.c_float, ctypes.c_size_t, ctypes.c_void_p, ctypes.c_char_p
_DETAIL = ctypes.POINTER(_F32)

_ENTER = ctypes.CFUNCTYPE(_U16, _ANY, _U8, _DETAIL)
_SETPOINT = ctypes.CFUNCTYPE(_U16, _ANY, _U8, _F32, _F32, _DETAIL)
_OUTPUTS_ON = ctypes.CFUNCTYPE(_U8, _ANY)
_CLEAR = ctypes.CFUNCTYPE(_U32, _ANY, _U32)
_COMMIT = ctypes.CFUNCTYPE(_U16, _ANY, _DETAIL)
_GET = ctypes.CFUNCTYPE(_F32, _ANY, _U16)
_SET = ctypes.CFUNCTYPE(_U16, _ANY, _U16, _F32, _DETAIL)


class _Channel(ctypes.Structure):
    _fields_ = (
        ("id", _U16), ("type", _U8), ("unit", _U8), ("flags", _U16), ("at", _U16),
        ("scale", _F32), ("offset", _F32), ("name", _TEXT),
    )  # fmt: skip


class _Parameter(ctypes.Structure):
    _fields_ = (
        ("id", _U16), ("unit", _U8), ("flags", _U16), ("lo", _F32), ("hi", _F32), ("initial", _F32),
        ("value", _ANY), ("name", _TEXT),
    )  # fmt: skip


class _Config(ctypes.Structure):
    _fields_ = (
        ("node", _U8), ("role", _U8), ("features", _U32), ("tick_hz", _U32), ("pwm_hz", _U32), ("tick0", _U64),
        ("name", _TEXT), ("firmware", _TEXT), ("serial", _TEXT), ("build", _TEXT),
        ("channels", ctypes.POINTER(_Channel)), ("parameters", ctypes.POINTER(_Parameter)),
        ("n_channels", _U16), ("n_parameters", _U16), ("sample_bytes", _U16), ("user", _ANY),
        ("enter", _ENTER), ("setpoint", _SETPOINT), ("outputs_on", _OUTPUTS_ON), ("clear", _CLEAR),
        ("commit", _COMMIT), ("get", _GET), ("set", _SET),
    )  # fmt: skip


def _declared(lib: ctypes.CDLL) -> ctypes.CDLL:
    for name, result, *arguments in (
        ("shim_link_bytes", _SIZE),
        ("shim_can_bytes", _SIZE),
        ("shim_device_bytes", _SIZE),
        ("shim_ticks", None, _ANY, _U64, _ANY, _SIZE, _SIZE),
        ("shim_edges", None, _ANY, _ANY, _SIZE),
        ("shim_running", _U32, _ANY),
        ("shim_channels", None, _ANY, _ANY),
        ("shim_dropped", _U32, _ANY),
        ("shim_faults", _U32, _ANY),
        ("shim_bad", _U32, _ANY),
        ("shim_state", _U8, _ANY),
        ("shim_watchdog_ms", _U16, _ANY),
        ("shim_can_take", ctypes.c_int, _ANY, ctypes.POINTER(_U32), _ANY),
        ("shim_link_init", None, _ANY, _F32),
        ("shim_add", _U32, _ANY, _ANY, ctypes.POINTER(_Config), _U32),
        ("hbp_rx", None, _ANY, _U64, _TEXT, _SIZE),
        ("hbp_poll", None, _ANY, _U64),
        ("hbp_tx_peek", _SIZE, _ANY, ctypes.POINTER(_ANY)),
        ("hbp_tx_advance", None, _ANY, _SIZE),
        ("hbp_fault", None, _ANY, _U32),
        ("hbp_log", None, _ANY, _U8, _TEXT),
        ("shim_can_init", _U32, _ANY, _ANY),
        ("shim_can_add", _U32, _ANY, _ANY, ctypes.POINTER(_Config), _U32),
        ("hbp_can_rx", None, _ANY, _U64, _U32, _TEXT, _SIZE),
        ("hbp_can_poll", None, _ANY, _U64),
        ("hbp_can_gave_up", None, _ANY),
    ):
        function = getattr(lib, name)
        function.restype, function.argtypes = result, arguments
    return lib


class CompiledSession:
    """One device of a link: has what the owner of a `session.DeviceSession` needs of it, its streams and its states.

    `raised`: an exception out of the app, which C cannot pass on; the link raises it. `nodes` is C's own affair.
    """

    nodes = 1

    def __init__(self, lib: ctypes.CDLL, app: DeviceApp, identity: Identity) -> None:
        self.app, self.identity = app, identity
        self.raised: BaseException | None = None
        self._lib = lib
        self._dtype = sample_dtype(app.channels)
        self._memory = ctypes.create_string_buffer(lib.shim_device_bytes())
        self.at = ctypes.addressof(self._memory)
        self._config = self._make_config()

    # -- what the simulated bench asks ------------------------------------------------------------------------------

    @property
    def streams(self) -> CompiledSession:
        """See `DeviceSession.streams`: it is all here."""
        return self

    @property
    def machine(self) -> CompiledSession:
        """See `DeviceSession.machine`: it is all here."""
        return self

    @property
    def running(self) -> frozenset[int]:
        """Numbers of the running streams."""
        mask = self._lib.shim_running(self.at)
        return frozenset(number for number in range(4) if mask >> number & 1)

    @property
    def channels(self) -> frozenset[str]:
        """Names of the channels that streams are configured with."""
        used = np.zeros(len(self.app.channels), np.uint8)
        self._lib.shim_channels(self.at, used.ctypes.data)
        return frozenset(channel.name for channel, taken in zip(self.app.channels, used, strict=True) if taken)

    @property
    def dropped(self) -> int:
        """Stream frames that were not sent since boot."""
        return int(self._lib.shim_dropped(self.at))

    @property
    def faults(self) -> Fault:
        """Latched since the last FAULT_CLEAR."""
        return Fault(self._lib.shim_faults(self.at))

    @property
    def state(self) -> DriveState:
        """The state now."""
        return DriveState(self._lib.shim_state(self.at))

    @property
    def bad(self) -> int:
        """Damaged frames that its link received."""
        return int(self._lib.shim_bad(self.at))

    def watchdog_ms(self, tick: int) -> int:
        """What is left, 0xFFFF when the watchdog is not at work; `tick` must be that of the last look at the time."""
        return int(self._lib.shim_watchdog_ms(self.at))

    def push_samples(self, index0: int, tick0: int, raw: NDArray[np.void]) -> None:
        """See `DeviceSession.push_samples`; C makes the ticks itself."""
        if raw.dtype != self._dtype:
            raise TypeError(f"samples of {raw.dtype}, the channels make {self._dtype}")
        rows = np.ascontiguousarray(raw)
        self._lib.shim_ticks(self.at, index0, rows.ctypes.data, rows.itemsize, len(rows))

    def push_edges(self, records: NDArray[np.void]) -> None:
        """See `DeviceSession.push_edges`."""
        data = np.ascontiguousarray(records)
        self._lib.shim_edges(self.at, data.ctypes.data, len(data))

    def fault(self, bits: Fault) -> None:
        """Latch faults: outputs off, state FAULT."""
        self._lib.hbp_fault(self.at, int(bits))
        self.check()

    def log(self, level: int, text: str) -> None:
        """Send a LOG."""
        self._lib.hbp_log(self.at, level, text.encode())

    def check(self) -> None:
        """Raise what the app raised."""
        if self.raised is not None:
            raised, self.raised = self.raised, None
            raise raised

    # -- the app as C sees it ---------------------------------------------------------------------------------------

    def _make_config(self) -> _Config:
        app, identity = self.app, self.identity
        offsets: dict[str, Any] = dict(self._dtype.fields or {})
        channels = [
            _Channel(s.id, s.raw, s.unit, s.flags, offsets[s.name][1], s.scale, s.offset, s.name.encode())
            for s in app.channels
        ]
        parameters = [
            _Parameter(p.id, p.unit, p.flags, p.lo, p.hi, app.default_param(p.name), None, p.name.encode())
            for p in app.parameters
        ]
        names = [parameter.name for parameter in app.parameters]

        def refusing(call: Callable[..., object]) -> Callable[..., int]:
            """`call` with the last argument, where to put a refusal's detail, taken off."""

            def called(_: int, *arguments: Any) -> int:
                *given, detail = arguments
                try:
                    call(*given)
                except Refused as refusal:
                    detail[0] = refusal.detail
                    return int(refusal.code)
                except BaseException as error:
                    self.raised = error
                return 0

            return called

        def answering(call: Callable[..., Any]) -> Callable[..., Any]:
            def called(_: int, *arguments: Any) -> Any:
                try:
                    return call(*arguments)
                except BaseException as error:
                    self.raised = error
                    return 0

            return called

        return _Config(
            identity.node, identity.role, identity.features, identity.tick_hz, identity.pwm_hz, identity.tick0,
            identity.name.encode(), identity.firmware.encode(), identity.serial.encode(), identity.build.encode(),
            (_Channel * max(1, len(channels)))(*channels), (_Parameter * max(1, len(parameters)))(*parameters),
            len(channels), len(parameters), self._dtype.itemsize, None,
            _ENTER(refusing(lambda state: app.enter_state(DriveState(state)))),
            _SETPOINT(refusing(lambda mode, value, value2: app.setpoint(SetpointMode(mode), value, value2))),
            _OUTPUTS_ON(answering(lambda: int(app.outputs_on))),
            _CLEAR(answering(lambda faults: int(app.clear_faults(Fault(faults))))),
            _COMMIT(refusing(app.commit)),
            _GET(answering(lambda k: app.get_param(names[k]))),
            _SET(refusing(lambda k, value: app.set_param(names[k], value))),
        )  # fmt: skip

    @property
    def config(self) -> Any:
        """A pointer to it, for `hbp_add`."""
        return ctypes.byref(self._config)


class CompiledLink:
    """Several devices behind one byte link, the first of which answers to node 0. See `session.DeviceLink`.

    `pool`: bytes of samples that may wait in each stream. `capacity`: bytes/s that the link carries, None = unknown.
    """

    def __init__(self, pool: int = 1 << 16, capacity: float | None = None) -> None:
        self._lib = library(max(pool, MIN_POOL) & ~3, 1024)
        self._memory = ctypes.create_string_buffer(self._lib.shim_link_bytes())
        self._at = ctypes.addressof(self._memory)
        self._tick = 0
        self.sessions: dict[int, CompiledSession] = {}
        self._lib.shim_link_init(self._at, capacity or 0.0)

    def add(self, app: DeviceApp, identity: Identity) -> CompiledSession:
        """Return the session of one more device; ValueError for one that C refuses."""
        session = CompiledSession(self._lib, app, identity)
        if code := self._lib.shim_add(self._at, session.at, session.config, identity.boot_id):
            raise ValueError(f"node {identity.node}: hbp_add returns {code:#x}")
        self.sessions[identity.node] = session
        return session

    def receive(self, data: bytes) -> None:
        """Take bytes from the link, cut anywhere."""
        self._lib.hbp_rx(self._at, self._tick, data, len(data))
        self._check()

    def advance(self, tick: int) -> None:
        """Let time pass up to the 64-bit `tick` for every device."""
        self._tick = tick
        self._lib.hbp_poll(self._at, tick)
        self._check()

    def __len__(self) -> int:
        """Bytes that wait for the link: those in one piece."""
        return int(self._lib.hbp_tx_peek(self._at, ctypes.byref(ctypes.c_void_p())))

    def data_to_send(self, limit: int | None = None) -> bytes:
        """Return and forget the bytes that wait for the link, at most `limit`."""
        parts: list[bytes] = []
        left = 1 << 62 if limit is None else limit
        start = ctypes.c_void_p()
        while left > 0:
            n = min(left, self._lib.hbp_tx_peek(self._at, ctypes.byref(start)))
            if not n:
                break
            parts.append(ctypes.string_at(start.value or 0, n))
            self._lib.hbp_tx_advance(self._at, n)
            left -= n
            self._lib.hbp_poll(self._at, self._tick)  # what waits in the pools moves up
        self._check()
        return b"".join(parts)

    def _check(self) -> None:
        for session in self.sessions.values():
            session.check()
