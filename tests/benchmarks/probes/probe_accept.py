"""The whole acceptance suite with its report: CPU time of the process and its children."""

from __future__ import annotations

import subprocess
import sys
import tempfile

import probe

if __name__ == "__main__":
    costs = {}
    if probe.there("bench.accept", "bench.acceptance"):

        def suite(*more: str) -> None:
            with tempfile.TemporaryDirectory() as report:
                command = [sys.executable, "-m", "bench", "accept", "sim", "--report", report, *more]
                done = subprocess.run(command, capture_output=True, text=True)
            if done.returncode:
                raise SystemExit(f"bench accept: exit code {done.returncode}\n{done.stdout[-3000:]}{done.stderr}")

        suite("-k", "fig08")  # compiled by now
        costs["acceptance suite with report, one process: CPU, s"] = probe.best(1, suite)
    probe.tell(costs)
