"""Step 2: resistance, and the volts that the dead time takes, told apart.

A d current in steps, at three angles and, on the way back, at the same three again. Where no phase is near zero,
u = R i + 4/3 U + c i E: the vector of the signs of three phase currents is 4/3 along the current, U is what the dead
time and the switches take of a phase, and E, the square of the current added up since the first one, less what has
cooled, is the heat in the winding, which goes out with it. So R is that of the winding as it was before anything had
flown. How fast a winding cools nobody knows: each of some times is fitted, and counts as much as its residuals allow.
Each angle has an R and a U of its own, because sensors that drift would else be taken for a winding that warms. What
the currents' sum is not zero by tells the gains of the three sensors apart, but for their mean.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bench.commission.least_squares import Fit, fit
from bench.commission.outcome import Evidence, Outcome, Panel
from bench.commission.quantity import Quantity
from bench.commission.refusal import Refused
from bench.commission.stand import COOLING, Stand
from bench.commission.window import Booleans, Floats, Integers, Window, clarke
from bench.rig.envelope import Envelope

STEP = "resistance"
ANGLES = (0.0, 2.0 * math.pi / 3.0, -2.0 * math.pi / 3.0)
LEVELS = np.concatenate([np.geomspace(0.01, 0.2, 9), np.linspace(0.28, 0.75, 6)])
"""Currents as shares of the agreed one."""
PASSES = (*ANGLES, *ANGLES[::-1])
"""The angles and the same way back: what drifts meanwhile is then not taken for what warms."""
ALIGNED = 0.5
"""The share with which the rotor is brought to the angle."""
FULL = 0.25
"""Share of the agreed current from which the dead time's volts do not change any more."""
SETTLE, MEASURE = 0.012, 0.03
"""s of each level."""
CALM = 150.0
"""Hz of the current loop where the drive's memory holds some of the samples only: a loop that is as fast as it may be
answers noise by voltages, whose mean over all samples is 0."""
PASS, EDGES_PER_S = 4.0, 20.0
"""s of an angle, and Hall edges a second, for which the drive's memory is to have room where the link is slow."""
LOOK, LONGEST = 0.1, 1.3
"""s in which a rotor that swings is looked at, and for which it is waited for at most."""
AT_REST = 1e-3
"""What it may swing by as a voltage, as a share of R times the current."""
NOISY = 3.0
"""Standard deviations of noise, from sample to sample, that the part of a look may swing by besides."""
BLOCKS = 6
"""Parts of a window, whose scatter weighs it."""
LEAST_SD = 2e-4
"""V: what the mean of a window is known to at best."""
ENOUGH = 5
"""Windows at rest that an angle needs, to count."""
RESTLESS = 12.0
"""Times the usual scatter within a window from which its rotor was not at rest yet: it is left out."""
FLOOR_R, FLOOR_SLOW, FLOOR_U = 1.2e-3, 1.7e-3, 2.5e-3
"""Standard deviations that the method leaves, relative; the second of R where a memory holds some of the samples."""
FLOOR_NOISE = 0.11
"""And what it leaves of R on a drive that is too large for the motor: so many times noise over agreed current."""


@dataclass(frozen=True)
class Held:
    """A window at a level, and the heat in the middle of it, A2 s, for each time with which the winding may cool."""

    window: Window
    heat: Floats
    """Shape (m,); the first without cooling."""


@dataclass(frozen=True)
class Winding:
    """What the levels say."""

    R: float
    """Ohm, in the drive's units."""
    gains: Floats
    """Of the three current sensors, shape (3,), of mean 1."""
    dead_time: float
    """s, the effective one."""
    outcome: Outcome


@dataclass(frozen=True)
class _Levels:
    """Means of the windows, each of shape (n,) or (n, 3)."""

    angle: Floats
    phases: Floats
    u: Floats
    sd: Floats
    heats: Floats
    """A2 s, shape (n, m)."""
    u_dc: Floats

    @property
    def place(self) -> Integers:
        """Which of the angles each has, shape (n,)."""
        return np.asarray(np.unique(np.round(self.angle, 2), return_inverse=True)[1])

    def angles(self, used: Booleans) -> Integers:
        """Those that have enough windows among the used ones."""
        return np.flatnonzero(np.bincount(self.place[used]) >= ENOUGH)

    def columns(self, i: Floats, heat: Floats, angles: Integers) -> Floats:
        """Of the equations: each angle's R and volts at no current, and the warming, which all share."""
        own = (self.place[:, None] == angles).astype(float)
        return np.hstack([own * i[:, None], own, (i * heat)[:, None]])


def _means(held: Sequence[Held]) -> _Levels:
    angle = np.array([float(np.angle(np.exp(1j * each.window.control).mean())) for each in held])
    u = [each.window.u * np.exp(-1j * at) for each, at in zip(held, angle, strict=True)]
    blocks = [x.real[: len(x) // BLOCKS * BLOCKS].reshape(BLOCKS, -1).mean(axis=1) for x in u]
    return _Levels(
        angle,
        np.array([each.window.i.mean(axis=1) for each in held]),
        np.array([float(x.real.mean()) for x in u]),
        np.array([float(x.std(ddof=1)) / math.sqrt(BLOCKS) for x in blocks]),
        np.array([each.heat for each in held]),
        np.array([float(each.window.u_dc.mean()) for each in held]),
    )


def mismatch(phases: Floats) -> tuple[Floats, Floats]:
    """Gains of three current sensors, of mean 1, shape (3,), and their sd, from means of currents, shape (n, 3), A.

    The true currents add up to zero; what the sensors' offsets have moved by since is fitted beside.
    """
    a, b, c = phases.T
    found = fit(np.stack([a - c, b - c, np.ones_like(a)], axis=1), a + b + c)
    gains = np.array([found.x[0], found.x[1], -found.x[0] - found.x[1]])
    turn = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, -1.0]])
    covariance = turn @ found.covariance[:2, :2] @ turn.T
    return 1.0 + gains - gains.mean(), np.sqrt(np.diag(covariance))


def analyse(held: Sequence[Held], i_max: float, noise: float) -> Winding:
    """R, U and the effective dead time of levels that cover FULL and more of `i_max`, A; `noise`: A, of a sample.

    Refused where the levels do not tell them apart.
    """
    of = _means(held)
    gains, gains_sd = mismatch(of.phases)
    i = np.asarray((clarke((of.phases / gains).T) * np.exp(-1j * of.angle)).real)
    usual = max(float(np.median(of.sd)), LEAST_SD)
    still = of.sd < RESTLESS * usual
    if still.mean() < 0.5:
        raise Refused(STEP, "the rotor does not come to rest: hold the shaft, or take off what swings on it")
    full = (i > FULL * i_max) & still
    full &= np.isin(of.place, of.angles(full))
    if not full.any():
        raise Refused(STEP, f"the levels of current do not tell R: too few are above {FULL * i_max:.3g} A, at rest")
    models = _coolings(of, i, full)
    shares = np.array([model.share for model in models])
    likely = models[int(np.argmax(shares))]
    found, heat, n = likely.fit, likely.heat, len(of.angles(full))
    each = np.array([[model.fit.x[:n].mean(), model.fit.x[n : 2 * n].mean()] for model in models])
    R, offset = (float(x) for x in shares @ each)
    heating, heating_offset = (float(x) for x in np.sqrt(shares @ (each - [R, offset]) ** 2))
    if R <= 0.0:
        raise Refused(STEP, f"the voltage falls where the current grows ({R:.3g} ohm): check the phases' wires")
    warming = float(found.x[-1])
    means = np.zeros((3, len(found.x)))  # of the angles' slopes, of their volts at no current; and the warming
    means[0, :n], means[1, n : 2 * n], means[2, -1] = 1.0 / n, 1.0 / n, 1.0
    sd = np.sqrt(np.diag(means @ found.covariance @ means.T)) * found.inflation()
    u_dc, T = float(of.u_dc.mean()), held[0].window.T
    by_noise, floor = FLOOR_NOISE * noise / i_max, FLOOR_R if held[0].window.every == 1 else FLOOR_SLOW
    parts = {
        "noise": float(sd[0]), "method": R * math.hypot(floor, by_noise),
        "angles": float(np.std(found.x[:n], ddof=1)) / math.sqrt(n) if n > 1 else 0.0, "heating": heating,
    }  # fmt: skip
    U = 0.75 * offset
    U_parts = {
        "noise": 0.75 * float(sd[1]), "method": abs(U) * FLOOR_U + by_noise * R * FULL * i_max,
        "heating": 0.75 * heating_offset,
    }  # fmt: skip
    to_time = T / u_dc
    quantities = (
        Quantity("R_s", "Ω", R, parts, volts=1.0, amperes=-1.0),
        Quantity("U_dead", "V", U, U_parts, volts=1.0),
        Quantity("t_dead", "s", U * to_time, {name: part * to_time for name, part in U_parts.items()}),
        *(Quantity(f"gain_{name}", "1", float(gain), {"noise": float(s)})
          for name, gain, s in zip("abc", gains, gains_sd, strict=True)),
    )  # fmt: skip
    figures = {
        "R": R, "offset": offset, "warming": warming, "cooling": likely.time, "warmed_by": warming * heat.max() / R,
        "windows": float(len(held)), "windows_at_rest": float(still.sum()),
        "inflation": found.inflation(), "naive_R": R + offset / (0.5 * i_max),
        **{f"sd_{name}": float(s) for name, s in zip(("R", "offset", "warming"), sd, strict=True)},
    }  # fmt: skip
    evidence = Evidence("Resistance, and the dead time's volts", _panels(of, i, full, likely), figures)
    return Winding(R, gains, max(U, 0.0) * to_time, Outcome(quantities, evidence, tuple(_remarks(figures))))


@dataclass(frozen=True)
class _Cooling:
    """A fit with one time of cooling, s, and how much it counts among them."""

    time: float
    heat: Floats
    fit: Fit
    share: float


def _coolings(of: _Levels, i: Floats, full: Booleans) -> list[_Cooling]:
    """A fit for each time; its share falls with the sum of its squares over the best one's scatter."""
    weights = 1.0 / np.maximum(of.sd, LEAST_SD)
    fits = []
    for heat in of.heats.T:
        A = of.columns(i, heat, of.angles(full))
        try:
            fits.append(fit(A[full], of.u[full], weights[full]))
        except ValueError as error:
            raise Refused(STEP, f"the levels of current do not tell R: {error}") from None
    squares = np.array([float(each.residuals @ each.residuals) for each in fits])
    scatter = max(float(squares.min()), 1e-300) / max(int(full.sum()) - 4, 1)
    shares = np.exp(-0.5 * (squares - squares.min()) / scatter)
    shares = shares / shares.sum()
    times = COOLING[: len(fits)]
    return [
        _Cooling(float(time), heat, each, float(share))
        for time, heat, each, share in zip(times, of.heats.T, fits, shares, strict=True)
    ]


def _remarks(figures: dict[str, float]) -> list[str]:
    remarks = []
    if abs(figures["warmed_by"]) > 0.01:
        kelvin = figures["warmed_by"] / 0.0039
        remarks.append(
            f"the winding warmed by about {kelvin:.1f} K meanwhile; R_s is that of before, {figures['R']:.4g} ohm"
        )
    return remarks


def _panels(of: _Levels, i: Floats, full: Booleans, likely: _Cooling) -> tuple[Panel, ...]:
    x, n = likely.fit.x, (len(likely.fit.x) - 1) // 2
    R, offset, warming = float(x[:n].mean()), float(x[n : 2 * n].mean()), float(x[-1])
    order = np.argsort(i)
    line = np.array([0.0, float(i.max())])
    cold = of.u - warming * i * likely.heat
    weight = 1.0 / np.maximum(of.sd, LEAST_SD)[full]
    shape = (cold - R * i) / offset if offset else np.zeros_like(i)
    return (
        Panel("d current", "A", "d voltage, heating taken out", "V",
              {"levels": (i[order], cold[order]), "fit": (line, R * line + offset)}),
        Panel("d current", "A", "residuals", "V", {"levels": (i[full], likely.fit.residuals / weight)}),
        Panel("d current", "A", "dead time's volts, share", "1", {"levels": (i[order], shape[order])}),
    )  # fmt: skip


def perform(stand: Stand) -> Outcome:
    """Hold the levels, and tell the stand and the drive's current loop what follows."""
    taken = []
    if stand.held:
        stand.set(bw_current=min(CALM, stand.rig.drive.parameters["bw_current"]))
    with stand.running():
        stand.keep(len(PASSES) * PASS, LOOK, EDGES_PER_S)
        for angle in PASSES:
            stand.turn_to(angle)
            stand.ramp(0.1 * stand.i_max, ALIGNED * stand.i_max, 0.24)
            _come_to_rest(stand)
            for share in LEVELS[::-1]:  # downwards: a small current lets the rotor go, which then swings
                stand.current(float(share) * stand.i_max)
                stand.wait(SETTLE)
                heat = stand.heat()
                with stand.stretch("forced") as each:
                    stand.wait(MEASURE)
                taken.append((each, heat))
            stand.current(0.0)
            stand.wait(0.02)
    held = [Held(window, stand.heat_of(window, heat)) for each, heat in taken if (window := each.window) is not None]
    found = analyse(held, stand.i_max, stand.noise)
    stand.R, stand.gains, stand.dead_time = found.R, found.gains, found.dead_time
    stand.set(R_s_hat=found.R)
    return found.outcome


def _come_to_rest(stand: Stand) -> None:
    """Wait until the rotor has stopped swinging, by the back-EMF across the current; LONGEST s at most."""
    still = AT_REST * stand.R * ALIGNED * stand.i_max + LEAST_SD
    for _ in range(round(LONGEST / LOOK)):
        stand.wait(0.5 * LOOK)
        across = stand.look(0.5 * LOOK).u_dq.imag
        blocks = across[: len(across) // BLOCKS * BLOCKS].reshape(BLOCKS, -1)
        noise = float(np.std(np.diff(across))) / math.sqrt(2.0 * blocks.shape[1])
        if float(np.ptp(blocks.mean(axis=1))) < still + NOISY * noise:
            return


def announcement(agreed: Envelope) -> str:
    """What will be done, within what was agreed to."""
    most = LEVELS.max() * agreed.current
    return (
        f"{len(LEVELS)} levels of d current up to {most:.3g} A, twice at each of three angles, "
        f"about {len(PASSES) * (len(LEVELS) * (SETTLE + MEASURE) + 1.0):.0f} s; the shaft moves to each angle"
    )
