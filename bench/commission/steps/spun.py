"""What a shaft that was spun tells: flux, inertia, friction, the encoder's zero, Hall edges, and L_q without a rocking
rotor.

What the encoder was taken for when it was dragged has to hold under torque, too: a zero that has moved is a disc that
slips. Without an encoder the back-EMF tells flux and Hall edges, and the edges the shaft's motion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from bench.commission.analysis import by_edges
from bench.commission.analysis.back_emf import UNKNOWN_LATE, flux_by_back_emf
from bench.commission.analysis.edges import HallEdges, edges_by_back_emf, hall_edges
from bench.commission.analysis.flux import Flux, flux
from bench.commission.analysis.mechanics import Mechanics, mechanics
from bench.commission.analysis.stretches import merged
from bench.commission.outcome import Evidence, Outcome, Panel
from bench.commission.quantity import Quantity
from bench.commission.refusal import Refused
from bench.commission.stand import Stand
from bench.commission.steps import inductance
from bench.commission.steps.spin import STEP, Spin, announcement, spin
from bench.commission.window import Floats, Window
from bench.findings.finding import degrees
from bench.signal.position import unwrapped, wrapped

__all__ = ["STEP", "announcement", "perform"]

SLIPPED = math.radians(5.0)
"""rad, electrical, by which the zero at speed may differ from that of the dragged turn, at least,"""
SURE = 3.0
"""and times what the rough one is known to."""
MOTION_FLOOR = 3e-3
"""Of inertia and friction by Hall edges, sd, besides: of unkind benches up to 1.4 % were left."""
SHOWN, POINTS = 1500, 150
"""Points of a curve, and of residuals."""


@dataclass
class Spun:
    """What came of it."""

    flux: Flux
    """Without an encoder its angle is 0, and not told."""
    motion: Mechanics | None = None
    edges: HallEdges | None = None
    inductances: inductance.Inductances | None = None
    blind: Quantity | None = None
    """Psi without the encoder, beside."""
    pole_pairs: bool = True
    """Whether they are known: else inertia and friction are those of a shaft with one, and not told."""
    refused: list[Refused] = field(default_factory=list)

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """All of it."""
        of = self.flux
        told: list[Quantity | None] = [of.psi]
        if of.fitted is not None:
            told += [of.L_d, of.L_q, of.zero, of.delay]
        if self.motion is not None and self.pole_pairs:
            told += [self.motion.J, self.motion.b, self.motion.friction, *self.motion.each_way]
        if self.motion is not None:
            told.append(self.motion.late)
        if self.edges is not None:
            told += [self.edges.ring, self.edges.delay, *self.edges.up, *self.edges.down]
        if self.inductances is not None:
            told += self.inductances.outcome.quantities
        if self.blind is not None:
            told.append(replace(self.blind, name="psi_f_blind"))
        return tuple(each for each in told if each is not None)


def perform(stand: Stand) -> Outcome:
    """Spin it, and tell stand and drive what follows."""
    made = spin(stand)
    windows = [replace(window, i=window.i / stand.gains[:, None]) for window in made.windows]
    found = analyse(stand, made, windows) if not made.blind else _without_encoder(stand, made, windows)
    if made.blind and found.edges is not None:
        windows = _with_angles(windows, found.edges)
    outcome = Outcome(
        found.quantities, Evidence("The shaft spun both ways, and coasting", _panels(windows, found, made.n_p), {
            "fastest": made.fastest, "windows": float(len(windows)),
            "seconds": sum(window.seconds for window in windows),
        }), refused=tuple(found.refused),
    )  # fmt: skip
    if not made.blind:
        stand.set(encoder_zero=found.flux.zero.value)
    return outcome


def _without_encoder(stand: Stand, made: Spin, windows: Sequence[Window]) -> Spun:
    """What back-EMF and Hall edges tell; Refused where the flux is not told."""
    assert stand.turned is not None
    R, L_q, U_dead = stand.found["R_s"], stand.found["L_q"], stand.found["U_dead"].value
    nothing = Quantity("encoder_delay", "s", 0.0)
    in_time = Quantity("current_delay", "s", 0.0)
    psi = flux_by_back_emf(windows, R, L_q, in_time, U_dead)
    found = Spun(Flux(psi, stand.found["L_d_half"], None, replace(nothing, unit="rad"), nothing, 0.0, 0.0))
    found.pole_pairs = stand.turned.n_p is not None
    try:
        found.edges = edges_by_back_emf(windows, R, L_q)
        turning = _with_angles(windows, found.edges)
        falls = _falls(stand, L_q.value)
        found.motion = mechanics(turning, found.flux, R, L_q, made.n_p, falls, UNKNOWN_LATE, MOTION_FLOOR)
        found.flux = found.motion.flux
        found.inductances = _inductances(stand, found.motion, made.n_p)
        if found.pole_pairs:
            found.refused += found.motion.refused
        else:
            found.refused.append(
                Refused("mechanics", "inertia and friction are not claimed: they need the pole pairs (--pole-pairs N)")
            )
    except Refused as refused:
        found.refused.append(refused)
    if found.motion is None:
        found.flux = replace(found.flux, psi=flux_by_back_emf(windows, R, L_q, UNKNOWN_LATE, U_dead))
    return found


def _with_angles(windows: Sequence[Window], edges: HallEdges) -> list[Window]:
    """Windows that follow each other as one, each with the flux's angle by its edges."""
    return [by_edges.with_angle(window, edges) for window in merged(windows)]


def analyse(stand: Stand, made: Spin, windows: Sequence[Window]) -> Spun:
    """What follows; Refused where the flux is not told. What else is not told is among what it refuses."""
    turned = stand.turned
    assert turned is not None
    assert turned.dragged is not None
    dragged, n_p = turned.dragged, made.n_p
    R, L_q, U_dead = stand.found["R_s"], stand.found["L_q"], stand.found["U_dead"].value
    found = Spun(flux(windows, R, L_q, dragged.zero.value, U_dead))
    moved = wrapped(found.flux.zero.value - dragged.zero.value)
    if abs(moved) > max(SLIPPED, SURE * dragged.zero.sd):
        raise Refused(
            STEP, f"the encoder's zero has moved by {degrees(moved)} (electrical) since the shaft was dragged: the "
            "encoder slips on the shaft, or loses counts"
        )  # fmt: skip
    try:
        found.motion = mechanics(windows, found.flux, R, L_q, n_p, _falls(stand, L_q.value))
        found.flux = found.motion.flux
        found.refused += found.motion.refused
    except Refused as refused:
        found.refused.append(refused)
    if turned.hall is not None:
        try:
            found.edges = _edges(stand, found.flux, n_p, dragged.direction, windows)
        except Refused as refused:
            found.refused.append(refused)
    try:
        late = UNKNOWN_LATE if found.motion is None else found.motion.late
        found.blind = flux_by_back_emf(windows, R, L_q, late, U_dead)
    except Refused as refused:
        found.refused.append(refused)
    if found.motion is not None and found.motion.J.value > 0.0:
        found.inductances = _inductances(stand, found.motion, n_p)
    return found


def _falls(stand: Stand, L_q: float) -> float:
    """1/A: the share by which a d current lessens L_q."""
    return (1.0 - stand.found["L_q_half"].value / L_q) / (inductance.MIDDLE * stand.i_max)


def _edges(stand: Stand, of: Flux, n_p: int, direction: int, windows: Sequence[Window]) -> HallEdges:
    lines = int(stand.rig.drive.parameters.get("encoder_lines", 0))
    return hall_edges(windows, of, n_p, 4 * lines * direction, step=1.0 / stand.rig.recorder.tick_hz)


def _inductances(stand: Stand, motion: Mechanics, n_p: int) -> inductance.Inductances:
    """L_d and L_q once more, with what the rocking rotor takes off as J and psi say."""
    psi, J = motion.flux.psi, motion.J
    K = inductance.rocking_of(n_p, psi.value, J.value)
    sd = K * math.hypot(J.sd / J.value, 2.0 * psi.sd / psi.value)
    return inductance.analyse(stand.waves, stand.R, stand.gains, stand.i_max, stand.noise, (K, sd))


def _panels(windows: Sequence[Window], found: Spun, n_p: int) -> tuple[Panel, ...]:
    panels = [Panel("time", "s", "speed of the shaft", "rad/s", _speeds(windows, n_p))]
    if found.flux.fitted is not None:
        residuals = found.flux.fitted.residuals
        of_flux = {"voltage across, parts with a d current": (np.arange(len(residuals), dtype=float), 1e3 * residuals)}
        panels.append(Panel("part", "", "residuals", "mV", of_flux))
    if found.motion is not None:
        told = found.motion.moments.omega
        some = slice(None, None, 1 + len(told) // POINTS)
        of_motion = {"momentum": (told[some], 1e6 * found.motion.fitted.residuals[some])}
        panels.append(Panel("speed of the shaft", "rad/s", "residuals", "uN m s", of_motion))
    if found.edges is not None:
        six = np.arange(1.0, 7.0)
        by_way = {
            name: (six, np.degrees([each.value for each in edges]))
            for name, edges in (("forward", found.edges.up), ("in reverse", found.edges.down))
        }
        panels.append(Panel("sector", "", "Hall edge, ideal less actual", "deg", by_way))
    return tuple(panels)


def _speeds(windows: Sequence[Window], n_p: int) -> dict[str, tuple[Floats, Floats]]:
    """By command, over the time since the first window."""
    start = int(windows[0].index[0])
    series: dict[str, tuple[list[Any], list[Any]]] = {"driven": ([], []), "coasting": ([], [])}
    total = sum(len(window) for window in windows)
    for window in (each for each in windows if each.theta is not None):
        step = max(8, total // SHOWN)
        theta = unwrapped(np.asarray(window.theta))[::step]
        t, w = series["coasting" if window.kind == "off" else "driven"]
        t += [(window.index[::step][1:] - start) * window.T, [math.nan]]
        w += [np.diff(theta) / (step * window.T) / n_p, [math.nan]]
    return {name: (np.concatenate(t), np.concatenate(w)) for name, (t, w) in series.items() if t}
