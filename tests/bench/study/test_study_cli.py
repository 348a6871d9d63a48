"""`bench study`: what is there is kept and never computed again, and what cannot be done says why."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from pyarrow import parquet
from test_study_file import TEN_LINES, written

from bench.cli import cli
from bench.study import store as storing
from bench.study.experiments import compute
from bench.study.store import Store, read_rows
from bench.study.study import read_study
from bench.study.worker import identity


def study(*arguments: object) -> Result:
    return CliRunner().invoke(cli, ["study", *map(str, arguments)])


def columns(folder: Path) -> dict[str, list[object]]:
    """All that rows depend on."""
    table = storing.table_in(folder)
    there = [name for name in table.column_names if name not in ("cpu_s", "worker", "version", "ended")]
    return {name: table.column(name).to_pylist() for name in there}


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("done")
    result = study("run", written(folder), "--workers", 1)
    assert result.exit_code == 0, result.output
    return folder / "study.study"


def test_what_is_there_is_not_computed_again(done: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    part = tmp_path / "part.study"
    shutil.copytree(done, part)
    files = sorted(part.glob("rows-*.parquet"))
    assert len(files) > 2
    files[1].unlink()
    before = [file.read_bytes() for file in (files[0], *files[2:])]
    result = study("run", written(tmp_path), "--workers", 1, "--out", part)
    assert result.exit_code == 0, result.output
    assert "rows of 8 there already" in result.stderr
    assert [file.read_bytes() for file in (files[0], *files[2:])] == before
    assert columns(part) == columns(done)
    monkeypatch.setattr("bench.study.experiments.row_of", None)
    assert study("run", written(tmp_path), "--workers", 1, "--out", part).exit_code == 0


def test_more_drives_are_added_and_fewer_are_another_study(done: Path, tmp_path: Path) -> None:
    part = tmp_path / "part.study"
    shutil.copytree(done, part)
    assert study("run", written(tmp_path), "--workers", 1, "--out", part, "--samples", 12).exit_code == 0
    more = read_rows(part)
    assert more.row.tolist() == list(range(12))
    assert np.array_equal(more.measured["fast.speed.std"][:8], read_rows(done).measured["fast.speed.std"])
    fewer = study("run", written(tmp_path), "--workers", 1, "--out", part, "--samples", 4)
    assert fewer.exit_code != 0
    assert "holds rows of another study (samples): choose another name with --out, or --overwrite" in str(
        fewer.exception
    )


def test_another_study_and_another_version_are_refused(done: Path, tmp_path: Path) -> None:
    other = written(tmp_path, TEN_LINES.replace("0.05", "0.06"))
    assert "of another study (varied)" in str(study("run", other, "--workers", 1, "--out", done).exception)
    part = tmp_path / "part.study"
    shutil.copytree(done, part)
    made_by = json.loads((part / "made_by.json").read_text())
    (part / "made_by.json").write_text(json.dumps(made_by | {"sources of sim": "0123456789ab"}))
    refused = study("run", written(tmp_path), "--workers", 1, "--out", part, "--samples", 9)
    assert f"(sources of sim 0123456789ab, now {made_by['sources of sim']})" in str(refused.exception)
    assert study("run", written(tmp_path), "--workers", 1, "--out", part, "--overwrite").exit_code == 0
    assert columns(part) == columns(done)


def test_a_folder_of_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "a.txt").write_text("mine")
    refused = study("run", written(tmp_path), "--workers", 1, "--out", tmp_path / "notes", "--overwrite")
    assert "is there and holds no study" in str(refused.exception)
    assert (tmp_path / "notes" / "a.txt").read_text() == "mine"
    assert "holds no study: there is no study.json" in str(study("report", tmp_path / "notes").exception)


def test_two_do_not_write_at_once(done: Path, tmp_path: Path) -> None:
    with Store(tmp_path / "a.study", read_study(written(tmp_path)), identity()):
        busy = study("run", written(tmp_path), "--workers", 1, "--out", tmp_path / "a.study")
    assert "is being written by another bench study" in str(busy.exception)


def test_many_files_become_one_and_rows_in_two_count_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(storing, "MOST_FILES", 2)
    made = read_study(written(tmp_path))
    with Store(tmp_path / "a.study", made, identity()) as store:
        for rows in ((0, 1), (2,), (3,)):
            store.add(compute(made.text, rows), "here:1")
    (file,) = (tmp_path / "a.study").glob("rows-*.parquet")
    shutil.copy(file, file.with_name("rows-000009.parquet"))  # as if it had died before the old ones were removed
    (file.parent / ".abcdef.part").write_bytes(b"cut")
    assert read_rows(file.parent).row.tolist() == [0, 1, 2, 3]
    assert parquet.read_table(file).column("worker").to_pylist() == ["here:1"] * 4


def test_a_row_once_more(done: Path, tmp_path: Path) -> None:
    same = study("replay", done, 3, "--json", tmp_path / "row.json", "--drive", tmp_path / "drive.toml")
    assert same.exit_code == 0
    assert "row 3: drive 3, seed" in same.stdout
    assert same.stdout.rstrip().endswith("equal to the study's row, bit for bit")
    assert json.loads((tmp_path / "row.json").read_text())["v.fast"] == "PASS"
    assert "has the rows 0 to 7, not 8" in str(study("replay", done, 8).exception)
    part = tmp_path / "part.study"
    shutil.copytree(done, part)
    for file in part.glob("rows-*.parquet"):
        table = parquet.read_table(file)
        k = table.column_names.index("m.fast.speed.std")
        values = table.column(k).to_numpy() * (1 + 1e-15)
        parquet.write_table(table.set_column(k, "m.fast.speed.std", [values]), file)
    other = study("replay", part, 3)
    assert other.exit_code == 1
    assert "m.fast.speed.std was" in other.stdout
