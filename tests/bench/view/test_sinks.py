"""A slow, stopped, dead or absent viewer costs live frames, never recorded samples; a full disk is said once."""

from __future__ import annotations

import errno
import signal
import threading
from pathlib import Path

import pytest
import synthetic

from bench.device.heard import Note
from bench.errors import RecordingError
from bench.record import sink, writer
from bench.record.reader import Run
from bench.record.sink import RunSink
from bench.view import schema, sinks
from bench.view.blocks import BlockBuilder
from bench.view.log import RunLog
from bench.view.sinks import LiveSink
from tests.choice import sampled
from tests.tools import needs
from tests.viewers import any_port, headless

pytestmark = pytest.mark.slow


def whole(path: Path, made: synthetic.SyntheticRun) -> bool:
    run = Run(path)
    return bool(run.samples.raw.tobytes() == made.raw.tobytes() and len(run.edges) == len(made.edge_tick))


def test_without_any_viewer_the_file_is_whole(tmp_path: Path, made: synthetic.SyntheticRun) -> None:
    live = LiveSink(synthetic.run_info(), any_port())
    file = RunSink(tmp_path / "a.run", live.run, wait=True)
    made.feed(live, file)
    file.close()
    assert live.close()
    assert live.error is None
    assert live.logged_samples + live.dropped_samples == len(made.index)
    assert whole(tmp_path / "a.run", made)
    assert (file.logged_samples, file.logged_edges) == (len(made.index), len(made.edge_tick))


@needs("Vulkan driver")
@pytest.mark.parametrize("number", sampled("viewer's end", [signal.SIGSTOP, signal.SIGKILL], 1, campaign="viewer"))
def test_a_stopped_or_killed_viewer_costs_live_frames_only(tmp_path, made, number) -> None:
    live = LiveSink(synthetic.run_info(), any_port())
    file = RunSink(tmp_path / "a.run", live.run, wait=True)
    with headless("--connect", live.url) as viewer:
        made.feed(live)
        viewer.await_recording()
        viewer.send_signal(number)
        later = synthetic.SyntheticRun(3.0, start=103.0)
        later.feed(live, file)
        file.close()
        live.close()
    assert live.logged_samples + live.dropped_samples <= 2 * len(made.index)
    assert whole(tmp_path / "a.run", later)


class Stuck:
    """A rerun stream whose calls never return, as with a stalled client once rerun's buffer is full."""

    def __init__(self) -> None:
        self.free = threading.Event()

    def __getattr__(self, name: str):
        return lambda *_, **__: self.free.wait()


def test_a_view_that_blocks_for_ever_never_holds_up_the_caller(tmp_path, made: synthetic.SyntheticRun, monkeypatch):
    stuck = Stuck()
    monkeypatch.setattr(sinks, "_serve", lambda *_: (stuck, "nowhere"))
    monkeypatch.setattr(sinks, "READY_TIMEOUT", 0.05)
    monkeypatch.setattr(sinks, "LIVE_CLOSE_TIMEOUT", 0.05)
    live = LiveSink(synthetic.run_info(), 0)
    file = RunSink(tmp_path / "a.run", live.run, wait=True)
    made.feed(live, file)  # would hang here
    file.close()
    assert live.close() is False
    assert live.dropped_samples == len(made.index) - 960 * sinks.LIVE_QUEUE  # blocks of 60 ms
    assert live.dropped_blocks == 50 - sinks.LIVE_QUEUE + 1  # the last one holds but a note
    assert whole(tmp_path / "a.run", made)
    stuck.free.set()


def test_the_live_view_shows_what_it_dropped_not_as_lost(made: synthetic.SyntheticRun, monkeypatch) -> None:
    seen: list[dict[str, int]] = []
    gate = threading.Event()

    class Log:
        def block(self, block: sinks.Block) -> None:
            gate.wait()
            seen.append(block.losses)

    monkeypatch.setattr(sinks, "LIVE_QUEUE", 2)
    live = LiveSink(synthetic.run_info(), any_port())
    original = live._log
    live._log = lambda log, item: original(Log(), item)  # type: ignore[assignment,arg-type,method-assign]
    made.feed(live)
    gate.set()
    live.close()
    assert seen[-1]["lost:samples"] == 0
    assert seen[-1]["lost:live_blocks"] == live.dropped_blocks > 40


def test_a_view_that_holds_still_is_drawn_again_where_it_stands(tmp_path, made: synthetic.SyntheticRun, monkeypatch):
    """The live stream goes into a file here, so that it can be looked at."""
    run = synthetic.run_info()
    stream = sinks.new_stream(run)
    stream.save(tmp_path / "live.rrd")
    monkeypatch.setattr(sinks, "_serve", lambda *_: (stream, "file"))
    monkeypatch.setattr(sinks, "TOUCH_PERIOD", 0.01)
    touched = threading.Event()
    touch = RunLog.touch
    monkeypatch.setattr(RunLog, "touch", lambda log: (touch(log), log._now_ns > 0 and touched.set()))
    clock = {"now": 60.0}
    live = LiveSink(run, 0, hold=True, now=lambda: clock["now"])
    made.feed(live)
    clock["now"] = 1000.0  # what is held back on purpose is not late
    live.take(Note(0, "later"))
    live._pass_on(0.0, everything=True)
    assert touched.wait(10)
    assert live.close()
    assert live.error is None
    last = int(made.tick[-1]) * 1_000_000_000 // synthetic.TICK_HZ
    assert synthetic.column(tmp_path / "live.rrd", schema.TOUCH, "touch")[-1][0] == last
    assert live.latency.n == len(made.index)
    assert live.latency.at(100) < 1.0


def test_latency_is_by_the_clock_that_holds_as_samples_come(tmp_path: Path, made: synthetic.SyntheticRun) -> None:
    """While the drive's clock is not known there is none, whatever is known when the block is written."""
    file = RunSink(tmp_path / "a.run", synthetic.run_info(), wait=True, now=lambda: 50.0)
    chunks = made.sample_chunks(96)[:3]
    clocks = (None, chunks[1].tick[0] / synthetic.TICK_HZ - 49.9, None)
    for chunk, offset in zip(chunks, clocks, strict=True):
        file.host_time = lambda tick, offset=offset: None if offset is None else tick / synthetic.TICK_HZ - offset
        file.take(chunk)
    file.close()
    assert file.latency.n == 96
    assert 0.1 <= file.latency.at(100) <= 0.103


def test_a_disk_that_takes_no_more_is_told_once_and_what_was_written_reads(tmp_path, made, monkeypatch) -> None:
    """From the hundredth chunk on the disk is full, while whoever records is held back."""
    monkeypatch.setattr(sink, "BACKLOG_LIMIT", 1)
    write, written = writer.write_all, []

    def full(descriptor: int, data: bytes) -> None:
        written.append(len(data))
        if len(written) > 100:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(descriptor, data)

    monkeypatch.setattr(writer, "write_all", full)
    file = RunSink(tmp_path / "a.run", synthetic.run_info(), wait=True)
    made.feed(file)
    with pytest.raises(RecordingError, match=r"a\.run: the disk is full"):
        file.close()
    file.close()  # it was said
    run = Run(tmp_path / "a.run")
    assert run.samples.raw.tobytes() == made.raw[: len(run.samples)].tobytes()
    assert len(run.samples) > 160 * 40
    assert not run.ended


def test_a_caller_faster_than_the_disk_is_told(tmp_path, made: synthetic.SyntheticRun, monkeypatch) -> None:
    monkeypatch.setattr(sink, "BACKLOG_LIMIT", 200_000)
    hold, write = threading.Event(), writer.write_all
    file = RunSink(tmp_path / "a.run", synthetic.run_info())
    monkeypatch.setattr(writer, "write_all", lambda *given: (hold.wait(20), write(*given)))
    made.feed(file)
    with pytest.raises(RecordingError, match="wait to be written; use a faster disk"):
        file.check()
    hold.set()
    file.close()  # it was said
    assert file.error is not None


def test_a_live_view_is_given_close_ups_a_few_times_a_second_and_no_samples(tmp_path, made) -> None:
    stream = sinks.new_stream(synthetic.run_info())
    stream.save(tmp_path / "live.rrd")
    log, builder = RunLog(stream, synthetic.run_info(), live=True), BlockBuilder(sinks.BLOCK_PERIOD, synthetic.TICK_HZ)
    log.start()
    for chunk in made.chunks():
        builder.add(chunk, 0.0)
        if (block := builder.close(0.0)) is not None:
            log.block(block)
    log.finish()
    stream.disconnect()
    found = synthetic.components(tmp_path / "live.rrd")
    assert not {f"/{entity}" for entity in (schema.FAST, schema.HALL, schema.GUIDE)} & found.keys()
    assert "StateChange:state" not in found[f"/{schema.HALL_LANES}"]
    words = synthetic.column(tmp_path / "live.rrd", f"{schema.SCOPE}/0", "Points2D:labels")
    assert 9 <= len(words) <= 13  # of 3 s
    assert len({texts[0] for _, texts in words}) == len(words)
    assert "angle by encoder" in words[-1][1][0]
    strips = synthetic.column(tmp_path / "live.rrd", f"{schema.SCOPE}/0", "LineStrips2D:strips")
    assert [at for at, _ in strips] == [at for at, _ in words]


def test_a_live_view_makes_room_for_legends_before_its_first_sample(tmp_path, made, monkeypatch) -> None:
    """The long plots begin so early that three tenths of their width are left to the legend, in short runs too."""
    run = synthetic.run_info()
    stream = sinks.new_stream(run)
    stream.save(tmp_path / "live.rrd")
    monkeypatch.setattr(sinks, "_serve", lambda *_: (stream, "file"))
    live = LiveSink(run, 0)
    made.feed(live)
    live.close()
    rows = synthetic.column(tmp_path / "live.rrd", schema.ROOM, "guide:error_trend")
    assert [row[0] for _, row in rows[:2]] in ([-2.0, 2.0], [-2.0, -2.0], [2.0, -2.0])
    first = int(made.tick[0]) * 50  # ns
    drawn = synthetic.column(tmp_path / "live.rrd", schema.TREND, "error_deg:theta_vt")
    assert drawn[0][0] == pytest.approx(first, abs=10_000_000)
    begin, last = rows[0][0], rows[-1][0]  # room is made twice a second, in the time of what the view takes
    assert 0 <= drawn[-1][0] - last <= 0.6e9
    assert (first - begin) / (last - begin) == pytest.approx(0.3, abs=0.02)
