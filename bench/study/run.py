"""`bench study run` without the command line: rows that are missing are computed, and kept as they come."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from bench.errors import BenchError
from bench.rig.screen import Screen
from bench.study.engine import Engine, Rate, open_engine
from bench.study.experiments import course, limits_of, lost, test_of
from bench.study.schedule import Crashed
from bench.study.store import FOLDER, Store
from bench.study.study import TURN, Study, read_study
from bench.study.worker import identity
from protocol.text import counted
from sim.ports.direct import ConfigError, Driven, with_values

WORK = "bench.study.experiments:compute"


@dataclass(frozen=True)
class StudyOptions:
    """What `bench study run` was asked for."""

    file: Path
    """Of the study, a TOML."""
    out: Path | None = None
    """Folder for the rows; None: beside the study, by its name."""
    samples: int | None = None
    """Drives, where not as many as the file says."""
    workers: int | None = None
    """Processes; None: one for each core."""
    cluster: str | None = None
    """Address of a dask scheduler."""
    overwrite: bool = False


def run(options: StudyOptions, screen: Screen, clock: Callable[[], float]) -> Path:
    """Compute what is missing of a study, and return its folder. BenchError for what cannot be done."""
    study = read_study(options.file, samples=options.samples)
    check(study)
    folder = options.out or options.file.with_suffix(FOLDER)
    with Store(folder, study, identity(), options.overwrite) as store:
        there, total = int(store.done.sum()), len(study)
        if there:
            screen.note(f"{folder}: {counted(there, 'row')} of {total} there already")
        if there < total:
            with open_engine(options.workers, options.cluster, screen.note) as engine:
                fill(store, study, engine, screen, clock)
    return folder


def fill(store: Store, study: Study, engine: Engine, screen: Screen, clock: Callable[[], float]) -> None:
    """Compute what is missing of a study."""
    rate = Rate(len(study), clock, int(store.done.sum()))
    screen.progress(rate.said("rows"))
    for done in engine.run(study.text, WORK, store.missing()):
        if isinstance(done, Crashed):
            (row,) = done.rows
            screen.note(f"row {row}: {done.why}")
            store.add(lost(study, row, done.why), "")
        else:
            store.add(done.result, done.worker)
        rate.add(len(done.rows))
        screen.progress(rate.said("rows"))


def check(study: Study) -> None:
    """BenchError where an experiment cannot be done with the nominal drive, or two measure the same."""
    names: set[str] = set()
    for experiment in study.experiments:
        tests = {test_of(name, limits) for name, limits in limits_of(study, experiment).items()}
        if double := sorted(names & tests):
            raise BenchError(f"two experiments have a test {double[0]}: leave it out of one of them")
        names |= tests
        for design in study.designs if experiment.kind == TURN else ():
            try:
                Driven(with_values(study.figures[design], {}), 0, course(experiment))
            except ConfigError as error:
                where = f"experiments.{experiment.name}" + (f", design {design}" if design else "")
                raise BenchError(f"{where}: {error}") from None
