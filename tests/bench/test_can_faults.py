"""A run over a CAN bus on which everything goes wrong: each fault is counted, no value is wrong, STOP gets through.

In virtual time, on the simulated bus. What is right is what the drive said itself: its samples are compared with those
of the same drive, with the same seed, over a byte link that loses nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import product
from typing import Any

import numpy as np
import pytest
from collect import Bench
from virtual_run import WatchedLink

from protocol.canmap.frame import EXTENDED, REMOTE, BusRates
from protocol.device.records import made
from protocol.messages import DriveState, Fault
from protocol.streams import EdgeChunk, SampleChunk
from sim.config.params import load_params
from sim.ports.can_bus import Controller, State
from sim.ports.device import SimulatedDevice
from sim.ports.networks import CanNetwork
from tests.choice import sampled

pytestmark = pytest.mark.slow

CLASSIC = BusRates(1_000_000)
FD = BusRates(1_000_000, 5_000_000)
NAMES = ("hall", "status", "theta_enc", "i_a", "i_b", "i_c", "theta_vt")
STEP = 0.002  # s


class Rig:
    """A bench on a simulated bus; `bus` is where faults are ordered."""

    def __init__(self, rates: BusRates, seed: int = 3, step: float = STEP) -> None:
        self.network = CanNetwork(rates, seed=seed)
        self.bus = self.network.bus
        self.device = SimulatedDevice(load_params(), seed, network=self.network)
        self.samples: list[np.ndarray] = []  # what the drive handed to its streams: the truth to compare with
        self.edges: list[np.ndarray] = []
        drive = self.device.drive
        self.first: list[int] = []  # index of the first of them
        all_of_them = frozenset(channel.name for channel in drive.app.channels)
        keep = partial(made, names=all_of_them)
        drive.push_samples = kept_of(drive.push_samples, self.samples, self.first, keep)  # type: ignore[method-assign]
        drive.push_edges = kept_of(drive.push_edges, self.edges)  # type: ignore[method-assign]
        self.link = WatchedLink(self.device)
        self.link._step = max(1, round(step * self.device.pwm_hz))  # small, so that bus and drive keep together
        self.bench = Bench(self.link)
        self.client = self.bench.client

    def go(self, omega_m: float = 50.0) -> None:
        self.bench.stream(NAMES)
        self.bench.turn(omega_m)

    def end(self, after: float = 0.0):
        """Without faults again, `after` s with them: the streams' account comes up to date, and is checked."""
        self.client.run_for(after)
        self.bus.corrupt = None
        self.bus.faults.drop = self.bus.faults.duplicate = 0.0
        self.bus.faults.delay = None
        self.client.run_for(0.4)
        self.check()
        return self.client.losses(1)

    def check(self) -> None:
        """Every sample is the drive's own of that index, every edge too, and what is missing is counted."""
        samples = [chunk for chunk in self.bench.collector.chunks if isinstance(chunk, SampleChunk)]
        edges = [chunk for chunk in self.bench.collector.chunks if isinstance(chunk, EdgeChunk)]
        true_samples, true_edges = np.concatenate(self.samples), np.concatenate(self.edges)
        first = self.first[0]
        for chunk in samples:
            for name in NAMES:
                assert (chunk.raw[name] == true_samples[name][chunk.index - first]).all(), name
        for each in edges:
            assert (each.tick & 0xFFFFFFFF == true_edges["tick"][each.index]).all()
            assert (each.encoder == true_edges["encoder"][each.index]).all()
        losses = self.client.losses(1)
        index = np.concatenate([chunk.index for chunk in samples])
        decimation = samples[0].config.decimation
        assert (np.diff(index) > 0).all()
        assert losses.samples.samples == len(index)
        assert losses.samples.samples + losses.samples.lost_by_index == (index[-1] - index[0]) // decimation + 1
        numbers = np.concatenate([each.index for each in edges])
        assert losses.edges.samples + losses.edges.lost_by_index == numbers[-1] + 1


def kept_of(
    push: Callable[..., None],
    kept: list[np.ndarray],
    begun: list[int] | None = None,
    made_of: Callable[[Any], np.ndarray] = np.asarray,
) -> Callable[..., None]:
    """`push`, whose last argument is kept too; `begun` gets its first one, once."""

    def pushed(*arguments: Any) -> None:
        if begun == []:
            begun.append(arguments[0])
        kept.append(made_of(arguments[-1]).copy())
        push(*arguments)

    return pushed


@pytest.fixture(params=[CLASSIC, FD], ids=["classic", "FD"])
def rig(request: pytest.FixtureRequest) -> Rig:
    return Rig(request.param)


def test_without_faults_nothing_is_lost(rig: Rig) -> None:
    rig.go()
    losses = rig.end(after=1.0)
    assert losses.samples.lost_by_index == losses.edges.lost_by_index == losses.edges.late == 0
    assert rig.client.session.counters.framing.bad == 0


def test_dropped_frames_are_counted(rig: Rig) -> None:
    rig.go()
    rig.client.run_for(0.3)
    rig.bus.faults.drop = 0.05
    losses = rig.end(after=1.0)
    assert losses.samples.lost_by_seq > 10
    assert losses.samples.lost_by_index >= losses.samples.lost_by_seq / 3
    assert losses.edges.lost_by_index > 0
    if not rig.bus.rates.fd:  # a heartbeat is one FD frame
        counters = rig.client.session.counters.framing
        assert counters.aborted + counters.bad_crc + counters.orphans > 0
    assert rig.device.drive.state in (DriveState.RUNNING, DriveState.FAULT)


def test_doubled_frames_are_counted(rig: Rig) -> None:
    rig.go()
    rig.bus.faults.duplicate = 0.2
    losses = rig.end(after=1.0)
    assert losses.samples.lost_by_index == losses.edges.lost_by_index == 0
    assert losses.samples.out_of_order > 50
    assert losses.edges.out_of_order > 10
    assert rig.client.session.counters.framing.duplicates > 0
    assert rig.device.drive.state is DriveState.RUNNING


def test_identifiers_that_overtake_each_other(rig: Rig) -> None:
    """Edges come 30 ms late, then every identifier by another time."""
    rig.go()
    rig.client.run_for(0.2)
    rig.bus.faults.delay = lambda can_id: 0.03 if can_id >> 8 == 4 else 0.0
    rig.client.run_for(0.5)
    assert rig.client.losses(1).edges.late > 20
    rng = np.random.default_rng(1)
    rig.bus.faults.delay = lambda can_id: float(rng.uniform(0.0, 0.02))
    losses = rig.end(after=0.5)
    assert losses.samples.lost_by_index == losses.edges.lost_by_index == 0
    assert rig.device.drive.state is DriveState.RUNNING


def test_error_frames_cost_time_only(rig: Rig) -> None:
    rng = np.random.default_rng(2)
    rig.go()
    rig.bus.corrupt = lambda record, time: bool(rng.random() < 0.05)
    losses = rig.end(after=1.0)
    assert losses.samples.lost_by_index == losses.edges.lost_by_index == 0
    assert rig.bus.error_frames > 50
    assert rig.client.session.counters.framing.error_frames > 50
    assert rig.client.heartbeats[1].rx_bad == 0
    assert rig.device.drive.state is DriveState.RUNNING


def of_node(node: int) -> Callable[[bytes, float], bool]:
    return lambda record, time: record[0] >> 4 == node and record[1] & 7 in (1, 3, 4, 5, 6)


def go_bus_off(rig: Rig, controller: Controller, corrupt: Callable[[bytes, float], bool]) -> None:
    """Destroy these frames until the controller has given up."""
    rig.go()
    rig.client.run_for(0.3)
    rig.bus.corrupt = corrupt
    assert rig.client.wait(lambda: controller.state is State.BUS_OFF, 2.0)
    rig.bus.corrupt = None


def test_the_drive_goes_bus_off_and_comes_back(rig: Rig) -> None:
    controller = rig.bus._nodes[1]
    assert controller.name == "simulated drive"
    go_bus_off(rig, controller, of_node(1))
    assert rig.client.wait(lambda: controller.state is State.ACTIVE, 1.0)
    losses = rig.end(after=0.5)
    assert 0 < losses.samples.lost_by_seq + losses.edges.lost_by_seq <= rig.bus.abandoned  # the rest were no stream's
    assert rig.client.session.counters.framing.error_frames >= 32  # 256 / 8 errors to bus-off


def test_a_drive_that_stays_off_the_bus_switches_off_by_itself(rig: Rig) -> None:
    controller = rig.bus._nodes[1]
    controller.auto_restart = None
    go_bus_off(rig, controller, of_node(1))
    rig.client.run_for(0.3)
    assert rig.device.drive.machine.faults == Fault.WATCHDOG
    assert not rig.device.drive.app.outputs_on
    controller.restart()
    rig.client.run_for(0.5)
    assert rig.bench.drive.state is DriveState.FAULT
    rig.check()


def test_the_adapter_goes_bus_off(rig: Rig) -> None:
    adapter = rig.network.adapter
    adapter.auto_restart = 0.5
    go_bus_off(rig, adapter, lambda record, time: record[1] & 7 == 2 or record[0:2] == b"\x15\x01")  # the host's
    rig.client.run_for(0.4)
    assert rig.device.drive.machine.faults == Fault.WATCHDOG
    rig.client.run_for(0.6)
    rig.end()
    assert rig.bench.drive.state is DriveState.FAULT


# -- a babbling node --------------------------------------------------------------------------------------------------


def test_a_stop_to_everybody_stops_both_machines_whoever_sends_it(rig: Rig) -> None:
    rig.go()
    rig.bench.load.arm()
    rig.bench.load.start()
    rig.client.run_for(0.2)
    assert rig.device.load.state is rig.device.drive.state is DriveState.RUNNING
    stranger = rig.bus.babble(0x000, 0.001, 0)
    rig.client.run_for(0.01)
    rig.bus.detach(stranger)
    assert rig.device.load.state is rig.device.drive.state is DriveState.IDLE


BABBLED = [*product((CLASSIC, FD), (0x0FF, 0x100, 0x455, 0x7FF, EXTENDED | 0x1FFFFFFF))]


@pytest.mark.parametrize(("rates", "can_id"), sampled("babbled", BABBLED, 3, campaign="links"))
def test_stop_gets_through_a_babbling_node_within_20_ms(rates: BusRates, can_id: int) -> None:
    """At 80 % of the bus, with identifiers above and below all of ours but STOP's, beside the streams."""
    fine = Rig(rates, step=0.0005)
    fine.go()
    fine.client.run_for(0.2)
    fine.bus.babble(can_id, 0.8, 8)
    fine.client.run_for(0.3)
    drive = fine.device.drive
    assert drive.state is DriveState.RUNNING
    assert fine.bus.busy_seconds / fine.bus.time > 0.4
    asked = fine.link.clock()
    fine.bench.drive.client.session.cancel()
    stopped: list[float] = []
    stop = drive.machine._app.enter_state

    def enter(state: DriveState) -> None:
        if state is DriveState.IDLE and not stopped:
            stopped.append(fine.bus.time)
        stop(state)

    drive.machine._app.enter_state = enter  # type: ignore[method-assign]
    fine.bench.drive.stop()
    assert stopped[0] - asked < 0.020
    assert drive.state is DriveState.IDLE
    assert not drive.app.outputs_on
    fine.check()


def test_foreign_frames_are_counted(rig: Rig) -> None:
    rig.go()
    before = rig.bus.frames
    babbler = rig.bus.babble(0x7F0, 0.2)
    remote = rig.bus.babble(0x513 | REMOTE, 0.01, 0) if not rig.bus.rates.fd else None
    rig.client.run_for(1.0)
    rig.bus.detach(babbler)
    if remote is not None:
        rig.bus.detach(remote)
    rig.end()
    assert 0 < rig.client.session.counters.framing.foreign < rig.bus.frames - before
    assert rig.client.losses(1).samples.lost_by_index == 0


def test_an_overloaded_bus_loses_streams_not_control(rig: Rig) -> None:
    """A bus that is full: the drive drops and counts, the setpoints and heartbeats go on."""
    rig.go()
    rig.client.run_for(0.2)
    rig.bus.babble(0x3FF, 0.7)
    rig.client.run_for(1.0)
    rig.bench.drive.speed(60.0)
    losses, heartbeat = rig.end(after=0.5), rig.client.heartbeats[1]
    assert rig.device.drive.state is DriveState.RUNNING
    assert heartbeat.tx_dropped > 0
    assert losses.samples.lost_by_seq + losses.edges.lost_by_seq <= heartbeat.tx_dropped
