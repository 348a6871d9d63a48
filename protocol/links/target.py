"""Target strings, which name a link: `serial:/dev/ttyACM0?baud=3000000`, `tcp:127.0.0.1:7000`, `can:socketcan/can0`.

This module only reads and writes the strings; it opens nothing, and so does not know which CAN interfaces there are.
"""

from __future__ import annotations

import re
import socket
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Self

from protocol.errors import TargetError
from protocol.text import did_you_mean, either

_COM = re.compile(r"(?:\\\\\.\\)?(COM\d+)", re.IGNORECASE)  # a serial port of Windows

if TYPE_CHECKING:
    from protocol.canmap.frame import BusRates

DEFAULT_BAUD = 115200
MIN_BAUD = 300
MAX_BAUD = 50_000_000
MAX_OPEN_DELAY = 60

DEFAULT_BITRATE = 1_000_000
DEFAULT_DATA_BITRATE = 5_000_000
MIN_BITRATE = 5_000
MAX_BITRATE = 1_000_000
MAX_DATA_BITRATE = 20_000_000
DEFAULT_NODE = 1
MAX_NODE = 15
MAX_HOST = 15

CAN_KEYS = ("node", "ext", "context", "host_number")
"""Our own keys of a CAN target; of the others python-can knows which there are."""


class Target(ABC):
    """What names a link. To add one, write a subclass here and its link: defining it makes it known everywhere."""

    scheme: ClassVar[str]
    """What its strings begin with, before the colon."""
    form: ClassVar[str]
    """How they look, for help and errors."""
    example: ClassVar[str]
    link: ClassVar[str]
    """Module and class of the `Link` that it opens, which is made of a target; loaded when one is opened."""
    kinds: ClassVar[dict[str, type[Target]]] = {}
    """All that there are, by scheme."""

    def __init_subclass__(cls) -> None:
        cls.kinds[cls.scheme] = cls

    @classmethod
    @abstractmethod
    def read(cls, text: str, address: str, options: Mapping[str, str]) -> Self:
        """The target `text`, whose part after the scheme is `address` with `options`. Raises TargetError."""

    @staticmethod
    def here() -> list[str]:
        """Targets of this kind that are on this machine, or how they begin: what a shell completes."""
        return []

    @property
    def place(self) -> str:
        """Where one program may be at a time: the same for all ways to write it."""
        return str(self).partition("?")[0]


@dataclass(frozen=True, slots=True)
class SerialTarget(Target):
    """A serial port and its rate in baud (a USB port of a microcontroller ignores the rate)."""

    scheme = "serial"
    form = "serial:PORT"
    example = "serial:/dev/ttyACM0?baud=3000000"
    link = "protocol.links.serial.SerialLink"

    port: str
    baud: int = DEFAULT_BAUD
    open_delay: float = 0.0
    """s after opening in which nothing is sent: to a boot loader that takes the first byte for its own."""

    @classmethod
    def read(cls, text: str, address: str, options: Mapping[str, str]) -> Self:
        """See `Target.read`."""
        _allow(text, options, ("baud", "open_delay"))
        if not address:
            raise TargetError(f"target '{text}' names no port: write serial:/dev/ttyACM0")
        baud = _whole(text, options, "baud", DEFAULT_BAUD, MIN_BAUD, MAX_BAUD)
        return cls(address, baud, _seconds(text, options, "open_delay", MAX_OPEN_DELAY))

    @staticmethod
    def here() -> list[str]:
        """See `Target.here`."""
        return [f"serial:{port}" for port in _ports()]

    @property
    def place(self) -> str:
        """See `Target.place`: the device, whatever links lead there."""
        return _place_of(self.port)

    def __str__(self) -> str:
        given = {"baud": (self.baud, DEFAULT_BAUD), "open_delay": (self.open_delay, 0.0)}
        query = "&".join(f"{key}={value:.12g}" for key, (value, usual) in given.items() if value != usual)
        return f"serial:{self.port}" + (f"?{query}" if query else "")


@dataclass(frozen=True, slots=True)
class TcpTarget(Target):
    """A TCP server."""

    scheme = "tcp"
    form = "tcp:HOST:PORT"
    example = "tcp:127.0.0.1:7000"
    link = "protocol.links.tcp.TcpLink"

    host: str
    port: int

    @classmethod
    def read(cls, text: str, address: str, options: Mapping[str, str]) -> Self:
        """See `Target.read`."""
        _allow(text, options, ())
        try:
            return cls(*split_host_port(address, lowest=1))
        except TargetError as error:
            raise TargetError(f"target '{text}': {error}") from None

    @staticmethod
    def here() -> list[str]:
        """See `Target.here`."""
        return ["tcp:127.0.0.1:"]

    @property
    def place(self) -> str:
        """See `Target.place`; names are not looked up."""
        host = self.host.lower()
        return f"tcp:{join_host_port('127.0.0.1' if host == 'localhost' else host, self.port)}"

    def __str__(self) -> str:
        return f"tcp:{join_host_port(self.host, self.port)}"


@dataclass(frozen=True, slots=True)
class CanTarget(Target):
    """A node on a CAN bus that python-can reaches; what is None is left to python-can's configuration."""

    scheme = "can"
    form = "can:INTERFACE/CHANNEL"
    example = "can:socketcan/can0"
    link = "protocol.links.can.CanLink"

    interface: str | None = None
    """python-can's name of the kind of adapter, for example `socketcan`."""
    channel: str | None = None
    options: tuple[tuple[str, str], ...] = ()
    """What python-can is given besides, as written: `bitrate`, `fd`, `host`, …"""
    node: int = DEFAULT_NODE
    extended: bool = False
    """29-bit identifiers (key `ext`)."""
    context: str | None = None
    """Section of python-can's configuration."""
    host: int = 0
    """Number of this host among those on the bus."""

    @classmethod
    def read(cls, text: str, address: str, options: Mapping[str, str]) -> Self:
        """See `Target.read`."""
        interface, _, channel = address.partition("/")
        if channel.startswith("dev/"):
            channel = f"/{channel}"
        for key in ("interface", "channel"):
            if key in options:
                raise TargetError(f"target '{text}': {key} is not an option: write can:INTERFACE/CHANNEL before the ?")
        bitrate = _whole(text, options, "bitrate", DEFAULT_BITRATE, MIN_BITRATE, MAX_BITRATE)
        if not _whole(text, options, "fd", 0, 0, 1) and "data_bitrate" in options:
            raise TargetError(f"target '{text}': data_bitrate needs CAN FD: add fd=1")
        _whole(text, options, "data_bitrate", DEFAULT_DATA_BITRATE, bitrate, MAX_DATA_BITRATE)
        others = tuple((key, value) for key, value in options.items() if key not in CAN_KEYS)
        node = _whole(text, options, "node", DEFAULT_NODE, 1, MAX_NODE)
        extended = bool(_whole(text, options, "ext", 0, 0, 1))
        host = _whole(text, options, "host_number", 0, 0, MAX_HOST)
        return cls(interface or None, channel or None, others, node, extended, options.get("context"), host)

    @staticmethod
    def here() -> list[str]:
        """See `Target.here`; serial ports are also those of slcan adapters."""
        buses = [f"can:socketcan/{name}" for _, name in socket.if_nameindex() if "can" in name]
        return buses + [f"can:slcan/{port}" for port in _ports()]

    @property
    def place(self) -> str:
        """See `Target.place`: the bus, or the serial port of its adapter."""
        if self.channel is not None and (self.channel.startswith("/") or _COM.fullmatch(self.channel)):
            return _place_of(self.channel)
        return super(CanTarget, self).place  # a dataclass with slots is not the class that `super()` knows

    @property
    def rates(self) -> BusRates:
        """The bit rates that the options give, or the usual ones."""
        from protocol.canmap.frame import BusRates  # numpy costs 70 ms: only those who need it pay

        given = dict(self.options)
        data = int(given.get("data_bitrate", DEFAULT_DATA_BITRATE)) if given.get("fd", "0") != "0" else None
        return BusRates(int(given.get("bitrate", DEFAULT_BITRATE)), data)

    def __str__(self) -> str:
        place = (self.interface or "") + (f"/{self.channel}" if self.channel is not None else "")
        values, usual = (self.node, int(self.extended), self.context, self.host), (DEFAULT_NODE, 0, None, 0)
        own = ((key, value) for key, value, other in zip(CAN_KEYS, values, usual, strict=True) if value != other)
        query = "&".join(f"{key}={value}" for key, value in (*self.options, *own))
        return f"can:{place}" + (f"?{query}" if query else "")


def parse_target(text: str) -> Target:
    """Read a target string.

    Raises:
        TargetError: the string names no link; the message quotes the part at fault and what is allowed there.
    """
    scheme, colon, rest = text.partition(":")
    if not colon or scheme not in Target.kinds:
        if text.startswith("/") or text.upper().startswith("COM"):
            raise TargetError(f"target '{text}' has no scheme: write serial:{text}")
        forms = f"write {either(kind.example for kind in Target.kinds.values())}"
        hint = did_you_mean(scheme, Target.kinds if colon else (), forms, "did you mean {}:?")
        raise TargetError(f"unknown target '{text}': {hint}")
    address, _, query = rest.partition("?")
    return Target.kinds[scheme].read(text, address, _read_options(text, query))


def split_host_port(text: str, lowest: int = 0) -> tuple[str, int]:
    """`host:port` or `[ipv6]:port` as a pair.

    Raises:
        TargetError: not of that form, or a port outside `lowest`..65535.
    """
    host, colon, port = text.rpartition(":")
    if host.startswith("[") and host.endswith("]"):
        host = host[1:-1]
    elif ":" in host:
        raise TargetError(f"'{text}': write an IPv6 address in brackets, [{host}]:{port}")
    if not colon or not host:
        raise TargetError(f"'{text}' is not HOST:PORT, for example 127.0.0.1:7000")
    if not port.isascii() or not port.isdigit() or not lowest <= int(port) <= 65535:
        raise TargetError(f"'{text}': the port must be a whole number from {lowest} to 65535, got '{port}'")
    return host, int(port)


def join_host_port(host: str, port: int) -> str:
    """The inverse of `split_host_port`."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def _read_options(text: str, query: str) -> dict[str, str]:
    options: dict[str, str] = {}
    for item in filter(None, query.split("&")):
        key, equals, value = item.partition("=")
        if not equals or not value:
            raise TargetError(f"target '{text}': '{item}' is not key=value")
        if key in options:
            raise TargetError(f"target '{text}' gives {key} twice")
        options[key] = value
    return options


def _place_of(port: str) -> str:
    """Of a serial port: Windows has three ways to write each of its own."""
    com = _COM.fullmatch(port)
    return com[1].upper() if com else str(Path(port).resolve())


def _allow(text: str, options: Mapping[str, str], allowed: tuple[str, ...]) -> None:
    for key in options:
        if key not in allowed:
            known = f"known: {', '.join(allowed)}" if allowed else "a target of this kind has none"
            raise TargetError(f"target '{text}': unknown key '{key}' ({known})")


def _whole(text: str, options: Mapping[str, str], key: str, default: int, lowest: int, highest: int) -> int:
    value = options.get(key, str(default))
    if not value.isascii() or not value.isdigit() or not lowest <= int(value) <= highest:
        raise TargetError(f"target '{text}': {key} must be a whole number from {lowest} to {highest}, got '{value}'")
    return int(value)


def _seconds(text: str, options: Mapping[str, str], key: str, highest: float) -> float:
    value = options.get(key, "0")
    if not re.fullmatch(r"\d+(\.\d*)?", value, re.ASCII) or float(value) > highest:
        raise TargetError(f"target '{text}': {key} must be a number of seconds from 0 to {highest:g}, got '{value}'")
    return float(value)


def _ports() -> list[str]:
    from serial.tools import list_ports  # pyserial costs 20 ms

    return [port.device for port in list_ports.comports()]
