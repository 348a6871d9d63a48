"""The plot of a measured loop: gain and phase of open and closed loop, margins, coherence. Nothing here measures."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from bench.report.style import GREY, SERIES, axis_labels, legend_above, new_figure
from bench.response.experiment import Measured
from bench.signal.waveforms.frequency_response import Complexes
from bench.signal.waveforms.samples import Floats


def draw(measured: Measured) -> Figure:
    """Gain in dB, phase in degrees and coherence over the frequency."""
    found, margins = measured.response, measured.margins
    figure, (gain, phase, coherence) = new_figure(3, height=5.6)
    for hue, name, values in zip(SERIES, ("closed loop", "open loop"), (found.closed, found.open), strict=False):
        gain.semilogx(found.f, 20.0 * np.log10(np.abs(values)), ".-", color=hue, label=name)
        phase.semilogx(found.f, _degrees(values), ".-", color=hue)
    gain.axhline(0.0, color=GREY, linewidth=0.9)
    phase.axhline(-180.0, color=GREY, linewidth=0.9)
    if margins.crossover.value is not None and margins.phase_margin.value is not None:
        for ax in (gain, phase, coherence):
            ax.axvline(margins.crossover.value, color=GREY, linewidth=0.9, linestyle=":")
        phase.annotate(
            f"phase margin {margins.phase_margin.value:.1f}°",
            (margins.crossover.value, margins.phase_margin.value - 180.0), xytext=(-6, -14), textcoords="offset points",
            ha="right", fontsize=8,
        )  # fmt: skip
    coherence.semilogx(found.f, found.coherence, ".-", color=SERIES[0])
    coherence.set_ylim(0.0, 1.05)
    axis_labels(gain, "", "gain", unit_y="dB")
    axis_labels(phase, "", "phase", unit_y="°")
    axis_labels(coherence, "frequency", "coherence", "Hz")
    legend_above(gain)
    figure.align_ylabels([gain, phase, coherence])
    return figure


def _degrees(values: Complexes) -> Floats:
    phase = np.degrees(np.unwrap(np.angle(values)))
    return np.asarray(phase - 360.0 * np.round((phase[0] + 45.0) / 360.0))
