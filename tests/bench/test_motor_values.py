"""What a run says of R_s, L_s and psi_f, against the values that the simulated motor has; and what it must not say."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import count, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hall_motor import L_S, PSI, R_S
from virtual_run import RecordingScreen, WatchedLink, run, simulated

from bench.device.simulator import motors
from bench.findings.motor import MotorValues
from bench.live.summary import run_rows
from bench.record.reader import Run
from bench.signal.chunks import part
from protocol.messages import DriveState, StreamEvent
from protocol.signals import DRIVE_CHANNELS, LESSONS
from protocol.streams import SampleChunk, StreamConfig
from sim.config.params import load_params
from sim.config.unkind import unkind
from sim.drive.machine import Recorded
from sim.ports.device import SimulatedDevice
from tests.choice import sampled
from tests.sim.observers.lost import Case, bench_of, drawn, operated
from tests.sim.observers.proving import Proving

TRUE = {"R_s_hat": R_S, "L_s_hat": L_S, "psi_f_hat": PSI}
LIMITS = {"n_p": 6.0, "i_max": 8.0, "omega_m_max": 330.0}


@dataclass(frozen=True)
class Formula:
    """A motor on a shaft that is turned so, in electrical rad/s by s, with so much q current, A by s."""

    omega: tuple[tuple[float, float], ...] = ((0.0, 100.0), (0.5, 100.0), (1.0, 500.0), (2.0, 500.0), (3.0, -300.0))
    i_q: tuple[tuple[float, float], ...] = ((0.0, 6.0), (0.6, 6.0), (0.602, 1.0), (1.5, 1.0), (1.503, 7.0), (2.5, -4.0))
    encoder: float = 1.0
    """How fast theta_enc turns, by the rotor."""
    state: DriveState = DriveState.RUNNING
    without: tuple[str, ...] = ()

    def chunk(self) -> SampleChunk:
        hz = 16_000
        t = np.arange(3 * hz) / hz
        omega, i_q = (np.interp(t, *zip(*points, strict=True)) for points in (self.omega, self.i_q))
        theta = np.cumsum(omega) / hz
        i = 1j * i_q * np.exp(1j * theta)
        flux = L_S * i + PSI * np.exp(1j * theta)
        u = np.diff(flux, prepend=flux[0]) * hz + R_S * 0.5 * (i + np.roll(i, 1))
        streamed = tuple(channel for channel in DRIVE_CHANNELS if channel.name not in self.without)
        config = StreamConfig(1, 0, 1, StreamEvent.PWM, 1, streamed, 32, tick_hz=20_000_000, pwm_hz=hz)
        raw = np.zeros(len(t), config.dtype)
        columns = {
            "status": np.full(len(t), int(self.state)), "u_dc": np.full(len(t), 24.0), "omega_enc": omega,
            "theta_enc": np.angle(np.exp(1j * self.encoder * theta)) * 0.9999, "u_alpha": u.real, "u_beta": u.imag,
            "i_a": i.real, "i_b": (math.sqrt(3.0) * i.imag - i.real) / 2.0,
        }  # fmt: skip
        for channel in streamed:
            if channel.name in columns:
                raw[channel.name] = np.round(columns[channel.name] / channel.scale)
        index = np.arange(len(t), dtype=np.int64)
        return SampleChunk(config, index, 1250 * index, raw, ())


SEVERAL = Formula()
AT_REST = Formula(omega=((0.0, 0.0),), i_q=((0.0, 0.0),))


def of_formula(motor: Formula, parameters: Mapping[str, float]) -> MotorValues:
    whole = motor.chunk()
    values = MotorValues(whole.config, LIMITS | parameters)
    for k in range(0, len(whole), 3200):
        values.add(part(whole, k, min(k + 3200, len(whole))))
    return values


@pytest.mark.parametrize("wrong", [1.0, 0.5, 2.0])
def test_by_formula_each_value_is_found_whatever_the_drive_takes_it_for(wrong: float) -> None:
    found = of_formula(SEVERAL, {name: wrong * true for name, true in TRUE.items()}).values()
    for name, within in (("R_s_hat", 1.0), ("L_s_hat", 0.9), ("psi_f_hat", 0.3)):
        assert found[name].value == pytest.approx(TRUE[name], abs=3.0 * found[name].sd)
        assert 3.0 * found[name].sd < within * TRUE[name]


@pytest.mark.parametrize(("name", "factor", "words"), [
    ("psi_f_hat", math.sqrt(3.0), "psi_f_hat is 1.7 times what voltages and currents say: line to line against phase?"),
    ("psi_f_hat", 1.0 / math.sqrt(3.0), "psi_f_hat is 0.58 times what voltages and currents say: line to line"),
    ("psi_f_hat", math.sqrt(2.0), "psi_f_hat is 1.4 times what voltages and currents say: rms against peak?"),
    ("psi_f_hat", 6.0, "by the shaft's angle, not the electrical one?"),
    ("psi_f_hat", 60.0 / math.tau, "r/min against rad/s?"),
    ("psi_f_hat", 1.25, ""), ("psi_f_hat", 0.85, ""), ("R_s_hat", 1.4, ""), ("L_s_hat", 1.6, ""),
])  # fmt: skip
def test_a_known_mistake_is_named_by_its_factor(name: str, factor: float, words: str) -> None:
    said = list(of_formula(SEVERAL, TRUE | {name: factor * TRUE[name]}).findings())
    assert [words in finding.cause for finding in said] == ([True] if words else [])


def test_nothing_is_said_where_the_data_cannot_tell() -> None:
    """At rest, with the outputs off, at one working point, without a channel, and with an encoder that is another's."""
    doubled = {name: 2.0 * true for name, true in TRUE.items()}
    for motor in (
        AT_REST,
        replace(SEVERAL, state=DriveState.IDLE),
        replace(SEVERAL, encoder=0.8),
        replace(SEVERAL, without=("u_beta",)),
        replace(SEVERAL, without=("theta_enc",)),
    ):
        assert list(of_formula(motor, doubled).findings()) == []
    steady = replace(SEVERAL, omega=((0.0, 300.0),), i_q=((0.0, 3.0),))
    assert {finding.code for finding in of_formula(steady, doubled).findings()} <= {"flux_linkage"}


def test_without_an_encoder_what_the_drives_filter_has_learned_counts_by_its_uncertainty() -> None:
    for value, sd, doubts, said in (
        (R_S, 0.005, 0, True),
        (R_S, 0.03, 0, False),
        (-R_S, 0.005, 0, False),
        (R_S, 0.005, 0b1000000, False),
        (R_S, 0.005, 0b1000, False),
    ):
        chunk = replace(AT_REST, without=("theta_enc", "omega_enc")).chunk()
        rows = {"lesson_ek": LESSONS.index("R_s_hat"), "lesson_value_ek": value, "lesson_sigma_ek": sd}
        for channel, it in (rows | {"sensors_ek": doubts}).items():
            chunk.raw[channel] = it
        values = MotorValues(chunk.config, LIMITS | TRUE | {"R_s_hat": 2.0 * R_S})
        values.add(part(chunk, 0, 100))
        chunk.raw["sensors_ek"] = 0
        values.add(part(chunk, 100, 200))
        assert [finding.code for finding in values.findings()] == (["resistance"] if said else [])


def chunks(bench: Proving, runs: list[Recorded]) -> Iterator[SampleChunk]:
    """What the drive would have streamed, a fifth of a second at a time."""
    streamed = tuple(channel for channel in DRIVE_CHANNELS if channel.name in runs[0].samples.dtype.names)
    hz = bench.params.clock.pwm_hz
    config = StreamConfig(
        1, 0, 1, StreamEvent.PWM, 1, streamed, 32, tick_hz=hz * bench.params.clock.period_ticks, pwm_hz=hz
    )
    numbers = count()
    for recorded in runs:
        for k in range(0, len(recorded), hz // 5):
            raw = recorded.samples[k : k + hz // 5]
            index = np.fromiter(numbers, np.int64, len(raw))
            yield SampleChunk(config, index, index * bench.params.clock.period_ticks, raw, ())


def true_of(bench: Proving) -> dict[str, float]:
    motor = bench.params.motor
    return {"R_s_hat": motor.R_s, "L_s_hat": motor.L_q, "psi_f_hat": motor.psi_f}


def followed(case: Case, observer: str) -> tuple[Proving, MotorValues, set[str]]:
    """The bench, what its run said in the end, and which parameters were called wrong at any time."""
    bench = bench_of(case, observer)
    runs = operated(bench, case)
    values, called = None, set()
    for chunk in chunks(bench, runs):
        values = values or MotorValues(chunk.config, bench.parameters)
        values.add(chunk)
        called |= {finding.cause.partition(" ")[0] for finding in values.findings()}
    assert values is not None
    return bench, values, called


OBSERVERS = ("edge_kalman", "vector_tracking", "average_speed")


@pytest.mark.parametrize("seed", sampled("right motor values", range(3000, 4000), 12, campaign="motor-values"))
def test_a_parameter_that_is_right_within_a_fifth_is_never_called_wrong(seed: int) -> None:
    draw = np.random.default_rng(seed)
    factors = {name: float(np.exp(draw.uniform(-1.0, 1.0) * math.log(1.2))) for name in TRUE}
    factors["dead_time_hat"] = float(draw.uniform(0.0, 2.0))
    case = replace(drawn(seed), factors=factors)
    assert followed(case, str(draw.choice(OBSERVERS)))[2] == set(), case


@pytest.mark.parametrize("seed", sampled("wrong motor values", range(4000, 5000), 12, campaign="motor-values"))
def test_what_is_called_wrong_is_wrong_and_what_is_known_is_near_the_motors_own(seed: int) -> None:
    draw = np.random.default_rng(seed)
    by = {"R_s_hat": (0.5, 1.0, 2.0), "L_s_hat": (0.5, 1.0, 2.0), "psi_f_hat": (3**-0.5, 1.0, 3**0.5)}
    factors = {name: float(draw.choice(values)) for name, values in by.items()}
    factors["dead_time_hat"] = float(draw.uniform(0.0, 2.0))
    case = replace(drawn(seed), factors=factors)
    bench, values, called = followed(case, str(draw.choice(OBSERVERS)))
    assert all(factors[name] != 1.0 for name in called), (case, called)
    for name, told in values.told().items():
        assert told["wrong"] is None or told["value"] == pytest.approx(true_of(bench)[name], rel=0.5), (case, name)


FOUND = ("R_s_hat", 2.0, "hurst-dmb0224c10002"), ("L_s_hat", 2.0, "robodrive-ilm50x08"), ("psi_f_hat", 3**0.5, "")


@pytest.mark.parametrize(("name", "factor", "motor"), FOUND)
def test_it_is_said_within_seconds_marked_and_summed_up(name: str, factor: float, motor: str, tmp_path: Path) -> None:
    config = motors()[motor] if motor else None
    right = load_params(config)
    own = {"R_s_hat": right.motor.R_s, "L_s_hat": right.motor.L_q, "psi_f_hat": right.motor.psi_f}[name]
    device = simulated(config=config, **{f"firmware__{name}": factor * own})
    screen = RecordingScreen()
    rpm = right.firmware.omega_m_max * 60.0 / math.tau / 3.0
    path = tmp_path / "a.run"
    ended = run(
        WatchedLink(device), screen=screen, speed_rpm=rpm, load_a=0.3 * right.motor.i_max, duration=6.0, save=path
    )
    [said] = [note for note in screen.notes if note.startswith("motor, until ")]
    assert float(said.split()[2]) < 3.0
    [mark] = [mark for mark in Run(path).marks if mark.name.startswith(name)]
    assert mark.name in said
    told = ended.summary.motor[name]
    assert told["wrong"]
    assert told["parameter"] == pytest.approx(factor * own, rel=1e-3)
    assert told["value"] == pytest.approx(own, rel=0.2)
    assert [row for row in run_rows(ended.summary) if row[0] == f"{name} by the run"]
    assert ended.exit_code == 1
    assert mark.name in ended.summary.result
    assert "encoder" not in ended.summary.result


def test_of_a_motor_whose_parameters_are_right_nothing_is_said() -> None:
    screen = RecordingScreen()
    ended = run(WatchedLink(simulated()), screen=screen, speed_rpm=1000.0, load_a=4.0, duration=3.0)
    assert not [note for note in screen.notes if note.startswith("motor, until ")]
    assert ended.summary.motor["psi_f_hat"]["wrong"] is False
    assert ended.summary.motor["R_s_hat"]["wrong"] is None  # one speed, one current
    assert ["R_s_hat by the run", "this run cannot tell, in the drive 0.158"] in run_rows(ended.summary)
    assert ended.summary.result == "ok"


MOTORS = ("", *motors())
ODD: dict[str, dict[str, Any]] = {
    "encoder reversed": {"faults.encoder.reversed": 1},
    "encoder slips": {"faults.encoder.slip_deg": 40.0, "faults.encoder.slip_at": 2.0},
    "half of its lines": {"faults.encoder.pulses_hat": 1800},
    "encoder turned": {"encoder.offset_deg": 25.0},
    "encoder late": {"encoder.latency": 60e-6},
    "current gains": {"current_sensor.gain_error": [0.05, -0.05, 0.0]},
    "devices": {"inverter.u_device": 0.7},
    "no compensation": {"firmware.dead_time.dead_time_hat": 0.0},
    "harmonics": {"motor.emf_harmonics": [0.1, 0.05, 0.0, 0.0]},
    "wires exchanged": {"wiring.hall_swap": 1},
}
"""What is wrong, while the motor's parameters are right."""


@pytest.mark.parametrize(("what", "motor"), sampled("odd", product(ODD, MOTORS), 8, campaign="motor-values"))
def test_of_right_parameters_nothing_is_said_whatever_else_is_wrong(what: str, motor: str) -> None:
    config = motors()[motor] if motor else None
    right = load_params(config)
    screen = RecordingScreen()
    ended = run(
        WatchedLink(SimulatedDevice(load_params(config, {**unkind(right), **ODD[what]}), 1)),
        screen=screen, speed_rpm=right.firmware.omega_m_max * 60.0 / math.tau / 3.0, load_a=0.3 * right.motor.i_max,
        duration=6.0,
    )  # fmt: skip
    assert not [note for note in screen.notes if note.startswith("motor, until ")]
    assert not any(told["wrong"] for told in ended.summary.motor.values())
