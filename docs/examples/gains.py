"""The gain k_p of vector tracking, swept on one recorded run: error at a steady speed and after a load step.

python docs/examples/gains.py [OUT.png]
"""

import sys
from pathlib import Path

import numpy as np

import bench
from bench.report.style import SERIES, axis_labels, legend_above, new_figure

out = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_suffix(".png")
with bench.connect("sim") as rig:
    rig.drive.start("encoder")  # the control does not depend on what is compared
    rig.drive.speed(rpm=200)
    rig.load.torque(0.0)  # armed and started here, so that the step itself is one
    rig.wait(0.5)
    with rig.recording() as stretch:
        rig.wait(1.5)
        step = rig.tick()
        rig.load.torque(0.15)
        rig.wait(0.5)
run = stretch.capture
steady = (run.t > run.t[0] + 0.8) & (run.samples.tick < step)
moving = run.samples.tick >= step


def errors(theta: str, capture: bench.Capture) -> tuple[float, float]:
    """At the steady speed its std, after the load step the largest, el. deg."""
    error = np.degrees(capture.position_error(theta))
    return float(error[steady].std()), float(np.abs(error[moving]).max())


gains = np.geomspace(150, 6000, 14)
swept = np.array([errors("theta_vt_host", bench.estimate(run, "vt", k_p=k_p)) for k_p in gains])
own, own_k_p = errors("theta_vt", run), run.parameters["k_p_vt"]
again = errors("theta_vt_host", bench.estimate(run, "vt"))
print(f"drive's k_p {own_k_p:g}: {own[0]:.3f} by the drive, {again[0]:.3f} by the host; best {swept[:, 0].min():.3f}")

figure, (ax,) = new_figure(1, height=3.0)
ax.loglog(gains, swept[:, 0], "o-", markersize=3, color=SERIES[0], label="std at 200 r/min")
ax.loglog(gains, swept[:, 1], "s-", markersize=3, color=SERIES[1], label="largest after the load step")
ax.loglog([own_k_p] * 2, own, "k*", markersize=9, label="the drive itself")
axis_labels(ax, "k_p", "position error", "1/s", "el. °")
ax.set_xticks(ticks := [200, 500, 1000, 2000, 5000], ticks)
ax.set_yticks(ticks := [1, 2, 5, 10], ticks)
ax.minorticks_off()
legend_above(ax)
figure.savefig(out, dpi=100)
