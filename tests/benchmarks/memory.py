"""Memory of a process, over time."""

from __future__ import annotations

import threading
import time

import numpy as np
import psutil

FLAT = 20.0  # MB: what the memory of a recording host may differ by
MB = 1e6


class Memory:
    """Resident memory of a process, looked at every half a second: times in s and bytes."""

    def __init__(self, pid: int) -> None:
        self._process = psutil.Process(pid)
        self._found: list[tuple[float, int]] = []
        self.children_cpu = 0.0
        """s of CPU time that its children have taken, those that are there at a time."""
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()

    def _look(self) -> None:
        started = time.monotonic()
        while not self._end.wait(0.5):
            try:
                self._found.append((time.monotonic() - started, self._process.memory_info().rss))
                cpu = sum(sum(child.cpu_times()[:2]) for child in self._process.children())
                self.children_cpu = max(self.children_cpu, cpu)
            except psutil.NoSuchProcess:
                return

    def close(self) -> None:
        """End."""
        self._end.set()
        self._thread.join()

    def after(self, warm: float) -> tuple[float, float, float]:
        """The most, most less least, in MB, and MB/h by a straight line, from `warm` s on; without the last second."""
        t, size = np.array(self._found[:-2]).T
        t, size = t[t >= warm], size[t >= warm] / MB
        return float(size.max()), float(np.ptp(size)), float(np.polyfit(t / 3600.0, size, 1)[0])
