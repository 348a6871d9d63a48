"""How much memory there is, so that a run too large for it is refused in words instead of by the system's killer."""

from __future__ import annotations

import sys

from bench.system import memory_limits


def available() -> int:
    """Bytes that this process may still take: by what is free, its control group's limit, and its own (RLIMIT_AS)."""
    return max(0, min(memory_limits(), default=sys.maxsize))


def in_words(size: float) -> str:
    """Such as 4.6 GB."""
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.0f} MB"
