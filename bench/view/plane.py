"""The stator plane: current, voltage, back-EMF and the rotor's axis, actual and estimated, as vectors.

Radii below zero are pixels, as rerun has it. alpha points right, beta up (rerun's y points down, so it is
negated here). The circle has radius 1; what it stands for in A and V is chosen from 1-2-5 steps and written
beside it, so that small vectors stay visible.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr

from bench.record.info import RunInfo
from bench.signal.colours import RGB, TABLE
from bench.signal.waveforms.sectors import NUMERALS, SECTOR_WIDTH, SECTORS, edge_angle, hall_offset
from bench.view import schema

X_RANGE, Y_RANGE = (-2.75, 1.3), (-1.25, 1.25)
_TEXT_X = -1.95
_CIRCLE, _RAY, FAINT = (110, 110, 110), (58, 58, 58), (150, 150, 150)
_POINT = 0.0  # a radius: labels only
_HOLD = 0.98  # a picture: how slowly a scale shrinks again


Picture = tuple[list[tuple[float, float]], list[str]]
"""Ends of the arrows, as rerun has them, and the lines of the legend."""


Place = tuple[float, float]


def circle(
    entity: str, rays: Sequence[Sequence[Place]], names: Sequence[tuple[Place, str, RGB]]
) -> Iterator[tuple[str, rr.AsComponents]]:
    """Yield entity and static content of what lies behind vectors: a circle of radius 1, rays, and names in colours."""
    turn = np.linspace(0, 2 * math.pi, 121)
    strips = [np.stack([np.cos(turn), -np.sin(turn)], axis=1).tolist(), *rays]
    colours, radii = [_CIRCLE] + [_RAY] * len(rays), [-1.2] + [-0.6] * len(rays)
    yield f"{entity}/lines", rr.LineStrips2D(strips, colors=colours, radii=radii, draw_order=-10)
    places, labels, hues = zip(*names, strict=True)
    look = rr.Points2D(places, labels=labels, colors=hues, radii=_POINT, show_labels=True, draw_order=-5)
    yield f"{entity}/names", look


@dataclass(frozen=True, slots=True)
class _Arrow:
    colour: RGB
    x: float
    y: float
    text: str
    radius: float


class Plane:
    """Makes the static frame and the pictures of the stator plane for a run's channels."""

    def __init__(self, run: RunInfo) -> None:
        self._run = run
        self._currents = run.has("i_a", "i_b", "i_c")
        self._voltages = run.has("u_alpha", "u_beta")
        self._back_emf = run.has("e_alpha", "e_beta")
        self._reference = run.position_reference
        self._peak_i = self._peak_u = 0.0
        inputs = ("i_a", "i_b", "i_c", "u_alpha", "u_beta", "e_alpha", "e_beta")
        angles = (self._reference, *run.position_estimates)
        self._used = [name for name in inputs if run.has(name)] + [name for name in angles if name]

    @property
    def contents(self) -> str:
        """What is drawn, with units; empty if the run has nothing to draw."""
        volts = [name for name, there in (("voltage", self._voltages), ("back-EMF", self._back_emf)) if there]
        parts = (
            "rotor axes" if self._reference or self._run.position_estimates else "",
            "current [A]" if self._currents else "",
            f"{' and '.join(volts)} [V]" if volts else "",
        )
        return ", ".join(part for part in parts if part)

    def frame(self) -> Iterator[tuple[str, rr.AsComponents]]:
        """Yield entity and static content: circle, sector borders and names, phase axes; how arrows and legend look."""
        if not self.contents:
            return
        edges = edge_angle(np.arange(SECTORS), hall_offset(self._run.parameters)).tolist()
        rays = [[(0.0, 0.0), _xy(edge)] for edge in edges]
        names = [(_xy(edge + SECTOR_WIDTH / 2, 0.86), name, FAINT) for edge, name in zip(edges, NUMERALS, strict=True)]
        names += [(_xy(2 * math.pi / 3 * k, 1.13), name, TABLE[f"i_{name}"].rgb) for k, name in enumerate("abc")]
        yield from circle(schema.PLANE, rays, names)
        arrows = self._arrows(dict.fromkeys(self._used, 0.0), {})
        colours = [arrow.colour for arrow in arrows]
        yield schema.VECTORS, rr.Arrows2D.from_fields(colors=colours, radii=[-arrow.radius for arrow in arrows])
        places = [(_TEXT_X, -0.95 + 0.34 * row) for row in range(len(arrows))]
        yield schema.LEGEND, rr.Points2D(places, colors=colours, radii=_POINT, show_labels=True)

    def picture(self, newest: Mapping[str, float], errors_deg: Mapping[str, float]) -> Picture | None:
        """What moves, for the newest values of all channels and the position errors in degrees."""
        if not self.contents or not all(math.isfinite(newest[name]) for name in self._used):
            return None  # a float channel of a physical drive can hold anything
        arrows = self._arrows(newest, errors_deg)
        return [(arrow.x, -arrow.y) for arrow in arrows], [arrow.text for arrow in arrows]

    def _arrows(self, newest: Mapping[str, float], errors_deg: Mapping[str, float]) -> list[_Arrow]:
        return [*self._axes(newest, errors_deg), *self._vectors(newest)]

    def _axes(self, newest: Mapping[str, float], errors_deg: Mapping[str, float]) -> Iterator[_Arrow]:
        estimates = self._run.position_estimates
        reference = self._reference
        angles = [(reference, f"rotor axis, {schema.label(reference)}", 1.0, 2.6)] if reference else []
        angles += [(name, schema.label(name), 0.92 - 0.1 * k, 1.7) for k, name in enumerate(estimates)]
        for name, text, length, radius in angles:
            x, y = length * math.cos(newest[name]), length * math.sin(newest[name])
            suffix = f"  {errors_deg[name]:+.1f}°" if name in errors_deg else ""
            yield _Arrow(self._run.colours[name], x, y, text + suffix, radius)

    def _vectors(self, newest: Mapping[str, float]) -> Iterator[_Arrow]:
        pairs: list[tuple[str, str, str, float, float]] = []
        if self._currents:
            alpha = (2 * newest["i_a"] - newest["i_b"] - newest["i_c"]) / 3
            pairs.append(("i_q", "current", "A", alpha, (newest["i_b"] - newest["i_c"]) / math.sqrt(3)))
        if self._voltages:
            pairs.append(("u_alpha", "voltage", "V", newest["u_alpha"], newest["u_beta"]))
        if self._back_emf:
            pairs.append(("e_alpha", "back-EMF", "V", newest["e_alpha"], newest["e_beta"]))
        sizes = {unit: max((math.hypot(a, b) for *_, u, a, b in pairs if u == unit), default=0.0) for unit in "AV"}
        self._peak_i = max(self._peak_i * _HOLD, sizes["A"])
        self._peak_u = max(self._peak_u * _HOLD, sizes["V"])
        full = {"A": schema.nice_ceiling(self._peak_i), "V": schema.nice_ceiling(self._peak_u)}
        for name, text, unit, alpha, beta in pairs:
            size = math.hypot(alpha, beta)
            yield _Arrow(
                TABLE[name].rgb,
                alpha / full[unit],
                beta / full[unit],
                f"{text}  {size:.2f} {unit}  (circle {full[unit]:g} {unit})",
                2.2,
            )


def _xy(angle: float, radius: float = 1.0) -> tuple[float, float]:
    return radius * math.cos(angle), -radius * math.sin(angle)
