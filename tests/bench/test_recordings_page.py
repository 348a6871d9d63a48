"""docs/recordings.md: its blocks run as they stand, one after the other, and give what is stored."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import duckdb
import exported
import pandas as pd
import pytest
from damage import flip

from bench.cli import main
from bench.record import layout

PAGE = (Path(__file__).parents[2] / "docs" / "recordings.md").read_text()
KEPT = Path(__file__).parents[1] / "data" / "steady.run"
MARK = {"kind": "mark", "tick": 12_000_000, "last": 16_000_000, "name": "steady", "verdict": "PASS"}


def test_the_page_as_it_is_printed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = tmp_path / "spin.run"
    shutil.copytree(KEPT, run)
    with (run / "run.jsonl").open("a") as log:
        log.write(layout.line_of(MARK))
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"^```(\w+)\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    assert {kind for kind, _ in blocks} == {"sh", "python", "sql", "matlab"}
    cells: list[dict[str, Any]] = [{}]
    answers: list[pd.DataFrame] = []
    with duckdb.connect() as database:
        for kind, block in blocks:
            if kind == "sh":
                for line in block.splitlines():
                    main(shlex.split(line)[1:])
            elif kind == "python":
                cells.append(dict(cells[-1]))
                exec(block, cells[-1])
            elif block.startswith("SELECT"):
                answers.append(database.sql(block).df())
            elif kind == "sql":
                database.execute(block)
        channels = database.sql("SELECT * FROM channels").df()
    wanted = exported.expected(run, "samples")
    time, i_q = wanted["time"][0], wanted["i_q"][0]

    checked, opened, part, marks, measured, csv, mdf, mat, npz, parquet = cells[1:]
    assert checked["log"][-1].items() >= MARK.items()
    for name, (values, unit) in wanted.items():
        if name in opened["units"]:
            assert (opened["samples"][name].to_numpy() == values).all()
            assert opened["units"][name] == unit
            (row,) = channels[channels["name"] == name].itertuples(index=False)
            assert row.unit == unit
    assert list(opened["units"]) == list(channels["name"])
    assert (opened["samples"].index.to_numpy() == time).all()
    assert part["part"]["tick"].tolist() == [tick for tick in wanted["tick"][0] if 10_000_000 <= tick <= 12_000_000]
    within = (wanted["tick"][0] >= MARK["tick"]) & (wanted["tick"][0] <= MARK["last"])
    assert (marks["marked"]["i_q"].to_numpy() == i_q[within]).all()
    assert marks["first"]["verdict"] == "PASS"
    between = (time >= 0.55) & (time <= 1.1)
    assert measured["table"].loc["i_a", "std"] == pytest.approx(wanted["i_a"][0][between].std(), rel=1e-9)
    assert 49.5 < measured["f"] < 50.5

    means, counted, largest, joined = answers
    first = (time >= means["t"][10]) & (time < means["t"][11])
    assert means["i_q"][10] == pytest.approx(i_q[first].mean(), rel=1e-9)
    assert counted.to_numpy().tolist() == [["steady", "PASS", within.sum()]]
    assert largest.iloc[0, 0] == i_q[(time >= 0.5) & (time <= 0.6)].max()
    assert (joined["i_q"].to_numpy() == i_q[within]).all()

    assert (csv["i_q"].to_numpy() == i_q).all()
    assert (csv["i_q"].index.to_numpy() == time).all()
    assert (mdf["signal"].samples == i_q).all()
    assert mdf["signal"].unit == mat["unit"] == parquet["unit"] == npz["units"]["samples/i_q"] == "A"
    assert (mdf["counts"] == exported.stored(run, "samples").column("i_q").to_numpy()).all()
    assert mdf["kinds"].tolist().count(b"mark") == 1
    for cell in (mat, npz):
        assert (cell["i_q"] == i_q).all()
    assert (npz["time"] == time).all()
    assert (parquet["samples"]["i_q"].to_numpy() == i_q).all()
    assert (mdf["about"], npz["started"]) == (parquet["about"], parquet["about"]["started"])
    assert (tmp_path / "spin.rrd").stat().st_size > 100_000
    assert list(pd.read_csv("part.csv"))[3:5] == ["theta_enc [rad]", "theta_vt [rad]"]


def test_damage_is_found_by_the_pages_check(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    check = next(iter(re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)))
    for file in ("run.jsonl", "samples-000001.parquet", "edges-000001.parquet"):
        shutil.copytree(KEPT, "spin.run", dirs_exist_ok=True)
        flip(Path("spin.run", file), Path("spin.run", file).stat().st_size // 2)
        with pytest.raises(AssertionError):
            exec(check, {})


def test_the_page_names_every_kind_of_line_and_every_file(tmp_path: Path) -> None:
    written = {record["kind"] for record in exported.said(exported.record(tmp_path / "a.run", 3))}
    assert written | {"removed", "rebooted", "misdated"} == set(
        re.findall(r"`(\w+)`", " ".join(re.findall(r"^\| (`[^|]*) \|", log_table(), re.MULTILINE)))
    )
    names = {
        layout.LOG,
        layout.journal_name(2),
        *(layout.file_name(name, 1) for name in ("samples", "edges", "overview")),
    }
    assert not {name for name in names if f"`{name}`" not in PAGE}


def log_table() -> str:
    return PAGE.split("The lines of the log have a `kind`:")[1].split("Every line ends")[0]
