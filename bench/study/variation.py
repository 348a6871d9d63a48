"""What is varied from drive to drive: distributions of figures, correlated ones, and tables of measured drives.

Each takes numbers that are uniform between 0 and 1, and makes figures of them, so that it does not matter how those
were chosen: at random, by Sobol's sequence, by Latin hypercubes or for Saltelli's estimates.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.errors import BenchError
from bench.files import leaves
from protocol.text import did_you_mean

F64 = NDArray[np.float64]

KINDS = {
    "normal": "[mean, standard deviation]", "uniform": "[lowest, highest]",
    "triangular": "[lowest, likeliest, highest]", "choice": "a list of values", "follows": '"KEY"',
}  # fmt: skip
"""Distributions, and what is given of each."""
PARTS = {
    "normal": ("mean", "sd"), "uniform": ("from", "to"), "triangular": ("from", "likeliest", "to")
}  # fmt: skip
OPTIONS: dict[str, Any] = {
    "relative": bool, "together": bool, "within": list, "factor": (int, float), "sd": (int, float)
}  # fmt: skip
OF_FOLLOWERS = ("factor", "sd")
AT = "@"
"""Before the design, in the name of what is varied in one alone."""
LEAST_SHARE = 1e-9  # of a distribution that must lie within its ends
EDGE = 1e-12  # uniform numbers are no nearer to 0 and 1: a normal distribution has no end


@dataclass(frozen=True)
class Varied:
    """One key of the configuration that is varied, or a table of several."""

    key: str
    """Of the configuration; for a table its name."""
    kind: str
    """Of `KINDS`, or `table`."""
    given: tuple[Any, ...]
    """See `KINDS`; of a table its columns, each a tuple; of what follows names of inputs, and then factor and sd."""
    inputs: tuple[str, ...]
    """Names of what is varied: the key, or one for each number of a list, as hall.delta_deg_1."""
    base: tuple[float, ...]
    """What they are where nothing is varied."""
    relative: bool = False
    """Whether what is given are multiples of `base`."""
    together: bool = False
    """Whether all numbers of a list are the same."""
    within: tuple[float, float] = (-math.inf, math.inf)
    only: tuple[str, ...] = ()
    """Designs in which it is varied; none: all."""

    @property
    def dimensions(self) -> int:
        """Uniform numbers that it takes."""
        if self.kind == "follows":
            return len(self.inputs) if self.given[-1] else 0
        return 1 if self.together or self.kind in ("choice", "table") else len(self.inputs)

    @property
    def factors(self) -> tuple[str, ...]:
        """What each of these stands for."""
        if self.kind == "follows":
            return tuple(f"error of {name}" for name in self.inputs[: self.dimensions])
        return self.inputs if self.dimensions == len(self.inputs) else (self.key,)

    @property
    def continuous(self) -> bool:
        """Whether it may be correlated with others."""
        return self.kind not in ("choice", "table", "follows") and not self.together

    def of(self, uniform: F64) -> F64:
        """Values (n, inputs) for uniform numbers (n, dimensions); of a `choice` of lists their numbers, from 0."""
        if self.kind == "table":
            return np.array(self.given)[:, self._index(uniform, len(self.given[0]))].T * self._scale
        if self.kind == "choice":
            index = self._index(uniform, len(self.given))
            values = range(len(self.given)) if self.lists else self.given
            return np.repeat(np.array(list(values), float)[index][:, None], len(self.inputs), 1) * self._scale
        return np.broadcast_to(self._quantiles(uniform), (len(uniform), len(self.inputs))) * self._scale

    def after(self, followed: F64, uniform: F64) -> F64:
        """Values (n, inputs) of what follows others, `followed` (n, inputs), with an error of its own."""
        from scipy.special import ndtri

        factor, sd = self.given[-2:]
        found: F64 = factor * followed
        return found + sd * ndtri(np.clip(uniform, EDGE, 1.0 - EDGE)) if sd else found

    @property
    def lists(self) -> bool:
        """Whether lists are chosen from: its value is the number of one."""
        return self.kind == "choice" and isinstance(self.given[0], list | tuple)

    @property
    def _scale(self) -> F64 | float:
        return np.array(self.base) if self.relative else 1.0

    @staticmethod
    def _index(uniform: F64, n: int) -> NDArray[np.int64]:
        return np.minimum((uniform[:, 0] * n).astype(np.int64), n - 1)

    @property
    def _distribution(self) -> Any:
        from scipy import stats

        a, *more = self.given
        if self.kind == "normal":
            return stats.norm(a, more[0])
        if self.kind == "uniform":
            return stats.uniform(a, more[0] - a)
        return stats.triang((more[0] - a) / (more[1] - a), a, more[1] - a)

    @property
    def share(self) -> float:
        """Of the distribution that lies `within`."""
        lo, hi = self._distribution.cdf(self.within)
        return float(hi - lo)

    def _quantiles(self, uniform: F64) -> F64:
        lo, hi = self._distribution.cdf(self.within)
        found: F64 = self._distribution.ppf(lo + np.clip(uniform, EDGE, 1.0 - EDGE) * (hi - lo))
        return np.clip(found, *self.within)

    @property
    def words(self) -> str:
        """For people."""
        if self.kind == "table":
            return f"a table of {len(self.given[0])} drives"
        if self.kind == "follows":
            factor, sd = self.given[-2:]
            of = f"{factor:g} x " if factor != 1.0 else ""
            error = f", with an error of {sd:g} (standard deviation)" if sd else ""
            return f"{of}{self.given[0].rpartition('_1')[0] or self.given[0]}{error}" + self._where
        told = [f"{one:g}" if isinstance(one, float | int) else str(one) for one in self.given]
        if self.kind == "choice":
            times = Counter(told)
            numbers = "of " + ", ".join(f"{one} ({n} x)" if n > 1 else one for one, n in times.items())
        else:
            numbers = ", ".join(f"{name} {one}" for name, one in zip(PARTS[self.kind], told, strict=True))
        lo, hi = self.within
        within = f", within {lo:g} … {hi:g}" if (lo, hi) != (-math.inf, math.inf) else ""
        each = ", all of the list alike" if self.together else ", each by itself" if len(self.inputs) > 1 else ""
        return f"{self.kind}: {numbers}{', times nominal' if self.relative else ''}{within}{each}" + self._where

    @property
    def _where(self) -> str:
        return f", in {', '.join(self.only)} only" if self.only else ""


@dataclass(frozen=True)
class Variation:
    """All that is varied, and which of it goes together."""

    varied: tuple[Varied, ...]
    correlated: tuple[tuple[tuple[str, str], float], ...] = ()
    """Pairs of inputs, with the correlation of the normal numbers that are behind them (a Gaussian copula)."""
    _root: F64 = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        followed = [(one, name) for one in self.varied if one.kind == "follows" for name in one.given[:-2]]
        there = [name for one in self.varied if one.kind != "follows" and not one.lists for name in one.inputs]
        for one, name in followed:
            if name not in there:
                hint = did_you_mean(name, there, f"there are {', '.join(there)}")
                raise BenchError(f"{one.key} follows {name}, which is not varied: {hint}")
        places = dict(self._places())
        matrix = np.eye(self.dimensions)
        for pair, r in self.correlated:
            for name in pair:
                if name not in places:
                    hint = did_you_mean(name, places, f"there are {', '.join(places)}")
                    raise BenchError(f"correlated: '{name}' is not varied by a distribution of its own: {hint}")
            a, b = (places[name] for name in pair)
            matrix[a, b] = matrix[b, a] = r
        try:
            root = np.linalg.cholesky(matrix)
        except np.linalg.LinAlgError:
            names = ", ".join(f"{a} and {b}: {r:g}" for (a, b), r in self.correlated)
            raise BenchError(f"these correlations contradict each other ({names}): give smaller ones") from None
        object.__setattr__(self, "_root", root)

    def _places(self) -> Iterator[tuple[str, int]]:
        at = 0
        for one in self.varied:
            if one.continuous:
                yield from ((name, at + k) for k, name in enumerate(one.inputs))
            at += one.dimensions

    @cached_property
    def _begins(self) -> dict[str, int]:
        """The first uniform number of each, by its key."""
        ends = np.cumsum([one.dimensions for one in self.varied]).tolist()
        return dict(zip((one.key for one in self.varied), [0, *ends], strict=False))

    @property
    def dimensions(self) -> int:
        """Uniform numbers that a drive takes."""
        return sum(one.dimensions for one in self.varied)

    @property
    def factors(self) -> tuple[str, ...]:
        """What each of the uniform numbers stands for."""
        return tuple(name for one in self.varied for name in one.factors)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of what is varied, in the order of `of`."""
        return tuple(name for one in self.varied for name in one.inputs)

    def of(self, uniform: F64) -> F64:
        """Values (n, inputs) for uniform numbers (n, dimensions)."""
        if self.correlated:
            from scipy.special import ndtr, ndtri

            uniform = ndtr(ndtri(np.clip(uniform, EDGE, 1.0 - EDGE)) @ self._root.T)
        found = {name: np.empty(0) for name in self.inputs}
        for one in sorted(self.varied, key=lambda one: one.kind == "follows"):
            own = uniform[:, (at := self._begins[one.key]) : at + one.dimensions]
            if one.kind == "follows":
                values = one.after(np.stack([found[name] for name in one.given[:-2]], 1), own)
            else:
                values = one.of(own)
            found |= dict(zip(one.inputs, values.T, strict=True))
        return np.stack(list(found.values()), 1) if found else np.empty((len(uniform), 0))

    def changes(self, values: Sequence[float], figures: Mapping[str, Any], design: str = "") -> dict[str, Any]:
        """What stands in the configuration `figures` of a design for `values` (inputs,): by dotted key."""
        found: dict[str, Any] = {}
        ends = np.cumsum([len(one.inputs) for one in self.varied]).tolist()
        for one, at in zip(self.varied, [0, *ends], strict=False):
            if one.only and design not in one.only:
                continue
            if one.lists:
                found[one.key.partition(AT)[0]] = list(one.given[round(values[at])])
            else:
                told = {name.partition(AT)[0]: value for name, value in zip(one.inputs, values[at:], strict=False)}
                put(told, figures, found)
        return found


def in_design(one: Varied, design: str) -> Varied:
    """What is varied in one design alone."""
    return replace(
        one, key=f"{one.key}{AT}{design}", inputs=tuple(f"{name}{AT}{design}" for name in one.inputs), only=(design,)
    )


def put(values: Mapping[str, float], figures: Mapping[str, Any], found: dict[str, Any]) -> None:
    """Put `values`, by the names of inputs, into `found`: what stands in the place of keys of `figures`."""
    for name, value in values.items():
        dotted, k, there = leaf(figures, name)
        if k is None:
            found[dotted] = whole(value) if isinstance(there, int) else value
        else:
            found.setdefault(dotted, list(there))[k] = value


def whole(value: float) -> float | int:
    """A whole number as an int."""
    return int(value) if float(value).is_integer() else value


def leaf(figures: Mapping[str, Any], name: str) -> tuple[str, int | None, Any]:
    """Dotted key, position in a list and value of an input; BenchError where the configuration has none of that name.

    The position is None where the key is a number, or a list that is named as a whole.
    """
    there: Any = figures
    for key in name.split("."):
        if isinstance(there, Mapping) and key not in there and not isinstance(there, list | tuple):
            stem, _, number = key.rpartition("_")
            if (
                isinstance(there.get(stem), list | tuple)
                and number.isdecimal()
                and 1 <= int(number) <= len(there[stem])
            ):
                return f"{name[: -len(key)]}{stem}", int(number) - 1, there[stem]
        there = there.get(key) if isinstance(there, Mapping) else None
        if there is None:
            known = [dotted for dotted, _ in leaves(figures)]
            hint = did_you_mean(name, known, "bench sim --help names the file that has them all")
            raise BenchError(f"the configuration has no {name}: {hint}")
    if isinstance(there, Mapping):
        raise BenchError(f"{name} is a section: name one of {', '.join(f'{name}.{key}' for key in there)}")
    return name, None, there


def read_varied(key: str, given: Any, figures: Mapping[str, Any], where: str) -> Varied:
    """A line of [vary]: `given` for a key of the configuration. BenchError for what it cannot be."""
    what = f"vary.{key!r} in {where}"
    kinds = [kind for kind in KINDS if isinstance(given, Mapping) and kind in given]
    if len(kinds) != 1:
        forms = "; ".join(f"{{ {kind} = {form} }}" for kind, form in KINDS.items())
        raise BenchError(f"{what} must have one of {forms}; got {given!r}")
    (kind,) = kinds
    for option, value in given.items():
        if option != kind and option not in OPTIONS:
            hint = did_you_mean(option, OPTIONS, f"there are {', '.join(OPTIONS)}")
            raise BenchError(f"{what} has an unknown '{option}': {hint}")
        if option in OPTIONS and not isinstance(value, OPTIONS[option]):
            raise BenchError(f"{what}: {option} must be {_form(OPTIONS[option])}, got {value!r}")
    others = set(OF_FOLLOWERS) if kind != "follows" else set(OPTIONS) - set(OF_FOLLOWERS)
    if unfit := sorted(given.keys() & others):
        raise BenchError(f"{what}: {unfit[0]} does not go with {kind}")
    dotted, k, there = leaf(figures, key)
    base = [there[k]] if k is not None else list(there) if isinstance(there, list | tuple) else [there]
    inputs = [key] if len(base) == 1 else [f"{dotted}_{number}" for number in range(1, len(base) + 1)]
    if kinds == ["choice"] and isinstance(given["choice"], list) and isinstance((given["choice"] or [0])[0], list):
        inputs = [key]
    if kind == "follows":
        return _follower(key, given, tuple(inputs), base, figures, what)
    relative = bool(given.get("relative"))
    if relative and not all(base):
        raise BenchError(f"{what}: relative to a nominal value of 0 it would stay 0: leave out relative")
    values = given[kind]
    _check_values(kind, values, len(base), what)
    if isinstance(base[0], int) and (kind != "choice" or relative):
        raise BenchError(f"{what}: {key} is a whole number: give the ones to choose from, {{ choice = [4, 5] }}")
    if kind == "choice" and isinstance(values[0], list) and relative:
        raise BenchError(f"{what}: lists to choose from cannot be relative")
    within = _numbers(given.get("within", [-math.inf, math.inf]), f"{what}: within", 2, finite=False)
    if within[0] >= within[1]:
        raise BenchError(f"{what}: within must be [lowest, highest], got {list(within)}")
    made = Varied(
        key, kind, tuple(values), tuple(inputs), tuple(map(float, base)), relative, bool(given.get("together")),
        (within[0], within[1]),
    )  # fmt: skip
    if kind != "choice" and made.share < LEAST_SHARE:
        raise BenchError(f"{what}: nothing of the distribution lies within {list(within)}")
    return made


def _follower(
    key: str, given: Mapping[str, Any], inputs: tuple[str, ...], base: Sequence[float], figures: Mapping[str, Any],
    what: str,
) -> Varied:  # fmt: skip
    other, factor, sd = given["follows"], float(given.get("factor", 1.0)), float(given.get("sd", 0.0))
    dotted, k, there = leaf(figures, str(other))
    n = len(there) if k is None and isinstance(there, list | tuple) else 1
    if n != len(inputs):
        raise BenchError(f"{what}: it is {len(inputs)} numbers, and {other} is {n}")
    if not (math.isfinite(factor) and 0.0 <= sd < math.inf):
        raise BenchError(f"{what}: factor must be a number and sd one from 0 on, got {factor:g} and {sd:g}")
    names = [other] if n == 1 else [f"{dotted}_{number}" for number in range(1, n + 1)]
    return Varied(key, "follows", (*names, factor, sd), inputs, tuple(map(float, base)))


def _check_values(kind: str, values: Any, n: int, what: str) -> None:
    if kind == "choice":
        if not isinstance(values, list) or not values:
            raise BenchError(f"{what}: choice must be a list of values, got {values!r}")
        if isinstance(values[0], list):
            for one in values:
                _numbers(one, f"{what}: choice", n)
        else:
            _numbers(values, f"{what}: choice", len(values))
        return
    numbers = _numbers(values, f"{what}: {kind}", 3 if kind == "triangular" else 2)
    fits = numbers[1] > 0.0 if kind == "normal" else list(numbers) == sorted(numbers) and numbers[0] < numbers[-1]
    if not fits:
        raise BenchError(f"{what}: {kind} must be {KINDS[kind]}, got {values!r}")


def _numbers(values: Any, what: str, n: int, finite: bool = True) -> tuple[float, ...]:
    fits = isinstance(values, list | tuple) and len(values) == n
    fits = fits and all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
    if not fits or not all((math.isfinite(v) if finite else not math.isnan(v)) for v in values):
        raise BenchError(f"{what} must be {n} number{'s' * (n > 1)}, got {values!r}")
    return tuple(map(float, values))


def _form(kind: Any) -> str:
    return {bool: "true or false", list: "a list"}.get(kind, "a number")
