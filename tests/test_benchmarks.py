"""The machinery of `python -m tests.benchmarks`, on parts that measure nothing; and the tables that are kept."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.benchmarks import __main__ as command
from tests.benchmarks import page, reference
from tests.benchmarks.last import Measured, compared, read, slower, text_of
from tests.benchmarks.parts import LONG, PARTS
from tests.benchmarks.table import KERNEL, Row, cost, speed

PAGE = "# Page\n\n<!-- benchmarks: begin -->\nold\n<!-- benchmarks: end -->\n\nMore.\n"
GOOD = speed("reading", 400.0, "frames/s", 300)


class Parts:
    """Two parts, `one` and `two`, in place of the real ones; what they return, and where figures are kept."""

    def __init__(self, folder: Path) -> None:
        self.rows: dict[str, Callable[[], list[Row]]] = {"one": lambda: [GOOD], "two": lambda: [cost("way", 2.0, "s")]}
        self.short: list[bool] = []
        self.last, self.page = folder / "last.json", folder / "page.md"
        self.page.write_text(PAGE)

    def module(self, part: str) -> SimpleNamespace:
        def rows(short: bool) -> Iterator[Row]:
            self.short.append(short)
            yield from self.rows[part]()

        return SimpleNamespace(rows=rows)

    @property
    def kept(self) -> dict[str, Measured]:
        return read(self.last.read_text())


@pytest.fixture
def parts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Parts:
    made = Parts(tmp_path)
    for module in (command, page):
        monkeypatch.setattr(module, "PARTS", {part: f"Part {part}" for part in made.rows})
    for part in made.rows:
        monkeypatch.setitem(sys.modules, f"tests.benchmarks.bench_{part}", made.module(part))
    monkeypatch.setattr(command, "LAST", made.last)
    monkeypatch.setattr(command, "AGAINST", tmp_path / "against.json")
    monkeypatch.setattr(command, "DOCS", made.page.parent)
    monkeypatch.setattr(command, "PAGES", {made.page.name: list(made.rows)})
    monkeypatch.setattr(reference, "seconds", lambda repeat: KERNEL)
    return made


def raising(error: BaseException) -> Callable[[], list[Row]]:
    def rows() -> list[Row]:
        raise error

    return rows


def measured(*rows: Row, kernel: float = 0.05) -> Measured:
    return Measured("2026-11-23", "Python 3.11.7, 2 cores, x86_64", kernel, tuple(row.beside(kernel) for row in rows))


@pytest.mark.parametrize(
    ("before", "now", "kernel", "times"),
    [
        (speed("x", 100, "/s"), speed("x", 80, "/s"), 0.05, 1.25),
        (speed("x", 100, "/s"), speed("x", 90, "/s"), 0.05, None),
        (cost("x", 1.0, "s"), cost("x", 1.2, "s"), 0.05, 1.2),
        (cost("x", 1.0, "s"), cost("x", 0.5, "s"), 0.05, None),
        (speed("x", 100, "/s"), speed("x", 50, "/s"), 0.1, None),  # a machine that is half as fast
        (speed("x", 100, "/s"), speed("x", 100, "/s"), 0.025, 2.0),  # twice as fast, and no quicker
        (Row("x", 1.0, "deg", at_most=True), Row("x", 2.0, "deg", at_most=True), 0.05, None),  # no speed
        (speed("x", 100, "/s"), speed("y", 10, "/s"), 0.05, None),  # something else
    ],
)
def test_slower_is_what_takes_more_runs_of_the_reference_kernel(
    before: Row, now: Row, kernel: float, times: float | None
) -> None:
    found = list(slower(measured(before), measured(now, kernel=kernel)))
    assert found == ([] if times is None else [("x", pytest.approx(times))])


@pytest.mark.parametrize(
    ("row", "kernel", "missed"),
    [
        (speed("x", 299, "/s", 300), KERNEL, True),
        (speed("x", 151, "/s", 300), 2 * KERNEL, False),  # a machine that is half as fast
        (speed("x", 599, "/s", 300), KERNEL / 2, True),
        (cost("x", 1.9, "s", 1.0), 2 * KERNEL, False),
        (cost("x", 0.51, "s", 1.0), KERNEL / 2, True),
        (Row("lost", 1, "", 0, at_most=True), 2 * KERNEL, True),  # no speed
    ],
)
def test_a_goal_of_speed_is_judged_beside_the_reference_kernel(row: Row, kernel: float, missed: bool) -> None:
    assert row.beside(kernel).missed == missed


def test_a_full_run_keeps_figures_with_their_ratios_and_writes_the_page(
    parts: Parts, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command.main([]) == 0
    assert parts.short == [False, False]
    assert parts.kept["one"].rows == (Row("reading", 400.0, "frames/s", 300, False, True, pytest.approx(10.4)),)
    assert parts.kept["two"].rows == (Row("way", 2.0, "s", None, True, True, pytest.approx(76.923, rel=1e-4)),)
    assert parts.page.read_text() == page.with_tables(PAGE, parts.kept)
    assert "every goal reached" in capsys.readouterr().out
    # what became slower is named and is no failure
    parts.rows["two"] = lambda: [cost("way", 3.0, "s")]
    assert command.main([]) == 0
    assert "slower than last: two: way: 1.50 x\n" in capsys.readouterr().out
    assert parts.kept["two"].rows[0].measured == 3.0


@pytest.mark.parametrize("row", [speed("reading", 299.0, "frames/s", 300), Row("lost", 1, "", 0, at_most=True)])
def test_a_missed_goal_is_named_and_is_a_failure(parts: Parts, row: Row, capsys: pytest.CaptureFixture[str]) -> None:
    parts.rows["one"] = lambda: [row]
    assert command.main([]) == 1
    assert f"MISSED: one: {row.what}, " in capsys.readouterr().out
    assert "**MISSED**" in parts.page.read_text()
    assert set(parts.kept) == {"one", "two"}


@pytest.mark.parametrize("short", [True, False])
@pytest.mark.parametrize(
    "rows",
    [
        raising(RuntimeError("no drive")),
        list,
        lambda: [GOOD, GOOD],
        lambda: [Row("error", math.nan)],
        lambda: [Row("error", math.inf)],
        lambda: [speed("reading", 0.0, "frames/s")],
    ],
    ids=["raises", "no figures", "one name twice", "nan", "inf", "no speed"],
)
def test_a_broken_part_is_a_failure_and_the_others_run(
    parts: Parts, rows: Callable[[], list[Row]], short: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    command.main(["one"])
    before = parts.kept["one"]
    parts.rows["one"] = rows
    assert command.main(["--short"] if short else []) == 1
    captured = capsys.readouterr()
    assert captured.out.endswith("BROKEN: one\n")
    assert "Traceback" in captured.err
    assert ("two" in parts.kept) != short
    assert parts.kept["one"] == before


def test_parts_that_were_not_run_keep_their_figures_in_their_place(parts: Parts) -> None:
    command.main([])
    parts.rows["one"] = lambda: [speed("reading", 500.0, "frames/s")]
    command.main(["one"])
    assert {part: each.rows[0].measured for part, each in parts.kept.items()} == {"one": 500.0, "two": 2.0}
    parts.last.unlink()
    command.main(["two"])
    command.main(["one"])
    assert list(parts.kept) == ["one", "two"]


@pytest.mark.parametrize(
    ("arguments", "two", "ends"),
    [(["--short"], lambda: [GOOD], 0),  # goals are not for the short form
     (["--no-keep"], lambda: [GOOD], 1),
     ([], raising(KeyboardInterrupt()), KeyboardInterrupt)],
)  # fmt: skip
def test_neither_the_short_form_nor_a_look_nor_an_interrupted_run_is_kept(parts: Parts, arguments, two, ends) -> None:
    command.main([])
    before = parts.last.read_text(), parts.page.read_text()
    parts.rows |= {"one": lambda: [speed("reading", 1.0, "frames/s", 300)], "two": two}
    if isinstance(ends, int):
        assert command.main(arguments) == ends
    else:
        with pytest.raises(ends):
            command.main(arguments)
    assert (parts.last.read_text(), parts.page.read_text()) == before


def test_every_part_has_its_module_its_figures_and_its_table() -> None:
    text = command.LAST.read_text("utf-8")
    last = read(text)
    assert text_of(last) == text
    assert list(last) == [part for part in PARTS if part in last or part not in LONG]
    assert all(each.rows for each in last.values())
    assert {file.stem for file in command.LAST.parent.glob("bench_*.py")} == {f"bench_{part}" for part in PARTS}
    assert sorted(part for parts in page.PAGES.values() for part in parts) == sorted(PARTS)
    for name, parts in page.PAGES.items():
        text = (command.DOCS / name).read_text("utf-8")
        its = {part: last[part] for part in parts if part in last}
        against = compared(command.AGAINST.read_text("utf-8")) if name == page.FIRST else None
        assert text == page.with_tables(text, its, against)  # else: python -m tests.benchmarks
    for row in (row for each in last.values() for row in each.rows):
        assert (row.ratio is not None) == row.timed


@pytest.mark.campaign("benchmarks")
@pytest.mark.parametrize("part", PARTS)
def test_a_part_runs_in_its_short_form(part: str) -> None:
    done = subprocess.run([sys.executable, "-m", "tests.benchmarks", "--short", part], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
