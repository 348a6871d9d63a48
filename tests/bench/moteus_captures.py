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

from bench.record.info import RunInfo
from bench.record.writer import RunWriter
from bench.signal.capture import Capture
from bench.signal.chunks import part
from protocol.descriptor import Descriptor
from protocol.messages import StreamEvent
from protocol.signals import DRIVE_CHANNELS
from protocol.streams import EdgeChunk, SampleChunk, StreamConfig

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
RATE, TICK_HZ = 30_000, 30_000_000
NEIGHBOURS = {(1, 3), (3, 2), (2, 6), (6, 4), (4, 5), (5, 1)}
"""Codes that follow each other forward (SPEC chapter 12)."""

_HALL = tuple(channel for channel in Descriptor.of(DRIVE_CHANNELS, ()).channels if channel.name == "hall")

needs_captures = pytest.mark.skipif(
    not all((FOLDER / f"{name}.dat.gz").is_file() for name in NAMES),
    reason="no captures of moteus: fw/test/data of mjbots/moteus, its folder in HALLBENCH_CAPTURES",
)


def unpacked(name: str) -> bytes:
    """What the file holds."""
    return gzip.decompress((FOLDER / f"{name}.dat.gz").read_bytes())


def read(name: str, decimation: int = 1) -> Capture:
    """A capture; an edge has the tick of the sample in which its code is seen first, 33 us late at most.

    Args:
        decimation: every how many samples one is kept; edges are those of all samples.
    """
    packed = np.frombuffer(unpacked(name), np.uint8)
    first = next(k for k in range(3) if np.all(packed[k::3] == 0x5A))
    codes = packed[first + 1 :: 3]
    clock = {"tick_hz": TICK_HZ, "pwm_hz": RATE}
    config = StreamConfig(1, 0, 1, StreamEvent.PWM, decimation, _HALL, 32, **clock)
    index = np.arange(0, len(codes), decimation, dtype=np.int64)
    raw = np.empty(len(index), config.dtype)
    raw["hall"] = codes[index]
    samples = SampleChunk(config, index, index * (TICK_HZ // RATE), raw, ())
    changed = np.flatnonzero(np.diff(codes)) + 1
    old, new = codes[changed - 1], codes[changed]
    legal = [pair in NEIGHBOURS or pair[::-1] in NEIGHBOURS for pair in zip(old.tolist(), new.tolist(), strict=True)]
    n = len(changed)
    edges = EdgeChunk(
        StreamConfig(1, 1, 2, StreamEvent.EDGES, 1, (), 32, **clock), changed * (TICK_HZ // RATE), old, new,
        ~np.array(legal), np.zeros(n, np.uint16), np.arange(n, dtype=np.int64), (),
    )  # fmt: skip
    return Capture(samples, edges)


def write(path: Path, name: str, decimation: int = 1) -> Path:
    """A recording of it, for `bench hall check`."""
    capture = read(name, decimation)
    writer = RunWriter(path, RunInfo(TICK_HZ, RATE, _HALL, identity={"name": name}))
    sent = 0
    for first in range(0, len(capture), 50_000):
        samples = part(capture.samples, first, min(first + 50_000, len(capture)))
        until = int(np.searchsorted(capture.edges.tick, samples.tick[-1], side="right"))
        if until > sent:  # edges come before the samples of their time
            writer.take(part(capture.edges, sent, until))
        writer.take(samples)
        sent = until
    writer.close()
    return path


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
