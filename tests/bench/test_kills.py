"""Five of the hundred runs that `python -m tests.benchmarks kills` ends by a signal at a random moment."""

from __future__ import annotations

import random
import signal
from pathlib import Path

import pytest

from tests.benchmarks.bench_kills import LATEST, SHORT, WATCHDOG, drive, kill

pytestmark = [pytest.mark.alone, pytest.mark.campaign("kills"), pytest.mark.long("real time")]

RESULTS = {
    signal.SIGKILL: ("watchdog", -signal.SIGKILL, ""),
    signal.SIGTERM: ("STOP", 143, "ended by SIGTERM"),
    signal.SIGHUP: ("STOP", 129, "ended by SIGHUP"),
    signal.SIGQUIT: ("STOP", 131, "ended by SIGQUIT"),
    signal.SIGSTOP: ("watchdog", 1, "WATCHDOG"),
}


def test_however_the_host_ends_the_outputs_go_off_and_the_recording_is_whole(tmp_path: Path) -> None:
    moments = random.Random(7)
    with drive() as (sim, proxy):
        for n, number in enumerate(RESULTS):
            off, code, result = RESULTS[number]
            for again in range(3):  # who takes both cores for 0.1 s keeps the host from what the drive has sent
                each = kill(number, moments.uniform(0.0, LATEST), sim, proxy, tmp_path / f"{n}-{again}.run")
                assert (each.off, each.code) == (off, code), each
                assert result in each.result, each
                assert not each.outputs_on, each
                assert each.unfed <= WATCHDOG + 0.002, each
                if each.short <= SHORT:
                    break
            assert each.short <= SHORT, each
