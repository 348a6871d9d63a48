"""What a step has found, and what shows it: quantities, remarks, and figures with their fits and residuals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bench.commission.quantity import Quantity
from bench.commission.refusal import Refused
from bench.commission.window import Floats
from bench.files import finite

Series = Mapping[str, tuple[Floats, Floats]]


@dataclass(frozen=True)
class Panel:
    """One plot: what is over what, with units, and its series by name; those that begin with "fit" are lines."""

    x: str
    x_unit: str
    y: str
    y_unit: str
    series: Series


@dataclass(frozen=True)
class Evidence:
    """What a step measured, what was fitted to it, and what the fit leaves."""

    title: str
    panels: tuple[Panel, ...] = ()
    figures: Mapping[str, float] = field(default_factory=dict)
    """Coefficients, deviations and numbers of the fit, by name, in SI units."""

    def as_json(self) -> dict[str, Any]:
        """Plain data."""
        told: dict[str, Any] = finite({
            "title": self.title,
            "figures": dict(self.figures),
            "panels": [
                {"x": panel.x, "x_unit": panel.x_unit, "y": panel.y, "y_unit": panel.y_unit,
                 "series": {name: {"x": np.asarray(x, float).tolist(), "y": np.asarray(y, float).tolist()}
                            for name, (x, y) in panel.series.items()}}
                for panel in self.panels
            ],
        })  # fmt: skip
        return told


@dataclass(frozen=True)
class Outcome:
    """Of one step."""

    quantities: tuple[Quantity, ...]
    evidence: Evidence
    remarks: tuple[str, ...] = ()
    refused: tuple[Refused, ...] = ()
    """What it does not claim beside what it has found."""
    settings: Mapping[str, float] = field(default_factory=dict)
    """Parameters of the drive that follow from what was found, in their units, beside those that are quantities."""

    def __getitem__(self, name: str) -> Quantity:
        """The quantity of this name; KeyError where the step has not found it."""
        return found_by([self])[name]


def found_by(outcomes: Iterable[Outcome]) -> dict[str, Quantity]:
    """All quantities by name; of several that are alike the last one."""
    return {quantity.name: quantity for outcome in outcomes for quantity in outcome.quantities}
