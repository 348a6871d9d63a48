"""Makes the recordings here, and bounds around the figures of the observers on them.

    python tests/data/make.py [faults]

`faults/` has each fault of the Hall sensors that tests/bench/tables/hall_check.toml names. The recordings are kept, so
that the bounds hold the observers, and the check of Hall sensors, to what they made of the same data before, whatever
became of the simulated drive meanwhile. Make them anew only where an observer is meant to have changed.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bench

HERE = Path(__file__).resolve().parent
CHANNELS = (
    *("hall", "status", "u_alpha", "u_beta", "i_a", "i_b", "i_c", "i_q_ref", "i_q"),
    *("theta_enc", "theta_vt", "omega_vt"),
)
HALL_CHANNELS = ("hall", "status", "u_alpha", "u_beta", "i_a", "i_b", "i_c", "theta_enc")
MARGIN = "0.2%"
CASES = HERE.parent / "bench" / "tables" / "hall_check.toml"


def steady(rig: bench.Rig) -> None:
    """500 r/min with a load, from a start."""
    rig.drive.start("encoder")
    rig.drive.speed(rpm=500)
    rig.load.torque(0.2)
    rig.wait(0.6)


def reversal(rig: bench.Rig) -> None:
    """1000 to -1000 r/min without a load."""
    rig.drive.start("encoder")
    rig.drive.speed(rpm=1000)
    rig.wait(0.3)
    rig.drive.speed(rpm=-1000)
    rig.wait(0.4)


def faulty(config: str, path: Path) -> None:
    """240 r/min forward and reverse: Hall sensors that the drive would trip at by the load machine, others by it."""
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):  # no path of this machine is recorded
        Path("faulty.toml").write_text(config)
        with bench.connect("sim", channels=HALL_CHANNELS, save=path, overwrite=True, config="faulty.toml") as rig:
            turning: Any = rig.load if "hall_" in config and "glitch" not in config else rig.drive
            if turning is rig.drive:
                rig.drive.start("vector-tracking" if "encoder" in config else "encoder")
            else:
                rig.load.start()
            for rpm in (240, -240):
                turning.speed(rpm=rpm)
                rig.wait(0.7)


def main() -> None:
    """Record, score, write."""
    for name, config, _ in tomllib.loads(CASES.read_text("utf-8"))["faults"]:
        faulty(config, HERE / "faults" / f"{name}.run")
    if sys.argv[1:] == ["faults"]:
        return
    runs: tuple[Callable[[bench.Rig], None], ...] = (steady, reversal)
    for run in runs:
        path = HERE / f"{run.__name__}.run"
        with bench.connect("sim", channels=CHANNELS, save=path, overwrite=True, settings=bench.Settings()) as rig:
            run(rig)
        bounds = ["--write-expect", str(path.with_suffix(".toml")), "--margin", MARGIN, "--overwrite"]
        subprocess.run([sys.executable, "-m", "bench", "score", str(path), *bounds], check=True)


if __name__ == "__main__":
    main()
