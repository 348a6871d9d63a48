"""`bench tune` without the command line: parameters of a drive that make figures of a study, or of recordings, small.

Each trial is a design of that study: the same drives with the same noise. What is found is measured again on other
drives, with other noise, beside what there was: the best of many trials owes a part of it to the drives of the search.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.errors import BenchError
from bench.files import write
from bench.rig.screen import Screen
from bench.study.engine import Engine, Rate, open_engine
from bench.study.experiments import MEASURED, VERDICT, WHY
from bench.study.objectives import F64, LOST, YIELD, Objective
from bench.study.run import WORK, check, fill
from bench.study.schedule import Crashed
from bench.study.search import Search, Trial, front, imported, middle
from bench.study.statistics import Estimate
from bench.study.store import ELSEWHERE, LOCK, STUDY, Store, locked, table_in
from bench.study.study import Study
from bench.study.tune_file import Found, Plan, Tuned, read_tune
from bench.study.tuned import write_results
from bench.study.worker import identity
from protocol.text import counted, did_you_mean
from sim.ports.direct import ConfigError

FOLDER = ".tune"
PLAN, TRIALS, CHECK = "tune-plan.json", "trials.log", "check.study"
RESULTS = ("tune.json", "trials.csv", "tune.png", "best.toml", "best-drive.toml")
AS_IT_WAS = "as it was"
MOST_POINTS = 12  # of a front that are checked


@dataclass(frozen=True)
class TuneOptions:
    """What `bench tune` was asked for."""

    file: Path
    """Of the tune, a TOML."""
    out: Path | None = None
    """Folder; None: beside the file, by its name."""
    trials: int | None = None
    """In all, where not as many as the file says."""
    workers: int | None = None
    cluster: str | None = None
    overwrite: bool = False


# -- measuring ------------------------------------------------------------------------------------------------------


def summed(objectives: Sequence[Objective], drives: Sequence[F64], why: str = "") -> Found:
    """What a set of parameters gives, of what each drive has."""
    lacking = int(np.isnan(np.array(drives)).any(0).sum())
    return Found(
        tuple(one.of_drives(of) for one, of in zip(objectives, drives, strict=True)), lacking, why, tuple(drives)
    )


class Drives:
    """Simulated drives: a trial is a design of the study."""

    def __init__(self, plan: Plan, engine: Engine, tell: Callable[[int], None]) -> None:
        assert plan.study
        self._plan, self._study, self._engine, self._tell = plan, plan.study, engine, tell

    def __call__(self, trials: Sequence[Mapping[str, float]]) -> list[Found]:
        """See `bench.study.search.Measure`."""
        figures: dict[str, Any] = {}
        cannot: dict[int, str] = {}
        for k, values in enumerate(trials):
            try:
                figures[f"trial {k}"] = self._plan.figures(values)
            except ConfigError as error:
                cannot[k] = f"no such drive: {error}"
        n = self._study.samples * self._study.repetitions
        self._tell(n * len(cannot))
        found = iter(self._of(Study({**self._study.plan, "figures": figures}), n) if figures else ())
        nothing = (np.nan,) * len(self._plan.objectives)
        return [Found(nothing, n, cannot[k]) if k in cannot else next(found) for k in range(len(trials))]

    def _of(self, study: Study, n: int) -> list[Found]:
        import pyarrow as pa

        tables = []
        for done in self._engine.run(study.text, WORK, range(len(study))):
            if not isinstance(done, Crashed):
                tables.append(pa.ipc.open_stream(done.result).read_all())
            self._tell(len(done.rows))
        table = pa.concat_tables(tables, promote_options="default") if tables else pa.table({"row": []})
        whys = [column for column in table.column_names if column.startswith(WHY)]
        each = drives_in(table, study, self._plan.objectives)
        return [
            summed(self._plan.objectives, drives, _reason(table, whys, study, k) if np.isnan(drives).all() else "")
            for k, drives in enumerate(each)
        ]


def _reason(table: Any, whys: Sequence[str], study: Study, design: int) -> str:
    for name in whys:
        for row, why in zip(table.column("row").to_pylist(), table.column(name).to_pylist(), strict=True):
            if why and study.place(row)[2] == design:
                return f"no drive does it: {why}"
    return "no drive does it"


def drives_in(table: Any, study: Study, objectives: Sequence[Objective]) -> list[list[F64]]:
    """By design, for each objective (drives, repetitions) of rows in a table."""
    rows = table.column("row").to_numpy().astype(int)
    shape = study.samples, study.repetitions, len(study.designs)
    found = []
    for one in objectives:
        name = (VERDICT if one.over == YIELD else MEASURED) + one.of
        values = np.full(len(study), np.nan)
        if name in table.column_names:
            column = table.column(name).to_pylist()
            if one.over == YIELD:
                column = [{"PASS": 1.0, "FAIL": 0.0}.get(str(verdict).upper()) for verdict in column]
            values[rows] = [np.nan if value is None else value for value in column]
        found.append(values.reshape(shape))
    return [[of[:, :, design] for of in found] for design in range(shape[2])]


class Recordings:
    """Recordings: observers run on them with a trial's parameters; each counts as a drive."""

    def __init__(self, plan: Plan, runs: Sequence[str], tell: Callable[[int], None] = lambda n: None) -> None:
        self._plan, self._runs, self._tell = plan, runs, tell

    def __call__(self, trials: Sequence[Mapping[str, float]]) -> list[Found]:
        """See `bench.study.search.Measure`."""
        return [self._of({key.rpartition(".")[2]: value for key, value in values.items()}) for values in trials]

    def _of(self, settings: Mapping[str, float]) -> Found:
        from bench.score.board import flat, score

        names = list(dict.fromkeys(one.of.partition(".")[0] for one in self._plan.objectives))
        figures: list[dict[str, float | None]] = []
        for run in self._runs:
            board = score([run], names, settings=settings)
            figures.append({f"{name}.{key}": v for name, of in board.pooled.items() for key, v in flat(of)})
            self._tell(1)
        drives = []
        for one in self._plan.objectives:
            observer, _, rest = one.of.partition(".")
            key = one.of if "." in rest else f"{observer}.moving.{rest}"
            if all(key not in of for of in figures):
                hint = did_you_mean(key, figures[0], f"there are {', '.join(figures[0])}")
                raise BenchError(f"tune.objectives.{one.name!r}: nothing measures {one.of}: {hint}")
            drives.append(np.array([[np.nan if of.get(key) is None else float(of[key] or 0.0)] for of in figures]))
        return summed(self._plan.objectives, drives)


# -- the whole ------------------------------------------------------------------------------------------------------


def tune(options: TuneOptions, screen: Screen, clock: Callable[[], float]) -> Tuned:
    """Search, check what was found, write it. BenchError for what cannot be done."""
    imported()
    plan = read_tune(options.file, options.trials)
    if plan.study is not None:
        check(plan.study)
    folder = options.out or options.file.with_suffix(FOLDER)
    with ExitStack() as stack:
        stack.enter_context(_begun(folder, plan, options.overwrite))
        engine = None
        if plan.study is not None:
            engine = stack.enter_context(open_engine(options.workers, options.cluster, screen.note))
        tuned = _searched(plan, folder, engine, screen, clock)
        if plan.study is not None and engine is not None:
            _check_drives(tuned, plan.study, engine, screen, clock)
        elif plan.check:
            _check_recordings(tuned)
        write_results(tuned)
    return tuned


def _begun(folder: Path, plan: Plan, overwrite: bool) -> Any:
    """The folder of this tune, locked."""
    lock, file = locked(folder, "bench tune"), folder / PLAN
    if overwrite:
        for name in (PLAN, TRIALS, *RESULTS):
            (folder / name).unlink(missing_ok=True)
    if file.exists():
        there, now = json.loads(file.read_text("utf-8")), json.loads(plan.text)
        if differ := [key for key in now if there.get(key) != now[key]]:
            raise BenchError(f"{folder} holds trials of another tune ({', '.join(differ)} differ): {ELSEWHERE}")
    elif [one.name for one in folder.iterdir() if one.name not in (LOCK, CHECK)]:
        raise BenchError(f"{folder} is there and holds no tune: choose another name with --out")
    write(file, plan.text, str(file))
    return lock


def _searched(plan: Plan, folder: Path, engine: Engine | None, screen: Screen, clock: Callable[[], float]) -> Tuned:
    search = Search(folder / TRIALS, plan.parameters, plan.objectives, plan.seed, plan.batch)
    there = len(search.trials)
    if there:
        screen.note(f"{folder}: {counted(there, 'trial')} of {plan.trials} there already")
    each = len(plan.recordings) if plan.study is None else plan.study.samples * plan.study.repetitions
    rate = Rate(max(plan.trials - there, 0) * each + each, clock)
    words = ""

    def tell(rows: int) -> None:
        rate.add(rows)
        screen.progress(f"{rate.said('drives' if plan.study else 'recordings')}{words}")

    measure: Any = Drives(plan, engine, tell) if engine else Recordings(plan, plan.recordings, tell)
    (before,) = measure([{}])
    for one, of in zip(plan.objectives, before.drives, strict=True):
        if np.isnan(of).all():
            raise BenchError(f"tune.objectives.{one.name!r}: as it is no drive has {one.of}; {before.why}".rstrip("; "))
    for trial in search.run(plan.trials, measure, before.lacking):
        if found := front(search.trials, plan.objectives):
            words = f"; {len(search.trials)} of {plan.trials} trials, {_told(plan, found[0])}"
            words = words if len(plan.objectives) == 1 else f"; trial {trial.number + 1}, {len(found)} on the front"
    points = front(search.trials, plan.objectives)
    return Tuned(plan, folder, before, search.trials, points, middle(points, plan.objectives) if points else None)


def _told(plan: Plan, trial: Trial) -> str:
    return f"best {plan.objectives[0].name} {trial.objectives[0]:.4g} {plan.objectives[0].unit}".rstrip()


def to_check(tuned: Tuned) -> list[Trial]:
    """The points of the front that are checked: all, or as many over its length."""
    chosen = {round(k) for k in np.linspace(0, len(tuned.points) - 1, min(len(tuned.points), MOST_POINTS))}
    return [one for k, one in enumerate(tuned.points) if k in chosen or one is tuned.best]


def _check_drives(tuned: Tuned, study: Study, engine: Engine, screen: Screen, clock: Callable[[], float]) -> None:
    """Other drives and other noise, as it was and with what was found, as a study of designs."""
    plan, points, folder = tuned.plan, to_check(tuned), tuned.folder / CHECK
    if not points:
        return
    figures = {AS_IT_WAS: plan.figures({})} | {f"trial {one.number}": plan.figures(one.values) for one in points}
    changed = {"name": f"{plan.name}, checked", "figures": figures, "seed": study.seed + 1, "samples": plan.check}
    other = Study(json.loads(json.dumps({**study.plan, **changed})))
    file = folder / STUDY
    with Store(folder, other, identity(), file.exists() and file.read_bytes() != other.text) as store:
        fill(store, other, engine, screen, clock)
    before, *after = drives_in(table_in(folder), other, plan.objectives)
    for point, drives in zip(points, after, strict=True):
        tuned.checked[point.number] = compared(plan.objectives, before, drives)


def _check_recordings(tuned: Tuned) -> None:
    measure, points = Recordings(tuned.plan, tuned.plan.check), to_check(tuned)
    before, *after = measure([{}, *(one.values for one in points)])
    for point, found in zip(points, after, strict=True):
        tuned.checked[point.number] = compared(tuned.plan.objectives, before.drives, found.drives)


def compared(
    objectives: Sequence[Objective], before: Sequence[F64], after: Sequence[F64]
) -> list[tuple[float, float, Estimate, float]]:
    """For each objective: before, after, difference, share of drives that are better."""
    found = []
    for one, a, b in zip(objectives, before, after, strict=True):
        worst = LOST if one.unit == "deg" else np.nan
        x, y = (np.where(np.isnan(of), worst, of).mean(1) * one.sign for of in (a, b))
        found.append((one.of_drives(a), one.of_drives(b), one.difference(a, b), float((y < x).mean())))
    return found
