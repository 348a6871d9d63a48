"""The host's estimates as further channels: live, recorded, beside the drive's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from collect import Bench
from virtual_run import WatchedLink, run, simulated

from bench.record.reader import Run
from bench.replay.augment import Augmenter, host_channels
from protocol.descriptor import Channel
from protocol.signals import ANGLE, DRIVE_CHANNELS, Flag, RawType, Status, Unit
from protocol.streams import EdgeChunk, SampleChunk

pytestmark = pytest.mark.slow


def test_a_live_run_records_the_hosts_estimates_too(tmp_path: Path) -> None:
    path = tmp_path / "a.run"
    chosen = ("vector-tracking", "avg", "vt")
    ended = run(WatchedLink(simulated()), duration=0.6, estimate=chosen, host_observers=True, save=path)
    (errors,) = ended.summary.position_error_deg.values()
    assert errors["theta_vt_host"] == pytest.approx(errors["theta_vt"])
    assert ended.summary.host_observers["different"] == 0
    recorded = Run(path)
    raw = recorded.samples.raw
    assert raw.dtype.names[-4:] == ("theta_vt_host", "omega_vt_host", "theta_avg_host", "omega_avg_host")
    after = int(np.flatnonzero(raw["status"] & Status.OBSERVERS_RESET)[-1])
    assert len(raw) - after > 5000
    for name in ("theta_vt", "omega_vt", "theta_avg", "omega_avg"):
        assert np.array_equal(raw[name][after:], raw[f"{name}_host"][after:]), name
    assert {"theta_vt_host", "theta_avg_host"} < set(recorded.info.position_estimates)


def test_all_else_is_handed_on_as_it_came() -> None:
    bench = Bench(WatchedLink(simulated()))
    stream = bench.drive.set_samples(bench.drive.channels(None), 1)
    augmenter = Augmenter(["average_speed"], bench.drive.parameters(), stream)
    plain = []

    def change(chunk: SampleChunk | EdgeChunk) -> SampleChunk | EdgeChunk:
        plain.append(chunk)
        return augmenter.take(chunk)

    bench.client.change = change
    bench.load.set_samples(bench.load.channels(None), 16)
    bench.load.start_streams()
    bench.stream()
    bench.turn(50.0)
    bench.client.run_for(0.3)
    bench.drive.stop()
    nodes = set()
    for before, after in zip(plain, bench.collector.chunks, strict=True):
        nodes.add(before.config.node)
        if isinstance(before, EdgeChunk) or before.config.node != bench.hello.node:
            assert after is before
            continue
        assert isinstance(after, SampleChunk)
        assert after.config.channels == (*before.config.channels, *augmenter.channels)
        assert after.gaps == before.gaps
        for name in before.raw.dtype.names:
            assert np.array_equal(after.raw[name], before.raw[name])
    assert nodes == {1, 2}


def test_the_format_is_that_of_the_drives_estimates() -> None:
    angle, speed = host_channels(["vt"], DRIVE_CHANNELS)
    like = {channel.name: channel for channel in DRIVE_CHANNELS}
    for channel, name in ((angle, "theta_vt"), (speed, "omega_vt")):
        assert channel.name == f"{name}_host"
        for field in ("unit", "raw", "scale", "flags"):
            assert getattr(channel, field) == getattr(like[name], field), (name, field)
    floats = [
        Channel(1, "theta_x", Unit.RAD, RawType.F32, 1.0, Flag.CHANNEL | Flag.ESTIMATE | Flag.WRAPS),
        Channel(2, "omega_x", Unit.RAD_PER_S, RawType.I32, 0.5, Flag.CHANNEL | Flag.ESTIMATE),
    ]
    angle, speed = host_channels(["vt"], floats)
    assert (angle.raw, angle.scale, speed.raw, speed.scale) == (RawType.F32, 1.0, RawType.I32, 0.5)
    angle, speed = host_channels(["vt"], ())
    assert (angle.raw, angle.scale, speed.raw) == (RawType.I16, ANGLE, RawType.I16)
    assert angle.flags == Flag.CHANNEL | Flag.ESTIMATE | Flag.WRAPS
