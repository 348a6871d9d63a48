"""What recordings say of themselves: clock, pole pairs, the firmware's parameters, DC link, ranges of sensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from bench.files import leaves
from bench.record.reader import Run
from bench.twin.samples import Stretch
from bench.twin.values import Number
from sim.ports.direct import nominal

BEGUN_WITH = {
    "n_p": "motor.n_p", "i_max": "motor.i_max", "R_s_hat": "motor.R_s", "psi_f_hat": "motor.psi_f",
    "J_hat": "mechanics.J", "dead_time_hat": "inverter.dead_time", "i_range": "current_sensor.range",
    "encoder_lines": "encoder.pulses_per_rev",
}  # fmt: skip
"""By the drive's parameter the key of the plant that begins with its value."""
AS_TOLD = {
    "encoder_reverse": "faults.encoder.reversed", "hall_swap_hat": "wiring.hall_swap",
    "hall_invert_hat": "wiring.hall_invert",
}  # fmt: skip
WHOLE = ("motor.n_p", "encoder.pulses_per_rev")


def known(runs: Sequence[Run], pieces: Sequence[Stretch]) -> dict[str, Number]:
    """By dotted key; the parameters are those with which the first run began."""
    info = runs[0].info
    parameters = {name: float(str(np.float32(value))) for name, value in info.parameters.items()}
    values: dict[str, Number] = {"clock.pwm_hz": info.pwm_hz, "clock.tick_hz": info.tick_hz}
    values |= {key: parameters[name] for name, key in BEGUN_WITH.items() if parameters.get(name, 0.0) > 0.0}
    if parameters.get("L_s_hat", 0.0) > 0.0:
        values |= {"motor.L_d": parameters["L_s_hat"], "motor.L_q": parameters["L_s_hat"]}
    if volts := [p.u_dc[p.rest] if p.rest.any() else p.u_dc for p in pieces if p.u_dc is not None]:
        values["inverter.u_dc"] = float(np.median(np.concatenate(volts)))
    values |= _firmware(parameters)
    for name, key in AS_TOLD.items():  # what the firmware puts right is there to be put right
        if parameters.get(name):
            values[key] = int(parameters[name])
    if not any(p.theta is not None for p in pieces):
        values["encoder.present"] = 0
        values["firmware.observer"] = int(values.get("firmware.observer", 0)) or 1  # type: ignore[arg-type]
    return {key: int(value) if key in WHOLE else value for key, value in values.items()}  # type: ignore[arg-type]


def _firmware(parameters: Mapping[str, float]) -> dict[str, Number]:
    """The configuration's keys of the firmware's parameters."""
    found: dict[str, Number] = {}
    for key, value in leaves(nominal(None, {})["firmware"], "firmware."):
        name = key.rpartition(".")[2]
        if isinstance(value, (list, tuple)):
            parts = [parameters.get(f"{name}_{k}") for k in range(1, len(value) + 1)]
            if all(part is not None for part in parts):
                found[key] = [float(part) for part in parts if part is not None]
        elif name in parameters:
            found[key] = int(parameters[name]) if isinstance(value, int) else float(parameters[name])
    return found
