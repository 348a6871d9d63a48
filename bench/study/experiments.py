"""What is done with the drive of a row: a course without a link, acceptance tests, or a function of the user's own.

`compute` is what workers are given. A row depends on the study's text and its number, and on nothing else: not on the
machine, the batch or the rows before it.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.errors import BenchError
from bench.files import RUN, file_name
from bench.rig.connection import SIM
from bench.rig.drive import DriveTripped
from bench.rig.envelope import Envelope
from bench.rig.notebook import Simulated, open_rig
from bench.rig.outputs import Recording
from bench.rig.rig import Rig
from bench.rig.screen import Screen
from bench.rig.settings import Settings
from bench.signal.limits import Limits
from bench.signal.verdict import Verdict
from bench.study.recorded import recording
from bench.study.study import ACCEPT, FUNCTION, TURN, Experiment, Study
from protocol.errors import HbpError
from sim.ports.direct import BenchParams, ConfigError, Course, Driven, measured_by, with_values

INPUT, MEASURED, VERDICT, WHY = "x.", "m.", "v.", "why."
"""What names of columns begin with: of inputs, measurements, verdicts of tests, and the reasons for these."""
F64 = NDArray[np.float64]
WHOLE = ("row", "sample", "repetition", "design", "seed")
NO_ENDS = (None, None)
TRIPPED = Limits("tripped", "", hi=0.0, about="the firmware has switched off")
MOST_WHY = 200  # characters of a reason
DRIVE = "drive.toml"


@dataclass
class Outcome:
    """What an experiment gave, by names that are the study's."""

    measured: dict[str, float] = field(default_factory=dict)
    """By TEST.MEASUREMENT."""
    verdicts: dict[str, Verdict] = field(default_factory=dict)
    """By test."""
    why: dict[str, str] = field(default_factory=dict)
    """Of tests that did not pass."""

    def add(self, other: Outcome) -> None:
        """Add what another experiment gave."""
        self.measured |= other.measured
        self.verdicts |= other.verdicts
        self.why |= other.why

    def judge(self, test: str, limits: Mapping[str, Limits]) -> None:
        """The verdict of a test by the limits of TEST.MEASUREMENT; INVALID where one is not known."""
        values = {name: self.measured.get(name, math.nan) for name, of in limits.items() if (of.lo, of.hi) != NO_ENDS}
        unknown = [name for name, value in values.items() if math.isnan(value)]
        outside = [name for name, value in values.items() if name not in unknown and not limits[name].allow(value)]
        verdict = Verdict.FAIL if outside else Verdict.INVALID if unknown else Verdict.PASS
        self.end(test, verdict, ", ".join(f"{limits[name].name} = {values[name]:.4g}" for name in outside or unknown))

    def end(self, test: str, verdict: Verdict, why: str = "") -> None:
        """A test ended like this."""
        self.verdicts[test] = verdict
        if why:
            self.why[test] = why[:MOST_WHY]


def compute(plan: bytes, rows: Sequence[int]) -> bytes:
    """The rows with these numbers of the study whose text `plan` is, as an Arrow stream."""
    study = Study.of(plan)
    inputs = study.inputs(rows)
    return _stream([row_of(study, row, inputs[k]) for k, row in enumerate(rows)])


def _stream(rows: Sequence[Mapping[str, Any]]) -> bytes:
    import pyarrow as pa

    names = dict.fromkeys(name for one in rows for name in one)
    table = pa.table({name: pa.array([one.get(name) for one in rows], _kind(name)) for name in names})
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema) as stream:
        stream.write_table(table)
    result: bytes = sink.getvalue().to_pybytes()
    return result


def _kind(name: str) -> Any:
    import pyarrow as pa

    if name in WHOLE:
        return pa.int64()
    return pa.string() if name.startswith((VERDICT, WHY)) else pa.float64()


def row_of(study: Study, row: int, values: F64, save: Path | None = None) -> dict[str, Any]:
    """A row by the names of its columns; `values` (inputs,) are its inputs.

    `save`: a folder that gets what can be kept of what the drive does.
    """
    began = time.process_time()
    try:
        params = study.drive(row, values.tolist())
    except ConfigError as error:  # such a drive cannot be: it says nothing of those that can
        outcome = untested(study, Verdict.INVALID, f"no such drive: {error}")
    else:
        outcome, seed = Outcome(), study.noise(row)
        for experiment in study.experiments:
            outcome.add(PERFORM[experiment.kind](study, experiment, params, seed, save))
    return _row(study, row, values, outcome) | {"cpu_s": time.process_time() - began}


def untested(study: Study, verdict: Verdict, why: str) -> Outcome:
    """All tests of a study ended like this."""
    outcome = Outcome()
    for experiment in study.experiments:
        for test in tests_of(study, experiment):
            outcome.end(test, verdict, why)
    return outcome


def _row(study: Study, row: int, values: F64, outcome: Outcome) -> dict[str, Any]:
    found: dict[str, Any] = dict(zip(WHOLE, (row, *study.place(row), study.noise(row)), strict=True))
    found |= {INPUT + name: float(value) for name, value in zip(study.variation.inputs, values, strict=True)}
    found |= {MEASURED + name: value for name, value in outcome.measured.items()}
    found |= {VERDICT + test: verdict.value for test, verdict in outcome.verdicts.items()}
    return found | {WHY + test: why for test, why in outcome.why.items()}


def tests_of(study: Study, experiment: Experiment) -> list[str]:
    """Names of the tests of an experiment."""
    if experiment.kind != ACCEPT:
        return [experiment.name]
    return list(dict.fromkeys(test_of(name, limits) for name, limits in limits_of(study, experiment).items()))


def test_of(name: str, limits: Limits) -> str:
    """The test that measures what is called TEST.MEASUREMENT."""
    return name.removesuffix(f".{limits.name}")


@lru_cache(16)
def _limits_of(text: bytes, name: str) -> dict[str, Limits]:
    study = Study.of(text)
    experiment = next(one for one in study.experiments if one.name == name)
    if experiment.kind == ACCEPT:
        return _declared(experiment, study)
    units = measured_by(course(experiment)) if experiment.kind == TURN else {}
    limits = {key: Limits(key, unit) for key, unit in units.items()}
    limits |= {key: Limits(key, units.get(key, ""), **given) for key, given in experiment.limits.items()}
    if experiment.kind == TURN:
        if unknown := sorted(limits.keys() - units.keys()):
            raise BenchError(f"experiments.{name} measures no {unknown[0]}; it measures {', '.join(units)}")
        limits["tripped"] = TRIPPED
    return {f"{name}.{key}": one for key, one in limits.items()}


def limits_of(study: Study, experiment: Experiment) -> dict[str, Limits]:
    """Limits by TEST.MEASUREMENT on the nominal drive of the first design; of a course units of all it measures."""
    return _limits_of(study.text, experiment.name)


# -- a course without a link ----------------------------------------------------------------------------------------


def course(experiment: Experiment) -> Course:
    """What the drive is made to do."""
    given = experiment.given
    numbers = {name: float(given[name]) for name in ("load", "seconds", "settle")}
    return Course(
        speeds=tuple(map(float, given["speed"])),
        control=given["control"],
        observers=tuple(given["observers"]),
        **numbers,
    )


def run_in(save: Path, experiment: Experiment) -> Path:
    """The run that is kept of an experiment."""
    return save / f"{file_name(experiment.name)}{RUN}"


def _turned(study: Study, experiment: Experiment, params: BenchParams, seed: int, save: Path | None) -> Outcome:
    outcome, test = Outcome(), experiment.name
    try:
        driven = Driven(params, seed, course(experiment))
    except ConfigError as error:
        outcome.end(test, Verdict.INVALID, str(error))
        return outcome
    with ExitStack() as stack:
        if save is not None:
            rig, file = connected(params, seed), run_in(save, experiment)
            driven.watch = stack.enter_context(recording(file, rig, driven.channels))
        outcome.measured = {f"{test}.{name}": value for name, value in driven.measure().items()}
    if driven.fault:
        outcome.end(test, Verdict.FAIL, f"the drive tripped: {driven.fault}")
    else:
        outcome.judge(test, limits_of(study, experiment))
    return outcome


# -- acceptance tests -----------------------------------------------------------------------------------------------


class _Silent(Screen):
    """What pytest would say; nobody looks. `limits`: of what is listed."""

    def __init__(self) -> None:
        self.limits: dict[str, Limits] = {}

    def note(self, text: str) -> None:
        """Nothing."""

    def progress(self, text: str) -> None:
        """Nothing."""

    def pause(self) -> None:
        """Nothing."""

    def resume(self) -> None:
        """Nothing."""

    def confirm(self, question: str) -> bool:
        """Nobody can be asked."""
        return False

    def listed(self, name: str, limits: Limits, specified: Limits | None) -> None:
        """Keep it."""
        self.limits[name] = limits


def write_drive(file: Path, params: BenchParams) -> None:
    """Write a drive's configuration, for `bench accept --config`: all figures, so that none follows from others."""
    import tomli_w

    file.write_text(tomli_w.dumps(params.model_dump(mode="json")), encoding="utf-8")


def _accept(experiment: Experiment, params: BenchParams, **given: Any) -> tuple[Any, _Silent]:
    from bench.accept.accept import AcceptOptions, accept

    screen = _Silent()
    with tempfile.TemporaryDirectory(prefix="hallbench-", ignore_cleanup_errors=True) as folder:
        file, settings = Path(folder, DRIVE), Path(folder, "bench.toml")
        settings.write_text("", encoding="utf-8")  # not that of the folder that a worker happens to be in
        write_drive(file, params)
        tests = tuple(map(Path, experiment.given["tests"]))
        options = AcceptOptions(
            target="sim",
            tests=tests,
            keyword=experiment.given["accept"] or None,
            config=file,
            bench_toml=settings,
            **given,
        )
        result, _ = accept(options, screen)
    return result, screen


def _declared(experiment: Experiment, study: Study) -> dict[str, Limits]:
    _, screen = _accept(experiment, with_values(study.figures[study.designs[0]], {}), list_only=True)
    return screen.limits


def _accepted(study: Study, experiment: Experiment, params: BenchParams, seed: int, save: Path | None) -> Outcome:
    outcome = Outcome()
    result, _ = _accept(experiment, params, seed=seed, report=save and save / file_name(experiment.name))
    for test in result.tests:
        outcome.measured |= {one.name: one.value for one in test.measurements if one.value is not None}
        missed = ", ".join(f"{one.limits.name} = {one.value:.4g}" for one in test.measurements if one.failed)
        outcome.end(test.name, test.verdict, test.why or missed)
    return outcome


# -- a function of one's own ----------------------------------------------------------------------------------------


@lru_cache(8)
def _function(file: str, name: str, source: str) -> Callable[[Any], Mapping[str, float]]:
    space: dict[str, Any] = {"__name__": Path(file).stem, "__file__": file}
    exec(compile(source, file, "exec"), space)
    if not callable(found := space.get(name)):
        raise BenchError(f"{file} has no function {name}")
    function: Callable[[Any], Mapping[str, float]] = found
    return function


def connected(params: BenchParams, seed: int, save: Path | None = None) -> Rig:
    """A rig with this drive behind a link, in virtual time; `save`: the run that is recorded."""
    simulated: Simulated = {"config": params.model_dump(mode="json"), "seed": seed}
    return open_rig(SIM, Settings(), Envelope(), True, None, Recording(save), simulated)


def _by_function(study: Study, experiment: Experiment, params: BenchParams, seed: int, save: Path | None) -> Outcome:
    outcome, test = Outcome(), experiment.name
    file, _, name = experiment.given["function"].partition(":")
    function = _function(file, name, experiment.given["sources"][file])
    try:
        with connected(params, seed, save and run_in(save, experiment)) as rig:
            told = function(rig)
        outcome.measured = {f"{test}.{key}": float(value) for key, value in dict(told).items()}
    except DriveTripped as error:
        outcome.end(test, Verdict.FAIL, str(error))
    except AssertionError as error:
        outcome.end(test, Verdict.FAIL, str(error) or "an assertion failed")
    except (BenchError, HbpError) as error:
        outcome.end(test, Verdict.INVALID, str(error))
    except Exception as error:  # whatever another's code raises
        outcome.end(test, Verdict.ERROR, f"{type(error).__name__}: {error}")
    else:
        outcome.judge(test, limits_of(study, experiment))
    return outcome


def lost(study: Study, row: int, why: str) -> bytes:
    """A row that cannot be computed, as `compute` makes one: ERROR of each test."""
    outcome = untested(study, Verdict.ERROR, why)
    return _stream([_row(study, row, study.inputs([row])[0], outcome) | {"cpu_s": 0.0}])


PERFORM = {TURN: _turned, ACCEPT: _accepted, FUNCTION: _by_function}
"""What is done in each kind of experiment."""
