"""A rotor that a d current drags through an angle that is made, a turn and more, both ways.

By the encoder: pole pairs, its direction, a rough zero. The rotor stays behind the angle by what friction needs, one
way as the other: the mean of both ways is free of it, and half their difference is the lag.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bench.commission.analysis.stretches import merged
from bench.commission.least_squares import fit
from bench.commission.quantity import Quantity
from bench.commission.refusal import Refused
from bench.commission.window import Floats, Window
from bench.findings.finding import degrees
from bench.signal.hall_edges import mean_angle
from bench.signal.position import unwrapped, wrapped

STEP = "turn"
FOLLOWS = 0.25
"""Share of the way of a shaft with the most pole pairs, below which it does not follow."""
MOST_PAIRS = 70
"""Electrical turns in one of the shaft, beyond which no motor is looked for."""
WHOLE = 0.1
"""Electrical turns in one of the shaft, by which they may differ from a whole number, and one way from the other."""
LAG_KEPT = 0.25
"""Of the lag of both ways together, sd of the rough zero: friction need not be alike both ways."""
ZERO_FLOOR = 0.01
"""rad, sd of the rough zero: cogging holds the rotor back by places."""
SAMPLES = 2000
"""That the number of electrical turns is told by, evenly spread."""
COUNTS, COARSE = 4.0, 5e-3
"""Counts by which an encoder may move from sample to sample beside the flux, and rad of one where nobody tells."""
PLACES = 400
"""Places of a turn, of which both ways must have been at the same ones."""


@dataclass(frozen=True)
class Dragged:
    """What dragged turns tell by an encoder."""

    n_p: int
    ratio: Quantity
    """Name `n_p`: electrical turns in one of the shaft, as measured."""
    direction: int
    """1, or -1 where the encoder counts down while the angle goes up."""
    zero: Quantity
    """rad, name `encoder_zero`: what that parameter should be, with n_p and direction as found; rough."""
    lag: Quantity
    """rad, electrical, by which the rotor stays behind the angle that drags it."""

    @property
    def share(self) -> float:
        """Of the current that drags: what it takes to turn the shaft."""
        return abs(math.sin(self.lag.value))


def dragged(
    up: Sequence[Window], down: Sequence[Window], n_p: int = 1, encoder_zero: float = 0.0, lines: int = 0
) -> Dragged:
    """Pole pairs, direction, zero and lag of windows dragged forward and in reverse, at one speed each.

    `n_p` and `encoder_zero`, rad: the drive's parameters meanwhile. `lines` of the encoder, for what is said of them;
    0: not known. Refused where the shaft did not follow, and where its turns are not a whole number of electrical ones.
    """
    ways = [_shaft(windows, n_p, encoder_zero) for windows in (up, down)]
    ratios = []
    for shafts in ways:
        control = sum(abs(float(each[-1] - each[0])) for each, _ in shafts)
        shaft = sum(abs(float(each[-1] - each[0])) for _, each in shafts)
        if shaft < FOLLOWS * control / MOST_PAIRS:
            raise Refused(
                STEP,
                f"the shaft does not follow: the flux turned by {control / math.tau:.2f} electrical turns, the shaft "
                f"by {degrees(shaft)}: it is blocked, or there is no encoder",
            )
        ratios.append(_ratio(shafts))
    (forward, error_f), (reverse, error_r) = ratios
    ratio, apart = 0.5 * (abs(forward) + abs(reverse)), 0.5 * abs(abs(forward) - abs(reverse))
    found = round(ratio)
    if found < 1 or abs(ratio - found) > WHOLE or 2.0 * apart > WHOLE or forward * reverse < 0.0:
        raise Refused(
            STEP,
            f"{ratio:.2f} electrical turns in one of the shaft ({abs(forward):.2f} forward, {abs(reverse):.2f} in "
            f"reverse): the shaft slips, or the encoder's lines are not {lines or 'as the drive has them'}",
        )
    direction = 1 if forward > 0.0 else -1
    middle, lag, scatter = _zero(ways, direction * found)
    parts = {"noise": scatter, "friction": 2.0 * LAG_KEPT * abs(lag), "method": ZERO_FLOOR}
    return Dragged(
        found,
        Quantity("n_p", "", ratio, {"noise": 0.5 * math.hypot(error_f, error_r), "ways": apart}),
        direction,
        Quantity("encoder_zero", "rad", wrapped(-middle), parts),
        Quantity("lag", "rad", lag, {"noise": scatter, "method": ZERO_FLOOR}),
    )


def rough_flux(windows: Sequence[Window], L: float, current: float) -> float:
    """V s of the rotor, at least 0, by the voltage across the `current`, A, that drags it at one speed in each window.

    L in H. What resistance and dead time take lies along the current.
    """
    told = []
    for window in windows:
        angle = unwrapped(window.control)
        w = float(angle[-1] - angle[0]) / (window.dt * max(len(angle) - 1, 1))
        told.append(float(window.u_dq.imag.mean()) / w if w else 0.0)
    return max(float(np.mean(told)) - L * current, 0.0)


def jump(windows: Sequence[Window], lines: int) -> float:
    """rad by which the encoder's angle jumps, at most, from one sample to the next; 0.0 for no more than counts.

    With the drive's n_p at 1 meanwhile, so that this is the shaft. A counter jumps where its index sets it right.
    """
    largest = 0.0
    count = math.tau / (4 * lines) if lines else COARSE
    for window in windows:
        moved = np.diff(unwrapped(np.asarray(window.theta)))
        made = float(np.abs(np.diff(unwrapped(window.control))).max(initial=0.0))
        most = float(np.abs(moved).max(initial=0.0))
        largest = max(largest, most if most > made + COUNTS * count else 0.0)
    return largest


def _shaft(windows: Sequence[Window], n_p: int, encoder_zero: float) -> list[tuple[Floats, Floats]]:
    """Angle that was made, electrical, and the shaft's, unwrapped, of each stretch; Refused without an encoder."""
    found = []
    for window in merged(windows, by_command=False):
        if window.theta is None:
            raise Refused(STEP, "there is no encoder's angle: pole pairs cannot be found without one")
        if len(window) > 1:
            found.append((unwrapped(window.control), (unwrapped(np.asarray(window.theta)) - encoder_zero) / n_p))
    if not found:
        raise Refused(STEP, "no samples came while the shaft was dragged")
    return found


def _ratio(shafts: Sequence[tuple[Floats, Floats]]) -> tuple[float, float]:
    """Electrical turns in one of the shaft, below 0 where it turns the other way, and the standard error."""
    rows, y = [], []
    every = max(1, sum(len(shaft) for _, shaft in shafts) // SAMPLES)
    for number, (control, shaft) in enumerate((each[::every], other[::every]) for each, other in shafts):
        level = np.zeros((len(shaft), len(shafts)))
        level[:, number] = 1.0
        rows.append(np.column_stack([control, level]))
        y.append(shaft)
    told = fit(np.concatenate(rows), np.concatenate(y))
    slope = float(told.x[0])
    # the rotor sways about the angle as it passes the places of cogging: neighbouring samples err alike
    error = float(told.sd[0]) * told.inflation(most=len(told.residuals) // 4)
    return 1.0 / slope if slope else math.inf, error / slope**2 if slope else math.inf


def _zero(ways: Sequence[Sequence[tuple[Floats, Floats]]], pairs: int) -> tuple[float, float, float]:
    """Where the rotor is when the encoder's angle is 0, the lag, and the standard error of both, rad."""
    both = []
    for shafts in ways:
        control, shaft = (np.concatenate([each[k] for each in shafts]) for k in (0, 1))
        place = np.floor(shaft % math.tau / math.tau * PLACES).astype(np.int64) % PLACES
        unit = np.exp(1j * (pairs * shaft - control))
        n = np.bincount(place, minlength=PLACES)
        sums = np.bincount(place, unit.real, PLACES) + 1j * np.bincount(place, unit.imag, PLACES)
        both.append(np.where(n > 0, sums / np.maximum(n, 1), np.nan))
    met = np.isfinite(both[0]) & np.isfinite(both[1])
    if not met.any():
        raise Refused(STEP, "both ways were at no common place of the shaft: drag it by a whole turn each way")
    forward, reverse = (float(np.angle(each[met].mean())) for each in both)
    middle = np.angle(both[0][met] / np.abs(both[0][met]) + both[1][met] / np.abs(both[1][met]))
    scatter = float(np.std(np.angle(np.exp(1j * (middle - mean_angle(middle)))))) / math.sqrt(max(1, met.sum() / 10))
    return mean_angle(np.array([forward, reverse])), 0.5 * wrapped(reverse - forward), scatter
