"""What pulses, bounces and dead Hall sensors cost the Kalman filter on edges.

`python -m tests.benchmarks disturbed`. The control is on the encoder; the edges of the end of a run are disturbed, and
the observer goes on from where it was before. What is added: largest error with a disturbance, less that without.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from bench.device.simulator import motors
from sim.config.params import load_params
from sim.config.unkind import unkind
from sim.observers import sample
from sim.observers.catalogue import CATALOGUE
from sim.observers.entry import chosen
from tests.benchmarks.table import Row
from tests.sim.drive.rig import MEASURED, Recorded, column, physical
from tests.sim.observers.proving import TAUGHT, Proving

sys.path.insert(0, str(Path(__file__).parents[1] / "sim" / "observers"))
from disturbed import bounced, dead, pulsed
from ideal_motor import Signals, error_deg

BENCHES = (("", True), ("", False), ("maxon-ec60-flat", False), ("gimbal-4310", True), ("hurst-dmb0224c10002", True))
"""Motors, "" being the paper's, and whether the bench is kind."""
POINTS = ((0.03, 0.5), (-0.1, 0.0), (0.1, 0.5), (-0.33, 0.5), (0.9, 0.25))  # shares of speed and current
WIDTHS = (2e-6, 20e-6, 60e-6, 150e-6, 250e-6, 500e-6, 1e-3, 2e-3)  # s
RATES = (10, 100, 1000)  # 1/s
SPACINGS = (5e-6, 20e-6, 60e-6, 150e-6, 500e-6)  # s
PULSES = 200  # of each width
MOST = 3.0  # deg


def rows(short: bool) -> Iterator[Row]:
    """By disturbance, the worst of all benches and speeds."""
    worst: dict[str, list[float]] = {}
    for motor, kind in BENCHES[:1] if short else BENCHES:
        for share, load in POINTS[-1:] if short else POINTS:
            for what, figure in costs(End(motor, kind, share, load), 2 if short else PULSES):
                worst.setdefault(what, []).append(figure)
    for what, found in worst.items():
        goal = MOST if what.endswith("added") and "/s" not in what else None
        yield Row(what, max(found), "turns" if "named after" in what else "deg", goal, at_most=True)


class End:
    """The end of a run, and the observer before it."""

    def __init__(self, motor: str, kind: bool, share: float, load: float) -> None:
        self.share = share
        params = load_params(motors()[motor] if motor else None)
        bench = Proving("encoder", load_params(motors()[motor] if motor else None, {} if kind else unkind(params)), 110)
        rpm, amps, way = share * bench.top, load * bench.i_max, math.copysign(1.0, share)
        parts = [bench.forced(way * rpm * bench.top, i * bench.i_max, s * bench.longer) for rpm, i, s in TAUGHT]
        parts.append(bench.forced(rpm, amps, 0.3 * bench.longer + 30.0 / abs(rpm)))
        self.seconds = max(0.4, 240.0 / abs(rpm * params.motor.n_p))
        """Four electrical revolutions at least."""
        self.front = sample.FrontEnd(
            sample.make_params(params.clock.tick_hz, chosen(sample.Settings, bench.parameters))
        )
        entry = CATALOGUE["edge_kalman"]
        self.observer = entry.start(entry.make_params(params.clock.pwm_hz, bench.parameters))
        self._observed(_signals(bench, parts))
        self._before = self.front.state.first, self.observer.state.first
        self.signals = _signals(bench, [bench.forced(rpm, amps, self.seconds)])
        self.tick_hz = params.clock.tick_hz
        self.turn = 60.0 / abs(rpm * params.motor.n_p)
        """An electrical revolution, s."""
        self.clean = self.error(self.signals)[0]

    def _observed(self, s: Signals) -> np.recarray:
        reset = np.zeros(s.tick.size, np.bool_)
        return self.observer.run(self.front.run(s.measured, s.edges, reset), reset).view(np.recarray)

    def seen(self, s: Signals) -> tuple[np.recarray, np.ndarray]:
        """The estimates, and the size of their error, deg."""
        self.front.state.first, self.observer.state.first = self._before
        out = self._observed(s)
        return out, np.abs(error_deg(s.theta, out.theta))

    def error(self, s: Signals) -> tuple[np.ndarray, np.ndarray]:
        """Its size, deg, and who is named: bits 0-2."""
        out, error = self.seen(s)
        return error, out.sensors & 7

    def added(self, s: Signals) -> float:
        """The largest error that a disturbance adds, deg; infinite if somebody is named for it."""
        error, named = self.error(s)
        return math.inf if np.any(named) else float((error - self.clean).max())


def _signals(bench: Proving, parts: Sequence[Recorded]) -> Signals:
    seen = {name: np.concatenate([physical(part, name) for part in parts]) for name in (*MEASURED, "i_q_ref", "i_q")}
    ticks = [part.tick + np.arange(len(part)) * bench.params.clock.period_ticks for part in parts]
    captured = np.concatenate([part.captured for part in parts])
    return Signals(
        np.concatenate(ticks),
        np.concatenate([part.samples["hall"] for part in parts]),
        *(seen[name] for name in MEASURED),
        seen["i_q_ref"] - np.r_[0.0, seen["i_q"][:-1]],
        captured["tick"].astype(np.int64),
        captured["code"].astype(np.uint8),
        np.concatenate([column(part, "theta_e") for part in parts]),
    )


def costs(end: End, n: int) -> Iterator[tuple[str, float]]:
    """What disturbances cost at the end of a run, `n` pulses of each width: what, and deg or turns."""
    rng, s = np.random.default_rng(7), end.signals
    first, span = int(s.tick[0]), end.seconds * end.tick_hz

    def pulse(width: float) -> tuple[int, float, float]:
        return rng.integers(3), first + rng.uniform(0.05, 0.6) * span, width

    for width in WIDTHS:
        found = max(end.added(pulsed(s, [pulse(width)])) for _ in range(n))
        yield f"a pulse of {1e6 * width:g} us: added", found
    for rate in RATES:
        longest = min(2e-3, 0.2 / rate)
        many = [
            [pulse(10 ** rng.uniform(-5.7, math.log10(longest))) for _ in range(int(rate * end.seconds))]
            for _ in range(3)
        ]
        found = max(float((end.error(pulsed(s, each))[0] - end.clean).max()) for each in many)
        yield f"{rate} pulses/s up to {1e6 * longest:g} us at {abs(end.share):.0%} of the speed: added", found
    for gap in SPACINGS:
        returns = [k for k in (1, 2, 3) if 2 * k * gap < end.turn / 6]  # what lasts longer than a sector is no bounce
        if returns:
            found = max(end.added(bounced(s, rng, k, gap, share)) for k in returns for share in (1.0, 0.1))
            yield f"1 to 3 returns {1e6 * gap:g} us apart: added", found
    deaths = [
        (k, level, 0.02 * end.tick_hz + rng.uniform() * end.turn * end.tick_hz) for k in range(3) for level in (0, 1)
    ]
    for k, level, at in deaths:
        begin = int(np.searchsorted(s.tick, first + at))
        error, named = end.error(dead(s, k, level, first + at))
        known = begin + int(np.argmax(named[begin:] == 1 << k))
        alone = set(named[known:]) == {1 << k}
        seconds = (known - begin) / s.tick.size * end.seconds
        yield "a sensor dies: named after", seconds / end.turn if alone else math.inf
        yield "a sensor dies: largest error until then", float(error[begin : known + 1].max())
        yield "a sensor dies: largest error from then on", float(error[known:].max())
