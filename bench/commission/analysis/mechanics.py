"""Inertia and friction by the shaft's own motion: driven up, then coasting with the outputs off, both ways.

From the first moment of a run of one command on, the impulse of the torque is, with k_t = 1.5 n_p psi,

    k_t sum(i_q T) = J w + b theta + tau_+ t_+ + tau_- t_- - delta theta (with outputs on) + a level of the run

with a friction of its own for each way, so that a load that acts one way does not become inertia. delta is a current
that goes with the speed and that the sensors do not show: they are sampled late, while no voltage lies on the winding,
and lack w psi late / L_q. A coasting rotor has none of it, which tells it from b. Iron loss is friction that goes with
the speed, and in b; what of it is there with the outputs on only is in delta with the other sign, and widens b.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from bench.commission.analysis.back_emf import UNKNOWN_LATE
from bench.commission.analysis.flux import Flux, compensated
from bench.commission.analysis.harmonics import Harmonics, harmonics
from bench.commission.analysis.stretches import merged
from bench.commission.least_squares import Fit, fit
from bench.commission.quantity import Quantity
from bench.commission.refusal import Refused
from bench.commission.window import Booleans, Floats, Integers, Window
from bench.signal.position import unwrapped

STEP = "mechanics"
INERTIA_FLOOR = 1.2e-3
"""Of J, sd: gains of the current sensors that have drifted since they were compared."""
FRICTION_FLOOR = 1.5e-3
"""Of b and of dry friction, sd, likewise, and an encoder's disc that is uneven."""
FASTER = 0.25
"""Of the largest speed: J and friction of moments above are compared with those of all."""
LATE_FLOOR = 1e-7
"""s, sd, of how late currents are sampled."""
BELIEVED = 0.5
"""Of what late currents do to psi, sd: other things that go with the speed look like it."""
ONE_WAY = 0.3
"""Of dry friction, that half of what the two ways differ by may be at most."""
SURE = 3.0
"""Times its own noise, that what the ways differ by, and a bend of friction with the speed, must be to be believed."""
SPACE, MOMENTS = 0.02, 12
"""s from one moment to the next, and how many a short run has."""
SETTLE = 0.01
"""s after a change of the command that are left out."""
LEAST_SLOPE, MOST_SLOPE = 0.005, 0.04
"""s on either side of a moment over which its speed is taken: half an electrical turn, within these, so that cogging,
which stores energy, does not count as a change of speed."""
SLOW = 0.12
"""Of the largest speed, below which friction has another shape."""
LEAST_IN_RUN, LEAST_EACH = 3, 4
"""Moments in a run, and of each way with the outputs on and off."""
UP, DOWN, LAG, LEVELS = 2, 3, 4, 5
"""Columns of friction each way, of the current that goes with the speed and was not seen, and of the runs' levels."""


@dataclass(frozen=True)
class Moments:
    """Moments of runs with one command each, shape (m,) each, in the order of time."""

    run: Integers
    """Number of the run that it is in."""
    omega: Floats
    """rad/s of the shaft."""
    way: Floats
    """rad of the shaft since the run's first moment."""
    t: Floats
    """s since then; below 0 where it turns in reverse."""
    on: Booleans
    """Whether the outputs were on."""
    charge: Floats
    """A s, the integral of the current that makes torque, i_q (1 + (L_d - L_q) i_d / psi), since then; 0 with the
    outputs off."""

    def __len__(self) -> int:
        return len(self.run)

    @property
    def up(self) -> Booleans:
        """Whether it turned forward."""
        return np.asarray(self.omega > 0.0)

    def of(self, which: Booleans) -> Moments:
        """Some of them."""
        return Moments(*(getattr(self, name)[which] for name in Moments.__annotations__))

    def columns(self) -> Floats:
        """J, b, friction each way, the current that goes with the speed, and a level of each run: shape (m, k)."""
        level = (self.run[:, None] == np.unique(self.run)).astype(float)
        each_way = (self.t * self.up, self.t * ~self.up)
        return np.column_stack([self.omega, self.way, *each_way, -self.way * self.on, level])


@dataclass(frozen=True)
class Mechanics:
    """What the motion of the shaft tells."""

    J: Quantity
    b: Quantity
    """N m s."""
    friction: Quantity | None
    """N m, name `tau_c`: dry friction, the mean of both ways; None where something acts one way."""
    each_way: tuple[Quantity, Quantity]
    """N m, `tau_up` and `tau_down`: what holds the shaft back forward and in reverse, beside b."""
    late: Quantity
    """s, name `current_delay`: by which currents are sampled late."""
    flux: Flux
    """That which was given, with the late currents put right."""
    refused: tuple[Refused, ...]
    """What is not claimed, and why."""
    moments: Moments
    fitted: Fit
    """Over the moments: residuals in N m s."""


def moments(windows: Sequence[Window], found: Flux, beside: Harmonics, L_q: float, n_p: int) -> Moments:
    """Moments of windows with the outputs off, or with a q current alone; `found`: where the flux is; L_q in H."""
    rows: list[tuple[float, ...]] = []
    salient = (found.L_d.value - L_q) / found.psi.value
    runs = [w for w in merged(windows) if w.theta is not None and (w.kind == "off" or not w.i_ref.real)]
    fastest = max((max(_ends(unwrapped(np.asarray(w.theta)), w.T)) for w in runs), default=0.0)
    for number, window in enumerate(runs):
        angle = unwrapped(np.asarray(window.theta))
        every = _speeds(angle / n_p, window.T, n_p)
        if not every:
            continue
        w = np.interp(np.arange(len(angle)), [each.at for each in every], [each.omega for each in every]) * n_p
        way = math.copysign(1.0, float(w.mean()))
        told = [each for each in every if each.omega * way * n_p > SLOW * fastest]
        at = angle - found.error(w)
        i = window.current * np.exp(-1j * at)
        straight = np.sinc(0.5 * w * window.T / math.pi) ** 2  # between two samples the current cuts the corner
        i_q = straight * (beside.torque_current(at, i) + i.imag * salient * i.real)
        charge = np.concatenate([[0.0], np.cumsum(0.5 * (i_q[1:] + i_q[:-1]))]) * window.T
        if len(told) < LEAST_IN_RUN:
            continue
        first, on = told[0], window.kind != "off"
        rows += [
            (number, each.omega, (each.mean(angle) - first.mean(angle)) / n_p,
             math.copysign((each.at - first.at) * window.T, each.omega), on,
             on * (each.mean(charge) - first.mean(charge)))
            for each in told
        ]  # fmt: skip
    columns = np.array(rows, float).reshape(-1, 6).T
    return Moments(columns[0].astype(np.int64), columns[1], columns[2], columns[3], columns[4] > 0.0, columns[5])


def _ends(theta: Floats, T: float) -> tuple[float, float]:
    """Mean sizes of the speed at both ends of a run, rad/s, by an unwrapped angle."""
    n = max(1, min(len(theta) - 1, round(SPACE / T)))
    if len(theta) < 2:
        return 0.0, 0.0
    return abs(float(theta[n] - theta[0])) / (n * T), abs(float(theta[-1] - theta[-1 - n])) / (n * T)


@dataclass(frozen=True)
class _Moment:
    """A moment of a run: its sample, the speed of the shaft, rad/s, by a line around it, and that line's samples.

    The slope of a line is a mean of the speed that weighs by 1 - x^2. What the speed is compared with gets the same.
    """

    at: int
    omega: float
    half: int

    def mean(self, of: Floats) -> float:
        """Of a value of each sample, as the speed is a mean."""
        x = np.arange(-self.half, self.half + 1) / (self.half + 0.5)
        return float(np.average(of[self.at - self.half : self.at + self.half + 1], weights=1.0 - x**2))


def _speeds(theta: Floats, T: float, n_p: int) -> list[_Moment]:
    """Moments of a run with an unwrapped angle `theta` of the shaft, rad."""
    n, settle, least = len(theta), round(SETTLE / T), round(LEAST_SLOPE / T)
    space = max(1, round(min(SPACE, (n - settle) * T / MOMENTS) / T))
    found = []
    for k in range(settle + least, n - least, space):
        rough = abs(float(theta[k + least] - theta[k - least])) / (2 * least * T) * n_p
        half = round(min(max(LEAST_SLOPE, math.pi / max(rough, 1.0)), MOST_SLOPE) / T)
        if settle <= k - half and k + half < n:
            t = np.arange(-half, half + 1) * T
            found.append(_Moment(k, float(t @ theta[k - half : k + half + 1]) / float(t @ t), half))
    return found


def mechanics(
    windows: Sequence[Window], found: Flux, R: Quantity, L_q: Quantity, n_p: int, falls: float = 0.0,
    usual: Quantity | None = None, rough: float = 0.0,
) -> Mechanics:  # fmt: skip
    """J, friction, and how late currents are sampled, of windows with an angle: driven by a q current, and "off".

    `falls`, 1/A: share by which a d current lessens L_q. If that is one axis that saturates the other, a q current
    lessens the flux by as much, and its torque is less than psi says. `usual`: what is known of the lateness
    beforehand, s; `rough`: what the angle leaves of inertia and friction, relative, sd. Late currents are as much too
    small as psi is too large by them, so the torque needs neither put right. Refused where too few pieces of each kind
    were long enough.
    """
    beside = harmonics(windows, found, R.value, L_q.value)
    seen = moments(windows, found, beside, L_q.value, n_p)
    each = [int(np.count_nonzero((seen.up == up) & (seen.on == on))) for up in (True, False) for on in (True, False)]
    if min(each) < LEAST_EACH:
        raise Refused(
            STEP,
            f"speeds were told at {each[0]} and {each[2]} moments driven, forward and in reverse, and at {each[1]} and "
            f"{each[3]} coasting; {LEAST_EACH} are needed: accelerate with less torque, and let it coast longer",
        )
    k_t = 1.5 * n_p * found.psi.value
    told = fit(seen.columns(), k_t * seen.charge)
    by = L_q.value / (k_t * n_p * found.psi.value)
    if usual is not None:
        told = told.informed(LAG, usual.value / by, usual.sd / by)
    noise = told.sd * told.inflation()
    late = _late(told, noise, by, L_q)
    flux, x = compensated(found, R, L_q, late), told.x
    ways, shape = _ways(seen, k_t, x), _shape(seen, k_t, told)
    more = _implausible(seen, k_t, told, by)
    driven = [abs(w.i_ref.imag) for w in windows if w.i_ref.imag]
    crossed = 0.5 * L_q.value * abs(falls) * float(np.mean(np.square(driven))) / found.psi.value
    share = flux.psi.sd / flux.psi.value

    def quantity(name: str, unit: str, value: float, own: float, floor: float, **parts: float) -> Quantity:
        size = abs(value)
        common = {"noise": own, "psi": share * size, "cross-saturation": crossed * size, "method": floor * size}
        common["angle"] = rough * size
        return Quantity(name, unit, value, common | parts, 1.0, 1.0)

    friction = 0.5 * float(x[UP] + x[DOWN])
    spread = told.covariance[UP, UP] + told.covariance[DOWN, DOWN] + 2.0 * told.covariance[UP, DOWN]
    both = 0.5 * math.sqrt(max(0.0, float(spread))) * told.inflation()
    refused = _one_way(float(x[UP]), float(x[DOWN]), math.hypot(noise[UP], noise[DOWN]) / 2.0)
    loss = -float(x[LAG]) if -x[LAG] > SURE * noise[LAG] else 0.0
    J, b = (float(value) for value in x[:2])
    up, down = (
        quantity(
            name, "N m", float(x[at]), float(noise[at]), FRICTION_FLOOR, shape=shape[2], **{"late currents": more[2]}
        )
        for name, at in (("tau_up", UP), ("tau_down", DOWN))
    )
    of_J, of_b, of_dry = (
        {"ways": w, "shape": of, "late currents": lag} for w, of, lag in zip(ways, shape, more, strict=True)
    )
    return Mechanics(
        quantity("J", "kg m2", J, float(noise[0]), INERTIA_FLOOR, **of_J),
        quantity("b", "N m s", b, float(noise[1]), FRICTION_FLOOR, **of_b, **{"iron loss": loss}),
        None if refused else quantity("tau_c", "N m", friction, both, FRICTION_FLOOR, **of_dry),
        (up, down),
        late, flux, refused, seen, told,
    )  # fmt: skip


def _one_way(up: float, down: float, noise: float) -> tuple[Refused, ...]:
    """Why friction is not claimed, of what holds the shaft back each way, N m; `noise`: of half their difference."""
    half = 0.5 * abs(up - down)
    if half <= ONE_WAY * 0.5 * abs(up + down) or half <= SURE * noise:
        return ()
    return (
        Refused(
            STEP,
            f"friction not claimed: the two ways differ, something acts one way; forward takes {1e3 * up:.3g} mN m and "
            f"reverse {1e3 * down:.3g} mN m: take the load off, or lay the shaft level",
        ),
    )


def _late(told: Fit, noise: Floats, by: float, L_q: Quantity) -> Quantity:
    """How late currents are sampled, s, 0 at least; `noise`: sd of what was fitted; `by`: s per N m s."""
    value = max(0.0, float(told.x[LAG]) * by)
    parts = {
        "noise": float(noise[LAG]) * by,
        "L_q": value * L_q.sd / L_q.value,
        "method": LATE_FLOOR,
        "else": BELIEVED * value,
    }
    return Quantity("current_delay", "s", value, parts)


def _ways(seen: Moments, k_t: float, x: Floats) -> Floats:
    """Half of what the two ways differ by in J, b and friction, shape (3,), beyond the noise."""
    halves = []
    for up in (True, False):
        own = seen.of(seen.up == up)
        A = own.columns()
        keep = np.concatenate([[0, 1, UP if up else DOWN], np.arange(LEVELS, A.shape[1])])
        halves.append(fit(A[:, keep], k_t * own.charge + x[LAG] * own.way * own.on))
    difference = 0.5 * np.abs(halves[0].x[:3] - halves[1].x[:3])
    scatter = 0.5 * np.hypot(*(half.sd[:3] * half.inflation() for half in halves))
    return np.asarray(np.sqrt(np.maximum(difference**2 - scatter**2, 0.0)))


def _shape(seen: Moments, k_t: float, told: Fit) -> Floats:
    """By how much J, b and friction, shape (3,), hang on the shape that friction is taken for; 0 where nothing shows.

    Half of what they change by where friction is seen to bend with the speed, and all of what they change by without
    the slowest moments, beyond the noise.
    """
    bend = np.zeros(len(seen))
    for run in np.unique(seen.run):
        own = seen.run == run
        way, omega = seen.way[own], seen.omega[own]
        bend[own] = np.concatenate([[0.0], np.cumsum(0.5 * np.abs(omega[1:] + omega[:-1]) * np.diff(way))])
    changes = [np.zeros(3)]
    with suppress(ValueError):  # of one speed: nothing tells a bend
        other = fit(np.column_stack([seen.columns(), bend]), k_t * seen.charge)
        if abs(float(other.x[-1])) > SURE * float(other.sd[-1]) * other.inflation():
            changes.append(0.5 * np.abs(_three(other.x) - _three(told.x)))
    fast = seen.of(np.abs(seen.omega) > FASTER * np.abs(seen.omega).max())
    with suppress(ValueError):
        other = fit(fast.columns(), k_t * fast.charge)
        noise = _three(other.sd) * other.inflation()
        changes.append(np.sqrt(np.maximum((_three(other.x) - _three(told.x)) ** 2 - noise**2, 0.0)))
    return np.asarray(np.max(changes, axis=0))


def _implausible(seen: Moments, k_t: float, told: Fit, by: float) -> Floats:
    """What J, b and friction, shape (3,), change by if currents are not later than drives have them; `by`: s per N m s.

    Other things that go with the speed and are there with the outputs on only, such as iron loss, look like them.
    """
    lag = float(told.x[LAG])
    held = min(max(lag, 0.0), (UNKNOWN_LATE.value + 2.0 * UNKNOWN_LATE.sd) / by)
    if held == lag:
        return np.zeros(3)
    others = np.delete(seen.columns(), LAG, axis=1)
    other = fit(others, k_t * seen.charge + held * seen.way * seen.on)
    return np.abs(_three(other.x) - _three(told.x))


def _three(x: Floats) -> Floats:
    """J, b, and the mean of friction each way."""
    return np.array([x[0], x[1], 0.5 * (x[UP] + x[DOWN])])
