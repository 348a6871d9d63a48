"""Currents over frequency, with harmonics and distortion, over the longest stretch in which the speed stands still."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bench.plot.motion import Piece
from bench.report.style import FONT_SIZE, GREY, axis_labels, colour, legend_above, new_figure
from bench.signal.channels import reference_angle
from bench.signal.units import RPM
from bench.signal.waveforms import Spectrum, Thd, fundamental, spectrum, thd, thd_by_angle
from bench.signal.waveforms.harmonics import ORDER, PERIODS
from protocol.streams import SampleChunk

F64 = NDArray[np.float64]

PHASES, VECTOR = ("i_a", "i_b", "i_c"), ("i_d", "i_q")
BLOCK = 0.05  # s over which the speed is averaged
STILL = 0.01  # share of the stretch's speed that the mean over a block may be off
LONGEST = 5.0  # s of a stretch that are used: lines 0.2 Hz apart
SHOWN = 20.7  # harmonics, up to which the figure goes


@dataclass(frozen=True)
class Stretch:
    """Samples in which the speed stands still."""

    first: int
    """Device ticks, both included."""
    last: int
    rpm: float
    """Mean."""
    n: int


class SteadyStretch:
    """Looks for the longest stretch of samples without a gap in which the shaft turns at one speed."""

    def __init__(self) -> None:
        self.longest: Stretch | None = None
        self._now: Stretch | None = None
        self._next = -1  # index that would go on from the last

    def add(self, piece: Piece) -> None:
        """Look at the samples of a piece; pieces come in order."""
        if piece.rpm is None or piece.phases is None:
            return
        config, tick = piece.samples.config, piece.samples.tick
        if int(piece.samples.index[0]) != self._next:
            self._now = None
        self._next = int(piece.samples.index[-1]) + config.decimation
        size = max(1, round(BLOCK * config.rate))
        for begin in range(0, len(tick), size):
            rows = slice(begin, min(begin + size, len(tick)))
            rpm = float(piece.rpm[rows].mean())
            if not piece.phases.steady[rows].all():
                self._now = None
                continue
            new = Stretch(int(tick[rows][0]), int(tick[rows][-1]), rpm, rows.stop - rows.start)
            old = self._now
            if old is not None and abs(rpm - old.rpm) <= STILL * abs(old.rpm):
                n = old.n + new.n
                new = Stretch(old.first, new.last, (old.rpm * old.n + rpm * new.n) / n, n)
            self._now = new
            if self.longest is None or new.n > self.longest.n:
                self.longest = new


@dataclass(frozen=True)
class Currents:
    """Spectra of currents over one stretch."""

    f: float
    """Hz, of the fundamental."""
    rpm: float
    span: tuple[float, float]
    """s of device time."""
    lines: dict[str, Spectrum]
    """By channel."""
    distortion: dict[str, Thd]
    """By phase; those without a fundamental are left out,"""
    why: dict[str, str] = field(default_factory=dict)
    """and why."""


def currents(samples: SampleChunk, rpm: float, n_p: int) -> Currents:
    """Spectra and distortions of the currents in `samples`, which have no gap, at about `rpm` (mechanical).

    The fundamental's frequency is that of the encoder's angle, over which the distortion is measured too; without an
    encoder it is the one nearest to the speed at which the current has most. Raises ValueError for fewer than
    three electrical periods.
    """
    config = samples.config
    t = samples.tick / config.tick_hz
    names = [channel.name for channel in config.channels]
    reference = reference_angle(config.channels)
    theta = np.unwrap(samples.physical(reference)) if reference else None
    seconds = float(t[-1] - t[0])
    f = abs(rpm) * RPM * n_p / math.tau if theta is None else abs(float(np.polyfit(t - t[0], theta, 1)[0])) / math.tau
    if f * seconds < PERIODS:
        raise ValueError(f"the longest steady stretch, {seconds:.3g} s, has fewer than {PERIODS} periods of {f:.3g} Hz")
    found: dict[str, Thd] = {}
    why: dict[str, str] = {}
    for name in PHASES:
        if name in names:
            try:
                found[name] = _distortion(t, theta, samples.physical(name), f)
            except ValueError as error:
                why[name] = str(error)
    if theta is None and (refined := [each.f for each in found.values() if each.f is not None]):
        f = float(np.mean(refined))
    lines = {name: spectrum(t, samples.physical(name)) for name in (*PHASES, *VECTOR) if name in names}
    return Currents(f, rpm, (float(t[0]), float(t[-1])), lines, found, why)


def _distortion(t: F64, theta: F64 | None, y: F64, f: float) -> Thd:
    if theta is None:
        refined = fundamental(t, y, guess=f).f
        return thd(t, y, refined, order=_order(0.5 / (refined * float(t[1] - t[0]))))
    return thd_by_angle(theta, y, order=_order(math.pi / float(np.abs(np.diff(theta)).max())))


def _order(limit: float) -> int:
    """The highest harmonic below `limit`, at most that of the paper's (20)."""
    return min(ORDER, math.ceil(limit) - 1)


def as_json(of: Currents) -> dict[str, Any]:
    """Plain data: figures and harmonics, not the lines."""
    return {
        "from_s": of.span[0],
        "to_s": of.span[1],
        "rpm": of.rpm,
        "fundamental_hz": of.f,
        "phases": {
            name: {"thd_percent": 100 * each.value, "order": len(each.amplitudes), "periods": each.periods,
                   "harmonics_a": each.amplitudes.tolist()}
            for name, each in of.distortion.items()
        },
        "without_thd": of.why,
    }  # fmt: skip


def stretch(of: Currents) -> str:
    """The stretch in words."""
    return f"{of.span[0]:.3f} … {of.span[1]:.3f} s, {of.rpm:.0f} r/min, {of.f:.2f} Hz"


def words(of: Currents) -> str:
    """What the figure says, in a line."""
    each = [f"{name} {100 * its.value:.3g} % of {its.amplitudes[0]:.3g} A" for name, its in of.distortion.items()]
    each += [f"{name} none" for name in of.why]  # in JSON: why
    return f"THD {', '.join(each) or 'undefined'}; longest steady stretch: {stretch(of)}"


def draw(of: Currents) -> Figure:
    """Amplitudes by logarithm: phases above, currents in the rotor's frame below, harmonics marked."""
    phases = [name for name in PHASES if name in of.lines]
    vector = [name for name in VECTOR if name in of.lines]
    figure, axes = new_figure((len(phases) > 0) + (len(vector) > 0), height=2.9 if not (phases and vector) else 4.9)
    drawn = iter(axes)
    if phases:
        ax = next(drawn)
        _lines(ax, of, phases[:1], "amplitude of a phase")
        for mark, name in zip("ox+", (name for name in phases if name in of.distortion), strict=False):
            amplitudes = of.distortion[name].amplitudes
            hue, words = colour(name), f"{name}: THD {100 * of.distortion[name].value:.3g} %"
            f = of.f * np.arange(1, len(amplitudes) + 1)
            ax.plot(f, amplitudes, mark, color=hue, markersize=4.5, fillstyle="none", label=words)
        legend_above(ax)
    if vector:
        ax = next(drawn)
        _lines(ax, of, vector, "amplitude of i_d, i_q")
        legend_above(ax)
    axis_labels(axes[-1], "frequency", axes[-1].get_ylabel(), "Hz")
    figure.align_ylabels(axes)
    return figure


def _lines(ax: Axes, of: Currents, names: list[str], what: str) -> None:
    """The lines of these channels, with the harmonics named within the axes, at their top."""
    end = min(SHOWN * of.f, float(of.lines[names[0]].f[-1]))
    low, high = math.inf, 0.0
    for name in names:
        f, amplitude = of.lines[name]
        shown = (f > 0) & (f <= end)
        ax.semilogy(f[shown], amplitude[shown], color=colour(name), linewidth=0.7, label=name)
        low = min(low, float(np.percentile(amplitude[shown], 2)))
        high = max(high, float(amplitude[shown].max()))
    ax.set_xlim(0, end)
    ax.set_ylim(max(low / 2, high * 1e-6, 1e-9), 6.0 * high or 1.0)
    behind = {"facecolor": "white", "edgecolor": "none", "pad": 0.8}
    for n in range(1, math.ceil(end / of.f)):
        ax.axvline(n * of.f, color=GREY, linewidth=0.5, linestyle=":", zorder=0)
        ax.text(n * of.f, 0.985, f"{n}", transform=ax.get_xaxis_transform(), ha="center", va="top", bbox=behind,
                fontsize=FONT_SIZE - 1, color="0.3")  # fmt: skip
    axis_labels(ax, "", what, unit_y="A")
