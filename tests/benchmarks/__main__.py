"""`python -m tests.benchmarks [PART …] [--seconds S]`: every figure beside its goal, as a ratio."""

from __future__ import annotations

import argparse
import os
import platform

from tests.benchmarks import (
    bench_accept,
    bench_accuracy,
    bench_can,
    bench_decode,
    bench_fixed_point,
    bench_kills,
    bench_learned_edges,
    bench_live,
    bench_replay,
    bench_sim,
    bench_slcan,
    bench_start,
)
from tests.benchmarks.table import show

PARTS = {
    "accuracy": (
        "Accuracy: plant against solve_ivp, position errors against the plant",
        lambda seconds: bench_accuracy.rows(),
    ),
    "learned": (
        "Learned edges: position errors against the plant, beside vector tracking",
        lambda seconds: bench_learned_edges.rows(),
    ),
    "decode": ("Decode: bytes to numpy columns, CRC checked", lambda seconds: bench_decode.rows()),
    "fixed_point": (
        "Fixed point: 16 bits beside floating point, same telemetry",
        lambda seconds: bench_fixed_point.rows(),
    ),
    "sim": ("Simulated drive in virtual time", lambda seconds: bench_sim.rows()),
    "live": ("Live: all channels at 16 kHz over a pty, recorded", bench_live.rows),
    "can": ("CAN: stream frames to numpy columns, and a run over slcan, recorded", bench_can.rows),
    "slcan": ("slcan: text, and reading 5000 CAN FD frames of 64 bytes a second", bench_slcan.rows),
    "replay": ("Replay and score of a recorded minute, all channels at 16 kHz", lambda seconds: bench_replay.rows()),
    "accept": ("Acceptance: the whole suite in virtual time", lambda seconds: bench_accept.rows()),
    "kills": ("Killed, stopped or told to end at a random moment", lambda seconds: bench_kills.rows()),
    "start": ("Start-up, caches warm", lambda seconds: bench_start.rows()),
}


def main() -> None:
    """Run the parts that were asked for, all by default."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks", description=__doc__)
    parser.add_argument("parts", nargs="*", choices=[[], *PARTS], metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--seconds", type=float, default=60.0, help="length of the live run and of each slcan reader")
    given = parser.parse_args()
    print(f"Python {platform.python_version()}, {os.cpu_count()} cores")
    reached = True
    for name in given.parts or PARTS:
        title, rows = PARTS[name]
        reached &= show(title, rows(given.seconds))
    print("\nevery goal reached" if reached else "\nsome goals were MISSED")


if __name__ == "__main__":
    main()
