"""`bench hall check` of a long recording: CPU time of the process."""

from __future__ import annotations

import subprocess
import sys

import probe
import recorded

SECONDS, REPEAT = 300.0, 3

if __name__ == "__main__":
    costs = {}
    if probe.there("bench.hall"):
        run = recorded.run("long.run", SECONDS, False)
        command = [sys.executable, "-m", "bench", "hall", "check", str(run)]
        took = probe.best(REPEAT, lambda: subprocess.run(command, capture_output=True, check=True))
        costs[f"bench hall check of {SECONDS:g} s at 16 kHz: CPU, s"] = took
    probe.tell(costs)
