"""How bands are made of good runs, for `bench accept --learn-limits`: tolerance intervals, and how narrow they may be.

A band holds, with a confidence of 95 %, so much of what good drives measure that all measurements of a run together lie
within theirs but for once in a thousand runs: K. Howe, J. Amer. Stat. Assoc. 64 (1969), 610, as in the NIST/SEMATECH
e-Handbook, 7.2.6.3. Few runs make wide bands. What is added to a file adds to its counts, means and deviations.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from bench.accept.accept import AcceptOptions, accept
from bench.accept.collected import Screen
from bench.accept.results import RunResult, Verdict, run_from_json
from bench.accept.spec import LARGEST, Band, Spec, ratings_of, read_spec, rounded, write_spec
from bench.errors import BenchError
from bench.rig.connection import SIM, target_of
from bench.rig.ratings import FLOAT32
from bench.rig.settings import read_settings
from bench.signal.limits import YES_NO, Limits
from bench.signal.versions import PROGRAM
from protocol.text import counted

CONFIDENCE = 0.95
MANY = 20
"""Runs from which on more of them make bands little narrower."""
FALSE_ALARMS = 1e-3
"""The share of good runs with a measurement out of its band."""
RESOLUTION = {
    "deg": 0.1,  # a count of a good encoder, electrical, or what the shaft turns within a sample
    "turns": 1.0,  # it depends on where the rotor is when something happens
    "%": 0.05, "": 0.005, "dB": 0.05, "V": 0.02, "r/min": 0.5, "ms": 0.125, "us": 0.2,
}  # fmt: skip
"""By unit, what a reading can be off by on a bench without anything being wrong with the drive; times are two samples
at 16 kHz. Beside it there is `FIGURES`, for currents of the current sensors' range.
"""
REACH = 1.5
"""How many times as far from the mean as the furthest good run a band reaches: some measurements have long tails."""
FIGURES = 1e-3
"""Share of a value, or of a range, to which it is read: ten bits. A band is nowhere narrower, either side."""


def learn(
    options: AcceptOptions, screen: Screen, file: Path, runs: int, results: Sequence[Path], anew: bool
) -> tuple[Spec, RunResult, int]:
    """Run so many times, or read `results` of `--json`, and add them to the spec in `file`; `anew` replaces it.

    The file is written after each run that passed, and the first that did not ends it. Returns the spec, the last run
    and its exit code. Each run of the simulated drive has a seed of its own.
    """
    spec = read_spec(str(file)) if file.exists() and not anew else Spec(file)
    if results:
        read = [(_read(path), str(path)) for path in results]
        spec = learned(read, spec)
        write_spec(spec)
        return spec, read[-1][0], 0
    seed = None
    if target_of(options.target, read_settings(options.bench_toml)) == SIM:
        seed = options.seed if options.seed is not None else len(spec.runs) + 1
    for number in range(runs):
        found, code = accept(replace(options, seed=None if seed is None else seed + number), screen)
        assert found is not None
        run = found
        if run.verdict is not Verdict.PASS:
            break
        spec = learned([(run, f"run {number + 1}")], spec)
        write_spec(spec)
    return spec, run, code


def _read(path: Path) -> RunResult:
    try:
        return run_from_json(json.loads(path.read_text(encoding="utf-8-sig")))
    except OSError as error:
        raise BenchError(f"cannot read results {path}: {error.strerror}") from None
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
        raise BenchError(f"{path} has no results of bench accept --json") from None


def summary(spec: Spec, run: RunResult) -> list[str]:
    """What was learned, in a few lines; `run` is the last."""
    n, bands = len(spec.runs), [band for band in spec.measurements.values() if band.resolution is not None]
    text = f"{spec.path}: from {counted(n, 'run')}, {len(bands)} of {len(spec.measurements)} measurements have a band"
    if n < 2:
        return [f"{text}: one run tells no scatter, add more"]
    now, later = (tolerance_factor(k, FALSE_ALARMS / len(spec.measurements)) for k in (n, MANY))
    more = f", and ± {later:.1f} once there are {MANY} runs" if n < MANY else ""
    untold = spec.use(run).untold
    lines = [f"{text}: mean ± {now:.1f} standard deviations{more}"]
    return lines + ([f"cannot be told here, if it is off by less: {untold}"] if untold else [])


def tolerance_factor(n: int, outside: float, confidence: float = CONFIDENCE) -> float:
    """Two-sided: mean ± so many standard deviations, of `n` values, hold all but `outside` of a normal population."""
    from scipy.stats import chi2, norm

    z = float(norm.isf(outside / 2.0))
    return z * math.sqrt((n - 1) * (1.0 + 1.0 / n) / float(chi2.ppf(1.0 - confidence, n - 1)))


def learned(runs: Sequence[tuple[RunResult, str]], spec: Spec) -> Spec:
    """`spec` with these good runs added, each of which comes with what to call it.

    BenchError for a run that did not pass, that is in it already, or that is of another motor.
    """
    for run, called in runs:
        spec = _with(spec, run, called)
    limits = {m.name: m.limits for run, _ in runs for m in run.measurements}
    bands, i_range = dict(spec.measurements), _range(run for run, _ in runs)
    for name in limits.keys() & bands.keys():
        if bands[name].n:
            bands[name] = _banded(bands[name], limits[name], len(bands), i_range)
    return replace(spec, measurements=bands)


def _with(spec: Spec, run: RunResult, called: str) -> Spec:
    if run.verdict is not Verdict.PASS:
        why = "; --allow-skipped makes it a PASS" if run.verdict is Verdict.INCOMPLETE else ""
        raise BenchError(f"{called} ended with {run.verdict}, and limits are learned from good runs only{why}")
    seed = f"seed {run.rig['seed']}" if "seed" in run.rig else ""
    name = f"{run.started} {run.identity.get('serial') or run.target} {seed}".strip()
    if name in spec.runs:
        raise BenchError(f"{called}: the run of {name} is in {spec.path} already")
    parameters = {p.name: float(f"{p.value:.7g}") for p in run.parameters if math.isfinite(p.value)}
    spec.require_kind(parameters, called, run.rig)
    drive = str(run.identity.get("name") or "")
    if spec.drive and drive and drive != spec.drive:
        raise BenchError(f"{called} is of a drive '{drive}', and {spec.path} is of '{spec.drive}'")
    same = parameters if not spec.runs else {
        name: value for name, value in spec.parameters.items()
        if math.isclose(parameters.get(name, math.nan), value, rel_tol=FLOAT32, abs_tol=1e-12)
    }  # fmt: skip
    measurements = dict(spec.measurements)
    for m in run.measurements:
        if m.value is not None and abs(m.value) < LARGEST:
            before = measurements.get(m.name, Band(m.limits.unit))
            if before.unit != m.limits.unit:
                raise BenchError(
                    f"{called}: {m.name} is in '{m.limits.unit}', and {spec.path} has it in '{before.unit}'"
                )
            if before.n or (before.lo is None and before.hi is None):  # else it is a person's
                measurements[m.name] = _added(before, m.value)
    return replace(
        spec,
        drive=spec.drive or drive,
        motor=spec.motor or run.motor,
        firmware=_union(spec.firmware, run.identity.get("firmware")),
        station=_union(spec.station, run.station),
        rated=spec.rated or ratings_of(run.rig),
        software=f"{PROGRAM} {run.versions.get(PROGRAM, '')}".strip(),
        runs=(*spec.runs, name),
        parameters=same,
        measurements=measurements,
    )


def _union(known: tuple[str, ...], more: object) -> tuple[str, ...]:
    return known if not more or str(more) in known else (*known, str(more))


def _added(band: Band, value: float) -> Band:
    """With one value more (B. P. Welford, Technometrics 4, 1962)."""
    n, off = band.n + 1, value - band.mean
    mean = band.mean + off / n
    squares = max(band.n - 1, 0) * band.sd**2 + off * (value - mean)
    least, most = (value, value) if band.n == 0 else (min(band.min, value), max(band.max, value))
    return replace(band, n=n, mean=mean, sd=math.sqrt(squares / max(n - 1, 1)), min=least, max=most)


def _range(runs: Iterable[RunResult]) -> float:
    """Of the drive's current sensors, A; 0 where it does not say."""
    return max((p.value for run in runs for p in run.parameters if p.name == "i_range" and p.value > 0), default=0.0)


def _banded(band: Band, limits: Limits, number: int, i_range: float) -> Band:
    """With the band that its statistics make among `number` measurements, never wider than its limits."""
    if band.unit == YES_NO or limits.chance or band.n < 2:
        return rounded(replace(band, lo=None, hi=None))
    least = max(RESOLUTION.get(band.unit, 0.0), FIGURES * max(abs(band.min), abs(band.max)))
    if band.unit == "A":
        least = max(least, FIGURES * i_range)
    half = max(tolerance_factor(band.n, FALSE_ALARMS / number) * band.sd, least)
    lo = min(band.mean - max(half, REACH * (band.mean - band.min)), band.min - least)
    hi = max(band.mean + max(half, REACH * (band.max - band.mean)), band.max + least)
    new = rounded(replace(band, lo=lo, hi=hi))
    los, his = ([side for side in sides if side is not None] for sides in ((new.lo, limits.lo), (new.hi, limits.hi)))
    return replace(new, lo=max(los), hi=min(his))
