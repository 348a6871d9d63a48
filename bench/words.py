"""Words for numbers, alike in every table, note and message."""

from __future__ import annotations


def counted(number: int, noun: str) -> str:
    """So many of a thing: 1 outage, 2 outages."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
