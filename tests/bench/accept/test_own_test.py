"""The test that docs/acceptance.md shows as all of one's own is all of one: it runs as it is printed."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from accepting import Accepting

pytestmark = pytest.mark.slow

PAGE = Path(__file__).parents[3] / "docs" / "acceptance.md"


def printed() -> str:
    (block,) = re.findall(r"<!-- ci: own-test -->\n```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    return block


def test_it_passes_with_bench_accept(accepting: Accepting) -> None:
    file = accepting.directory / "own_as_printed.py"
    file.write_text(printed())
    run = accepting(file)
    assert run.code == 0
    (measurement,) = run.measured.values()
    assert measurement.name == "load_step_at_800_rpm.speed_dip"
    assert 20 < measurement.value < 120


def test_it_fails_where_the_load_is_too_much(accepting: Accepting) -> None:
    assert accepting(printed().replace("load.torque(3.0 *", "load.torque(5.0 *")).code == 1
