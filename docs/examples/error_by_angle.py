"""Position error of four observers over the electrical angle, all run on the same second of data.

python docs/examples/error_by_angle.py [OUT.png]
"""

import sys
from pathlib import Path

import numpy as np

import bench
from bench.report.style import axis_labels, colour, legend_above, new_figure
from bench.signal.error_bins import ANGLES, ErrorByAngle, angle_bins

OBSERVERS = {
    "sector_centre": "theta_sc",
    "average_speed": "theta_avg",
    "vector_tracking": "theta_vt",
    "edge_kalman": "theta_ek",
}  # by name: the channel of its angle

out = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_suffix(".png")
with bench.connect("sim") as rig:
    rig.drive.speed(rpm=300)
    rig.load.torque(0.1)
    rig.wait(0.5)
    run = rig.record(3.0)  # the first two seconds are for the observers to settle, and to learn

figure, (ax,) = new_figure(1, height=3.2)
for name, theta in OBSERVERS.items():
    late = bench.estimate(run, name).between(run.t[-1] - 1.0, run.t[-1])
    error = np.degrees(late.position_error(f"{theta}_host"))
    sums = ErrorByAngle()
    sums.add(angle_bins(late.theta), error, np.zeros(len(late), bool))
    mean, _ = sums.both()
    ax.plot(ANGLES, mean, color=colour(theta), linewidth=1.2, label=f"{name}, std {error.std():.2f}°")
    print(f"{name}: mean {error.mean():.3f}, std {error.std():.3f} el. deg")
ax.set_xlim(0, 360)
ax.set_xticks(range(0, 361, 60))
axis_labels(ax, "electrical angle", "actual − estimated", "el. °", "el. °")
legend_above(ax)
figure.savefig(out, dpi=100)
