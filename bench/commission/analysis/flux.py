"""Flux linkage, inductances at speed, and the encoder's zero and delay, by the voltage behind the resistance.

A current of +I and then of -I flows on d while the rotor turns. Over a PWM period the stator flux changes by the
voltage's integral less that of R i. In the rotor's frame, turned by the angle in the middle of the period,

    v_d = -w s (L_q i_q - e (psi + (L_d - L_q) i_d)) + r i_d,    v_q = w s (psi + L_d i_d) + r i_q

with s = sin x / x, x = w T / 2; e, rad, by which the encoder's angle is ahead of the rotor flux; and r, what R is wrong
by and what dead time takes: that lies along the current, which is on d, so psi is free of it. The pair of currents
takes L_d i_d out of psi. The frame is turned by the e that was found until nothing is left of it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bench.commission.analysis.stretches import PART, merged, parts
from bench.commission.least_squares import Fit, fit
from bench.commission.quantity import Quantity
from bench.commission.refusal import Refused
from bench.commission.window import Booleans, Floats, Window
from bench.signal.position import unwrapped, wrapped

STEP = "flux"
ALONG_D = ("d+", "d-")
FLUX_FLOOR = 1e-3
"""Of psi, sd: drift of the current sensors, warming."""
LATE_COMPENSATION = 3.0
"""PWM periods, sd: that times dead time's volts and the share of harmonic currents is what they leave of psi. A drive
compensates a period and a half late; where harmonics move the zeros of the phases, that is not along the current."""
SIXTH = (-6, 6)
"""Turns in the rotor's frame per electrical turn of the currents of the 5th and 7th harmonic."""
L_D_FLOOR = 8e-3
"""Of L_d at speed, sd, likewise: saturation is not alike for both signs of the current."""
L_Q_FLOOR = 2e-2
"""Of L_q under torque, sd, likewise: an error of the angle looks like a part of L_q i_q."""
ZERO_FLOOR = math.radians(0.06)
"""rad, sd, of the zero, likewise: an encoder's disc is uneven and not centred, n_p times that in electrical angle."""
DELAY_FLOOR = 2e-7
"""s, sd, of the encoder's delay: iron loss and the lateness of the current sensors look like one."""
SHORT = 0.01
"""s of a part under torque, about: a rotor does not stand that for long."""
SETTLE = 5e-3
"""s after a change of the command that are left out."""
STEADY = 0.04
"""Of the commanded current, by which the mean of a part's second half may differ from that of the first."""
MET = 0.1
"""Of the commanded current, by which the mean of a part may be off."""
FAST = 0.2
"""Of the largest speed, below which a part tells nothing."""
LEAST_PARTS, LEAST_TORQUE = 3, 4
"""Parts with each sign of the current, and under torque."""
TURNS = 6
"""Times that the frame is turned at most; each time leaves a small part of the error before."""


@dataclass(frozen=True)
class Rows:
    """Means over parts of windows, shape (m,) each, in the frame of an angle, electrical."""

    w: Floats
    """rad/s, by the encoder."""
    shrink: Floats
    """sin x / x."""
    v: Floats
    """V, shape (m, 2): d and q."""
    i: Floats
    """A, shape (m, 2): d and q."""

    @property
    def ws(self) -> Floats:
        """rad/s: speed times sin x / x."""
        return self.w * self.shrink

    def of(self, which: Booleans) -> Rows:
        """Some of them."""
        return Rows(self.w[which], self.shrink[which], self.v[which], self.i[which])


@dataclass(frozen=True)
class Flux:
    """What the voltage at speed tells."""

    psi: Quantity
    L_d: Quantity
    """H, name `L_d_run`: at the current of the test, between its two signs."""
    L_q: Quantity | None
    """H, name `L_q_run`: under torque; None where no torque was held."""
    zero: Quantity
    """rad, name `encoder_zero`: what that parameter of the drive should be."""
    delay: Quantity
    """s, name `encoder_delay`: by which the encoder's angle is older than currents and voltages."""
    ahead: float
    """rad by which the encoder's angle as streamed is ahead of the rotor flux at standstill."""
    along: float
    """ohm, besides R, of what is taken along the current: dead time, and what R is wrong by."""
    fitted: Fit | None = None
    """Of psi and L_d: its residuals, V, are those of v_q; None without an encoder."""

    def error(self, w: Floats | float) -> Floats | float:
        """rad by which the encoder's angle as streamed is ahead at electrical speeds `w`, rad/s."""
        return self.ahead - self.delay.value * w


def rows(
    windows: Sequence[Window],
    R: float,
    kinds: Sequence[str],
    turned: tuple[float, float] = (0.0, 0.0),
    seconds: float = PART,
) -> Rows:
    """Means over the steady parts, of about so many seconds, of windows of these kinds, in the order of time.

    The frame is that of the encoder, turned back by `turned`: rad, and rad per rad/s. R in ohm.
    """
    found = []
    for window in merged(windows):
        if window.kind not in kinds or window.theta is None:
            continue
        begin = round(SETTLE / window.T)
        theta, current, u = unwrapped(window.theta)[begin:], window.current[begin:], window.u[begin:]
        size = max(abs(window.i_ref), 1e-9)
        for part in parts(theta, window.T, seconds) if len(theta) > 1 else ():
            th, i, n = theta[part], current[part], part.stop - part.start
            w = float(th[-1] - th[0]) / (window.T * (n - 1))
            back = np.exp(-1j * (0.5 * (th[1:] + th[:-1]) - turned[0] - turned[1] * w))
            middle = 0.5 * (i[1:] + i[:-1])
            v, i_dq = (u[part][1:] - R * middle) * back, middle * back
            changed = abs(i_dq[: n // 2].mean() - i_dq[n // 2 :].mean())
            as_streamed = i_dq.mean() * np.exp(-1j * (turned[0] + turned[1] * w))
            if changed <= STEADY * size and abs(as_streamed - window.i_ref) <= MET * size:
                found.append((w, np.sinc(0.5 * w * window.T / math.pi), v.mean(), i_dq.mean()))
    if not found:
        return Rows(np.zeros(0), np.zeros(0), np.zeros((0, 2)), np.zeros((0, 2)))
    w, shrink, v, i_dq = (np.array(column) for column in zip(*found, strict=True))
    return Rows(w, shrink, np.stack([v.real, v.imag], 1), np.stack([i_dq.real, i_dq.imag], 1))


def flux(windows: Sequence[Window], R: Quantity, L_q: Quantity, encoder_zero: float = 0.0, U_dead: float = 0.0) -> Flux:
    """Psi, L_d, L_q, zero and delay of the encoder, of windows of the kinds "d+", "d-", and "q" where there are some.

    `R`, ohm, of the phase at the temperature of these windows; `L_q`, H, at a small current; `encoder_zero`, rad: the
    drive's parameter meanwhile; `U_dead`, V, that dead time takes of a phase. Refused where there are too few steady
    windows of each sign, or of each direction.
    """
    turned, ahead, late, more_R = (0.0, 0.0), 0.0, 0.0, 0.0
    for _ in range(TURNS):
        found = _usable(rows(windows, R.value, ALONG_D, turned))
        psi, angle, base = _fits(found, L_q.value, more_R)
        settled, more_R = abs(float(angle.x[2]) - more_R) < 1e-3 * R.value, float(angle.x[2])
        ahead, late = ahead + float(angle.x[0]), late + float(angle.x[1])
        turned = (ahead, -late)
        if settled and abs(angle.x[0]) < 1e-6 and abs(angle.x[1]) * float(np.abs(found.w).max()) < 1e-6:
            break
    T = windows[0].T
    late -= ripple_delay(R.value, float(psi.x[1]), T) if psi.x[1] > 0.0 else 0.0
    noise, more = psi.sd * psi.inflation(), angle.sd * angle.inflation()
    value, L_d = float(psi.x[0]), _held(float(psi.x[1]), R.value, T)
    i_q = float(np.abs(found.i[:, 1]).mean() / np.abs(found.ws).mean())
    dead_time = LATE_COMPENSATION * T * U_dead * _swinging(windows)
    by_cause = {"noise": float(noise[0]), "R": R.sd * i_q, "dead time": dead_time, "method": FLUX_FLOOR * value}
    quantity = Quantity("psi_f", "V s", value, by_cause, 1.0)
    of_L_q = L_q.sd * float(np.abs(found.i[:, 1]).mean()) / base
    zero = Quantity(
        "encoder_zero",
        "rad",
        wrapped(encoder_zero - ahead),
        {"noise": float(more[0]), "L_q": of_L_q, "method": ZERO_FLOOR},
    )
    torque = rows(windows, R.value, ("q",), turned, SHORT)
    L_q_run = _under_torque(torque, value, zero.sd, math.hypot(float(more[1]), DELAY_FLOOR))
    return Flux(
        quantity,
        Quantity("L_d_run", "H", L_d, {"noise": float(noise[1]), "method": L_D_FLOOR * abs(L_d)}, 1.0, -1.0),
        None if L_q_run is None else replace(L_q_run, value=_held(L_q_run.value, R.value, T)),
        zero,
        Quantity("encoder_delay", "s", late, {"noise": float(more[1]), "method": DELAY_FLOOR}),
        ahead,
        more_R,
        psi,
    )  # fmt: skip


def ripple_delay(R: float, L: float, T: float) -> float:
    """s by which the rotor seems to be ahead of itself, for a voltage is held over each PWM period while it turns.

    Between two samples the current lies off the line through them by w^2 psi T^2 / 12 L in the mean, on d; what R takes
    of that turns the voltage by an angle that goes with the speed.
    """
    return R * T * T / (12.0 * L)


def _held(L: float, R: float, T: float) -> float:
    """An inductance, H, by the means of the current at both ends of each period: exact for a voltage that is held."""
    return L * (1.0 - (R * T / L) ** 2 / 12.0)


def _usable(found: Rows) -> Rows:
    """Those that are fast enough; Refused where they are too few."""
    if len(found.w):
        found = found.of(np.abs(found.w) > FAST * np.abs(found.w).max())
    if len(found.w) and abs(float(np.sign(found.w).sum())) == len(found.w):
        raise Refused(STEP, "the rotor turned one way only: zero and delay of the encoder are told by both ways")
    plus = found.i[:, 0] > 0.0 if len(found.w) else np.zeros(0, bool)
    n_plus, n_minus = int(np.count_nonzero(plus)), int(np.count_nonzero(~plus))
    if min(n_plus, n_minus) < LEAST_PARTS:
        raise Refused(
            STEP,
            f"{n_plus} steady parts with a current along the flux and {n_minus} against it were seen at speed, "
            f"{LEAST_PARTS} of each are needed: the current did not settle, or the rotor stopped too soon",
        )
    return found


def _swinging(windows: Sequence[Window]) -> float:
    """Size of the currents of the 5th and 7th harmonic beside the d current, as a share of it."""
    shares = []
    for window in merged(windows):
        begin = round(SETTLE / window.T)
        if window.kind in ALONG_D and window.theta is not None and len(window) > begin:
            theta, i = unwrapped(window.theta)[begin:], window.current[begin:]
            each = [abs(np.mean(i * np.exp(-1j * (order + 1) * theta))) for order in SIXTH]
            shares.append(sum(each) / abs(window.i_ref))
    return float(np.mean(shares)) if shares else 0.0


def _fits(found: Rows, L_q: float, more_R: float) -> tuple[Fit, Fit, float]:
    """Psi and L_d by v_q; ahead, delay and what is taken along the current, ohm, by v_d; the mean of what turns, V s.

    `more_R`: that resistance, as known before.
    """
    ws, (i_d, i_q), (v_d, v_q) = found.ws, found.i.T, found.v.T
    psi = fit(np.stack([ws, ws * i_d], 1), v_q - more_R * i_q)
    base = ws * (psi.x[0] + (psi.x[1] - L_q) * i_d)
    angle = fit(np.stack([base, -base * found.w, i_d], 1), v_d + ws * L_q * i_q)
    return psi, angle, float(np.abs(base / ws).mean())


def _under_torque(found: Rows, psi: float, zero_sd: float, delay_sd: float) -> Quantity | None:
    """L_q by v_d = -w s L_q i_q; None for fewer than `LEAST_TORQUE` parts. Both ways cancel an error of the zero."""
    if len(found.w) < LEAST_TORQUE:
        return None
    ws, i_q = found.ws, found.i[:, 1]
    told = fit((-ws * i_q)[:, None], found.v[:, 0])
    L_q = float(told.x[0])
    one_way = abs(float(np.sign(found.w * np.abs(i_q)).mean()))
    angle = math.hypot(one_way * zero_sd, float(np.abs(found.w).mean()) * delay_sd)
    parts = {
        "noise": float(told.sd[0]) * told.inflation(),
        "angle": angle * psi / float(np.abs(i_q).mean()),
        "method": L_Q_FLOOR * abs(L_q),
    }
    return Quantity("L_q_run", "H", L_q, parts, 1.0, -1.0)


def compensated(found: Flux, R: Quantity, L_q: Quantity, late: Quantity) -> Flux:
    """With currents that are sampled `late`, s: they lack w psi late / L_q on q; the resistance times that is in psi.

    The delay of the encoder, which is told by w L_q i_q, has the same lateness in it.
    """
    psi, resistance = found.psi, R.value + found.along
    by, share = resistance * late.value / L_q.value, resistance * late.sd / L_q.value
    value = psi.value / (1.0 + by)
    parts = {**psi.parts, "late currents": share * value}
    delay = found.delay
    return replace(
        found,
        psi=replace(psi, value=value, parts=parts),
        delay=replace(delay, value=delay.value - late.value, parts={**delay.parts, "late currents": late.sd}),
    )
