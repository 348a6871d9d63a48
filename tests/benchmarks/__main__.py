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
    "accuracy": (bench_accuracy, "Accuracy: plant against solve_ivp, position errors against the plant"),
    "learned": (bench_learned_edges, "Learned edges: position errors against the plant, beside vector tracking"),
    "decode": (bench_decode, "Decode: bytes to numpy columns, CRC checked"),
    "fixed_point": (bench_fixed_point, "Fixed point: 16 bits beside floating point, same telemetry"),
    "sim": (bench_sim, "Simulated drive in virtual time"),
    "live": (bench_live, "Live: all channels at 16 kHz over a pty, recorded"),
    "can": (bench_can, "CAN: stream frames to numpy columns, and a run over slcan, recorded"),
    "slcan": (bench_slcan, "slcan: text, and reading 5000 CAN FD frames of 64 bytes a second"),
    "replay": (bench_replay, "Replay and score of a recorded minute, all channels at 16 kHz"),
    "accept": (bench_accept, "Acceptance: the whole suite in virtual time"),
    "kills": (bench_kills, "Killed, stopped or told to end at a random moment"),
    "start": (bench_start, "Start-up, caches warm"),
}
OF_A_LENGTH = (bench_live, bench_can, bench_slcan)


def main() -> None:
    """Run the parts that were asked for, all by default."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks", description=__doc__)
    parser.add_argument("parts", nargs="*", choices=[[], *PARTS], metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--seconds", type=float, default=60.0, help="length of the live run and of each slcan reader")
    given = parser.parse_args()
    print(f"Python {platform.python_version()}, {os.cpu_count()} cores")
    reached = True
    for name in given.parts or PARTS:
        part, title = PARTS[name]
        reached &= show(title, part.rows(given.seconds) if part in OF_A_LENGTH else part.rows())
    print("\nevery goal reached" if reached else "\nsome goals were MISSED")


if __name__ == "__main__":
    main()
