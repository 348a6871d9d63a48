"""What Windows lacks of the operating system's calls, and what does the same there."""

from __future__ import annotations

import os
import re
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

if sys.platform == "win32":
    import ctypes
    import msvcrt
    import subprocess
else:
    import fcntl
    import resource
    import select
    import termios
    import tty

MOVES_OPEN_FILES = sys.platform != "win32"
"""Whether a file that is open may be moved or removed, and a folder that holds one."""
CGROUP = Path("/sys/fs/cgroup")
_PLACE = 0x7FFF0000  # of the byte that is locked: Windows keeps others from reading it, and no log is as long
_LOOKS, _BETWEEN = 10, 0.01  # s: Windows has no shared lock, so whoever looks whether a file is locked locks it

if sys.platform == "win32":
    APART = subprocess.CREATE_NO_WINDOW | subprocess.CREATE_NEW_PROCESS_GROUP
    """`creationflags` of a child that Ctrl-C in this terminal does not reach; elsewhere `start_new_session` does it."""

    def lock(descriptor: int, shared: bool = False) -> None:
        """Lock an open file until it is closed. BlockingIOError where another program has it."""
        os.lseek(descriptor, _PLACE, os.SEEK_SET)  # what is appended goes to the end all the same
        for look in range(_LOOKS, 0, -1):
            try:
                msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
                break
            except OSError as error:
                if look == 1:
                    raise BlockingIOError(*error.args) from None
            time.sleep(_BETWEEN)

    def forget_typed(terminal: int) -> None:
        """Drop what was typed at a terminal, and not read yet."""
        while msvcrt.kbhit():
            msvcrt.getwch()

    def typed_line(terminal: int, timeout: float) -> bytes | None:
        """A line typed at a terminal within `timeout` s, as its first bytes; b"" at its end, None for no line."""
        end = time.monotonic() + timeout
        while True:
            while msvcrt.kbhit():
                character = msvcrt.getwch()
                if character == "\x03":  # Ctrl-C, as this call gives it
                    raise KeyboardInterrupt
                if character in "\r\n\x1a":  # Ctrl-Z ends the input
                    return b"" if character == "\x1a" else b"\n"
            if (left := end - time.monotonic()) <= 0.0:
                return None
            time.sleep(min(left, 2 * _BETWEEN))

    def of_another_user(file: Path) -> bool:
        """Whether a file belongs neither to this user nor to the system; Windows does not tell."""
        return False

    _ARROWS = {"H": "\x1b[A", "P": "\x1b[B", "M": "\x1b[C", "K": "\x1b[D"}

    class Keys:
        """Keys that are pressed at a terminal, one by one, from `begin` to `end`; arrows as ESC [ A to D."""

        def __init__(self, terminal: int) -> None:
            pass

        def begin(self) -> None:
            """Nothing has to be done."""

        def end(self) -> None:
            """Nothing has to be done."""

        def typed(self) -> list[str]:
            """Those that were pressed since the last call; never waits."""
            keys = []
            while msvcrt.kbhit():
                key = msvcrt.getwch()
                if key == "\x03":  # Ctrl-C, as this call gives it
                    raise KeyboardInterrupt
                keys.append(_ARROWS.get(msvcrt.getwch(), "") if key in "\x00\xe0" else key)
            return keys

    class _MemoryStatus(ctypes.Structure):
        """MEMORYSTATUSEX."""

        _fields_ = (
            *((name, ctypes.c_uint32) for name in ("length", "load")),
            *((name, ctypes.c_uint64) for name in ("total", "free", "page_total", "page_free", "own", "own_free", "x")),
        )

    def memory_limits() -> Iterator[int]:
        """Bytes that this process may still take, by each limit that it has."""
        status = _MemoryStatus(length=ctypes.sizeof(_MemoryStatus))
        if ctypes.windll.kernel32.GlobalMemoryStatusEx(ctypes.byref(status)):
            yield from (status.free, status.page_free, status.own_free)

else:
    APART = 0

    def lock(descriptor: int, shared: bool = False) -> None:
        """Lock an open file until it is closed. BlockingIOError where another program has it."""
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)

    def forget_typed(terminal: int) -> None:
        """Drop what was typed at a terminal, and not read yet."""
        termios.tcflush(terminal, termios.TCIFLUSH)

    def typed_line(terminal: int, timeout: float) -> bytes | None:
        """A line typed at a terminal within `timeout` s, as its first bytes; b"" at its end, None for no line."""
        if not select.select([terminal], [], [], timeout)[0]:
            return None
        try:
            return os.read(terminal, 1024)
        except OSError:  # it was hung up
            return b""

    def of_another_user(file: Path) -> bool:
        """Whether a file belongs neither to this user nor to root. Raises OSError."""
        return file.stat().st_uid not in (os.geteuid(), 0)

    class Keys:
        """Keys that are pressed at a terminal, one by one, from `begin` to `end`; arrows as ESC [ A to D."""

        def __init__(self, terminal: int) -> None:
            self._terminal = terminal
            self._before: list[Any] | None = None
            self._rest = ""  # of an arrow that has not come whole

        def begin(self) -> None:
            """Keys come at once, and are not shown. Ctrl-C is a signal as ever."""
            self._before = termios.tcgetattr(self._terminal)
            tty.setcbreak(self._terminal, termios.TCSANOW)

        def end(self) -> None:
            """The terminal is as it was."""
            if self._before is not None:
                with suppress(termios.error):  # it was hung up
                    termios.tcsetattr(self._terminal, termios.TCSADRAIN, self._before)
                self._before = None

        def typed(self) -> list[str]:
            """Those that were pressed since the last call; never waits."""
            text = self._rest
            try:
                while select.select([self._terminal], [], [], 0.0)[0]:
                    data = os.read(self._terminal, 1024)
                    if not data:
                        break
                    text += data.decode("utf-8", "replace")
            except OSError:  # it was hung up
                pass
            keys = re.findall(r"\x1b\[[0-9;]*[A-Za-z~]|\x1b\[?[0-9;]*$|.|\n", text)
            self._rest = keys.pop() if keys and re.fullmatch(r"\x1b\[?[0-9;]*", keys[-1]) else ""
            return keys

    def memory_limits() -> Iterator[int]:
        """Bytes that this process may still take, by each limit that it has."""
        try:
            told = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text(encoding="utf-8").splitlines())
            yield int(told["MemAvailable"].split()[0]) << 10
        except (OSError, KeyError, ValueError):  # not Linux: all that there is
            yield os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        with suppress(OSError, ValueError):
            limit, used = (int((CGROUP / f"memory.{name}").read_text(encoding="utf-8")) for name in ("max", "current"))
            yield limit - used
        limit, _ = resource.getrlimit(resource.RLIMIT_AS)
        if limit != resource.RLIM_INFINITY:
            with suppress(OSError):
                pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[0])
                yield limit - pages * resource.getpagesize()


def sync(descriptor: int) -> None:
    """Have the disk take an open file's content."""
    if sys.platform == "linux":
        os.fdatasync(descriptor)
    else:
        os.fsync(descriptor)


def removed(file: Path) -> bool:
    """Remove a file; False where another program has it open and the system keeps it for that. Raises OSError."""
    try:
        file.unlink(missing_ok=True)
    except PermissionError:
        if MOVES_OPEN_FILES:
            raise
        return False
    return True


def append_to(path: Path) -> int:
    """Open a file that only grows; the descriptor is its caller's to close."""
    return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | getattr(os, "O_BINARY", 0), 0o644)
