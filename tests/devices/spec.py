"""The numbers of protocol/SPEC.md under the names of this device, and what a refusal is.

The numbers themselves are held by the vectors and by the tables of SPEC.md; what a device does with them is not taken
from `protocol`.
"""

from __future__ import annotations

from protocol.codes import Command, Fault, Feature, Role
from protocol.codes import DriveState as State
from protocol.codes import ErrorCode as Code
from protocol.codes import EventCode as Event
from protocol.codes import MessageType as Type
from protocol.codes import SetpointMode as Mode
from protocol.codes import StreamEvent as Source
from protocol.framing import ERROR, MAJOR, MAX_PAYLOAD, REPLY
from protocol.framing import Frame as Message
from protocol.signals import Flag, Unit
from protocol.signals import RawType as Raw

__all__ = [
    "ERROR", "HALL_CODES", "MAJOR", "MAX_PAYLOAD", "REPLY", "Code", "Command", "Event", "Fault", "Feature", "Flag",
    "Message", "Mode", "Raw", "Refusal", "Role", "Source", "State", "Type", "Unit",
]  # fmt: skip

HALL_CODES = (1, 3, 2, 6, 4, 5)
"""By sector of the electrical angle."""


class Refusal(Exception):
    """A request is refused with this code and detail."""

    def __init__(self, code: int, detail: float = 0.0) -> None:
        super().__init__(code, detail)
        self.code, self.detail = code, detail
