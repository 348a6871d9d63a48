"""Writes the tables and the picture of docs/twin.md: a twin of the simulated drive on the unkind bench.

python docs/make_twin.py
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from markdown_tables import filled, table

import bench
from bench.record.recording import run_of
from bench.report.style import save
from bench.twin.check import HEADERS, Checked, cells, check
from bench.twin.draw import draw
from bench.twin.fit import Twin, fit

DOCS = Path(__file__).parent
PAGE, PICTURE = DOCS / "twin.md", DOCS / "twin" / "check.png"
SHOWN = (
    "motor.R_s", "motor.L_d", "motor.L_q", "motor.psi_f", "inverter.dead_time", "mechanics.J", "mechanics.b",
    "mechanics.tau_coulomb", "current_sensor.delay", "encoder.offset_deg", "hall.delta_deg[1]", "hall.hysteresis_deg",
    "hall.latency",
)  # fmt: skip
COMPARED = (
    "i_a, rms", "i_d, rms", "i_q, rms", "u_alpha, rms", "theta_avg error, rms", "theta_vt error, mean",
    "theta_vt error, rms",
)  # fmt: skip


def recordings(folder: Path) -> tuple[Path, Path]:
    """Steps, which are fitted, and another manoeuvre."""
    with bench.connect("sim", config="bench24v", seed=1, save=folder / "steps.run") as rig:
        rig.wait(0.3)
        rig.drive.start("average-speed")
        for rpm in (300, 800, 1500, 500, 1200, -700, -1500, -500, 900):
            rig.drive.speed(rpm=rpm)
            rig.wait(0.5)
        rig.drive.stop()
        rig.wait(0.4)
    with bench.connect("sim", config="bench24v", seed=2, save=folder / "reversal.run") as rig:
        rig.wait(0.1)
        rig.drive.start("encoder")
        for rpm in (600, 1300, -900):
            rig.drive.speed(rpm=rpm)
            rig.wait(0.6)
        rig.drive.observe("vector-tracking")
        rig.wait(0.3)
        rig.drive.speed(rpm=-1200)
        rig.wait(0.5)
    return folder / "steps.run", folder / "reversal.run"


def tables(twin: Twin, found: Checked) -> dict[str, str]:
    """By the name of its place."""
    told = {one.name: one for one in twin.quantities}
    rows = [
        [f"`{name}`", f"{told[name].value:.4g} {told[name].unit}", f"± {told[name].half_width:.2g}",
         f"± {told[name].absolute_half_width():.2g}", told[name].dominated_by]
        for name in SHOWN if name in told
    ]  # fmt: skip
    left = [[name, f"{value:.3g} {unit}"] for name, (value, unit) in twin.residuals.items()]
    return {
        "fit": table(["quantity", "value", "95 %, drive's units", "absolute", "mostly"], rows),
        "left": table(["left unexplained, rms", ""], left),
        "check": table([head or "verdict" for head in HEADERS], [cells(found[name]) for name in COMPARED]),
    }


def main() -> None:
    """Make all of it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        steps, reversal = recordings(folder)
        twin = fit([run_of(steps)])
        (folder / "twin.toml").write_text(twin.toml())
        found = check(run_of(reversal), folder / "twin.toml")
    PAGE.write_text(filled(PAGE.read_text(), tables(twin, found)))
    PICTURE.parent.mkdir(exist_ok=True)
    save(draw(found), PICTURE)


if __name__ == "__main__":
    main()
