"""What the parts of the plug-in know of a test: whether it is ours, its name, and what is kept with it.

Loaded by every pytest of the environment: it imports nothing heavy.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import pytest

from bench.rig import screen as rig_screen

if TYPE_CHECKING:
    from bench.accept.measuring import Running
    from bench.rig.rig import Rig
    from bench.signal.limits import Limits

RESULT = "hallbench"  # attribute of an acceptance test's reports; the last one's carries its result
FIXTURE = "_hallbench_rig"  # whoever asks for it, directly or not, is an acceptance test


class Screen(rig_screen.Screen, Protocol):
    """Where progress goes."""

    def listed(self, name: str, limits: Limits, specified: Limits | None) -> None:
        """A measurement, its limits and its band, where only those were asked for."""

    def pause(self) -> None:
        """Somebody is about to be asked something."""

    def resume(self) -> None:
        """It goes on."""


RUNNING: pytest.StashKey[Running] = pytest.StashKey()
RIG: pytest.StashKey[Rig] = pytest.StashKey()
SCREEN: pytest.StashKey[Screen] = pytest.StashKey()
"""Of `bench accept`."""


def is_acceptance_test(item: pytest.Item) -> bool:
    """Whether a test asks for the bench."""
    return FIXTURE in getattr(item, "fixturenames", ())


def names_of(node_ids: Iterable[str]) -> dict[str, str]:
    """Name of each test by node id: without `test_`, and with its file where two have the same."""
    short = {node_id: _function(node_id) for node_id in node_ids}
    often = Counter(short.values())
    return {node_id: name if often[name] == 1 else long_name(node_id) for node_id, name in short.items()}


def long_name(node_id: str) -> str:
    """With its file, whatever else is run."""
    file = Path(node_id.partition("::")[0]).stem
    return f"{file.removeprefix('test_')}.{_function(node_id)}"


def _function(node_id: str) -> str:
    """Without `test_`, with what is in brackets."""
    path, bracket, parameters = node_id.partition("[")
    return path.rpartition("::")[2].removeprefix("test_") + bracket + parameters
