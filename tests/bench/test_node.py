"""Client and nodes against the simulated bench over every kind of link: in virtual time, and over real ones."""

from __future__ import annotations

import gc
import re
from collections.abc import Iterator

import numpy as np
import pytest
from collect import Bench
from processes import Sim
from virtual_bus import PATIENT, on_virtual_bus
from virtual_run import NETWORKS, WatchedLink, simulated

from bench.device.client import Client
from bench.device.node import Node
from bench.errors import NodeError
from protocol.canmap.frame import BusRates
from protocol.errors import LinkClosed
from protocol.links import open_link
from protocol.messages import DriveState, EventCode, Fault, Feature, Role
from protocol.signals import DRIVE_CHANNELS, DRIVE_PARAMETERS
from protocol.streams import SampleChunk

pytestmark = [pytest.mark.long("a simulated drive in a process of its own")]

SIMS = {
    "pty": ("--pty",),
    "tcp": ("--tcp", "127.0.0.1:0"),
    "slcan": ("--slcan",),
    "slcan, FD": ("--slcan", "--fd"),
    "slcan, 29 bits": ("--slcan", "--ext"),
}
IN_PROCESS = {
    "virtual": BusRates(),
    "virtual, FD": BusRates(1_000_000, 5_000_000),
}


def virtual(network: str) -> Bench:
    return Bench(WatchedLink(simulated(1, network)))


REAL = [
    pytest.param(link, marks=() if link == "pty" else pytest.mark.campaign("links")) for link in (*SIMS, *IN_PROCESS)
]


@pytest.fixture(scope="module", params=[*NETWORKS, *REAL])
def target(request: pytest.FixtureRequest) -> Iterator[str]:
    """A kind of link: a network in virtual time, or the target of a simulated bench in real time."""
    if request.param in NETWORKS:
        yield request.param
    elif request.param in IN_PROCESS:
        with on_virtual_bus(request.param, IN_PROCESS[request.param]) as name:
            yield name
    else:
        sim = Sim(*SIMS[request.param], *(f"--set={key}={value}" for key, value in PATIENT.items()))
        yield sim.target
        sim.close()


@pytest.fixture
def bench(target: str) -> Iterator[Bench]:
    """A host that has just come to the bench over each kind of link; it leaves it at rest."""
    if target in NETWORKS:
        yield virtual(target)
        return
    link = open_link(target)
    try:
        bench = Bench(link)
        yield bench
        bench.rest()
    finally:
        link.close()


def test_a_whole_session_over_each_link(bench: Bench) -> None:
    drive, load = bench.drive, bench.load
    assert (drive.identity.role, load.identity.role) == (Role.DRIVE, Role.LOAD)
    assert drive.identity.features & Feature.SIMULATED
    assert [channel.name for channel in drive.descriptor.channels] == [s.name for s in DRIVE_CHANNELS]
    assert set(drive.parameters()) == {p.name for p in DRIVE_PARAMETERS}
    before = drive.parameter("R_s_hat")
    assert before.default == np.float32(0.158)
    assert drive.set("R_s_hat", 0.2) == np.float32(0.2) == drive.parameter("R_s_hat").value
    assert drive.set("R_s_hat", before.default) == before.default
    with pytest.raises(NodeError, match=r"i_max must be 0\.\.200, got 999"):
        drive.set("i_max", 999)
    with pytest.raises(NodeError, match="no parameter 'R_hat': did you mean R_s_hat"):
        drive.set("R_hat", 1)
    decimation = bench.stream()
    bench.turn(50.0)
    assert drive.state == DriveState.RUNNING
    bench.client.run_for(0.3)
    with pytest.raises(NodeError, match="i_max was not set to 5: node 1 takes it only with its outputs off"):
        drive.set("i_max", 5)  # only while the outputs are off
    assert drive.stop() == DriveState.IDLE
    drive.stop_streams()
    heartbeat = drive.next_heartbeat()
    assert not heartbeat.outputs_on
    samples, edges = bench.collector.all_samples(), bench.collector.all_edges()
    assert (np.diff(samples.index) == decimation).all()
    assert (np.diff(samples.tick) == 1250 * decimation).all()
    assert (np.diff(edges.index) == 1).all()
    losses = bench.client.losses(1)
    assert losses.samples.samples == len(samples) > 4000 / decimation
    assert losses.edges.samples == len(edges) > 10
    for counters in (losses.samples, losses.edges):
        assert counters.lost_by_index == counters.lost_by_seq == counters.overruns == counters.stale == 0
        assert counters.out_of_order == counters.malformed == counters.late == 0
    assert (bench.client.session.counters.framing.bad, heartbeat.tx_dropped) == (0, 0)
    assert samples.physical("omega_enc")[-100 // decimation - 1] == pytest.approx(6 * 50, rel=0.3)


def test_setpoints_are_confirmed_or_the_rejection_is_raised(network: str) -> None:
    bench = virtual(network)
    with pytest.raises(NodeError, match=r"rejected the setpoint SPEED 10: WRONG_STATE \(1\) \(state IDLE"):
        bench.drive.speed(10.0)
    bench.turn(50.0)
    bench.drive.current(2.0, -1.0)
    with pytest.raises(NodeError, match="rejected the setpoint CURRENT 50"):
        bench.drive.current(50.0)
    with pytest.raises(NodeError, match="rejected the setpoint SPEED 1000"):
        bench.drive.speed(1000.0)
    with pytest.raises(NodeError, match="rejected the setpoint TORQUE"):
        bench.drive.torque(0.1)
    assert bench.drive.state == DriveState.RUNNING
    bench.client.run_for(0.2)
    assert [event.code for _, event in bench.collector.events].count(EventCode.SETPOINT_REJECTED) == 4


def test_a_setpoint_counts_as_confirmed_only_when_this_host_sent_it(network: str) -> None:
    first = virtual(network)
    first.turn(50.0)
    first.drive.stop()
    second = Bench(first.client.link)  # the drive remembers the counter of the first host
    second.client.wait(lambda: 1 in second.client.heartbeats, 1.0)
    with pytest.raises(NodeError, match="state IDLE"):
        second.drive.speed(50.0)


def test_losses_add_up_over_reconfigurations(network: str) -> None:
    bench = virtual(network)
    for names in (("hall",), ("i_a", "i_b"), None):
        bench.stream(names)
        bench.client.run_for(0.2)
    seen = sum(len(chunk) for chunk in bench.collector.chunks if isinstance(chunk, SampleChunk))
    assert (bench.client.losses(1).samples.samples, bench.client.losses(1).samples.lost_by_seq) == (seen, 0)


# -- the watchdog -----------------------------------------------------------------------------------------------


class DeafLink(WatchedLink):
    """Loses what the drive sends, once `deaf`."""

    deaf = False

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        if not self.deaf:
            return super().read(timeout, settle)
        self.device.advance(max(1, self._periods(timeout)))
        self.device.data_to_send()
        return b""


def test_a_host_that_no_longer_hears_the_drive_stops_feeding_its_watchdog(network: str) -> None:
    link = DeafLink(simulated(1, network))
    bench = Bench(link)
    bench.turn(50.0)
    bench.client.run_for(0.2)
    assert link.device.drive.state == DriveState.RUNNING
    link.deaf = True
    start = link.clock()
    bench.client.wait(lambda: link.device.drive.state == DriveState.FAULT, 5.0)
    assert link.clock() - start < 0.3 + 0.2 + 0.1  # telemetry is stale after 0.3 s, the watchdog waits for 0.2 s
    assert link.device.drive.machine.faults == Fault.WATCHDOG
    assert not link.device.drive.app.outputs_on
    link.deaf = False
    bench.client.run_for(0.2)
    why = r"this host sent no ALIVE for 0\.\d\d s, because the drive was silent for 0\.\d\d s: the link carried nothing"
    assert re.fullmatch(why, bench.client.starved(1))


def test_garbage_is_not_looked_for_among_all_that_there_is_while_a_watchdog_is_fed(network: str) -> None:
    bench, there = virtual(network), len(gc.get_objects())
    bench.turn(50.0)
    assert len(gc.get_objects()) < 0.5 * there  # a full collection goes through these
    bench.drive.stop()
    assert len(gc.get_objects()) > 0.9 * there


# -- links that fail --------------------------------------------------------------------------------------------


def test_a_lost_link_is_raised_at_once_where_nobody_waits_for_it(network: str) -> None:
    bench = virtual(network)
    bench.client.link.close()
    with pytest.raises(LinkClosed):
        bench.client.poll()
    client = Client(bench.client.link, reconnect=1.0)
    client.poll()
    assert client.health.outages == 1
    with pytest.raises(LinkClosed, match="is gone: HELLO was not sent"):
        _ = Node(client, 1).identity


def test_the_clock_fit_puts_a_tick_at_its_time(network: str) -> None:
    fit = virtual(network).drive.clock_fit()
    assert (fit.tick_hz, fit.host_time(fit.tick + 20_000_000)) == (20_000_000, pytest.approx(fit.host + 1.0))
    assert fit.host == pytest.approx(fit.tick / fit.tick_hz, abs=0.03)
