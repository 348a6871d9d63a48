"""The kernels' sources: the hash that says whether what is kept of them is stale, and the decorator that marks them.

A kernel's machine code holds all kernels that it is made of, so it is kept under a hash of every source that kernels
are made of: any edit makes all of it anew (`protocol.machine_code`). Importing this module does not import numba.
"""

from __future__ import annotations

import hashlib
import sys
from functools import cache
from pathlib import Path
from uuid import uuid4

from protocol.machine_code import Store, hashed, kernel

__all__ = ["kernel", "source_hash", "source_stamp", "store"]

_HERE = Path(__file__).parent
SHIPPED = _HERE / "kernels"

# Of `sim/drive` and `sim/ports` only the control tick and the lengths of CAN frames are kernels.
_PLAIN = ("config", "drive", "ports", "compile.py", "interrupts.py")
_KERNELS_AMONG = ("drive/tick*.py", "ports/can_bits.py")
_IN_PROTOCOL = (
    "codes.py",
    "messages.py",
    "signals.py",
    "streams.py",
    "canmap/frame.py",
    "ir_by_numba.py",
)  # constants that kernels take in, and how they are compiled


def _kernel_sources() -> list[Path]:
    sources = [p for p in _HERE.rglob("*.py") if p.relative_to(_HERE).parts[0] not in _PLAIN]
    return [
        *sorted(sources),
        *sorted(path for pattern in _KERNELS_AMONG for path in _HERE.glob(pattern)),
        *(_HERE.parent / "protocol" / name for name in _IN_PROTOCOL),
    ]


@cache
def source_hash() -> str:
    """Hash of all kernel sources: 16 hex digits."""
    return hashed(_kernel_sources(), _HERE.parent)


@cache
def store() -> Store:
    """Where the kernels are kept."""
    return Store(SHIPPED, source_hash())


@cache
def source_stamp(module: str) -> str:
    """Hash of a module's sources, if it is none of those that `source_hash` is made of; else empty.

    Of a package's module all that is in the package counts: kernels are made of one another. A module without sources
    has another one in each process.
    """
    top = module.partition(".")[0]
    if top in ("sim", "protocol"):
        return ""
    found = sys.modules.get(top) or sys.modules.get(module)
    folders = [Path(folder) for folder in getattr(found, "__path__", ())]
    file = getattr(sys.modules.get(module), "__file__", None)
    paths = sorted(path for folder in folders for path in folder.rglob("*.py")) or ([Path(file)] if file else [])
    if not paths:
        return uuid4().hex[:16]
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]
