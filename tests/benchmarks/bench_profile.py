"""Where a period of the simulated drive goes: its parts timed alone, on what a run of it recorded.

The plant is fed with the recorded voltages, the front end and the observer with what they saw. The rest of the loop is
what is left: sensing, control, protection, record.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from protocol.signals import DRIVE_CHANNELS
from sim.control import modulation
from sim.native import Cells, Pointer, address, native
from sim.observers import sample
from sim.observers.entry import chosen
from sim.plant import integrator, inverter, mechanics
from tests.benchmarks.bench_sim import RPM, TORQUE
from tests.benchmarks.table import Quickest, Row, cost
from tests.sim.drive.rig import Rig, measured_of

PERIODS = 1200  # a call of the session in virtual time
USUAL = 26  # channels


@native
def plant(
    params: Pointer[integrator.Params],
    state: Pointer[integrator.State],
    load: Pointer[mechanics.Load],
    u_alpha: Pointer[float],
    u_beta: Pointer[float],
    h: float,
    n: int,
) -> None:
    """The plant over n periods with these voltages."""
    constants = params[0]
    now = state[0]
    brake = load[0]
    for k in range(n):
        d_a, d_b, d_c = modulation.duties(u_alpha[k], u_beta[k], constants.inverter.u_dc)
        applied = inverter.apply(constants.inverter, d_a, d_b, d_c)
        now, _ = integrator.step(constants, now, applied, brake, h)
    state[0] = now


def rows(short: bool) -> Iterator[Row]:
    """Nanoseconds a period, and a call's own microseconds."""
    repeat = 3 if short else 300
    bench = Rig()
    bench.start()
    bench.spin(RPM, 1.0, TORQUE)
    whole = _nanoseconds(lambda: bench.advance(PERIODS), repeat)
    recorded = bench.advance(PERIODS)
    params, state, load = Cells(integrator.Params), Cells(integrator.State), Cells(mechanics.Load)
    params.first, load.first = bench._constants.plant, bench._load
    u_alpha, u_beta = (np.ascontiguousarray(recorded[name]) for name in ("u_alpha", "u_beta"))

    def move() -> None:
        state.array[0] = bench._state.array["world"]["plant"][0]
        h = bench._constants.h
        plant(params.at, state.at, load.at, address(u_alpha), address(u_beta), h, PERIODS)

    front = sample.FrontEnd(sample.make_params(bench.params.clock.tick_hz, chosen(sample.Settings, bench.parameters)))
    measured, none = measured_of(bench, [recorded]), np.zeros(PERIODS, bool)
    seen = front.run(measured, recorded.captured, none)
    observer = next(iter(bench._observers.values()))
    channels = DRIVE_CHANNELS[:USUAL]
    plant_ns = _nanoseconds(move, repeat)
    front_ns = _nanoseconds(lambda: front.run(measured, recorded.captured[:0], none), repeat)
    observer_ns = _nanoseconds(lambda: observer.run(seen, none), repeat)
    yield cost("a period of the simulation, in calls of 75 ms", whole, "ns")
    yield cost("  of that, the plant", plant_ns, "ns")
    yield cost("  of that, the Hall front end", front_ns, "ns")
    yield cost("  of that, vector tracking", observer_ns, "ns")
    yield cost("  of that, sensing, control, protection and record", whole - plant_ns - front_ns - observer_ns, "ns")
    yield cost(f"raw samples of {USUAL} channels, made where they are streamed", _nanoseconds(
        lambda: recorded.raw(channels), repeat), "ns")  # fmt: skip
    yield cost("a call of one period", 1e-3 * _nanoseconds(lambda: bench.advance(1), 10 * repeat, 1), "us")


def _nanoseconds(action: Callable[[], object], repeat: int, periods: int = PERIODS) -> float:
    best = Quickest()
    for _ in range(repeat):
        with best.timed():
            action()
    return 1e9 * best[""] / periods
