"""Links to a device: serial ports, TCP, CAN. `open_link("tcp:127.0.0.1:7000")` opens one."""

from __future__ import annotations

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
    if isinstance(named, SerialTarget):
        from protocol.links.serial import SerialLink  # pyserial costs 20 ms: only those who need it pay

        return SerialLink(named)
    if isinstance(named, CanTarget):
        from protocol.links.can import CanLink  # and python-can 90 ms

        return CanLink(named)
    from protocol.links.tcp import TcpLink

    return TcpLink(named)
