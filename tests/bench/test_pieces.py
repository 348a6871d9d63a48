"""Runs that do not fit into memory: read in part or piece by piece, scored and checked as if at once."""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner
from damage import flip
from hall_motor import Motor, capture
from long_run import KEPT, repeated

import bench
from bench.cli import cli
from bench.device.heard import Missing
from bench.device.losses import Continuity
from bench.errors import BenchError
from bench.files import leaves
from bench.findings.health import examine
from bench.hall.trace import Recorded, trace
from bench.record import writer
from bench.record.reader import Run
from bench.record.writer import RunWriter
from bench.score.board import score
from bench.signal import hall_inputs, windows
from bench.signal import trace as trace_of_analysis
from bench.signal.chunks import join, part
from bench.signal.delays import delays_of
from bench.signal.trace import INPUTS
from tests.choice import sampled

STEADY, REVERSAL = KEPT / "steady.run", KEPT / "reversal.run"
SECOND = 20_000_000  # ticks


@pytest.fixture
def small_groups(monkeypatch: pytest.MonkeyPatch) -> None:
    """A row group every 0.1 s, a file every 0.35 s."""
    monkeypatch.setattr(writer, "PIECE", 0.05)
    monkeypatch.setattr(writer, "ROW_GROUP", 0.1)
    monkeypatch.setattr(writer, "SEGMENT", 0.35)


@pytest.fixture
def in_groups(tmp_path: Path, small_groups: None) -> Path:
    """The kept reversal in many row groups, with 300 samples and 5 edges that are missing in its middle."""
    run = Run(REVERSAL)
    path = tmp_path / "groups.run"
    out, continuity = RunWriter(path, run.info), Continuity()
    for a in range(0, len(run.samples), 500):
        if a != 9000:
            samples = part(run.samples, a + (300 if a == 9500 else 0), min(a + 500, len(run.samples)))
            out.take(continuity.chunk(samples))
    for a in range(0, len(run.edges), 20):
        out.take(continuity.chunk(part(run.edges, a + (5 if a == 300 else 0), min(a + 20, len(run.edges)))))
    out.close()
    return path


def stored(path: Path, stream: str, *columns: str) -> dict[str, np.ndarray]:
    """Columns of a stream as its files have them, in their order."""
    tables = [pq.read_table(file, columns=list(columns)) for file in sorted(path.glob(f"{stream}-*.parquet"))]
    return {name: np.concatenate([np.asarray(table[name]) for table in tables]) for name in columns}


# -- reading --------------------------------------------------------------------------------------------------------


def test_a_part_and_some_channels_are_what_is_stored(in_groups: Path) -> None:
    read = bench.read(in_groups, 0.4, 0.9, ["i_q", "theta_enc"])
    raw = stored(in_groups, "samples", "tick", "theta_enc", "i_q")
    within = (raw["tick"] >= 0.4 * SECOND) & (raw["tick"] <= 0.9 * SECOND)
    assert read.names == ("theta_enc", "i_q")  # in the drive's order
    assert 6000 < len(read) == within.sum()
    for name in read.names:
        assert np.array_equal(read.samples.raw[name], raw[name][within])
    assert np.array_equal(read.samples.tick, raw["tick"][within])
    edges = stored(in_groups, "edges", "tick", "hall_new")
    within = (edges["tick"] >= 0.4 * SECOND) & (edges["tick"] <= 0.9 * SECOND)
    assert np.array_equal(read.edges.hall_new, edges["hall_new"][within])


def test_only_what_is_asked_for_is_read(in_groups: Path) -> None:
    """Row groups beside the part are not looked at: damage there is not found."""
    flip(in_groups / "samples-000001.parquet", 1000)
    whole = Run(in_groups)
    list(whole.pieces("samples"))
    assert len(whole.damage) == 1
    run = Run(in_groups)
    (first, *_) = (piece for piece in run.pieces("samples", SECOND, channels=["hall"]))
    assert not run.damage
    assert first.raw.dtype.names == ("hall",)


def test_pieces_are_the_whole(in_groups: Path) -> None:
    whole, pieces = bench.read(in_groups), list(bench.pieces(in_groups))
    assert len(pieces) >= 10
    assert max(map(len, pieces)) <= 0.11 * 16_000 + 500
    for one, of in (("samples", [p.samples for p in pieces]), ("edges", [p.edges for p in pieces if len(p.edges)])):
        joined, expected = join(of), getattr(whole, one)  # type: ignore[type-var]
        for field in fields(expected):
            mine, theirs = getattr(joined, field.name), getattr(expected, field.name)
            assert np.array_equal(mine, theirs) if isinstance(mine, np.ndarray) else mine == theirs
    before = -1
    for piece in pieces[:-1]:
        last = piece.samples.tick[-1]
        assert ((piece.edges.tick > before) & (piece.edges.tick <= last)).all()
        before = last
    assert tuple(lost for piece in pieces for lost in piece.dropped) == whole.dropped
    assert sorted(words.split(" before")[0] for *_, words in whole.dropped) == [
        "5 Hall edges were lost", "800 samples were lost",
    ]  # fmt: skip


@pytest.mark.parametrize("stream", ["samples", "edges"])
@pytest.mark.parametrize("end", [0, -1])
def test_what_is_damaged_at_an_end_is_lost(in_groups: Path, stream: str, end: int) -> None:
    """No gap between two records tells of it."""
    file = sorted(in_groups.glob(f"{stream}-*.parquet"))[end]
    table = pq.ParquetFile(file).metadata
    group = table.row_group(0 if end == 0 else table.num_row_groups - 1)
    flip(file, group.column(0).data_page_offset + 2)
    before = bench.read(REVERSAL)
    read = bench.read(in_groups)
    noun = "samples" if stream == "samples" else "Hall edges"
    (lost,) = [(a, b, words) for a, b, words in read.dropped if "damaged" in words]
    assert lost[2].startswith(f"{group.num_rows} {noun} are damaged from ")
    ticks = getattr(before, stream).tick
    assert lost[:2][end] == ticks[end]
    assert len(getattr(read, stream)) < len(ticks) - group.num_rows


def test_what_never_came_at_the_end_is_lost(tmp_path: Path) -> None:
    run = Run(STEADY)
    out = RunWriter(tmp_path / "a.run", run.info)
    out.take(run.samples)
    out.take(Missing(int(run.samples.tick[-1]), run.info.node, 40, 2))
    out.take(Missing(int(run.samples.tick[-1]), run.info.node + 1, 7, 0))
    out.close()
    samples, edges = bench.read(tmp_path / "a.run").dropped
    assert re.fullmatch(r"40 samples after \d+\.\d{4} s were lost", samples[2])
    assert edges[2] == "2 Hall edges were lost"
    assert (samples[0], bench.read(tmp_path / "a.run", end=0.5).dropped) == (run.samples.tick[-1], ())


def test_the_journal_is_read_by_part_and_channel_too(tmp_path: Path) -> None:
    run = Run(REVERSAL)
    out = RunWriter(tmp_path / "cut.run", run.info)
    out.take(run.samples)
    out.sync()
    out.abandon()
    read = bench.read(tmp_path / "cut.run", 0.5, 0.6, ["i_q"])
    raw = stored(REVERSAL, "samples", "tick", "i_q")
    within = (raw["tick"] >= 0.5 * SECOND) & (raw["tick"] <= 0.6 * SECOND)
    assert np.array_equal(read.samples.raw["i_q"], raw["i_q"][within])


def test_what_cannot_be_read_is_said(in_groups: Path) -> None:
    with pytest.raises(BenchError, match="channel 'nothing' is not in the stream; it has hall"):
        bench.read(in_groups, channels=["nothing"])
    with pytest.raises(BenchError, match="no channel named"):
        next(iter(bench.pieces(in_groups, channels=[])))
    with pytest.raises(BenchError, match=r"has no data from 5 to 6 s: it covers 0\.1"):
        bench.read(in_groups, 5.0, 6.0)


LIMITED = """
import resource, sys
import bench
from bench.record.reader import Run
path = sys.argv[1]
assert len(bench.read(path, 0.2, 0.5))  # everything is imported
taken = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (taken + (100 << 20), resource.RLIM_INFINITY))
try:
    bench.read(path)
except bench.BenchError as error:
    print(error)
print(sum(map(len, bench.pieces(path))))
print(len(bench.read(path, 30.0, 31.0)))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="a limit of the address space")
@pytest.mark.long("a run that does not fit")
def test_more_than_fits_into_memory_is_refused_and_read_in_pieces(tmp_path: Path) -> None:
    """A process that may take 100 MB more, and a run of 124 MB."""
    path = repeated(tmp_path / "long.run", 150)
    done = subprocess.run([sys.executable, "-c", LIMITED, path], capture_output=True, text=True, check=True)
    refused, samples, part_of = done.stdout.splitlines()
    assert "do not fit into memory" in refused
    assert "bench.read(path, begin, end, channels)" in refused
    assert (int(samples), int(part_of)) == (150 * len(Run(REVERSAL).samples), 16_001)


# -- scoring --------------------------------------------------------------------------------------------------------


def figures(board: Any) -> dict[str, Any]:
    return {name: value for name, value in leaves(board.pooled) if not name.endswith("step_ns")}


@pytest.mark.parametrize("piece", [1, 5000])
def test_a_score_does_not_depend_on_the_pieces(in_groups: Path, monkeypatch: pytest.MonkeyPatch, piece: int) -> None:
    """Against one piece for all of it; a piece of 1 is one of the least length that its neighbours are seen from."""
    whole = score([bench.read(in_groups)])
    monkeypatch.setattr(windows, "PIECE", piece)
    board = score([in_groups])
    expected, found = figures(whole), figures(board)
    assert list(expected) == list(found)
    for name, value in expected.items():
        assert found[name] == (pytest.approx(value, rel=1e-9, abs=1e-9) if isinstance(value, float) else value), name
    ours, theirs = board.tracks[0], whole.tracks[0]
    assert [(s.first, s.n) for s in ours.stretches] == [(s.first, s.n) for s in theirs.stretches]
    assert (ours.lost, ours.samples, ours.restarts) == (theirs.lost, theirs.samples, theirs.restarts)
    assert ours.lost == 800
    for mine, other in ((ours.actual, theirs.actual), (ours.over_time["drive_vt"].error,) * 2):
        assert np.allclose(mine.lo, other.lo, atol=1e-6)
        assert np.allclose(mine.hi, other.hi, atol=1e-6)


def peak(run: Callable[[], object]) -> int:
    """Bytes that it took at most."""
    tracemalloc.start()
    try:
        run()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("what", sampled("memory", ("score", "check"), 1, campaign="memory"))
@pytest.mark.long("a run that does not fit")
def test_memory_does_not_grow_with_the_run(tmp_path, small_groups: None, monkeypatch, what: str) -> None:
    monkeypatch.setattr(windows, "PIECE", 4000)
    for name in ("MOST", "MOST_EDGES"):
        monkeypatch.setattr(trace_of_analysis, name, 2000)
    runs = [repeated(tmp_path / f"{times}.run", times) for times in (4, 26)]

    def use(path: Path) -> None:
        if what == "score":
            score([path], ["drive_vt", "average_speed"])
        else:
            examine(trace(Recorded(Run(path))))

    use(runs[0])  # compiles
    short, long = (peak(lambda path=path: use(path)) for path in runs)  # type: ignore[misc]
    more = 22 * len(Run(REVERSAL).samples)
    assert long < 1.5 * short  # six times as long: of each window a few numbers are kept
    assert long - short < more * 8 * 3  # angle, estimate and error alone would be that


def test_a_part_is_scored_and_checked(tmp_path: Path) -> None:
    path = repeated(tmp_path / "twice.run", 2)
    again = 0.12 + len(Run(REVERSAL).samples) / 16_000  # s, where it begins once more
    span = ["--from", str(again), "--to", "100"]
    for arguments in (["score", "--observer", "drive_vt"], ["hall", "check"]):
        command, rest = (arguments[:1], arguments[1:]) if arguments[0] == "score" else (arguments, [])
        told = []
        for source, more in ((REVERSAL, []), (path, span)):
            done = CliRunner().invoke(cli, [*command, str(source), *rest, *more, "--json=-"])
            told.append(json.loads(done.stdout))
        if command == ["score"]:
            once, second = (data["observers"]["drive_vt"]["error"] for data in told)
            assert second == pytest.approx(once, rel=1e-9)
        else:
            once, second = told
            assert second["samples"] == once["samples"]
            assert second["edges"][2]["up"] == pytest.approx(once["edges"][2]["up"], rel=1e-6)
    done = CliRunner().invoke(cli, ["hall", "check", "sim", "--from", "1"])
    assert done.exit_code == 2
    assert "--from and --to need a recording" in done.output
    done = CliRunner().invoke(cli, ["score", str(path), "--from", "50"])
    assert "has no data from 50 to" in str(done.exception or done.output)


# -- Hall sensors ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("piece", [1, 3000])
def test_a_trace_does_not_depend_on_the_pieces(monkeypatch: pytest.MonkeyPatch, piece: int) -> None:
    """Pulses that lie over the end of a piece, and an angle that goes on over all of them."""
    clean = Motor(turns=((60.0, 1.0), (150.0, 1.0), (0.0, 0.05), (-150.0, 1.0)))
    least = round(trace_of_analysis.AROUND * 16_000) + 1  # samples of a piece, where `piece` is less
    ends = np.arange(1, 40) * max(piece, least) - 1
    pulses = [((end - 0.02) / 16_000, k % 3) for k, end in enumerate(ends) if 0.1 < end / 16_000 < 2.9]  # 3 us wide
    made = capture(clean.but(pulses=pulses))
    whole = trace(made)
    monkeypatch.setattr(windows, "PIECE", piece)
    cut = trace(made)
    returns = [hall_inputs.read(one.edges, one.tick_hz).returns for one in (cut, whole)]
    assert len(returns[0]) == len(returns[1]) > 10
    assert len(returns[0]) == pytest.approx(len(pulses), abs=2)  # where the shaft turns round there is none
    for group in ("edges", "some"):
        for field in fields(getattr(whole, group)):
            mine, other = (getattr(getattr(one, group), field.name) for one in (cut, whole))
            assert np.allclose(mine, other, atol=1e-9, equal_nan=True), (group, field.name)
    assert np.array_equal(cut.changed, whole.changed)
    assert np.array_equal(cut.codes, np.bincount(made.samples.raw["hall"], minlength=8))
    assert (cut.up, cut.down) == pytest.approx((whole.up, whole.down))
    assert delays_of(cut) == pytest.approx(delays_of(whole), abs=1e-9, nan_ok=True)


def test_of_many_samples_some_are_measured_and_all_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    made = capture(Motor())
    whole = trace(made)
    monkeypatch.setattr(trace_of_analysis, "MOST", len(made) // 10)
    monkeypatch.setattr(trace_of_analysis, "MOST_EDGES", len(made.edges) // 3)
    some = trace(made)
    assert len(some.some.hall) == pytest.approx(len(made) / 16, abs=1)  # every 2nd, 4th, 8th are still too many
    assert np.ptp(np.diff(some.some.tick)) == 0
    assert len(some.edges.tick) == pytest.approx(len(whole.edges.tick) / 4, abs=60)  # of blocks of 60
    assert (some.samples, some.changes()) == (len(made), whole.changes())
    flips = made.edges.hall_old ^ made.edges.hall_new
    assert whole.changes() == [int(((flips >> k) & 1).sum()) - slow_flips(whole, made, k) for k in range(len(INPUTS))]
    assert examine(some).verdict == examine(whole).verdict
    for one, other in zip(examine(some).measured.edges, examine(whole).measured.edges, strict=True):
        assert math.cos(one.up.angle - other.up.angle) == pytest.approx(1.0, abs=1e-6)


def slow_flips(made: Any, of: Any, number: int) -> int:
    """Changes of an input at edges that were left out."""
    kept = np.isin(of.edges.tick, made.edges.tick)
    return int((((of.edges.hall_old ^ of.edges.hall_new) >> number & 1) == 1)[~kept].sum())


def test_a_run_without_edges_is_refused(tmp_path: Path) -> None:
    shutil.copytree(STEADY, tmp_path / "a.run")
    run = Run(tmp_path / "a.run")
    out = RunWriter(tmp_path / "b.run", replace(run.info))
    out.take(run.samples)
    out.close()
    with pytest.raises(BenchError, match="holds no samples or no Hall edges of a drive: record both"):
        Recorded(Run(tmp_path / "b.run"))


def test_nothing_is_scored_of_no_samples() -> None:
    read = bench.read(STEADY)
    with pytest.raises(BenchError, match="the capture holds no samples of the drive"):
        score([replace(read, samples=part(read.samples, 0, 0))])
    with pytest.raises(BenchError, match="nothing was recorded"):
        trace(replace(read, samples=part(read.samples, 0, 0)))
