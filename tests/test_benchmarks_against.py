"""`python -m tests.benchmarks --against`: its arithmetic, on costs that are written down, and trees of one line."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.benchmarks import __main__ as command
from tests.benchmarks import against, page
from tests.benchmarks.last import Comparison, compared, text_of
from tests.benchmarks.parts import machine
from tests.benchmarks.ratio import SLOW, WITHIN, Pair, paired

ROOT = Path(__file__).parents[1]


def git(root: Path, *arguments: str) -> str:
    command = ["git", "-c", "user.name=x", "-c", "user.email=x@x", *arguments]
    return subprocess.run(command, cwd=root, check=True, capture_output=True, text=True).stdout.strip()


def pair(now: list[float], then: list[float], **asked: float) -> Pair:
    return Pair("x", "s", now, then, **asked)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("now", "then", "ratio", "spread"),
    [
        ([2.0], [1.0], 2.0, 0.0),
        ([1.0, 3.0], [1.0, 2.0], 1.25, 0.25),
        ([2.0, 4.0, 6.0], [1.0, 2.0, 2.0], 2.0, 0.5),  # 2, 2, 3
        ([1.0, 2.0, 3.0, 4.0, 50.0], [1.0] * 5, 3.0, 1.0),  # quartiles 2 and 4: one wild round is none of it
        ([10.0, 1.0, 1.0], [10.0, 1.0, 1.0], 1.0, 0.0),  # what both sides feel in a round is no difference
    ],
)
def test_the_ratio_is_the_median_of_the_rounds_and_the_spread_half_the_quartiles_distance(
    now: list[float], then: list[float], ratio: float, spread: float
) -> None:
    row = pair(now, then)
    assert (row.ratio, row.spread) == (pytest.approx(ratio), pytest.approx(spread))


@pytest.mark.parametrize(
    ("row", "missed"),
    [
        (pair([1.1], [1.0], at_most=1.0), True),
        (pair([1.1] * 3, [1.0] * 3, at_most=1.03, beyond=True), True),
        (pair([1.0, 1.1, 1.2], [1.0] * 3, at_most=1.03, beyond=True), False),  # 1.1 +- 0.1
        (pair([0.62], [1.0], at_most=1 / 1.6), False),  # 1.6 times as fast
        (pair([0.63], [1.0], at_most=1 / 1.6), True),
        (pair([9.0, 12.0, 11.0], [], limit=10.0), True),  # by itself, whatever the other has
        (pair([9.0, 12.0, 8.0], [], limit=10.0), False),
        (pair([], [1.0], at_most=1.0, limit=1.0), False),  # nothing here to judge
        (pair([5.0], [], at_most=1.0), False),  # nothing there to compare with
        (pair([5.0], [1.0]), False),  # nothing asked
    ],
)
def test_a_verdict(row: Pair, missed: bool) -> None:
    assert row.missed == missed
    assert (row.cells("abc1234")[-1] == "MISSED") == missed


@pytest.mark.parametrize(
    ("now", "then", "slow"),
    [
        ([1.5, 1.5, 1.5], [1.0, 1.0, 1.0], True),
        ([1.5, 1.5, 1.0], [1.0, 1.0, 1.0], False),  # other load: the best rounds are the same
        ([1.5, 1.5, 1.5], [1.0, 1.5, 1.5], False),  # other load on the other side
        ([1.29, 1.29, 1.29], [1.0, 1.0, 1.0], False),
    ],
)
def test_slow_is_what_neither_the_median_nor_the_best_rounds_excuse(now, then, slow) -> None:
    assert pair(now, then).slow == slow


def test_a_ratio_within_a_run_is_not_compared_with_the_others() -> None:
    assert not Pair("reads of 8 KiB over reads of 64", WITHIN, [2.0], [1.0]).slow


def test_rows_that_a_side_lacks_are_told_and_no_failure() -> None:
    rows = paired([{"a, s": 2.0, "new, with a comma, ms": 3.0}] * 2, [{"a, s": 1.0, "old, x": 4.0}] * 2)
    assert [(row.what, row.unit, row.compared) for row in rows] == [
        ("a", "s", True),
        ("new, with a comma", "ms", False),
        ("old", "x", False),
    ]
    assert [row.cells("abc1234")[1:4] for row in rows] == [
        ("2 s", "1 s", "2.00 ± 0.00"),
        ("3 ms", "not in abc1234", ""),
        ("not here", "4 x", ""),
    ]
    assert not any(row.slow for row in rows[1:])


@pytest.mark.parametrize(
    ("now", "then", "says"),
    [
        ([{"a, s": 1.0}, {}], [{"a, s": 1.0}] * 2, "a, s: not in every round"),
        ([{"a, s": 1.0}], [{"a, s": 0.0}], "a, s: 0.0 is no cost"),
        ([{"a, s": float("nan")}], [{"a, s": 1.0}], "a, s: nan is no cost"),
    ],
)
def test_what_cannot_be_is_an_error(now, then, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        paired(now, then)


def test_goals_are_those_of_the_commit() -> None:
    tick = Pair("simulation alone, calls of 1 s, a simulated second", "ms", [1.0], [1.0])
    assert against.asked(tick, "c9185aa").at_most == pytest.approx(0.625)
    assert not against.asked(tick, "c9185aa").beyond
    assert (against.asked(tick, "b35aadf").at_most, against.asked(tick, "b35aadf").beyond) == (1.03, True)
    assert against.asked(pair([1.0], [1.0]), "c9185aa").at_most is None
    assert against.asked(Pair("way", WITHIN, [2.0], [1.0]), "b35aadf").at_most is None
    assert against.asked(Pair("sample to sink, p99", "ms", [1.0], [1.0]), "b35aadf").limit == 60.0


def test_every_row_that_something_is_asked_of_is_one_that_was_measured() -> None:
    kept = compared(command.AGAINST.read_text("utf-8"))
    for rev, of in against.AGAINST.items():
        measured = {row.what for key, each in kept.items() if key.startswith(rev) for row in each.rows}
        assert {*of, *against.LIMITS} <= measured
    assert {key.split()[1] for key in kept} == set(against.ROUNDS)
    assert {file.stem for file in against.PROBES.glob("probe_*.py")} == {f"probe_{part}" for part in against.ROUNDS}
    assert text_of(kept) == command.AGAINST.read_text("utf-8")


def test_an_unknown_commit_is_an_error_that_names_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["--against", "no-such-branch"]) == 2
    assert "error: --against no-such-branch: no such commit in" in capsys.readouterr().err


def test_an_unknown_part_is_an_error_that_names_those_there_are(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        command.main(["--against", "HEAD", "accuracy"])
    assert "no part accuracy; there are start, sim, plant" in capsys.readouterr().err


@pytest.fixture
def repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A repository of one commit, whose package costs 1 s, with a probe that says so."""
    root, probes = tmp_path / "tree", tmp_path / "probes"
    probes.mkdir()
    probe = "import json, sys\nfrom product import COST\nassert sys.argv[1] in COST.__code__.co_filename\n"
    (probes / "probe_decode.py").write_text(probe + "print(json.dumps({'way, s': COST()}))\n")
    for name, value in {
        "ROOT": root,
        "PROBES": probes,
        "SHORT": {"decode": 1},
        "ROUNDS": {"decode": 2},
    }.items():
        monkeypatch.setattr(against, name, value)
    monkeypatch.setattr(command, "AGAINST", tmp_path / "against.json")
    monkeypatch.setattr(command, "LAST", tmp_path / "last.json")
    monkeypatch.setattr(command, "DOCS", tmp_path)
    monkeypatch.setattr(command, "PAGES", {page.FIRST: []})
    (tmp_path / page.FIRST).write_text(f"{page.BEGIN}\n{page.END}\n")
    (root / "product").mkdir(parents=True)
    (root / "pyproject.toml").write_text('[project]\nname = "product"\nversion = "1"\n')
    (root / "product" / "__init__.py").write_text("def COST(): return 1.0\n")
    git(root, "init", "-q", "-b", "main")
    git(root, "add", ".")
    git(root, "commit", "-qm", "one")
    monkeypatch.setattr(against, "AGAINST", {against.commit("HEAD"): {}})
    return root


@pytest.fixture
def costs(repository: Path) -> Callable[[str], None]:
    """Changes what the present tree costs."""

    def change(source: str) -> None:
        shutil.rmtree(repository / "product" / "__pycache__", ignore_errors=True)  # of the same second and size
        (repository / "product" / "__init__.py").write_text(source)

    return change


def test_the_present_tree_is_measured_against_the_commit(costs, tmp_path: Path, capsys) -> None:
    costs("def COST(): return 2.0\n")  # not committed
    assert command.main(["--against", "HEAD", "--no-keep"]) == 1
    out = capsys.readouterr().out
    assert "2.00 ± 0.00" in out
    assert "MISSED: decode: way, 2 s, 1 s, 2.00 ± 0.00, ratio at most 1.03 beyond its spread\n" in out
    assert not (tmp_path / "against.json").exists()
    assert command.main(["--against", "HEAD"]) == 1
    ((key, comparison),) = compared((tmp_path / "against.json").read_text()).items()
    assert key == f"{against.commit('HEAD')} decode"
    assert comparison.commit == f"{against.commit('HEAD')}+"
    assert [(row.now, row.then) for row in comparison.rows] == [([2.0] * 2, [1.0] * 2)]
    assert "| way | 2 s | 1 s | 2.00 ± 0.00 |" in (tmp_path / page.FIRST).read_text()
    costs("def COST(): return 1.0\n")
    assert command.main(["--against", "HEAD"]) == 0
    assert capsys.readouterr().out.endswith("every goal reached\n")


def test_a_commit_that_no_goal_names_is_only_printed(costs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(against, "AGAINST", {})
    assert command.main(["--against", "HEAD"]) == 0
    assert not (tmp_path / "against.json").exists()


def test_what_only_one_side_has_takes_one_round(costs, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    probe = against.PROBES / "probe_decode.py"
    probe.write_text(probe.read_text().replace("{'way, s': COST()}", "{'way, s': COST()} if COST() > 1 else {}"))
    costs("def COST(): return 2.0\n")
    assert command.main(["--against", "HEAD"]) == 0
    ((_, comparison),) = compared((tmp_path / "against.json").read_text()).items()
    assert [(row.now, row.then) for row in comparison.rows] == [([2.0], [])]
    assert f"not in {against.commit('HEAD')}\n" in capsys.readouterr().out


NOISY = """
import pathlib
def COST():
    n = pathlib.Path("n")
    n.write_text(n.read_text() + "x" if n.exists() else "x")
    return 2.0 if len(n.read_text()) <= 1 else 1.0
"""


@pytest.mark.parametrize(
    ("source", "code", "first", "last"),
    [
        ("def COST(): return 1.29\n", 0, None, f"no row is {SLOW} x as slow\n"),
        ("def COST(): return 1.5\n", 1, "1.50", "SLOWER: decode: way: 1.50 x\n"),
        (NOISY, 0, "2.00", f"no row is {SLOW} x as slow\n"),  # slow in the first try
    ],
)
def test_the_short_form_measures_what_is_slow_once_more(costs, tmp_path, capsys, source, code, first, last) -> None:
    costs(source)
    assert command.main(["--against", "HEAD", "--short"]) == code
    out = capsys.readouterr().out
    assert f"once more: way {first}\n" in out if first else "once more" not in out
    assert out.endswith(last)
    assert not (tmp_path / "against.json").exists()


@pytest.mark.parametrize("broken", ["def COST(): raise OSError('no drive')\n", "def COST(): return 0.0\n"])
def test_a_probe_that_fails_is_a_failure(costs, broken: str, capsys: pytest.CaptureFixture[str]) -> None:
    costs(broken)
    assert command.main(["--against", "HEAD", "--no-keep"]) == 1
    captured = capsys.readouterr()
    assert captured.out.endswith("BROKEN: decode\n")
    assert ("no drive" in captured.err) != ("is no cost" in captured.err)


def test_a_comparison_is_kept_and_written_as_a_table() -> None:
    rows = (
        Pair("way", "s", [1.0, 2.0], [2.0, 2.0], 0.5),
        Pair("new", "ms", [3.0, 3.0], []),
    )
    made = {"abc1234 decode": Comparison("2026-11-30", machine(), "def5678", rows)}
    assert compared(text_of(made))["abc1234 decode"].rows[0].ratios == [0.5, 1.0]
    text = page.with_tables(f"{page.BEGIN}\n{page.END}", {}, made)
    assert "### Against abc1234, turn about\n\n`decode`: def5678, 2026-11-30, Python" in text
    assert "| way | 1.5 s | 2 s | 0.75 ± 0.25 | ratio at most 0.5 | **MISSED** |\n" in text
    assert "| new | 3 ms | not in abc1234 |  |  |  |\n" in text


def base(root: Path, merge_base: str = "") -> str:
    """What .ci/run measures a checkout against; empty: nothing."""
    text = (ROOT / ".ci" / "run").read_text("utf-8")
    function = text[text.index("base() {") : text.index("\n}\n", text.index("base() {")) + 3]
    script = f"set -euo pipefail\n{function}if against=$(base); then echo $against; fi"
    environment = {**os.environ, "CI_MERGE_BASE": merge_base}
    done = subprocess.run(["bash", "-c", script], cwd=root, env=environment, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_ci_measures_against_where_a_branch_began_or_the_commit_before(repository: Path, tmp_path: Path) -> None:
    first = git(repository, "rev-parse", "HEAD")
    assert base(repository) == ""  # one commit alone: nothing to measure against
    git(repository, "commit", "-qm", "two", "--allow-empty")
    second = git(repository, "rev-parse", "HEAD")
    assert base(repository) == first  # no origin
    git(repository, "update-ref", "refs/remotes/origin/main", second)
    assert base(repository) == first  # HEAD is origin/main
    for message in ("three", "four"):
        git(repository, "commit", "-qm", message, "--allow-empty")
    assert base(repository) == second  # a branch of two commits
    assert base(repository, first) == first
    assert base(repository, "0" * 40) == ""  # not in this clone
    git(tmp_path, "clone", "-q", "--depth", "1", f"file://{repository}", "shallow")
    assert base(tmp_path / "shallow") == ""


@pytest.mark.campaign("benchmarks")
@pytest.mark.parametrize("part", against.SHORT)
def test_a_part_is_measured_against_the_commit_itself(part: str) -> None:
    arguments = ["-m", "tests.benchmarks", "--against", "HEAD", "--short", part]
    done = subprocess.run([sys.executable, *arguments], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"{part}: " in done.stdout
