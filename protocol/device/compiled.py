"""The device side in C (protocol/c) behind a `DeviceApp`: what a firmware runs, with a drive in Python.

It is compiled when it is first used, by the system's C compiler, and kept in the user's cache directory. `CompiledLink`
takes the place of `session.DeviceLink`, and `protocol.canmap.compiled.CompiledCan` that of `CanDevice`. No I/O, no
clock.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import re
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from platformdirs import user_cache_path

from protocol.descriptor import sample_dtype
from protocol.device.app import DeviceApp, Extras, Identity
from protocol.device.blobs import meanings_blob
from protocol.device.records import LateSamples, Samples, made, rows_of
from protocol.errors import Refused
from protocol.messages import DriveState, Fault, Feature, SetpointMode
from protocol.streams import EDGE_RECORD

SOURCE = Path(__file__).parents[1] / "c"
FILES = ("hbp.c", "hbp_capture.c", "hbp_means.c", "hbp_can.c", "host/shim.c")
FLAGS = "-std=c99 -O2 -fPIC -shared"
OPTIONS = """
    HBP_RX_MAX=1024 HBP_TX_MAX=1024 HBP_TX_BYTES=8192 HBP_CHANNELS=256 HBP_POOLS=4 HBP_EDGES=16384 HBP_HOSTS=16
    HBP_CRC_TABLE=256 HBP_CAPTURE_PART=1048576 HBP_MEANS=1 HBP_CAN_BYTES=64 HBP_CAN_MESSAGES=1024 HBP_CAN_TRANSFERS=34
"""
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


def host_options(pool: int, frames: int) -> str:
    """Options of hbp.h for a host, which has memory: more than any firmware.

    Args:
        pool: bytes of samples that may wait in a stream.
        frames: stream frames that may wait on a CAN bus, a power of two.
    """
    return f"{OPTIONS} HBP_POOL_BYTES={pool} HBP_CAN_STREAMED={frames}"


@cache
def library(options: str) -> ctypes.CDLL:
    """The device side as a shared library, compiled if need be.

    Args:
        options: those of hbp.h and hbp_can.h that are not as there: `NAME=VALUE`, with spaces between them.

    Raises:
        NoCompiler: there is no compiler, or it fails.
    """
    command = [*compiler(), *FLAGS.split(), *(f"-D{option}" for option in options.split())]
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
                    [*command, "-o", made, *(SOURCE / name for name in FILES)],
                    capture_output=True,
                    encoding="utf-8",
                    errors="replace",
                )
                if done.returncode:
                    raise NoCompiler(f"{command[0]} cannot compile {SOURCE}: {done.stderr.strip()[:500]}")
                os.replace(made, target)
        except OSError as error:
            raise NoCompiler(f"cannot compile {SOURCE}: {error}") from None
    return _declared(ctypes.CDLL(str(target)))


_PLAIN: dict[str, Any] = {f"uint{bits}_t": getattr(ctypes, f"c_uint{bits}") for bits in (8, 16, 32, 64)}
_PLAIN |= {"int": ctypes.c_int, "size_t": ctypes.c_size_t, "float": ctypes.c_float, "void": None}


def _ctype(declared: str) -> Any:
    """What ctypes has for the type in a C declaration; most pointers are plain addresses."""
    base = declared.replace("const ", "").split()[0]
    if "*" in declared:
        return {"char": ctypes.c_char_p, "float": ctypes.POINTER(ctypes.c_float)}.get(base, ctypes.c_void_p)
    return _PLAIN[base]


@cache
def _declarations() -> str:
    """What the headers and the shim declare, without comments."""
    text = "".join(Path(SOURCE, name).read_text(encoding="utf-8") for name in ("hbp.h", "hbp_can.h", "host/shim.c"))
    return re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)


@cache
def structure(name: str) -> Any:
    """The structure `name` of the headers as ctypes has it. Raises KeyError for a type that is not known here."""
    (body,) = re.findall(rf"^struct {name} {{(.*?)^}};", _declarations(), re.DOTALL | re.MULTILINE)
    members: list[tuple[str, Any]] = []
    for member in map(str.strip, body.split(";")[:-1]):
        if call := re.fullmatch(r"(\w+) \(\*(\w+)\)\((.*)\)", member):
            members.append((call[2], ctypes.CFUNCTYPE(_ctype(call[1]), *map(_ctype, call[3].split(",")))))
        else:
            ((base, names),) = re.findall(r"((?:const |struct )*\w+) (.*)", member)
            members += [(each.strip(" *"), _ctype(f"{base} {each}")) for each in names.split(",")]
    return type(name, (ctypes.Structure,), {"_fields_": members})


def _declared(lib: ctypes.CDLL) -> ctypes.CDLL:
    """Tell ctypes how the functions of the headers and the shim are called."""
    functions = re.findall(r"^(\w[\w ]*[ *])((?:hbp|shim)_\w+)\(([^()]*)\)", _declarations(), re.MULTILINE)
    for result, name, arguments in functions:
        if not result.startswith("static"):
            function = getattr(lib, name)
            function.restype = _ctype(result)
            function.argtypes = [_ctype(each) for each in arguments.split(",") if each != "void"]
    return lib


class CompiledSession:
    """One device of a link: has what the owner of a `session.DeviceSession` needs of it, its streams and its states.

    `raised`: an exception out of the app, which C cannot pass on; the link raises it. `nodes` is C's own affair.
    """

    nodes = 1

    def __init__(self, lib: ctypes.CDLL, app: DeviceApp, identity: Identity) -> None:
        extras = Extras.of(app)
        self.app, self.identity = app, replace(identity, features=extras.features(identity))
        self.raised: BaseException | None = None
        self._lib = lib
        self._dtype = sample_dtype(app.channels)
        self._memory = ctypes.create_string_buffer(lib.shim_device_bytes())
        self._edges: list[NDArray[np.void]] = []  # that come before samples which have not been pushed yet
        self.at = ctypes.addressof(self._memory)
        self.config = ctypes.byref(self._make_config(extras))
        """A pointer to the app as C sees it, for `hbp_add`."""
        self.streams = self.machine = self
        """See `DeviceSession.streams` and `machine`: it is all here."""

    # -- what the simulated bench asks ------------------------------------------------------------------------------

    @property
    def running(self) -> frozenset[int]:
        """Numbers of the running streams."""
        mask = self._lib.shim_running(self.at)
        return frozenset(number for number in range(4) if mask >> number & 1)

    @property
    def channels(self) -> frozenset[str]:
        """See `DeviceSession.channels`."""
        used = np.zeros(len(self.app.channels), np.uint8)
        self._lib.shim_channels(self.at, used.ctypes.data)
        return frozenset(channel.name for channel, taken in zip(self.app.channels, used, strict=True) if taken)

    @property
    def sampling(self) -> bool:
        """Whether a stream runs, or a capture takes samples."""
        return bool(self.running) or bool(self._lib.shim_capturing(self.at))

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

    def push_samples(self, index0: int, tick0: int, samples: Samples) -> None:
        """See `DeviceSession.push_samples`; C makes the ticks itself."""
        if isinstance(samples, LateSamples) and not self.sampling:
            return
        rows = rows_of(made(samples, self.channels), self._dtype)
        self._give(index0, rows.ctypes.data, len(rows))

    def push_edges(self, records: NDArray[np.void]) -> None:
        """See `DeviceSession.push_edges`. C gets them among the samples that follow, or when it looks at the time."""
        if len(records):
            self._edges.append(records.copy())

    def look(self) -> None:
        """Before C looks at the time: give it edges that no sample has followed."""
        if self._edges:
            self._give(self._lib.shim_periods(self.at), None, 0)

    def _give(self, index0: int, rows: int | None, n: int) -> None:
        """Give C `n` samples from the period `index0` on, at the address `rows`, and the edges that wait."""
        edges = np.concatenate(self._edges) if self._edges else np.empty(0, EDGE_RECORD)
        self._edges.clear()
        self._lib.shim_ticks(self.at, index0, rows, self._dtype.itemsize, n, edges.ctypes.data, len(edges))

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

    def _make_config(self, extras: Extras) -> Any:
        app, identity = self.app, self.identity
        offsets: dict[str, Any] = dict(self._dtype.fields or {})
        channels = [
            (s.id, s.raw, s.unit, s.flags, offsets[s.name][1], s.scale, s.offset, s.name.encode()) for s in app.channels
        ]
        parameters = [
            (p.id, p.unit, p.flags, p.lo, p.hi, app.default_param(p.name), None, p.name.encode())
            for p in app.parameters
        ]
        self._channels = (structure("hbp_channel") * max(1, len(channels)))(*channels)
        self._parameters = (structure("hbp_parameter") * max(1, len(parameters)))(*parameters)
        names = [parameter.name for parameter in app.parameters]
        by_name = {channel.name: channel.id for channel in app.channels}
        ids = [by_name[name] for name in extras.fault_channels]
        self._fault_channels = (ctypes.c_uint16 * len(ids))(*ids)
        given: dict[str, Any] = {}
        if identity.features & Feature.CAPTURE:
            self._capture = ctypes.create_string_buffer(identity.capture_bytes)
            given = {"capture": ctypes.addressof(self._capture), "capture_bytes": identity.capture_bytes}
        if ids:
            given["fault_channels"] = ctypes.addressof(self._fault_channels)
        if identity.features & Feature.MEANINGS:
            given["meanings"] = meanings_blob(extras.meanings, {*by_name, *names})
        if identity.features & Feature.WAVEFORM and extras.waveform is not None:
            given["waveform"] = extras.waveform.ctypes.data
            given["waveform_length"] = len(extras.waveform)

        def refusing(call: Callable[..., object]) -> Callable[..., int]:
            """`call` with the last argument, where to put a refusal's detail, taken off."""

            def called(*arguments: Any) -> int:
                *given, detail = arguments
                try:
                    call(*given)
                except Refused as refusal:
                    detail[0] = refusal.detail
                    return int(refusal.code)
                return 0

            return answering(called)

        def answering(call: Callable[..., Any]) -> Callable[..., Any]:
            def called(_: int, *arguments: Any) -> Any:
                try:
                    return call(*arguments)
                except BaseException as error:
                    self.raised = error
                    return 0

            return called

        calls = {
            "enter": refusing(lambda state: app.enter_state(DriveState(state))),
            "setpoint": refusing(lambda mode, value, value2: app.setpoint(SetpointMode(mode), value, value2)),
            "outputs_on": answering(lambda: int(app.outputs_on)),
            "clear": answering(lambda faults: int(app.clear_faults(Fault(faults)))),
            "commit": refusing(app.commit),
            "get": answering(lambda k: app.get_param(names[k])),
            "set": refusing(lambda k, value: app.set_param(names[k], value)),
        }
        config = structure("hbp_config")
        types = dict(config._fields_)
        told = {key: each.encode() if isinstance(each, str) else each for key, each in asdict(identity).items()}
        del told["capture_bytes"]  # only where there is memory
        return config(
            sample_bytes=self._dtype.itemsize,
            channels=ctypes.addressof(self._channels), n_channels=len(channels),
            parameters=ctypes.addressof(self._parameters), n_parameters=len(parameters),
            n_fault_channels=len(ids),
            **given,
            **{name: told[name] for name in types if name in told},
            **{name: types[name](call) for name, call in calls.items()},
        )  # fmt: skip


class CompiledLink:
    """Several devices behind one byte link, the first of which answers to node 0. See `session.DeviceLink`.

    `pool`: bytes of samples that may wait in each stream. `capacity`: bytes/s that the link carries, None = unknown.
    """

    def __init__(self, pool: int = 1 << 16, capacity: float | None = None) -> None:
        self._lib = library(host_options(max(pool, MIN_POOL) & ~3, 1024))
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
        self._look()
        self._lib.hbp_rx(self._at, self._tick, data, len(data))
        self._check()

    def advance(self, tick: int) -> None:
        """Let time pass up to the 64-bit `tick` for every device."""
        self._look()
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

    def _look(self) -> None:
        for session in self.sessions.values():
            session.look()

    def _check(self) -> None:
        for session in self.sessions.values():
            session.check()
