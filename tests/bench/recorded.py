"""Recordings for the tests of replay and score: of the simulated drive in virtual time, and made up from formulas."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from collect import Bench
from made_runs import N_P, PWM_HZ, RPM, make
from virtual_run import WatchedLink, simulated

from bench.record.info import Mark, SummaryText
from bench.record.sink import RunSink
from bench.signal.verdict import Verdict
from protocol.descriptor import Channel
from protocol.signals import Flag, RawType, Unit

__all__ = ["N_P", "PWM_HZ", "record_drive", "record_made_up"]


def record_drive(path: Path) -> None:
    """Start-up, a speed step, a load step and a reversal, with a note, a mark and a summary: 2.2 s."""
    bench = Bench(WatchedLink(simulated(seed=5)))
    drive, load, client = bench.drive, bench.load, bench.client
    sink = RunSink(path, bench.info(), wait=True)
    client.sinks = [sink]
    bench.stream()
    client.run_for(0.2)
    load.arm()
    load.start()
    bench.turn(500 * RPM)
    client.run_for(0.5)
    client.note("now faster", "WARN")
    drive.speed(1000 * RPM)
    client.run_for(0.5)
    load.torque(0.2)
    client.run_for(0.4)
    load.torque(0.0)
    drive.speed(-300 * RPM)
    client.run_for(0.6)
    drive.stop()
    load.stop()
    client.run_for(0.05)
    second = bench.hello.tick_hz
    sink.take(Mark("steady", second // 2, second, Verdict.PASS))
    sink.take(SummaryText("# The run"))
    sink.close()


def record_made_up(
    path: Path,
    theta: np.ndarray,
    estimates: Mapping[str, tuple[np.ndarray, np.ndarray]],
    reference: bool = True,
    decimation: int = 1,
    omega_told: bool = True,
    **parameters: float,
) -> None:
    """A recording with an encoder at `theta` (n,) rad, unwrapped, and estimates (angle, speed) by short name, no more.

    Of the speeds only the largest that the drive permits is there without `omega_told`: that of the first estimate.
    Angles are telemetered as float32, so that formulas hold to 1e-6 rad.
    """
    angle, speed = Flag.CHANNEL | Flag.WRAPS, Flag.CHANNEL | Flag.ESTIMATE
    columns, parameters = {"theta_enc": theta}, {"n_p": N_P, **parameters}
    channels = [Channel(1, "theta_enc", Unit.RAD, RawType.F32, 1.0, angle | (Flag.REFERENCE if reference else Flag(0)))]
    for k, (short, (its_angle, its_speed)) in enumerate(estimates.items()):
        channels.append(Channel(10 + 2 * k, f"theta_{short}", Unit.RAD, RawType.F32, 1.0, angle | Flag.ESTIMATE))
        columns[f"theta_{short}"] = its_angle
        if omega_told:
            channels.append(Channel(11 + 2 * k, f"omega_{short}", Unit.RAD_PER_S, RawType.F32, 1.0, speed))
            columns[f"omega_{short}"] = its_speed
        else:
            parameters.setdefault("omega_m_max", float(np.abs(its_speed).max()) / N_P)
    make(path, columns, channels=channels, parameters=parameters, decimation=decimation)
