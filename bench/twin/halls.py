"""Hall sensors of a twin: where each edge lies, hysteresis, jitter, and by how much each kind of edge comes late."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from bench.commission.window import Floats
from bench.errors import BenchError
from bench.findings.health import resolution
from bench.hall.trace import Recorded, trace
from bench.record.layout import EDGES
from bench.record.reader import Run
from bench.signal import hall_edges
from bench.signal.edge_fit import EdgeFit
from bench.signal.position import wrap
from bench.signal.trace import INPUTS
from bench.signal.waveforms.sectors import SECTOR_WIDTH, SECTORS
from bench.twin.values import Value, several, single
from sim.ports.followed import pole_pair_means

PLACE_FLOOR = 0.02
"""deg, sd: what an uneven disc and steps of the encoder leave in a mean."""
JITTER_FLOOR = 0.05
"""Of the jitter, sd."""
LATE_FLOOR = 5e-7
"""s, sd, of how late edges come."""
SURE = 3.0
"""Standard deviations beyond which a spread, or a delay of its own, is believed."""
MOST_HYSTERESIS, MOST_JITTER = 10.0, 3.0
"""deg, that the simulated drive's sensors can have."""


@dataclass(frozen=True)
class Halls:
    """What the edges of one run tell: values by dotted key of the configuration."""

    values: tuple[Value, ...]
    residual: float
    """deg rms, of a passage about its edge's place."""
    resolution: float
    """deg rms, to which an edge is known by the steps of its time, and of the encoder's angle."""
    untold: tuple[str, ...]
    blind: bool
    """Whether no encoder was recorded."""
    n_p: int | None
    """Pole pairs by edges that repeat, where no parameter says them."""


def halls(run: Run, zero: float = 0.0, zero_sd: float = 0.0, encoder_delay: float = 0.0) -> Halls | str:
    """Of a run with Hall edges; `zero`, rad, and `encoder_delay`, s, of its encoder. Else why not, in words."""
    if EDGES not in run.names:
        return "no Hall edges were recorded"
    try:
        looked_at = trace(Recorded(run))
    except BenchError as error:
        return str(error)
    measured = hall_edges.measure(looked_at)
    found, inputs = measured.fit, measured.inputs
    if found is None or (found.n.sum(axis=1) < 2).any():
        return "too few Hall edges were passed: each of the six is needed, in two turns at least"
    if inputs.inverted or (not measured.blind and not 0.9 < inputs.ratio < 1.1):
        return "Hall edges and encoder do not agree in order: mend the wiring first (bench hall check)"
    n = found.passages
    sharp = math.degrees(resolution(looked_at, measured))
    rms = math.degrees(math.sqrt(float(np.nansum(found.n * found.jitter**2) / n)))
    own = math.sqrt(max(rms**2 - sharp**2, 0.0))
    by_pair, uneven = found.pairs.shape[1], 0.0
    spread = math.degrees(float(found.pairs.std()))
    if found.apart and by_pair > 1 and spread > SURE * rms / math.sqrt(n / found.pairs.size):
        uneven = min(math.sqrt(3.0) * spread, 10.0)  # the simulated drive draws them evenly
    means = pole_pair_means(uneven, by_pair)  # what it draws is not to move the edges' means
    jitter = rms / math.sqrt(2.0 * n), sharp**2 / max(rms, sharp, 1e-9) + JITTER_FLOOR * own
    values = [
        *_places(found, zero, zero_sd, measured.blind, means), *_late(found, encoder_delay, measured.blind),
        _told("hall.jitter_deg", "deg", min(own, MOST_JITTER), *jitter),
    ]  # fmt: skip
    untold = []
    if uneven:
        values.append(_told("hall.pole_pair_deg", "deg", uneven, uneven / math.sqrt(2.0 * found.pairs.size), 0.0))
        untold.append(
            "which edge of which pole pair lies where: the twin's pole pairs have the spread, not the pattern"
        )
    if measured.blind:
        untold.append("the angle of the Hall ring, and a delay that all edges share: no encoder was recorded")
    if np.isnan(found.hysteresis).any():
        untold.append("hall.hysteresis_deg: the shaft turned one way only")
    if np.isnan(found.delay).any():
        untold.append("delays of the Hall edges: the speed did not change enough; the places are those at speed")
    return Halls(tuple(values), rms, sharp, tuple(untold), measured.blind, found.n_p or None)


def _told(key: str, unit: str, value: float, noise: float, method: float) -> Value:
    return single(key, unit, value, {"noise": noise, "method": method})


def _places(found: EdgeFit, zero: float, zero_sd: float, blind: bool, more: Floats) -> list[Value]:
    """`more`: deg, (6,), that go to the configuration's `hall.delta_deg` beside what was told."""
    off = found.place - SECTOR_WIDTH * np.arange(SECTORS) - zero
    ring = 0.0 if blind else hall_edges.mean_angle(off)
    delta = np.degrees(wrap(ring - off))
    sd = np.degrees(found.place_sd)
    told = several("hall.delta_deg", "deg", delta, [{"noise": float(one), "method": PLACE_FLOOR} for one in sd])
    values = [replace(told, value=(delta + more).tolist())]
    if not blind:
        own = math.sqrt(float(np.mean(sd**2)))
        floor = math.hypot(PLACE_FLOOR, math.degrees(zero_sd))
        values.insert(0, _told("hall.offset_deg", "deg", math.degrees(ring), own, floor))
    if np.isfinite(found.hysteresis).all():
        mean = min(max(math.degrees(float(found.hysteresis.mean())), 0.0), MOST_HYSTERESIS)
        own = math.degrees(float(np.sqrt(np.mean(found.hysteresis_sd**2)) / math.sqrt(SECTORS)))
        values.append(_told("hall.hysteresis_deg", "deg", mean, own, PLACE_FLOOR))
    return values


def _late(found: EdgeFit, encoder_delay: float, blind: bool) -> list[Value]:
    """Latency of all, and what rising and falling edges of each input have beyond it where they differ."""
    if np.isnan(found.delay).any():
        return []
    late: Floats = found.delay + (0.0 if blind else encoder_delay)
    sd = found.delay_sd
    apart = late - late.min()
    differ = bool((apart > SURE * np.hypot(sd, LATE_FLOOR)).any())
    common = float(late.min() if differ else late.mean())
    values = []
    if not blind:
        own = float(sd.mean())
        values.append(_told("hall.latency", "s", min(max(common, 0.0), 1e-3), own, LATE_FLOOR))
    if differ:
        for column, key in enumerate(("faults.hall.rise_delay", "faults.hall.fall_delay")):
            parts = [{"noise": float(one), "method": LATE_FLOOR} for one in sd[:, column]]
            values.append(several(key, "s", np.minimum(apart[:, column], 0.01), parts, names=INPUTS))
    return values
