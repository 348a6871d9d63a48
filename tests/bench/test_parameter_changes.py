"""Parameters that change during a run: drive, live host and recording use each value from the same sample on."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from collect import Bench
from virtual_run import WatchedLink, simulated

from bench.device.heard import ParameterSet
from bench.live.summary import RunStatistics
from bench.record.changes import settled
from bench.record.reader import Run, capture_of, captures
from bench.record.sink import RunSink
from bench.record.writer import whole_run
from bench.replay.estimators import CHECKED, Estimators, HostObservers, raw_counts
from bench.replay.replay import estimate_capture, replay
from bench.signal.parameters import Change, ParameterCourse
from protocol.codes import EventCode
from protocol.signals import Status
from sim.observers.catalogue import CATALOGUE

ESTIMATES = tuple(f"+{name}" for name in CHECKED)
CHANGES = {
    "k_p_vt": 700.0, "k_i_vt": 90000.0, "edge_up_1": 0.06, "edge_down_4": -0.05, "psi_f_hat": 0.0083, "tau_max": 2e-4,
    "bw_hall_vector": 25.0, "hall_timeout": 0.1, "bw_omega_lpf": 80.0, "J_hat": 3e-4, "R_s_hat": 0.2, "omega_on": 60.0,
}  # fmt: skip
"""One after the other, while the motor turns."""


@pytest.fixture(scope="module")
def changed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, RunStatistics]:
    """A run in which parameters of all observers change, and what a host saw that ran the observers beside it."""
    path = tmp_path_factory.mktemp("changes") / "run.run"
    bench = Bench(WatchedLink(simulated(seed=5)))
    drive, client = bench.drive, bench.client
    info = bench.info(ESTIMATES)
    live = RunStatistics(info.node, HostObservers(info.parameters, drive.set_samples(drive.channels(ESTIMATES), 1)))
    sink = RunSink(path, info, wait=True)
    client.sinks = [sink, live]
    client.run_for(0.01)
    assert bench.stream(ESTIMATES) == 1
    bench.turn(80.0)
    client.run_for(0.3)
    for name, value in CHANGES.items():
        assert drive.set(name, value) != info.parameters[name]
        client.run_for(0.0301)
    drive.stop()
    client.run_for(0.05)
    sink.close()
    return path, live


def started(run: Run) -> int:
    return int(np.flatnonzero(run.samples.raw["status"] & Status.OBSERVERS_RESET)[-1])


def differing(run: Run, found: dict[str, object], start: int) -> dict[str, int]:
    """Samples from `start` on at which an observer gives other counts than the drive, by channel."""
    samples, differ = run.samples, {}
    for name, entry in CATALOGUE.items():
        for what in ("theta", "omega"):
            channel = samples.config.channel(f"{what}_{entry.short}")
            counts = raw_counts(channel, getattr(found[name], what))
            differ[channel.name] = int((counts != samples.raw[channel.name])[start:].sum())
    return differ


def test_the_recording_has_each_change_once_with_the_drives_own_time(changed) -> None:
    run = Run(changed[0])
    assert [(change.name, change.node, change.exact) for change in run.changes] == [(n, 1, True) for n in CHANGES]
    assert [np.float32(change.value) for change in run.changes] == [np.float32(value) for value in CHANGES.values()]
    ticks = [change.tick for change in run.changes]
    assert np.diff(ticks) / run.info.tick_hz == pytest.approx(0.0301, abs=0.001)
    assert not [event for event in run.events if event.code == EventCode.PARAM_CHANGED]  # each is told once


def test_from_the_recording_each_observer_gives_the_drives_counts_across_all_changes(changed) -> None:
    run = Run(changed[0])
    estimators = Estimators(tuple(CATALOGUE), run.parameters, run.samples.config)
    estimators.edges(run.edges)
    differ = differing(run, estimators.samples(run.samples), started(run))
    assert set(differ.values()) == {0}, differ


def test_with_the_first_values_alone_they_would_not(changed) -> None:
    run = Run(changed[0])
    estimators = Estimators(tuple(CATALOGUE), dict(run.parameters), run.samples.config)
    estimators.edges(run.edges)
    differ = differing(run, estimators.samples(run.samples), started(run))
    assert min(differ["theta_vt"], differ["theta_ek"], differ["theta_hv"], differ["theta_lut"]) > 100


def test_live_on_the_host_no_sample_differs(changed) -> None:
    path, live = changed
    run = Run(path)
    assert (live.host_compared, live.host_differ) == (len(run.samples) - started(run), 0)


def test_a_replay_a_part_and_the_pieces_follow_too(changed, tmp_path: Path) -> None:
    run = Run(changed[0])
    result = replay(changed[0], ["vector_tracking"], out=tmp_path / "again.run")
    assert not [words for words in result.unknown if "changed" in words]
    again = Run(tmp_path / "again.run")
    assert again.changes == run.changes
    start = started(run)
    assert np.array_equal(again.samples.raw["theta_vt_host"][start:], run.samples.raw["theta_vt"][start:])
    whole = estimate_capture(capture_of(run), "vector_tracking", {})
    assert np.array_equal(whole.samples.raw["theta_vt_host"][start:], run.samples.raw["theta_vt"][start:])
    fixed = estimate_capture(capture_of(run), "vector_tracking", {"k_p": 700.0})
    assert not np.array_equal(fixed.samples.raw["theta_vt_host"], whole.samples.raw["theta_vt_host"])
    a, b = run.changes[2].tick, run.changes[5].tick
    middle = capture_of(run, a + 1, b)
    expected = {**run.info.parameters, **{c.name: c.value for c in run.changes[:3]}}
    assert dict(middle.parameters) == expected
    pieces = [piece.parameters for piece in captures(run)]
    for before, after in pairwise(pieces):
        assert {**before, **{c.name: c.value for c in before.changes}} == {
            **after, **{c.name: c.value for c in after.changes}
        }  # fmt: skip


@pytest.mark.parametrize("seed", range(20))
def test_a_course_says_at_each_sample_what_was_set_last_before_it(seed: int) -> None:
    """By going through the changes one by one, which `since` does not."""
    random = np.random.default_rng(seed)
    names = ["a", "b", "c"]
    changes = [
        Change(int(tick), str(random.choice(names)), float(value))
        for value, tick in enumerate(random.integers(0, 50, 30))
    ]
    course = ParameterCourse(dict.fromkeys(names, -1.0), changes)
    for tick in range(52):
        expected = dict.fromkeys(names, -1.0)
        for change in sorted(changes, key=lambda change: change.tick):
            if change.tick < tick:
                expected[change.name] = change.value
        since = course.since(tick)
        assert dict(since) == expected
        assert dict(since.since(60)) == dict(course.since(60))
        assert dict(course.fixed({"b": 7.0}).since(tick)) == {**expected, "b": 7.0}


def test_what_this_host_has_dated_gives_way_to_what_the_node_has() -> None:
    """Whichever came first; what the node did not tell stays, and each event stands for one set only."""
    own = [ParameterSet(tick, 1, "k_p_vt", value) for tick, value in ((100, 1.0), (5000, 2.0), (9000, 1.0))]
    told = [ParameterSet(120, 1, "k_p_vt", 1.0, exact=True), ParameterSet(4990, 1, "k_p_vt", 2.0, exact=True)]
    other = ParameterSet(130, 2, "k_p_vt", 1.0)
    assert settled([own[0], told[0], told[1], own[1], own[2], other]) == (told[0], told[1], own[2], other)


def test_a_recording_follows_a_change_whose_event_was_lost_to_a_value_that_was_told_before(changed, tmp_path) -> None:
    """700, 900, 700 within a second: each set has an event but the last, which has only what this host has dated."""
    run, path = Run(changed[0]), tmp_path / "lost.run"
    told = [ParameterSet(100, 1, "k_p_vt", 700.0, exact=True), ParameterSet(300, 1, "k_p_vt", 900.0, exact=True)]
    own = [ParameterSet(tick, 1, "k_p_vt", value) for tick, value in ((110, 700.0), (310, 900.0), (500, 700.0))]
    with whole_run(path, run.info) as writer:
        for item in (own[0], told[0], told[1], own[1], own[2], run.samples):
            writer.take(item)
    changes = Run(path).parameters.changes
    assert [(change.tick, change.value) for change in changes] == [(100, 700.0), (300, 900.0), (500, 700.0)]
