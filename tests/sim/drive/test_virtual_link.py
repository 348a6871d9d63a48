"""The link in virtual time: its clock, its waits, its determinism, and all channels through the protocol."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_host import SmallHost

from protocol.errors import LinkClosed
from protocol.messages import SetpointMode, StreamStop
from protocol.signals import DRIVE_CHANNELS, LOAD_CHANNELS
from sim.config.params import ConfigError, load_params
from sim.drive.machine import SimulatedBench
from sim.ports.virtual import VirtualLink, open_virtual

PARAMS = load_params()


def quiet(step: float = 0.05) -> VirtualLink:
    """A link on which nothing waits."""
    link = VirtualLink.of(PARAMS, step=step)
    link.read(0.0)
    return link


def test_it_opens_from_a_file_and_dotted_keys(tmp_path: Path) -> None:
    file = tmp_path / "my.toml"
    file.write_text("[motor]\nR_s = 0.3\n[inverter]\nu_dc = 20\n")
    link = open_virtual(file, {"motor.R_s": 0.4}, 5)
    params = link.device.bench.params
    assert (params.motor.R_s, params.inverter.u_dc) == (0.4, 20.0)
    assert SmallHost(link).connect().boot_id == SmallHost(VirtualLink.of(load_params(), 5)).connect().boot_id
    with pytest.raises(ConfigError, match="R_s must be > 0"):
        open_virtual(None, {"motor.R_s": -1.0}, 0)


@pytest.mark.parametrize("timeout", [0.0, 1e-9, 1e-5, 1 / 16000, 0.03])
def test_a_wait_takes_its_virtual_time_in_whole_periods_and_no_more(timeout: float) -> None:
    link = quiet()
    assert link.read(timeout) == b""
    assert link.clock() == pytest.approx(np.ceil(timeout * 16000) / 16000)


def test_a_wait_ends_within_a_step_of_the_bytes() -> None:
    link = quiet(step=0.004)
    start = link.clock()
    assert link.read(10.0)  # the next heartbeat
    assert start < link.clock() <= 0.104


def test_settle_collects() -> None:
    host = SmallHost(link := VirtualLink.of(PARAMS, step=0.005))
    host.stream(edges=False)
    link.read(0.0)
    start = link.clock()
    data = link.read(1.0, settle=0.05)
    assert link.clock() - start <= 0.056
    assert len(data) > 0.03 * 16000 * 50


def test_long_waits_lose_nothing() -> None:
    host = SmallHost(link := VirtualLink.of(PARAMS))
    host.stream()
    link.device.advance(3 * 16000)  # a host that is busy for 3 s
    host.run(0.5)
    loss = host.losses(1).samples
    assert loss.lost_by_index == loss.lost_by_seq == link.device.frames_dropped == 0
    assert loss.samples > 3.4 * 16000


def test_close_stops_the_time_and_reopen_goes_on() -> None:
    link = quiet()
    link.read(0.01)
    link.close()
    for call in (lambda: link.read(1.0), lambda: link.write(b"x")):
        with pytest.raises(LinkClosed, match="virtual: is closed"):
            call()
    assert link.clock() == pytest.approx(0.01)
    link.reopen()
    link.read(0.01)
    assert link.clock() == pytest.approx(0.02)


def test_what_comes_out_is_what_the_bench_recorded() -> None:
    """Every sample of every channel and every edge, against the same bench run without any protocol."""
    host = SmallHost(link := VirtualLink.of(PARAMS, seed=5))
    host.stream()
    host.stream(node=2, edges=False)
    for node in (1, 2):
        host.start(node)
    host.setpoint(SetpointMode.SPEED, 40.0)
    host.setpoint(SetpointMode.TORQUE, 0.1, node=2)
    host.poll(0.0)
    done = link.device.bench
    commands = (done._drive, done._load, done._load_state, done._reset)
    assert link.device.periods == 0
    host.run(0.5)
    for node in (1, 2):
        host.request(StreamStop(), node)
    host.poll(0.0)

    bench = SimulatedBench(PARAMS, seed=5)
    bench._drive, bench._load, bench._load_state, bench._reset = commands
    bench.watch(frozenset(channel.name for channel in DRIVE_CHANNELS))
    recorded = bench.advance(link.device.periods)
    for node, channels, truth in ((1, DRIVE_CHANNELS, recorded.samples), (2, LOAD_CHANNELS, recorded.load_samples)):
        samples = host.samples(node)
        assert samples.raw.dtype.names == tuple(channel.name for channel in channels)
        assert (samples.raw == truth).all()
        assert (samples.index == np.arange(len(truth))).all()
        assert (samples.tick == 1250 * np.arange(len(truth))).all()
    edges, truth = host.edges(), recorded.edges
    assert len(edges) > 10
    assert (edges.tick == truth["tick"]).all()
    assert (edges.hall_old | edges.hall_new << 3 == truth["codes"]).all()
    assert (edges.encoder == truth["encoder"]).all()


def test_ticks_and_index_run_over_32_bits_without_a_break() -> None:
    start = 2**32 - 1250 * 8000 - 625
    host = SmallHost(VirtualLink.of(load_params(None, {"clock.start_tick": start})))
    host.stream()
    host.start(2)
    host.setpoint(SetpointMode.SPEED, 100.0, node=2)
    host.run(1.0)
    samples, edges = host.samples(), host.edges()
    assert samples.tick[0] == start
    assert (np.diff(samples.tick) == 1250).all()
    assert edges.tick[0] < 2**32 < edges.tick[-1] <= samples.tick[-1] + 16 * 1250  # samples wait for a full frame
    settled = slice(len(edges) // 4, None)
    assert np.diff(edges.tick)[settled] == pytest.approx(20e6 / 600.0, rel=0.3)
    assert samples.raw["omega_avg"][8000:] * 0.125 == pytest.approx(600.0, rel=0.3)
