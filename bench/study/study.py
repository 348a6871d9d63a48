"""A study as its TOML says it, complete and checked: what is varied, what is done with each drive, what is judged.

    samples = 200
    [vary]
    "motor.R_s" = { normal = [1.0, 0.05], relative = true }
    "hall.delta_deg" = { uniform = [-4, 4] }
    [experiments.fast]
    speed = 1000
    observers = ["vector_tracking", "edge_kalman"]
    limits = { "edge_kalman.rms" = { hi = 1.0 } }

`read_study` makes plain data of it that hold all that a row depends on, figures of the drive and files named in it
included. So any row can be computed anywhere, and again at any time.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

from bench.device.simulator import configuration
from bench.errors import BenchError
from bench.files import read_toml
from bench.rig.settings import read_limits
from bench.signal.limits import Limits
from bench.study.sampling import SAMPLINGS, SOBOL, Points, noise_seed
from bench.study.variation import Variation, Varied, in_design, leaf, read_varied
from protocol.text import did_you_mean
from sim.ports.direct import ENCODER, OBSERVERS, BenchParams, ConfigError, nominal, with_values

TOP: dict[str, Any] = {
    "samples": int, "repetitions": int, "seed": int, "sampling": str, "drive": str, "name": str,
    "set": dict, "vary": dict, "correlated": list, "tables": dict, "designs": dict, "experiments": dict,
}  # fmt: skip
VARY = "vary"
MOST = 10**9
"""Rows, at most."""
AS_CONFIGURED = ""
"""The design of a study that names none."""
TURN, ACCEPT, FUNCTION = "speed", "accept", "function"
"""Kinds of experiments, by the key that each must have."""
EXPERIMENT: dict[str, dict[str, Any]] = {
    TURN: {
        "speed": (int, float, list), "load": (int, float), "seconds": (int, float), "settle": (int, float),
        "control": str, "observers": list, "limits": dict,
    },
    ACCEPT: {"accept": str, "tests": list},
    FUNCTION: {"function": str, "limits": dict},
}  # fmt: skip
WORDS = {int: "a whole number", str: "text", dict: "a table", list: "a list", (int, float): "a number",
         (int, float, list): "a number or a list of numbers"}  # fmt: skip


@dataclass(frozen=True)
class Experiment:
    """What is done with each drive."""

    name: str
    kind: str
    """Of `TURN`, `ACCEPT`, `FUNCTION`."""
    given: Mapping[str, Any]
    """As the TOML has it; of `ACCEPT` and `FUNCTION` with the text of the files in `sources`, by name."""

    @property
    def limits(self) -> Mapping[str, Any]:
        """`lo` and `hi` by the name of a measurement."""
        found: Mapping[str, Any] = self.given.get("limits", {})
        return found


class Study:
    """A study of `plan`, plain data as `read_study` makes them."""

    def __init__(self, plan: Mapping[str, Any]) -> None:
        self.plan = plan
        self.name: str = plan["name"]
        self.repetitions: int = plan["repetitions"]
        self.seed: int = plan["seed"]
        self.figures: Mapping[str, Mapping[str, Any]] = plan["figures"]
        """Of the configuration, by design."""
        self.designs: tuple[str, ...] = tuple(self.figures)
        self.variation = Variation(
            tuple(_varied(one) for one in plan["varied"]),
            tuple(((one["keys"][0], one["keys"][1]), one["r"]) for one in plan["correlated"]),
        )
        self.points = Points(plan["sampling"], plan["samples"], self.variation.dimensions, self.seed)
        self.samples = self.points.drives
        self.experiments = tuple(Experiment(name, one["kind"], one) for name, one in plan["experiments"].items())

    @classmethod
    def of(cls, text: bytes) -> Study:
        """The study that `text` is, see `text`; the last ones are kept."""
        return _study_of(text)

    @cached_property
    def text(self) -> bytes:
        """All of it, as what is sent to workers and kept beside the rows."""
        return json.dumps(self.plan, separators=(",", ":"), allow_nan=True).encode()

    def __len__(self) -> int:
        """Rows."""
        return self.samples * self.repetitions * len(self.designs)

    def place(self, row: int) -> tuple[int, int, int]:
        """Sample, repetition and design of a row."""
        rest, design = divmod(row, len(self.designs))
        return *divmod(rest, self.repetitions), design

    def noise(self, row: int) -> int:
        """Seed of a row's noise."""
        sample, repetition, _ = self.place(row)
        return noise_seed(self.seed, sample, repetition)

    def inputs(self, rows: Sequence[int]) -> Any:
        """(n, inputs) what is varied, of these rows."""
        return self.variation.of(self.points.of([self.place(row)[0] for row in rows]))

    def drive(self, row: int, values: Sequence[float]) -> BenchParams:
        """The drive of a row, whose inputs are `values`. ConfigError for one that cannot be."""
        design = self.designs[self.place(row)[2]]
        figures = self.figures[design]
        return with_values(figures, self.variation.changes(values, figures, design))


@lru_cache(4)
def _study_of(text: bytes) -> Study:
    return Study(json.loads(text))


def _varied(one: Mapping[str, Any]) -> Varied:
    given = tuple(tuple(v) if isinstance(v, list) else v for v in one["given"])
    lists = {name: tuple(one[name]) for name in ("inputs", "base", "within", "only")}
    return Varied(**{**one, **lists, "given": given})


# -- reading --------------------------------------------------------------------------------------------------------


def read_study(path: Path, **instead: Any) -> Study:
    """Read a study's TOML; `instead`: keys of its top that are given elsewhere. BenchError for what cannot be done."""
    return study_of(
        read_toml(path, "study") | {key: value for key, value in instead.items() if value is not None}, path
    )


def study_of(data: Mapping[str, Any], path: Path) -> Study:
    """The study that the TOML at `path` says. BenchError for what cannot be done."""
    where = str(path)
    for key, value in data.items():
        if key not in TOP:
            hint = did_you_mean(key, TOP, f"there are {', '.join(TOP)}")
            raise BenchError(f"unknown key {key} in {where}: {hint}")
        _require(value, TOP[key], key, where)
    samples, repetitions = (
        _whole(data, key, default, 1, where) for key, default in (("samples", 100), ("repetitions", 1))
    )
    seed = _whole(data, "seed", 1, 0, where)
    sampling = data.get("sampling", SOBOL)
    if sampling not in SAMPLINGS:
        hint = did_you_mean(sampling, SAMPLINGS, f"there are {', '.join(SAMPLINGS)}")
        raise BenchError(f"sampling in {where} is '{sampling}': {hint}")
    figures = _figures(data, path)
    base = next(iter(figures.values()))
    varied = list(_read_vary(data, figures, where))
    varied += [_read_table(name, given, base, path) for name, given in data.get("tables", {}).items()]
    names = [name for one in varied for name in one.inputs]
    if double := sorted({name for name in names if names.count(name) > 1}):
        raise BenchError(f"{double[0]} is varied twice in {where}")
    experiments = data.get("experiments", {})
    if not experiments:
        raise BenchError(f"{where} has no experiment: write [experiments.NAME] with {', '.join(EXPERIMENT)}")
    plan = {
        "name": data.get("name", path.stem), "samples": samples, "repetitions": repetitions, "seed": seed,
        "sampling": sampling, "drive": data.get("drive", ""), "designs": data.get("designs", {}), "figures": figures,
        "varied": [_plain(one) for one in varied],
        "correlated": [_correlated(one, where) for one in data.get("correlated", [])],
        "experiments": {name: _experiment(name, one, path) for name, one in experiments.items()},
    }  # fmt: skip
    study = Study(json.loads(json.dumps(plan)))
    if len(study) > MOST:
        raise BenchError(f"{where} has {len(study)} rows, more than {MOST}")
    return study


def _require(value: Any, kind: Any, key: str, where: str) -> None:
    if not isinstance(value, kind) or isinstance(value, bool):
        raise BenchError(f"{key} in {where} must be {WORDS[kind]}, got {value!r}")


def _whole(data: Mapping[str, Any], key: str, default: int, least: int, where: str) -> int:
    value: int = data.get(key, default)
    if value < least:
        raise BenchError(f"{key} in {where} must be at least {least}, got {value}")
    return value


def _figures(data: Mapping[str, Any], path: Path) -> dict[str, dict[str, Any]]:
    """The figures of each design. What follows from the motor follows from the nominal one of that design."""
    config = config_of(data, path)
    designs = data.get("designs", {}) or {AS_CONFIGURED: {}}
    found = {}
    for name, changes in designs.items():
        _require(changes, dict, f"designs.{name}", str(path))
        try:
            found[name] = nominal(config, data.get("set", {}) | {k: v for k, v in changes.items() if k != VARY})
        except ConfigError as error:
            raise BenchError(f"{'designs.' + name if data.get('designs') else 'set'} in {path}: {error}") from None
    return found


def config_of(data: Mapping[str, Any], path: Path) -> Path | None:
    """The file of the drive's configuration; None: the default one."""
    given = data.get("drive", "")
    config = configuration(path.parent / given, given) if given else None
    if config is not None and not config.exists():
        raise BenchError(f"drive in {path} is '{given}': no file and no motor of that name (bench sim --motors)")
    return config


def _read_vary(data: Mapping[str, Any], figures: Mapping[str, Mapping[str, Any]], where: str) -> Iterator[Varied]:
    """The lines of [vary], and of those of designs, which stand in their place."""
    own = {design: changes.get(VARY, {}) for design, changes in data.get("designs", {}).items()}
    for key, given in data.get(VARY, {}).items():
        others = tuple(design for design in figures if key not in own.get(design, {}))
        made = read_varied(key, given, figures[(others or tuple(figures))[0]], where)
        for design in others:
            if read_varied(key, given, figures[design], where).base != made.base:
                raise BenchError(
                    f"vary.{key!r} in {where}: {key} is another in design '{design}': write [designs.{design}.{VARY}], "
                    f"or leave it alone there"
                )
        yield replace(made, only=others if len(others) < len(figures) else ())
    for design, lines in own.items():
        _require(lines, dict, f"designs.{design}.{VARY}", where)
        for key, given in lines.items():
            yield in_design(read_varied(key, given, figures[design], where), design)


def _read_table(name: str, given: Any, figures: Mapping[str, Any], path: Path) -> Varied:
    """Measured drives, a row of a table each: figures that go together."""
    what = f"tables.{name} in {path}"
    if not isinstance(given, Mapping) or not isinstance(given.get("file"), str):
        raise BenchError(f'{what} must have file = "NAME.parquet" or "NAME.csv"')
    if unknown := sorted(set(given) - {"file", "columns", "relative"}):
        raise BenchError(f"{what} has an unknown '{unknown[0]}': there are file, columns, relative")
    import pyarrow as pa
    from pyarrow import csv, parquet

    file = path.parent / given["file"]
    try:
        table = parquet.read_table(file) if file.suffix == ".parquet" else csv.read_csv(file)
    except (OSError, pa.ArrowException) as error:
        raise BenchError(f"{what}: cannot read {file}: {str(error).splitlines()[0]}") from None
    columns = given.get("columns") or {key: key for key in table.column_names}
    if not isinstance(columns, Mapping) or not columns or not table.num_rows:
        raise BenchError(f'{what}: columns must look like {{ "hall.delta_deg_1" = "edge 1" }}, and {file} have rows')
    base, values = [], []
    for key, column in columns.items():
        if column not in table.column_names:
            hint = did_you_mean(str(column), table.column_names, f"there are {', '.join(table.column_names)}")
            raise BenchError(f"{what}: {file} has no column '{column}': {hint}")
        try:
            numbers = [float(v) for v in table.column(column).to_pylist()]
        except (TypeError, ValueError):
            numbers = [math.nan]
        if not all(map(math.isfinite, numbers)):
            raise BenchError(f"{what}: column '{column}' of {file} must have a number in each row")
        _, k, there = leaf(figures, key)
        if k is None and isinstance(there, list | tuple):
            raise BenchError(f"{what}: {key} is a list: name {key}_1 to {key}_{len(there)}")
        base.append(float(there if k is None else there[k]))
        values.append(tuple(numbers))
    return Varied(name, "table", tuple(values), tuple(columns), tuple(base), bool(given.get("relative")))


def _plain(one: Varied) -> dict[str, Any]:
    return {name: getattr(one, name) for name in Varied.__dataclass_fields__}


def _correlated(one: Any, where: str) -> dict[str, Any]:
    fits = isinstance(one, Mapping) and set(one) == {"keys", "r"} and isinstance(one["keys"], list)
    fits = fits and len(one["keys"]) == 2 and isinstance(one["r"], int | float) and -1.0 < one["r"] < 1.0
    if not fits:
        raise BenchError(
            f'correlated in {where} must look like {{ keys = ["motor.L_d", "motor.L_q"], r = 0.9 }}, got {one!r}'
        )
    return dict(one)


def _experiment(name: str, given: Any, path: Path) -> dict[str, Any]:
    what = f"experiments.{name} in {path}"
    kinds = [kind for kind in EXPERIMENT if isinstance(given, Mapping) and kind in given]
    if len(kinds) != 1:
        raise BenchError(f"{what} must have one of {', '.join(EXPERIMENT)}, got {given!r}")
    (kind,) = kinds
    for key, value in given.items():
        if key not in EXPERIMENT[kind]:
            hint = did_you_mean(key, EXPERIMENT[kind], f"there are {', '.join(EXPERIMENT[kind])}")
            raise BenchError(f"{what} has an unknown '{key}': {hint}")
        _require(value, EXPERIMENT[kind][key], key, what)
    made = dict(given) | {"kind": kind}
    if kind == TURN:
        _check_turn(made, what)
    if kind == FUNCTION:
        made["sources"] = {given[kind].partition(":")[0]: _source(given[kind], path, what)}
    if kind == ACCEPT:
        made["tests"] = [str((path.parent / test).absolute()) for test in given.get("tests", [])]
    for measured, limits in made.get("limits", {}).items():
        ends = read_limits(measured, limits, what)
        try:
            Limits(measured, "", ends.get("lo"), ends.get("hi"))
        except ValueError as error:
            raise BenchError(f"{what}: {error}") from None
    return made


def _check_turn(made: dict[str, Any], what: str) -> None:
    speeds = made["speed"] if isinstance(made["speed"], list) else [made["speed"]]
    made["speed"] = speeds
    made.setdefault("load", 0.0)
    made.setdefault("seconds", 1.0)
    made.setdefault("settle", 0.5 * made["seconds"])
    made.setdefault("control", "")
    made.setdefault("observers", [])
    numbers = [*speeds, made["load"], made["seconds"], made["settle"]]
    if not speeds or not all(isinstance(n, int | float) and math.isfinite(n) for n in numbers):
        raise BenchError(f"{what}: speed, load, seconds and settle must be finite numbers, got {numbers}")
    if not 0.0 <= made["settle"] < made["seconds"]:
        raise BenchError(
            f"{what}: settle must be from 0 to less than seconds = {made['seconds']:g}, got {made['settle']:g}"
        )
    for name in [*made["observers"], *([made["control"]] if made["control"] not in ("", ENCODER) else [])]:
        if name not in OBSERVERS:
            hint = did_you_mean(str(name), OBSERVERS, f"there are {', '.join(OBSERVERS)}")
            raise BenchError(f"{what}: no observer '{name}': {hint}")


def _source(given: str, path: Path, what: str) -> str:
    file, _, function = given.partition(":")
    if not file.endswith(".py") or not function.isidentifier():
        raise BenchError(f'{what}: function must look like "FILE.py:NAME", got {given!r}')
    try:
        text = (path.parent / file).read_text(encoding="utf-8")
        compile(text, file, "exec")
    except OSError as error:
        raise BenchError(f"{what}: cannot read {path.parent / file}: {error.strerror}") from None
    except (SyntaxError, ValueError) as error:
        raise BenchError(f"{what}: {file} is no Python: {error}") from None
    return text
