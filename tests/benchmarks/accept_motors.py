"""`python -m tests.benchmarks.accept_motors [MOTOR …]`: the acceptance suite on the motors that are shipped.

Each as it is, and as unkind as a bench moderately is; then with the wrong pole pairs, flux linkage and wiring, each of
which one measurement must name. Prints a line a run; exit code 1 if a healthy drive does not pass, or a wrong one is
not named.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import Any

from bench.device.simulator import motors

WRONG = {
    "wrong n_p": ("back_emf", "back_emf_and_encoder.encoder_turns"),
    "wrong psi_f": ("back_emf", "back_emf_and_encoder.psi_f_deviation"),
    "wrong wiring": ("hall_edges and not table1", "hall_edges.wiring_as_specified"),
}


def unkind(motor: dict[str, float]) -> str:
    """What makes a motor's configuration unkind, by its own size; begins within [motor]."""
    tau = 1.5 * motor["n_p"] * motor["psi_f"] * motor["i_max"]
    offset = 0.0025 * motor["i_max"]
    return f"""
emf_harmonics = [0.03, -0.02, 0.0, 0.0]
cogging = [{0.015 * tau:.3g}, {0.008 * tau:.3g}]
i_sat = {4.0 * motor["i_max"]:.3g}
[hall]
pole_pair_deg = 1.5
latency = 5e-6
[encoder]
eccentricity_deg = 0.1
unevenness = 0.3
[inverter]
dead_time_by_edges = 1
[current_sensor]
gain_error = [0.01, -0.01, 0.005]
offset = [{offset:.3g}, {-offset:.3g}, {offset / 2:.3g}]
delay = 1e-6
"""


def wrong(what: str, motor: dict[str, float]) -> str:
    """The section of a configuration that makes it so."""
    return {
        "wrong n_p": f"\n[firmware]\nn_p = {motor['n_p'] + 1:.0f}\n",
        "wrong psi_f": f"\n[firmware]\npsi_f_hat = {0.7 * motor['psi_f']:.4g}\n",
        "wrong wiring": "\n[wiring]\nhall_swap = 1\n",
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
        text = motors()[name].read_text()
        motor = tomllib.loads(text)["motor"]
        for kind, more in (("kind", ""), ("unkind", unkind(motor))):
            run = accept(text + more)
            failed = [m for test in run["tests"] for m in test["measurements"] if m["verdict"] != "PASS"]
            bad += run["verdict"] != "PASS"
            count = sum(len(test["measurements"]) for test in run["tests"])
            print(f"{name:24} {kind:12} {run['verdict']}, {count} measurements", flush=True)
            for m in failed:
                print(f"{'':24} {m['name']} = {m['value']} ({m['limits']['lo']} … {m['limits']['hi']})", flush=True)
        for what, (keyword, by) in WRONG.items():
            run = accept(text + wrong(what, motor), keyword)
            verdict = next(m["verdict"] for test in run["tests"] for m in test["measurements"] if m["name"] == by)
            bad += verdict != "FAIL"
            print(f"{name:24} {what:12} {'named by' if verdict == 'FAIL' else 'NOT NAMED by'} {by}", flush=True)
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
