"""The serial ports and CAN interfaces of this machine, as targets. Opens none of them."""

from __future__ import annotations

import logging
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

from protocol.links.target import SerialTarget, parse_target

_NO_ADAPTERS = {"virtual", "udp_multicast", "serial", "slcan", "socketcand"}
"""Interfaces of python-can that have no adapter to find, or only serial ports, which are listed anyway."""

_DETECTION = 2.0  # s
BY_ID = Path("/dev/serial/by-id")
"""Where Linux has names of serial ports that stay when they are plugged in in another order."""


def places() -> list[dict[str, Any]]:
    """All of them, serial ports first: `target`, `description`, `manufacturer`, `serial_number`, `usb_id`."""
    return [*_serial_ports(), *_can_interfaces()]


def _serial_ports() -> list[dict[str, Any]]:
    from serial.tools import list_ports  # pyserial costs 20 ms: only those who need it pay

    return [
        {
            "target": f"serial:{port.device}",
            "description": port.description if port.description != "n/a" else "",
            "manufacturer": port.manufacturer or "",
            "serial_number": port.serial_number or "",
            "usb_id": f"{port.vid:04x}:{port.pid:04x}" if port.vid is not None and port.pid is not None else "",
        }
        for port in sorted(list_ports.comports())
    ]


def _can_interfaces() -> list[dict[str, Any]]:
    import can

    logging.getLogger("can").setLevel(logging.CRITICAL)  # it tells of each driver that is not installed
    found = can.detect_available_configs(sorted(can.VALID_INTERFACES - _NO_ADAPTERS), timeout=_DETECTION)
    return [
        {
            "target": f"can:{config['interface']}/{config['channel']}",
            "description": f"CAN by {config['interface']}",
            "manufacturer": "",
            "serial_number": str(config.get("serial", "") or config.get("unique_hardware_id", "") or ""),
            "usb_id": "",
        }
        for config in found
    ]


def lasting(target: str, links: Path = BY_ID) -> str:
    """The same target by the name of its port in the folder `links`, if it has one there; else as it is."""
    named = parse_target(target)
    if not isinstance(named, SerialTarget) or not links.is_dir():
        return target
    port = os.path.realpath(named.port)
    names = sorted(str(link) for link in links.iterdir() if os.path.realpath(link) == port)
    return str(replace(named, port=names[0])) if names else target
