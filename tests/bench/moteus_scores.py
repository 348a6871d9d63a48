"""Observers on Hall edges alone, on the captures of `moteus_captures`: figures by `bench score`, and moteus's own.

`truth` and `published_metric` are those of mjbots/moteus fw/test/hall_filter_test.cc (0ee13698), `PUBLISHED` the limits
of its fw/test/hall_regression_test.py (082f939f, both Apache License 2.0): a run of its filter passes with a result
from half of a limit up to it. The truth is linear from entry to entry into sectors, wherever the sensors are.
"""

from __future__ import annotations

import math
import tomllib
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import bench
from bench.replay.estimators import Estimators
from tests.bench.moteus_captures import RATE, read

Floats = NDArray[np.float64]
LIMITS = Path(__file__).parent / "tables" / "real_observers.toml"
OBSERVERS = ("edge_kalman", "hall_vector_decoupled", "hall_vector", "average_speed", "sector_centre")
"""Those that run on edges, but for `lookup_table`, which is `average_speed` where nobody has filled its table."""
SPINDLE, WHEEL = {"n_p": 2.0, "omega_m_max": 1260.0}, {"n_p": 15.0, "omega_m_max": 42.0}
"""What is told of each motor, by --set: pole pairs, and a round speed above its largest."""
SECTOR_OF_CODE = np.array([-1, 0, 2, 1, 4, 5, 3, -1])
COUNT = math.pi / 3
"""Electrical rad of a count of moteus: a sector."""
SCORED = ("rms", "std", "max", "bias", "speed")
METRIC = ("position", "position_max", "velocity", "velocity_max")
MARGIN, LEAST = 0.2, {"bias": 0.1, "rms": 0.05, "std": 0.05}
"""Of a figure, and deg at least, on both sides."""


class Metric(NamedTuple):
    """Mean square and largest error of the position in counts, and of the velocity in counts/s."""

    position: float
    position_max: float
    velocity: float
    velocity_max: float


PUBLISHED = {
    "20250616-speed-cycle": [
        Metric(0.09, 1.1, 1400, 280), Metric(0.09, 1.1, 1400, 270), Metric(0.09, 1.1, 1400, 270),
        Metric(0.08, 1.1, 2800, 350), Metric(0.09, 1.1, 3500, 390),
    ],
    "20250616-back-and-forth": [
        Metric(0.11, 1.1, 150, 70), Metric(0.11, 1.1, 190, 70), Metric(0.11, 1.1, 190, 70),
        Metric(0.11, 1.1, 190, 70), Metric(0.11, 1.1, 200, 70),
    ],
    "20250616-bnforth-highaccel": [
        Metric(0.09, 1.1, 190, 80), Metric(0.09, 1.1, 250, 80), Metric(0.09, 1.1, 250, 80),
        Metric(0.09, 1.1, 260, 80), Metric(0.09, 1.1, 260, 80),
    ],
    "20250616-hboard-cycle": [
        Metric(0.06, 1.1, 900, 130), Metric(0.06, 1.1, 1400, 160), Metric(0.06, 1.1, 2800, 180),
        Metric(0.06, 1.1, 2800, 180), Metric(0.06, 1.1, 2900, 180),
    ],
    "20250616-hboard-manual": [
        Metric(0.04, 1.1, 23, 20), Metric(0.04, 1.1, 23, 20), Metric(0.04, 1.1, 25, 20),
        Metric(0.04, 1.1, 25, 20), Metric(0.04, 1.1, 25, 20),
    ],
}  # fmt: skip
"""By the filter's bandwidth: 50, 124, 248, 496, 992 Hz."""


SPEED_OF_SECTOR = "its speed is that of the sector before, and wrong by the sensors' places"
CENTRE = "it stands in the middle of a sector: 1/12 of a count² is its nature, and moteus's filter moves"
SLOW_LOOP = "its loop of 10 Hz steps with each sector of a shaft that starts, stops and turns round by hand"
STOPS = "where the shaft stops or turns round between two edges the truth stands or is a line; it goes on meanwhile"
WORSE = {
    **{
        (name, observer, "velocity"): SPEED_OF_SECTOR
        for name in PUBLISHED
        for observer in ("average_speed", "sector_centre")
    },
    **{
        (name, observer, "velocity_max"): SPEED_OF_SECTOR
        for name in ("20250616-speed-cycle", "20250616-hboard-cycle")
        for observer in ("average_speed", "sector_centre")
    },
    **{(name, "sector_centre", "position"): CENTRE for name in ("20250616-hboard-cycle", "20250616-hboard-manual")},
    **{
        ("20250616-hboard-manual", observer, key): SLOW_LOOP
        for observer in ("hall_vector", "hall_vector_decoupled")
        for key in ("velocity", "velocity_max")
    },
    ("20250616-hboard-manual", "edge_kalman", "velocity_max"): STOPS,
    ("20250616-speed-cycle", "edge_kalman", "position_max"): STOPS,
}
"""By capture, observer and figure: why it is above the least of moteus's limits."""


def best_published(name: str) -> Metric:
    """The least limit of each figure over all bandwidths."""
    return Metric(*(min(column) for column in zip(*PUBLISHED[name], strict=True)))


def motor(name: str) -> dict[str, float]:
    """What is told of the motor of a capture."""
    return WHEEL if "hboard" in name else SPINDLE


def truth(codes: NDArray[np.uint8]) -> tuple[Floats, Floats, Floats]:
    """Position (counts) and velocity (counts/s) at each sample, and the way, 1, -1 or 0, that the shaft then goes."""
    sector = SECTOR_OF_CODE[codes]
    step = (np.diff(sector) + 3) % 6 - 3
    count = np.concatenate([sector[:1], sector[0] + np.cumsum(step)])
    changed, i = np.flatnonzero(step) + 1, np.arange(len(codes))
    part = np.searchsorted(changed, i, "right")
    first = np.concatenate([[0], changed - 1])[part]
    last = np.concatenate([changed, [0]])[part]
    goes = np.where((part < len(changed)) & (count[first] != count[last]), count[last] - count, 0)
    position = count + np.where(goes, (i - first) / np.maximum(last - first, 1) * goes, 0.0)
    velocity = np.where(goes, goes * RATE / np.maximum(last - first - 1, 1), 0.0)
    return position, velocity, np.sign(goes).astype(float)


def published_metric(codes: NDArray[np.uint8], theta: Floats, omega: Floats) -> Metric:
    """moteus's figures of an estimate, electrical rad and rad/s, over all samples of a file.

    A count names the place where a shaft that turns forward enters a sector, where one that turns in reverse leaves it,
    and the middle of the sector of one that stands: as an angle it is that. Angles are electrical, so a position error
    is told within three counts; none of moteus's exceeds 1.1.
    """
    position, velocity, way = truth(codes)
    off = (position + 0.5 * (1.0 - way) - theta / COUNT + 3.0) % 6.0 - 3.0
    slip = velocity - omega / COUNT
    return Metric(*(float(x) for e in (off, slip) for x in (np.mean(e**2), np.abs(e).max())))


@cache
def figures(name: str) -> dict[str, dict[str, float]]:
    """All figures of each observer on a capture: `SCORED` by its own edges, electrical deg and r/min, and `METRIC`."""
    capture = read(name)
    pooled = bench.score(capture, observers=OBSERVERS, reference="edges", **motor(name)).pooled
    estimators = Estimators(OBSERVERS, motor(name), capture.samples.config)
    estimators.edges(capture.edges)
    codes, found = capture.samples.raw["hall"], estimators.samples(capture.samples)
    return {
        observer: {
            "rms": pooled[observer]["moving"]["rms"],
            **{key: pooled[observer]["error"][key] for key in ("std", "max", "bias")},
            "speed": pooled[observer]["speed"]["std"],
            **published_metric(codes, *found[observer])._asdict(),
        }
        for observer in OBSERVERS
    }


def limits(value: float, key: str) -> tuple[float, float]:
    """On both sides of a figure."""
    margin = max(MARGIN * abs(value), LEAST.get(key, 0.0))
    return value - margin, value + margin


def as_toml(names: tuple[str, ...]) -> str:
    """The limits of all captures and observers."""
    lines = [
        "# Figures of observers on Hall edges alone on real captures, from and to: python docs/make_real_halls.py",
        "# rms, std, max, bias: electrical deg, by the capture's own edges; speed: r/min; then moteus's.",
    ]
    for name in names:
        lines += ["", f"[{name}]"]
        for observer, of in figures(name).items():
            cells = (f"{key} = [{lo:.4g}, {hi:.4g}]" for key in of for lo, hi in [limits(of[key], key)])
            lines.append(f"{observer} = {{ {', '.join(cells)} }}")
    return "\n".join(lines) + "\n"


@cache
def read_limits() -> dict[str, dict[str, dict[str, list[float]]]]:
    """By capture, observer and figure."""
    return tomllib.loads(LIMITS.read_text())
