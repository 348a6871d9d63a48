"""`bench sim` and `bench live` as two processes on a real pty: the run, its recording, and every way to end it.

The pty is a serial port, or has an slcan adapter on a CAN bus behind it.
"""

from __future__ import annotations

import json
import resource
import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from processes import Program, Sim

from bench.record import space
from bench.record.reader import Run
from tests.choice import sampled
from tests.tools import require

pytestmark = [pytest.mark.real_time, pytest.mark.long("drive and host in real time")]

Start = Callable[..., Program]
StartSim = Callable[..., Sim]
PATIENT = ("--set", "firmware.watchdog=1.0", "--set", "load.watchdog=1.0")  # other programs may want the machine
OBSERVED = "hall,status,theta_enc,u_alpha,u_beta,i_a,i_b,i_c,i_q_ref,theta_vt"
RUNS = {
    "serial": (("--pty",), ("--host-observers",)),
    "CAN": (("--slcan",), ("--fit",)),
    "CAN FD": (("--slcan", "--fd", "--data-bitrate", "8000000"), ("--host-observers", "--channels", OBSERVED)),
}
SPIN = ("--speed", "500", "--viewer", "none", "--json", "-")


@pytest.mark.parametrize(("where", "options"), sampled("run", RUNS, 1, campaign="real-time"))
def test_a_run_over_a_pty_loses_nothing_and_is_recorded_whole(
    start: Start, start_sim: StartSim, tmp_path: Path, where: tuple[str, ...], options: tuple[str, ...]
) -> None:
    sim = start_sim(*where, *PATIENT)
    recording, summary_file = tmp_path / "a.run", tmp_path / "a.json"
    for _ in range(3):  # in real time, whoever takes both cores for 0.3 s makes the drive drop samples
        live = start(
            "live", sim.target, "--speed", "500", "--yes", "--duration", "3", "--save", str(recording),
            "--overwrite", "--viewer", "none", "--json", str(summary_file), *options,
        )  # fmt: skip
        assert live.end() == 0, live.err
        summary = json.loads(summary_file.read_text())
        if not any(summary["lost"].values()):
            break
    assert summary["lost"] == {
        "samples_by_index": 0, "edges_by_index": 0, "frames_by_sequence": 0, "frames_by_device": 0,
    }  # fmt: skip
    run = Run(recording)
    decimation = run.samples.config.decimation
    assert (decimation == 1) == ("--host-observers" in options)
    assert summary["samples"] >= 2.9 * 16000 / decimation
    assert 3 * 250 < summary["edges"] < 3 * 350  # 500 r/min, 6 pole pairs: 300 edges/s
    assert summary["link"]["damaged"] == summary["link"]["outages"] == summary["link"]["reboots"] == 0
    if decimation == 1:
        assert summary["host_observers"]["different"] == 0
        assert summary["host_observers"]["compared"] > 2.5 * 16000
    if "--slcan" in where:
        bus = summary["bus"]
        assert 0.1 < bus["load"] < bus["load_predicted"] + 0.1 < 1.05
        assert bus["foreign"] == bus["stale"] == bus["duplicates"] == bus["error_frames"] == 0
    assert len(run.samples) == summary["samples"] == summary["recording"]["samples"]
    assert len(run.edges.tick) == summary["edges"] == summary["recording"]["edges"]
    assert (np.diff(run.samples.index) == decimation).all()
    assert (np.diff(run.samples.tick) == 1250 * decimation).all()
    assert (np.diff(run.edges.index) == 1).all()
    assert run.samples.gaps == run.edges.gaps == ()
    assert len(run.samples.config.channels) == (10 if OBSERVED in options else 26)
    # every change of the sampled code has its edge: the recorded edges are those of the run, not of another
    sampled = run.samples.raw["hall"]
    since = np.searchsorted(run.edges.tick, run.samples.tick, side="right") - 1
    covered = since >= 0
    assert (run.edges.hall_new[since[covered]] == sampled[covered]).mean() > 0.999
    sim.line(r"outputs off: STOP \(node 1")


@pytest.fixture(params=sampled("disk", ("a limit on files", "a full disk"), 1, campaign="real-time"))
def small_place(
    request: pytest.FixtureRequest, tmp_path: Path
) -> Iterator[tuple[Path, Callable[[], None] | None, str]]:
    """A directory in which a megabyte is left to a recording, what a child does for it, and what a writer is told."""
    size = 1 << 20
    if request.param == "a limit on files":
        yield tmp_path, lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size)), "cannot be written"
        return
    require("small disk")
    disk = ["mount", "-t", "tmpfs", "-o", f"size={size + space.RESERVE}", "none", str(tmp_path)]
    subprocess.run(disk, check=True)
    yield tmp_path, None, "the disk is full"
    subprocess.run(["umount", str(tmp_path)], check=True)


def test_a_full_disk_ends_in_stop_and_a_summary(
    start: Start, start_sim: StartSim, small_place: tuple[Path, Callable[[], None] | None, str]
) -> None:
    directory, limit, says = small_place
    recording = directory / "a.run"
    sim = start_sim("--pty", *PATIENT)
    live = start("live", sim.target, *SPIN, "--save", str(recording), limit_resources=limit)
    sim.line(r"outputs on \(node 1")
    sim.line(r"outputs off: STOP \(node 1")
    assert live.end() == 3
    summary = json.loads("\n".join(live.out))
    assert summary["result"].startswith(f"recording failed: {recording}: {says}")
    assert summary["samples"] > summary["recording"]["samples"] > 1000
    assert summary["faults"] == []
    assert sum(says in line for line in live.err) == 1
    assert not any("Traceback" in line or "re_sdk" in line or "\x1b" in line for line in live.err)
    run = Run(recording)
    assert len(run.samples) > 1000  # what fitted is there
    assert run.ended == (limit is None)  # a disk that fills is seen before it is full


@pytest.mark.parametrize("where", sampled("unplugged", ("--pty", "--slcan"), 1, campaign="real-time"))
def test_an_unplugged_cable_is_waited_for_and_the_motor_is_not_started_again(
    start: Start, start_sim: StartSim, tmp_path: Path, where: str
) -> None:
    sim = start_sim(where, "--link", str(tmp_path / "tty"))
    recording = tmp_path / "a.run"
    live = start("live", sim.target, *SPIN, "--fit", "--save", str(recording), "--trigger", "abs(omega_enc)>=200")
    live.line("trigger .*: omega_enc was")
    sim.send(signal.SIGUSR1)
    sim.line(r"outputs off (\d+) ms after the last ALIVE: watchdog \(node 1")
    live.line("(is gone|was lost).*; waiting up to 30 s")
    sim.send(signal.SIGUSR2)
    live.line("the drive tripped: WATCHDOG")
    live.line(r"FAULT, \d+ r/min")  # it goes on watching
    live.send(signal.SIGINT)
    assert live.end() == 1
    summary = json.loads("\n".join(live.out))
    assert summary["result"].startswith("the drive tripped: WATCHDOG: this host sent no ALIVE for 0.")
    assert summary["link"]["outages"] == 1
    assert summary["link"]["downtime_s"] > 0.05  # from when it was noticed
    assert summary["link"]["reboots"] == 0
    assert summary["faults"] == ["WATCHDOG"]
    run = Run(recording)
    decimation = run.samples.config.decimation
    assert summary["lost"]["samples_by_index"] > 0.15 * 16000 / decimation
    assert sum("outputs on" in line for line in sim.out) == 1
    assert len(run.samples) == summary["samples"]
    steps = np.diff(run.samples.index) // decimation
    assert (steps - 1).sum() == summary["lost"]["samples_by_index"] == sum(g.lost_samples for g in run.samples.gaps)


def test_a_ring_with_a_trigger_and_marks_from_another_terminal(
    start: Start, start_sim: StartSim, tmp_path: Path
) -> None:
    sim = start_sim("--pty", *PATIENT)
    recording = tmp_path / "a.run"
    live = start(
        "live", sim.target, *SPIN, "--save", str(recording), "--keep", "1min", "--note", "new bearings",
        "--trigger", "abs(omega_enc)>=200",
    )  # fmt: skip
    live.line(r"trigger abs\(omega_enc\)>=200: omega_enc was 20\d")
    marked = start("mark", str(recording), "grease heard")
    assert marked.end() == 0, marked.err
    live.line("mark: grease heard, at ")
    live.send(signal.SIGINT)
    assert live.end() == 130
    run = Run(recording)
    trigger, by_hand = run.marks
    assert (trigger.name, by_hand.name) == ("trigger abs(omega_enc)>=200", "grease heard")
    omega = run.samples.physical("omega_enc")
    assert trigger.first_tick == run.samples.tick[np.flatnonzero(abs(omega) >= 200.0)[0]]
    assert trigger.first_tick < by_hand.first_tick <= run.samples.tick[-1]
    assert f"marked {run.at(by_hand.first_tick)} of {recording}: grease heard" in "\n".join(marked.out)
    assert run.info.identity["note"] == "new bearings"
    summary = json.loads("\n".join(live.out))
    assert summary["recording"]["kept_s"] == 60.0
