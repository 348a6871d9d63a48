"""Every error that the protocol and its links raise, as one tree.

    HbpError                  all of the below
    ├─ LocalProtocolError     this side broke the rules: a bug of ours or a value that cannot be sent
    ├─ RemoteProtocolError    the other side broke the rules in a way that ends the conversation
    │  ├─ VersionError        no protocol major in common
    │  └─ DeviceDefect        what the device says of itself cannot be: its firmware must be mended
    ├─ Refused                the device understood and said no; carries its code and number
    ├─ NoReply                a request stayed unanswered after every retry
    ├─ TargetError            a target string that cannot be read
    └─ LinkError              the link itself
       ├─ LinkNotFound        no such port, host or interface
       ├─ LinkBusy            held by another program
       └─ LinkClosed          gone while in use: unplugged, closed by the peer

Damaged frames are not errors: they are counted (`FramingCounters`) and the sender's retry recovers them.
Messages name the thing and the number, in one line, and say what to do where that is known.
"""


class HbpError(Exception):
    """Root of the tree. `str(error)` is one line that can be shown to a user."""


class LocalProtocolError(HbpError):
    """This side asked for something that the protocol does not allow."""


class RemoteProtocolError(HbpError):
    """The other side sent something that the protocol does not allow and that cannot be skipped."""


class VersionError(RemoteProtocolError):
    """The two sides have no protocol major version in common."""


class DeviceDefect(RemoteProtocolError):
    """The device says something of itself that a host cannot work with. `what` names it, and the number."""

    def __init__(self, what: str) -> None:
        super().__init__(f"{what}: fix the firmware")


class Refused(HbpError):
    """The device refused a request.

    `code` is a `protocol.messages.ErrorCode`, `detail` the number that the device gave with it
    (its meaning depends on the code: the limit, the largest value that would fit, …).
    """

    def __init__(self, message: str, code: int, detail: float = 0.0) -> None:
        super().__init__(message)
        self.code = code
        self.detail = detail


class NoReply(HbpError):
    """A request stayed unanswered after every retry."""


class TargetError(HbpError):
    """A target string that cannot be read."""


class LinkError(HbpError):
    """The link failed."""


class LinkNotFound(LinkError):
    """No such port, host or interface."""


class LinkBusy(LinkError):
    """The port is held by another program."""


class LinkClosed(LinkError):
    """The link went away while in use."""
