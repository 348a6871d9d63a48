"""Hints to processor and compiler, that change nothing. Plain Python has no use for them."""

from __future__ import annotations

from typing import Any

from sim.native import Pointer


def seldom(condition: bool) -> bool:
    """The condition itself, which seldom holds: nothing waits for it."""
    return condition


def ahead(of: Pointer[Any], k: int) -> None:
    """The k-th record will be written soon: its memory is fetched meanwhile; there need be none."""


def apart() -> None:
    """First in a kernel that is large and seldom runs: it stays a function, and is not put into what calls it."""
