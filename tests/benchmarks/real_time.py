"""`python -m tests.benchmarks.real_time [-k EXPR]`: the suite in real time beside virtual time.

Runs `bench accept` on the simulated drive in virtual time and on `bench sim --pty`, and prints every measurement whose
verdict differs, or whose values differ by more of the room that its limits leave than `TOLERANCES` allow. Exit code 1
if any.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from contextlib import closing
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from tests.bench.processes import Sim

TOLERANCES = {
    "hall_wire*": 1.0,  # where the rotor was when a wire broke, or from where it started with two exchanged
    "hall_glitches*": 1.0,  # where the false pulses fell
    "lowest_speed*": 1.0,  # the shaft sticks and slips
    "fig06_frequency_response.high_pass_*": 0.7,  # the largest of ten deviations that are mostly noise
    "*": 0.35,  # noise of another seed, and when commands came
}
"""Of the width between the limits (of the limit, where there is one), by pattern of names: the first that fits."""


def tolerance(name: str) -> float:
    """What is allowed for a measurement."""
    return next(share for pattern, share in TOLERANCES.items() if fnmatchcase(name, pattern))


def measured(result: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Measurements by name."""
    return {m["name"]: m for test in result["tests"] for m in test["measurements"]}


def apart(a: dict[str, Any], b: dict[str, Any]) -> float:
    """How far two values are apart, as a share of the room that the limits leave."""
    lo, hi = a["limits"]["lo"], a["limits"]["hi"]
    if a["value"] is None or b["value"] is None or (lo is None and hi is None):
        return 0.0
    room = hi - lo if lo is not None and hi is not None else abs(hi if hi is not None else lo)
    return abs(float(a["value"]) - float(b["value"])) / room if room else float(a["value"] != b["value"])


def accept(target: str, keyword: str | None, folder: Path) -> dict[str, Any]:
    """Run `bench accept` as a process; its JSON."""
    out = folder / f"{target.partition(':')[0]}.json"
    command = [sys.executable, "-m", "bench", "accept", target, "--json", str(out)]
    subprocess.run(command + (["-k", keyword] if keyword else []), stdin=subprocess.DEVNULL, check=False)
    return json.loads(out.read_text())


def differences(virtual: dict[str, Any], real: dict[str, Any]) -> list[str]:
    """A line for everything that does not agree."""
    lines = [f"{v['name']}: {v['verdict']} in virtual time, {r['verdict']} in real time"
             for v, r in zip(virtual["tests"], real["tests"], strict=True) if v["verdict"] != r["verdict"]]  # fmt: skip
    there = measured(real)
    for name, here in measured(virtual).items():
        other = there[name]
        if here["verdict"] != other["verdict"] or apart(here, other) > tolerance(name):
            lines.append(
                f"{name}: {here['value']} {here['verdict']}; {other['value']} {other['verdict']} {other['why']}"
            )
    return lines


def main() -> int:
    """Run both and compare."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-k", dest="keyword")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        virtual = accept("sim", given.keyword, folder)
        with closing(Sim("--pty", "--seed", "7")) as sim:
            real = accept(sim.target, given.keyword, folder)
    lines = differences(virtual, real)
    n = len(measured(virtual))
    worst = max((apart(a, measured(real)[name]) for name, a in measured(virtual).items()), default=0.0)
    print("\n".join(lines) or f"{n} measurements agree: same verdicts, values at most {worst:.0%} of the limits apart")
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
