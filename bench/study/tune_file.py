"""The TOML of `bench tune`, complete and checked; and what came of it.

A tune is a study in whose TOML stands besides

    [tune]
    trials = 200
    [tune.parameters]
    "firmware.vector_tracking.k_p_vt" = { log = [300, 5000] }
    [tune.objectives]
    noise = { of = "slow.vector_tracking.rms", over = "p95", sense = "minimise" }
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from bench.errors import BenchError
from bench.files import read_toml
from bench.study.experiments import course, limits_of, tests_of
from bench.study.objectives import (
    F64,
    Objective,
    Parameter,
    read_objectives,
    read_parameter,
    with_parameters,
)
from bench.study.search import Trial, batch_of
from bench.study.statistics import Estimate
from bench.study.study import FUNCTION, TURN, Study, config_of, study_of
from bench.study.worker import identity
from protocol.text import did_you_mean
from sim.ports.direct import measured_by, nominal

TUNE: dict[str, Any] = {
    "trials": int, "seed": int, "batch": int, "check": (int, list), "recordings": list,
    "parameters": dict, "objectives": dict,
}  # fmt: skip


@dataclass(frozen=True)
class Found:
    """What a measure has found with one set of parameters."""

    objectives: tuple[float, ...]
    lacking: int
    why: str = ""
    drives: tuple[F64, ...] = ()
    """By objective (drives, repetitions)."""


@dataclass(frozen=True)
class Plan:
    """A tune as its TOML says it."""

    name: str
    trials: int
    seed: int
    batch: int
    parameters: tuple[Parameter, ...]
    objectives: tuple[Objective, ...]
    study: Study | None
    """None: recordings are measured."""
    config: Path | None
    given: Mapping[str, Any]
    """The configuration's keys that the file sets."""
    recordings: tuple[str, ...]
    check: Any
    """Drives, or recordings, that what was found is checked on."""

    @property
    def text(self) -> str:
        """All that trials depend on but for how many there are."""
        study = None if self.study is None else self.study.plan
        parts = {
            "study": study, "parameters": [asdict(one) for one in self.parameters], "recordings": self.recordings,
            "objectives": [asdict(one) for one in self.objectives], "seed": self.seed, "batch": self.batch,
            "program": identity(),
        }  # fmt: skip
        return json.dumps(parts, indent=1)

    def overrides(self, values: Mapping[str, float]) -> dict[str, Any]:
        """The configuration's keys with these parameters."""
        return {**self.given, **with_parameters(_base(self.study), values)}

    def figures(self, values: Mapping[str, float]) -> dict[str, Any]:
        """All figures of the drive with them. ConfigError for one that cannot be."""
        return nominal(self.config, self.overrides(values))


@dataclass
class Tuned:
    """What came of it."""

    plan: Plan
    folder: Path
    before: Found
    """As it was, on the drives of the search."""
    trials: list[Trial]
    points: list[Trial]
    """The front; of one objective the best trial. Empty where none can be used."""
    best: Trial | None
    checked: dict[int, list[tuple[float, float, Estimate, float]]] = field(default_factory=dict)
    """On other drives, by trial, for each objective: as it was, with the trial's parameters, difference, share of
    drives that are better."""


def _base(study: Study | None) -> Mapping[str, Any]:
    return nominal(None, {}) if study is None else next(iter(study.figures.values()))


# -- reading --------------------------------------------------------------------------------------------------------


def read_tune(path: Path, trials: int | None = None) -> Plan:
    """Read the TOML of a tune. BenchError for what cannot be done."""
    data, where = read_toml(path, "tune file"), str(path)
    given = data.pop("tune", None)
    if not isinstance(given, dict):
        raise BenchError(f"{where} has no [tune]: it is a study, for bench study run")
    for key, value in given.items():
        if key not in TUNE:
            hint = did_you_mean(key, TUNE, f"there are {', '.join(TUNE)}")
            raise BenchError(f"unknown key tune.{key} in {where}: {hint}")
        if not isinstance(value, TUNE[key]) or isinstance(value, bool):
            raise BenchError(f"tune.{key} in {where} cannot be {value!r}")
    if "designs" in data:
        raise BenchError(f"{where}: designs cannot be tuned: each trial is one; put what they set into [set]")
    numbers = {
        "trials": trials or given.get("trials", 200),
        "seed": given.get("seed", 1),
        "batch": given.get("batch", 1),
    }
    for key, least in (("trials", 1), ("seed", 0), ("batch", 1)):
        if numbers[key] < least:
            raise BenchError(f"tune.{key} in {where} must be at least {least}, got {numbers[key]}")
    wanted, recordings = (
        given.get("objectives"),
        tuple(str(path.parent / str(run)) for run in given.get("recordings", ())),
    )
    if recordings and (unused := [key for key in ("experiments", "vary", "samples") if key in data]):
        raise BenchError(f"{where}: with tune.recordings there is no {unused[0]}: tune on one of the two")
    study = None if recordings else study_of(data, path)
    units, tests = (None, ()) if study is None else _measured(study, wanted)
    objectives = read_objectives(wanted, units, tests, where)
    lines = given.get("parameters") or {}
    if not lines:
        raise BenchError(f'{where} tunes nothing: write [tune.parameters] with "KEY" = {{ range = [lowest, highest] }}')
    parameters = tuple(read_parameter(key, one, _base(study), where, study is not None) for key, one in lines.items())
    if study is not None and (double := [one.key for one in parameters if one.key in study.variation.inputs]):
        raise BenchError(f"{double[0]} in {where} is varied from drive to drive: it cannot be tuned as well")
    if study is None:
        objectives = [Objective(**{**asdict(one), "unit": "deg"}) for one in objectives]
        _require_settings(parameters, objectives, where)
    checked = given.get("check", 0 if study is None else study.plan["samples"])
    if isinstance(checked, list) != (study is None) and checked:
        raise BenchError(
            f"tune.check in {where} must be {'a list of recordings' if study is None else 'a number of drives'}"
        )
    if isinstance(checked, list):
        checked = tuple(str(path.parent / str(run)) for run in checked)
    batch = given.get("batch") or batch_of(numbers["trials"], len(objectives))
    config = None if study is None else config_of(data, path)
    return Plan(
        data.get("name", path.stem), numbers["trials"], numbers["seed"], batch, parameters, tuple(objectives), study,
        config, data.get("set", {}), recordings, checked,
    )  # fmt: skip


def _measured(study: Study, wanted: Any) -> tuple[dict[str, str], list[str]]:
    """Units by what experiments measure, and their tests. What functions measure shows when they run."""
    units: dict[str, str] = {}
    tests: list[str] = []
    for experiment in study.experiments:
        tests += tests_of(study, experiment)
        if experiment.kind == TURN:
            units |= {f"{experiment.name}.{key}": unit for key, unit in measured_by(course(experiment)).items()}
        elif experiment.kind == FUNCTION:
            each = wanted.items() if isinstance(wanted, dict) else ()
            named = [one["of"] if isinstance(one, dict) and "of" in one else name for name, one in each]
            units |= {str(name): "" for name in named if str(name).startswith(f"{experiment.name}.")}
        units |= {name: limits.unit for name, limits in limits_of(study, experiment).items() if name not in units}
    return units, tests


def _require_settings(parameters: Iterable[Parameter], objectives: Sequence[Objective], where: str) -> None:
    from bench.replay.estimators import entry_of

    known = [name for one in objectives for name in entry_of(one.of.partition(".")[0]).parameters]
    for one in parameters:
        if (name := one.key.rpartition(".")[2]) not in known:
            hint = did_you_mean(name, known, f"they take {', '.join(dict.fromkeys(known))}")
            raise BenchError(
                f"tune.parameters.{one.key!r} in {where}: no observer that is looked at takes {name}: {hint}"
            )
