"""docs/study.md: what its generator makes of the shipped study, which a short form of it still runs."""

from __future__ import annotations

import importlib.util
import json
import re
import shlex
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from click.testing import CliRunner

from bench.cli import cli
from bench.study.study import EXPERIMENT, TOP, read_study
from bench.study.variation import KINDS, OPTIONS

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs" / "study.md"


@pytest.fixture(scope="module")
def generator() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_study", ROOT / "docs" / "make_study.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def numbers(generator: ModuleType) -> dict[str, Any]:
    return json.loads(generator.NUMBERS.read_text())


def test_the_page_is_what_its_generator_makes(generator: ModuleType) -> None:
    assert PAGE.read_text() == generator.page(numbers(generator))  # else: python docs/make_study.py


def test_each_statement_has_an_interval_and_each_yield_all_drives(generator: ModuleType) -> None:
    found = numbers(generator)
    study = read_study(generator.STUDY)
    assert found["drives"] == study.samples
    assert {one["design"] for one in found["yields"]} == set(study.designs)
    for one in found["yields"]:
        assert one["passed"] + one["failed"] + one["unknown"] == study.samples
        assert one["share"]["lo"] <= one["share"]["value"] <= one["share"]["hi"]
        assert one["share"]["hi"] - one["share"]["lo"] > 0.0
    lines = re.findall(r"^- (?:All tests|\w+\.control\.rms): .*$", PAGE.read_text(), re.M)
    assert len(lines) == 3 + 3 * 4
    assert all(re.search(r"±|…|less than", line) for line in lines)


@pytest.mark.slow
@pytest.mark.long("80 rows of four courses each, and a report with pictures")
def test_a_short_form_of_it_runs_and_agrees(generator: ModuleType, tmp_path: Path) -> None:
    """20 drives on two workers: what passes lies where the page says, as far as 20 drives can tell."""
    short = generator.study(2, 20, tmp_path / "report.html")
    assert short["drives"] == 20
    whole = {(one["test"], one["design"]): one["share"] for one in numbers(generator)["yields"]}
    for one in short["yields"]:
        there, here = whole[one["test"], one["design"]], one["share"]
        assert here["lo"] <= there["hi"], one
        assert there["lo"] <= here["hi"], one
    assert (tmp_path / "report.html").stat().st_size > 100_000


def test_the_page_names_all_that_a_study_may_say() -> None:
    text = PAGE.read_text()
    words = {*TOP} - {"name"} | {*KINDS} | {*OPTIONS} | {key for keys in EXPERIMENT.values() for key in keys}
    assert [word for word in words if not re.search(rf"\b{word}\b", text)] == []


@pytest.mark.slow
def test_the_ten_lines_of_the_page_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As they stand there, with fewer drives, and the commands after them."""
    monkeypatch.chdir(tmp_path)
    text = PAGE.read_text()
    (toml,) = re.findall(r"<<'END'\n(.*?)\nEND\n", text, re.S)
    Path("tolerances.toml").write_text(toml)
    run = CliRunner().invoke(cli, ["study", "run", "tolerances.toml", "--samples", "80", "--workers", "1"])
    assert run.exit_code == 0, run.output
    assert re.search(r"^fast: \d\d\.\d % pass \(.* … .* %\), \d+ of 80 drives$", run.stdout, re.M), run.stdout
    assert re.search(r"^worst: fast\.vector_tracking\.rms [\d.]+, ≤ 3 deg: bench study replay ", run.stdout, re.M), (
        run.stdout
    )
    assert Path("tolerances.study/report.html").exists()
    for line in re.findall(r"^bench (study replay .*?)(?:  +#.*)?$", text, re.M):
        done = CliRunner().invoke(cli, shlex.split(line))
        assert done.exit_code == 0, done.output
    assert Path("row71/fast.run").is_dir()
    info = CliRunner().invoke(cli, ["accept", "sim", "--list", "--config", "row71.toml"])
    assert info.exit_code == 0, info.output
