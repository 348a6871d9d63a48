"""Runs that go on for long: a ring, parts, marks from another terminal, and the room on the disk."""

from __future__ import annotations

import random
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import synthetic
from click.testing import CliRunner
from numpy.typing import NDArray

from bench.cli import cli
from bench.device.heard import ParameterSet
from bench.device.losses import Continuity
from bench.errors import RecordingError
from bench.record import folder, layout, sink, space
from bench.record.extended import Extension
from bench.record.info import Mark
from bench.record.reader import Run, capture_of
from bench.record.ring import Ring, Stored
from bench.record.sink import RunSink
from bench.record.writer import RunWriter
from bench.signal.chunks import lost_stretches
from protocol.descriptor import Channel
from protocol.host import DeviceEventReceived, HeartbeatReceived
from protocol.messages import DeviceEvent, EventCode
from protocol.signals import Flag, RawType, Unit
from protocol.streams import Gap, SampleChunk, StreamConfig

HZ = synthetic.TICK_HZ
STEP = 160  # PWM periods from sample to sample: 100 Hz
CONFIG = replace(synthetic.config(synthetic.named("i_a", "hall")), decimation=STEP)


def chunks(begin: float, end: float, offset: float = 0.0, config: StreamConfig = CONFIG) -> list[SampleChunk]:
    """Samples at 100 Hz, a second in each chunk, from `begin` to `end`, s; `offset`: of the device's time, s.

    A sample's raw current is a hash of its index.
    """
    found = []
    for second in np.arange(begin, end):
        index = (round(second * 100) + np.arange(100, dtype=np.int64)) * STEP
        raw = np.zeros(len(index), config.dtype)
        raw["i_a"] = hashed(index)
        found.append(SampleChunk(config, index, index * synthetic.TICKS + round(offset * HZ), raw, ()))
    return found


def fed(path: Path, parts: Iterable[SampleChunk], **options: object) -> RunSink:
    """A sink that was given these."""
    file = RunSink(path, synthetic.run_info(channels=CONFIG.channels), wait=True, **options)  # type: ignore[arg-type]
    for chunk in map(Continuity().chunk, parts):
        file.take(chunk)
    return file


def hashed(index: np.ndarray) -> np.ndarray:
    return index // STEP * 7919 % 30011 - 15000


def seconds_of(run: Run) -> set[int]:
    """The whole seconds of which there are samples, each of which must be as it was written."""
    samples = run.samples
    assert (samples.raw["i_a"] == hashed(samples.index)).all()
    whole, n = np.unique(samples.index // (100 * STEP), return_counts=True)
    assert (n == 100).all()
    return set(whole.tolist())


# -- a ring ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(8))
def test_a_ring_lets_go_of_what_is_old_and_led_to_nothing(seed: int) -> None:
    """Against the rule itself, applied to all that happened, on a time that goes on over reboots."""
    dice = random.Random(seed)
    keep = dice.choice([60.0, 300.0, 1000.0])
    ring = Ring(keep, HZ)
    segments: list[tuple[float, float]] = []
    moments: list[tuple[float, float]] = []
    gone: set[int] = set()
    real, boot = 0.0, 0.0  # s; device time is real - boot
    for number in range(120):
        if dice.random() < 0.1:
            boot = real
            ring.restarted()
        begin, end = real, real + dice.uniform(20.0, 60.0)
        for _ in range(dice.choice([0, 0, 0, 0, 1, 3])):
            at = dice.uniform(begin, end)
            moments.append((at, min(end, at + dice.choice([0.0, 0.0, 30.0]))))
            ring.moment(round((moments[-1][0] - boot) * HZ), round((moments[-1][1] - boot) * HZ))
        segments.append((begin, end))
        gone |= set(ring.ended(number, round((begin - boot) * HZ), round((end - boot) * HZ)))
        real = end
    for number, (begin, end) in enumerate(segments):
        old = end < real - keep
        wanted = any(a - 60.0 <= end and b + 10.0 >= begin for a, b in moments)
        assert (number in gone) == (old and not wanted), (number, begin, end)
    assert gone


def ring_run(path: Path) -> Path:
    """Twenty minutes in a ring of two: a fault at 400.5 s, a mark at 700 s, 30 s without samples from 900 s on."""
    writer = RunWriter(path, synthetic.run_info(channels=CONFIG.channels), keep=120.0)
    continuity = Continuity()
    for chunk in chunks(0, 1200):
        at = round(chunk.index[0] / (100 * STEP))
        if 900 <= at < 930:
            continue
        if at == 400:
            writer.take(DeviceEventReceived(1, DeviceEvent(round(400.5 * HZ), EventCode.FAULT, 1, 1.0)))
        if at == 700:
            writer.take(Mark("here", 700 * HZ, 700 * HZ))
        if at == 545:  # of a profile that is repeated for days: a ring keeps nothing for it
            writer.take(Mark("step 1", 540 * HZ, 545 * HZ, routine=True))
        writer.take(continuity.chunk(chunk))
    writer.close()
    return path


@pytest.fixture(scope="module")
def ring(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return Run(ring_run(tmp_path_factory.mktemp("ring") / "a.run"))


def test_a_ring_on_the_disk_keeps_what_it_should_exactly(ring: Run) -> None:
    there = seconds_of(ring)
    assert there >= {*range(341, 411), *range(640, 711), *range(1080, 1200)}
    assert there.isdisjoint({*range(270), *range(490, 580), *range(780, 990)})  # but for whole segments
    on_disk = {int(file.name[-14:-8]) for file in ring.path.glob("samples-*.parquet")}
    assert on_disk == {segment.number for segment in ring.segments}
    rows = sum(pq.read_metadata(file).num_rows for file in ring.path.glob("samples-*.parquet"))
    assert rows == len(ring.samples) == 100 * len(there)
    assert not ring.damage
    assert ring.ended
    assert ring.lost["samples"] == 3000  # of the 30 s, although they are gone


def test_what_a_ring_let_go_is_a_gap_of_nothing_lost(ring: Run) -> None:
    samples = ring.samples
    jumps = np.flatnonzero(np.diff(samples.index) != STEP) + 1
    assert [gap.position for gap in samples.gaps] == jumps.tolist()
    assert {gap.lost_samples for gap in samples.gaps} == {0}
    assert [words.split(" before")[0] for _, _, words in lost_stretches(samples, 0)] == ["samples"] * len(jumps)
    assert all("were not kept" in words for _, _, words in capture_of(ring).dropped)


def test_a_program_killed_while_it_lets_go_leaves_a_whole_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed between the line in the log and the end of the files."""

    class KilledError(BaseException):
        pass

    unlink = Path.unlink

    def killed(path: Path, missing_ok: bool = False) -> None:
        if path.name.startswith("overview-"):
            raise KilledError
        unlink(path, missing_ok)

    monkeypatch.setattr(Path, "unlink", killed)
    with pytest.raises(KilledError):
        ring_run(tmp_path / "a.run")
    monkeypatch.undo()
    run = Run(tmp_path / "a.run")
    assert list(run.path.glob("overview-000001.parquet"))
    assert min(seconds_of(run)) > 0
    assert max(seconds_of(run)) >= 180
    assert not run.damage
    folder.remove(run.path)
    assert not run.path.exists()


def test_an_extended_ring_is_one_too(ring: Run, tmp_path: Path) -> None:
    more = Channel(99, "i_more", Unit.A, RawType.I16, 1.0, Flag(0), 0.0)
    info = replace(ring.info, channels=(*ring.info.channels, more))

    def its_values(chunk: SampleChunk) -> list[NDArray[np.generic]]:
        return [-chunk.raw["i_a"]]

    Extension(ring, tmp_path / "b.run", info).write(its_values, lambda edges: None, lambda: "")
    extended = Run(tmp_path / "b.run")
    assert (extended.samples.index == ring.samples.index).all()
    assert (extended.samples.raw["i_more"] == -ring.samples.raw["i_a"]).all()
    assert extended.samples.gaps == ring.samples.gaps
    assert not extended.damage


# -- parts ----------------------------------------------------------------------------------------------------------


def test_parts_join_without_a_seam(tmp_path: Path, made: synthetic.SyntheticRun) -> None:
    """Samples stand in one part each; edges too, but for those ahead of the samples that begin a part."""
    target = tmp_path / "a.run"
    file = RunSink(target, synthetic.run_info(), wait=True, stored=Stored(split=0.7))
    chunks = list(made.chunks())
    file.take(HeartbeatReceived(1, synthetic.heartbeat(int(made.tick[0]), tx_dropped=5)))
    file.take(ParameterSet(int(made.tick[0]), 1, "speed_kp", 0.25))
    file.take(HeartbeatReceived(1, synthetic.heartbeat(int(made.tick[160]), tx_dropped=8)))
    for chunk in chunks:
        file.take(chunk)
    file.close()
    runs = [Run(part) for part in file.parts]
    assert [run.path.name for run in runs] == [f"a-{k:03d}.run" for k in range(1, len(runs) + 1)]
    assert len(runs) == -(-len(made.index) // round(0.7 * synthetic.PWM_HZ))
    assert b"".join(run.samples.raw.tobytes() for run in runs) == made.raw.tobytes()
    assert all(run.ended and not run.damage and not run.samples.gaps and not run.edges.gaps for run in runs)
    assert np.array_equal(np.unique(np.concatenate([run.edges.tick for run in runs])), made.edge_tick)
    for run in runs:  # every edge that its samples cover
        first, last = run.samples.tick[[0, -1]]
        inside = made.edge_tick[(made.edge_tick >= first) & (made.edge_tick <= last)]
        assert set(inside.tolist()) <= set(run.edges.tick.tolist())
    assert len({run.info.recording_id for run in runs}) == len(runs)
    assert [run.info.identity["part"] for run in runs] == list(range(1, len(runs) + 1))
    assert all(run.info.parameters["speed_kp"] == 0.25 for run in runs[1:])
    assert runs[0].changes[0].value == 0.25
    assert (file.logged_samples, file.logged_edges) == (len(made.index), len(made.edge_tick))
    assert [run.lost["by_device"] for run in runs if run.lost] == [3] + [0] * (len(runs) - 1)


def test_what_is_lost_between_two_parts_is_counted_in_the_second(tmp_path: Path) -> None:
    file = fed(tmp_path / "a.run", [*chunks(0, 20), *chunks(23, 40)], stored=Stored(split=20))
    file.close()
    first, second = (Run(part) for part in file.parts)
    assert ((first.lost or {})["samples"], (second.lost or {})["samples"]) == (0, 300)
    assert second.samples.gaps == (Gap(0, 300, 0, False),)


def test_parts_of_an_earlier_run_are_replaced_on_request_only(tmp_path: Path) -> None:
    info = synthetic.run_info(channels=CONFIG.channels)
    for length in (20, 10):
        file = RunSink(tmp_path / "a.run", info, wait=True, overwrite=length == 10, stored=Stored(split=10))
        for chunk in chunks(0, length):
            file.take(chunk)
        file.close()
        assert len(layout.parts_of(tmp_path / "a.run")) == length // 10
    with pytest.raises(RecordingError, match=r"a-001\.run exists: choose another name, or --overwrite"):
        RunSink(tmp_path / "a.run", info, stored=Stored(split=10))
    assert len(Run(tmp_path / "a-001.run").samples) == 1000


# -- marks ----------------------------------------------------------------------------------------------------------


def mark(*arguments: str) -> tuple[int, str]:
    done = CliRunner().invoke(cli, ["mark", *arguments])
    error = done.exception
    return done.exit_code, done.output if error is None or isinstance(error, SystemExit) else str(error)


def wait_for(file: RunSink, samples: int) -> None:
    """Until they are written."""
    while file.logged_samples < samples and file.error is None:
        time.sleep(0)


@pytest.mark.parametrize("stored", [Stored(), Stored(split=10.0)])
def test_a_mark_from_another_terminal_stands_at_its_moment(tmp_path: Path, stored: Stored) -> None:
    path = tmp_path / "a.run"
    file = fed(path, chunks(0, 15), stored=stored)
    wait_for(file, 1500)
    boot = time.monotonic() - 100.0  # when the device's time began, by this clock
    file.host_time = lambda tick: boot + tick / HZ
    before = time.monotonic() - boot
    code, words = mark(str(path), "grease heard")
    after = time.monotonic() - boot
    assert code == 0, words
    at = float(words.split()[1])
    assert before - 2e-3 <= at <= after
    assert f"s of {file.parts[-1]}: grease heard" in words
    file.close()
    assert file.news.popleft() == (f"mark: grease heard, at {at:.3f} s", "INFO")
    (found,) = Run(file.parts[-1]).marks
    assert (found.name, found.verdict) == ("grease heard", None)
    assert found.first_tick == found.last_tick == pytest.approx(at * HZ, abs=1e-3 * HZ)
    assert not (file.parts[-1] / layout.ASKED).exists()


def test_a_mark_as_one_part_ends_and_the_next_begins_is_in_one_of_them(tmp_path: Path) -> None:
    """The sink is at work on 40 parts while the mark is asked for."""
    path = tmp_path / "a.run"
    file = fed(path, chunks(0, 400), stored=Stored(split=10.0))
    code, words = mark(str(path), "here")
    file.close()
    assert code == 0, words
    (part,) = [part for part in file.parts if Run(part).marks]
    assert f"of {part}: here" in words
    assert not any((part / layout.ASKED).exists() for part in file.parts)


def test_a_drive_without_a_clock_is_marked_at_its_newest_sample(tmp_path: Path) -> None:
    file = fed(tmp_path / "a.run", chunks(0, 3))
    wait_for(file, 300)
    assert mark(str(tmp_path / "a.run"), "now")[0] == 0
    file.close()
    assert Run(tmp_path / "a.run").marks[0].first_tick == int(chunks(2, 3)[0].tick[-1])


def test_a_run_that_is_over_is_marked_at_a_time(tmp_path: Path) -> None:
    path = synthetic.recorded(tmp_path / "a.run", *chunks(0, 20), channels=CONFIG.channels)
    assert mark(str(path), "load came on", "--at", "12.5") == (0, f"marked 12.500 s of {path}: load came on\n")
    assert Run(path).marks == (Mark("load came on", round(12.5 * HZ), round(12.5 * HZ)),)
    assert not Run(path).damage
    assert mark(str(path), "x", "--at", "25")[1] == f"{path} has no 25 s: it is from 0.000 s to 19.990 s"
    assert mark(str(path), "x")[1] == f"{path} is not being recorded: mark a device time with --at S"
    assert "no such file" in mark(str(tmp_path / "b.run"), "x")[1]
    assert "TEXT is empty" in mark(str(path), " ")[1]
    file = fed(tmp_path / "c.run", chunks(0, 3))
    wait_for(file, 300)
    assert "is being recorded: omit --at" in mark(str(tmp_path / "c.run"), "x", "--at", "1")[1]
    file.close()


def test_a_recorder_that_does_not_answer_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bench.record.marks.ANSWER", 0.1)
    writer = RunWriter(tmp_path / "a.run", synthetic.run_info(channels=CONFIG.channels))  # nobody looks
    assert "did not confirm the mark within 0.1 s" in mark(str(tmp_path / "a.run"), "x")[1]
    writer.close()


# -- the disk -------------------------------------------------------------------------------------------------------


def test_a_disk_that_fills_is_told_in_time_and_the_run_ends_whole(tmp_path, monkeypatch) -> None:
    """The disk is as full as the run is large: it has room for some 12 min of it, and then for 90 s."""
    monkeypatch.setattr(sink, "SPACE_PERIOD", 0.0)
    a_minute = 100_000
    room = [space.RESERVE + 12 * a_minute]
    file = RunSink(
        tmp_path / "a.run", synthetic.run_info(channels=CONFIG.channels), wait=True, free=lambda path: room[0]
    )
    monkeypatch.setattr(
        RunWriter, "stored", property(lambda self: (60.0, a_minute), lambda self, value: None), raising=False
    )
    told = []
    for left in (12.0, 11.0, 9.9, 9.0, 8.0, 1.9, 1.0, 0.5, -0.01):
        room[0] = space.RESERVE + round(left * a_minute)
        file.take(chunks(len(told), len(told) + 1)[0])
        wait_for(file, 100 * (len(told) + 1))
        told.append(left)
        deadline = time.monotonic() + 0.15
        while time.monotonic() < deadline and file.error is None:
            time.sleep(0.01)
    words = [text for text, level in file.news if level == "WARN"]
    assert [text.split(":")[0] for text in words] == [f"the disk will be full in {t} min" for t in (9.9, 1.9)]
    with pytest.raises(RecordingError, match=r"the disk is full: 63 MiB are free .* everything before is complete"):
        file.close()
    monkeypatch.undo()
    run = Run(tmp_path / "a.run")
    assert run.ended
    assert seconds_of(run) >= set(range(8))


def test_a_ring_that_fits_is_not_warned_of() -> None:
    for keep, fits in ((600.0, True), (3600.0, False)):
        room = space.Room(keep)
        assert (room.words(space.RESERVE + 900_000, 60.0, 100_000) == "") == fits  # 9 min


def test_a_recording_does_not_begin_on_a_full_disk(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"a\.run: the disk is full: 63 MiB are free in .*, and 64 MiB are res"):
        RunSink(tmp_path / "a.run", synthetic.run_info(), free=lambda path: space.RESERVE - 1)
    assert not list(tmp_path.iterdir())
