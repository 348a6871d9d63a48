"""`bench.toml`: what is wrong in it is said in one line before anything moves; what is right takes effect."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from accepting import Accepting, SpoiltLink
from shared import table

from bench.accept.accept import closing_lines
from bench.errors import BenchError
from bench.rig.connection import target_of
from bench.rig.settings import Settings, read_settings

pytestmark = pytest.mark.slow

TESTS = """
@limit("spread", "deg", lo=1, hi=2)
@limit("other", "A", lo=0)
def test_measures(measure):
    measure("spread", 2.5)
    measure("other", 0)
"""
WRONG = table("settings")
READ = [*WRONG["read"], [f"target = {'[' * 100_000}", "cannot read bench.toml: it is nested too deeply"]]


@pytest.mark.parametrize(("text", "says"), READ, ids=lambda text: text[:60])
def test_what_is_wrong_is_one_line(text: str, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bench.toml").write_text(text)
    with pytest.raises(BenchError, match=says) as refused:
        read_settings(None)
    assert ("\n" in str(refused.value), refused.value.exit_code) == (False, 2)


@pytest.mark.parametrize(("text", "says"), [*READ[:1], *WRONG["run"]], ids=lambda text: text[:60])
def test_what_is_wrong_is_told_before_anything_runs(accepting: Accepting, capfd, text: str, says: str) -> None:
    Path("bench.toml").write_text(text)
    with pytest.raises(BenchError, match=says) as refused:
        accepting(TESTS)
    assert ("\n" in str(refused.value), refused.value.exit_code) == (False, 2)
    assert not any("measures" in note for note in accepting.screen.notes)
    assert [line for line in capfd.readouterr().err.splitlines() if "compiling" not in line] == []  # on a new machine


def test_what_is_wrong_is_told_whatever_is_selected_and_the_list_shows_what_there_is(accepting: Accepting) -> None:
    Path("bench.toml").write_text("[limits]\n'measures.spraed' = { hi = 3 }")
    text = TESTS + "def test_nothing(drive): pass\n"
    with pytest.raises(BenchError, match=r"did you mean measures.spread\?"):
        accepting(text, keyword="test_nothing")
    with pytest.raises(BenchError, match=r"did you mean measures.spread\?"):
        accepting(text, list_only=True)
    assert "measures.spread: 1 … 2 deg" in accepting.screen.notes
    Path("bench.toml").write_text("[limits]\n'measures.spread' = { lo = 3 }")
    with pytest.raises(BenchError, match="the lower limit 3 is above the upper one, 2"):
        accepting(TESTS, list_only=True)
    with pytest.raises(BenchError, match=r"^no file nowhere\.toml$"):
        accepting(TESTS, bench_toml=Path("nowhere.toml"))


@pytest.mark.parametrize(
    ("name", "meant"),
    [("fig08.a.b", ""),
     ("fig08.a.c", ""),
     ("fig08.d", ".*"),
     ("fig09.a.c", None),
     ("measrues.spread", r": did you mean measures.spread\?"),
     ("measures_other.spread", None),
     ("steady_5.error_max", None),
     ("staedy_50.error_max", r": did you mean steady_50.error_max\?")],
)  # fmt: skip
def test_a_limit_is_refused_only_if_it_is_misspelt_and_told_if_it_is_of_another_run(name: str, meant: str | None):
    """None: of another run; empty: of this one; else what is said."""
    settings = Settings(path=Path("bench.toml"), limits={name: {"hi": 1.0}})
    tests = {"fig08": ["a.b"], "fig08.a": ["c"], "measures": ["spread"], "steady_50": ["error_max"]}
    if meant:
        with pytest.raises(BenchError, match=f"names '{name}', which no test measures{meant}$"):
            settings.check_names(tests)
    else:
        assert settings.check_names(tests) == ([name] if meant is None else [])


def test_the_name_with_the_file_holds_whatever_else_is_run_or_selected_from_elsewhere(accepting, monkeypatch) -> None:
    text = '@limit("err", hi=5)\ndef test_same(measure): measure("err", 1)\n'
    one, other = accepting.write(text, "one"), accepting.write(text, "other")
    Path("here").mkdir()
    monkeypatch.chdir("here")
    Path("bench.toml").write_text(f"[limits]\n'{one.stem}.same.err' = {{ hi = 0.1 }}")
    both = accepting(text, tests=(one, other))
    assert both.tests == {f"{one.stem}.same": "FAIL", f"{other.stem}.same": "PASS"}
    assert [both[name].node_id for name in both.tests] == [f"{one.name}::test_same", f"{other.name}::test_same"]
    assert accepting(text, tests=(one, other), keyword="own_one_").tests == {f"{one.stem}.same": "FAIL"}
    alone = accepting(text, tests=(one,))
    assert (alone.tests, alone.measured["same.err"].limits.hi) == ({"same": "FAIL"}, 0.1)
    Path("bench.toml").write_text(f"[limits]\n'{one.stem}.same.err' = {{ hi = 2 }}\n'same.err' = {{ hi = 3 }}")
    with pytest.raises(BenchError, match=rf"names one measurement twice: {one.stem}\.same\.err and same\.err"):
        accepting(text, tests=(one,))


def test_a_limit_replaces_the_bounds_that_it_names_and_is_marked(accepting: Accepting) -> None:
    """One `bench.toml` for the shipped tests and for those of one's own: what is for others is told, and no error."""
    Path("bench.toml").write_text("[limits]\n'fig08_steady.error_max' = { hi = 3 }\n'measures.spread' = { hi = 3 }")
    run = accepting(TESTS)
    assert run.code == 0  # without the file it is 1, for the same value
    told = "bench.toml has limits for tests that are not in this run, 1: fig08_steady.error_max"
    assert closing_lines(run.result)[1:] == [told]
    spread, other = run.measured["measures.spread"].limits, run.measured["measures.other"].limits
    assert (spread.lo, spread.hi, spread.unit, spread.overridden) == (1, 3, "deg", True)
    assert (other.lo, other.hi, other.overridden) == (0, None, False)
    assert "measures.spread: 1 … 3 deg" in accepting(TESTS, list_only=True).screen.notes


def test_config_is_relative_to_the_file(accepting: Accepting) -> None:
    bench = accepting.directory / "benches" / "left"
    bench.mkdir(parents=True)
    (bench / "motor.toml").write_text("[firmware]\ni_max = 3.5\n")
    (bench / "left.toml").write_text('config = "motor.toml"\n')
    text = '@limit("i_max", "A")\ndef test_tells(drive, measure): measure("i_max", drive.parameters["i_max"])\n'
    assert accepting(text, bench_toml=bench / "left.toml").measured["tells.i_max"].value == pytest.approx(3.5)
    Path("other.toml").write_text("[firmware]\ni_max = 2.5\n")
    run = accepting(text, bench_toml=bench / "left.toml", config=Path("other.toml"))
    assert run.measured["tells.i_max"].value == pytest.approx(2.5)


def test_figures_of_the_simulated_drive_are_not_for_another(accepting: Accepting, link: SpoiltLink) -> None:
    Path("motor.toml").write_text("[firmware]\ni_max = 3.5\n")
    with pytest.raises(BenchError, match=r"--config is for the simulated drive, not for serial:"):
        accepting(TESTS, link, config=Path("motor.toml"))
    Path("bench.toml").write_text('config = "motor.toml"\n')  # what the file says for `sim` does no harm
    assert (accepting(TESTS, link).code, len(link.opened)) == (1, 2)


def test_the_target_is_that_of_the_option_the_environment_the_file_or_sim(monkeypatch: pytest.MonkeyPatch) -> None:
    file = Settings(target="tcp:file:1")
    monkeypatch.setenv("BENCH_TARGET", "tcp:environment:1")
    assert (target_of("tcp:option:1", file), target_of(None, file)) == ("tcp:option:1", "tcp:environment:1")
    monkeypatch.delenv("BENCH_TARGET")
    assert (target_of(None, file), target_of(None, Settings())) == ("tcp:file:1", "sim")


def test_every_key_is_read(tmp_path: Path) -> None:
    file = tmp_path / "a.toml"
    file.write_text(
        'target = "tcp:a:1"\nconfig = "b.toml"\n[rig]\nload = "person"\nperson = true\n'
        '[limits]\n"a.b" = { lo = 1, hi = 2 }'
    )
    assert read_settings(file) == Settings(
        path=file, target="tcp:a:1", config=tmp_path / "b.toml", load="person", person=True,
        limits={"a.b": {"lo": 1.0, "hi": 2.0}},
    )  # fmt: skip
    assert re.fullmatch(r"no file .*nowhere\.toml", _refused(tmp_path / "nowhere.toml"))
    assert _refused(tmp_path).startswith(f"cannot read {tmp_path}: ")


def _refused(path: Path) -> str:
    with pytest.raises(BenchError) as refused:
        read_settings(path)
    return str(refused.value)
