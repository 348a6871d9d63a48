"""Real Hall sensors: eight captures of mjbots/moteus, fw/test/data (Apache License 2.0), as captures without encoder.

Three Hall pins at 30 kHz, nothing else. A file is three bytes a sample, 0x5a, code and 0, and may begin within one.
The folder is $HALLBENCH_CAPTURES, by default shared/data/moteus-hall beside the repository.
"""

from __future__ import annotations

import gzip
import os
from pathlib import Path

import numpy as np
import pytest

from bench.importer.from_logic import MoteusFile
from bench.importer.importer import Prepared, capture_of, prepare
from bench.importer.importer import write as import_run
from bench.importer.mapping import mapping_of
from bench.signal.capture import Capture

FOLDER = Path(
    os.environ.get("HALLBENCH_CAPTURES", Path(__file__).resolve().parents[3] / "shared" / "data" / "moteus-hall")
)
NAMES = (
    "20250615-new-slow",
    "20250616-back-and-forth",
    "20250616-bnforth-highaccel",
    "20250616-hboard-cycle",
    "20250616-hboard-manual",
    "20250616-speed-cycle",
    "20260618-spindle-hw",
    "20260618-spindle-sweep",
)
RATE = 30_000
NEIGHBOURS = {(1, 3), (3, 2), (2, 6), (6, 4), (4, 5), (5, 1)}
"""Codes that follow each other forward (SPEC chapter 12)."""

needs_captures = pytest.mark.skipif(
    not all((FOLDER / f"{name}.dat.gz").is_file() for name in NAMES),
    reason="no captures of moteus: fw/test/data of mjbots/moteus, its folder in HALLBENCH_CAPTURES",
)


def unpacked(name: str) -> bytes:
    """What the file holds."""
    return gzip.decompress((FOLDER / f"{name}.dat.gz").read_bytes())


def prepared(name: str, decimation: int) -> Prepared:
    """A capture as `bench import` prepares it."""
    source = MoteusFile(FOLDER / f"{name}.dat.gz")
    rate = {} if decimation == 1 else {"rate_hz": RATE / decimation}
    return prepare(source, mapping_of({"time": rate, "hall": {"column": "hall"}}, name))


def read(name: str, decimation: int = 1) -> Capture:
    """A capture; an edge has the tick of the sample in which its code is seen first, 33 us late at most.

    Args:
        decimation: every how many samples one is kept; edges are those of all samples.
    """
    return capture_of(prepared(name, decimation))


def write(path: Path, name: str, decimation: int = 1) -> Path:
    """A recording of it, for `bench hall check`."""
    return import_run(prepared(name, decimation), FOLDER / f"{name}.dat.gz", path).path


def shares_deg(capture: Capture, first: float, last: float) -> np.ndarray:
    """Electrical degrees of sectors I to VI, shape (6,), from device time `first` to `last` in s, in one direction.

    Each passage of a sector is divided by the mean of the two whole electrical turns about it, in which neither the
    speed's slope nor the place of an edge shows. Means over passages: whole turns of the shaft should be given.
    """
    t, code = capture.edge_t, capture.edges.hall_new[:-1]
    passage = np.diff(t)
    k = np.flatnonzero((t[:-1] > first) & (t[1:] < last))
    k = k[(k >= 3) & (k < len(passage) - 3)]
    turns = ((t[k + 3] - t[k - 3]) + (t[k + 4] - t[k - 2])) / 2
    shares = 360 * passage[k] / turns
    mean = np.array([shares[code[k] == one].mean() for one in (1, 3, 2, 6, 4, 5)])
    return np.asarray(mean * 360 / mean.sum())


def displacements_deg(widths: np.ndarray) -> np.ndarray:
    """How far sensors a, b, c lie forward of their places, (3,), from sectors' widths (6,); their mean is taken out.

    A sensor's place is the middle of its two edges, 180 degrees apart: a delay of rising edges alone and a speed that
    swings once an electrical turn move them in opposite directions.
    """
    begins = np.cumsum(widths - 60) - (widths - 60)
    places = np.array([begins[5] + begins[2], begins[1] + begins[4], begins[3] + begins[0]]) / 2
    return np.asarray(places - places.mean())
