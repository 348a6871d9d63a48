"""The link in virtual time: its clock, its waits, its determinism, and all channels through the protocol."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_host import SmallHost

from protocol.errors import LinkClosed
from protocol.messages import SetpointMode, StreamStop
from protocol.signals import DRIVE_CHANNELS
from protocol.streams import EDGE_RECORD
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


def test_a_wait_takes_its_virtual_time_and_no_more() -> None:
    link = quiet()
    assert link.read(0.0) == b""
    assert link.clock() == 0.0
    assert link.read(0.03) == b""
    assert link.clock() == pytest.approx(0.03)


@pytest.mark.parametrize("timeout", [1e-9, 1e-5, 1 / 16000])
def test_the_shortest_wait_moves_the_time_on(timeout: float) -> None:
    link = quiet()
    link.read(timeout)
    assert link.clock() == 1 / 16000


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
    host.run(0.2)
    loss = host.decoders[1, 0].counters
    assert loss.lost_by_index == loss.lost_by_seq == link.device.frames_dropped == 0
    assert loss.samples > 3.1 * 16000


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
    host.start()
    host.setpoint(SetpointMode.SPEED, 40.0)
    host.poll(0.0)
    commands = (link.device.bench._drive, link.device.bench._reset)
    assert link.device.periods == 0
    host.run(0.5)
    host.request(StreamStop())
    host.poll(0.0)

    bench = SimulatedBench(PARAMS, seed=5)
    bench._drive, bench._reset = commands
    bench.watch(frozenset(channel.id for channel in DRIVE_CHANNELS))
    recorded = bench.advance(link.device.periods)
    raw = np.concatenate([chunk.raw for chunk in host.samples[1, 0]])
    index = np.concatenate([chunk.index for chunk in host.samples[1, 0]])
    tick = np.concatenate([chunk.tick for chunk in host.samples[1, 0]])
    assert raw.dtype.names == tuple(channel.name for channel in DRIVE_CHANNELS)
    assert (raw == recorded.samples).all()
    assert (index == np.arange(len(raw))).all()
    assert (tick == 1250 * np.arange(len(raw))).all()
    edges = np.zeros(len(recorded.edges), EDGE_RECORD)
    edges["tick"] = np.concatenate([chunk.tick for chunk in host.edges])
    edges["codes"] = np.concatenate([chunk.hall_old | chunk.hall_new << 3 for chunk in host.edges])
    edges["encoder"] = np.concatenate([chunk.encoder for chunk in host.edges])
    assert len(edges) > 10
    assert (edges == recorded.edges).all()


def test_ticks_and_index_run_over_32_bits_without_a_break() -> None:
    start = 2**32 - 1250 * 8000 - 625
    host = SmallHost(VirtualLink.of(load_params(None, {"clock.start_tick": start})))
    host.stream()
    host.run(1.0)
    tick = np.concatenate([chunk.tick for chunk in host.samples[1, 0]])
    assert tick[0] == start
    assert (np.diff(tick) == 1250).all()
    assert tick[-1] > 2**32
