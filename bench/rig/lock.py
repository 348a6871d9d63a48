"""Nobody else meanwhile: a lock on each target, so that no two programs of this bench turn one motor."""

from __future__ import annotations

import getpass
import hashlib
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from bench.errors import BenchError
from bench.files import file_name
from bench.rig.connection import SIM
from protocol.links.target import parse_target


@contextmanager
def alone_on(*targets: str) -> Iterator[None]:
    """Hold the locks on targets, at most as long as this process lives; `sim` and none need none.

    BenchError if another process holds one.
    """
    with ExitStack() as stack:
        for target in targets:
            if target in (SIM, ""):
                continue
            from filelock import FileLock, Timeout

            place = hashlib.sha256(parse_target(target).place.encode()).hexdigest()[:16]
            lock = FileLock(folder() / f"hallbench-{file_name(getpass.getuser())}-{place}.lock", timeout=0)
            try:
                stack.enter_context(lock)
            except Timeout:
                raise BenchError(f"{target} is in use by another run: wait until it ends, or close its rig") from None
            except OSError as error:  # a symbolic link in its place is not followed
                words = f"cannot lock {target} for this run: {lock.lock_file}: {error.strerror or error}"
                raise BenchError(f"{words}; remove that file") from None
        yield


def folder() -> Path:
    """Where the locks of this computer are."""
    return Path(tempfile.gettempdir())
