"""The simulated drive in virtual time, alone and through the protocol: ms of CPU time a simulated second."""

from __future__ import annotations

import math
from typing import Any

import probe
import rig

from protocol.messages import DriveState, SetpointMode

SECONDS, REPEAT = (4.0, 4) if probe.SHORT else (8.0, 5)
ALONE = 4 * SECONDS
PWM_HZ = 16_000


def alone(call: float) -> float:
    """ms a simulated second, in calls of so many seconds."""
    bench = probe.newest("sim.drive.machine").SimulatedBench(rig.load_params())
    for state in (DriveState.ARMED, DriveState.RUNNING):
        bench.enter_state(state)
        bench.load_enter_state(state)
        bench.advance(1)
    bench.load_setpoint(SetpointMode.TORQUE, rig.TORQUE)
    bench.setpoint(SetpointMode.SPEED, rig.OMEGA_M)
    bench.advance(PWM_HZ)
    calls, portion = math.ceil(ALONE / call), round(call * PWM_HZ)

    def run() -> None:
        for _ in range(calls):
            bench.advance(portion)

    took = probe.best(REPEAT, run)
    if abs(bench.truth.omega_m - rig.OMEGA_M) > 5.0:
        raise SystemExit(f"the motor turns at {bench.truth.omega_m} rad/s")
    return 1e3 * took / (calls * call)


def through_protocol(everything: bool) -> tuple[float, int]:
    """ms a simulated second until there are columns, and of how many channels."""
    sink = rig.Count()
    made = rig.connected(sink)
    channels = rig.stream(made, everything)
    rig.turn(made)
    client: Any = made.client
    client.run_for(1.0)
    before = sink.samples_seen, sink.edges_seen

    def run() -> None:
        end = client.now() + SECONDS
        while client.now() < end:
            client.poll(rig.POLL)

    took = probe.best(REPEAT, run)
    losses = client.losses(rig.node.DRIVE)
    seconds = (sink.samples_seen - before[0]) / PWM_HZ / REPEAT
    if losses.samples.lost_by_index or losses.edges.lost_by_index or abs(seconds - SECONDS) > 2 * rig.POLL:
        raise SystemExit(f"{seconds} of {SECONDS} s arrived: {losses}")
    return 1e3 * took / seconds, channels


if __name__ == "__main__":
    costs = {
        "simulation alone, calls of 1 s, a simulated second, ms": alone(1.0),
        "simulation alone, calls of 5 ms, a simulated second, ms": alone(0.005),
    }
    usual, channels = through_protocol(False)
    costs[f"through the protocol, {channels} channels and edges, a simulated second, ms"] = usual
    if not probe.SHORT:
        every, more = through_protocol(True)
        if more > channels:
            costs["through the protocol, all channels, observers and edges, a simulated second, ms"] = every
    probe.tell(costs)
