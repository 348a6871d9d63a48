"""Rows: each depends on the study and its number alone, and equals what the other commands measure on that drive."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from click.testing import CliRunner
from test_study_file import TEN_LINES, written

import bench
from bench.cli import cli
from bench.study.experiments import compute, limits_of, row_of
from bench.study.replay import replay
from bench.study.run import StudyOptions, run
from bench.study.store import Store, open_study, read_rows
from bench.study.study import Study, read_study
from bench.study.worker import identity

MINE = """
def measure(rig):
    rig.drive.speed(rpm=500)
    rig.wait(0.2)
    run = rig.record(0.1)
    assert run["i_q"].mean() < 5.0, "too much current"
    return {"i_q": run["i_q"].mean(), "edges": len(run.edges)}

def wrong(rig):
    return {"i_q": 1 / 0}

def refused(rig):
    rig.drive.speed(rpm=1e6)

def failing(rig):
    assert not "good"
"""
SUITE = '\n[experiments.suite]\naccept = "fig09 or current_loop"\n'


class Quiet:
    """Nobody looks."""

    def note(self, text: str) -> None:
        pass

    def progress(self, text: str) -> None:
        pass


def made(folder: Path, text: str = TEN_LINES) -> Study:
    (folder / "mine.py").write_text(MINE)
    return read_study(written(folder, text))


def rows(study: Study, *numbers: int) -> list[dict[str, Any]]:
    found = pa.ipc.open_stream(compute(study.text, numbers)).read_all().to_pylist()
    return [{key: value for key, value in row.items() if key != "cpu_s"} for row in found]


def test_a_row_is_the_same_in_any_batch_and_any_thread(tmp_path: Path) -> None:
    study = made(tmp_path, TEN_LINES + '[experiments.own]\nfunction = "mine.py:measure"\n' + SUITE)
    together = rows(study, 0, 1, 2)
    assert rows(study, 2, 1) == together[:0:-1]
    found: list[Any] = []
    thread = threading.Thread(target=lambda: found.extend(rows(study, 1)))
    thread.start()
    thread.join()
    assert found == together[1:2]
    assert {key: together[0][key] for key in ("row", "sample", "repetition", "design")} == dict.fromkeys(
        ("row", "sample", "repetition", "design"), 0
    )


def test_a_row_is_what_bench_accept_measures_on_that_drive_and_seed(tmp_path: Path) -> None:
    """Bit for bit, by the configuration that `bench study replay --drive` writes."""
    study = made(tmp_path, "samples = 3\n[vary]\n" + TEN_LINES.split("[vary]")[1].split("[experiments")[0] + SUITE)
    folder = run(StudyOptions(tmp_path / "study.toml", workers=1), Quiet(), float)
    drive, results = tmp_path / "drive.toml", tmp_path / "results.json"
    row, differences = replay(folder, 2, drive=drive)
    assert not differences
    command = [
        "accept",
        "sim",
        "--config",
        drive,
        "--seed",
        row["seed"],
        "-k",
        "fig09 or current_loop",
        "--json",
        results,
    ]
    CliRunner().invoke(cli, [str(word) for word in command])
    tests = json.loads(results.read_text())["tests"]
    measured = {one["name"]: one["value"] for test in tests for one in test["measurements"]}
    assert len(measured) > 20
    assert {name.removeprefix("m."): value for name, value in row.items() if name.startswith("m.")} == measured
    assert {name: row[f"v.{name}"] for name in {test["name"] for test in tests}} == {
        test["name"]: test["verdict"] for test in tests
    }
    name = "m.fig09_start_up.proposed.error_max"
    assert row[name] != rows(study, 1)[0][name]


def test_the_recording_of_a_row_shows_what_was_measured(tmp_path: Path) -> None:
    """Angles are telemetered to 360 / 65536 degrees."""
    made(tmp_path)
    folder = run(StudyOptions(tmp_path / "study.toml", workers=1), Quiet(), float)
    row, _ = replay(folder, 5, save=tmp_path / "row5")
    (whole, *more) = list(bench.open(tmp_path / "row5" / "fast.run"))
    assert not more
    tick_hz = whole.samples.config.tick_hz
    late = whole.samples.tick >= 0.5 * tick_hz
    for name, channel in (("vector_tracking", "theta_vt"), ("edge_kalman", "theta_ek")):
        off = whole["theta_true"][late] - whole[channel][late]
        error = np.degrees(np.angle(np.exp(1j * off)))
        assert row[f"m.fast.{name}.rms"] == pytest.approx(np.sqrt((error**2).mean()), abs=0.006)
    assert len(whole.edges) > 80


def test_the_recording_of_a_row_has_the_angle_in_control(tmp_path: Path) -> None:
    """Also where it is one that is streamed on request alone, and no observer is named."""
    text = 'samples = 1\n[set]\n"firmware.observer" = 10\n[experiments."fast, at last"]\nspeed = 1000\nseconds = 0.4\n'
    made(tmp_path, text)
    folder = run(StudyOptions(tmp_path / "study.toml", workers=1), Quiet(), float)
    row, differences = replay(folder, 0, save=tmp_path / "row0")
    assert not differences
    (whole,) = list(bench.open(tmp_path / "row0" / "fast_at_last.run"))
    late = whole.samples.tick >= 0.2 * whole.samples.config.tick_hz
    off = whole["theta_true"][late] - whole["theta_ek"][late]
    error = np.degrees(np.angle(np.exp(1j * off)))
    assert row["m.fast, at last.control.rms"] == pytest.approx(np.sqrt((error**2).mean()), abs=0.006)


def test_what_a_function_may_do_is_a_verdict(tmp_path: Path) -> None:
    texts = [f'[experiments.{name}]\nfunction = "mine.py:{name}"\n' for name in ("wrong", "refused", "failing")]
    text = "samples = 1\n" + "".join(texts) + '[experiments.measure]\nfunction = "mine.py:measure"\n'
    (row,) = rows(made(tmp_path, text + "limits = { i_q = { hi = 0 }, other = { hi = 1 } }\n"), 0)
    assert row["v.wrong"] == "ERROR"
    assert row["why.wrong"] == "ZeroDivisionError: division by zero"
    assert row["v.refused"] == "INVALID"
    assert "OUT_OF_RANGE (330)" in row["why.refused"]
    assert (row["v.failing"], row["why.failing"]) == ("FAIL", "an assertion failed")
    assert row["v.measure"] == "FAIL"
    assert row["why.measure"] == f"i_q = {row['m.measure.i_q']:.4g}"


def test_what_was_not_measured_is_unknown(tmp_path: Path) -> None:
    text = 'samples = 1\n[experiments.measure]\nfunction = "mine.py:measure"\nlimits = { other = { hi = 1 } }\n'
    (row,) = rows(made(tmp_path, text), 0)
    assert (row["v.measure"], row["why.measure"]) == ("INVALID", "other = nan")


def test_a_drive_that_cannot_be_is_unknown_and_says_why(tmp_path: Path) -> None:
    lists = "{ choice = [[0, 0, 0, 0, 0, 0], [-29, 29, 0, 0, 0, 0]] }"
    study = made(tmp_path, TEN_LINES.replace("{ uniform = [-4, 4] }", lists) + '[set]\n"hall.hysteresis_deg" = 5\n')
    found = rows(study, *range(8))
    impossible = [row for row in found if row["v.fast"] == "INVALID"]
    assert len(impossible) == 4
    assert all("leaves sector" in row["why.fast"] for row in impossible)
    assert all(row["m.fast.edge_kalman.rms"] is None for row in impossible)


def test_a_trip_is_a_failure_and_leaves_nothing_measured(tmp_path: Path) -> None:
    text = TEN_LINES + '[set]\n"firmware.protection.i_trip" = 0.5\n'
    (row,) = rows(made(tmp_path, text.replace("speed = 1000", "speed = 1000\nload = 0.3")), 0)
    assert (row["v.fast"], row["why.fast"]) == ("FAIL", "the drive tripped: OVERCURRENT")
    assert row["m.fast.tripped"] == 1.0


def test_limits_of_all_that_is_judged(tmp_path: Path) -> None:
    study = made(tmp_path, TEN_LINES + SUITE)
    limits = {name: one for each in study.experiments for name, one in limits_of(study, each).items()}
    assert str(limits["fast.edge_kalman.rms"]) == "≤ 1 deg"
    assert str(limits["fast.tripped"]) == "≤ 0"
    assert str(limits["fig09_start_up.average.initial_error"]) == "≤ 45 deg"


def test_rows_are_read_as_columns(tmp_path: Path) -> None:
    study = made(tmp_path, "repetitions = 2\n" + TEN_LINES)
    folder = tmp_path / "a.study"
    with Store(folder, study, identity()) as store:
        for numbers in ((5, 3), (0,), (3, 5, 8)):
            store.add(compute(study.text, numbers), "here:1")
        assert np.flatnonzero(store.done).tolist() == [0, 3, 5, 8]
        assert list(store.missing())[:4] == [1, 2, 4, 6]
    found = read_rows(folder)
    assert found.row.tolist() == [0, 3, 5, 8]
    assert found.sample.tolist() == [0, 1, 2, 4]
    assert found.repetition.tolist() == [0, 1, 1, 0]
    assert found.passed("fast").all()
    assert np.array_equal(found.inputs["motor.R_s"], study.inputs([0, 3, 5, 8])[:, 0])
    assert open_study(folder).text == study.text
    assert row_of(study, 3, study.inputs([3])[0])["m.fast.edge_kalman.rms"] == found.measured["fast.edge_kalman.rms"][1]
