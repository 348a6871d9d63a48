"""What docs/observers.md says in numbers: measured on the recordings, and computed by `theory` to stand beside it.

Errors are actual less estimated, in electrical degrees. Nothing is drawn or written here.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from observers import theory
from observers.recordings import EVENTS, FULL, LEARNING, LIGHT, LOADS, SPEEDS, STAGES, edges, in_the_loop

from bench.record.reader import Run
from bench.record.recording import readable
from bench.replay.estimators import Estimators
from bench.score.phases import phases_of, speed_of
from bench.signal.position import wrap
from bench.signal.units import RPM
from bench.signal.waveforms import thd_by_angle
from sim.config.params import load_params
from sim.native import layout
from sim.observers import sample
from sim.observers.catalogue import CATALOGUE

F64 = NDArray[np.float64]
ORDERS = 18
LUT_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
READ = cache(readable)


class Seen:
    """A recording with observers run on it; `changes` are parameters that differ from the drive's."""

    def __init__(self, path: Path, names: tuple[str, ...] = tuple(CATALOGUE), **changes: float) -> None:
        run: Run = READ(path)
        parameters = {**run.info.parameters, **changes}
        self.n_p = int(parameters["n_p"])
        self.rate = run.info.pwm_hz
        estimators = Estimators(names, parameters, run.samples.config)
        estimators.edges(run.edges)
        estimates = estimators.samples(run.samples)
        self.theta = run.samples.physical("theta_enc")
        self.omega = speed_of(self.theta, self.rate)
        self.phases = phases_of(self.omega, np.ones(len(self.theta), bool), self.rate, self.n_p)
        self.load = run.samples.physical("i_q_ref")
        self.rpm = self.omega / (RPM * self.n_p)
        self.t = np.arange(len(self.theta)) / self.rate
        self.errors: dict[str, F64] = {name: np.degrees(wrap(self.theta - e.theta)) for name, e in estimates.items()}

    def where(self, rpm: float, load: float | None = None) -> NDArray[np.int64]:
        """Samples of steady running at `rpm`, of one `load` or of all."""
        held = self.phases.steady & (np.abs(self.rpm - rpm) < 0.1 * abs(rpm))
        return np.flatnonzero(held if load is None else held & (np.abs(self.load - load) < 0.1))

    def whole(self, rpm: float, load: float | None = None) -> NDArray[np.int64]:
        """The last of them that make whole electrical turns at each load: a mean over them has no ripple in it."""
        if load is None:
            return np.concatenate([self.whole(rpm, one) for one in LOADS])
        at = self.where(rpm, load)
        turn = self.rate * 60.0 / (abs(rpm) * self.n_p)
        return at[-round(math.floor(len(at) / turn) * turn) :]


def figures(error: F64) -> dict[str, float]:
    """std, bias and max."""
    return {"std": float(error.std()), "bias": float(error.mean()), "max": float(np.abs(error).max())}


def scored(paths: Mapping[str, Path], folder: Path) -> dict[str, Any]:
    """What `bench score` says of the recordings: observers in the order of their rank, with the table's figures."""
    report = folder / "score.json"
    files = [str(paths[name]) for name in ("steady", *EVENTS)]
    command = [sys.executable, "-m", "bench", "score", *files, "--json", str(report)]
    subprocess.run(command, check=True, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    score = json.loads(report.read_text())
    by_file = {Path(file["path"]).stem: file["observers"] for file in score["files"]}
    board = {}
    for name, pooled in score["observers"].items():
        if pooled["kind"] != "host":
            continue
        steady = by_file["steady"][name]
        largest = {"start_up": "start_up", "reversal": "reversal"}
        board[name] = {
            "rms": pooled["moving"]["rms"],
            **{key: steady["error"][key] for key in ("std", "max", "bias")},
            "lag": steady["lag"]["angle_us"],
            **{event: by_file[event][name][largest.get(event, "transient")]["max"] for event in EVENTS},
            "ns": steady["step_ns"],
            "bytes": layout(CATALOGUE[name].kinds[1]).itemsize,
        }
    front = next(file["front_end_ns"] for file in score["files"] if Path(file["path"]).stem == "steady")
    return {"board": board, "front_ns": front, "front_bytes": layout(sample.State).itemsize}


def measured(paths: Mapping[str, Path], seen: Seen) -> dict[str, Any]:
    """All other numbers; `seen` is the steady recording."""
    table = tuple(key for key in READ(paths["steady"]).info.parameters if key.startswith("edge_"))
    nothing = dict.fromkeys(table, 0.0)
    half = seen.where(500, 4.0)
    shares = {}
    for share in LUT_SHARES:
        known = {key: share * READ(paths["steady"]).info.parameters[key] for key in table}
        shares[f"{share:g}"] = figures(Seen(paths["steady"], ("lookup_table",), **known).errors["lookup_table"][half])
    fresh = Seen(paths["steady"], ("lookup_table", "edge_kalman"), **nothing)
    before, after = learned(Seen(paths["learning"], ("edge_kalman",)))
    fixed = {str(rpm): _fixed(seen, rpm) for rpm in (50, 500)}
    return {
        "by_speed": {
            name: {str(rpm): figures(error[seen.whole(rpm)]) for rpm in SPEEDS} for name, error in seen.errors.items()
        },
        "by_load": {
            name: {f"{rpm}": {f"{load:g}": figures(error[seen.whole(rpm, load)]) for load in LOADS} for rpm in SPEEDS}
            for name, error in seen.errors.items()
        },
        "backwards": {name: figures(error[seen.whole(-500, 4.0)]) for name, error in seen.errors.items()},
        "fresh": {name: {str(rpm): figures(e[fresh.whole(rpm)]) for rpm in SPEEDS} for name, e in fresh.errors.items()},
        "shares": shares,
        "learning": {"seconds": LEARNING, "before": figures(before), "after": figures(after)},
        "fixed": fixed,
        "harmonics": {name: harmonics(seen, name) for name in ("hall_vector", "hall_vector_decoupled")},
        "theory": predicted(READ(paths["steady"]).info.parameters),
        "samples": len(seen.t),
    }


def _fixed(seen: Seen, rpm: int) -> dict[str, float]:
    at = seen.whole(rpm)
    return figures(seen.errors["vector_tracking"][at] - seen.errors["vector_tracking_q15"][at])


def harmonics(seen: Seen, name: str) -> dict[str, float]:
    """Amplitudes of the error's harmonics of an electrical turn at 500 r/min, by order."""
    at = seen.whole(500)
    error = seen.errors[name][at] - seen.errors[name][at].mean()
    return {str(n): float(2.0 * abs(np.mean(error * np.exp(-1j * n * seen.theta[at])))) for n in range(1, ORDERS + 1)}


def learned(seen: Seen) -> tuple[F64, F64]:
    """Error of the Kalman filter at 50 r/min and 4 A before 1000 r/min have taught it the edges, and after."""
    at = seen.where(50, 4.0)
    fastest = int(np.argmax(seen.rpm))
    error = seen.errors["edge_kalman"]
    return error[at[at < fastest]], error[at[at > fastest]]


def predicted(drive: Mapping[str, float]) -> dict[str, Any]:
    """What `theory` makes of the bench's own figures and the drive's parameters, by speed where it depends on it."""
    params = load_params(None, {})
    delta = [math.degrees(edges(params)[f"edge_up_{s}"]) for s in range(1, 7)]
    turn = theory.Turn(delta)
    count = 360.0 * params.motor.n_p / (4.0 * params.encoder.pulses_per_rev)
    rest = params.inverter.u_dc * params.inverter.dead_time * params.clock.pwm_hz
    rest *= 1.0 - drive["dead_time_comp"]
    k_p, k_i = drive["k_p_vt"], drive["k_i_vt"]
    motor = params.motor
    by_ampere = 1.5 * motor.n_p**2 * motor.psi_f / params.mechanics.J
    steps = {"speed": drive["alpha_m_max"] * motor.n_p, "4": LIGHT * by_ampere, "7": FULL * by_ampere}
    by_speed = {}
    for rpm in SPEEDS:
        omega = rpm * RPM * params.motor.n_p
        fed, ripple = turn.vector_tracking(omega, k_p, k_i, drive["tau_max"])
        dead = {
            f"{load:g}": theory.dead_time(omega, load, rest, params.inverter.i_smooth, params.motor.psi_f, k_p, k_i)
            for load in LOADS
        }
        by_speed[str(rpm)] = {
            "fed": figures(fed),
            "ripple": figures(ripple),
            "dead_time": {load: figures(error) for load, error in dead.items()},
            "vector_tracking": {load: math.hypot(ripple.std(), error.std()) for load, error in dead.items()},
            "hall_vector": figures(turn.hall_vector(omega, drive["bw_hall_vector"])),
            "hall_vector_decoupled": figures(turn.hall_vector(omega, drive["bw_hall_vector"], True)),
            "programmable_filter": figures(
                turn.programmable_filter(omega, drive["bw_omega_lpf"], 1.0 / params.clock.pwm_hz)
            ),
            "emf": params.motor.psi_f * omega,
        }
    return {
        "widths": [float(width) for width in turn.widths],
        "speed_bias": float(100.0 * (turn.speed.mean() - 1.0)),
        "speed_std": float(100.0 * turn.speed.std()),
        "average_speed": figures(turn.average_speed),
        "sector_centre": figures(turn.sector_centre),
        "lookup_table": theory.lookup_table(params.hall.jitter_deg, count),
        "after_acceleration": {key: theory.after_acceleration(a, 500 * RPM * motor.n_p) for key, a in steps.items()},
        "after_load_step": {key: theory.after_load_step(steps[key], drive["bw_hall_vector"]) for key in ("4", "7")},
        "load_angle": math.degrees(drive["k_ic"] * LOADS[-1] / (2.0 * math.pi * drive["bw_current"])),
        "count": count,
        "rest": rest,
        "by_speed": by_speed,
    }


def closed_loops() -> dict[str, Any]:
    """The drive with each angle source in its control loop: THD (20) of i_a in %, and the course of events."""
    found: dict[str, Any] = {}
    for source in ("encoder", *CATALOGUE):
        loop = in_the_loop(source)
        thd: dict[str, float | None] = {str(rpm): None for rpm in loop.tripped}
        thd |= {str(rpm): 100.0 * thd_by_angle(theta, i_a).value for rpm, (theta, i_a) in loop.currents.items()}
        words = [f"{stage}: {what}" for stage, what in zip(STAGES, loop.course, strict=False) if what]
        words += [f"{rpm} r/min: {what}" for rpm, what in loop.tripped.items()]
        found[source] = {"thd": thd, "words": words}
    return found
