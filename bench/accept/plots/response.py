"""The observer's frequency response, computed and measured: Fig. 6. Nothing here measures or fits.

Source: (11) and Fig. 6 of Kim et al. 2011, DOI 10.1109/TIE.2010.2098367.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bench.report.style import GREY, SERIES, axis_labels, legend_above, new_figure
from bench.signal.capture import F64

Complex = NDArray[np.complex128]


def draw_bode(f: F64, measured: Mapping[str, Complex], computed: Mapping[str, Callable[[F64], Complex]]) -> Figure:
    """Magnitude and phase over the frequency, by name: `measured` (n,) at `f` (n,) Hz as dots, `computed` as lines."""
    figure, (magnitude, phase) = new_figure(2, height=4.4)
    dense = np.geomspace(f.min() / 1.6, f.max() * 1.6, 400)
    for hue, (name, law) in zip(SERIES, computed.items(), strict=False):
        exact, near, dots = law(dense), law(f), measured[name]
        magnitude.semilogx(dense, _decibels(exact), color=hue, label=f"{name} by (11)")
        magnitude.semilogx(f, _decibels(dots), "o", color=hue, markersize=4)
        phase.semilogx(dense, np.degrees(np.angle(exact)), color=hue)
        phase.semilogx(f, np.degrees(np.angle(near) + np.angle(dots / near)), "o", color=hue, markersize=4)
    magnitude.plot([], [], "o", color=GREY, markersize=4, label="measured")
    axis_labels(magnitude, "", "magnitude", unit_y="dB")
    axis_labels(phase, "frequency", "phase", "Hz", "°")
    phase.set_xlim(dense[0], dense[-1])
    phase.set_yticks(np.arange(-90, 181, 45))
    legend_above(magnitude)
    figure.align_ylabels([magnitude, phase])
    return figure


def _decibels(gain: Complex) -> NDArray[np.float64]:
    return 20.0 * np.log10(np.abs(gain))
