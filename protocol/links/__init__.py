"""Links to a device: serial ports, TCP, CAN. `open_link("tcp:127.0.0.1:7000")` opens one."""

from __future__ import annotations

from importlib import import_module

from protocol.links.base import Link
from protocol.links.target import CanTarget, SerialTarget, Target, TcpTarget, parse_target

__all__ = ["CanTarget", "Link", "SerialTarget", "Target", "TcpTarget", "open_link", "parse_target"]


def open_link(target: str | Target) -> Link:
    """Open the link that a target names.

    Raises:
        TargetError: the target cannot be read, or asks for what the port cannot do.
        LinkError: it cannot be opened (`LinkNotFound`, `LinkBusy`, …).
    """
    named = parse_target(target) if isinstance(target, str) else target
    module, _, name = named.link.rpartition(".")  # pyserial costs 20 ms, python-can 90: only those who need it pay
    link: Link = getattr(import_module(module), name)(named)
    return link
