"""Hints to the processor, that change nothing. Plain Python has no use for them."""

from __future__ import annotations

from typing import Any

from sim.native import Pointer


def ahead(of: Pointer[Any], k: int) -> None:
    """The k-th record will be written soon: its memory is fetched meanwhile; there need be none."""
