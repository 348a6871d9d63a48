"""How fast other open simulators run a comparable drive: the paper's motor at 16 kHz under current control.

A script of its own, so that it can run under another interpreter than the benchmark: prints one JSON object
{name: {"version": …, "x_real_time": …, "note": …} or {"error": …}}. Packages: motulator, gym-electric-motor
(the extra `benchmark`).
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from importlib.metadata import version

T_S = 1 / 16000
R_S, L_S, PSI_F, N_P, J, U_DC, I_MAX = 0.158, 0.176e-3, 6.55e-3, 6, 2e-4, 24.0, 8.0
OMEGA_M = 500 * math.tau / 60


def motulator(seconds: float) -> dict[str, object]:
    """Current-vector control, speed loop, encoder; plant by solve_ivp, duty ratios held for a period."""
    from motulator.drive import model
    from motulator.drive.control import sm as control
    from motulator.drive.utils import SynchronousMachinePars

    par = SynchronousMachinePars(n_p=N_P, R_s=R_S, L_d=L_S, L_q=L_S, psi_f=PSI_F)
    mdl = model.Drive(
        model.VoltageSourceConverter(u_dc=U_DC), model.SynchronousMachine(par), model.StiffMechanicalSystem(J=J)
    )
    cfg = control.CurrentReferenceCfg(par, nom_w_m=N_P * 314.0, max_i_s=I_MAX)
    ctrl = control.CurrentVectorControl(par, cfg, T_s=T_S, J=J, alpha_c=math.tau * 800, sensorless=False)
    ctrl.ref.w_m = lambda t: N_P * OMEGA_M
    start = time.perf_counter()
    model.Simulation(mdl, ctrl).simulate(t_stop=seconds)
    took = time.perf_counter() - start
    return {
        "version": version("motulator"),
        "x_real_time": seconds / took,
        "note": "plant, current and speed loop, encoder; solve_ivp",
    }


def gym_electric_motor(seconds: float) -> dict[str, object]:
    """The dq plant at constant speed behind its step(), default solver, a fixed voltage: no controller."""
    import gym_electric_motor as gem
    import numpy as np
    from gym_electric_motor.core import ElectricMotorVisualization
    from gym_electric_motor.physical_systems import ConstantSpeedLoad
    from gym_electric_motor.reference_generators import ConstReferenceGenerator, MultipleReferenceGenerator

    limits = {"i": 20.0, "torque": 2.0, "omega": 400.0, "u": U_DC}
    env = gem.make(
        "Cont-CC-PMSM-v0",
        motor={
            "motor_parameter": {"r_s": R_S, "l_d": L_S, "l_q": L_S, "psi_p": PSI_F, "p": N_P, "j_rotor": J},
            "limit_values": limits,
            "nominal_values": limits,
        },
        supply={"u_nominal": U_DC},
        load=ConstantSpeedLoad(omega_fixed=OMEGA_M),
        reference_generator=MultipleReferenceGenerator(
            [ConstReferenceGenerator(reference_state=name, reference_value=0.1) for name in ("i_sd", "i_sq")]
        ),
        visualization=ElectricMotorVisualization(),
        tau=T_S,
        constraints=(),
    ).unwrapped
    env.reset()
    action = np.zeros(3)
    steps = int(seconds / T_S)
    start = time.perf_counter()
    for _ in range(steps):
        env.step(action)
    took = time.perf_counter() - start
    return {
        "version": version("gym-electric-motor"),
        "x_real_time": seconds / took,
        "note": "plant only at constant speed, dopri5, no controller",
    }


PEERS: dict[str, Callable[[float], dict[str, object]]] = {
    "motulator": motulator,
    "gym-electric-motor": gym_electric_motor,
}


def main() -> None:
    """Measure every peer that is installed."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 0.5
    results: dict[str, dict[str, object]] = {}
    for name, measure in PEERS.items():
        try:
            results[name] = measure(seconds)
        except ImportError as error:
            results[name] = {"error": f"not installed ({error})"}
    print(json.dumps(results))


if __name__ == "__main__":
    main()
