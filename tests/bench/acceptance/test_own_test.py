"""The test that docs/acceptance.md shows as all of one's own is all of one: it runs as it is printed."""

from __future__ import annotations

import re
from pathlib import Path

from accepting import Accepting, plain_pytest

PAGE = Path(__file__).parents[3] / "docs" / "acceptance.md"


def printed() -> str:
    (block,) = re.findall(r"<!-- ci: own-test -->\n```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    return block


def test_it_passes_with_bench_accept(tmp_path: Path) -> None:
    file = tmp_path / "own_as_printed.py"
    file.write_text(printed())
    run = Accepting(tmp_path)(file)
    assert run.code == 0
    (measurement,) = run.measured.values()
    assert measurement.name == "load_step_at_800_rpm.speed_dip"
    assert 20 < measurement.value < 120


def test_it_fails_where_the_load_is_too_much(tmp_path: Path) -> None:
    file = tmp_path / "own_overloaded.py"
    file.write_text(printed().replace("load.torque(3.0 *", "load.torque(5.0 *"))
    assert Accepting(tmp_path)(file).code == 1


def test_it_passes_with_plain_pytest(tmp_path: Path) -> None:
    (tmp_path / "test_mine.py").write_text(printed())
    ran = plain_pytest(tmp_path, "-q", "test_mine.py", "--target", "sim")
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "1 passed" in ran.stdout
