"""Spectrum and distortion of a phase current, with the motor controlled by two different angles.

python docs/examples/spectrum.py [OUT.png]
"""

import sys
from pathlib import Path

import numpy as np

import bench
from bench.report.style import axis_labels, colour, legend_above, new_figure
from bench.signal.waveforms import spectrum, thd

SOURCES = {"average-speed": "theta_avg", "vector-tracking": "theta_vt"}

out = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_suffix(".png")
figure, (waves, lines) = new_figure(2, height=4.8, share_x=False)
for source, theta in SOURCES.items():
    with bench.connect("sim") as rig:
        rig.drive.start(source)
        rig.drive.speed(rpm=600)
        rig.load.torque(0.2)
        rig.wait(1.5)
        run = rig.record(1.0)
    i_a = run["i_a"]
    distortion = thd(run.t, i_a)
    print(
        f"{source}: {distortion.f:.2f} Hz, {distortion.amplitudes[0]:.3f} A, THD {100 * distortion.value:.2f} %, "
        f"rms {i_a.std():.4f} A"
    )
    first = int((np.diff(run["theta_enc"]) < -3).argmax())  # an electrical turn begins
    shown = slice(first, first + round(2.5 * run.rate / distortion.f))
    waves.plot(1e3 * (run.t[shown] - run.t[first]), i_a[shown], color=colour(theta), linewidth=1, label=source)
    f, amplitude = spectrum(run.t, i_a)
    low = (f > 5) & (f < 1300)
    lines.semilogy(
        f[low], amplitude[low], color=colour(theta), linewidth=0.7, label=f"THD {100 * distortion.value:.1f} %"
    )
lines.set_ylim(5e-3, 10)
axis_labels(waves, "t", "i_a", "ms", "A")
axis_labels(lines, "f", "amplitude of i_a", "Hz", "A")
for ax in (waves, lines):
    legend_above(ax)
figure.savefig(out, dpi=100)
