"""Target strings, which name a link: `serial:/dev/ttyACM0?baud=3000000`, `tcp:127.0.0.1:7000`.

This module only reads and writes the strings; it opens nothing.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from protocol.errors import TargetError

DEFAULT_BAUD = 115200
MIN_BAUD = 300
MAX_BAUD = 50_000_000

_FORMS = "serial:/dev/ttyACM0?baud=3000000 or tcp:127.0.0.1:7000"


@dataclass(frozen=True, slots=True)
class SerialTarget:
    """A serial port and its rate in baud (a USB port of a microcontroller ignores the rate)."""

    port: str
    baud: int = DEFAULT_BAUD

    def __str__(self) -> str:
        return f"serial:{self.port}" + (f"?baud={self.baud}" if self.baud != DEFAULT_BAUD else "")


@dataclass(frozen=True, slots=True)
class TcpTarget:
    """A TCP server."""

    host: str
    port: int

    def __str__(self) -> str:
        return f"tcp:{join_host_port(self.host, self.port)}"


Target = SerialTarget | TcpTarget


def parse_target(text: str) -> Target:
    """Read a target string.

    Raises:
        TargetError: the string names no link; the message quotes the part at fault and what is allowed there.
    """
    scheme, colon, rest = text.partition(":")
    if not colon or scheme not in _PARSERS:
        if text.startswith("/") or text.upper().startswith("COM"):
            raise TargetError(f"target '{text}' has no scheme: write serial:{text}")
        near = difflib.get_close_matches(scheme, _PARSERS, 1) if colon else []
        hint = f"did you mean {near[0]}:?" if near else f"write {_FORMS}"
        raise TargetError(f"unknown target '{text}': {hint}")
    address, _, query = rest.partition("?")
    return _PARSERS[scheme](text, address, _read_options(text, query))


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


def _allow(text: str, options: Mapping[str, str], allowed: tuple[str, ...]) -> None:
    for key in options:
        if key not in allowed:
            known = f"the known one is {', '.join(allowed)}" if allowed else "a target of this kind has none"
            raise TargetError(f"target '{text}': unknown key '{key}' ({known})")


def _parse_serial(text: str, port: str, options: Mapping[str, str]) -> SerialTarget:
    _allow(text, options, ("baud",))
    if not port:
        raise TargetError(f"target '{text}' names no port: write serial:/dev/ttyACM0")
    value = options.get("baud", str(DEFAULT_BAUD))
    if not value.isascii() or not value.isdigit() or not MIN_BAUD <= int(value) <= MAX_BAUD:
        raise TargetError(f"target '{text}': baud must be a whole number from {MIN_BAUD} to {MAX_BAUD}, got '{value}'")
    return SerialTarget(port, int(value))


def _parse_tcp(text: str, address: str, options: Mapping[str, str]) -> TcpTarget:
    _allow(text, options, ())
    try:
        return TcpTarget(*split_host_port(address, lowest=1))
    except TargetError as error:
        raise TargetError(f"target '{text}': {error}") from None


_PARSERS: dict[str, Callable[[str, str, Mapping[str, str]], Target]] = {
    "serial": _parse_serial,
    "tcp": _parse_tcp,
}
