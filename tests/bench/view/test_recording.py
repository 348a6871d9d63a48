"""A recording read back is the run, bit for bit, however it was cut up and however the process ended."""

from __future__ import annotations

import os
import random
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import synthetic
from damage import Whole, unfinished

from bench.device.heard import ClockRestarted
from bench.device.losses import LOSS_FIELDS
from bench.errors import BenchError, RecordingError
from bench.record import layout
from bench.record.info import ns_from_tick
from bench.record.reader import NotARecordingError, Run
from bench.record.recording import readable
from bench.record.sink import RunSink
from bench.record.writer import RunWriter
from bench.rig.outputs import Outputs, Recording
from bench.view import schema
from protocol.descriptor import Descriptor
from protocol.host import HeartbeatReceived
from protocol.messages import StreamEvent
from protocol.signals import LOAD_CHANNELS
from protocol.streams import Gap, SampleChunk, StreamConfig
from tests.choice import sampled

pytestmark = pytest.mark.slow


def test_every_sample_and_every_edge_comes_back(recording: Path, made: synthetic.SyntheticRun) -> None:
    run = Run(recording)
    samples, edges = run.samples, run.edges
    assert (samples.config, samples.raw.tobytes()) == (made.config, made.raw.tobytes())
    assert (samples.tick == made.tick).all()
    assert (samples.index == made.index).all()
    assert samples.gaps == edges.gaps == ()
    assert edges.config == synthetic.EDGE_CONFIG
    whole = made.edge_chunk(0, len(made.edge_tick))
    for name in ("tick", "hall_old", "hall_new", "illegal", "encoder", "index"):
        assert (getattr(edges, name) == getattr(whole, name)).all(), name
        assert getattr(edges, name).dtype == getattr(whole, name).dtype


def test_the_drives_lanes_follow_its_status_word(recording: Path, made: synthetic.SyntheticRun) -> None:
    """State, angle source and correction change in the timeline at the very sample that says so."""
    changed = dict(synthetic.column(recording, schema.DRIVE, "StateChange:state"))
    at = np.array(sorted(changed))
    status = made.raw["status"].astype(int)
    t_ns = ns_from_tick(made.tick, synthetic.TICK_HZ)
    first = np.flatnonzero(np.diff(status, prepend=-1))  # of each status
    for sample in (*first, *(first[1:] - 1), len(status) - 1):
        words = changed[at[np.searchsorted(at, t_ns[sample], side="right") - 1]]
        assert words[0] == "RUNNING"
        source = ("average speed", "vector tracking")[(status[sample] >> 5) - 1]
        assert words[2] == source + ("", ", back-EMF correction on")[status[sample] >> 4 & 1]


def test_gaps_an_outage_and_a_new_configuration_come_back(tmp_path: Path, made: synthetic.SyntheticRun) -> None:
    chunks = made.sample_chunks(100)[:60]
    again = synthetic.config(cfg_id=9)  # as after a reconnect: same stream, another number
    chunks[5] = replace(chunks[5], gaps=(Gap(40, 3, 1, True),), index=chunks[5].index + 3 * (np.arange(100) >= 40))
    sent = chunks[:10] + [replace(chunk, config=again) for chunk in chunks[30:]]
    run = Run(synthetic.recorded(tmp_path / "a.run", *sent))
    assert run.names == ("samples",)
    assert (run.samples.index == np.concatenate([chunk.index for chunk in sent])).all()
    assert (run.samples.raw == np.concatenate([chunk.raw for chunk in sent])).all()
    assert run.samples.gaps == (Gap(540, 3, 1, True), Gap(1000, 2000, 0, False))


def test_after_a_reboot_of_the_drive_everything_is_logged_as_before(tmp_path: Path) -> None:
    """Device time starts again at 0: pictures, health and trends go on, and notes stand at the new time."""
    paths = tmp_path / "once.run", tmp_path / "twice.run"
    for path, starts in zip(paths, ((100.0,), (100.0, 0.5)), strict=True):
        sink = RunSink(path, synthetic.run_info(), wait=True)
        for start in starts:
            synthetic.SyntheticRun(3.0, start=start).feed(sink)
        sink.close()
    once, twice = (synthetic.components(path) for path in paths)
    for entity in ("/samples", "/stator/vectors", "/trend", "/health"):
        assert max(twice[entity].values()) >= 2 * max(once[entity].values()) - 2 > 0, entity
    last = [(start * synthetic.PWM_HZ + 47_999) * synthetic.TICKS for start in (100, 0.5)]
    assert [note.tick for note in Run(paths[1]).notes] == last


def test_a_reboot_is_known_though_the_new_time_is_beyond_the_old_one(tmp_path: Path) -> None:
    """A log that says so needs no ticks that go back, and what lies between two boots is no loss."""
    first, second = synthetic.SyntheticRun(0.5, start=1.0), synthetic.SyntheticRun(0.5, start=3.0)
    sink = RunSink(tmp_path / "a.run", synthetic.run_info(), wait=True)
    reboot = ClockRestarted(1, int(first.tick[-1]))
    for item in (*first.chunks(), reboot, *second.chunks()):
        sink.take(item)
    sink.close()
    run = Run(tmp_path / "a.run")
    assert list(run.restarts.values()) == [[reboot, ClockRestarted(1, int(first.edge_tick[-1]))]]
    assert run.clock_went_back() == reboot
    assert (run.samples.gaps, run.lost) == ((), dict.fromkeys(LOSS_FIELDS, 0))
    assert run.samples.raw.tobytes() == first.raw.tobytes() + second.raw.tobytes()
    with pytest.raises(BenchError, match="it rebooted during the run"):
        readable(run)


def test_the_telemetry_lane_shows_a_gap_as_long_as_it_was(tmp_path: Path) -> None:
    """Samples every 50 ms, one a chunk; four are lost before the last."""
    config = replace(synthetic.config(), decimation=800)
    chunks = []
    for number in (0, 1, 2, 3, 8):
        index = np.array([number * 800], np.int64)
        gaps = (Gap(0, 4, 1, False),) if number == 8 else ()
        chunks.append(SampleChunk(config, index, index * synthetic.TICKS, np.zeros(1, config.dtype), gaps))
    path = synthetic.recorded(tmp_path / "a.run", *chunks)
    states = synthetic.column(path, schema.DRIVE, "StateChange:state")
    lanes = {at: row[3] for at, row in states}
    assert (lanes[200_000_000], lanes[400_000_000]) == ("GAP", "complete")
    assert min(at for at, word in lanes.items() if word == "GAP") == 200_000_000


def test_a_run_that_ends_in_an_error_leaves_a_whole_file(tmp_path: Path, made: synthetic.SyntheticRun) -> None:
    outputs = Outputs(synthetic.run_info(), Recording(tmp_path / "a.run"))
    made.feed(*outputs.sinks)
    outputs.close()  # with no end_recording before it
    run = Run(tmp_path / "a.run")
    assert (run.samples.raw.tobytes(), [note.text for note in run.notes]) == (made.raw.tobytes(), ["all of it"])


def test_streams_of_two_nodes_and_of_fewer_channels_are_kept_apart(tmp_path: Path) -> None:
    few = synthetic.SyntheticRun(0.1, config=synthetic.config(synthetic.CHANNELS[:3]))
    more = synthetic.SyntheticRun(0.1, start=101, config=synthetic.config(synthetic.CHANNELS[:7]))
    load = StreamConfig(
        2, 0, 3, StreamEvent.PWM, 16, Descriptor.of(LOAD_CHANNELS, ()).channels, 10, tick_hz=20_000_000, pwm_hz=16_000
    )
    raw = np.zeros(50, load.dtype)
    raw["omega_m"] = np.random.default_rng(0).normal(size=50)
    index = np.arange(50, dtype=np.int64) * 16
    chunks = (*few.chunks(), *more.chunks(), SampleChunk(load, index, index * 1250, raw, ()))
    run = Run(synthetic.recorded(tmp_path / "a.run", *chunks, channels=few.config.channels))
    assert set(run.names) == {"samples", "edges", "samples.2", "node2-stream0"}
    assert run.samples.raw.tobytes() == few.raw.tobytes()
    second, load = run.chunk("samples.2"), run.chunk("node2-stream0")
    assert second.raw.tobytes() == more.raw.tobytes()
    assert load.raw.tobytes() == raw.tobytes()
    assert (load.index == index).all()


def test_a_run_without_samples_is_a_run(tmp_path: Path) -> None:
    sink = RunSink(tmp_path / "a.run", synthetic.run_info())
    sink.take(HeartbeatReceived(1, synthetic.heartbeat(77)))
    sink.close()
    run = Run(tmp_path / "a.run")
    assert run.names == ()
    assert run.summary == ""


def test_a_file_that_exists_or_cannot_be_made_is_refused_and_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "a.run"
    path.write_bytes(b"precious")
    with pytest.raises(RecordingError, match=r"a\.run exists: it is not a recorded run"):
        RunSink(path, synthetic.run_info())
    with pytest.raises(RecordingError, match=r"a\.run exists: it is not a recorded run"):
        RunSink(path, synthetic.run_info(), overwrite=True)
    assert path.read_bytes() == b"precious"
    run = tmp_path / "b.run"
    RunSink(run, synthetic.run_info()).close()
    with pytest.raises(RecordingError, match=r"b\.run exists: .*--overwrite"):
        RunSink(run, synthetic.run_info())
    RunSink(run, synthetic.run_info(parameters={"n_p": 4.0}), overwrite=True).close()
    assert Run(run).info.n_p == 4
    with pytest.raises(RecordingError, match="cannot be created: No such file or directory"):
        RunSink(tmp_path / "missing" / "a.run", synthetic.run_info())


def test_folders_that_are_no_recordings_of_ours_are_named(tmp_path: Path) -> None:
    noise, empty, newer = tmp_path / "noise.run", tmp_path / "empty.run", tmp_path / "newer.run"
    noise.write_bytes(os.urandom(4096))
    empty.mkdir()
    newer.mkdir()
    record = {"kind": "run", "format": layout.FORMAT + 1, "id": "x", **synthetic.run_info().to_json()}
    (newer / layout.LOG).write_text(layout.line_of(record))
    for path, what in (
        (noise, "a run is a folder"),
        (empty, r"has no run\.jsonl"),
        (newer, "newer version .*update hallbench"),
        (tmp_path / "none.run", "nothing is there"),
    ):
        with pytest.raises(NotARecordingError, match=what) as caught:
            Run(path)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("share", [0.3, 0.6, 0.8])
def test_a_journal_cut_short_reads_up_to_the_cut(made: synthetic.SyntheticRun, tmp_path: Path, share: float) -> None:
    """As kill -9 leaves it, at any byte."""
    writer = RunWriter(tmp_path / "a.run", synthetic.run_info())
    for chunk in made.chunks():
        writer.take(chunk)
    journal = tmp_path / "a.run" / layout.journal_name(1)
    os.truncate(journal, int(journal.stat().st_size * share))
    run = Run(tmp_path / "a.run")
    n = len(run.samples)
    assert 0.9 * share * len(made.index) < n < len(made.index)
    assert run.samples.raw.tobytes() == made.raw[:n].tobytes()
    assert (run.edges.tick == made.edge_tick[: len(run.edges)]).all()
    assert not run.damage
    assert not run.ended
    assert run.being_written
    writer.abandon()
    assert not Run(tmp_path / "a.run").being_written


@pytest.mark.long("reads a recording for each trial")
@pytest.mark.parametrize(("ended", "trials"), [
    *sampled("damage", ((True, 12), (False, 12)), 1, campaign="damage"),
    *sampled("damaged much", ((True, 200), (False, 200)), 0, campaign="damage"),
])  # fmt: skip
def test_damage_anywhere_is_told_and_what_still_reads_is_what_was_written(
    recording: Path, tmp_path, ended: bool, trials: int
):
    """A bit flipped or a file cut, at places drawn at random, of a run that has ended and of one that was killed."""
    whole = Whole(recording if ended else unfinished(Run(recording), tmp_path / "a.run"))
    assert whole.run.ended == ended
    places = random.Random(3)
    trials = [whole.trial(places, tmp_path) for _ in range(trials)]
    assert not [trial for trial in trials if not (trial.told and trial.same)]


def test_segments_and_row_groups_join_without_a_seam(tmp_path: Path) -> None:
    """Two and a half minutes: each part of it reads as the slice that it is."""
    config = replace(synthetic.config(synthetic.CHANNELS[:3]), decimation=10)
    index = np.arange(15 * synthetic.PWM_HZ, dtype=np.int64) * 10
    raw = np.zeros(len(index), config.dtype)
    for name in raw.dtype.names or ():
        raw[name] = np.random.default_rng(2).integers(0, 255, len(index))
    writer = RunWriter(tmp_path / "a.run", synthetic.run_info(channels=config.channels))
    for k in range(0, len(index), 800):
        part = slice(k, k + 800)
        writer.take(SampleChunk(config, index[part], index[part] * synthetic.TICKS, raw[part], ()))
    for _ in range(2):
        run = Run(tmp_path / "a.run")
        assert run.samples.raw.tobytes() == raw.tobytes()
        assert (run.samples.index == index).all()
        assert run.samples.gaps == ()
        for first, last in ((0, 10), (95_000, 97_001), (230_000, 239_999)):
            piece = run.chunk("samples", *(index[[first, last]] * synthetic.TICKS).tolist())
            assert isinstance(piece, SampleChunk)
            assert piece.raw.tobytes() == raw[first : last + 1].tobytes()
        writer.close()
    assert len(list((tmp_path / "a.run").glob("samples-*.parquet"))) == 3
    assert not list((tmp_path / "a.run").glob("journal-*"))


def test_channels_may_be_called_as_other_columns_are(tmp_path: Path) -> None:
    names = ("tick", "tick_", "tick__", "index", "gap", "lost", "lost_frames", "edges")
    channels = tuple(replace(channel, name=name) for channel, name in zip(synthetic.CHANNELS, names, strict=False))
    config = synthetic.config(channels)
    raw = np.zeros(50, config.dtype)
    for name in names:
        raw[name] = np.random.default_rng(6).integers(0, 100, 50)
    index = np.arange(50, dtype=np.int64)
    chunk = SampleChunk(config, index, index * synthetic.TICKS, raw, ())
    run = Run(synthetic.recorded(tmp_path / "a.run", chunk, channels=channels))
    assert run.samples.raw.tobytes() == raw.tobytes()
    assert (run.samples.index == index).all()
    assert not run.damage
