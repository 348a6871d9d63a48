"""Where the Hall edges lie, by the encoder: how far each is from its ideal place, turning forwards and backwards.

python docs/examples/hall_edges.py [OUT.png]
"""

import sys
from pathlib import Path

import numpy as np

import bench
from bench.report.style import SERIES, axis_labels, legend_above, new_figure
from bench.signal.waveforms import FORWARD, REVERSE, edge_offsets, hall_offset

out = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_suffix(".png")
angles, edges = [], []
with bench.connect("sim") as rig:
    rig.drive.start("encoder")
    for rpm in (200, -200):
        rig.drive.speed(rpm=rpm)
        rig.wait(1.0)
        run = rig.record(2.0)
        angles.append(run.theta_at_edges())
        edges.append(run.edges)
theta = np.concatenate(angles)
old, new = (np.concatenate([getattr(each, code) for each in edges]) for code in ("hall_old", "hall_new"))
ring = hall_offset(run.parameters)  # where the drive has the first edge, rad
found = edge_offsets(theta, old, new, ring)
late = -np.degrees(found.mean)  # measured less ideal, (6, 2)
print("late by", ", ".join(f"{degrees:.2f}" for degrees in late.mean(axis=1)), "el. deg")
print(f"hysteresis {np.mean(late[:, FORWARD] - late[:, REVERSE]):.2f} el. deg, {found.n.sum()} edges")

figure, (ax,) = new_figure(1, height=2.8)
for column, words, colour in ((FORWARD, "forwards", SERIES[0]), (REVERSE, "backwards", SERIES[1])):
    ax.bar(np.arange(6) + (column - 0.5) * 0.36, late[:, column], 0.34, color=colour, label=words)
ax.axhline(0, color="black", linewidth=0.8)
ax.set_xticks(range(6), [f"{np.degrees(ring) + 60 * k:.0f}°" for k in range(6)])
axis_labels(ax, "ideal place of the edge", "late by", "el. °", "el. °")
legend_above(ax)
figure.savefig(out, dpi=100)
