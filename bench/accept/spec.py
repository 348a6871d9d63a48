"""What good drives of one kind measure on one kind of bench: the bands of `bench accept --spec`, and their file.

    drive = "…"                      # whose runs these were; what is not the same in all of them is left out
    runs = ["2026-03-01T10:00:00+01:00 no. 17", …]
    [parameters]                     # the drive's own, each the same in all runs: another value is not as specified
    n_p = 6.0
    [measurements]
    "torque_constant.torque_deviation" = { unit = "%", n = 20, mean = 0.1, sd = 0.7, …, lo = -4.6, hi = 4.8 }

`lo` and `hi` are the band, the rest is what it was made of (`bench.accept.learning`). Who writes a band by hand leaves
the rest out. Nothing here runs or measures.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import tomli_w

from bench.accept.results import Measurement, RunResult, SpecUse
from bench.errors import BenchError
from bench.files import read_toml, write
from bench.rig.ratings import FLOAT32
from bench.rig.settings import require_known
from bench.signal.limits import RATED_CURRENT, RATED_SPEED, Limits
from protocol.text import counted, did_you_mean, printable

SHIPPED = Path(__file__).with_name("specs")
KIND = ("n_p", "R_s_hat", "L_s_hat", "psi_f_hat", "i_max", "omega_m_max")
"""The drive's parameters that say which motor it has."""
ALIKE = 1.5  # a factor by which one of them may be off before it is another motor's; pole pairs must be the same
HEAD: dict[str, type] = {
    "drive": str,
    "motor": str,
    "firmware": list,
    "station": list,
    "rated": list,
    "software": str,
    "runs": list,
}
FORMS: dict[type, str] = {str: "text", list: "a list of texts", dict: "a table"}
COMMENT = """\
# What good drives of this kind measure on this bench: `bench accept --learn-limits` wrote it, and adds runs to it.
# A band is from lo to hi. Bands by hand, without n, mean, sd, min and max, stay as they are when runs are added.
"""


@dataclass(frozen=True, slots=True)
class Band:
    """One measurement: the band from `lo` to `hi` in `unit`, and the `n` values that it was made of.

    Without `lo` and `hi` it has none: an answer, which its limit judges, or a single run.
    """

    unit: str
    n: int = 0
    """0: a person has written the band."""
    mean: float = 0.0
    sd: float = 0.0
    min: float = 0.0
    max: float = 0.0
    lo: float | None = None
    hi: float | None = None

    @property
    def resolution(self) -> float | None:
        """Half of its width: less than that cannot be told from what good drives do. None without two sides."""
        return None if self.lo is None or self.hi is None else (self.hi - self.lo) / 2.0


MOST_RUNS = 1e6
LARGEST = 1e100  # of numbers in the file: squares of more are not finite
NUMBERS = tuple(f.name for f in fields(Band) if f.name != "unit")
STATISTICS = NUMBERS[:5]


@dataclass(frozen=True)
class Spec:
    """What a file says. `parameters` and `measurements` go by name."""

    path: Path
    drive: str = ""
    motor: str = ""
    firmware: tuple[str, ...] = ()
    station: tuple[str, ...] = ()
    rated: tuple[str, ...] = ()
    """What setpoints were shares of: the ratings, with units."""
    software: str = ""
    runs: tuple[str, ...] = ()
    """Each run's date and time and what it was of."""
    parameters: Mapping[str, float] = field(default_factory=dict)
    measurements: Mapping[str, Band] = field(default_factory=dict)

    def require_kind(self, parameters: Mapping[str, float], whose: str, told: Mapping[str, str]) -> None:
        """BenchError if a drive with these parameters has another motor, or is `told` to have other ratings."""
        for name in KIND:
            if (ours := self.parameters.get(name)) is None or (theirs := parameters.get(name)) is None:
                continue
            near = ours == theirs if name == "n_p" else ours / ALIKE <= theirs <= ours * ALIKE
            if not near:
                raise BenchError(
                    f"{self.path} is of another motor: its {name} is {ours:.4g}, and that of {whose} {theirs:.4g}"
                )
        kind = {name: parameters[name] for name in KIND if name in parameters}
        if self.rated and self.rated != (rated := ratings_of(told)) and not self.unlike(kind):
            raise BenchError(
                f"{self.path} is for a {' and a '.join(self.rated)}, and {whose} has a {' and a '.join(rated)}: "
                "give the same [rated] in bench.toml, or learn anew"
            )

    def unlike(self, parameters: Mapping[str, float]) -> list[str]:
        """What is not as specified of the drive's parameters, a line each."""
        return [
            f"parameter {name} is {parameters[name]:.6g}, specified {value:.6g}"
            for name, value in self.parameters.items()
            if name in parameters and not math.isclose(parameters[name], value, rel_tol=FLOAT32, abs_tol=1e-12)
        ]

    def band(self, name: str) -> Limits | None:
        """Of a measurement, as limits; None where there is none."""
        band = self.measurements.get(name)
        if band is None or (band.lo is None and band.hi is None):
            return None
        return Limits(name.rpartition(".")[2], band.unit, band.lo, band.hi)

    def allows(self, measurement: Measurement) -> bool:
        """Whether a value is in its band, if there is one."""
        band = self.band(measurement.name)
        return band is None or measurement.value is None or band.allow(measurement.value)

    def check_names(self, tests: Mapping[str, Collection[str]], units: Mapping[str, str]) -> None:
        """BenchError for what none of these tests, which map to what they measure, does: see `require_known`.

        And for another unit than in `units`, by full name.
        """
        for name in self.measurements.keys() & units.keys():
            if (unit := self.measurements[name].unit) != units[name]:
                raise BenchError(f"{self.path}: {name} is in '{units[name]}', and the file has it in '{unit}'")
        require_known(self.measurements, f"spec {self.path}", tests)

    def use(self, run: RunResult) -> SpecUse:
        """What it had to say on a run, beside the verdicts of measurements."""
        measured = {m.name: m for m in run.measurements if m.value is not None}
        learned = {"drive": (self.drive,), "firmware": self.firmware, "station": self.station}
        here = {"drive": run.identity.get("name"), "firmware": run.identity.get("firmware"), "station": run.station}
        notes = [
            f"learned with {what} {', '.join(known)}: this is {here[what]}"
            for what, known in learned.items()
            if any(known) and here[what] and str(here[what]) not in known
        ]
        return SpecUse(
            name=str(self.path),
            about=f"{self.drive}, from {counted(len(self.runs), 'run')}" if self.runs else self.drive,
            unlike=tuple(self.unlike({p.name: p.value for p in run.parameters})),
            notes=tuple(notes),
            without=tuple(name for name in measured if name not in self.measurements),
            unused=tuple(name for name in self.measurements if name not in measured),
            resolution=tuple(self._resolution(measured)),
        )

    def _resolution(self, measured: Mapping[str, Measurement]) -> Iterator[tuple[str, float, str]]:
        """Of what matters, the largest of those that tell the same thing: words, half-width and unit."""
        found: dict[str, tuple[float, str]] = {}
        for name, measurement in measured.items():
            what, band = measurement.limits.tells, self.measurements.get(name)
            if what and band is not None and band.resolution is not None:
                found[what] = max(found.get(what, (0.0, band.unit)), (band.resolution, band.unit))
        return ((what, width, unit) for what, (width, unit) in found.items())


def ratings_of(told: Mapping[str, str]) -> tuple[str, ...]:
    """Rated speed and current, of ratings as words by name or of what a run says of its rig."""
    return tuple(f"{rating} of {told[rating]}" for rating in (RATED_SPEED, RATED_CURRENT) if rating in told)


def read_spec(given: str) -> Spec:
    """Read a file, or the shipped one of that name. BenchError of one line for what cannot be used."""
    path = Path(given)
    if not path.is_file():
        names = sorted(file.stem for file in SHIPPED.glob("*.toml"))
        if given not in names:
            there = f"there are a file of yours, or the shipped {', '.join(names)}"
            raise BenchError(f"no spec '{given}': {did_you_mean(given, names, there)}")
        path = SHIPPED / f"{given}.toml"
    data = read_toml(path, "spec")
    known: dict[str, type] = {**HEAD, "parameters": dict, "measurements": dict}
    for key, value in data.items():
        if key not in known:
            raise BenchError(f"unknown key {printable(key)} in {path}: {did_you_mean(key, known, 'remove it')}")
        texts = list(value) if known[key] is list and isinstance(value, list) else []
        if not isinstance(value, known[key]) or not all(isinstance(text, str) for text in texts):
            raise BenchError(f"{key} in {path} must be {FORMS[known[key]]}, got {value!r}")
    if not data.get("measurements"):
        raise BenchError(f"{path} has no [measurements]: it is no spec")
    head: dict[str, Any] = {
        key: tuple(data[key]) if kind is list else data[key] for key, kind in HEAD.items() if key in data
    }
    return Spec(
        path if path.parent != SHIPPED else Path(given),
        **head,
        parameters={name: _number(value, name, path) for name, value in data.get("parameters", {}).items()},
        measurements={name: _band(value, name, path) for name, value in data["measurements"].items()},
    )


def _number(value: Any, what: str, path: Path) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < LARGEST:
        raise BenchError(f"{printable(what)} in {path} must be a finite number, got {value!r}")
    return float(value)


def _band(value: Any, name: str, path: Path) -> Band:
    what = printable(name)
    if not isinstance(value, dict) or not isinstance(value.get("unit"), str):
        raise BenchError(f'{what} in {path} must look like {{ unit = "deg", lo = -1.0, hi = 1.0 }}, got {value!r}')
    for key in value.keys() - {"unit", *NUMBERS}:
        raise BenchError(f"{what} in {path} has an unknown key {printable(key)}: {did_you_mean(key, NUMBERS)}")
    given = {key: _number(value[key], f"{key} of {name}", path) for key in NUMBERS if key in value}
    if missing := [key for key in STATISTICS if key not in given]:
        if len(missing) < len(STATISTICS):
            raise BenchError(
                f"{what} in {path} lacks {', '.join(missing)}: give all of {', '.join(STATISTICS)}, or none"
            )
        if "lo" not in given and "hi" not in given:
            raise BenchError(f"{what} in {path} has neither lo nor hi")
    elif (
        not 1 <= given["n"] <= MOST_RUNS
        or not given["n"].is_integer()
        or given["sd"] < 0
        or given["min"] > given["max"]
    ):
        raise BenchError(f"{what} in {path}: n must be a count, sd not negative, and min not above max")
    band = Band(value["unit"], **{**given, "n": int(given.get("n", 0))})  # type: ignore[arg-type]
    try:
        Limits(name, band.unit, band.lo, band.hi)
    except ValueError as error:
        raise BenchError(f"{path}: {printable(str(error))}") from None
    return band


def write_spec(spec: Spec) -> None:
    """Write the file, a line for each measurement. Raises BenchError."""
    head: dict[str, Any] = {key: getattr(spec, key) for key in HEAD}
    head = {key: list(value) if isinstance(value, tuple) else value for key, value in head.items()}
    text = COMMENT + tomli_w.dumps(head) + "\n[parameters]\n" + tomli_w.dumps(spec.parameters) + "\n[measurements]\n"
    lines = [f"{_key(name)} = {{ {', '.join(_pairs(band))} }}\n" for name, band in spec.measurements.items()]
    write(spec.path, text + "".join(lines), f"spec {spec.path}")


def _key(name: str) -> str:
    return tomli_w.dumps({name: 0}).rpartition(" = ")[0]


def _pairs(band: Band) -> Iterator[str]:
    learned = STATISTICS if band.n else ()
    for key in ("unit", *learned, "lo", "hi"):
        if (value := getattr(band, key)) is not None:
            yield tomli_w.dumps({key: value}).strip()


def rounded(band: Band) -> Band:
    """With as many digits as its scatter and its width call for, the band outwards."""
    digits = _digits(max(band.sd, 1e-9 * abs(band.mean), 1e-12), 5)
    near = {key: round(getattr(band, key), digits) for key in ("mean", "min", "max")}
    digits = _digits(max(band.resolution or 0.0, 1e-9 * abs(band.mean), 1e-12), 3)
    step = 10.0**-digits
    lo = None if band.lo is None else round(math.floor(band.lo / step + 1e-6) * step, digits)
    hi = None if band.hi is None else round(math.ceil(band.hi / step - 1e-6) * step, digits)
    return replace(band, **near, sd=float(f"{band.sd:.6g}"), lo=lo, hi=hi)


def _digits(scale: float, more: int) -> int:
    return more - math.floor(math.log10(scale))
