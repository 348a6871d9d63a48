"""Errors of the bench that are the user's to mend; each is one line that says what to do.

What the protocol and its links raise stands in `protocol.errors`.
"""

from enum import IntEnum


class ExitCode(IntEnum):
    """How `bench` ends; a signal is 128 + its number. README has the same table."""

    DONE = 0
    FAILED = 1
    """The drive tripped, failed or behaved implausibly, or the link was lost for good."""
    ERROR = 2
    """A wrong argument, or an error."""
    NOT_RECORDED = 3
    NO_VIEWER = 4
    OUTPUTS_MAY_BE_ON = 5
    INCOMPLETE = 6
    """Not everything could be tested."""
    NO_READER = 141
    """The output pipe was closed."""


UNSAFE = "OUTPUTS MAY STILL BE ON: cut the power"
"""What `OutputsMayBeOn` begins with."""


class BenchError(Exception):
    """Something that the user can mend. `str(error)` is the whole story, in one line."""

    exit_code: int = ExitCode.ERROR


class NodeError(BenchError):
    """A device on the link would not do what it was told."""


class SeveralDevices(NodeError):
    """More than one device answers as one node: none of them is told anything but STOP."""


class DoesNotFit(NodeError):
    """A stream is more than the link carries. `decimation`: the smallest one that would fit, 0 if none does."""

    def __init__(self, message: str, decimation: int) -> None:
        super().__init__(message)
        self.decimation = decimation


class MemoryTooSmall(NodeError):
    """The drive's memory for captures does not hold what is to be measured."""


class DriveFailed(NodeError):
    """A device did not do what the protocol promises: it is the drive that failed, not the bench."""

    exit_code = ExitCode.FAILED


class OutputsMayBeOn(NodeError):
    """A power stage was not seen to be off at the end. Its exit code goes before all others."""

    exit_code = ExitCode.OUTPUTS_MAY_BE_ON


class RecordingError(BenchError):
    """The recording cannot be written."""

    exit_code = ExitCode.NOT_RECORDED


class ViewerError(BenchError):
    """The live view cannot be started."""

    exit_code = ExitCode.NO_VIEWER


class UnsafeError(BenchError):
    """Refused because it would energise a drive without an explicit act."""


class Interrupted(BaseException):
    """SIGTERM, SIGHUP, SIGQUIT or SIGBREAK arrived. Like KeyboardInterrupt it passes through `except Exception`."""

    def __init__(self, signum: int) -> None:
        super().__init__(signum)
        self.signum = signum
