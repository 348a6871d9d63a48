"""Windows that follow each other made one, and parts of whole turns: properties over any of them."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from bench.commission.analysis.stretches import LEAST_PART, merged, parts
from bench.commission.window import Edges, Window
from tests.choice import examples

T = 1e-4


def window(first: int, n: int, kind: str, i_ref: complex, encoder: bool = True) -> Window:
    index = first + np.arange(n)
    edges = Edges(np.array([1]), np.array([3]), np.array([first + 0.5]), np.array([first])) if n else Edges(
        np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.int64)
    )  # fmt: skip
    angle = 1e-3 * index
    return Window(
        T, np.stack([index, index, index]).astype(float), index + 0j, 24.0 + 0.0 * index, angle if encoder else None,
        angle, index, index % 7 == 0, edges, kind, i_ref,
    )  # fmt: skip


LENGTHS = st.lists(st.tuples(st.integers(0, 30), st.integers(0, 1), st.sampled_from(["up", "off"])), max_size=12)


@examples(60, 1000, campaign="commission")
@given(LENGTHS, st.booleans())
def test_merged_windows_have_the_samples_of_all_in_their_order(
    asked: list[tuple[int, int, str]], by_command: bool
) -> None:
    """Each is without a gap, has one command if asked for, and two that follow each other differ in one of them."""
    windows, at = [], 0
    for n, gap, kind in asked:
        at += 5 * gap
        windows.append(window(at, n, kind, 1j if kind == "up" else 0j))
        at += n
    made = merged(windows, by_command)
    every = [window for window in windows if len(window)]
    for name in ("index", "u", "u_dc", "control", "theta", "cycle"):
        seen = [getattr(each, name) for each in made]
        assert np.array_equal(
            np.concatenate(seen) if seen else np.zeros(0),
            np.concatenate([getattr(each, name) for each in every]) if every else np.zeros(0),
        )
    assert sum(len(each.edges) for each in made) == len(every)
    for each in made:
        assert np.all(np.diff(each.index) == 1)
        assert each.i.shape == (3, len(each))
        own = [w for w in every if each.index[0] <= w.index[0] <= each.index[-1]]
        assert not by_command or len({w.kind for w in own}) == 1
    for before, after in pairwise(made):
        assert after.index[0] > before.index[-1] + 1 or (by_command and after.kind != before.kind)


def test_one_window_without_an_encoder_leaves_the_whole_without_one() -> None:
    made = merged([window(0, 5, "up", 1j), window(5, 5, "up", 1j, encoder=False)])
    assert len(made) == 1
    assert made[0].theta is None


@examples(60, 1000, campaign="commission")
@given(st.floats(-3000.0, 3000.0), st.integers(2, 3000), st.floats(0.002, 0.05))
def test_parts_are_whole_turns_and_share_their_ends(w: float, n: int, seconds: float) -> None:
    angle = w * T * np.arange(n)
    made = parts(angle, T, seconds)
    for before, after in pairwise(made):
        assert after.start == before.stop - 1
    for part in made:
        assert 0 <= part.start < part.stop <= n
        turns = abs(angle[part.stop - 1] - angle[part.start]) / math.tau
        whole = math.tau / max(abs(w) * T, 1e-12) < n - 1
        assert not whole or abs(turns - round(turns)) <= 0.5 * abs(w) * T / math.tau + 1e-9
        assert whole or part.stop - part.start - 1 == max(LEAST_PART, round(seconds / T))
