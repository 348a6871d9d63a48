"""Makes the recordings here, and bounds around the figures of the observers on them.

    python tests/data/make.py

The recordings are kept, so that the bounds hold the observers to what they made of the same data before, whatever
became of the simulated drive meanwhile. Make them anew only where an observer is meant to have changed.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import bench

HERE = Path(__file__).parent
CHANNELS = (
    *("hall", "status", "u_alpha", "u_beta", "i_a", "i_b", "i_c", "i_q_ref", "i_q"),
    *("theta_enc", "theta_vt", "omega_vt"),
)
MARGIN = "0.2%"


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


def main() -> None:
    """Record, score, write."""
    runs: tuple[Callable[[bench.Rig], None], ...] = (steady, reversal)
    for run in runs:
        path = HERE / f"{run.__name__}.run"
        with bench.connect("sim", channels=CHANNELS, save=path, overwrite=True, settings=bench.Settings()) as rig:
            run(rig)
        bounds = ["--write-expect", str(path.with_suffix(".toml")), "--margin", MARGIN, "--overwrite"]
        subprocess.run([sys.executable, "-m", "bench", "score", str(path), *bounds], check=True)


if __name__ == "__main__":
    main()
