"""What a drive is rated for: the speed and the current that tests ask for shares of.

The drive tells, by its parameters `omega_m_max` and `i_max`; `bench.toml` may say less, and must say it where the drive
does not. Nothing here energises.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

from bench.errors import BenchError
from bench.signal.limits import LOAD_ANGLE, RATED_CURRENT, RATED_SPEED, UNITS
from bench.signal.units import RPM

HEADROOM = 1.05
"""The largest speed reference over the rated speed, which is a multiple of ROUND: a speed loop overshoots."""
ROUND = 10.0  # r/min
FLOAT32 = 1e-6  # to which a drive rounds its parameters, as a share
RATING_PARAMETERS = ("omega_m_max", "i_max", "L_s_hat", "psi_f_hat")
TOLD_BY = {RATED_SPEED: ("omega_m_max", "speed_rpm"), RATED_CURRENT: ("i_max", "current")}


@dataclass(frozen=True)
class Ratings:
    """Rated speed and current, those that are known; who asks for another gets a BenchError."""

    told: Mapping[str, float]

    @property
    def speed_rpm(self) -> float:
        """Mechanical r/min."""
        return self._told(RATED_SPEED)

    @property
    def current(self) -> float:
        """A, peak."""
        return self._told(RATED_CURRENT)

    @property
    def words(self) -> dict[str, str]:
        """Each with its unit, by name."""
        return {rating: f"{value:.5g} {UNITS[rating]}" for rating, value in self.told.items()}

    def missing(self, wanted: Collection[str]) -> list[str]:
        """What is not known of these, in words, and who may say it."""
        return [
            f"needs the drive's {what}: it has no parameter {TOLD_BY[what][0]}; set [rated] {TOLD_BY[what][1]} in "
            "bench.toml"
            for what in wanted
            if what not in self.told
        ]

    def _told(self, what: str) -> float:
        if missing := self.missing([what]):
            raise BenchError(missing[0])
        return self.told[what]


def ratings(parameters: Mapping[str, float], own: Mapping[str, float]) -> Ratings:
    """Of a drive with these parameters, and of `own`, the table [rated] of bench.toml: `speed_rpm`, `current`.

    The load angle in electrical degrees follows from the rated current and what the drive holds its motor for.
    BenchError if the file's are beyond what the drive lets one ask for.
    """
    omega_m_max, i_max, L_s_hat, psi_f_hat = (parameters.get(name, math.inf) for name in RATING_PARAMETERS)
    most = {RATED_SPEED: omega_m_max / RPM, RATED_CURRENT: i_max}
    told = {what: limit for what, limit in most.items() if math.isfinite(limit)}
    if RATED_SPEED in told:
        told[RATED_SPEED] = math.floor(told[RATED_SPEED] / HEADROOM / ROUND) * ROUND
    for what, (parameter, key) in TOLD_BY.items():
        if key not in own:
            continue
        if own[key] > most[what] * (1.0 + FLOAT32):
            limit = f"the drive's limit of {most[what]:.4g} (its parameter {parameter})"
            raise BenchError(f"[rated] {key} = {own[key]:g} in bench.toml is beyond {limit}")
        told[what] = own[key]
    if RATED_CURRENT in told and math.isfinite(L_s_hat + psi_f_hat):
        told[LOAD_ANGLE] = math.degrees(math.atan2(L_s_hat * told[RATED_CURRENT], psi_f_hat))
    return Ratings({what: value for what, value in told.items() if value > 0.0})
