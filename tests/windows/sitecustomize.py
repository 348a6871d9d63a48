"""Python starts with this where its folder is in PYTHONPATH: `bench`, `sim`, `protocol` then see one like Windows.

Only they do: what other packages import is left alone. They find no POSIX module, no name of `os`, `signal` or `time`
that Windows lacks, `msvcrt`, `select` for sockets only, `os.read` and `os.write` for anything but sockets, and
`os.kill` and `creationflags` that do what they do on Windows. Below the folder $HALLBENCH_TESTS_WINDOWS no file can be
made under a name that Windows refuses, and none moved or removed that this process has open.
"""

from __future__ import annotations

import builtins
import ctypes
import enum
import errno
import fcntl
import os
import re
import select
import signal
import stat
import struct
import subprocess
import sys
import time
import types
from typing import Any

FOLDER = os.environ.get("HALLBENCH_TESTS_WINDOWS", "")
OURS = re.compile(r"(bench|sim|protocol)(\.|$)")
ABSENT = {"fcntl", "grp", "posix", "pty", "pwd", "resource", "spwd", "syslog", "termios", "tty"}
SIGBREAK = 21  # Windows' number; nothing sends it here by itself


class Without(types.ModuleType):
    """A module without some of its names, or with some only."""

    def __init__(self, real: types.ModuleType, without: str = "", only: str = "", **instead: Any) -> None:
        super().__init__(real.__name__)
        self.__dict__.update({"_real": real, "_without": set(without.split()), "_only": set(only.split())} | instead)

    def __getattr__(self, name: str) -> Any:
        if name in self._without or (self._only and name not in self._only and not name.startswith("__")):
            raise AttributeError(f"module '{self.__name__}' has no attribute '{name}' on Windows")
        return getattr(self._real, name)

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(self._real, name, value)


# -- os, select -------------------------------------------------------------------------------------------------------


def _is_socket(descriptor: Any) -> bool:
    number = descriptor if isinstance(descriptor, int) else descriptor.fileno()
    return stat.S_ISSOCK(os.fstat(number).st_mode)


def _no_socket(call: Any) -> Any:
    def checked(descriptor: int, *arguments: Any) -> Any:
        if _is_socket(descriptor):
            raise OSError(errno.EBADF, "Bad file descriptor")
        return call(descriptor, *arguments)

    return checked


def _kill(pid: int, number: int) -> None:
    """TerminateProcess."""
    assert pid == os.getpid(), "only itself"
    os._exit(number)


def _select(read: Any, write: Any, other: Any, timeout: float | None = None) -> Any:
    wanted = [*read, *write, *other]
    if not wanted:
        raise OSError(errno.EINVAL, "[WinError 10022] An invalid argument was supplied")
    if not all(map(_is_socket, wanted)):
        raise OSError(errno.ENOTSOCK, "[WinError 10038] An operation was attempted on something that is not a socket")
    return select.select(read, write, other, timeout)


OS = Without(
    os,
    """O_CLOEXEC O_DIRECTORY O_NOFOLLOW O_NONBLOCK O_SYNC WNOHANG chown chroot confstr fchmod fchown fdatasync fork
    forkpty fpathconf fstatvfs getegid geteuid getgid getgroups getloadavg getpgid getpgrp getpriority getsid
    getuid initgroups killpg lchown lockf major minor mkfifo mknod nice openpty pathconf pipe2 posix_fadvise
    posix_fallocate pread preadv pwrite pwritev readv register_at_fork sched_getaffinity sched_yield sendfile
    set_blocking setgid setpgid setpriority setsid setuid statvfs sync sysconf tcgetpgrp tcsetpgrp ttyname uname
    wait wait3 wait4 writev memfd_create splice""",
    name="nt", O_BINARY=0, kill=_kill, read=_no_socket(os.read), write=_no_socket(os.write),
)  # fmt: skip
SELECT = Without(select, only="select error", select=_select)


# -- signal -----------------------------------------------------------------------------------------------------------

Signals = enum.IntEnum(
    "Signals", {"SIGINT": 2, "SIGILL": 4, "SIGFPE": 8, "SIGSEGV": 11, "SIGTERM": 15, "SIGBREAK": SIGBREAK, "SIGABRT": 6}
)


def _break(number: int, frame: Any) -> None:
    """What Windows does at Ctrl-Break; what Linux does with that number is another thing."""
    os._exit(0x7F)


def _get_handler(number: int) -> Any:
    handler = signal.getsignal(number)
    return signal.SIG_DFL if handler is _break else handler


def _set_handler(number: int, handler: Any) -> Any:
    Signals(number)  # ValueError
    before = _get_handler(number)
    signal.signal(number, _break if number == SIGBREAK and handler == signal.SIG_DFL else handler)
    return before


signal.signal(SIGBREAK, _break)
_WINDOWS = {member.name: member for member in Signals} | {"Signals": Signals, "signal": _set_handler}
SIGNAL = Without(
    signal, only="SIG_DFL SIG_IGN Handlers default_int_handler raise_signal strsignal valid_signals",
    CTRL_C_EVENT=0, CTRL_BREAK_EVENT=1, getsignal=_get_handler, **_WINDOWS,
)  # fmt: skip


# -- msvcrt, ctypes ---------------------------------------------------------------------------------------------------


def _locking(descriptor: int, mode: int, size: int) -> None:
    """A lock of the open file, of `size` bytes from where it stands; exclusive where the descriptor can have one."""
    assert mode == MSVCRT.LK_NBLCK
    writes = fcntl.fcntl(descriptor, fcntl.F_GETFL) & os.O_ACCMODE != os.O_RDONLY
    place = os.lseek(descriptor, 0, os.SEEK_CUR)
    lock = struct.pack("hhqqi4x", fcntl.F_WRLCK if writes else fcntl.F_RDLCK, os.SEEK_SET, place, size, 0)
    try:
        fcntl.fcntl(descriptor, 37, lock)  # F_OFD_SETLK
    except OSError:
        raise PermissionError(errno.EACCES, "Permission denied") from None


MSVCRT = types.ModuleType("msvcrt")
MSVCRT.__dict__.update(
    LK_NBLCK=2,
    locking=_locking,
    kbhit=lambda: bool(select.select([0], [], [], 0.0)[0]),
    getwch=lambda: (os.read(0, 1) or b"\x1a").decode("latin1"),
)


def _memory_status(pointer: Any) -> int:
    """Windows' GlobalMemoryStatusEx, of a machine with 1 to 6 GiB of each kind: dwLength must be right."""
    place = ctypes.cast(pointer, ctypes.c_void_p).value
    assert place is not None
    if ctypes.c_uint32.from_address(place).value != 64:
        return 0
    (ctypes.c_uint64 * 6).from_address(place + 8)[:] = [n << 30 for n in (6, 3, 6, 4, 6, 5)]
    return 1


KERNEL32 = types.SimpleNamespace(GlobalMemoryStatusEx=_memory_status)
CTYPES = Without(ctypes, windll=types.SimpleNamespace(kernel32=KERNEL32))


# -- subprocess -------------------------------------------------------------------------------------------------------


class _Popen(subprocess.Popen):  # type: ignore[type-arg]
    def __init__(
        self, args: Any, *more: Any, creationflags: int = 0, start_new_session: bool = False, **given: Any
    ) -> None:
        program = os.fspath(args if isinstance(args, str) else args[0])
        if re.match(r"(/usr)?/s?bin/(?!python)", program):
            raise FileNotFoundError(errno.ENOENT, "The system cannot find the file specified", program)
        apart = bool(creationflags & SUBPROCESS.CREATE_NO_WINDOW)
        super().__init__(args, *more, start_new_session=apart, **given)

    def terminate(self) -> None:
        self.kill()


SUBPROCESS = Without(subprocess, Popen=_Popen, CREATE_NO_WINDOW=0x08000000, CREATE_NEW_PROCESS_GROUP=0x200)
SYS = Without(sys, platform="win32")
TICK = 1 / 64  # s: of the monotonic clock there, before Python 3.13


def _monotonic() -> float:
    return time.monotonic() // TICK * TICK


TIME = Without(time, "clock_gettime pthread_getcpuclockid tzset", monotonic=_monotonic)
PRESENT: dict[str, types.ModuleType] = {
    "os": OS, "select": SELECT, "signal": SIGNAL, "_signal": SIGNAL, "msvcrt": MSVCRT, "ctypes": CTYPES,
    "subprocess": SUBPROCESS, "sys": SYS, "time": TIME,
}  # fmt: skip

_import = builtins.__import__


def _windows_import(name: str, globals: Any = None, locals: Any = None, fromlist: Any = (), level: int = 0) -> Any:
    importer = (globals or {}).get("__name__") or ""
    if importer == "__main__":
        importer = (globals or {}).get("__package__") or ""
    if level == 0 and OURS.match(importer) and importer != "sim.numba_cache":  # whose key tells one system from another
        top = name.partition(".")[0]
        if top in ABSENT:
            raise ModuleNotFoundError(f"No module named '{name}' on Windows", name=name)
        if top in PRESENT and (name == top or not fromlist):
            _import(name, globals, locals, fromlist, level) if top != "msvcrt" else None
            return PRESENT[top]
    return _import(name, globals, locals, fromlist, level)


builtins.__import__ = _windows_import


# -- files ------------------------------------------------------------------------------------------------------------

REFUSED = re.compile(r'[<>:"|?*\\\x00-\x1f]|[. ]$|^(CON|PRN|AUX|NUL|COM[0-9¹²³]|LPT[0-9¹²³])(\.|$)', re.IGNORECASE)


def _inside(path: Any) -> str:
    """The path, where it is below the folder; else nothing."""
    if not FOLDER or not isinstance(path, str | bytes | os.PathLike):
        return ""
    full = os.path.abspath(os.fsdecode(path))
    return full if full.startswith(FOLDER + os.sep) else ""


def _check_name(path: Any) -> None:
    if full := _inside(path):
        for part in full.removeprefix(FOLDER).split(os.sep):
            if REFUSED.search(part):
                raise OSError(errno.EINVAL, f"[WinError 123] Windows refuses the name {part!r}", full)
        if len(full.removeprefix(FOLDER)) > 200:
            raise FileNotFoundError(errno.ENOENT, "[WinError 206] The file name is too long", full)


def _check_closed(path: Any) -> None:
    if full := _inside(path):
        with open("/proc/self/maps", "rb") as maps:
            mapped = re.findall(rb"^\S+ r.*? (/.*)$", maps.read(), re.MULTILINE)
        held = [os.fsdecode(name) for name in mapped]
        for number in os.listdir("/proc/self/fd"):
            try:
                held.append(os.readlink(f"/proc/self/fd/{number}"))
            except OSError:
                continue
        for name in held:
            if name == full or name.startswith(full + os.sep):
                raise PermissionError(errno.EACCES, f"[WinError 32] this process has {name} open", full)


def _audit(event: str, arguments: tuple[Any, ...]) -> None:
    if event == "open":
        path, mode, flags = arguments
        if (isinstance(mode, str) and set(mode) & set("wax+")) or flags & os.O_CREAT:
            _check_name(path)
    elif event == "os.mkdir":
        _check_name(arguments[0])
    elif event == "os.rename":
        _check_name(arguments[1])
        _check_closed(arguments[0])
        caller = sys._getframe(1).f_code
        there = os.path.isdir(arguments[1]) or (caller.co_name == "rename" and os.path.exists(arguments[1]))
        if there and _inside(arguments[1]):
            raise FileExistsError(errno.EEXIST, "[WinError 183] it exists", arguments[1])
        _check_closed(arguments[1])
    elif event in ("os.remove", "os.rmdir"):
        _check_closed(arguments[0])


sys.addaudithook(_audit)
