"""The motor that the firmware takes its motor to be, against what voltages, currents and encoder say of it.

In the rotor's own frame, over a tenth of a second,

    u = R_s i + d(L i)/dt + j omega (L i + psi_f) + v i / |i|

with v, the voltage that dead time and devices take, and an error of the angle unknown, too: a constant one, and one
that goes with the speed. All are found together, by least squares over the working points that the run has been to.
What these cannot separate stays uncertain: R_s at one current from v, L_s at one load from the angle.

Of a drive without an encoder what its own Kalman filter has learned counts, where it is streamed, and where the filter
has never doubted a Hall sensor nor its angle.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.findings.finding import Finding
from bench.findings.thresholds import SEEN_FOR, SURELY, TELLING
from bench.signal.channels import flagged, reference_angle
from bench.signal.position import running
from protocol.signals import LESSONS, Flag, Unit
from protocol.streams import SampleChunk, StreamConfig

F64 = NDArray[np.float64]
C128 = NDArray[np.complex128]

NEEDED = ("u_alpha", "u_beta", "i_a", "i_b", "u_dc")
TOLD_BY = ("lesson_ek", "lesson_value_ek", "lesson_sigma_ek", "sensors_ek")
BLOCK = 0.1  # s of a mean
COHERENT = 0.7  # of the voltage's rms, that its mean in the rotor's frame has to be: else the angle is another
LEFT = 0.005  # of u_dc: V that dead time and devices leave in any direction; a third of v's standard deviation
RIPPLE = 0.02  # of the back-EMF: harmonics, a shaft that swings
MODEL = {0: 0.05, 1: 0.1, 3: 0.03}  # of R_s, L_s and psi_f: what the equation leaves out, such as saturation
SMALL = 0.1  # of i_max, current below which the dead time's voltage has another shape
POINTS = (20.0, 10.0, 10.0)  # working points that are told apart, in the largest speed and in the largest currents
LATE = 1e-5  # s
FULL = 0.9 / math.sqrt(3.0)  # of u_dc: voltage above which not all of it may come, with dead time and current control
CONSISTENT = 6.0  # times the expected square that is left over: with more the data contradict the equation
STEP = 1e-3  # s of a mean over which a current rises steeply: that shows the inductance
LEAST_STEP = 4  # samples in it
STEEP = 8.0  # times what is `LEFT`, that the inductance must take
START = (1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0)
PRIOR = (1.5, 1.5, 1.5, 1.5, 1.5, 3.2, 5.0)
"""R_s, L_q, L_d and psi_f by the drive's parameters, the angle in rad, v by what is `LEFT`, the delay by `LATE`: before
anything is seen, and the standard deviations of that."""
NAMES = {0: "R_s_hat", 1: "L_s_hat", 3: "psi_f_hat"}
DOUBT = {"R_s_hat": 6.0, "L_s_hat": 3.0, "psi_f_hat": 3.0}
"""Times the standard deviation that the drive tells: its filter takes its equations to be right."""
OF = {"R_s_hat": ("resistance", 1.0, "ohm"), "L_s_hat": ("inductance", 1e3, "mH"),
      "psi_f_hat": ("flux_linkage", 1e3, "mV s")}  # fmt: skip
"""By parameter: the finding's code; what makes its unit one for people, and that unit."""
CODES = tuple(code for code, *_ in OF.values())
TERMINALS, WINDING = "a value between two terminals?", "of a delta winding taken for star?"
LIKELY: dict[str, tuple[tuple[float, str], ...]] = {
    "R_s_hat": ((2.0, TERMINALS), (3.0, WINDING)),
    "L_s_hat": ((2.0, TERMINALS), (3.0, WINDING)),
    "psi_f_hat": (
        (math.sqrt(3.0), "line to line against phase?"), (math.sqrt(2.0), "rms against peak?"), (2.0, "peak to peak?"),
        (60.0 / math.tau, "r/min against rad/s?"),
    ),
}  # fmt: skip
"""Mistakes by their factor, either way."""
ALIKE = 0.05  # by which a ratio may be off a likely one at least


class Value(NamedTuple):
    """A parameter of the drive, what it should be by the run, and the standard deviation of that, in its unit."""

    parameter: float
    value: float
    sd: float

    @property
    def ratio(self) -> float:
        """The parameter by what it should be."""
        return self.parameter / self.value if self.value > 0.0 else math.inf

    def wrong(self, telling: float) -> bool:
        """Whether it is off by more than the factor `telling`, and by more than `SURELY` for certain."""
        least, most = self.value - 3.0 * self.sd, self.value + 3.0 * self.sd
        off = not 1.0 / telling <= self.ratio <= telling
        return least > 0.0 and off and (self.parameter > SURELY * most or SURELY * self.parameter < least)


class _Point(NamedTuple):
    """Sums over the blocks of a working point."""

    n: int
    x: C128  # (7,) what a unit of each unknown adds to the voltage, V
    u: complex  # V
    variance: float  # V2


NOTHING = _Point(0, np.zeros(len(PRIOR), complex), 0j, 0.0)


class MotorValues:
    """R_s, L_s and psi_f by what a run shows, beside the drive's `parameters`; `stream`: what it streams."""

    def __init__(self, stream: StreamConfig, parameters: Mapping[str, float]) -> None:
        names = {channel.name for channel in stream.channels}
        self._rate, self._period = stream.rate, 1.0 / stream.pwm_hz
        self._theta = reference_angle(stream.channels)
        self._omega = flagged(stream.channels, Unit.RAD_PER_S, Flag.REFERENCE)
        hats = {name: parameters.get(name, math.nan) for name in OF}
        self._hats, self._n_p = hats, parameters.get("n_p", math.nan)
        R_s, L_s, psi_f = hats.values()
        self._scales = np.array([R_s, L_s, L_s, psi_f, 1.0, 1.0, LATE])
        i_max = parameters.get("i_max", math.nan)
        self._most = np.array([parameters.get("omega_m_max", math.nan) * self._n_p, i_max, i_max])
        known = bool((self._scales > 0.0).all() and (self._most > 0.0).all())  # false for what is not there
        self._seen = known and bool(self._theta and self._omega) and names.issuperset(NEEDED)
        self._told = not self._seen and names.issuperset(TOLD_BY)
        self._points: dict[tuple[int, ...], _Point] = {}
        self._seconds = 0.0
        self._turning = self._unlike = (
            0  # blocks in which the rotor turned; of them with another angle than the rotor's
        )
        self._lessons: dict[str, Value] = {}

    def add(self, chunk: SampleChunk) -> None:
        """Take in samples."""
        if self._told:
            self._lessons |= dict(self._learned(chunk))
        if not self._seen or chunk.gaps or not running(chunk).all():
            return
        u = chunk.physical("u_alpha") + 1j * chunk.physical("u_beta")
        i_a, i_b = chunk.physical("i_a"), chunk.physical("i_b")
        i = i_a + 1j * (i_a + 2.0 * i_b) / math.sqrt(3.0)
        lost = LEFT * float(chunk.physical("u_dc").mean())
        self._add(chunk.physical(self._theta), chunk.physical(self._omega), u, i, lost)

    def _learned(self, chunk: SampleChunk) -> Iterator[tuple[str, Value]]:
        number, value, sd, doubts = (chunk.physical(name) for name in TOLD_BY)
        if doubts.any():  # of Hall sensors or of the angle: it has learned with them
            self._told = False
            self._lessons.clear()
            return
        for name, hat in self._hats.items():
            rows = np.flatnonzero(number == LESSONS.index(name))
            if len(rows):
                yield name, Value(hat, float(value[rows[-1]]), DOUBT[name] * float(sd[rows[-1]]))

    def _add(self, theta: F64, omega: F64, u: C128, i: C128, lost: float) -> None:
        """Samples in a row (n,): theta (rad), omega (rad/s) and i (A) at each, u (V) over the PWM period up to it.

        `lost`: what is `LEFT`, V.
        """
        back = np.exp(-1j * theta)
        u = (u * back * np.exp(0.5j * self._period * omega))[1:]
        i = i * back
        n = len(u)
        if blocks := round(n / (self._rate * BLOCK)):
            self._blocks(np.arange(blocks + 1) * n // blocks, omega[1:], u, i, lost, 0.0)
        if (step := round(self._rate * STEP)) >= LEAST_STEP:
            self._blocks(np.arange(0, n + 1, step), omega[1:], u, i, lost, STEEP * lost)

    def _blocks(self, at: NDArray[np.int64], omega: F64, u: C128, i: C128, lost: float, least: float) -> None:
        """Blocks [at[k], at[k + 1]) of the n intervals between samples; u and i as the rotor sees them, i (n + 1,).

        `lost`: what is `LEFT`, V; `least`: V that the inductance must take at least, by the drive's.
        """
        if len(at) < 2:
            return
        count = np.diff(at)
        inductance, psi = float(self._scales[1]), float(self._scales[3])

        def mean(values: NDArray[Any]) -> C128:
            return np.asarray(np.add.reduceat(values[: at[-1]], at[:-1]) / count, complex)

        through = 0.5 * (i[1:] + i[:-1])
        mean_u, mean_i = mean(u), mean(through)
        mean_omega: F64 = np.add.reduceat(omega[: at[-1]], at[:-1]) / count
        rise: C128 = (i[at[1:]] - i[at[:-1]]) / count * self._rate
        along = mean(through / np.maximum(np.abs(through), 1e-9))
        small = np.abs(mean_i) < SMALL * self._most[1]
        along[small] = 0.0
        x = np.stack(
            [
                mean_i, 1j * rise.imag - mean(omega * through.imag), rise.real + 1j * mean(omega * through.real),
                1j * mean_omega, -mean_omega * psi, along, -mean(omega * omega) * psi,
            ]
        )  # fmt: skip
        x *= np.r_[self._scales[:5], lost, LATE][:, None]
        variance = lost**2 + (RIPPLE * psi * mean_omega) ** 2 + small * (2.0 * lost) ** 2
        if least:
            chosen = inductance * np.abs(rise) > least
            where = [mean_omega / self._most[0], STEP * rise.real / self._most[1], STEP * rise.imag / self._most[1]]
        else:
            chosen = np.abs(mean_u) > COHERENT * np.sqrt(mean(np.abs(u) ** 2).real)
            where = [mean_omega / self._most[0], mean_i.real / self._most[1], mean_i.imag / self._most[1]]
            turning = np.abs(mean_omega) * count > self._rate  # by more than a radian
            self._turning += int(np.count_nonzero(turning))
            self._unlike += int(np.count_nonzero(turning & ~chosen))
        chosen &= np.maximum.reduceat(np.abs(u[: at[-1]]), at[:-1]) < FULL * lost / LEFT
        keys = np.rint(np.stack(where).T * POINTS).astype(int)
        for k in np.flatnonzero(chosen):
            self._seconds += 0.0 if least else count[k] / self._rate
            old = self._points.get(key := (least > 0.0, *keys[k].tolist()), NOTHING)
            self._points[key] = _Point(old.n + 1, old.x + x[:, k], old.u + mean_u[k], old.variance + variance[k])

    def values(self) -> dict[str, Value]:
        """What is said of each parameter."""
        seen = self._seconds >= SEEN_FOR and self._unlike <= 0.5 * self._turning
        return dict(self._fitted()) if seen else self._lessons

    def _fitted(self) -> Iterator[tuple[str, Value]]:
        """By least squares; nothing where the data contradict the equation."""
        of, sd, worse = self._least_squares(list(self._points.values()))
        of[3] = math.hypot(of[3], of[4])  # the angle turns the flux
        for k, name in NAMES.items() if worse <= CONSISTENT else ():
            hat = self._hats[name]
            yield name, Value(hat, hat * float(of[k]), hat * math.hypot(sd[k], MODEL[k] * of[k]))

    def _least_squares(self, points: Sequence[_Point]) -> tuple[F64, F64, float]:
        """The unknowns, in `_scales`, their standard deviations, and how much worse the fit is than expected."""
        x = np.array([point.x / point.n for point in points])
        u = np.array([point.u / point.n for point in points])
        weight = np.sqrt([point.n / point.variance for point in points])
        rows = np.concatenate([x.real * weight[:, None], x.imag * weight[:, None]])
        seen = np.r_[u.real * weight, u.imag * weight]
        P = np.linalg.inv(rows.T @ rows + np.diag(np.array(PRIOR) ** -2.0))
        of = START + P @ rows.T @ (seen - rows @ START)
        worse = float(np.sum((seen - rows @ of) ** 2)) / max(len(seen) - len(of), 1)
        return of, np.sqrt(np.diag(P) * max(worse, 1.0)), worse

    def told(self) -> dict[str, dict[str, float | bool | None]]:
        """By parameter that the drive has: what it is, what it should be, its standard deviation, whether it is wrong.

        The last is None of one that is not known to a third: the run cannot tell.
        """
        values = self.values()
        told: dict[str, dict[str, float | bool | None]] = {}
        for name, hat in self._hats.items():
            value = values.get(name, Value(hat, math.nan, math.inf))
            wrong = True if value.wrong(TELLING[name]) else False if 9.0 * value.sd < value.value else None
            told |= {name: value._asdict() | {"wrong": wrong}} if hat > 0.0 else {}
        return told

    def findings(self) -> Iterator[Finding]:
        """The parameters that are wrong."""
        for name, value in self.values().items():
            if value.wrong(TELLING[name]):
                yield _finding(name, value, self._n_p)


def _finding(name: str, value: Value, n_p: float) -> Finding:
    code, factor, unit = OF[name]
    likely = LIKELY[name] + (((n_p, "by the shaft's angle, not the electrical one?"),) if name == "psi_f_hat" else ())
    off = abs(math.log(value.ratio))
    alike = max(ALIKE, 2.0 * value.sd / value.value)
    hints = [words for ratio, words in likely if ratio > 1.0 and abs(off - math.log(ratio)) < alike]
    times = f"{value.ratio:.2g} times"
    for ratio, words in ((2.0, "twice"), (0.5, "half of")):
        times = words if abs(math.log(value.ratio / ratio)) < 0.1 else times
    has, says, within = (
        f"{figure:.3g} {unit}" for figure in factor * np.array([value.parameter, value.value, 3.0 * value.sd])
    )
    return Finding(
        code,
        f"{name} is {times} what voltages and currents say"
        + (f": {' or '.join(hints)}" if len(hints) in (1, 2) else ""),
        (f"{name} = {has}, but by voltages, currents and angle it is {says} +/- {within}",),
        "measure the flux linkage with bench accept, test back_emf_and_encoder" if code == "flux_linkage" else "",
    )
