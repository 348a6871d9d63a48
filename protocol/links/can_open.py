"""Opening and shutting down a bus of python-can's, and what is said of the errors that its drivers raise.

An adapter whose bit rates are python-can's to set is always told them, so that it runs at those that we assume. This
module reads and sends no frame.
"""

from __future__ import annotations

import errno
import logging
import re
import socket
from collections.abc import Callable, Mapping
from configparser import ConfigParser
from contextlib import suppress
from inspect import signature
from typing import Any

import can
from can.interfaces import VALID_INTERFACES
from can.interfaces.socketcand import SocketCanDaemonBus
from can.interfaces.virtual import VirtualBus
from can.typechecking import BitTimingDict, BitTimingFdDict
from can.util import load_config, load_environment_config, load_file_config

from protocol.canmap.frame import BusRates
from protocol.errors import HbpError, LinkBusy, LinkClosed, LinkError, LinkNotFound, TargetError
from protocol.links.slcan_bus import SlcanBus, SlcanOptions
from protocol.links.target import CAN_KEYS, DEFAULT_BITRATE, DEFAULT_DATA_BITRATE, CanTarget
from protocol.text import did_you_mean

OPEN_TIMEOUT = 3.0
"""Seconds that a socketcand server may take to answer."""

_RATES_ELSEWHERE = frozenset({"socketcan", "socketcand", "udp_multicast", "virtual"})  # by `ip link`, or there are none
_FD_BY_TIMING = frozenset({"pcan", "kvaser"})  # these take most FD bit rates only as timing at 80 MHz
_FD_CLOCK = 80_000_000
_SAMPLE_POINT = 80.0  # %

_SWITCHES = ("fd", "listen_only", "receive_own_messages", "rtscts")
_BOUNDED: Mapping[str, Callable[..., object]] = {
    "slcan": SlcanOptions,
    "socketcand": SocketCanDaemonBus,
    "virtual": VirtualBus,
}  # of these we know every key; python-can's own ignore one that they do not know
_RATE_KEYS = frozenset({"bitrate", "data_bitrate", "fd", "timing"})
_TIMING_KEYS = frozenset(BitTimingDict.__annotations__) | frozenset(BitTimingFdDict.__annotations__)

logging.getLogger("can").addHandler(logging.NullHandler())  # python-can's reports go nowhere unless asked for


def bus_arguments(target: CanTarget) -> dict[str, Any]:
    """Return python-can's arguments for a target, completed from its configuration files and environment.

    The bit rates are among them, the usual ones if need be, unless `timing` is, or they are not python-can's to set.
    Keys of a configuration that the target's interface does not know are left out.

    Raises:
        TargetError: no such interface, none named at all, no such context, a key that slcan, socketcand or python-can's
            virtual bus does not know, or a configuration that cannot be read.
    """
    given: dict[str, Any] = dict(target.options)
    if target.interface is not None:
        given["interface"] = target.interface
    if target.channel is not None:
        given["channel"] = target.channel
    try:
        _read_switches(target, given)
        arguments: dict[str, Any] = dict(load_config(config=given, context=target.context))
        _check_values(arguments)
        _check_keys(target, arguments)
        _complete_rates(arguments)
    except HbpError:
        raise
    except can.CanInterfaceNotImplementedError as error:
        raise _unknown_interface(target, str(error).split('"')[1]) from None
    except Exception as error:  # JSON, INI syntax, values
        raise TargetError(f"{target}: python-can does not accept this configuration: {one_line(error)}") from None
    return arguments


def _read_switches(target: CanTarget, given: dict[str, Any]) -> None:
    """Add the switches of python-can's configuration to what is given: it would take any word for yes."""
    context = target.context
    by_context = [{}, {}] if context is None else [load_environment_config(context), load_file_config(section=context)]
    if context is not None and not any(by_context):
        raise TargetError(
            f"{target}: python-can's configuration has no context '{context}': "
            f"no section [{context}] in can.conf, and no variable CAN_INTERFACE_{context}"
        )
    sources: list[Mapping[str, Any]] = [given, can.rc, by_context[0], load_environment_config(), by_context[1]]
    sources.append(load_file_config())
    for key in _SWITCHES:
        for source in sources:  # the first one counts
            if key in source:
                value = str(source[key])
                if value.lower() not in ConfigParser.BOOLEAN_STATES:
                    raise ValueError(f"{key} must be yes or no, got '{value}'")
                given[key] = ConfigParser.BOOLEAN_STATES[value.lower()]
                break


def _check_values(arguments: Mapping[str, Any]) -> None:
    for key in ("bitrate", "data_bitrate"):
        value = arguments.get(key)
        if value is not None and (type(value) is not int or value <= 0):
            raise ValueError(f"{key} must be a whole number of bit/s, got '{value}'")
    timing = arguments.get("timing")
    if timing is not None and not isinstance(timing, (can.BitTiming, can.BitTimingFd)):
        raise ValueError(f"timing cannot be text, got '{timing}': give {', '.join(BitTimingDict.__annotations__)}")


def _check_keys(target: CanTarget, arguments: dict[str, Any]) -> None:
    """Refuse the target's keys that its interface does not know, and take those of the configuration out."""
    interface = arguments["interface"]
    if interface not in _BOUNDED:
        return
    known = {*signature(_BOUNDED[interface]).parameters, *_RATE_KEYS} - {"kwargs"}
    foreign = arguments.keys() - known - {"interface", "channel"}
    if "timing" in arguments:  # made of these
        foreign -= _TIMING_KEYS
        for key in _TIMING_KEYS & arguments.keys():
            del arguments[key]
    for key in sorted(foreign):
        if target.interface is None or key in dict(target.options):
            keys = f"known: {', '.join(sorted(known - {'channel'}))}"
            hint = did_you_mean(key, sorted({*known, *CAN_KEYS}), keys)
            raise TargetError(f"{target}: the interface {interface} has no key '{key}': {hint}")
        del arguments[key]


def _complete_rates(arguments: dict[str, Any]) -> None:
    """Add the bit rates that nothing has set, as timing for drivers that take no others."""
    rates = bus_rates(arguments)
    if arguments["interface"] in _FD_BY_TIMING and rates.fd and "timing" not in arguments:
        with suppress(ValueError):  # no such timing: the driver will say so
            arguments["timing"] = can.BitTimingFd.from_sample_point(
                _FD_CLOCK, rates.bitrate, _SAMPLE_POINT, rates.data_bitrate or rates.bitrate, _SAMPLE_POINT
            )
    if arguments["interface"] in _RATES_ELSEWHERE or "timing" in arguments:
        return
    arguments["bitrate"] = rates.bitrate
    arguments.pop("data_bitrate", None)
    if rates.fd:
        arguments["data_bitrate"] = rates.data_bitrate


def _unknown_interface(target: CanTarget, name: str) -> TargetError:
    if name == "None":
        return TargetError(
            f"{target}: no CAN interface is named, nor does python-can's configuration name one: "
            "write can:socketcan/can0, or set CAN_INTERFACE and CAN_CHANNEL"
        )
    hint = did_you_mean(name, VALID_INTERFACES, f"known: {', '.join(sorted(VALID_INTERFACES))}")
    return TargetError(f"{target}: python-can has no interface '{name}': {hint}")


def bus_rates(arguments: dict[str, Any]) -> BusRates:
    """Return the bit rates that python-can's arguments mean; the usual ones where they say nothing."""
    timing = arguments.get("timing")
    if isinstance(timing, can.BitTimingFd):
        return BusRates(timing.nom_bitrate, timing.data_bitrate)
    if isinstance(timing, can.BitTiming):
        return BusRates(timing.bitrate)
    bitrate = int(arguments.get("bitrate") or DEFAULT_BITRATE)
    if not arguments.get("fd"):
        return BusRates(bitrate)
    return BusRates(bitrate, int(arguments.get("data_bitrate") or DEFAULT_DATA_BITRATE))


def open_bus(name: str, arguments: dict[str, Any]) -> can.BusABC:
    """Open the bus, slcan by our own. It raises what the driver raises: `cannot_open` makes our error of it."""
    interface = arguments["interface"]
    if interface == "slcan":
        others = {key: value for key, value in arguments.items() if key not in ("interface", "channel")}
        return SlcanBus(str(arguments["channel"] or ""), **others)
    if interface == "socketcand":
        _meet_socketcand(name, arguments)
    return can.Bus(ignore_config=True, **arguments)


def _meet_socketcand(name: str, arguments: dict[str, Any]) -> None:
    """Look whether a socketcand server is there: python-can tries for 10 s and then waits for its greeting for ever."""
    if arguments["channel"] is None:
        raise TargetError(f"{name} names no bus of the server: write can:socketcand/can0?host=10.0.0.5&port=29536")
    if arguments.get("fd"):
        raise TargetError(
            f"{name}: python-can's socketcand has no CAN FD frames: leave fd out, or use another interface"
        )
    host, port = arguments.get("host"), arguments.get("port")
    if host is None or port is None:
        raise TargetError(f"{name} names no server: write {name}?host=10.0.0.5&port=29536")
    place = f"port {port} of {host}"
    try:
        with socket.create_connection((str(host), port), OPEN_TIMEOUT) as connection:
            greeting = connection.recv(16)
    except ConnectionRefusedError:
        raise LinkNotFound(f"{name}: nothing listens on {place}: is socketcand running?") from None
    except TimeoutError:
        raise LinkNotFound(f"{name}: no answer from {place} within {OPEN_TIMEOUT:g} s") from None
    except (OSError, UnicodeError) as error:
        raise LinkNotFound(f"{name}: cannot reach {place}: {one_line(error)}") from None
    if not greeting or not b"< hi >".startswith(greeting[:6]):
        raise LinkNotFound(f"{name}: the server on {place} is not socketcand")


def shut_down(bus: can.BusABC) -> None:
    """Let go of a bus, also of one that has gone."""
    with suppress(Exception):
        bus.shutdown()


_GONE = frozenset(
    {
        errno.EBADF,
        errno.ECONNABORTED,
        errno.ECONNRESET,
        errno.EIO,
        errno.ENETDOWN,
        errno.ENODEV,
        errno.ENOTCONN,
        errno.ENXIO,
        errno.EPIPE,
    }
)


def _errno(error: BaseException) -> int | None:
    """The system's number of an error; python-can keeps it in the cause, and in `error_code` among the drivers' own."""
    for each in (error, error.__cause__):
        if isinstance(each, OSError) and each.errno is not None:
            return each.errno
    return None


def is_gone(error: BaseException) -> bool:
    """Whether the adapter or the connection is lost, and no single frame refused."""
    return _errno(error) in _GONE or isinstance(error.__context__, LinkClosed)


def is_full(error: BaseException) -> bool:
    """Whether the transmit buffer had no room for a frame."""
    return _errno(error) in (errno.ENOBUFS, errno.EAGAIN) or re.search(r"full|overflow", str(error), re.I) is not None


def one_line(error: BaseException) -> str:
    """Return the first line of what an error says, without a full stop; its class where it says nothing."""
    lines = str(error).strip().splitlines()
    return lines[0].strip().rstrip(".") if lines else type(error).__name__


def remedy(name: str, error: BaseException) -> str:
    """Return what to do about a system error on the link `name`, to be appended; "" where that is not known."""
    number = _errno(error)
    channel = name.rpartition("/")[2]
    if number == errno.ENETDOWN:
        return f": bring it up with `ip link set {channel} up`"
    if number == errno.EAFNOSUPPORT:
        return ": this kernel has no CAN: modprobe can_raw"
    if number == errno.ENODEV:
        return ": `ip link` lists the interfaces"
    return ""


def cannot_open(name: str, interface: str, error: Exception) -> HbpError:
    """Return our error for what a driver raised while a bus was opened."""
    text = one_line(error)
    if isinstance(error.__context__, LinkError):  # our own slcan knows best
        return type(error.__context__)(f"{name}: {text}")
    if isinstance(error, (TypeError, ValueError)):
        return TargetError(f"{name}: python-can's interface {interface} refuses these options: {text}")
    if interface == "socketcand" and "could not open bus" in text:
        return LinkNotFound(f"{name}: the server has no bus {name.rpartition('/')[2]}")
    number = _errno(error)
    if number in (errno.EACCES, errno.EPERM):
        return LinkError(f"{name}: no permission: {text}: add your user to the device's group (often dialout)")
    if number in (errno.EBUSY, errno.EAGAIN) or re.search(r"\bbusy\b|\bin use\b|exclusively lock", text, re.I):
        return LinkBusy(f"{name} is held by another program ({text}): close it and try again")
    if isinstance(error, NameError):  # python-can's Kvaser without Kvaser's library
        text = "its library is missing"
    advice = remedy(name, error) or ": is the adapter plugged in and its driver installed?"
    return LinkNotFound(f"{name} cannot be opened: {text}{advice}")
