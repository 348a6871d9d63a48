"""Which seeds, motors and faults the suite tries today: chosen by the commit's hash, all of them in a campaign.

A week of commits covers what every run covered before. The summary of a run prints the hash;
`HALLBENCH_TESTS_CHOICE=<hash> pytest …` chooses the same again.
"""

from __future__ import annotations

import functools
import os
import random
import subprocess
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TypeVar

import pytest
from _pytest.mark.structures import ParameterSet

GIVEN = "HALLBENCH_TESTS_CHOICE"
CAMPAIGN = "HALLBENCH_TESTS_CAMPAIGN"  # set by `pytest --campaign`
T = TypeVar("T")
Test = Callable[..., None]


@functools.cache
def commit() -> str:
    """What chooses: $HALLBENCH_TESTS_CHOICE, else the hash of the commit, else "none" outside a repository."""
    if given := os.environ.get(GIVEN):
        return given
    try:
        where = Path(__file__).parent
        found = subprocess.run(["git", "-C", where, "rev-parse", "HEAD"], capture_output=True, text=True)
    except FileNotFoundError:
        return "none"
    return found.stdout.strip()[:12] or "none"


def chosen(what: str, items: Iterable[T], count: int) -> list[T]:
    """`count` of the items, in their order, by the commit's hash; all of them in a campaign.

    `what` names the choice, so that two choices among the same items differ. Raises ValueError for too few items.
    """
    every = list(items)
    if os.environ.get(CAMPAIGN):
        return every
    picked = random.Random(f"{commit()} {what}").sample(range(len(every)), count)
    return [every[k] for k in sorted(picked)]


def sampled(what: str, items: Iterable[object], count: int, *, campaign: str) -> list[ParameterSet]:
    """The items for `parametrize`, a tuple for several arguments: `count` in the suite, the others in that campaign.

    A campaign has them all. Items of `pytest.param` keep their marks and ids; keys of a mapping are ids.
    """
    named = items.items() if isinstance(items, Mapping) else ((None, item) for item in items)
    every = [item if isinstance(item, ParameterSet) else pytest.param(*item if type(item) is tuple else [item], id=key)
             for key, item in named]  # fmt: skip
    here = () if os.environ.get(CAMPAIGN) else chosen(what, range(len(every)), count)
    late = pytest.mark.campaign(campaign)
    return [item if k in here else item._replace(marks=(*item.marks, late)) for k, item in enumerate(every)]


def also_in(*, campaign: str) -> Callable[[Test], Test]:
    """A test of the suite that this campaign has too, there with all that `chosen` chooses from."""
    return lambda test: pytest.mark.campaign(campaign)(test) if os.environ.get(CAMPAIGN) else test


def examples(here: int, there: int, *, campaign: str) -> Callable[[Test], Test]:
    """A property with `here` examples in the suite, and `there` in that campaign."""
    import hypothesis  # a plug-in of pytest, which is to import it first

    most = there if os.environ.get(CAMPAIGN) else here
    return lambda test: also_in(campaign=campaign)(hypothesis.settings(max_examples=most, deadline=None)(test))
