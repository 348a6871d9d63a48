"""The paper's gains against the best that `bench tune` finds on unkind drives, by speed, beside and in control."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bench.rig.screen import Screen
from bench.study.tune import TuneOptions, tune
from bench.study.tuned import as_json

RANGES = {
    "100 r/min": ("100", 1.2, 0.5), "500 r/min": ("500", 1.2, 0.5), "2000 r/min": ("2000", 1.2, 0.5),
    "steps 500, 1000, 500 r/min": ("[500, 1000, 500]", 0.4, 0.05),
    "100, 500 and 2000 r/min": ("[100, 500, 2000]", 0.7, 0.35),
}  # fmt: skip
"""Speeds, how long each (s), and how much of that is not measured."""
CONTROLS = {"beside": "encoder", "in control": "vector_tracking"}
TOML = """
drive = "bench24v"
samples = 32
[vary]
"motor.R_s" = {{ normal = [1.0, 0.08], relative = true, within = [0.5, 1.5] }}
"motor.L_d" = {{ normal = [1.0, 0.08], relative = true, within = [0.5, 1.5] }}
"motor.L_q" = {{ normal = [1.0, 0.08], relative = true, within = [0.5, 1.5] }}
"motor.psi_f" = {{ normal = [1.0, 0.03], relative = true, within = [0.8, 1.2] }}
"hall.delta_deg" = {{ normal = [0.0, 3.0], within = [-9, 9] }}
"mechanics.J" = {{ triangular = [0.7, 1.0, 1.5], relative = true }}
"inverter.dead_time" = {{ normal = [1.0, 0.1], relative = true, within = [0.5, 1.5] }}
[experiments.turn]
speed = {speed}
load = 0.12
seconds = {seconds}
settle = {settle}
control = "{control}"
observers = ["vector_tracking"]
[tune]
trials = {trials}
check = {check}
[tune.parameters]
"firmware.vector_tracking.k_p_vt" = {{ log = [60, 20000] }}
"firmware.vector_tracking.k_i_vt" = {{ log = [500, 5000000] }}
"firmware.vector_tracking.tau_max" = {{ log = [1e-4, 1e-2] }}
"firmware.vector_tracking.omega_on" = {{ log = [12, 300] }}
"firmware.vector_tracking.omega_off" = {{ log = [1, 12] }}
"firmware.vector_tracking.bw_omega_lpf" = {{ log = [4, 300] }}
"firmware.vector_tracking.load_angle_comp" = {{ choice = [0, 1] }}
"firmware.vector_tracking.k_ic" = {{ log = [0.3, 100] }}
[tune.objectives]
error = {{ of = "turn.vector_tracking.rms", over = "rms" }}
"""


def toml(name: str, control: str, trials: int, check: int) -> str:
    """A tune of one range."""
    speed, seconds, settle = RANGES[name]
    return TOML.format(
        speed=speed, control=CONTROLS[control], trials=trials, check=check, seconds=seconds, settle=settle
    )


def rows(folder: Path, screen: Screen, clock: Any, trials: int = 150, check: int = 100) -> Iterator[dict[str, Any]]:
    """A row for each range and way of use, what `tune.json` says of it; computed where it is not there."""
    for control in CONTROLS:
        for name in RANGES:
            file = folder / f"{control}-{name.split(',')[0]}.toml".replace(" ", "-").replace("/", "-")
            file.write_text(toml(name, control, trials, check))
            tuned = tune(TuneOptions(file, workers=1), screen, clock)
            yield {"range": name, "use": control, **as_json(tuned)}
