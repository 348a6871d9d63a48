"""Ticks that jump: they are told with the moment, in the run, in the recording and in every export; nothing is lost.

What is true is what the simulated drive made, whose own clock never jumps.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from lying import of_heartbeats
from virtual_run import WatchedLink, run, simulated

import bench
from bench.export import ENDINGS
from bench.export.export import export
from bench.record.reader import Run
from bench.record.writer import RunWriter
from protocol.messages import TimeSync, TimeSyncReply
from protocol.streams import EdgeChunk, SampleChunk
from sim.ports.device import SimulatedDevice
from tests.choice import sampled

HZ = 20_000_000
AT = 2.2  # s of device time at which it happens
JUMPS = {"+2^31": 1 << 31, "-2^31": -(1 << 31), "+2^32": 1 << 32, "+1 h": 3600 * HZ, "-2 s": -2 * HZ, "+7 s": 7 * HZ}
IN_FRAMES = [name for name in JUMPS if name != "+2^32"]  # of which they have 32 bits
IN_WORDS = [name for name in JUMPS if name != "-2^31"]  # which would be before the boot


def _heartbeats(device: SimulatedDevice, by: int, ends: float) -> None:
    of_heartbeats(device, lambda beat: {"tick": beat.tick + by * _due(beat.tick, ends)})


def _samples(device: SimulatedDevice, by: int, ends: float) -> None:
    push = device.drive.push_samples
    device.drive.push_samples = lambda index, tick, raw: push(index, tick + by * _due(tick, ends), raw)  # type: ignore[method-assign]


def _edges(device: SimulatedDevice, by: int, ends: float) -> None:
    push = device.drive.push_edges

    def lie(records: np.ndarray) -> None:
        records = records.copy()
        due = (records["tick"] >= AT * HZ) & (records["tick"] < ends * HZ)
        records["tick"] += np.uint32(by & 0xFFFFFFFF) * due.astype(np.uint32)
        push(records)

    device.drive.push_edges = lie  # type: ignore[method-assign]


def _time_sync(device: SimulatedDevice, by: int, ends: float) -> None:
    drive = device.drive

    def reply(_: object) -> TimeSyncReply:
        tick = drive._tick + by * _due(drive._tick, ends)
        return TimeSyncReply(tick, tick)

    drive._handlers[TimeSync] = reply


def _due(tick: int, ends: float) -> bool:
    return AT * HZ <= tick < ends * HZ


Lie = Callable[[SimulatedDevice, int, float], None]
WHERE: dict[str, tuple[Lie, ...]] = {
    "heartbeats": (_heartbeats,), "samples": (_samples,), "edges": (_edges,), "TIME_SYNC": (_time_sync,),
    "all": (_heartbeats, _samples, _edges, _time_sync),
}  # fmt: skip
LASTS = {"once": {"heartbeats": 0.1, "samples": 0.2, "edges": 0.02, "TIME_SYNC": 2.1, "all": 0.1}, "for good": {}}
CASES = [
    (where, by, lasts, network)
    for where in WHERE
    for by in (IN_FRAMES if where in ("samples", "edges") else IN_WORDS)
    for lasts in LASTS
    for network in ("bytes", "CAN FD")
    if not (network == "CAN FD" and where == "samples")  # whose frames have no tick
]
CHANNELS = ("hall", "theta_enc", "omega_enc", "status")


def _recorded(path: Path, where: str, by: int, lasts: str, network: str) -> tuple[str, int, Run]:
    """Result, exit code and recording of a run in which that happens."""
    device = simulated(network=network)
    ends = AT + LASTS[lasts].get(where, 1e6)
    for lie in WHERE[where]:
        lie(device, by, ends)
    ended = run(WatchedLink(device), save=path, speed_rpm=300.0, duration=4.0, channels=CHANNELS, fit=True)
    assert ended.summary.lost.samples_by_index == 0
    return ended.summary.result, ended.exit_code, Run(path)


@pytest.mark.parametrize(("where", "by", "lasts", "network"), sampled("ticks", CASES, 12, campaign="ticks"))
def test_jumps_are_told_and_nothing_is_lost(tmp_path: Path, where: str, by: str, lasts: str, network: str) -> None:
    result, code, recording = _recorded(tmp_path / "a.run", where, JUMPS[by], lasts, network)
    assert (result.startswith("implausible: "), code) == (True, 1), result
    assert "reboot" not in result
    moment = re.search(r"(ahead of|behind) ([\d.]+) s", result)
    assert moment is not None, result
    assert float(moment[2]) == pytest.approx(AT, abs=2.2 if where == "TIME_SYNC" else 0.3)
    assert recording.damage
    assert recording.clock_went_back() is None
    samples, edges = recording.samples, recording.edges
    assert not samples.gaps
    assert (np.diff(samples.index) == samples.config.decimation).all()
    assert np.abs(samples.tick - samples.index * 1250).max() <= 0.11 * HZ
    assert (np.diff(edges.tick) >= 0).all()
    if network == "bytes" or where not in ("edges", "all"):  # on CAN, a frame that is not of now is left out
        assert abs(int(edges.tick[-1]) - int(samples.tick[-1])) < 0.3 * HZ
    if network == "bytes":
        assert (np.diff(edges.index) == 1).all()
    capture = bench.read(tmp_path / "a.run")
    assert (len(capture), len(capture.edges)) == (len(samples), len(edges))
    assert any("dated" in words for _, _, words in capture.dropped)


@pytest.mark.parametrize("network", ["bytes", "CAN FD"])
@pytest.mark.parametrize("bit", [62, 63])
def test_a_time_of_no_clock_is_told_with_its_moment(tmp_path: Path, bit: int, network: str) -> None:
    device = simulated(network=network)
    of_heartbeats(device, lambda beat: {"tick": beat.tick + (_due(beat.tick, AT + 0.1) << bit)})
    ended = run(WatchedLink(device), save=tmp_path / "a.run", speed_rpm=300.0, duration=4.0, channels=CHANNELS)
    found = re.search(
        r"implausible: node 1: after ([\d.]+) s came what SPEC does not allow: HEARTBEAT", ended.summary.result
    )
    assert found is not None, ended.summary.result
    assert float(found[1]) == pytest.approx(AT, abs=0.2)
    assert "is not below 2^62" in ended.summary.result
    assert (ended.exit_code, ended.summary.link["malformed"]) == (1, 1)
    assert Run(tmp_path / "a.run").damage


def test_every_export_tells_it_and_has_every_row(tmp_path: Path) -> None:
    _, _, recording = _recorded(tmp_path / "a.run", "all", 1 << 31, "once", "bytes")
    rows = {"samples": len(recording.samples), "edges": len(recording.edges)}
    for ending in ENDINGS.values():
        done = export(recording, tmp_path / f"a{ending}")
        assert ending == ".rrd" or {name: done.rows[name] for name in rows} == rows, ending
        assert any("dated" in note for note in done.notes), ending
        assert not any("reboot" in note for note in done.notes), ending


# -- recordings that have such times in them ------------------------------------------------------------------------


def _leaping(path: Path, tmp_path: Path, by: int, ends: float) -> tuple[Run, Run]:
    """A sound recording, and the same with the ticks of samples and edges `by` away from `AT` to `ends`, s."""
    run(WatchedLink(simulated()), save=tmp_path / "sound.run", speed_rpm=300.0, duration=4.0, channels=CHANNELS)
    sound = Run(tmp_path / "sound.run")
    writer = RunWriter(path, sound.info)
    step = HZ // 50
    for first in range(sound.span[0], sound.span[1] + 1, step):
        for name in ("edges", "samples"):
            chunk = sound.chunk(name, first, first + step - 1)
            if isinstance(chunk, SampleChunk | EdgeChunk):
                off = by * ((chunk.tick >= AT * HZ) & (chunk.tick < ends * HZ))
                writer.take(replace(chunk, tick=chunk.tick + off))
    writer.close()
    return sound, Run(path)


@pytest.mark.slow
@pytest.mark.parametrize(("by", "ends"), [(1 << 32, 3.013), (-2 * HZ, 3.013), (3600 * HZ, 1e6), (-2 * HZ, 1e6)])
def test_a_recording_with_times_that_leap_is_read_whole(tmp_path: Path, by: int, ends: float) -> None:
    sound, leaping = _leaping(tmp_path / "a.run", tmp_path, by, ends)
    rows = {"samples": len(sound.samples), "edges": len(sound.edges)}
    capture = bench.read(tmp_path / "a.run")
    assert (len(capture), len(capture.edges)) == (rows["samples"], rows["edges"])
    assert capture.samples.raw.tobytes() == sound.samples.raw.tobytes()
    [first, *_] = [float(found[1]) for words in leaping.damage or bench.open(tmp_path / "a.run").damage
                   if (found := re.search(r"after ([\d.]+) s", words))] or [0.0]  # fmt: skip
    for ending in ENDINGS.values():
        again = Run(tmp_path / "a.run")
        done = export(again, tmp_path / f"a{ending}")
        assert ending == ".rrd" or {name: done.rows[name] for name in rows} == rows, ending
        leaps = [note for note in done.notes if "leaps by" in note]
        assert leaps, ending
        assert float(re.search(r"after ([\d.]+) s", leaps[0])[1]) == pytest.approx(AT, abs=0.05)  # type: ignore[index]
        assert not any("rebooted" in note for note in done.notes), ending
    assert pq.read_table(tmp_path / "a.parquet").num_rows == rows["samples"]
    assert first == 0.0 or first == pytest.approx(AT, abs=0.05)
