"""Learns the shipped spec of the simulated drive, bench/accept/specs/sim.toml, or counts its false alarms.

python docs/make_spec.py [--runs 60] [--first 1] [--check] [--keep DIR]

Each run is of another drive of the same kind: the paper's motor with the firmware's figures as they are by default, and
what `of_the_kind` draws. With --check they are judged by the file, and it is not written: learn from some, check with
others. Results are kept in DIR, as `bench accept --json` writes them, and those that are there are not made anew.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import tempfile
from collections import Counter
from operator import attrgetter
from pathlib import Path
from typing import Any

import tomli_w

from bench.accept.accept import AcceptOptions, accept
from bench.accept.learning import learned, summary
from bench.accept.results import RunResult, run_from_json
from bench.accept.spec import SHIPPED, Spec, read_spec, write_spec
from bench.cli.output import Progress
from sim.config.derive import RULES
from sim.config.params import Value, load_params

NAME = "sim"
WARMER = 10.0  # K, either way, of winding and magnets
COPPER, MAGNET = 0.0039, -0.0011  # 1/K, of R_s and psi_f
TOLERANCES = {
    "motor.R_s": 0.02, "motor.psi_f": 0.01, "motor.L_d": 0.02, "mechanics.b": 0.1, "mechanics.tau_coulomb": 0.1,
    "inverter.u_dc": 0.0025,
}  # fmt: skip
"""Shares by which one drive differs from another, either way."""
SCREEN: Any = Progress(status=False)
OFFSET, GAIN = 5e-3, 2e-3  # A and 1, of each current sensor, either way


def of_the_kind(number: int) -> dict[str, Value]:
    """The configuration of one more drive of the kind: its temperature, its motor, its sensors; noise is the seed's."""
    draw, kind = random.Random(number), load_params()
    values: dict[str, Value] = {key: attrgetter(key)(kind) for key in RULES}  # not of this very motor
    own = {key: attrgetter(key)(kind) * (1.0 + draw.uniform(-s, s)) for key, s in TOLERANCES.items()}
    warmer = draw.uniform(-WARMER, WARMER)
    own["motor.R_s"] *= 1.0 + COPPER * warmer
    own["motor.psi_f"] *= 1.0 + MAGNET * warmer
    own["motor.L_q"] = own["motor.L_d"]
    sensors: dict[str, Value] = {
        "current_sensor.offset": [draw.uniform(-OFFSET, OFFSET) for _ in range(3)],
        "current_sensor.gain_error": [draw.uniform(-GAIN, GAIN) for _ in range(3)],
    }
    return values | own | sensors


def toml(values: dict[str, Value]) -> str:
    """Values by dotted key as a configuration."""
    sections: dict[str, Any] = {}
    for dotted, value in values.items():
        *path, key = dotted.split(".")
        table = sections
        for name in path:
            table = table.setdefault(name, {})
        table[key] = value
    return tomli_w.dumps(sections)


def run_of(number: int, folder: Path) -> RunResult:
    """The suite on one of them, or what is kept of that."""
    file = folder / f"{number}.json"
    if not file.exists():
        config = folder / f"{number}.toml"
        config.write_text(toml(of_the_kind(number)))
        accept(AcceptOptions(target="sim", config=config, seed=number, json=file), SCREEN)
    return run_from_json(json.loads(file.read_text()))


def main() -> int:
    """Learn and write, or check and say; 1 if a drive of the kind was refused."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--runs", type=int, default=60)
    parser.add_argument("--first", type=int, default=1, help="the first drive's number")
    parser.add_argument("--check", action="store_true", help="judge them by the file")
    parser.add_argument("--keep", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        runs = {f"drive {n}": run_of(n, folder) for n in range(options.first, options.first + options.runs)}
    if not options.check:
        found = learned([(run, called) for called, run in runs.items()], Spec(SHIPPED / f"{NAME}.toml"))
        write_spec(found)
        print("\n".join(summary(found, *list(runs.values())[-1:])))
        return 0
    known = read_spec(NAME)
    out = [[m.name for m in run.measurements if not known.allows(m)] for run in runs.values()]
    print(f"{sum(map(bool, out))} of {len(runs)} runs of good drives have a measurement out of its band")
    for name, often in Counter(name for names in out for name in names).most_common():
        print(f"{often:4} {name}")
    return int(any(out))


if __name__ == "__main__":
    sys.exit(main())
