"""Total harmonic distortion of a phase current over load and speed: Fig. 13. Nothing here measures.

Source: (20) and Fig. 13 of Kim et al. 2011, DOI 10.1109/TIE.2010.2098367.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

from bench.analysis.capture import F64
from bench.analysis.colours import SPARES
from bench.reports.style import FONT_SIZE, LINE_WIDTH, axis_labels, new_figure


def draw_thd_map(loads: Sequence[float], speeds: Sequence[float], approaches: Mapping[str, F64]) -> Figure:
    """One curve a load, the approaches side by side with the same axes; distortions by their logarithm.

    `loads` (m,) in A; `speeds` (n,) in r/min; `approaches`: distortions in %, (m, n), by name.
    """
    figure, axes = new_figure(1, len(approaches), height=3.2)
    for ax, (name, thd) in zip(axes, approaches.items(), strict=True):
        for look, amps, y in zip(SPARES, loads, thd, strict=False):
            ax.plot(speeds, y, marker=look.mark, color=look.paper, lw=LINE_WIDTH, markersize=4, label=f"{amps:g} A")
        axis_labels(ax, f"{name}: mechanical speed", "THD", "r/min", "%")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False, fontsize=FONT_SIZE)
    values = np.concatenate([thd.ravel() for thd in approaches.values()])
    values = values[np.isfinite(values) & (values > 0.0)]
    for ax in axes:
        ax.set(xlim=(0, 1.04 * max(speeds)), yscale="log")
        ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.yaxis.set_major_formatter(FormatStrFormatter("%g"))
        ax.yaxis.set_minor_formatter(NullFormatter())
        if len(values):
            ax.set_ylim(0.8 * values.min(), 1.25 * values.max())
    return figure
