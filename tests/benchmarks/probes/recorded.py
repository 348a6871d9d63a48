"""Recordings of the simulated drive in virtual time, made once for a tree."""

from __future__ import annotations

from pathlib import Path

import probe
import rig

SPEEDS = (10.0, 50.0, 100.0, 200.0, 300.0, -100.0)  # mechanical rad/s, in turn


def run(name: str, seconds: float, everything: bool) -> Path:
    """The recording of this name, of the default channels or all."""
    path = probe.FOLDER / name
    if path.exists():
        return path
    info = probe.newest("bench.record.info", "bench.recording.info").RunInfo
    sink = probe.newest("bench.record.sink", "bench.recording.sink").RunSink
    made = rig.connected(rig.Count())
    channels = made.drive.channels(tuple(c.name for c in made.drive.descriptor.channels) if everything else None)
    hello = made.hello
    file = sink(path, info(hello.tick_hz, hello.pwm_hz, channels, made.drive.parameters(), node=hello.node), wait=True)
    made.client.sinks = [file]
    rig.stream(made, everything)
    rig.turn(made, 0.1)
    for omega_m in SPEEDS:
        made.drive.speed(omega_m)
        made.client.run_for(seconds / len(SPEEDS))
    made.drive.stop()
    made.drive.stop_streams()
    file.close()
    return path
