"""Drawn operations on drives whose parameters are told wrongly, and what an observer must hold on them.

A case follows from its seed: a motor of the ten or of three of another kind, a kind or an unkind bench, parameters that
are wrong as users mistype them, and what the shaft is asked to do. The control runs on the observer's own angle. The
oracle is the rotor's angle, and the Hall codes of healthy sensors.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bench.device.simulator import motors
from sim.config.params import Value, load_params
from sim.config.unkind import unkind
from sim.drive.machine import Recorded
from sim.observers.hall_speed import SECTOR_OF_CODE
from tests.sim.observers.proving import Proving

OTHERS: dict[str, Mapping[str, Value]] = {
    # odriverobotics.com, hoverboard guide: 0.18 ohm and 0.336 mH a phase, 16 r/min/V, 15 pole pairs
    "hub-36v": {
        "motor.n_p": 15, "motor.R_s": 0.18, "motor.L_d": 0.336e-3, "motor.L_q": 0.336e-3, "motor.psi_f": 0.0232,
        "motor.i_max": 15.0, "inverter.u_dc": 36.0,
    },
    # a spindle of two pole pairs, 1200 r/min/V; chosen
    "high-speed-2pp": {
        "motor.n_p": 2, "motor.R_s": 0.035, "motor.L_d": 35e-6, "motor.L_q": 35e-6, "motor.psi_f": 2.3e-3,
        "motor.i_max": 25.0,
    },
    # a gimbal motor with many turns of thin wire; chosen
    "gimbal-11pp": {
        "motor.n_p": 11, "motor.R_s": 5.6, "motor.L_d": 2.4e-3, "motor.L_q": 2.4e-3, "motor.psi_f": 8.5e-3,
        "motor.i_max": 1.6, "inverter.u_dc": 16.0,
    },
}  # fmt: skip
PARAMETERS = {
    "R_s_hat": (0.5, 2.0),
    "L_s_hat": (0.5, 2.0),
    "psi_f_hat": (0.58, 1.73),
    "J_hat": (0.3, 3.0),
    "dead_time_hat": (0.0, 2.0),
}
"""By what factor a parameter may be wrong."""
OPERATIONS = ("start", "creep", "speed steps", "load step", "reversal", "pulsating load", "steady", "hold")
EDGE_DEG = 9.0  # deg by which an edge may lie off the ideal one on these benches: Table I, hysteresis, pole pairs
SIGMAS = 3.0
BESIDE = ("sector_centre", "average_speed", "vector_tracking")


@dataclass(frozen=True)
class Case:
    """What is run."""

    seed: int
    motor: str
    kind: bool
    factors: Mapping[str, float]
    operation: str
    speed: float  # of the largest
    load: float  # of the largest current
    way: int

    def __str__(self) -> str:
        wrong = ", ".join(f"{name} x {factor:.2f}" for name, factor in self.factors.items()) or "all right"
        bench = "kind" if self.kind else "unkind"
        return f"{self.seed} {self.motor} {bench} {self.operation} {self.way * self.speed:.3f} {self.load:.2f}; {wrong}"


def drawn(seed: int) -> Case:
    """The case of a seed."""
    draw = np.random.default_rng([40, seed])
    motor = str(draw.choice(["", *motors(), *OTHERS]))
    factors = {}
    for name, (lo, hi) in PARAMETERS.items():
        if draw.random() < 0.4:
            factors[name] = float(draw.uniform(lo, hi) if lo == 0.0 else np.exp(draw.uniform(np.log(lo), np.log(hi))))
    operation = str(draw.choice(OPERATIONS))
    speed = float(np.exp(draw.uniform(np.log(0.02), np.log(0.7))))
    if operation == "creep":
        speed = float(np.exp(draw.uniform(np.log(0.004), np.log(0.03))))
    return Case(
        seed, motor, bool(draw.random() < 0.5), factors, operation, speed, float(draw.uniform(0.0, 0.6)),
        1 if draw.random() < 0.5 else -1,
    )  # fmt: skip


def bench_of(case: Case, observer: str = "edge_kalman", more: Mapping[str, Value] | None = None) -> Proving:
    """The bench of a case, running at rest; `more`: what else its configuration has."""
    changes = {**OTHERS.get(case.motor, {}), **(more or {})}
    file = motors().get(case.motor)
    params = load_params(file, changes)
    if not case.kind:
        params = load_params(file, {**changes, **unkind(params)})
    bench = Watched(observer, params, case.seed, case.factors)
    bench.watch(frozenset({"sigma_ek", *(bench.columns[name] for name in BESIDE)}))
    return bench


class Watched(Proving):
    """A bench that trips without an end, and runs only the observers that are compared."""

    def run(self, seconds: float) -> Recorded:
        """Go on, tripped or not."""
        return self.advance(round(seconds * self.params.clock.pwm_hz))


def operated(bench: Proving, case: Case) -> list[Recorded]:
    """What the shaft does, all records."""
    top, amps = case.way * case.speed * bench.top, case.load * bench.i_max
    load = case.way * amps
    longer = min(bench.longer, 3.0)
    runs = []
    if case.operation == "start":
        runs = [bench.spin(top, 1.5 * longer, load)]
    elif case.operation == "creep":
        runs = [bench.spin(5.0 * top, 0.5), bench.spin(top, 2.0, load)]
    elif case.operation == "speed steps":
        runs = [bench.spin(share * top, 0.5 * longer, load) for share in (1.0, 0.4, 1.4, 0.7)]
    elif case.operation == "load step":
        runs = [bench.spin(top, 0.8 * longer), bench.spin(top, 0.6, 1.6 * load), bench.spin(top, 0.6, 0.2 * load)]
    elif case.operation == "reversal":
        runs = [bench.spin(top, 0.7 * longer, load)]
        runs += [bench.spin(top * (1.0 - 0.1 * k), 0.06, load) for k in range(1, 21)]
        runs += [bench.spin(-top, 0.4, load)]
    elif case.operation == "pulsating load":
        runs = [bench.spin(top, 0.8 * longer, load)]
        turns = max(2, round(1.2 * longer * abs(top) / 60.0))
        runs += pulsated(bench, top, load, turns, least=2e-3, longest=3.0 * longer)
    elif case.operation == "steady":
        runs = [bench.forced(top, load, 2.0 * longer)]
    else:
        runs = [bench.spin(top, 0.5 * longer, 0.3 * load), bench.spin(0.0, 1.0, load), bench.spin(0.0, 0.7, -load)]
    return runs


def pulsated(
    bench: Proving, rpm: float, load: float, turns: int, times: int = 1, least: float = 5e-4, longest: float = math.inf
) -> list[Recorded]:
    """So many turns against `load` (A) and up to 30 % of the largest current more or less, `times` a turn of the shaft.

    The load changes every `least` s or more seldom. Ends after `longest` s.
    """
    period = 60.0 / abs(rpm)
    steps = max(8, min(64, round(period / least)))
    swing = 0.3 * bench.i_max
    runs: list[Recorded] = []
    for _ in range(round(steps * min(turns, longest / period))):
        angle = times * bench.truth.theta_e / bench.params.motor.n_p
        runs.append(bench.spin(rpm, period / steps, load + swing * math.sin(angle)))
    return runs


@dataclass(frozen=True)
class Held:
    """What a case gave."""

    case: Case
    outside: float  # s outside the sector of the codes, longer than one edge
    worse: float  # deg rms over a second more than the best of the others
    beyond: float  # share of samples with an error beyond `SIGMAS`
    largest: float  # deg
    rms: float
    sigma: float  # deg, rms
    faults: int
    others: Mapping[str, float]  # deg rms of those beside it
    others_worse: Mapping[str, float]  # as `worse`, of each of these against the other two and the observer

    @property
    def misses(self) -> list[str]:
        """The goals that it misses."""
        return [
            name
            for name, missed in (
                ("outside", self.outside > 0.0), ("worse", self.worse > 2.0), ("sigma", self.beyond > 0.01),
                ("trip", self.faults != 0),
            )
            if missed
        ]  # fmt: skip

    def __str__(self) -> str:
        return (
            f"largest {self.largest:5.1f} rms {self.rms:5.1f} sigma {self.sigma:5.1f} outside {self.outside:6.3f} s "
            f"worse {self.worse:6.2f} beyond {100 * self.beyond:5.1f}% faults {self.faults} "
            f"{'/'.join(self.misses) or 'ok'}"
        )


def _outside(error_of_sector: np.ndarray, code: np.ndarray, pwm_hz: float) -> float:
    """Seconds in which the estimate lay outside the codes' sector for longer than one edge, or than 0.1 s."""
    out = np.abs(error_of_sector) > 30.0 + EDGE_DEG
    begins = np.flatnonzero(np.diff(np.r_[False, out].astype(int)) == 1)
    ends = np.flatnonzero(np.diff(np.r_[out, False].astype(int)) == -1) + 1
    changes = np.r_[0, np.cumsum(np.diff(code.astype(int)) != 0)]
    total = 0
    for begin, end in zip(begins, ends, strict=True):
        if changes[end - 1] - changes[begin] >= 2 or end - begin > 0.1 * pwm_hz:
            total += int(end - begin)
    return total / pwm_hz


def held(case: Case, observer: str = "edge_kalman") -> Held:
    """Run a case and look at it."""
    bench = bench_of(case, observer)
    runs = operated(bench, case)
    pwm_hz = bench.params.clock.pwm_hz
    error = np.concatenate([bench.error(run) for run in runs])
    sigma = np.degrees(np.concatenate([run["sigma_ek"] for run in runs]))
    code = np.concatenate([run.samples["hall"] for run in runs])
    sector = np.array(SECTOR_OF_CODE)[code]
    centre = 60.0 * sector + 30.0 + bench.params.hall.offset_deg
    own = np.degrees(np.concatenate([run[bench.columns[observer]] for run in runs]))
    off = np.where(sector < 0, 0.0, (own - centre + 180.0) % 360.0 - 180.0)
    square = {name: np.concatenate([bench.error(run, name) for run in runs]) ** 2 for name in BESIDE}
    worse = _worse({observer: error**2, **square}, round(pwm_hz))
    return Held(
        case, _outside(off, code, pwm_hz), worse.pop(observer), float((np.abs(error) > SIGMAS * sigma).mean()),
        float(np.abs(error).max()), float(np.sqrt((error**2).mean())), float(np.sqrt((sigma**2).mean())),
        int(bench.faults), {name: float(np.sqrt(values.mean())) for name, values in square.items()}, worse,
    )  # fmt: skip


def _worse(square: Mapping[str, np.ndarray], window: int) -> dict[str, float]:
    """By how much the rms over so many samples is at most above that of the best of the others, deg, of each."""
    length = len(next(iter(square.values())))
    window = min(window, length)
    begins = range(0, length - window + 1, max(1, window // 4))
    rms = {name: np.sqrt([of[at : at + window].mean() for at in begins]) for name, of in square.items()}
    return {name: float((of - np.minimum.reduce([rms[x] for x in rms if x != name])).max()) for name, of in rms.items()}
