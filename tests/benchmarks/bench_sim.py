"""Speed of the simulated drive in virtual time, alone and through the whole protocol.

`python -m tests.benchmarks sim`. One core. The motor runs at 500 r/min under speed control against a load of 4 A; all
sensors and the record are always computed, the average-speed and the vector-tracking observer too, and the others
where their channels are streamed. Through the protocol means: simulation, device session, frames, host session,
decoding to numpy columns, by the bench's own client.
"""

from __future__ import annotations

import math
import time

from bench.device.node import DRIVE
from protocol.messages import StreamEvent
from sim.config.params import load_params
from sim.config.unkind import unkind
from sim.ports.virtual import VirtualLink
from tests.bench.collect import Bench
from tests.benchmarks.table import Row, speed
from tests.sim.drive.rig import PWM_HZ, Rig

RPM = 500.0
OMEGA_M = RPM * math.tau / 60  # rad/s
TORQUE = 0.236  # N·m: 4 A
POLL = 0.075  # s, virtual: what a batch job waits at a time; ALIVE goes out once a poll
CALLS = (1.0, 0.005)  # s
GOAL_UNKIND = 1.6  # times as long with every effect of a real bench as without


def alone(seconds: float, call: float, **settings: object) -> float:
    """Times real time of `SimulatedBench.advance` in calls of `call` s, so many s in all."""
    bench = Rig(0, **settings)
    bench.start()
    bench.spin(RPM, 1.0, TORQUE)
    calls, portion = math.ceil(seconds / call), round(call * PWM_HZ)
    start = time.process_time()
    for _ in range(calls):
        bench.advance(portion)
    took = time.process_time() - start
    assert abs(bench.truth.omega_m - OMEGA_M) < 5.0
    return calls * call / took


def all_channels(rig: Bench) -> tuple[str, ...]:
    """Names of all channels of the drive, those that are streamed on request too."""
    return tuple(channel.name for channel in rig.drive.descriptor.channels)


def run_against(rig: Bench, torque: float, names: tuple[str, ...] | None) -> int:
    """Stream channels and edges, and run both machines: the load at a torque in N·m. How many channels there are."""
    rig.stream(names)
    for node in (rig.load, rig.drive):
        node.arm()
        node.start()
    rig.load.torque(torque)
    (samples,) = (config for config in rig.drive.active_streams() if config.event == StreamEvent.PWM)
    assert samples.decimation == 1
    return len(samples.channels)


def through_protocol(seconds: float, everything: bool) -> tuple[float, int]:
    """Times real time from the plant to the host's numpy columns, and with how many channels, edges beside them."""
    rig = Bench(VirtualLink.of(load_params()))
    client = rig.client
    client.sinks = []
    channels = run_against(rig, TORQUE, all_channels(rig) if everything else None)
    rig.drive.speed(OMEGA_M)
    client.run_for(1.0)
    before = client.losses(DRIVE)
    start = time.process_time()
    end = client.now() + seconds
    while client.now() < end:
        client.poll(POLL)
    took = time.process_time() - start
    losses = client.losses(DRIVE)
    assert losses.samples.lost_by_index == losses.edges.lost_by_index == 0
    assert losses.edges.samples - before.edges.samples > seconds * 250
    return (losses.samples.samples - before.samples.samples) / PWM_HZ / took, channels


def rows(short: bool) -> list[Row]:
    """The figures, as multiples of real time; the best of some runs: other load on the machine only slows them."""
    seconds, repeat = (0.5, 1) if short else (4.0, 8)
    out = []
    for call in CALLS:
        times = max(alone(seconds, call) for _ in range(repeat))
        what = f"simulation alone, average speed and vector tracking, calls of {1000 * call:g} ms"
        out.append(speed(what, times, "x real time"))
    everything_on = unkind(load_params())
    pairs = [(alone(seconds, 1.0), alone(seconds, 1.0, **everything_on)) for _ in range(repeat)]
    longer = max(kind for kind, _ in pairs) / max(real for _, real in pairs)
    what = "the same in calls of 1000 ms with every effect of a real bench, over none"
    out.append(Row(what, longer, "x", GOAL_UNKIND, at_most=True))
    for everything, observers in ((False, ""), (True, ", all observers")):
        times, channels = max(through_protocol(seconds, everything) for _ in range(repeat))
        what = f"through the protocol, {'all ' if everything else ''}{channels} channels{observers}, and edges"
        out.append(speed(what, times, "x real time"))
    return out
