"""Step 6: gains by what was found, and a step of i_d against the model that they are made for.

The winding is taken as R and L, exact over a PWM period, the loop as its two gains, and the voltage as one period
late. What the measured step differs by from that is what R, L, delay and loop are wrong by together.
"""

from __future__ import annotations

import math

import numpy as np

from bench.commission import gains
from bench.commission.outcome import Evidence, Outcome, Panel
from bench.commission.quantity import Quantity
from bench.commission.refusal import Refused
from bench.commission.stand import Stand
from bench.commission.window import Floats, Window
from bench.rig.envelope import Envelope

STEP = "check"
BIAS, AMPLITUDE = 0.5, 0.05
"""Of the agreed current: the d current, and the amplitude of the square wave on its reference."""
CONSTANTS = 12.0
"""Time constants of the loop in half a cycle."""
LEAD, CYCLES = 2, 30
"""Cycles that are left out, and that are averaged."""
FAR = 0.05
"""Of the step, by which it may differ from the model without being told."""


def model(R: float, L: float, bandwidth: float, T: float, half: int) -> Floats:
    """The d current, A, of half a cycle of a square wave of +-1 A on its reference, shape (half,), settled.

    R in ohm, L in H, `bandwidth` in Hz, T in s.
    """
    alpha = math.tau * bandwidth
    kept = math.exp(-R * T / L)
    by_volt = (1.0 - kept) / R
    i, integral, u = 0.0, 0.0, 0.0
    seen = []
    for k in range(4 * half):
        reference = 1.0 if (k // half) % 2 == 0 else -1.0
        seen.append(i)
        error = reference - i
        integral += alpha * R * T * error
        i, u = kept * i + by_volt * u, alpha * L * error + integral
    return np.array(seen[2 * half : 3 * half])


def mean_half(window: Window, half: int) -> Floats:
    """The d current of the first half of a cycle, mean of all whole cycles, A, shape (half,). Refused without any.

    It begins with the sample by which the loop saw the new reference, one before that which marks the cycle: what a
    sample tells of references was in force up to it (SPEC, 13.2).
    """
    begins = np.flatnonzero(window.cycle) - 1
    begins = begins[(begins >= 0) & (begins + half <= len(window))]
    if len(begins) < 3:
        raise Refused(STEP, f"{len(begins)} cycles of the test signal came, and 3 are needed")
    i = window.dq.real
    return np.asarray(np.mean([i[b : b + half] for b in begins], axis=0))


def perform(stand: Stand) -> Outcome:
    """Set the gains, apply the step, and compare."""
    if stand.turned is not None:
        stand.await_rest(STEP)
    found, n_p = stand.found, None if stand.turned is None else stand.turned.n_p
    settings = gains.settings(found, n_p, stand.limits)
    R, L, bandwidth = stand.R, found["L_d_half"].value, settings["bw_current"]
    stand.compensate(L, bandwidth)
    half = max(round(CONSTANTS / (math.tau * bandwidth) / stand.T), 8)
    amplitude = AMPLITUDE * stand.i_max
    with stand.running():
        stand.ramp(0.05 * stand.i_max, BIAS * stand.i_max, 0.3, 15)
        stand.wait(0.3)
        with stand.square("i_d", amplitude, half):
            stand.wait(2 * LEAD * half * stand.T)
            window = stand.run(2 * (CYCLES + 1) * half * stand.T, "forced")
        stand.current(0.0)
        stand.wait(0.02)
    seen = mean_half(window, half)
    made = amplitude * model(R, L, bandwidth, stand.T, half)
    measured, modelled = np.asarray(seen - seen.mean()), np.asarray(made - made.mean())
    off = np.asarray(measured - modelled)
    misfit = float(np.abs(off).max()) / (2.0 * amplitude)
    noise = stand.noise / math.sqrt(CYCLES) / (2.0 * amplitude)
    settled = float(seen[-max(half // 4, 1) :].mean())
    overshoot = float((seen.max() - settled) / max(settled - seen[0], 1e-12))
    t: Floats = 1e3 * stand.T * np.arange(half, dtype=float)
    panels = (
        Panel("time", "ms", "d current", "A", {
            "measured": (t, measured), "fit: the model": (t, modelled),
        }),
        Panel("time", "ms", "residuals", "A", {"measured": (t, off)}),
    )  # fmt: skip
    remarks: tuple[str, ...] = ()
    if misfit > FAR + 3.0 * noise:
        remarks = (
            f"a step of i_d differs from the model by {misfit:.0%} of it: the loop's delay, or its gains, are not as "
            "the model has them",
        )
    quantities = (
        Quantity("step_misfit", "1", misfit, {"noise": noise}), Quantity("overshoot", "1", overshoot, {"noise": noise}),
    )  # fmt: skip
    figures = {"bw_current": bandwidth, "misfit": misfit, "overshoot": overshoot}
    evidence = Evidence("A step of the d current against the model", panels, figures)
    return Outcome(quantities, evidence, remarks, settings=settings)


def announcement(agreed: Envelope) -> str:
    """What will be done, within what was agreed to."""
    return (
        f"a square wave on the reference of the d current, about {BIAS * agreed.current:.3g} A; the shaft stands still"
    )
