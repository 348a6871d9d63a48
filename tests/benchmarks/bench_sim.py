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

from bench.device.node import DRIVE
from protocol.signals import DRIVE_CHANNELS
from sim.config.params import load_params
from sim.ports.virtual import VirtualLink
from tests.bench.collect import Bench
from tests.benchmarks.table import Row
from tests.sim.drive.rig import Rig

RPM = 500.0
OMEGA_M = RPM * math.tau / 60  # rad/s
TORQUE = 0.236  # N·m: 4 A
SECONDS = 4.0  # virtual, for each run
REPEAT = 8  # runs, of which the best counts: other load on the machine only slows them
POLL = 0.075  # s, virtual: what a batch job waits at a time; ALIVE goes out once a poll
GOAL_ALONE = 150.0  # x real time
GOAL_PROTOCOL = 60.0


def alone(portion: int) -> float:
    """Times real time of `SimulatedBench.advance` in calls of `portion` periods."""
    bench = Rig()
    bench.start()
    bench.spin(RPM, 1.0, TORQUE)
    calls = round(SECONDS * 16000 / portion)
    start = time.perf_counter()
    for _ in range(calls):
        bench.advance(portion)
    took = time.perf_counter() - start
    assert abs(bench.truth.omega_m - OMEGA_M) < 5.0
    return calls * portion / 16000 / took


def run_against(rig: Bench, torque: float) -> None:
    """Stream all channels and edges, and run both machines: the load at a torque in N·m."""
    rig.stream(tuple(channel.name for channel in rig.drive.descriptor.channels))
    for node in (rig.load, rig.drive):
        node.arm()
        node.start()
    rig.load.torque(torque)


def through_protocol() -> float:
    """Times real time with all channels and edges, from the plant to the host's numpy columns."""
    rig = Bench(VirtualLink.of(load_params()))
    client = rig.client
    client.sinks = []
    run_against(rig, TORQUE)
    rig.drive.speed(OMEGA_M)
    client.run_for(1.0)
    before = client.losses(DRIVE).samples.samples
    start = time.perf_counter()
    end = client.now() + SECONDS
    while client.now() < end:
        client.poll(POLL)
    took = time.perf_counter() - start
    losses = client.losses(DRIVE)
    assert losses.samples.lost_by_index == losses.edges.lost_by_index == 0
    assert losses.edges.samples > SECONDS * 250
    return (losses.samples.samples - before) / 16000 / took


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
