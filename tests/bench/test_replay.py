"""`bench replay`: what the drive computed comes out again bit for bit, and nothing that was recorded is lost."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from damage import flip

import bench
from bench.cli import cli
from bench.errors import BenchError
from bench.record.folder import SegmentFile
from bench.record.reader import Run
from bench.record.sink import RunSink
from bench.replay.estimators import Estimators, raw_counts
from bench.replay.replay import replay
from bench.score.board import score
from bench.signal.chunks import part
from protocol.signals import Status
from protocol.streams import Gap

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def run(drive_run: Path) -> Run:
    return Run(drive_run)


def drive_resets(run: Run) -> int:
    resets = int(np.count_nonzero(run.samples.raw["status"] & Status.OBSERVERS_RESET))
    assert resets >= 1
    return resets


@pytest.fixture(scope="module")
def replayed(drive_run: Path, run: Run, tmp_path_factory: pytest.TempPathFactory) -> Run:
    out = tmp_path_factory.mktemp("replay") / "out.run"
    result = replay(drive_run, out=out)
    assert result.restarts == {"start": 1, "drive": drive_resets(run), "lost_samples": 0, "lost_edges": 0}
    assert (result.lost_samples, result.lost_edges) == (0, 0)
    return Run(out)


def test_all_that_was_recorded_is_still_there(run: Run, replayed: Run) -> None:
    for name in run.samples.raw.dtype.names:
        assert np.array_equal(run.samples.raw[name], replayed.samples.raw[name]), name
    for name in ("index", "tick"):
        assert np.array_equal(getattr(run.samples, name), getattr(replayed.samples, name))
    for name in ("index", "tick", "hall_old", "hall_new", "illegal", "encoder"):
        assert np.array_equal(getattr(run.edges, name), getattr(replayed.edges, name))
    assert len(run.events) >= 4
    assert (replayed.events, replayed.marks, len(run.marks)) == (run.events, run.marks, 1)
    assert replayed.notes == run.notes
    assert "WARN" in [note.level for note in run.notes]
    assert replayed.summary.startswith("# The run\n")
    assert "# Replay" in replayed.summary
    assert (replayed.info.parameters, replayed.info.started) == (run.info.parameters, run.info.started)
    assert replayed.info.recording_id != run.info.recording_id


@pytest.mark.parametrize("lost", ["samples", "edges"])
def test_after_a_gap_the_observers_begin_anew(run: Run, lost: str, tmp_path: Path) -> None:
    gap, width = 14_000, 300
    assert run.samples.raw["status"][gap] & 7 == 3  # running
    first, second = part(run.samples, 0, gap), part(run.samples, gap, len(run.samples))
    due = int(np.searchsorted(run.edges.tick, first.tick[-1], side="right"))
    edges = [part(run.edges, 0, due), part(run.edges, due, len(run.edges))]
    if lost == "samples":
        second = replace(part(run.samples, gap + width, len(run.samples)), gaps=(Gap(0, width, 12, False),))
        anew = gap
    else:
        edges[1] = replace(part(run.edges, due + 2, len(run.edges)), gaps=(Gap(0, 2, 1, False),))
        anew = int(np.searchsorted(run.samples.tick, edges[1].tick[0]))
    sink = RunSink(tmp_path / "gap.run", run.info, wait=True)
    for edge_chunk, samples in zip(edges, (first, second), strict=True):
        sink.take(edge_chunk)
        sink.take(samples)
    sink.close()
    result = replay(tmp_path / "gap.run", out=tmp_path / "out.run")
    none = {"start": 1, "drive": drive_resets(run), "lost_samples": 0, "lost_edges": 0}
    assert result.restarts == none | {f"lost_{lost}": 1}
    assert (result.lost_samples, result.lost_edges) == ((width, 0) if lost == "samples" else (0, 2))
    samples = Run(tmp_path / "out.run").samples
    assert [(g.position, g.lost_samples) for g in samples.gaps] == ([(gap, width)] if lost == "samples" else [])
    at_once = Estimators(["vector_tracking"], run.info.parameters, run.samples.config)
    rest = part(samples, anew, len(samples))
    later = int(np.searchsorted(run.edges.tick, samples.tick[anew - 1], side="right"))  # edges in the gap count
    at_once.edges(replace(part(run.edges, later, len(run.edges)), gaps=()))
    expected = at_once.samples(replace(rest, gaps=()))["vector_tracking"]
    channel = samples.config.channel("theta_vt_host")
    differ = raw_counts(channel, expected.theta) != rest.raw["theta_vt_host"]
    assert np.count_nonzero(differ) == 0
    same = slice(int(np.flatnonzero(samples.raw["status"] & Status.OBSERVERS_RESET)[0]), gap)
    assert np.array_equal(samples.raw["theta_vt"][same], samples.raw["theta_vt_host"][same])


@pytest.mark.parametrize(("settings", "observers", "words"), [
    ({"k_p": 1e9}, (), "k_p: must be 0..100000, got 1e+09"),
    ({"literal_sgn": 0.5}, (), "literal_sgn: must be a whole number"),
    ({"nonsense": 1.0}, (), "nonsense: it is no parameter; available: "),
    ({"i_max": 1.0}, (), "i_max: it changes nothing in average_speed"),
    ({"k_p": 1.0}, ("average_speed",), "k_p: it changes nothing in average_speed; available: hall_offset"),
    ({}, ("nobody",), "no observer 'nobody'; available: average_speed (avg), vector_tracking (vt)"),
    ({}, ("load-angel",), "no observer 'load-angel' (did you mean load_angle?)"),
    ({"k_p": 1.0, "k_p_vt": 2.0}, ("vector-tracking",), "k_p_vt: k_p_vt is already set"),
])  # fmt: skip
def test_settings_and_names_are_checked(drive_run, tmp_path, settings, observers, words) -> None:
    with pytest.raises(BenchError) as raised:
        replay(drive_run, observers, settings, tmp_path / "out.run")
    assert words in str(raised.value)
    assert not (tmp_path / "out.run").exists()


def test_a_recording_without_what_observers_need_is_refused(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "few.run"
    channels = tuple(c for c in run.samples.config.channels if c.name not in ("i_b", "u_beta"))
    sink = RunSink(path, replace(run.info, channels=channels), wait=True)
    config = replace(run.samples.config, channels=channels)
    raw = np.empty(100, config.dtype)
    for name in config.dtype.names:
        raw[name] = run.samples.raw[name][:100]
    sink.take(replace(part(run.samples, 0, 100), config=config, raw=raw))
    sink.close()
    with pytest.raises(BenchError, match=r"few\.run cannot be replayed: it has no channel u_beta, i_b"):
        replay(path, ["vt"])


def test_the_command_writes_once(drive_run: Path, tmp_path: Path) -> None:
    link = tmp_path / "a.run"
    link.symlink_to(drive_run)
    given = ["replay", str(link), "--observer", "vt", "--set", "k_i=5e4"]
    done = CliRunner().invoke(cli, given)
    assert done.exit_code == 0
    assert "a.replay.run" in done.output
    assert "vector_tracking" in done.output
    assert re.search(r"observers restarted +1 at the start, \d+ where the drive initialised them\n", done.output)
    written = (tmp_path / "a.replay.run" / "run.jsonl").read_bytes()
    again = CliRunner().invoke(cli, given)
    assert str(again.exception).startswith(f"{tmp_path / 'a.replay.run'} exists")
    assert (tmp_path / "a.replay.run" / "run.jsonl").read_bytes() == written
    itself = CliRunner().invoke(cli, ["replay", str(link), "-o", str(drive_run), "--overwrite"])
    assert f"--out {drive_run} is also an input" in itself.output
    with pytest.raises(BenchError, match="is the recording itself"):
        replay(link, out=drive_run, overwrite=True)
    twice = CliRunner().invoke(cli, ["replay", str(tmp_path / "a.replay.run"), "--observer", "vt"])
    assert "already has theta_vt_host" in str(twice.exception)
    two = CliRunner().invoke(cli, ["replay", str(link), "--set", "k_i=1", "--set", "k_i=2", "--overwrite"])
    assert "--set k_i is given 2 times" in two.output
    assert (tmp_path / "a.replay.run" / "run.jsonl").read_bytes() == written
    assert "3 is no" in CliRunner().invoke(cli, ["replay", str(link), "--set", "3 is no"]).output.replace("'", "")


def test_a_replay_that_fails_leaves_the_earlier_one(drive_run: Path, tmp_path, monkeypatch) -> None:
    out = tmp_path / "out.run"
    replay(drive_run, ("vt",), out=out)
    earlier = (out / "run.jsonl").read_bytes()

    def interrupted(*arguments: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(SegmentFile, "finish", interrupted)
        with pytest.raises(KeyboardInterrupt):
            replay(drive_run, ("la",), out=out, overwrite=True)
    assert ([path.name for path in tmp_path.iterdir()], (out / "run.jsonl").read_bytes()) == (["out.run"], earlier)
    replay(drive_run, ("la",), out=out, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["out.run"]
    names = Run(out).samples.raw.dtype.names
    assert ("theta_la_host" in names, "theta_vt_host" in names) == (True, False)


def test_damage_is_named_by_whatever_reads_the_run(drive_run: Path, tmp_path: Path) -> None:
    """A flipped bit in the only row group of samples: no observer is run on what is left, and no empty run is made."""
    path = tmp_path / "a.run"
    shutil.copytree(drive_run, path)
    file = path / "samples-000001.parquet"
    flip(file, file.stat().st_size // 3)
    words = r"(holds|has) no samples.*samples-000001\.parquet is damaged: \d+ rows from 0\.\d+ s to 3\.\d+ s are lost"
    for reads in (bench.read, lambda run: score([run]), replay):
        with pytest.raises(BenchError, match=words):
            reads(path)
    assert not (tmp_path / "a.replay.run").exists()
    done = CliRunner().invoke(cli, ["hall", "check", str(path)])
    assert "samples-000001.parquet is damaged" in str(done.exception or done.output)
