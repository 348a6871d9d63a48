"""A load step of 0.15 N·m at 500 r/min: how far the speed dips, and the current that the load takes.

python docs/examples/load_step.py [OUT.png]
"""

import sys
from pathlib import Path

import numpy as np

import bench
from bench.report.style import axis_labels, colour, legend_above, new_figure, time_axes
from bench.signal.units import RPM

RPM_SET, TORQUE = 500, 0.15  # r/min, N·m

out = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_suffix(".png")
with bench.connect("sim") as rig:
    rig.drive.speed(rpm=RPM_SET)
    rig.load.torque(0.0)  # it is armed and started here, so that the step itself is one
    rig.wait(1.5)
    with rig.recording() as stretch:
        rig.wait(0.3)
        on = rig.tick()
        rig.load.torque(TORQUE)
        rig.wait(0.6)
    run, torque_constant = stretch.capture, rig.drive.torque_constant

t = run.t - on / run.tick_hz
rpm = run["omega_enc"] / RPM / run.parameters["n_p"]
before, after = run["i_q"][t < 0].mean(), run["i_q"][t > 0.4].mean()
dip = RPM_SET - rpm.min()
print(f"dip: {dip:.0f} r/min; i_q rises by {after - before:.3f} A for {TORQUE} N·m, {torque_constant:.4f} N·m/A")

figure, (speed, current) = new_figure(2, height=4.2)
speed.plot(t[::16], rpm[::16], linewidth=1, color=colour("omega_enc"), label="speed by the encoder")
speed.axhline(RPM_SET - dip, color="gray", linestyle="--", linewidth=0.8, label=f"dips by {dip:.0f} r/min")
smooth = np.convolve(run["i_q"], np.ones(32) / 32, "same")  # over 2 ms
current.plot(t[32:-32:16], smooth[32:-32:16], linewidth=0.8, color=colour("i_q"), label="i_q, mean of 2 ms")
current.axhline(
    before + TORQUE / torque_constant, color="gray", linestyle="--", linewidth=0.8, label="what the torque takes"
)
axis_labels(speed, "", "speed", "", "r/min")
axis_labels(current, "", "i_q", "", "A")
time_axes([speed, current], -0.1, 0.4)
for ax in (speed, current):
    legend_above(ax)
figure.savefig(out, dpi=100)
