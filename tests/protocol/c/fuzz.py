"""The fuzz of the device side in C for as long as one likes.

    python -m tests.protocol.c.fuzz byte 100000000 [SEED]     frames over a byte link
    python -m tests.protocol.c.fuzz can 100000000 [SEED]      over classic CAN; canfd: over CAN FD
    python -m tests.protocol.c.fuzz step 10000000 [SEED]      instructions, between which interrupts come
    python -m tests.protocol.c.fuzz paths 20                  seconds of libFuzzer, which looks for new paths

It ends with a line of figures, or where something does not hold.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).parent
SOURCE = HERE.parents[2] / "protocol" / "c"
CHECKED = ("-g", "-O2", "-fno-sanitize-recover=all", "-DHBP_HOSTS=2")
SANITIZED = (*CHECKED, "-fsanitize=address,undefined")
WAYS: dict[str, tuple[str, ...]] = {
    "byte": ("gcc", "fuzz.c", *SANITIZED),
    "can": ("gcc", "fuzz.c", *SANITIZED),
    "canfd": ("gcc", "fuzz.c", *SANITIZED, "-DHBP_CAN_BYTES=64"),
    "step": ("gcc", "interrupts.c", "-O2", "-DHBP_CHANNELS=8"),
    "paths": ("clang", "fuzz.c", *CHECKED, "-fsanitize=fuzzer,address,undefined", "-DLIBFUZZER"),
}


def main(way: str, amount: str, seed: str = "1") -> int:
    """Build the program of this way, and run it; its exit code."""
    compiler, file, *flags = WAYS[way]
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder, "fuzz")
        files = [HERE / file, SOURCE / "hbp.c", SOURCE / "hbp_can.c"]
        subprocess.run([compiler, "-std=c99", *flags, *files, "-o", program], check=True)
        if way == "paths":
            arguments = [f"-max_total_time={amount}", "-max_len=4096", "-len_control=0"]
        else:
            arguments = ["can" if way == "canfd" else way, amount, seed]
        return subprocess.run([program, *arguments]).returncode


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4) or sys.argv[1] not in WAYS:
        sys.exit(__doc__)
    sys.exit(main(*sys.argv[1:]))
