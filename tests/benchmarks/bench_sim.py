"""Speed of the simulated drive in virtual time, alone and through the whole protocol, beside other simulators.

`python -m tests.benchmarks sim`. One core. The motor runs at 500 r/min under speed control against a load of 4 A; both
estimators, all sensors and the record are always computed. Through the protocol means: simulation, device session,
frames, host session, decoding to numpy columns, by the bench's own client. The peers need the extra `benchmark`; with
`$PEER_PYTHON` they run under another interpreter, should they not go with the rest.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time
from pathlib import Path

from bench.device.client import Client
from bench.device.node import DRIVE, LOAD, Node
from protocol.messages import DriveState, SetpointMode
from protocol.signals import DRIVE_CHANNELS
from protocol.streams import EdgeChunk, SampleChunk
from sim.config.params import load_params
from sim.drive.machine import SimulatedBench
from sim.ports.virtual import VirtualLink
from tests.benchmarks.table import Row

OMEGA_M = 500 * math.tau / 60  # rad/s
TORQUE = 0.236  # N·m: 4 A
SECONDS = 4.0  # virtual, for each run
REPEAT = 8  # runs, of which the best counts: other load on the machine only slows them
POLL = 0.075  # s, virtual: what a batch job waits at a time; ALIVE goes out once a poll
GOAL_ALONE = 150.0  # x real time
GOAL_PROTOCOL = 60.0


class _Count:
    """A sink that only counts."""

    def __init__(self) -> None:
        self.n = 0
        self.n_edges = 0

    def samples(self, chunk: SampleChunk) -> None:
        self.n += len(chunk)

    def edges(self, chunk: EdgeChunk) -> None:
        self.n_edges += len(chunk)

    def heartbeat(self, node: int, heartbeat: object) -> None:
        pass

    def event(self, node: int, event: object) -> None:
        pass

    def note(self, text: str, level: str = "INFO") -> None:
        pass


def alone(portion: int) -> float:
    """Times real time of `SimulatedBench.advance` in calls of `portion` periods."""
    bench = SimulatedBench(load_params())
    bench.enter_state(DriveState.ARMED)
    bench.enter_state(DriveState.RUNNING)
    bench.setpoint(SetpointMode.SPEED, OMEGA_M)
    bench.load_enter_state(DriveState.RUNNING)
    bench.load_setpoint(SetpointMode.TORQUE, TORQUE)
    bench.advance(16000)
    calls = round(SECONDS * 16000 / portion)
    start = time.perf_counter()
    for _ in range(calls):
        bench.advance(portion)
    took = time.perf_counter() - start
    assert abs(bench.truth.omega_m - OMEGA_M) < 5.0
    return calls * portion / 16000 / took


def through_protocol() -> float:
    """Times real time with all channels and edges, from the plant to the host's numpy columns."""
    link = VirtualLink.of(load_params())
    client = Client(link)
    sink = _Count()
    client.sinks.append(sink)
    client.connect()
    drive, load = Node(client, DRIVE), Node(client, LOAD)
    drive.set_samples(drive.descriptor.channels, 1)
    drive.set_edges()
    drive.start_streams()
    for node in (load, drive):
        node.arm()
        node.start()
    load.torque(TORQUE)
    drive.speed(OMEGA_M)
    client.run_for(1.0)
    before = sink.n
    start = time.perf_counter()
    end = client.now() + SECONDS
    while client.now() < end:
        client.poll(POLL)
    took = time.perf_counter() - start
    losses = client.losses(DRIVE)
    assert losses.samples.lost_by_index == losses.edges.lost_by_index == 0
    assert sink.n_edges > SECONDS * 250
    return (sink.n - before) / 16000 / took


def peers() -> list[Row]:
    """The other simulators' figures; none where they are not installed."""
    script = Path(__file__).with_name("peer_simulators.py")
    python = os.environ.get("PEER_PYTHON", sys.executable)
    done = subprocess.run([python, script], capture_output=True, text=True, timeout=600)
    try:
        results = json.loads(done.stdout.splitlines()[-1])
    except (ValueError, IndexError):
        print(f"  the peers failed: {done.stderr.strip().splitlines()[-1:]}")
        return []
    rows = []
    for name, result in results.items():
        if "error" in result:
            print(f"  {name}: {result['error']}")
        else:
            rows.append(Row(f"{name} {result['version']}: {result['note']}", result["x_real_time"], "x real time"))
    return rows


def rows() -> list[Row]:
    """The figures, as multiples of real time; the best of `REPEAT` runs."""
    whole = max(alone(16000) for _ in range(REPEAT))
    step = max(alone(80) for _ in range(REPEAT))
    protocol = max(through_protocol() for _ in range(REPEAT))
    return [
        Row("simulation alone", whole, "x real time", GOAL_ALONE),
        Row("simulation alone, 5 ms a call", step, "x real time"),
        Row(
            f"through the protocol, all {len(DRIVE_CHANNELS)} channels + edges", protocol, "x real time", GOAL_PROTOCOL
        ),
        *peers(),
    ]
