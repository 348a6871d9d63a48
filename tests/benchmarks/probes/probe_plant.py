"""The plant alone, a period: ns of CPU time; and over the classic Runge-Kutta method in C, see rk4.c."""

from __future__ import annotations

import ctypes
import math
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import probe

PERIODS = 100_000
OMEGA_M = 500 * math.tau / 60  # rad/s
TORQUE = 0.236  # N m: 4 A
REPEAT = 10 if probe.SHORT else 60

integrator: Any = probe.newest("sim.plant.integrator")
inverter: Any = probe.newest("sim.plant.inverter")
mechanics: Any = probe.newest("sim.plant.mechanics")
machine: Any = probe.newest("sim.drive.machine")
NATIVE: Any = probe.newest("sim.native") if probe.there("sim.native") else None
Pointer: Any = NATIVE and NATIVE.Pointer
load_params: Any = probe.newest("sim.config.params", "sim.params").load_params
"""The plant and its constants."""


def constants() -> tuple[Any, Any, float, int]:
    """The plant's constants, its state at speed, the integration step in s, and how many there are in a period."""
    bench = machine.SimulatedBench(load_params())
    made = bench._constants.plant if hasattr(bench, "_constants") else bench._params.plant
    state = integrator.State(made.motor.psi_f, 4.0 / made.motor.g_mean, OMEGA_M, 0.0, 1.0, 0.0)
    clock = bench.params.clock
    return made, state, 1.0 / clock.pwm_hz / clock.substeps, clock.substeps


def voltage(made: Any) -> tuple[float, float]:
    """u_d, u_q (V) that keep the speed about where it is, at 4 A."""
    omega_e = OMEGA_M * made.motor.n_p
    return -omega_e * 4.0 / made.motor.g_mean, made.motor.R_s * 4.0 + omega_e * made.motor.psi_f + 0.5


def _whole(params: Any, state: Any, load: Any, e: float, u_d: float, u_q: float, h: float, steps: int, n: int) -> Any:
    for _ in range(n):
        u_alpha = u_d * state.cos - u_q * state.sin
        u_beta = u_d * state.sin + u_q * state.cos
        applied = inverter.Applied(True, u_alpha, u_beta, e, e, e)
        for _ in range(steps):
            state, _ = integrator.step(params, state, applied, load, h)
    return state


def _over(
    params: Pointer[integrator.Params],
    cell: Pointer[integrator.State],
    load: Pointer[mechanics.Load],
    e: float,
    u_d: float,
    u_q: float,
    h: float,
    steps: int,
    n: int,
) -> None:
    constants, state, brake = params[0], cell[0], load[0]
    for _ in range(n):
        u_alpha = u_d * state.cos - u_q * state.sin
        u_beta = u_d * state.sin + u_q * state.cos
        applied = inverter.Applied(True, u_alpha, u_beta, e, e, e)
        for _ in range(steps):
            state, _ = integrator.step(constants, state, applied, brake, h)
    cell[0] = state


def compiled(params: Any, state: Any, h: float, steps: int) -> Callable[[int], Any]:
    """The plant over n periods."""
    e = params.inverter.e_dead + params.inverter.e_device
    load = mechanics.Load(mechanics.TORQUE, TORQUE, 0.0)
    given = e, *voltage(params), h, steps
    if NATIVE is None:
        import numba

        loop = numba.njit(error_model="numpy")(_whole)
        return lambda n: loop(params, state, load, *given, n)
    cells = [NATIVE.Cells(of) for of in (integrator.Params, integrator.State, mechanics.Load)]
    cells[0].first, cells[2].first = params, load
    run = NATIVE.native(_over)

    def over(n: int) -> Any:
        cells[1].first = state
        run(*(cell.at for cell in cells), *given, n)
        return cells[1].first

    return over


def floor(params: Any, state: Any, T: float) -> Callable[[int], Any] | None:
    """The same by rk4.c; None without gcc."""
    if shutil.which("gcc") is None:
        return None
    library = probe.FOLDER / "rk4.so"
    source = Path(__file__).with_name("rk4.c")
    subprocess.run(["gcc", "-O2", "-shared", "-fPIC", "-o", str(library), str(source), "-lm"], check=True)
    run = ctypes.CDLL(str(library)).run
    run.restype = None
    run.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_double, ctypes.c_long]
    motor, shaft = params.motor, params.shaft
    given = np.array(
        [
            *(motor.R_s, motor.g_mean, motor.psi_f, motor.n_p, motor.k_tau),
            *(params.inverter.e_dead + params.inverter.e_device, params.inverter.g_smooth),
            *(1.0 / shaft.J, shaft.b, shaft.tau_coulomb + TORQUE, *voltage(params)),
        ]
    )

    def over(n: int) -> Any:
        x = np.array([state.psi_alpha, state.psi_beta, state.omega_m, state.cos, state.sin])
        run(given.ctypes.data, x.ctypes.data, T, n)
        return x

    return over


if __name__ == "__main__":
    params, state, h, steps = constants()
    plant, c = compiled(params, state, h, steps), floor(params, state, steps * h)
    plant(1)
    took = took_c = math.inf
    for _ in range(REPEAT):
        took = min(took, probe.best(1, lambda: plant(PERIODS)))
        took_c = took_c if c is None else min(took_c, probe.best(1, lambda: c(PERIODS)))
    costs = {"plant alone, a period, ns": 1e9 * took / PERIODS}
    if c is not None:
        a, b = plant(1000), c(1000)
        off = math.hypot(a.psi_alpha - b[0], a.psi_beta - b[1]) * params.motor.g_mean
        if not off < 1e-3:
            raise SystemExit(f"plant and rk4.c differ by {off:.3g} A: they are not the same plant")
        costs["plant alone, over a bare RK4 loop in C, within a run"] = took / took_c
    probe.tell(costs)
