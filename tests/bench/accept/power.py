"""What `bench accept` catches of deliberate faults: `python -m tests.bench.accept.power [NAME …]` runs them.

Without names all of them that have no result yet, below .sabotage; a run that was interrupted goes on where it was. A
fault must first show its effect. Then the whole suite is run on it, without a spec: limits are judged as it runs, and
bands by what it measured, so that another spec needs no other run.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import re
import subprocess
import sys
import time
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from bench.accept.results import Verdict, run_from_json
from bench.accept.spec import Band, Spec
from sim.numba_cache import source_hash
from tests.bench.accept.benches import configured
from tests.bench.accept.sabotages import CHANGES, FAULTS, Fault, number_of
from tests.bench.accept.switched import KEPT, ROOT, Tree

SUITE = ROOT / "bench" / "accept" / "suite"
SECONDS = 400.0  # that a run of the suite may take


class Caught(NamedTuple):
    """Which tests caught a fault: by limits, and by measurements that are not as specified."""

    limits: tuple[str, ...]
    specified: tuple[str, ...]
    unlike: tuple[str, ...]
    """Parameters that are not as specified."""


@cache
def stamp() -> str:
    """What results are of: the drive's sources and the suite."""
    digest = hashlib.sha256(source_hash().encode())
    for file in sorted(SUITE.glob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()[:12]


def kept(fault: Fault) -> Path:
    """Where the result of a fault is."""
    made = hashlib.sha256(f"{fault.size} {fault.config} {fault.kind.change} {fault.kind.effect}".encode())
    return KEPT / stamp() / f"{re.sub(r'[^a-zA-Z0-9.]+', '-', fault.name)}-{made.hexdigest()[:8]}.json"


def tree() -> Tree:
    """The copy with all changes of the table."""
    return Tree.of(CHANGES)


def effect(made: Tree, fault: Fault) -> tuple[float, float]:
    """Its number on a healthy drive, and on the faulty one. RuntimeError with what went wrong."""
    name = fault.kind.effect
    found = _measured(made, name, json.dumps(fault.config), number_of(fault.kind), fault.size)
    return _measured(made, name, "{}", 0, 0.0), found


@cache
def _measured(made: Tree, effect: str, config: str, number: int, size: float) -> float:
    ran = made.run("tests.bench.accept.effects", effect, config, number=number, size=size)
    if ran.returncode:
        raise RuntimeError(f"{effect} {config}: {ran.stderr[-500:]}")
    return float(json.loads(ran.stdout.splitlines()[-1]))


def accepted(made: Tree, number: int, size: float, config: dict[str, Any], file: Path, *more: str) -> int | None:
    """Run `bench accept` on the simulated drive with a fault, results to `file`; the exit code, None: it hung.

    RuntimeError for a run without a result, or that somebody ended.
    """
    own = file.with_suffix(".toml")
    own.write_text(configured("", config))
    file.unlink(missing_ok=True)
    words = ("bench", "accept", "sim", "--config", own, "--json", file, *more)
    try:
        ran = made.run(*words, number=number, size=size, seconds=SECONDS)
    except subprocess.TimeoutExpired:
        return None
    finally:
        own.unlink()
    if not file.exists() or json.loads(file.read_text())["verdict"] == Verdict.ABORTED:
        raise RuntimeError(f"bench accept ended with {ran.returncode}: {ran.stderr[-800:]}")
    return ran.returncode


def result_of(made: Tree, fault: Fault) -> dict[str, Any]:
    """Its effect and what the suite measured, from what is kept or from a run."""
    file = kept(fault)
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        healthy, found = effect(made, fault)
        entry: dict[str, Any] = {"name": fault.name, "healthy": healthy, "found": found}
        if fault.shown(healthy, found):
            run = file.with_name(f"run-{file.name}")
            entry["code"] = accepted(made, number_of(fault.kind), fault.size, fault.config, run)
            entry["run"] = json.loads(run.read_text()) if entry["code"] is not None else None
            run.unlink(missing_ok=True)
            file.write_text(json.dumps(entry))
        return entry
    known: dict[str, Any] = json.loads(file.read_text())
    return known


def judged(entry: dict[str, Any], spec: Spec) -> Caught:
    """Which tests caught it, by limits and by a spec; those first whose measurements are furthest out."""
    if entry["run"] is None:
        return Caught(("timeout",), ("timeout",), ())
    run = run_from_json(entry["run"])
    bad = {Verdict.FAIL, Verdict.ERROR}
    limits = [test.name for test in run.tests if test.verdict in bad]
    specified: dict[str, float] = {}
    for test in run.tests:
        for m in test.measurements:
            if not spec.allows(m):
                specified[test.name] = max(specified.get(test.name, 0.0), _out(spec.measurements[m.name], m.value))
    furthest = sorted(specified, key=lambda name: -specified[name])
    unlike = spec.unlike({p.name: p.value for p in run.parameters})
    return Caught(tuple(limits), tuple(furthest), tuple(unlike))


def _out(band: Band, value: float | None) -> float:
    """How far a value is out of its band, in widths of the band."""
    lo, hi = (band.lo, band.hi)
    width = hi - lo if lo is not None and hi is not None else abs(hi if hi is not None else lo or 0.0)
    at = value or 0.0
    beyond = max(-math.inf if lo is None else lo - at, -math.inf if hi is None else at - hi)
    return beyond / max(width, 1e-12)


def main() -> int:
    """Run what has no result yet, the largest of each kind first; 1 if a fault does not show its effect."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="faults whose names begin so")
    parser.add_argument("--effects", action="store_true", help="only their effects")
    options = parser.parse_args()
    names = tuple(options.names) or ("",)
    made, without = tree(), []
    chosen = [fault for fault in FAULTS.values() if fault.name.startswith(names)]
    chosen.sort(key=lambda fault: (fault.size != fault.kind.sizes[-1], fault.size != fault.kind.sizes[0]))
    for k, fault in enumerate(chosen, 1):
        begun = time.monotonic()
        if options.effects:
            healthy, found = effect(made, fault)
            entry = {"healthy": healthy, "found": found}
        else:
            entry = result_of(made, fault)
        shown = fault.shown(entry["healthy"], entry["found"])
        without += [] if shown else [fault.name]
        change = entry["found"] - entry["healthy"]
        print(f"{k} of {len(chosen)} {fault.name}: {fault.kind.effect} changes by {change:.4g}, by the formula "
              f"{fault.kind.expected(fault.size):.4g}{'' if shown else ': NOT SHOWN'}; "
              f"ended with {entry.get('code')}, {time.monotonic() - begun:.0f} s", flush=True)  # fmt: skip
    print(f"{len(chosen)} faults, {len(without)} without their effect: {', '.join(without)}")
    return int(bool(without))


if __name__ == "__main__":
    sys.exit(main())
