"""The search of `bench tune`: Optuna asks, a measure tells, a batch of trials at a time; what is told is kept on disk.

Only this process talks to Optuna and its file; workers get rows of a study. So no storage on a cluster is needed, and
nothing there imports Optuna. One objective: TPE, which needs few trials, takes whole numbers and choices, and learns
from trials that could not be. Several: NSGA-II, which spreads its trials over the whole Pareto front.

A trial's numbers are drawn by a seed of its own, after all trials of the batches before it. So a search that was
interrupted makes the same trials as one that was not, and so do one worker and a hundred.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from bench.errors import BenchError
from bench.study.objectives import Objective, Parameter
from bench.study.sampling import noise_seed

LEAST_BATCH, MOST_POPULATION = 4, 50
FIRST = 10  # trials of TPE that are random
OUT = 1e9  # in place of an objective that a trial does not have
WHY, LACKING = "why", "lacking"


@dataclass(frozen=True)
class Trial:
    """One set of parameters, and its objectives."""

    number: int
    values: Mapping[str, float]
    """Of parameters, by key."""
    objectives: tuple[float, ...]
    """NaN where it does not have one."""
    lacking: int
    """Rows that tripped, or could not be."""
    why: str
    """Why it is out of the running; empty if it is not."""


class Taken(Protocol):
    """What a measure has found with one set of parameters."""

    @property
    def objectives(self) -> tuple[float, ...]:
        """One for each, NaN where that is not known."""

    @property
    def lacking(self) -> int:
        """Rows that tripped, or could not be."""

    @property
    def why(self) -> str:
        """Why there is nothing to measure; empty if there is."""


Measure = Callable[[Sequence[Mapping[str, float]]], Sequence[Taken]]
"""Of sets of parameters what was found with each; an empty set: as it is."""


def batch_of(trials: int, objectives: int) -> int:
    """Trials that are asked for at once: for NSGA-II a generation."""
    return LEAST_BATCH if objectives == 1 else max(LEAST_BATCH, min(MOST_POPULATION, trials // 8))


class Search:
    """Trials in a file, which is made where there is none.

    Args:
        seed, batch: what the trials depend on besides.
    """

    def __init__(
        self, file: Path, parameters: Sequence[Parameter], objectives: Sequence[Objective], seed: int, batch: int
    ) -> None:
        self._optuna = optuna = imported()
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self._parameters, self._objectives, self._seed, self._batch = parameters, objectives, seed, batch
        self._distributions = {one.key: one.distribution(optuna) for one in parameters}
        directions = ["minimize" if one.sign > 0 else "maximize" for one in objectives]
        if file.exists():  # what a power cut has left of a line
            content = file.read_bytes()
            file.write_bytes(content[: content.rfind(b"\n") + 1])
        backend = optuna.storages.journal.JournalFileBackend(str(file), _NoLock())
        storage = optuna.storages.JournalStorage(backend)
        with _quiet():
            self._disk = optuna.create_study(
                storage=storage, study_name="tune", directions=directions, load_if_exists=True
            )
            self._study = optuna.create_study(directions=directions)
            self._study.add_trials(self._disk.trials)

    @property
    def trials(self) -> list[Trial]:
        """What there is."""
        return [
            Trial(
                one.number, dict(one.params), tuple(one.values) if not one.user_attrs[WHY] else
                tuple(np.nan if abs(value) == OUT else value for value in one.values),
                one.user_attrs[LACKING], one.user_attrs[WHY],
            )
            for one in self._study.trials
            if one.values
        ]  # fmt: skip

    def run(self, total: int, measure: Measure, allowed: int) -> Iterator[Trial]:
        """Go on to `total` trials; those with which more than `allowed` rows are lacking are out."""
        while (begin := len(self._study.trials)) < total:
            asked = []
            for number in range(begin, min(total, begin + self._batch - begin % self._batch)):
                self._study.sampler = self._sampler(noise_seed(self._seed, number, 0))
                with _quiet():
                    asked.append(self._study.ask(self._distributions))
            for trial, taken in zip(asked, measure([trial.params for trial in asked]), strict=True):
                self._tell(trial, taken, allowed)
            yield from self.trials[begin:]

    def _tell(self, trial: Any, taken: Taken, allowed: int) -> None:
        lacks = [one.name for one, value in zip(self._objectives, taken.objectives, strict=True) if np.isnan(value)]
        why = taken.why or (f"no {lacks[0]}" if lacks else "")
        if not why and taken.lacking > allowed:
            why = f"{taken.lacking} rows tripped or could not be, {allowed} as it was"
        trial.set_user_attr(WHY, why)
        trial.set_user_attr(LACKING, taken.lacking)
        values = [
            one.sign * OUT if np.isnan(value) else value
            for one, value in zip(self._objectives, taken.objectives, strict=True)
        ]
        with _quiet():
            self._study.tell(trial, values)
            self._disk.add_trial(self._study.trials[trial.number])

    def _sampler(self, seed: int) -> Any:
        samplers = self._optuna.samplers

        def out(trial: Any) -> tuple[float]:
            return (1.0 + trial.user_attrs[LACKING] if trial.user_attrs[WHY] else 0.0,)

        with _quiet():
            if len(self._objectives) == 1:
                return samplers.TPESampler(
                    n_startup_trials=FIRST, multivariate=True, constant_liar=True, constraints_func=out, seed=seed
                )
            return samplers.NSGAIISampler(population_size=self._batch, constraints_func=out, seed=seed)


def front(trials: Sequence[Trial], objectives: Sequence[Objective]) -> list[Trial]:
    """The trials that no other one is better than, in the order of the first objective; of one objective the best."""
    able = [one for one in trials if not one.why]
    if not able:
        return []
    costs = np.array([one.objectives for one in able]) * [one.sign for one in objectives]
    better = (costs[:, None] <= costs[None]).all(2) & (costs[:, None] < costs[None]).any(2)
    found = {tuple(costs[k]): able[k] for k in np.flatnonzero(~better.any(0))[::-1]}  # of equal ones the first
    return [found[cost] for cost in sorted(found)]


def middle(points: Sequence[Trial], objectives: Sequence[Objective]) -> Trial:
    """Of a front the point that is nearest to the best of all objectives, each by its span over the front."""
    costs = np.array([one.objectives for one in points]) * [one.sign for one in objectives]
    span = np.ptp(costs, 0)
    far = (costs - costs.min(0)) / np.where(span > 0.0, span, 1.0)
    return points[int(np.argmin((far**2).sum(1)))]


def imported() -> Any:
    """Optuna, or BenchError."""
    try:
        import optuna
    except ImportError:
        raise BenchError("bench tune needs Optuna: pip install 'hallbench[study]'") from None
    return optuna


class _NoLock:
    """The folder is locked already; one of Optuna's would outlive a killed process."""

    def acquire(self) -> bool:
        """Nothing."""
        return True

    def release(self) -> None:
        """Nothing."""


@contextmanager
def _quiet() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
