"""The simulated bench in real time behind a port: `serve` is what `bench sim` runs.

The server keeps the device in step with the clock, in portions of a few milliseconds, and moves bytes between it
and its port. It never blocks on the port and never sprints: what it cannot catch up within `MAX_BEHIND` it skips
and counts, while the device's own ticks go on without a gap.
"""

from __future__ import annotations

import math
import os
import select
import signal
import sys
import time
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from protocol.canmap.frame import BusRates
from protocol.device.tx import TxQueue
from protocol.links.target import (
    MAX_BAUD,
    MAX_BITRATE,
    MAX_DATA_BITRATE,
    MIN_BAUD,
    MIN_BITRATE,
    split_host_port,
)
from sim.compile import tell_by
from sim.config.params import BenchParams, ConfigError, Value, load_params
from sim.interrupts import there
from sim.ports.byte_ports import HAS_PTY, NO_PTY, Port, PtyPort, TcpPort
from sim.ports.uart import BITS_PER_CHARACTER, Pacer

if TYPE_CHECKING:
    from sim.ports.device import SimulatedDevice
    from sim.ports.networks import Network

STEP = 0.0125  # s between portions: a pty holds what comes meanwhile of the default stream
LATE = 0.05  # s of delay that is worth a word
LATE_PERIOD = 5.0  # s between such words
WARNING = 4  # level of a LOG
AWAITED = 1.0  # s
MAX_BEHIND = 0.1  # s of delay that is caught up; must leave a host's ALIVE in time for the watchdog
TX_BYTES = 1 << 18  # stream bytes that may wait for a port: 0.3 s of every channel
MIN_TX_BYTES = 1 << 13
_WRITE = 1 << 15
_STOPS = there("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")
_PULL, _PLUG = there("SIGUSR1"), there("SIGUSR2")
_TAKEN = (*_STOPS, *_PULL, *_PLUG)

EXPOSED = (
    "{} is open to other machines, and HBP has no authentication: whoever reaches it can spin the motor. "
    "Listen on 127.0.0.1 and use ssh -L instead"
)

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class ServeOptions:
    """What to serve and where."""

    tcp: str | None = None
    """HOST:PORT to listen on, port 0 = any."""
    pty: bool = False
    """On a pty, and nowhere else."""
    slcan: bool = False
    """On a CAN bus behind an slcan adapter on a pty. Without any of these: a pty, or TCP where the system has none."""
    rates: BusRates = field(default_factory=BusRates)
    """Of the CAN bus."""
    extended: bool = False
    """29-bit identifiers on the CAN bus."""
    link: Path | None = None
    """Symbolic link to the pty."""
    baud: int | None = None
    """Rate of the simulated UART; None = like a USB port."""
    config: Path | None = None
    overrides: Mapping[str, Value] = field(default_factory=dict)
    seed: int | None = None
    """Of noise and jitter; None = another one each time."""
    compiled: bool = False
    """The devices' side of HBP is the one in C (protocol/c)."""
    store: Path | None = None
    """File in which PARAM_COMMIT keeps the drive's parameters; None = it is refused."""
    awaits: bool = False
    """The device's time begins when the first client is there, or after `AWAITED`."""


def parse_override(text: str) -> tuple[str, Value]:
    """`section.name=value`, the value as in TOML, as a pair for `load_params`.

    Raises:
        ConfigError: not of that form.
    """
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise ConfigError(f"'{text}' is not section.name=value, for example motor.R_s=0.2")
    try:
        parsed: Value = tomllib.loads(f"x = {value}")["x"]
    except (ValueError, KeyError, RecursionError):  # TOMLDecodeError is a ValueError
        raise ConfigError(f"{key.strip()}: '{value}' is not a number or a list of numbers") from None
    return key.strip(), parsed


class Schedule:
    """Which periods are due; times in seconds of any one clock."""

    def __init__(self, pwm_hz: int, now: float) -> None:
        self._pwm_hz = pwm_hz
        self._start = now
        self._done = 0
        self.late = 0
        """How often the delay was more than could be caught up."""
        self.skipped = 0.0
        """Seconds of clock time that were left out then."""

    def behind(self, now: float) -> float:
        """Seconds from the last period that was run to `now`."""
        return now - self._start - self._done / self._pwm_hz

    def due(self, now: float) -> int:
        """Periods to run now."""
        excess = self.behind(now) - MAX_BEHIND
        if excess > 0.0:
            self.late += 1
            self.skipped += excess
            self._start += excess
        n = max(0, int((now - self._start) * self._pwm_hz) - self._done)
        self._done += n
        return n


class Server:
    """One device, one port, one clock: `step` does everything that is due.

    `tell` gets a line, and the host a LOG, when it was kept from its work for more than `LATE`.
    """

    def __init__(
        self, device: SimulatedDevice, port: Port, now: float, baud: int | None = None, tell: Say | None = None
    ) -> None:
        self.device = device
        self.port = port
        self.schedule = Schedule(device.pwm_hz, now)
        self._pacer = None if baud is None else Pacer(baud)
        self._portion = max(1, round(2 * STEP * device.pwm_hz))  # more only where it catches up
        self._pending = b""
        self.full = False
        """Whether the port took only a part of what was to be sent."""
        self._tell = _say_nothing if tell is None else tell
        self._told_late = -math.inf

    def step(self, now: float) -> None:
        """Run the periods that are due at `now`, take what has arrived, send what the port takes."""
        self._look_for_delay(now)
        due = self.schedule.due(now)
        while due > 0:
            n = min(due, self._portion)
            self.device.advance(n)
            due -= n
            if due > 0:
                self._receive()
        self._receive()
        self.send(now)

    def _look_for_delay(self, now: float) -> None:
        behind = self.schedule.behind(now)
        if behind > LATE and now - self._told_late >= LATE_PERIOD:
            self._told_late = now
            text = f"the simulated drive stood still for {behind * 1000:.0f} ms: this machine is too busy"
            self._tell(text)
            self.device.drive.log(WARNING, text)

    def _receive(self) -> None:
        data = self.port.read()
        if data:
            self.device.receive(data)

    def send(self, now: float) -> None:
        """Send what the port takes."""
        free = _WRITE if self._pacer is None else self._pacer.allowance(now)
        self.full = False
        while free > 0:
            if not self._pending:
                self._pending = self.device.data_to_send(free)
                if not self._pending:
                    return
            part = self._pending[:free]
            taken = self.port.write(part)
            self._pending = self._pending[taken:]
            free -= taken
            if self._pacer is not None:
                self._pacer.spend(taken)
            if taken < len(part):
                self.full = True
                return

    def summary(self) -> str:
        """The closing line."""
        device, schedule = self.device, self.schedule
        late = f"late {schedule.late} times ({schedule.skipped:.2f} s skipped)" if schedule.late else "never late"
        return (
            f"stopped after {device.periods} periods: {device.network.frames_sent} frames sent, "
            f"{device.frames_dropped} dropped, {late}{device.network.account()}{self.port.account()}"
        )


def serve(options: ServeOptions, tell: Say) -> None:
    """Serve until SIGINT, SIGTERM, SIGHUP or SIGBREAK.

    `tell` gets `target: …` once it answers; before that, only that it compiles.

    Raises:
        ConfigError: the configuration or an option is wrong.
        LinkError: the port cannot be made.
    """
    params = load_params(options.config, options.overrides, _note)
    port = _make_port(options)
    try:
        network = _make_network(options)
        tell_by(tell)
        if isinstance(port, TcpPort) and port.exposed:
            print(f"warning: {EXPOSED.format(port.target)}", file=sys.stderr, flush=True)
        with _handlers(lambda *_: _stop_at_once(port, tell), _TAKEN):
            device = _make_device(params, options, network, tell)
        received: set[int] = set()
        with _handlers(lambda number, _: received.add(number), _TAKEN):
            tell(f"target: {port.target}")
            tell(
                f"simulated drive (node 1) and load machine (node 2): {len(device.drive.app.channels)} channels at "
                f"{params.clock.pwm_hz / 1000:g} kHz, pid {os.getpid()}, Ctrl-C ends"
            )
            if options.awaits:
                _await_client(port, received)
            server = Server(device, port, time.monotonic(), options.baud, tell)
            _run(server, received, tell)
        tell(server.summary())
    finally:
        port.unplug()


def _note(text: str) -> None:
    print(f"note: {text}", file=sys.stderr, flush=True)


def _say_nothing(line: str) -> None:
    pass


def _run(server: Server, received: set[int], tell: Say) -> None:
    next_step = time.monotonic()
    while not received.intersection(_STOPS):
        left = max(0.0, next_step - time.monotonic())
        rooms = server.port.write_fds() if server.full else []
        arrived, room = _waited(server.port.read_fds(), rooms, left)
        now = time.monotonic()
        if room and not arrived and now < next_step:
            server.send(now)
        else:
            server.step(now)
        if now >= next_step:  # else bytes from the host woke it
            next_step = max(next_step + STEP, now)
        if received.intersection(_PULL):
            received.difference_update(_PULL)
            server.port.unplug()
            tell("unplugged")
        if received.intersection(_PLUG):
            received.difference_update(_PLUG)
            server.port.plug()
            tell(f"target: {server.port.target}")


def _await_client(port: Port, received: set[int]) -> None:
    end = time.monotonic() + AWAITED
    while not received and time.monotonic() < end and not _waited(port.read_fds(), [], STEP)[0]:
        pass


def _waited(readable: list[int], writable: list[int], timeout: float) -> tuple[bool, bool]:
    """Until one can be read or written: whether one can; Windows' `select` takes sockets, and not none."""
    if not readable and not writable:
        time.sleep(timeout)
        return False, False
    read, written, _ = select.select(readable, writable, [], timeout)
    return bool(read), bool(written)


def _stop_at_once(port: Port, tell: Say) -> None:
    """End while it compiles and loads; children that compile end with their input."""
    try:
        port.unplug()
        tell("stopped")
    finally:
        os._exit(0)


@contextmanager
def _handlers(handler: Callable[[int, FrameType | None], object], numbers: Iterable[int]) -> Iterator[None]:
    """Handle these signals so for a while."""
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


def _make_port(options: ServeOptions) -> Port:
    if options.baud is not None and not MIN_BAUD <= options.baud <= MAX_BAUD:
        raise ConfigError(f"baud must be between {MIN_BAUD} and {MAX_BAUD}, got {options.baud}")
    if options.link is not None and options.tcp:
        raise ConfigError("--link needs a pty")
    if options.baud is not None and (options.tcp or options.slcan):
        raise ConfigError("--baud needs a pty; for a CAN bus use --bitrate")
    if not HAS_PTY and not options.tcp:
        wanted = ("--slcan", options.slcan), ("--link", options.link), ("--baud", options.baud), ("--pty", options.pty)
        for option, value in wanted:
            if value:
                raise ConfigError(f"{option}: {NO_PTY}")
        return TcpPort("127.0.0.1", 0)
    if options.slcan:
        from sim.ports.slcan_port import SlcanPort

        check_rates(options.rates)
        check_slcan_rates(options.rates)
        return SlcanPort(options.link, options.rates, options.extended)
    if options.tcp is not None:
        return TcpPort(*split_host_port(options.tcp))
    return PtyPort(options.link, options.baud)


def check_rates(rates: BusRates) -> None:
    """Raise ConfigError for bit rates that no CAN bus has."""
    if not MIN_BITRATE <= rates.bitrate <= MAX_BITRATE:
        raise ConfigError(f"bitrate must be between {MIN_BITRATE} and {MAX_BITRATE} bit/s, got {rates.bitrate}")
    data = rates.data_bitrate
    if data is not None and not rates.bitrate <= data <= MAX_DATA_BITRATE:
        raise ConfigError(
            f"data bitrate must be between the bitrate, {rates.bitrate}, and {MAX_DATA_BITRATE} bit/s, got {data}"
        )


def check_slcan_rates(rates: BusRates) -> None:
    """Raise ConfigError for bit rates that no slcan command sets."""
    from protocol.canmap.slcan import BITRATES, DATA_BITRATES

    for name, rate, known in (
        ("bitrate", rates.bitrate, BITRATES),
        ("data bitrate", rates.data_bitrate, DATA_BITRATES),
    ):
        if rate is not None and rate not in known:
            raise ConfigError(f"{name} {rate} is not an slcan rate: {', '.join(map(str, sorted(known)))}")


def _make_network(options: ServeOptions) -> Network:
    from protocol.device.compiled import CompiledLink, NoCompiler
    from protocol.device.session import DeviceLink
    from sim.ports.networks import ByteNetwork, CanNetwork

    capacity = None if options.baud is None else options.baud / BITS_PER_CHARACTER
    room = TX_BYTES if capacity is None else min(TX_BYTES, max(MIN_TX_BYTES, round(0.3 * capacity)))
    try:
        if options.slcan:
            return CanNetwork(options.rates, options.extended, compiled=options.compiled)
        if options.compiled:
            return ByteNetwork(CompiledLink(room, capacity))
    except NoCompiler as why:
        raise ConfigError(f"--device c: {why}") from None
    return ByteNetwork(DeviceLink(TxQueue(room, capacity=capacity)))


def _make_device(params: BenchParams, options: ServeOptions, network: Network, tell: Say) -> SimulatedDevice:
    from sim.ports.device import SimulatedDevice, compile_all, random_boot_id  # numba

    compile_all()
    return SimulatedDevice(
        params,
        random_boot_id() if options.seed is None else options.seed,
        boot_id=random_boot_id(),
        store=options.store,
        network=network,
        notice=tell,
    )
