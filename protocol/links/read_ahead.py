"""A port read ahead by a process of its own, see `protocol.links.pump`: for ports that carry much, on POSIX systems."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

from protocol.links.base import MAX_READ, readable
from protocol.links.pump import READY

PIPE_BYTES = 1 << 20
"""What waits for a host at most, 1.2 s of 26 channels at 16 kHz; less where the system does not allow it."""

_PROGRAM = Path(__file__).with_name("pump.py")


class ReadAhead:
    """Has the port at descriptor `port` read. Until `ready` whoever made this reads on.

    Raises:
        OSError: no process can be started.
    """

    def __init__(self, port: int) -> None:
        self._pipe, end = os.pipe()
        try:
            _deepen(end)
            if sys.platform != "win32":  # where it is not made
                os.set_blocking(self._pipe, False)
            self._process = subprocess.Popen(
                [sys.executable, "-I", "-S", str(_PROGRAM), str(port)],
                bufsize=0, stdin=subprocess.PIPE, stdout=end, stderr=subprocess.DEVNULL, pass_fds=(port,),
                start_new_session=True,
            )  # fmt: skip
        except BaseException:
            os.close(self._pipe)
            raise
        finally:
            os.close(end)
        self.pid = self._process.pid
        self._waits = [self._process.stdin]  # it reads once this is closed; a signal's exception may come at any time
        self._process.stdin = None
        self._read = 0.0  # s of the monotonic clock, when something was read
        self._behind = False  # more waits than one read returns

    def ready(self) -> bool:
        """Whether it reads, or has ended: from now on nobody else may read before `read` has returned None."""
        if self._waits and readable(self._pipe, 0.0):
            os.read(self._pipe, len(READY))
            file = self._waits.pop()  # closed, at the latest, when nobody has it any more
            assert file is not None
            file.close()
        return not self._waits

    def read(self, timeout: float, settle: float) -> bytes | None:
        """As `Link.read`; None if it has ended. After a read the next one first sleeps for `settle` s.

        So whoever reads a stream wakes once for each piece of it, and not for its first bytes, too.
        """
        now = time.monotonic()
        until, pause = now + timeout, self._read + settle - now
        if settle > 0.0 and (self._behind or pause > 0.0):
            if not self._behind:
                time.sleep(pause)
            if (data := self._take()) != b"":
                return data
        if not readable(self._pipe, max(0.0, until - time.monotonic())):
            return b""
        if settle > 0.0:
            time.sleep(settle)
        return self._take()

    def _take(self) -> bytes | None:
        try:
            data = os.read(self._pipe, MAX_READ)
        except BlockingIOError:
            self._behind = False
            return b""
        self._read, self._behind = time.monotonic(), len(data) == MAX_READ
        return data or None

    def close(self) -> None:
        """End it."""
        self._waits.clear()
        self._process.kill()
        self._process.wait()
        os.close(self._pipe)


def _deepen(pipe: int) -> None:
    """Have it hold as much as this system lets one user's pipe hold."""
    if sys.platform == "linux":
        import fcntl

        with suppress(OSError):  # other programs of this user hold too much
            fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
