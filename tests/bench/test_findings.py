"""The table of thresholds of `bench.findings`."""

from __future__ import annotations

import ast
from itertools import pairwise
from pathlib import Path

from bench.findings import thresholds


def test_every_threshold_says_where_it_comes_from() -> None:
    table = ast.parse(Path(thresholds.__file__).read_text()).body
    said = [isinstance(after, ast.Expr) for node, after in pairwise(table) if isinstance(node, ast.Assign)]
    assert len(said) > 20
    assert all(said)
