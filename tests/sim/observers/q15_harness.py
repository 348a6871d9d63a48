"""Builds the C file of the fixed-point observer and runs it on rows of integers; see q15_harness.c."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim.observers import vector_tracking_q15
from sim.observers.vector_tracking_q15 import Constants, State

C_DIR = Path(vector_tracking_q15.__file__).parent / "c"
SOURCES = (Path(__file__).with_suffix(".c"), C_DIR / "vector_tracking_q15.c")
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
CHECKED = ("-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover")


def build(program: Path, *flags: str, sources: tuple[Path, ...] = SOURCES) -> Path:
    """Compile and link, warnings being errors; returns `program`."""
    command = ["gcc", *STRICT, *flags, f"-I{C_DIR}", *map(str, sources), "-o", str(program)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return program


def _input(constants: Constants, state: State, rows: NDArray[np.int64]) -> bytes:
    """`rows`: shape (n, 10), reset and the fields of Counts."""
    every = np.concatenate([np.array([*constants, *state], np.int64), rows.ravel()])
    assert every.min() >= -(1 << 31)
    assert every.max() < 1 << 32
    return every.astype(np.uint32).tobytes()  # two's complement, modulo 2^32


def trace(program: Path, constants: Constants, state: State, rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """The states after each row, shape (n, 10), fields as in State."""
    done = subprocess.run([program], input=_input(constants, state, rows), capture_output=True)
    assert done.returncode == 0, done.stderr.decode()
    out = np.frombuffer(done.stdout, np.int32).reshape(len(rows), len(State._fields)).astype(np.int64)
    out[:, State._fields.index("theta")] &= 0xFFFFFFFF
    return out


def nanoseconds(program: Path, constants: Constants, state: State, rows: NDArray[np.int64], repeat: int) -> float:
    """Time of a step, over `repeat` passes through the rows; resets are left out."""
    done = subprocess.run([program, str(repeat)], input=_input(constants, state, rows), capture_output=True, check=True)
    return float(done.stderr)
