"""Step 3: L_d and L_q over the current, by square waves on the voltage beside a d current, at two rates.

The d current keeps all phase currents from changing their sign, so that the dead time's volts do not change. Of whole
cycles the mean is taken, and of it the least squares of L (i[n] - i[n-1]) / T = u[n] - R i - c, without the interval
after each switch of the voltage, in which a current that is sampled late would be part of both slopes.

A DC link that gives way sinks while the square wave takes power, that is, beside a d current on the d axis, and the
drive sets its duties by the voltage that it had some periods before. So what lay on the winding is the reference times
the DC link's mean over that period, over what it was at the sample by which the duties were computed, one period before
it began.

A q current rocks the rotor, whose back-EMF takes something off L_q, K q: K = 1.5 n_p^2 psi^2 / J, and q, the mean
square of the current over that of its slope, follows from each cycle as measured. The two rates differ in q, so K is
fitted beside L_q as long as nobody knows J; once J and psi are known, `rocking_of` gives it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from bench.commission.least_squares import Fit, fit_curve
from bench.commission.outcome import Evidence, Outcome, Panel
from bench.commission.quantity import Quantity
from bench.commission.refusal import Refused
from bench.commission.stand import Stand
from bench.commission.window import Floats, Wave, clarke
from bench.rig.envelope import Envelope

STEP = "inductance"
BIASES = (0.2, 0.35, 0.5, 0.7)
"""d currents as shares of the agreed one."""
MIDDLE = 0.5
"""That at which L is stated as it was measured."""
HALVES = (4, 10)
"""PWM periods of half a cycle."""
SWINGS = {"u_d": 0.4, "u_q": 0.5}
"""Peak to peak, as shares of the d current, or of 0.4 of the agreed one where that is less."""
LARGEST = 0.3
"""Amplitude as a share of the linear voltage, at most."""
SLOW = 40.0
"""Hz of the current loop meanwhile."""
SECONDS, MOST_SECONDS, CLEAN = 0.16, 0.8, 0.004
"""s of a window, at least and at most, and the noise as a share of the agreed current from which it grows."""
LEAD = 0.03
"""s before it."""
BLOCKS = 6
"""Parts of a window, whose scatter is the noise of L."""
FLOOR = 3e-3
"""Standard deviation of one L that the method leaves, relative."""
LINK = 0.3
"""Standard deviation of the correction for a DC link that gives way, as a share of it: drives sample it otherwise."""
FLOOR_Q = 3e-3
"""And of L_q without a current, besides."""
SURE, DOUBT = 4.0, 0.6
"""Standard deviations by which another law has to be nearer to what was measured than the usual one, and what share of
their difference counts, sd, where it is nearer by less."""
FLOOR_NOISE = 0.2
"""And what it leaves on a drive that is too large for the motor: so many times noise over agreed current."""


@dataclass(frozen=True)
class Slope:
    """What one of them says."""

    axis: str
    half: int
    bias: float
    """A."""
    L: float
    """H, with what a rocking rotor takes off."""
    q: float
    """s2, by which K acts."""
    sd: float
    """H, by the scatter of the cycles."""
    ripple: float
    """A, peak to peak."""
    link: float
    """H: how much of L is the correction for a DC link that gives way."""


@dataclass(frozen=True)
class Inductances:
    """What all of them say."""

    L_d: float
    """H, incremental at the middle current."""
    L_q: float
    outcome: Outcome


def rocking_of(n_p: float, psi_f: float, J: float) -> float:
    """K in V/(A s): what the back-EMF of a free rotor is, for an integral of q current."""
    return 1.5 * (n_p * psi_f) ** 2 / J


def slope(wave: Wave, R: float, gains: Floats) -> Slope:
    """L of one window; Refused where its cycles are not whole."""
    window, half = wave.window, wave.half
    turn = np.exp(-1j * window.control)
    part = np.real if wave.axis == "u_d" else np.imag
    i = np.asarray(part(clarke(window.i / gains[:, None]) * turn))
    u = np.asarray(part(window.u * turn))
    begins = np.flatnonzero(window.cycle)
    begins = begins[begins >= 2]
    if len(begins) < 2 * BLOCKS or np.any(np.diff(begins) != 2 * half):
        raise Refused(STEP, f"cycles of the test signal are not {2 * half} PWM periods long, or too few came")
    n = len(begins) - 1
    rows = slice(int(begins[0]), int(begins[0]) + n * 2 * half)
    link = 0.5 * (window.u_dc + np.roll(window.u_dc, 1)) / np.roll(window.u_dc, 2)
    cut = (np.asarray(x[rows]).reshape(n, 2 * half) for x in (i, np.roll(i, 1), u * link, u))
    current, before, volts, reference = cut
    spread = current - current.mean(axis=0)
    variance = float((spread**2).sum() / max((n - 1) * 2 * half, 1))
    whole = _of_cycle(current.mean(0), before.mean(0), volts.mean(0), R, window.T, variance / n)
    stiff = _of_cycle(current.mean(0), before.mean(0), reference.mean(0), R, window.T, variance / n)
    pieces = [
        _of_cycle(current[k].mean(0), before[k].mean(0), volts[k].mean(0), R, window.T, variance / len(k))[0]
        for k in np.array_split(np.arange(n), BLOCKS)
    ]
    sd = float(np.std(pieces, ddof=1)) / math.sqrt(BLOCKS)
    mean = current.mean(0)
    return Slope(
        wave.axis, half, wave.bias, whole[0], whole[1], sd, float(mean.max() - mean.min()), whole[0] - stiff[0]
    )


def _of_cycle(i: Floats, before: Floats, u: Floats, R: float, T: float, variance: float) -> tuple[float, float]:
    """L (H) and q (s2) of a mean cycle, each of shape (2 half,): i at the end of each interval, before at its begin."""
    half = len(i) // 2
    used = np.ones(len(i), bool)
    used[[0, half]] = False
    middle = 0.5 * (i + before)
    charge = np.cumsum(middle - middle.mean()) * T
    charge = charge - 0.5 * (middle - middle.mean()) * T  # at the middle of each interval
    di = ((i - before) / T)[used]
    y = (u - R * middle)[used]
    di, y, charge = di - di.mean(), y - y.mean(), charge[used] - charge[used].mean()
    noise = 2.0 * variance / T**2 * int(used.sum())
    power = float(di @ di) - noise
    if power <= noise:
        raise Refused(STEP, "the test signal moves the current by less than the noise: agree to more current")
    L, q = float(di @ y) / power, -float(di @ charge) / power
    x = 0.5 * R * T / L
    if 0.0 < x < 1.0:
        L *= x / math.atanh(x)  # the mean of i over an interval is taken as that of its ends
    return L, q


Law = Callable[[Floats, Floats], Floats]
"""L at a current over L without one, of parameters, shape (1,) or (2,), and of currents as shares, shape (n,)."""
LAWS: tuple[Law, ...] = (
    lambda a, i: 1.0 / (1.0 + a[0] * i**2),
    lambda a, i: 1.0 - a[0] * i**2,
    lambda a, i: 1.0 / np.sqrt(np.maximum(1.0 + a[0] * i**2, 1e-3)),
)
"""How L may fall with the current. Each counts as much as its residuals allow; what they differ by at no current is
what the extrapolation costs."""


def bent(a: Floats, i: Floats) -> Floats:
    """The law of L_q where both signs of a d current are not alike, because one axis saturates the other."""
    return np.asarray(1.0 / np.maximum(1.0 + a[0] * i + a[1] * i**2, 1e-3))


def _squares(of: Fit) -> float:
    return float(of.residuals @ of.residuals)


@dataclass(frozen=True)
class _Axis:
    zero: Quantity
    middle: Quantity
    rocking: float
    law: Law
    fitted: Fit
    L: Floats

    def model(self, share: Floats) -> Floats:
        """H, at currents as shares of the agreed one, shape (n,)."""
        return np.asarray(self.zero.value * self.law(self.fitted.x[1:3], share))


def _axis(slopes: Sequence[Slope], i_max: float, floor: float, known: tuple[float, float] | None) -> _Axis:
    """L without a current and at the middle one; `known`: K and its sd, None: it is fitted on the q axis."""
    q_axis = slopes[0].axis == "u_q"
    name = "L_q" if q_axis else "L_d"
    raw, q, bias, noise = (np.array([getattr(s, key) for s in slopes]) for key in ("L", "q", "bias", "sd"))
    sd = np.hypot(noise, floor * raw)
    link = np.array([LINK * abs(s.link) for s in slopes])
    share = np.abs(bias) / i_max
    fits_K = q_axis and known is None
    given = 0.0 if known is None or not q_axis else known[0]

    def fitted(law: Law, shape: Sequence[float]) -> Fit:
        k = len(shape)

        def curve(x: Floats) -> Floats:
            return np.asarray(x[0] * law(x[1 : 1 + k], share) - (x[1 + k] if fits_K else given) * q)

        rocks = [1e-3 * float(raw.max()) / float(q.max())] if fits_K else []
        return fit_curve(curve, np.array([float(raw.max()), *shape, *rocks]), raw, sd)

    fits = [fitted(each, [0.1]) for each in LAWS]
    squares, zeros = np.array([_squares(each) for each in fits]), np.array([float(each.x[0]) for each in fits])
    likely = np.exp(-0.5 * (squares - squares.min()))
    likely /= likely.sum()
    nearest = int(np.argmin(squares))
    law, best, value = LAWS[nearest], fits[nearest], float(likely @ zeros)
    spread = math.sqrt(float(likely @ (zeros - value) ** 2))
    if q_axis:
        other = fitted(bent, [0.1, 0.1])
        nearer = _squares(best) - _squares(other)
        if nearer > SURE**2 and not fits_K:  # of rocking and two parameters of a law the few currents tell too little
            law, best, value = bent, other, float(other.x[0])
        elif nearer > 0.0:
            spread = math.hypot(spread, DOUBT * (float(other.x[0]) - value) * -math.expm1(-0.5 * nearer))
    K = float(best.x[-1]) if fits_K else given
    by_K = abs(0.0 if known is None or not q_axis else known[1]) * float(q.min())
    L = raw + K * q
    parts = {"fit": float(best.sd[0]), "extrapolation": spread, "method": (FLOOR_Q * value if q_axis else 0.0)}
    parts["weak DC link"] = float(link.max())
    if by_K:
        parts["rocking rotor"] = by_K
    zero = Quantity(name, "H", value, parts, volts=1.0, amperes=-1.0)
    own = np.abs(bias - MIDDLE * i_max) < 0.01 * i_max
    mean = float(L[own].mean())
    K_sd = float(best.sd[-1]) if fits_K else by_K / max(float(q.min()), 1e-30)
    halves = {
        "noise": float(np.sqrt(np.mean(noise[own] ** 2) / own.sum())),
        "method": floor * mean / math.sqrt(2.0),
        "weak DC link": float(link[own].mean()),
        "rates": 0.5 * float(L[own].max() - L[own].min()) / math.sqrt(2.0),
    }
    if q_axis:
        halves["rocking rotor"] = K_sd * float(q[own].mean())
    return _Axis(zero, Quantity(f"{name}_half", "H", mean, halves, volts=1.0, amperes=-1.0), K, law, best, L)


def analyse(
    waves: Sequence[Wave], R: float, gains: Floats, i_max: float, noise: float,
    known: tuple[float, float] | None = None,
) -> Inductances:  # fmt: skip
    """L_d and L_q of windows at BIASES and HALVES; R, ohm, and the sensors' `gains` as step 2 has them.

    `noise`: A, of a sample. `known`: K (see `rocking_of`) and its standard deviation, once J is known; 0 and 0 for a
    shaft that is held. Refused where the current does not answer.
    """
    slopes = [slope(wave, R, gains) for wave in waves]
    floor = math.hypot(FLOOR, FLOOR_NOISE * noise / i_max)
    by_axis = {axis: [s for s in slopes if s.axis == axis] for axis in SWINGS}
    d, q = (_axis(by_axis[axis], i_max, floor, known) for axis in SWINGS)
    figures = {"rocking": q.rocking, "law_d": float(d.fitted.x[1]), "law_q": float(q.fitted.x[1]), "R": R}
    for each in slopes:
        key = f"{each.axis[2]}_{each.bias / i_max:.2f}_{each.half}"
        figures |= {f"L_{key}": each.L, f"sd_{key}": each.sd, f"ripple_{key}": each.ripple}
    line = np.linspace(0.0, max(BIASES) * i_max, 60)
    measured: dict[str, tuple[Floats, Floats]] = {}
    residuals: dict[str, tuple[Floats, Floats]] = {}
    for name, axis, own in (("L_d", d, by_axis["u_d"]), ("L_q", q, by_axis["u_q"])):
        bias = np.array([s.bias for s in own])
        measured |= {name: (bias, 1e3 * axis.L), f"fit of {name}": (line, 1e3 * axis.model(line / i_max))}
        residuals[name] = (bias, 100.0 * (axis.L / axis.model(bias / i_max) - 1.0))
    panels = (
        Panel("d current", "A", "incremental inductance", "mH", measured),
        Panel("d current", "A", "residuals", "%", residuals),
    )
    quantities = (d.zero, q.zero, d.middle, q.middle)
    evidence = Evidence("Inductances over the current", panels, figures)
    return Inductances(d.middle.value, q.middle.value, Outcome(quantities, evidence))


def perform(stand: Stand) -> Outcome:
    """Apply the square waves, and set the current loop by what follows."""
    waves: list[Wave] = []
    seconds = min(max(SECONDS * stand.noise / (CLEAN * stand.i_max), SECONDS), MOST_SECONDS)
    with stand.running():
        stand.ramp(0.1 * stand.i_max, 0.5 * stand.i_max, 0.3, 15)
        stand.wait(0.3)
        stand.set(bw_current=SLOW)
        for share in BIASES:
            bias = share * stand.i_max
            stand.current(bias)
            stand.wait(0.15)
            for axis, part in SWINGS.items():
                for half in HALVES:
                    swing = part * stand.i_max * min(share, 0.4)
                    amplitude = swing * stand.L / (half * stand.T) + 0.5 * stand.R * swing
                    with stand.square(axis, min(amplitude, LARGEST * stand.u_linear), half):
                        stand.wait(LEAD)
                        waves.append(Wave(stand.run(seconds, "forced"), axis, half, bias))
    found = analyse(waves, stand.R, stand.gains, stand.i_max, stand.noise)
    stand.L = 0.5 * (found.L_d + found.L_q)
    stand.set(L_s_hat=stand.L)
    stand.waves = tuple(waves)
    return found.outcome


def announcement(agreed: Envelope) -> str:
    """What will be done, within what was agreed to."""
    return (
        f"square waves on the voltage beside d currents up to {max(BIASES) * agreed.current:.3g} A, at one angle, "
        "about 5 s; the shaft trembles"
    )
