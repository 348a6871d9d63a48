"""A port read ahead by a process of its own, see `protocol.links.pump`: for ports that carry much."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
import time
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
            if hasattr(fcntl, "F_SETPIPE_SZ"):
                try:
                    fcntl.fcntl(end, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
                except OSError:  # other programs of this user have too many
                    pass
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
        os.set_blocking(self._pipe, False)
        self.pid = self._process.pid
        self._ready = False
        self._read = 0.0  # s of the monotonic clock, when something was read
        self._behind = False  # more waits than one read returns

    def ready(self) -> bool:
        """Whether it reads: from then on nobody else may."""
        if not self._ready and readable(self._pipe, 0.0) and os.read(self._pipe, 1) == READY:
            assert self._process.stdin is not None
            self._process.stdin.write(b"\0")
            self._ready = True
        return self._ready

    def read(self, timeout: float, settle: float) -> bytes | None:
        """As `Link.read`; None if it has ended. What goes on coming is fetched once in both times together."""
        more = self._read + timeout + settle - time.monotonic() if settle > 0.0 else 0.0
        if self._behind:
            more = 0.0
        elif more <= 0.0:
            if not readable(self._pipe, max(0.0, timeout)):
                return b""
            more = settle
        if more > 0.0:
            time.sleep(more)
        try:
            data = os.read(self._pipe, MAX_READ)
        except BlockingIOError:
            return b""
        self._read, self._behind = time.monotonic(), len(data) == MAX_READ
        return data or None

    def close(self) -> None:
        """End it."""
        self._process.kill()
        self._process.wait()
        os.close(self._pipe)
        assert self._process.stdin is not None
        self._process.stdin.close()
