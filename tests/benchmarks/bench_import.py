"""How long it takes to import a million rows, and how much memory: whole processes, start of Python included.

`python -m tests.benchmarks import`. Rows have a time, a Hall code, an angle, three currents and three voltages, written
by pandas, pyarrow and asammdf. Beside it `bench hall check` of ten minutes at 16 kHz.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import asammdf
import numpy as np
import pandas as pd

from tests.bench.long_run import repeated
from tests.benchmarks.table import Row, cost

GOAL = 5.0  # s
FLAT = 50.0  # MB that ten times the rows may take more
RATE = 16_000
PROGRAM = """
import sys
from bench.cli import main
try:
    main(sys.argv[1:])
finally:  # ru_maxrss would be that of the program which started this one, too
    told = dict(line.split(":", 1) for line in open("/proc/self/status"))
    print(int(told["VmHWM"].split()[0]) / 1e3)
"""


def table(n: int) -> pd.DataFrame:
    """A shaft whose speed swings, ideal sensors, and noise."""
    t = np.arange(n) / RATE
    theta = 250.0 * t + 3.0 * np.sin(t)
    sector = np.floor(((theta - np.pi / 6) % (2 * np.pi)) / (np.pi / 3)).astype(int)
    found = {"time [s]": t, "hall": np.array([1, 3, 2, 6, 4, 5])[sector], "theta [el deg]": np.degrees(theta) % 360.0}
    chance = np.random.default_rng(1)
    for name in ("i_a [A]", "i_b [A]", "i_c [A]", "u_alpha [V]", "u_beta [V]", "u_dc [V]"):
        found[name] = np.round(chance.normal(0.0, 3.0, n), 4)
    return pd.DataFrame(found)


def mdf(rows: pd.DataFrame, path: Path) -> None:
    """By asammdf."""
    with asammdf.MDF(version="4.10") as file:
        t = rows["time [s]"].to_numpy()
        names = [name for name in rows if name != "time [s]"]
        split = [(name, *name.rstrip("]").partition(" [")[::2]) for name in names]
        file.append(
            [asammdf.Signal(rows[name].to_numpy(), t, name=own, unit=unit) for name, own, unit in split],
            common_timebase=True,
        )
        file.save(path, overwrite=True)


def whole(*arguments: str | Path) -> tuple[float, float]:
    """s that a process takes, and MB of its memory at most."""
    began = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", PROGRAM, *map(str, arguments)], capture_output=True, text=True)
    return time.perf_counter() - began, float(done.stdout.split()[-1])


def best(repeat: int, *arguments: str | Path) -> tuple[float, float]:
    """The quickest of so many."""
    return min(whole(*arguments) for _ in range(repeat))


def rows(short: bool) -> Iterator[Row]:
    """The figures."""
    n, repeat = (20_000, 1) if short else (1_000_000, 3)
    with tempfile.TemporaryDirectory(prefix="hallbench-") as folder:
        home = Path(folder)
        made, out = table(n), ("-o", home / "x.run", "--overwrite")
        made.to_csv(home / "a.csv", index=False, float_format="%.9g")
        pd.concat([made.assign(**{"time [s]": made["time [s]"] + k * n / RATE}) for k in range(10)]).to_csv(
            home / "ten.csv", index=False, float_format="%.10g"
        )
        made.to_parquet(home / "a.parquet")
        mdf(made, home / "a.mf4")
        size = (home / "a.csv").stat().st_size / 1e6
        for name, what in (("a.csv", f"CSV of {size:.0f} MB"), ("a.parquet", "Parquet"), ("a.mf4", "MDF 4")):
            took, memory = best(repeat, "import", home / name, *out)
            yield cost(f"{n:,} rows of 9 columns, {what}", took, "s", None if name == "a.mf4" else GOAL)
            if name == "a.csv":
                _, more = whole("import", home / "ten.csv", *out)
                yield Row("memory for ten times the rows, more than for these", more - memory, "MB", FLAT, at_most=True)
        repeated(home / "long.run", 5 if short else 500)
        took, _ = best(repeat, "hall", "check", home / "long.run")
        yield cost(f"bench hall check of {(5 if short else 500) * 1.2:.0f} s at 16 kHz", took, "s")
