"""A speed step from 300 to 800 r/min, with the motor controlled by one angle after the other.

python docs/examples/step_response.py [OUT.png]
"""

import sys
from pathlib import Path

import numpy as np

import bench
from bench.report.style import axis_labels, colour, legend_above, new_figure, time_axes
from bench.signal.units import RPM
from bench.signal.waveforms import step_response

FROM, TO = 300, 800  # r/min
SOURCES = {"average-speed": "theta_avg", "vector-tracking": "theta_vt", "encoder": "theta_enc"}

out = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_suffix(".png")
runs = {}
for source in SOURCES:
    with bench.connect("sim") as rig:
        rig.drive.start(source)
        rig.drive.speed(rpm=FROM)
        rig.wait(1.5)
        with rig.recording() as stretch:
            rig.wait(0.1)
            rig.drive.speed(rpm=TO)
            rig.wait(0.7)
        runs[source] = stretch.capture

figure, (speed, current) = new_figure(2, height=3.6)
for source, run in runs.items():
    stepped = int((run["omega_ref"] > run["omega_ref"][0] + 1.0).argmax())  # the reference begins to move
    t = run.t - run.t[stepped]
    rpm = run["omega_enc"] / RPM / run.parameters["n_p"]
    speed.plot(t[::16], rpm[::16], color=colour(SOURCES[source]), label=source, linewidth=1)
    smooth = np.convolve(run["i_q"], np.ones(64) / 64, "same")  # over 4 ms
    current.plot(t[64:-64:16], smooth[64:-64:16], color=colour(SOURCES[source]), linewidth=0.8)
    step = step_response(t, rpm, 0.0, FROM, TO, smooth=0.005)
    last = rpm[-1600:].mean()
    print(f"{source}: {last:.1f} r/min in the end, rise {1e3 * step.rise:.0f} ms, {100 * step.overshoot:.1f} % over")
axis_labels(speed, "", "speed", "", "r/min")
axis_labels(current, "", "i_q, mean of 4 ms", "", "A")
time_axes([speed, current], -0.05, 0.15)
legend_above(speed)
figure.savefig(out, dpi=100)
