"""What `bench tune` changes and what it looks at: parameters with their ranges, objectives, and how these are compared.

An objective is one number of many drives. What a drive lacks because it tripped, or could not be, counts as the worst:
an error as `LOST` degrees. In another unit nothing is the worst: there parameters with which one is lacking are out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.errors import BenchError
from bench.study.statistics import Estimate
from bench.study.variation import leaf, put, whole
from protocol.text import did_you_mean

F64 = NDArray[np.float64]

LOST = 180.0
"""deg: the largest error that an angle can have."""
YIELD, MEAN, MAX, RMS = "yield", "mean", "max", "rms"
SHARES = {"p50": 50.0, "p95": 95.0, "p99": 99.0}
"""Percent of the drives that are at least as good."""
OVERS = (MEAN, RMS, MAX, *SHARES, YIELD)
SENSES = {"minimise": 1.0, "maximise": -1.0}
KINDS = {"range": "[lowest, highest]", "log": "[lowest, highest], both above 0", "choice": "a list of values"}
NEAR = 0.02  # share of a range: so near to its end a parameter is at its end
RESAMPLED = 2000  # times, for an interval
FEWEST = 8  # drives, for an interval, and of a quantile
BEYOND = 10  # drives beyond it: with fewer what is resampled says too little of a tail


@dataclass(frozen=True)
class Parameter:
    """A number of the configuration that is tuned."""

    key: str
    kind: str
    """Of `KINDS`."""
    given: tuple[float | int, ...]
    whole: bool
    before: float | int | None
    """As it is; None where that is not known."""

    def distribution(self, optuna: Any) -> Any:
        """For Optuna."""
        if self.kind == "choice":
            return optuna.distributions.CategoricalDistribution(self.given)
        lo, hi = self.given
        if self.whole:
            return optuna.distributions.IntDistribution(lo, hi, log=self.kind == "log")
        return optuna.distributions.FloatDistribution(lo, hi, log=self.kind == "log")

    @property
    def within(self) -> bool:
        """Whether it is in its range as it is."""
        if self.before is None or self.kind == "choice":
            return self.before in self.given
        return self.given[0] <= self.before <= self.given[1]

    def at_end(self, value: float) -> bool:
        """Whether a value is at an end of the range, so that the best may lie beyond."""
        if self.kind == "choice":
            return False
        lo, hi, at = (math.log(x) for x in (*self.given, value)) if self.kind == "log" else (*self.given, value)
        return min(at - lo, hi - at) <= NEAR * (hi - lo)


def read_parameter(key: str, given: Any, figures: Mapping[str, Any], where: str, known: bool = True) -> Parameter:
    """A line of [tune.parameters]; `known`: whether what it is now is that of `figures`."""
    what = f"tune.parameters.{key!r} in {where}"
    _, k, there = leaf(figures, key)
    if k is None and isinstance(there, list | tuple):
        raise BenchError(f"{what} is a list: name one number of it, {key}_1 to {key}_{len(there)}")
    before = there if k is None else there[k]
    kinds = [kind for kind in KINDS if isinstance(given, Mapping) and kind in given]
    if len(kinds) != 1 or len(given) != 1:
        forms = "; ".join(f"{{ {kind} = {form} }}" for kind, form in KINDS.items())
        raise BenchError(f"{what} must be one of {forms}; got {given!r}")
    (kind,) = kinds
    values = given[kind]
    if not isinstance(values, list) or not values or not all(_is_number(value) for value in values):
        raise BenchError(f"{what}: {kind} must be {KINDS[kind]}, got {values!r}")
    is_whole = isinstance(before, int)
    if is_whole and not all(float(value).is_integer() for value in values):
        raise BenchError(f"{what}: {key} is a whole number, got {values!r}")
    if kind != "choice":
        if len(values) != 2 or values[0] >= values[1]:
            raise BenchError(f"{what}: {kind} must be [lowest, highest], got {values!r}")
        if kind == "log" and values[0] <= 0:
            raise BenchError(f"{what}: log needs numbers above 0, got {values!r}: take range")
    made = tuple(whole(value) if is_whole else float(value) for value in values)
    return Parameter(key, kind, made, is_whole, before if known else None)


def with_parameters(figures: Mapping[str, Any], values: Mapping[str, float]) -> dict[str, Any]:
    """Overrides of a configuration, by dotted key, that put `values` in their places."""
    found: dict[str, Any] = {}
    put(values, figures, found)
    return found


@dataclass(frozen=True)
class Objective:
    """One number of many drives, (drives, repetitions), NaN where one lacks it."""

    name: str
    of: str
    """TEST.MEASUREMENT; of a yield the test: 1 where it passed, 0 where it failed."""
    over: str
    """Of `OVERS`."""
    sense: str
    """Of `SENSES`."""
    unit: str

    @property
    def sign(self) -> float:
        """1 where less is better, -1 where more is."""
        return SENSES[self.sense]

    def of_drives(self, values: F64) -> float:
        """Over all drives; NaN where that is not known."""
        return float(self._figures(values[None])[0])

    def difference(self, before: F64, after: F64) -> Estimate:
        """Of the objective of two designs on the same drives, after less before: by resampling the drives.

        A largest value has no such interval, and a quantile has one only where enough drives lie beyond it.
        """
        value = self.of_drives(after) - self.of_drives(before)
        n = len(before)
        beyond = n * (100.0 - SHARES.get(self.over, 0.0)) / 100.0
        if self.over == MAX or n < FEWEST or beyond < BEYOND * (self.over in SHARES) or math.isnan(value):
            return Estimate(value, math.nan, math.nan)
        drawn = np.random.default_rng(0).integers(0, n, (RESAMPLED, n))
        found = self._figures(after[drawn]) - self._figures(before[drawn])
        from scipy import stats

        tail = float(stats.norm.cdf(-math.sqrt(n / (n - 1)) * stats.t.ppf(0.975, n - 1)))  # Hesterberg 2015
        lo, hi = np.quantile(found, [tail, 1.0 - tail])
        return Estimate(value, float(lo), float(hi))

    def _figures(self, values: F64) -> F64:
        """(times,) of values (times, drives, repetitions)."""
        worst = LOST if self.unit == "deg" else 0.0 if self.over == YIELD else math.nan
        values = np.where(np.isnan(values), worst, values)
        if self.over == YIELD:
            passed: F64 = values.min(2).mean(1)
            return passed
        found: F64 = _OVER[self.over](values.reshape(len(values), -1), self.sign)
        return found


def _quantile(percent: float) -> Callable[[F64, float], Any]:
    return lambda values, sign: np.quantile(_size(values, sign), 0.01 * (percent if sign > 0 else 100.0 - percent), 1)


def _size(values: F64, sign: float) -> F64:
    """What is to be small counts without its sign."""
    return np.abs(values) if sign > 0 else values


_OVER: Mapping[str, Callable[[F64, float], Any]] = {
    MEAN: lambda values, sign: values.mean(1),
    RMS: lambda values, sign: np.sqrt(np.square(values).mean(1)),
    MAX: lambda values, sign: sign * (sign * _size(values, sign)).max(1),
    **{name: _quantile(percent) for name, percent in SHARES.items()},
}


def read_objectives(given: Any, units: Mapping[str, str] | None, tests: Sequence[str], where: str) -> list[Objective]:
    """[tune.objectives]; `units`: by what can be measured, None where only a drive can tell."""
    if not isinstance(given, Mapping) or not given:
        form = 'noise = { of = "slow.vector_tracking.rms", over = "p95", sense = "minimise" }'
        raise BenchError(f"{where} has no objective: write [tune.objectives] with {form}")
    return [_objective(name, one, units, tests, f"tune.objectives.{name!r} in {where}") for name, one in given.items()]


def _objective(name: str, given: Any, units: Mapping[str, str] | None, tests: Sequence[str], what: str) -> Objective:
    given = {"sense": given} if isinstance(given, str) else given
    if not isinstance(given, Mapping):
        raise BenchError(f'{what} must be "minimise", or {{ of = …, over = …, sense = … }}, got {given!r}')
    filled = {"of": name, "over": MEAN, "sense": "minimise"} | dict(given)
    choices = {"over": OVERS, "sense": tuple(SENSES)}
    for key, value in filled.items():
        if key not in ("of", "over", "sense"):
            raise BenchError(f"{what} has an unknown '{key}': {did_you_mean(key, ('of', *choices), 'of, over, sense')}")
        if key in choices and value not in choices[key]:
            hint = did_you_mean(str(value), choices[key], f"there are {', '.join(choices[key])}")
            raise BenchError(f"{what}: {key} is {value!r}: {hint}")
    if filled["over"] == YIELD and given.get("sense") is None:
        filled["sense"] = "maximise"
    known: Sequence[str] = tests if filled["over"] == YIELD else [*(units or ())]
    if (units is not None or filled["over"] == YIELD) and filled["of"] not in known:
        hint = did_you_mean(str(filled["of"]), known, f"there are {', '.join(known) or 'none'}")
        raise BenchError(f"{what}: nothing measures {filled['of']}: {hint}")
    unit = "" if filled["over"] == YIELD else (units or {}).get(filled["of"], "")
    return Objective(name, filled["of"], filled["over"], filled["sense"], unit)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
