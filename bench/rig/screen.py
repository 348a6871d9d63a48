"""What an application tells a person meanwhile."""

from __future__ import annotations

from typing import Protocol


class Screen(Protocol):
    """Where progress goes."""

    def note(self, text: str) -> None:
        """A line that stays."""

    def progress(self, text: str) -> None:
        """The line that tells what is going on now."""
