"""How estimates look: a host's has its observer's colour where the drive's own is not beside it."""

from __future__ import annotations

from collections.abc import Iterable

from bench.record.info import HOST_SUFFIX
from bench.signal.colours import Look, apart, quantity


def looks(names: Iterable[str]) -> dict[str, Look]:
    """Looks of estimates by their channels: no two are the same."""
    drives_first = sorted(names, key=lambda name: name.endswith(HOST_SUFFIX))
    return apart({name: quantity(name.removesuffix(HOST_SUFFIX)) for name in drives_first})
