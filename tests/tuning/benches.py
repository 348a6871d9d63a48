"""Drives that are recorded once, with edge_kalman in control, and what an observer makes of what it would have seen."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from bench.device.simulator import motors
from sim.config.params import load_params
from sim.config.unkind import unkind
from sim.native import layout
from sim.observers.sample import Sample
from tests.sim.observers.proving import BENCH_24V, TAUGHT, Proving

OBSERVER = "edge_kalman"
DESIGNED_ON = ("bench24v", "gimbal-4310", "linix-45zwn24-40", "maxon-ec45-flat")
"""The benches that it was tuned on by hand."""
OTHERS = tuple(name for name in motors() if name not in DESIGNED_ON)
SLOW, MIDDLE, FAST, STEPS = "slow", "middle", "fast", "steps"
RANGES = {SLOW: (0.03, 0.06), MIDDLE: (0.15, 0.35), FAST: (0.6, 0.95)}
"""Shares of the largest speed."""
LOADS = (0.0625, 1.0)  # of the largest current
OFF = 0.2  # natural logarithm by which R_s_hat and L_s_hat are wrong, standard deviation; of psi_f_hat a fifth
LOST = 90.0  # deg: an error counts as so much at the most
UNKIND, KIND, PULSES = "unkind", "kind", "unkind, pulses on the Hall inputs"
PULSED = {
    "faults.begin": 0.5, "faults.hall.pulse_rate": [5.0] * 3, "faults.hall.pulse_min": 2e-5,
    "faults.hall.pulse_max": 1e-3,
}  # fmt: skip


class Stretch(NamedTuple):
    """Some samples that are judged."""

    kind: str
    """Of `RANGES`, or `STEPS`."""
    begin: int
    end: int


class Drive(NamedTuple):
    """A drive as observers have seen it; n samples."""

    name: str
    samples: np.ndarray
    reset: np.ndarray
    theta: np.ndarray  # rad, the rotor
    parameters: Mapping[str, float]
    stretches: Sequence[Stretch]
    pwm_hz: float

    def off(self, theta: np.ndarray, stretch: Stretch) -> np.ndarray:
        """Size of the error of an estimate (n,) in a stretch, deg."""
        part = slice(stretch.begin, stretch.end)
        off = np.abs((np.degrees(self.theta[part] - theta[part]) + 180.0) % 360.0 - 180.0)
        size: np.ndarray = np.minimum(np.nan_to_num(off, nan=LOST), LOST)
        return size

    def errors(self, theta: np.ndarray) -> Iterator[tuple[str, float]]:
        """Of an estimate (n,): by stretch its rms error, of steps the largest; deg."""
        for one in self.stretches:
            off = self.off(theta, one)
            yield one.kind, float(off.max() if one.kind == STEPS else np.sqrt(np.mean(off**2)))

    def beyond(self, theta: np.ndarray, sigma: np.ndarray) -> float:
        """Share of what is judged in which the error is beyond three times the deviation (n,) that is told, rad."""
        each = [self.off(theta, one) > 3.0 * np.degrees(sigma[one.begin : one.end]) for one in self.stretches]
        return float(np.concatenate(each).mean())


class Recorder(Proving):
    """A proving bench that keeps what observers get."""

    def __init__(self, name: str, seed: int, kind: str = UNKIND) -> None:
        self.kept: list[tuple[np.ndarray, np.ndarray]] = []
        self.thetas: list[np.ndarray] = []
        self.stretches: list[Stretch] = []
        file = BENCH_24V if name == "bench24v" else motors()[name]
        changes: dict[str, Any] = {} if kind == KIND or name == "bench24v" else dict(unkind(load_params(file)))
        changes = changes | (PULSED if kind == PULSES else {})
        self.rng = np.random.default_rng(seed)
        off = np.exp(OFF * self.rng.standard_normal(3) * (1.0, 1.0, 0.2))
        factors = dict(zip(("R_s_hat", "L_s_hat", "psi_f_hat"), off, strict=True)) if seed % 2 else {}
        super().__init__(OBSERVER, load_params(file, changes), seed, factors)

    def _run(self, source, n, block, begin, end):  # type: ignore[no-untyped-def]
        super()._run(source, n, block, begin, end)
        if end > begin:
            self.kept.append((self._samples.array[: end - begin].copy(), self._flags.array[begin:end].copy()))

    def advance(self, n):  # type: ignore[no-untyped-def]
        """As a bench does; the rotor's angle is kept too."""
        recorded = super().advance(n)
        self.thetas.append(recorded["theta_true"].copy())
        return recorded

    def judged(self, kind: str, run: Callable[[], object]) -> None:
        """Do what is judged."""
        begin = self.n
        run()
        self.stretches.append(Stretch(kind, begin, self.n))


def recorded(name: str, seed: int, kind: str = UNKIND) -> Recorder:
    """A bench with lessons, then speeds, loads and steps that its seed says."""
    bench = Recorder(name, seed, kind)
    bench.teach((speed, load, 0.6 * seconds) for speed, load, seconds in TAUGHT)
    rng = bench.rng
    for lo, hi in RANGES.values():
        of = next(kind for kind, ends in RANGES.items() if ends == (lo, hi))
        for way in (1.0, -1.0):
            rpm = way * bench.top * rng.uniform(lo, hi)
            load = math.exp(rng.uniform(*np.log(LOADS))) * bench.i_max
            bench.forced(rpm, load, 0.15 * bench.longer + 15.0 / abs(rpm))
            bench.judged(of, lambda rpm=rpm, load=load: bench.forced(rpm, load, max(0.15, 60.0 / abs(rpm))))  # type: ignore[misc]
    speed, load = bench.top * rng.uniform(0.1, 0.3), bench.i_max * rng.uniform(0.1, 0.4)
    bench.spin(speed, 0.5 * bench.longer)
    bench.judged(STEPS, lambda: bench.spin(2.0 * speed, 0.3))
    bench.judged(STEPS, lambda: bench.spin(2.0 * speed, 0.3, load))
    bench.judged(STEPS, lambda: bench.spin(-speed, 0.5))
    return bench


def drive(name: str, seed: int, kind: str = UNKIND) -> Drive:
    """The same, for observers beside it."""
    bench = recorded(name, seed, kind)
    samples = np.concatenate([samples for samples, _ in bench.kept])
    reset = np.concatenate([reset for _, reset in bench.kept]) != 0
    assert samples.dtype == layout(Sample)
    theta = np.concatenate(bench.thetas)
    return Drive(f"{name} {seed}", samples, reset, theta, bench.parameters, bench.stretches, bench.params.clock.pwm_hz)
