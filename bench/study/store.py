"""The folder of a study: its text, and its rows as Parquet as they come. What is there is never computed again.

NAME.study/study.json            all that rows depend on
NAME.study/made_by.json          the program that has made them, see `bench.study.worker.identity`
NAME.study/rows-000001.parquet   rows, in the order in which they came; a file is there when it is whole
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Any, Self

import numpy as np
from filelock import FileLock, Timeout

from bench.errors import BenchError
from bench.files import part_of, write
from bench.signal.limits import Limits
from bench.study.experiments import INPUT, MEASURED, VERDICT, limits_of
from bench.study.rows import Rows
from bench.study.sampling import RANDOM, SOBOL
from bench.study.study import Study

STUDY, MADE_BY, LOCK = "study.json", "made_by.json", ".lock"
OURS = (STUDY, MADE_BY, "report.html")
FOLDER = ".study"
"""How names of studies end, by custom."""
FILES = "rows-*.parquet"
ELSEWHERE = "choose another name with --out, or --overwrite"
MOST_FILES = 256
"""From so many files on they are put together when the study is opened or closed."""


class Store:
    """The rows of a study in a folder, which is made where there is none; the only one that writes there.

    Use it as a context manager. BenchError where another program writes there, the folder holds another study, or rows
    that another version has made.
    """

    def __init__(self, folder: Path, study: Study, made_by: Mapping[str, str], overwrite: bool = False) -> None:
        self.folder = folder
        self._made_by = dict(made_by)
        with ExitStack() as stack:
            stack.enter_context(locked(folder, "bench study"))
            if overwrite and (folder / STUDY).exists():
                for file in [*folder.glob(FILES), *folder.glob(".*.part"), *(folder / name for name in OURS)]:
                    file.unlink(missing_ok=True)
            self._begin(study)
            self.done = _numbers(folder, len(study))
            """(rows of the study,) which of them are there."""
            self._next = 1 + max((int(file.stem.rpartition("-")[2]) for file in folder.glob(FILES)), default=0)
            self._stack = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        if len(list(self.folder.glob(FILES))) > MOST_FILES:
            self._join()
        self._stack.close()

    def _begin(self, study: Study) -> None:
        file, maker = self.folder / STUDY, self.folder / MADE_BY
        if file.exists():
            if difference := _difference(_plan(self.folder), study):
                raise BenchError(f"{self.folder} holds rows of another study ({difference}): {ELSEWHERE}")
            there = json.loads(maker.read_text("utf-8")) if maker.exists() else {}
            if differ := [name for name in self._made_by if there.get(name) != self._made_by[name]]:
                words = ", ".join(f"{name} {there.get(name, 'unknown')}, now {self._made_by[name]}" for name in differ)
                raise BenchError(f"{self.folder} holds rows of another version ({words}): {ELSEWHERE}")
        elif any(self.folder.iterdir()) and [found.name for found in self.folder.iterdir()] != [LOCK]:
            raise BenchError(f"{self.folder} is there and holds no study: choose another name with --out")
        write(maker, json.dumps(self._made_by, indent=1) + "\n", str(maker))
        write(file, study.text, str(file))

    def missing(self) -> Iterator[int]:
        """Numbers of the rows that are not there, the first ones first."""
        yield from np.flatnonzero(~self.done).tolist()

    def add(self, result: bytes, worker: str) -> None:
        """Keep rows as `compute` makes them, but for those that are there already."""
        import pyarrow as pa
        from pyarrow import parquet

        table = pa.ipc.open_stream(result).read_all()
        number = table.column("row").to_numpy()
        if (new := ~self.done[number]).sum() < len(number):
            table, number = table.filter(pa.array(new)), number[new]
        if not len(number):
            return
        told = {"worker": worker, "version": self._made_by.get("hallbench", ""), "ended": time.time()}
        for name, value in told.items():
            table = table.append_column(name, pa.array([value] * len(number)))
        self._write(parquet, table, self.folder / f"rows-{self._next:06d}.parquet")
        self._next += 1
        self.done[number] = True

    def _write(self, parquet: Any, table: Any, file: Path) -> None:
        part = part_of(file)
        try:
            parquet.write_table(table, part, compression="zstd")
            part.replace(file)
        except OSError as error:
            part.unlink(missing_ok=True)
            raise BenchError(f"{file} cannot be written: {error.strerror}") from None

    def _join(self) -> None:
        """All files as one; rows that are in two files, because this was interrupted, are read once."""
        from pyarrow import parquet

        files = sorted(self.folder.glob(FILES))
        self._write(parquet, table_in(self.folder), self.folder / f"rows-{self._next:06d}.parquet")
        self._next += 1
        for file in files:
            file.unlink()


def locked(folder: Path, command: str) -> AbstractContextManager[object]:
    """The folder, made where there is none, in which no other `command` writes meanwhile. BenchError if one does."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        held: AbstractContextManager[object] = FileLock(folder / LOCK).acquire(timeout=0)
    except Timeout:
        raise BenchError(f"{folder} is being written by another {command}") from None
    except OSError as error:
        raise BenchError(f"{folder} cannot be written: {error.strerror}") from None
    return held


def _plan(folder: Path) -> Mapping[str, Any]:
    try:
        plan: Mapping[str, Any] = json.loads((folder / STUDY).read_text("utf-8"))
    except FileNotFoundError:
        raise BenchError(f"{folder} holds no study: there is no {STUDY} in it") from None
    except (OSError, ValueError) as error:
        raise BenchError(f"{folder / STUDY} cannot be read: {error}") from None
    return plan


def _difference(there: Mapping[str, Any], study: Study) -> str:
    """What of a study is not as it was; nothing where only drives were added, and those before stay what they were."""
    grows = study.plan["sampling"] in (SOBOL, RANDOM) and study.plan["samples"] >= there.get("samples", 0)
    keys = [key for key in study.plan if key != "name" and there.get(key) != study.plan[key]]
    return ", ".join(key for key in keys if not (key == "samples" and grows))


def _numbers(folder: Path, n: int) -> Any:
    from pyarrow import parquet

    done = np.zeros(n, bool)
    for file in folder.glob(FILES):
        done[parquet.read_table(file, columns=["row"]).column("row").to_numpy()] = True
    return done


def table_in(folder: Path) -> Any:
    """All rows once, by their number."""
    import pyarrow as pa
    from pyarrow import parquet

    tables = [parquet.read_table(file) for file in sorted(folder.glob(FILES))]
    if not tables:
        raise BenchError(f"{folder} has no row yet")
    table = pa.concat_tables(tables, promote_options="default").sort_by("row")
    number = table.column("row").to_numpy()
    first = np.append(True, np.diff(number) != 0)
    return table if first.all() else table.filter(pa.array(first))


def open_study(folder: Path) -> Study:
    """The study that a folder holds."""
    return Study(_plan(folder))


def read_rows(folder: Path) -> Rows:
    """What there is of its rows."""
    study, table = open_study(folder), table_in(folder)

    def by(prefix: str) -> list[str]:
        return [name for name in table.column_names if name.startswith(prefix)]

    def numbers(name: str) -> Any:
        return np.array(table.column(name).to_numpy(), float)

    def words(name: str) -> Any:
        return np.array([value or "" for value in table.column(name).to_pylist()])

    whole = {name: table.column(name).to_numpy() for name in ("row", "sample", "repetition", "design")}
    limits: dict[str, Limits] = {}
    for experiment in study.experiments:
        limits |= limits_of(study, experiment)
    return Rows(
        **whole,
        designs=study.designs,
        inputs={name.removeprefix(INPUT): numbers(name) for name in by(INPUT)},
        measured={name.removeprefix(MEASURED): numbers(name) for name in by(MEASURED)},
        verdicts={name.removeprefix(VERDICT): words(name) for name in by(VERDICT)},
        limits=limits,
        seconds=numbers("cpu_s"),
    )


def row_in(folder: Path, row: int) -> dict[str, Any] | None:
    """A row by the names of its columns; None where it is not there."""
    from pyarrow import parquet

    for file in sorted(folder.glob(FILES)):
        for found in parquet.read_table(file, filters=[("row", "=", row)]).to_pylist():
            there: dict[str, Any] = found
            return there
    return None
