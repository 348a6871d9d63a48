"""`bench live` with recording, of a simulated drive behind a pty at 16 kHz: CPU of both, latency.

The CPU time is that of a process with all its children, from 1.5 s after the first sample on.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import probe
import psutil

SECONDS = 10.0
SETTLED = 1.5  # s after the first sample
EVERY = 0.2  # s


def spent(process: psutil.Process) -> float:
    """CPU time of a process and its children so far, s."""
    own = process.cpu_times()
    times = [own, *(child.cpu_times() for child in process.children(recursive=True))]
    return own.children_user + own.children_system + sum(each.user + each.system for each in times)


def watch(process: psutil.Process, seen: list[tuple[float, float]], end: threading.Event) -> None:
    """Look at a process now and then: the time, and its CPU time so far."""
    while not end.wait(EVERY):
        try:
            seen.append((time.time(), spent(process)))
        except psutil.NoSuchProcess:
            return


def share(seen: list[tuple[float, float]], begin: float) -> float:
    """% of a core from a time on, for `SECONDS`."""
    first, last = np.interp([begin, begin + SECONDS], *np.array(seen).T)
    return float(100 * (last - first) / SECONDS)


def main() -> None:
    drive = subprocess.Popen(
        [sys.executable, "-m", "bench", "sim", "--pty"],
        stdout=subprocess.PIPE,
        stdin=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    end = threading.Event()
    try:
        assert drive.stdout is not None
        target = next(line for line in drive.stdout if "target: " in line).split("target: ")[1].split()[0]
        with tempfile.TemporaryDirectory() as folder:
            file, out = Path(folder, probe.RUN), Path(folder, "out.json")
            command = [sys.executable, "-m", "bench", "live", target, "--speed", "1000", "--yes", "--viewer", "none"]
            command += ["--duration", f"{SECONDS + SETTLED + 1.0:g}", "--save", str(file), "--json", str(out)]
            host = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
            seen: dict[int, list[tuple[float, float]]] = {host.pid: [], drive.pid: []}
            for pid in seen:
                threading.Thread(target=watch, args=(psutil.Process(pid), seen[pid], end), daemon=True).start()
            _, said = host.communicate()
            if host.returncode:
                raise SystemExit(f"bench live: exit code {host.returncode}\n{said}")
            summary = json.loads(out.read_text("utf-8"))
    finally:
        end.set()
        drive.terminate()
        drive.wait()
    lost = summary["lost"]
    if lost["samples_by_index"] or lost["edges_by_index"]:
        raise SystemExit(f"lost {lost}: the machine is too busy for what this measures")
    begin = float(summary["first_sample_unix_s"]) + SETTLED
    probe.tell(
        {
            "host of bench live with recording, 26 channels and edges: CPU, % of a core": share(seen[host.pid], begin),
            "simulated drive in real time, 26 channels and edges: CPU, % of a core": share(seen[drive.pid], begin),
            "sample to sink, p99, ms": summary["latency_ms"]["p99"],
        }
    )


if __name__ == "__main__":
    main()
