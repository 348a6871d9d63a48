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
from dataclasses import dataclass

import numpy as np

from bench.commission.analysis.flux import Flux, compensated
from bench.commission.analysis.stretches import merged
from bench.commission.least_squares import Fit, fit
from bench.commission.quantity import Quantity
from bench.commission.refusal import Refused
from bench.commission.window import Booleans, Floats, Integers, Window
from bench.signal.position import unwrapped

STEP = "mechanics"
INERTIA_FLOOR, INERTIA_FLOOR_LIGHT = 3.5e-3, 6.5e-3
"""Of J, sd: what would have covered 95 % of the trial's unkind benches, and of those with a bare rotor."""
FRICTION_FLOOR, FRICTION_FLOOR_LIGHT = 3e-3, 9e-3
"""Of b and of dry friction, sd, likewise: cogging, and an encoder's disc that is uneven."""
LIGHT = 5e-3
"""s, mechanical time constant J R / (1.5 n_p^2 psi^2), about which a rotor counts as bare: cogging swings it."""
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


def moments(windows: Sequence[Window], found: Flux, L_q: float, n_p: int) -> Moments:
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
        w = np.interp(np.arange(len(angle)), *np.array(every).T) * n_p
        way = math.copysign(1.0, float(w.mean()))
        told = [(k, omega) for k, omega in every if omega * way * n_p > SLOW * fastest]
        i = window.current * np.exp(-1j * (angle - found.error(w)))
        i_q = i.imag * (1.0 + salient * i.real)
        charge = np.concatenate([[0.0], np.cumsum(0.5 * (i_q[1:] + i_q[:-1]))]) * window.T
        if len(told) < LEAST_IN_RUN:
            continue
        first, on = told[0][0], window.kind != "off"
        rows += [
            (number, omega, float(angle[k] - angle[first]) / n_p, math.copysign((k - first) * window.T, omega), on,
             on * float(charge[k] - charge[first]))
            for k, omega in told
        ]  # fmt: skip
    columns = np.array(rows, float).reshape(-1, 6).T
    return Moments(columns[0].astype(np.int64), columns[1], columns[2], columns[3], columns[4] > 0.0, columns[5])


def _ends(theta: Floats, T: float) -> tuple[float, float]:
    """Mean sizes of the speed at both ends of a run, rad/s, by an unwrapped angle."""
    n = max(1, min(len(theta) - 1, round(SPACE / T)))
    if len(theta) < 2:
        return 0.0, 0.0
    return abs(float(theta[n] - theta[0])) / (n * T), abs(float(theta[-1] - theta[-1 - n])) / (n * T)


def _speeds(theta: Floats, T: float, n_p: int) -> list[tuple[int, float]]:
    """Samples of a run and the speed of the shaft at each, rad/s, by a line around it; `theta`: the shaft's angle."""
    n, settle, least = len(theta), round(SETTLE / T), round(LEAST_SLOPE / T)
    space = max(1, round(min(SPACE, (n - settle) * T / MOMENTS) / T))
    found = []
    for k in range(settle + least, n - least, space):
        rough = abs(float(theta[k + least] - theta[k - least])) / (2 * least * T) * n_p
        half = round(min(max(LEAST_SLOPE, math.pi / max(rough, 1.0)), MOST_SLOPE) / T)
        if settle <= k - half and k + half < n:
            t = np.arange(-half, half + 1) * T
            found.append((k, float(t @ theta[k - half : k + half + 1]) / float(t @ t)))
    return found


def mechanics(
    windows: Sequence[Window], found: Flux, R: Quantity, L_q: Quantity, n_p: int, usual: Quantity | None = None
) -> Mechanics:
    """J, friction, and how late currents are sampled, of windows with an angle: driven by a q current, and "off".

    `usual`: what is known of that lateness beforehand, s. Refused where too few pieces of each kind were long enough.
    """
    seen = moments(windows, found, L_q.value, n_p)
    each = [int(np.count_nonzero((seen.up == up) & (seen.on == on))) for up in (True, False) for on in (True, False)]
    if min(each) < LEAST_EACH:
        raise Refused(
            STEP,
            f"speeds were told at {each[0]} and {each[2]} moments driven, forward and in reverse, and at {each[1]} and "
            f"{each[3]} coasting; {LEAST_EACH} are needed: accelerate with less torque, and let it coast longer",
        )
    k_t = 1.5 * n_p * found.psi.value
    told = fit(seen.columns(), k_t * seen.charge)
    if usual is not None:
        by = L_q.value / (k_t * n_p * found.psi.value)
        told = told.informed(LAG, usual.value / by, usual.sd / by)
    noise = told.sd * told.inflation()
    late = _late(told, noise, k_t, n_p, found.psi.value, L_q)
    flux = compensated(found, R, L_q, late)
    scale = flux.psi.value / found.psi.value
    x, noise = told.x * scale, noise * scale
    ways, shape = _ways(seen, k_t, told.x) * scale, _shape(seen, k_t, told) * scale
    share = flux.psi.sd / flux.psi.value
    time_constant = max(float(x[0]), 0.0) * R.value / (1.5 * n_p**2 * flux.psi.value**2)
    light = 1.0 / (1.0 + (time_constant / LIGHT) ** 2)
    dry = FRICTION_FLOOR + (FRICTION_FLOOR_LIGHT - FRICTION_FLOOR) * light
    inertia = INERTIA_FLOOR + (INERTIA_FLOOR_LIGHT - INERTIA_FLOOR) * light

    def quantity(name: str, unit: str, value: float, own: float, floor: float, **more: float) -> Quantity:
        size = abs(value)
        return Quantity(
            name, unit, value, {"noise": own, "psi": share * size, "method": floor * size, **more}, 1.0, 1.0
        )

    friction = 0.5 * float(x[UP] + x[DOWN])
    spread = told.covariance[UP, UP] + told.covariance[DOWN, DOWN] + 2.0 * told.covariance[UP, DOWN]
    both = 0.5 * math.sqrt(max(0.0, float(spread))) * told.inflation() * scale
    refused = _one_way(float(x[UP]), float(x[DOWN]), math.hypot(noise[UP], noise[DOWN]) / 2.0)
    loss = -float(x[LAG]) if -x[LAG] > SURE * noise[LAG] else 0.0
    return Mechanics(
        quantity("J", "kg m2", float(x[0]), float(noise[0]), inertia, ways=ways[0], shape=shape[0]),
        quantity("b", "N m s", float(x[1]), float(noise[1]), dry, ways=ways[1], shape=shape[1], **{"iron loss": loss}),
        None if refused else quantity("tau_c", "N m", friction, both, dry, ways=ways[2], shape=shape[2]),
        (
            quantity("tau_up", "N m", float(x[UP]), float(noise[UP]), dry, shape=shape[2]),
            quantity("tau_down", "N m", float(x[DOWN]), float(noise[DOWN]), dry, shape=shape[2]),
        ),
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


def _late(told: Fit, noise: Floats, k_t: float, n_p: int, psi: float, L_q: Quantity) -> Quantity:
    """How late currents are sampled, s, 0 at least; `noise`: standard deviations of what was fitted."""
    by = L_q.value / (k_t * n_p * psi)
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
    """Half of what J, b and friction, shape (3,), change by where friction is seen to bend with the speed; else 0."""
    bend = np.zeros(len(seen))
    for run in np.unique(seen.run):
        own = seen.run == run
        way, omega = seen.way[own], seen.omega[own]
        bend[own] = np.concatenate([[0.0], np.cumsum(0.5 * np.abs(omega[1:] + omega[:-1]) * np.diff(way))])
    try:
        other = fit(np.column_stack([seen.columns(), bend]), k_t * seen.charge)
    except ValueError:  # of one speed: nothing tells a bend
        return np.zeros(3)
    if abs(float(other.x[-1])) < SURE * float(other.sd[-1]) * other.inflation():
        return np.zeros(3)
    change = np.abs(other.x[:-1] - told.x)
    friction = abs(float(np.mean(other.x[[UP, DOWN]] - told.x[[UP, DOWN]])))
    return 0.5 * np.array([change[0], change[1], friction])
