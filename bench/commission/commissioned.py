"""What came of a commissioning: outcomes and refusals of its steps, and what follows from them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from bench.commission.comparison import Comparison
from bench.commission.outcome import Outcome, found_by
from bench.commission.parameters import loadable
from bench.commission.quantity import USUAL, Converters, Quantity
from bench.commission.refusal import Refused
from bench.files import finite
from bench.param import dump, history
from bench.param.table import Parameters


@dataclass
class Commissioned:
    """What was found, step by step, and what was not."""

    drive: Parameters
    """The drive's parameters before."""
    i_max: float
    outcomes: dict[str, Outcome] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)
    """Why a step claims nothing, by the step's name."""
    seconds: float = 0.0
    """Of drive time."""
    converters: Converters = USUAL
    """What is known of the drive's own volts and amperes."""
    about: dict[str, Any] = field(default_factory=dict)
    """When, by whom, where, with what."""
    comparison: Comparison | None = None
    """With the one before, if there was one that has anything in common."""

    @property
    def found(self) -> dict[str, Quantity]:
        """All quantities by name."""
        return found_by(self.outcomes.values())

    @property
    def settings(self) -> dict[str, float]:
        """Parameters that follow from what was found, beside those that are quantities."""
        return {name: value for outcome in self.outcomes.values() for name, value in outcome.settings.items()}

    @property
    def remarks(self) -> list[str]:
        """What is to be known beside."""
        return [words for outcome in self.outcomes.values() for words in outcome.remarks]

    def refuse(self, refused: Refused) -> None:
        """That is not claimed; a step may have several reasons."""
        before = self.refused.get(refused.step)
        self.refused[refused.step] = refused.reason if before is None else f"{before}; {refused.reason}"

    def loadable(self) -> tuple[Parameters, list[str]]:
        """See `bench.commission.parameters.loadable`."""
        return loadable(self.found, self.settings, self.drive, self.converters)

    def as_toml(self) -> tuple[str, list[str]]:
        """A dump of what the drive takes, and what it does not take, in words."""
        told, left = self.loadable()
        return dump.text(told, history.now(), history.who(), "found by bench commission"), left

    def as_json(self) -> dict[str, Any]:
        """Plain data, SI units."""
        known = self.converters
        told: dict[str, Any] = finite({
            "drive": dict(self.drive.identity),
            "about": self.about,
            "current": self.i_max,
            "seconds": self.seconds,
            "converters": {
                "volts": known.volts, "amperes": known.common_amperes,
                "volts_gain": known.volts_gain, "amperes_gain": known.amperes_gain,
            },
            "quantities": {
                name: {
                    "value": q.value, "unit": q.unit, "parts": dict(q.parts),
                    "half_width": q.half_width, "dominated_by": q.dominated_by,
                    "absolute": q.absolute_value(known), "absolute_half_width": q.absolute_half_width(known),
                    "absolutely_dominated_by": q.absolutely_dominated_by(known),
                }
                for name, q in self.found.items()
            },
            "settings": self.settings,
            "refused": dict(self.refused),
            "remarks": self.remarks,
            **({} if self.comparison is None else {"comparison": self.comparison.as_json()}),
        })  # fmt: skip
        return told
