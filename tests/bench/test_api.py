"""What `import bench` offers beside a rig says what the commands say, of a recording, its path, and its capture."""

from __future__ import annotations

import importlib
import inspect
import json
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner
from matplotlib.figure import Figure

import bench
from bench.cli import cli
from bench.export import ENDINGS
from bench.files import leaves
from bench.record.reader import BESIDE
from bench.record.recording import CapturedRun, Source
from tests.choice import sampled

DATA = Path(__file__).parents[1] / "data"
STEADY, REVERSAL = DATA / "steady.run", DATA / "reversal.run"
KINDS = ("path", "recording", "capture")


@cache
def told(*arguments: object) -> dict[str, object]:
    """What a command writes as JSON."""
    printed = CliRunner().invoke(cli, [*map(str, arguments), "--json", "-"]).stdout
    found: dict[str, object] = json.loads(printed[printed.index("{\n") :])
    return found


def sources(path: Path) -> dict[str, Source]:
    recording = bench.open(path)
    return {"path": str(path), "recording": recording, "capture": recording.read()}


@pytest.mark.parametrize("kind", KINDS)
def test_hall_finds_what_the_command_finds(kind: str) -> None:
    health, command = bench.hall(sources(REVERSAL)[kind]), told("hall", "check", REVERSAL)
    assert (health.verdict, health.exit_code) == ("PASS", command["exit_code"])
    table = health.measured.to_pandas()
    angles = [edge[way]["angle_deg"] for edge in command["edges"] for way in ("up", "down")]  # type: ignore[attr-defined]
    assert (table["n"] > 10).all()
    late = (np.array(angles) - table["ideal"] + 180.0) % 360.0 - 180.0
    assert table["late"].to_numpy() == pytest.approx(late.to_numpy(), abs=1e-9)
    part = bench.hall(sources(REVERSAL)[kind], 0.3, 0.5)
    assert part.codes.edges < 0.5 * health.codes.edges


@pytest.mark.parametrize("kind", KINDS)
def test_compare_finds_what_the_command_finds(kind: str) -> None:
    a, b = sources(STEADY)[kind], sources(REVERSAL)[kind]
    table, rows = bench.compare(a, b, begin=0.1, channels=["i_q", "theta_vt"]).to_pandas(), told(
        "compare", STEADY, REVERSAL, "--from", 0.1, "--channels", "i_q,theta_vt"
    )["rows"]  # fmt: skip
    expected = pd.DataFrame(rows).set_index("quantity")
    pd.testing.assert_frame_equal(table, expected)
    assert list(table.index) == ["i_q", *(f"theta_vt error, {what}" for what in ("mean", "rms", "std"))]


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("drawn")


@pytest.mark.slow
@pytest.mark.parametrize("kind", sampled("plots", KINDS, 1, campaign="viewer"))
def test_plots_are_those_of_the_command(kind: str, drawn: Path) -> None:
    plots = bench.plot(sources(STEADY)[kind], 0.1)
    for figure in told("plot", STEADY, "--from", 0.1, "-o", drawn)["figures"]:  # type: ignore[attr-defined]
        mine = plots[figure["figure"]]
        assert (isinstance(mine.figure, Figure), mine.why or None) == (bool(figure["file"]), figure["why_not"])
        assert json.loads(json.dumps(mine.numbers)) == figure["numbers"]


def test_a_capture_of_a_drive_at_rest_counts_all_samples_and_one_that_ran_those_of_running() -> None:
    whole = bench.read(STEADY)
    running = (whole.samples.raw["status"] & 7) == 3
    assert CapturedRun(whole).ran
    assert 0 < running.sum() < len(whole)
    plane = bench.plot(whole)["current_plane"].numbers
    assert plane == bench.plot(STEADY)["current_plane"].numbers
    before = whole.ticks(0, int(whole.samples.tick[np.argmax(running)]) - 1)
    assert not CapturedRun(before).ran


@pytest.mark.parametrize("ending", [ending for ending in ENDINGS.values() if ending != ".rrd"])
def test_a_capture_is_exported_as_its_recording_is(ending: str, tmp_path: Path) -> None:
    done = [bench.export(source, tmp_path / f"{kind}{ending}") for kind, source in sources(STEADY).items()]
    assert done[0].rows == done[1].rows
    assert {**done[0].rows, "marks": 0} == done[2].rows
    if ending == ".csv":
        texts = [each.files["samples"].read_text() for each in done]
        assert texts[0] == texts[1] == texts[2]
    with pytest.raises(bench.BenchError, match="exists"):
        bench.export(STEADY, tmp_path / f"path{ending}")


def test_an_opened_recording_has_tables_of_all_that_was_said(tmp_path: Path) -> None:
    path = tmp_path / "a.run"
    with bench.connect("sim", save=path) as rig:
        rig.drive.set("k_p_speed", 0.1)
        rig.drive.speed(rad_s=50)
        rig.wait(0.3)
        rig.note("a noise", "WARN")
        marked = rig.record(0.2)
    bench_mark = CliRunner().invoke(cli, ["mark", str(path), "grease", "--at", str(marked.t[0])])
    assert bench_mark.exit_code == 0, bench_mark.output
    recording = bench.open(path)
    assert list(recording.events["name"]) == ["STATE_CHANGED"] * 3
    assert list(recording.events["arg"]) == [2.0, 3.0, 1.0]
    assert (recording.notes["text"].iloc[0], recording.notes["level"].iloc[0]) == ("a noise", "WARN")
    assert recording.notes.index[0] == pytest.approx(marked.t[0], abs=0.02)
    assert recording.marks.loc[:, "name"].tolist() == ["grease"]
    assert recording.marks.index[0] == pytest.approx(marked.t[0], abs=1e-6)
    assert recording.changes[recording.changes["name"] == "k_p_speed"]["value"].iloc[0] == pytest.approx(0.1)
    whole = recording.read()
    pd.testing.assert_frame_equal(recording.samples, whole.to_pandas())
    assert recording.samples is recording.samples
    pd.testing.assert_frame_equal(recording.edges, whole.edges.to_pandas())
    assert recording.edges.index.to_numpy() == pytest.approx(whole.edge_t)
    assert recording.edges["hall_new"].tolist() == whole.edges.hall_new.tolist()
    assert sum(map(len, recording)) == sum(map(len, bench.pieces(path))) == len(whole)
    part = recording.read(marked.t[0], marked.t[-1], ["i_q"])
    assert part["i_q"].tolist() == marked["i_q"].tolist()
    assert repr(recording).endswith(" s, 1 marks, 3 events")
    assert recording.info.identity["target"] == "sim"


def test_a_table_that_does_not_fit_into_memory_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    recording = bench.open(STEADY)
    raw = recording.run.rows("samples") * (recording.read().samples.raw.itemsize + 16)
    monkeypatch.setattr("bench.record.reader.available", lambda: 2 * raw + BESIDE)
    assert len(recording.read())
    with pytest.raises(bench.BenchError, match="do not fit into memory"):
        len(recording.samples)


def test_scores_are_those_of_the_command_and_a_table() -> None:
    names = ("drive_vt", "vector_tracking")
    board = bench.score(bench.open(STEADY), bench.read(REVERSAL), observers=names)
    command = told("score", STEADY, REVERSAL, *(f"--observer={name}" for name in names))["observers"]
    ours = dict(leaves(json.loads(json.dumps(board.as_json()["observers"]))))
    assert list(board.pooled) == list(command)  # type: ignore[call-overload]
    assert {k: v for k, v in leaves(command) if "step_ns" not in k} == {
        k: v for k, v in ours.items() if "step_ns" not in k
    }
    table = board.to_pandas()
    assert list(table.index) == list(board.pooled)
    assert list(table["rank"]) == [1, 2]
    for name, figures in board.pooled.items():
        assert table.loc[name, ("moving", "rms")] == figures["moving"]["rms"]
        assert table.loc[name, ("by_sector.3", "std")] == figures["by_sector"]["3"]["std"]


def test_a_channel_is_scaled_once_and_cannot_be_written_to() -> None:
    run = bench.read(STEADY)
    assert run["i_q"] is run["i_q"]
    with pytest.raises(ValueError, match="read-only"):
        run["i_q"][0] = 1.0


def test_two_runs_of_one_seed_are_equal_and_a_configuration_is_taken_in_three_ways(tmp_path: Path) -> None:
    def record(**simulated: object) -> bench.Capture:
        with bench.connect("sim", **simulated) as rig:  # type: ignore[arg-type]
            rig.drive.speed(rpm=300)
            return rig.record(0.1)

    config = {"motor": {"n_p": 4}}
    one, same, other = record(seed=7, config=config), record(seed=7, config=config), record(seed=8, config=config)
    assert one.samples.raw.tobytes() == same.samples.raw.tobytes() != other.samples.raw.tobytes()
    file = tmp_path / "mine.toml"
    file.write_text("[motor]\nn_p = 4\n")
    by_file = record(seed=7, config=file)
    assert by_file.samples.raw.tobytes() == one.samples.raw.tobytes()
    assert record(config="maxon-ec60-flat").parameters["n_p"] == 7
    with pytest.raises(bench.BenchError, match=r"motor\.n_q in overrides; did you mean motor\.n_p"):
        record(config={"motor": {"n_q": 4}})
    with pytest.raises(TypeError, match=r"connect\(\) got an unexpected keyword argument 'limit'"):
        record(limit=3)
    with pytest.raises(bench.BenchError, match="config and seed are for the simulated drive, not for tcp:no:1"):
        bench.connect("tcp:no:1", seed=7)


def test_a_function_that_is_called_like_a_folder_stays_a_function() -> None:
    folders = {name for name in bench.__all__ if (Path(bench.__file__).parent / name).is_dir()}
    assert "hall" in folders
    loaded = f"import sys, bench; print([n for n in {sorted(folders)} if 'bench.' + n not in sys.modules])"
    done = subprocess.run([sys.executable, "-c", loaded], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"  # else add them where bench/__init__.py imports folders first
    for name in folders:
        importlib.import_module(f"bench.{name}")
        assert not inspect.ismodule(getattr(bench, name))


def test_without_pandas_it_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    recording = bench.open(STEADY)
    capture = recording.read()
    monkeypatch.setitem(sys.modules, "pandas", None)
    for table in (capture.to_pandas, capture.edges.to_pandas, lambda: recording.events, lambda: recording.samples):
        with pytest.raises(ImportError, match=r"DataFrames need pandas: pip install 'hallbench\[pandas\]'"):
            table()
