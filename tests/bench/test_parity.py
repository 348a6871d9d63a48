"""Drive, live host and recording compute the same bits, whichever observer has the control: the simulated drive over a
link in virtual time, through start-up, a speed step, a load step and a reversal, with the estimates of all observers
streamed, compared live, recorded, and computed anew from the recording.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from collect import Bench
from virtual_run import WatchedLink, simulated

from bench.live.summary import RunStatistics
from bench.record.reader import Run
from bench.record.sink import RunSink
from bench.replay.estimators import CHECKED, Estimators, HostObservers, raw_counts
from protocol.messages import Fault
from protocol.signals import AngleSource, Status
from sim.observers.catalogue import CATALOGUE
from tests.choice import chosen

pytestmark = [pytest.mark.long("all observers, twice")]

TABLE_I = (-1.2, -3.0, 7.2, -3.3, 0.6, 5.6)  # deg, of Kim et al. 2011: for those who are told where the edges lie
ESTIMATES = tuple(f"+{name}" for name in CHECKED)
SOURCES = tuple(source for source in AngleSource if source != AngleSource.ENCODER)
CASES = [*((source, 0) for source in SOURCES), (AngleSource.VECTOR_TRACKING, 1)]
"""Which observer has the control, and whether vector tracking compensates the load angle."""


@dataclass(frozen=True)
class Told:
    """A run as it was compared live, and as it was recorded."""

    source: AngleSource
    live: RunStatistics
    held: list[tuple[int, float]]
    """Samples that had come when a speed (mechanical rad/s) had been held for a while."""
    recorded: Run


def go(source: AngleSource, compensation: int, path: Path) -> tuple[RunStatistics, list[tuple[int, float]]]:
    """Run the drive with this observer in its loop; recorded to `path`."""
    held: list[tuple[int, float]] = []

    def hold(seconds: float, omega_m: float) -> None:
        client.run_for(seconds)
        held.append((live.samples_seen, omega_m))

    bench = Bench(WatchedLink(simulated(seed=3)))
    drive, load, client = bench.drive, bench.load, bench.client
    for name, value in (("observer", source), ("load_angle_comp", compensation), ("k_pc", 0.01 * compensation)):
        drive.set(name, value)
    for sector, delta in enumerate(TABLE_I, 1):
        for way in ("up", "down"):
            drive.set(f"edge_{way}_{sector}", math.radians(delta))
    info = bench.info(ESTIMATES)
    live = RunStatistics(info.node, HostObservers(info.parameters, drive.set_samples(drive.channels(ESTIMATES), 1)))
    sink = RunSink(path, info, wait=True)
    client.sinks = [sink, live]
    client.run_for(0.01)  # past the drive's first period, which initialises them too
    assert bench.stream(ESTIMATES) == 1
    load.arm()
    load.start()
    bench.turn(50.0)  # from an unknown angle
    hold(0.3, 50.0)
    drive.speed(100.0)
    hold(0.3, 100.0)
    load.torque(0.2)
    hold(0.3, 100.0)
    load.torque(0.0)
    drive.speed(-60.0)
    hold(0.5, -60.0)
    drive.set("observer", SOURCES[source % len(SOURCES)])  # the next takes over while it turns
    client.run_for(0.1)
    drive.stop()
    load.stop()
    client.run_for(0.05)
    sink.close()
    return live, held


@pytest.fixture(scope="module", params=chosen("parity", CASES, 3), ids=lambda case: f"{case[0].name.lower()}-{case[1]}")
def told(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Told:
    source, compensation = request.param
    path = tmp_path_factory.mktemp("parity") / "run.run"
    return Told(source, *go(source, compensation, path), Run(path))


def started(told: Told) -> int:
    """The sample with which the observers start, where ARMED begins."""
    resets = np.flatnonzero(told.recorded.samples.raw["status"] & Status.OBSERVERS_RESET)
    assert len(resets) == 1
    return int(resets[0])


def test_the_drive_followed_with_this_observer_in_its_loop(told: Told) -> None:
    """No observer needs gentler steps than the others: a run that trips or stalls would compare nothing of interest."""
    samples, edges = told.recorded.samples, told.recorded.edges
    omega_m = samples.physical("omega_enc") / 6.0
    assert told.live.faults == Fault(0)
    assert len(edges) > 800
    for end, speed in told.held:
        # by the speed that the observer sees: with Table I's sensors the mean of omega_h is some 1 % above the true one
        assert np.mean(omega_m[end - 400 : end]) == pytest.approx(speed, rel=0.1), end
    assert np.abs(samples.physical("i_q")).max() > 4.0


def test_live_on_the_host_no_sample_differs(told: Told) -> None:
    assert (told.live.samples_seen, told.live.edges_seen) == (len(told.recorded.samples), len(told.recorded.edges))
    assert (told.live.host_compared, told.live.host_differ) == (len(told.recorded.samples) - started(told), 0)


def test_from_the_recording_in_one_piece_each_observer_gives_the_drives_counts(told: Told) -> None:
    info, samples, start = told.recorded.info, told.recorded.samples, started(told)
    estimators = Estimators(tuple(CATALOGUE), info.parameters, samples.config)
    estimators.edges(told.recorded.edges)
    found = estimators.samples(samples)
    assert estimators.restarts == {"start": 1, "drive": 1, "lost_samples": 0, "lost_edges": 0}
    for name, entry in CATALOGUE.items():
        for what in ("theta", "omega"):
            channel = samples.config.channel(f"{what}_{entry.short}")
            counts = samples.raw[channel.name][start:]
            assert np.array_equal(raw_counts(channel, getattr(found[name], what))[start:], counts), channel.name
            assert len(np.unique(counts)) > (5 if channel.name == "theta_sc" else 100)
