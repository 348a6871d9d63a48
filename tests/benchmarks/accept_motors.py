"""`python -m tests.benchmarks.accept_motors [MOTOR …]`: the acceptance suite on the motors that are shipped.

Each as it is, and on a bench as unkind as a real one; then with the wrong pole pairs, flux linkage and wiring, each of
which one measurement must name. Prints a line a run; exit code 1 if a healthy drive does not pass, or a wrong one is
not named.

A number instead of a name is a motor that nobody has looked at, drawn by it: somewhere between two of the shipped ones,
its Hall edges up to 6 deg from their places.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from bench.device.simulator import motors
from sim.config.params import load_params
from sim.config.sections import Motor
from tests.bench.accept.benches import configured, drawn, on_an_unkind_bench

WRONG = {
    "wrong n_p": ("back_emf", "back_emf_and_encoder.encoder_turns"),
    "wrong psi_f": ("back_emf", "back_emf_and_encoder.psi_f_deviation"),
    "wrong wiring": ("hall_edges and not table1", "hall_edges.wiring_as_specified"),
}


def wrong(what: str, motor: Motor) -> dict[str, float]:
    """The overrides that make it so."""
    return {
        "wrong n_p": {"firmware.n_p": motor.n_p + 1},
        "wrong psi_f": {"firmware.psi_f_hat": 0.7 * motor.psi_f},
        "wrong wiring": {"wiring.hall_swap": 1},
    }[what]


def accept(text: str, keyword: str = "") -> dict[str, Any]:
    """The results on a drive with this configuration."""
    with tempfile.TemporaryDirectory() as folder:
        config, out = Path(folder, "motor.toml"), Path(folder, "run.json")
        config.write_text(text)
        command = [sys.executable, "-m", "bench", "accept", "sim", "--config", str(config), "--json", str(out)]
        subprocess.run(command + (["-k", keyword] if keyword else []), cwd=folder, capture_output=True, check=False)
        found: dict[str, Any] = json.loads(out.read_text())
        return found


def main(names: list[str]) -> int:
    """Run all; 1 if anything is not as it should be."""
    bad = 0
    for name in names or motors():
        motor, own = ("", drawn(int(name))) if name.isdecimal() else (name, {})
        for kind, text in (("kind", configured(motor, own)), ("unkind", on_an_unkind_bench(motor, own))):
            run = accept(text)
            failed = [m for test in run["tests"] for m in test["measurements"] if m["verdict"] != "PASS"]
            bad += run["verdict"] != "PASS"
            count = sum(len(test["measurements"]) for test in run["tests"])
            print(f"{name:24} {kind:12} {run['verdict']}, {count} measurements", flush=True)
            for m in failed:
                print(f"{'':24} {m['name']} = {m['value']} ({m['limits']['lo']} … {m['limits']['hi']})", flush=True)
        for what, (keyword, by) in WRONG.items():
            run = accept(
                configured(motor, {**own, **wrong(what, load_params(motors().get(motor), own).motor)}), keyword
            )
            verdict = next(m["verdict"] for test in run["tests"] for m in test["measurements"] if m["name"] == by)
            bad += verdict != "FAIL"
            print(f"{name:24} {what:12} {'named by' if verdict == 'FAIL' else 'NOT NAMED by'} {by}", flush=True)
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
