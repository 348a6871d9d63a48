"""What a fault does to the simulated drive, from the plant's own state: `python -m tests.bench.accept.effects NAME …`.

Nothing of `bench` measures here. Each function makes a drive of some settings, lets it run, and gives one number; a
fault is proved by how much that number differs from the one of a healthy drive. Settings come as JSON by dotted key.
"""

from __future__ import annotations

import hashlib
import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.messages import SetpointMode
from protocol.signals import AngleSource
from sim.drive.channels import SOURCES
from sim.drive.machine import Recorded
from sim.observers.hall_speed import SECTOR_OF_CODE
from tests.sim.drive.rig import PWM_HZ, RPM, Rig

Settings = Mapping[str, Any]
Array = NDArray[np.float64]
T_S = 1.0 / PWM_HZ
TICK = 20e6  # Hz
R, L, PSI, N_P = 0.158, 0.176e-3, 6.55e-3, 6  # of the default motor
K_I = 2.0 * math.pi * 800.0 * R  # V/(A s), of the current loop
SMOOTH = 0.3  # A, inverter.i_smooth
SETTLED = 0.4  # s
ENCODER = int(AngleSource.ENCODER)


def wrapped(angle: Array) -> Array:
    """Within half a turn either way, rad."""
    return np.asarray(np.remainder(angle + math.pi, 2.0 * math.pi) - math.pi)


def turning(rpm: float, i_q: float = 4.0, i_d: float = 0.0, *, seconds: float = 0.5, **settings: Any) -> Recorded:
    """Speed forced by the load machine, currents by the drive on its encoder; all observers run."""
    rig = at_work({"firmware.observer": ENCODER, **settings})
    rig.load_setpoint(SetpointMode.SPEED, rpm * RPM)
    rig.setpoint(SetpointMode.CURRENT, i_q, i_d)
    rig.run(SETTLED)
    return rig.run(seconds)


def at_work(settings: Settings) -> Rig:
    """A drive and its load machine, both running, with every observer."""
    rig = Rig(**settings)
    rig.watch(frozenset(name for entry in SOURCES.values() for name in entry.channels))
    rig.start()
    return rig


def own_speed(rpm: float, load: float = 0.1, *, seconds: float = 0.5, **settings: Any) -> Recorded:
    """Speed by the drive's own loop, with its own observer, against a torque in N m."""
    rig = at_work(settings)
    rig.load_setpoint(SetpointMode.TORQUE, load)
    rig.setpoint(SetpointMode.SPEED, rpm * RPM)
    rig.run(0.3 + abs(rpm) / 3000.0)
    return rig.run(seconds)


def phases(alpha: Array, beta: Array) -> tuple[Array, Array, Array]:
    half = 0.5 * math.sqrt(3.0) * beta
    return alpha, -0.5 * alpha + half, -0.5 * alpha - half


def dq(run: Recorded) -> tuple[Array, Array]:
    """The true currents in the rotor's true frame, A."""
    alpha, beta, theta = run["i_alpha_true"], run["i_beta_true"], run["theta_true"]
    return alpha * np.cos(theta) + beta * np.sin(theta), beta * np.cos(theta) - alpha * np.sin(theta)


# -- sensors --------------------------------------------------------------------------------------------------------


def current_errors(settings: Settings) -> Iterator[tuple[Array, Array]]:
    """Reported and true current of each phase, A."""
    run = turning(1000.0, **settings)
    yield from zip((run["i_a"], run["i_b"], run["i_c"]), phases(run["i_alpha_true"], run["i_beta_true"]), strict=True)


def current_gain(settings: Settings) -> float:
    """Of phase a: reported over true."""
    reported, true = next(current_errors(settings))
    return float(np.polyfit(true, reported, 1)[0])


def current_gain_c(settings: Settings) -> float:
    """Of phase c."""
    *_, (reported, true) = current_errors(settings)
    return float(np.polyfit(true, reported, 1)[0])


def current_offset(settings: Settings) -> float:
    """Of phase a, A."""
    reported, true = next(current_errors(settings))
    return float(np.polyfit(true, reported, 1)[1])


def current_noise(settings: Settings) -> float:
    """Of phase a, A rms."""
    reported, true = next(current_errors(settings))
    return float(np.std(reported - true))


def current_error_q(settings: Settings) -> float:
    """Reported less true current along the true q axis, A."""
    run = turning(1000.0, **settings)
    alpha, beta, theta = run["i_a"], (run["i_b"] - run["i_c"]) / math.sqrt(3.0), run["theta_true"]
    return float(np.mean(beta * np.cos(theta) - alpha * np.sin(theta) - dq(run)[1]))


def edges(run: Recorded) -> tuple[NDArray[np.int64], Array, NDArray[np.int64]]:
    """Of the edges that open a sector going forward: its number 0..5, how late the rotor's angle is (deg), the turn."""
    at = (run.edge_tick - run.tick) / (TICK / PWM_HZ)
    inside = (at > 1.0) & (at < run.n - 1.0)
    theta = np.interp(at[inside], np.arange(run.n), run["theta_true"])
    sector = np.array(SECTOR_OF_CODE)[run.captured["code"][inside] & 7]
    legal = sector >= 0
    late = wrapped(theta[legal] - sector[legal] * math.pi / 3.0)
    near = np.abs(late) < math.radians(25.0)
    turn = np.floor((theta[legal][near] - sector[legal][near] * math.pi / 3.0 + 1.0) / (2.0 * math.pi)).astype(int)
    return sector[legal][near], np.degrees(late[near]), turn


def edges_late(settings: Settings) -> float:
    """All edges, deg of the rotor at 1000 r/min."""
    return float(np.mean(edges(turning(1000.0, **settings))[1]))


def edge_I_late(settings: Settings) -> float:
    """The edge that opens sector I, deg; there sensor c falls."""
    sector, late, _ = edges(turning(1000.0, **settings))
    return float(np.mean(late[sector == 0]))


def edge_jitter(settings: Settings) -> float:
    """Deg rms about the mean of each edge."""
    sector, late, _ = edges(turning(1000.0, **settings))
    return float(np.sqrt(np.mean([np.var(late[sector == s]) for s in range(6)])))


def edge_spread(settings: Settings) -> float:
    """From pole pair to pole pair, largest less smallest, deg."""
    sector, late, turn = edges(turning(1000.0, **settings))
    pair = turn % N_P
    means = np.array([[np.mean(late[(sector == s) & (pair == p)]) for p in range(N_P)] for s in range(6)])
    return float(np.mean(np.ptp(means, axis=1)))


def edges_per_second(settings: Settings) -> float:
    """Of the inputs, at 1000 r/min."""
    run = turning(1000.0, seconds=2.0, **settings)
    return len(run.edge_tick) / (run.n * T_S)


def wrong_codes(settings: Settings) -> float:
    """Share of the samples whose Hall code is not that of the rotor's sector or its neighbours'."""
    run = turning(300.0, 0.0, seconds=8.0, **settings)
    middle = np.array(SECTOR_OF_CODE)[run["hall"].astype(int) & 7] * math.pi / 3.0 + math.pi / 6.0
    off = np.abs(wrapped(run["theta_true"] - middle)) > math.radians(42.0)
    return float(np.mean(off | ~np.isin(run["hall"].astype(int), (1, 2, 3, 4, 5, 6))))


def encoder_error(settings: Settings) -> float:
    """Deg, electrical, mean at a speed that is no multiple of the encoder's counts."""
    run = turning(1013.0, seconds=0.6, **settings)
    return float(np.degrees(np.mean(wrapped(run["theta_enc"] - run["theta_true"]))))


def encoder_once_a_turn(settings: Settings) -> float:
    """Amplitude of its error once a turn of the shaft, deg electrical."""
    run = turning(1000.0, seconds=0.6, **settings)
    error, shaft = wrapped(run["theta_enc"] - run["theta_true"]), run["theta_true"] / N_P
    return float(np.degrees(2.0 * abs(np.mean(error * np.exp(1j * shaft)))))


def encoder_drift(settings: Settings) -> float:
    """Counts that it loses in a turn of the shaft."""
    run = turning(1000.0, 0.0, seconds=2.0, **settings)
    error, shaft = np.unwrap(run["theta_enc"] - run["theta_true"]), run["theta_true"] / N_P
    return float(np.polyfit(shaft, error, 1)[0] * 4.0 * 3600.0 / N_P)


# -- motor, inverter, shaft -----------------------------------------------------------------------------------------


def torque_per_ampere(settings: Settings) -> float:
    """N m/A of true q current."""
    run = turning(500.0, **settings)
    return float(np.mean(run["tau_e_true"]) / np.mean(dq(run)[1]))


def torque_ripple(settings: Settings) -> float:
    """Amplitude of the sixth harmonic over the mean."""
    run = turning(100.0, seconds=1.0, **settings)
    tau = run["tau_e_true"]
    return float(2.0 * abs(np.mean(tau * np.exp(6j * run["theta_true"]))) / np.mean(tau))


def resistance(settings: Settings) -> float:
    """Ohm, with a direct current in a motor that is held."""
    run = turning(0.0, 0.0, 6.0, **settings)
    return float(np.mean(np.hypot(run["u_alpha"], run["u_beta"])) / np.mean(np.hypot(*dq(run))))


def inductance(settings: Settings) -> float:
    """H, by what a step of the d current in a motor that is held takes of volt seconds."""
    rig = at_work({"firmware.observer": ENCODER, "mechanics.theta_0_deg": 0.0, **settings})
    rig.load_setpoint(SetpointMode.SPEED, 0.0)
    rig.setpoint(SetpointMode.CURRENT, 0.0, 2.0)
    before = rig.run(0.1)
    rig.setpoint(SetpointMode.CURRENT, 0.0, 6.0)
    run = rig.run(0.003)
    u, i = run["u_alpha"], run["i_alpha_true"]
    rest = np.polyfit(
        [np.mean(before["i_alpha_true"][-500:]), i[-1]], [np.mean(before["u_alpha"][-500:]), np.mean(u[-8:])], 1
    )
    taken = np.sum(u - np.polyval(rest, i)) * T_S
    return float(taken / (i[-1] - before["i_alpha_true"][-1]))


def friction(settings: Settings) -> float:
    """N m at 1000 r/min without a load, by the motor's true torque."""
    return float(np.mean(own_speed(1000.0, 0.0, **settings)["tau_e_true"]))


def inertia(settings: Settings) -> float:
    """kg m2, by torque and acceleration from rest."""
    rig = at_work({"firmware.observer": ENCODER, **settings})
    rig.setpoint(SetpointMode.CURRENT, 4.0, 0.0)
    run = rig.run(0.1)
    late = slice(400, None)
    alpha = np.polyfit(np.arange(run.n)[late] * T_S, run["omega_m"][late], 1)[0]
    return float((np.mean(run["tau_e_true"][late]) - 5e-3) / alpha)


def lost_volts(settings: Settings) -> tuple[float, float]:
    """What a leg with positive and with negative current loses of its reference voltage, V."""
    run = turning(200.0, 5.0, **settings)
    i = [run["i_alpha_true"], run["i_beta_true"]]
    theta, omega = run["theta_true"], run["omega_true"]
    emf = [-omega * PSI * np.sin(theta), omega * PSI * np.cos(theta)]
    mean = [0.5 * (x[1:] + x[:-1]) for x in i]
    took = [R * m + L * np.diff(x) / T_S + 0.5 * (e[1:] + e[:-1]) for m, x, e in zip(mean, i, emf, strict=True)]
    rest = phases(run["u_alpha"][1:] - took[0], run["u_beta"][1:] - took[1])
    shape = [np.clip(x / SMOOTH, -1.0, 1.0) for x in phases(mean[0], mean[1])]
    up, down = ([pick(x, 0.0) for x in shape] for pick in (np.maximum, np.minimum))
    columns = np.array([np.concatenate([x - sum(sort) / 3.0 for x in sort]) for sort in (up, down)]).T
    found = np.linalg.lstsq(columns, np.concatenate(rest), rcond=None)[0]
    return float(found[0]), float(found[1])


def lost_by_all(settings: Settings) -> float:
    """V, mean of both signs."""
    return sum(lost_volts(settings)) / 2.0


def lost_when_negative(settings: Settings) -> float:
    """V, with negative current more than with positive."""
    up, down = lost_volts(settings)
    return down - up


def link_voltage(settings: Settings) -> float:
    """V, by the drive's telemetry."""
    return float(np.mean(turning(500.0, 0.0, **settings)["u_dc"]))


# -- control --------------------------------------------------------------------------------------------------------


def control_angle(settings: Settings) -> float:
    """The angle by which the control turns the currents, less the rotor's true one, deg, at 1500 r/min."""
    run = own_speed(1500.0, 0.2, **settings)
    i_d, i_q = dq(run)
    return float(np.degrees(np.mean(wrapped(np.arctan2(i_q, i_d) - np.arctan2(run["i_q"], run["i_d"])))))


def true_speed(settings: Settings) -> float:
    """Over what was asked for, at 1000 r/min."""
    return float(np.mean(own_speed(1000.0, **settings)["omega_m"]) / (1000.0 * RPM))


def true_current(settings: Settings) -> float:
    """q current over what was asked for."""
    return float(np.mean(dq(turning(500.0, 4.0, **settings))[1]) / 4.0)


def true_d_current(settings: Settings) -> float:
    """A, while the drive holds a speed on its encoder."""
    return float(np.mean(dq(own_speed(1000.0, **{"firmware.observer": ENCODER, **settings}))[0]))


def largest_current(settings: Settings) -> float:
    """True q current of a drive whose speed the load machine keeps from rising, A."""
    rig = at_work({"firmware.observer": ENCODER, **settings})
    rig.load_setpoint(SetpointMode.SPEED, 500.0 * RPM)
    rig.setpoint(SetpointMode.SPEED, 1500.0 * RPM)
    rig.run(0.5)
    return float(np.mean(dq(rig.run(0.2))[1]))


def acceleration(settings: Settings) -> float:
    """rad/s2 from 30 to 150 rad/s on the encoder."""
    rig = at_work({"firmware.observer": ENCODER, **settings})
    rig.setpoint(SetpointMode.SPEED, 200.0)
    run = rig.run(0.4)
    inside = (run["omega_m"] > 30.0) & (run["omega_m"] < 150.0)
    return float(np.polyfit(np.flatnonzero(inside) * T_S, run["omega_m"][inside], 1)[0])


def step_of_current(rpm: float, settings: Settings, times: int = 8) -> tuple[Array, Array]:
    """True d and q current after steps of the q current from 0 to 4 A, each 5 ms, averaged; A."""
    rig = at_work({"firmware.observer": ENCODER, **settings})
    rig.load_setpoint(SetpointMode.SPEED, rpm * RPM)
    rig.run(SETTLED)
    found = []
    for k in range(times):
        rig.setpoint(SetpointMode.CURRENT, 0.0, 0.0)
        rig.run(0.02 + 0.0011 * k)
        rig.setpoint(SetpointMode.CURRENT, 4.0, 0.0)
        found.append(dq(rig.run(0.02)))
    mean = np.mean(found, axis=0)
    return mean[0], mean[1]


def rise_time(settings: Settings) -> float:
    """s until half a step of the current, at 300 r/min."""
    _, i_q = step_of_current(300.0, settings)
    k = int(np.argmax(i_q > 2.0))
    return float((k - 1 + (2.0 - i_q[k - 1]) / (i_q[k] - i_q[k - 1])) * T_S)


def q_error_area(settings: Settings) -> float:
    """A s, of the q current's error in a step at 300 r/min."""
    _, i_q = step_of_current(300.0, settings)
    return float(np.sum(4.0 - i_q) * T_S)


def d_error_area(settings: Settings) -> float:
    """A s, of the d current in a step of the q current at 2000 r/min."""
    i_d, _ = step_of_current(2000.0, settings)
    return float(np.sum(i_d) * T_S)


def sped_up(settings: Settings) -> tuple[float, float]:
    """A s of true d and q current less 2 A while the load machine goes from 500 to 2000 r/min."""
    rig = at_work({"firmware.observer": ENCODER, **settings})
    rig.load_setpoint(SetpointMode.SPEED, 500.0 * RPM)
    rig.setpoint(SetpointMode.CURRENT, 2.0, 0.0)
    rig.run(SETTLED)
    rest = [np.mean(x) for x in dq(rig.run(0.1))]
    rig.load_setpoint(SetpointMode.SPEED, 2000.0 * RPM)
    i_d, i_q = dq(rig.run(0.2))
    return float(np.sum(i_d - rest[0]) * T_S), float(np.sum(i_q - rest[1]) * T_S)


def d_area_speeding(settings: Settings) -> float:
    """A s."""
    return sped_up(settings)[0]


def q_area_speeding(settings: Settings) -> float:
    """A s."""
    return sped_up(settings)[1]


def beyond_the_voltage(settings: Settings) -> tuple[Recorded, Recorded]:
    """More speed than the voltage allows, and the 0.1 s after it has gone."""
    rig = at_work({"firmware.observer": ENCODER, **settings})
    rig.load_setpoint(SetpointMode.SPEED, 345.0)
    rig.setpoint(SetpointMode.CURRENT, 6.0, 0.0)
    high = rig.run(0.5)
    rig.load_setpoint(SetpointMode.SPEED, 250.0)
    return high, rig.run(0.1)


def largest_voltage(settings: Settings) -> float:
    """Reference voltage over the link's at the limit."""
    run, _ = beyond_the_voltage(settings)
    return float(np.mean(np.hypot(run["u_alpha"], run["u_beta"])[-2000:] / run["u_dc"][-2000:]))


def current_after_the_limit(settings: Settings) -> float:
    """The largest true current after the limit, A."""
    return float(np.max(np.hypot(*dq(beyond_the_voltage(settings)[1]))))


def speed_step(settings: Settings) -> Recorded:
    """From 500 to 1000 r/min on the encoder, without a ramp that matters."""
    rig = at_work({"firmware.observer": ENCODER, "firmware.alpha_m_max": 20000.0, **settings})
    rig.setpoint(SetpointMode.SPEED, 500.0 * RPM)
    rig.run(0.5)
    rig.setpoint(SetpointMode.SPEED, 1000.0 * RPM)
    return rig.run(0.5)


def overshoot(settings: Settings) -> float:
    """Of the true speed in it, r/min."""
    return float((np.max(speed_step(settings)["omega_m"]) / RPM) - 1000.0)


def gives_way(settings: Settings) -> tuple[float, float]:
    """What 0.2 N m do to a drive at 1000 r/min on its encoder: the largest fall of speed, rad/s, and its area, rad."""
    rig = at_work({"firmware.observer": ENCODER, **settings})
    rig.setpoint(SetpointMode.SPEED, 1000.0 * RPM)
    rig.run(0.8)
    rest = np.mean(rig.run(0.2)["omega_m"])
    rig.load_setpoint(SetpointMode.TORQUE, 0.2)
    run = rig.run(1.0)
    return float(rest - np.min(run["omega_m"])), float(np.sum(rest - run["omega_m"]) * T_S)


def speed_dip(settings: Settings) -> float:
    """rad/s."""
    return gives_way(settings)[0]


def speed_dip_area(settings: Settings) -> float:
    """rad; the integral of the error that holds the load's torque."""
    return gives_way(settings)[1]


# -- observers ------------------------------------------------------------------------------------------------------


def estimate(channel: str, rpm: float) -> Callable[[Settings], float]:
    """The mean error of an observer's angle, deg, at a speed that the load machine forces."""

    def measured(settings: Settings) -> float:
        run = turning(rpm, seconds=1.0, **settings)
        return float(np.degrees(np.mean(wrapped(run[f"theta_{channel}"] - run["theta_true"]))))

    return measured


def ripple(channel: str, rpm: float) -> Callable[[Settings], float]:
    """The standard deviation of it, deg."""

    def measured(settings: Settings) -> float:
        run = turning(rpm, seconds=1.0, **settings)
        return float(np.degrees(np.std(wrapped(run[f"theta_{channel}"] - run["theta_true"]))))

    return measured


def average_speed(settings: Settings) -> float:
    """omega_avg over the true speed."""
    run = turning(1000.0, seconds=1.0, **settings)
    return float(np.mean(run["omega_avg"]) / np.mean(run["omega_true"]))


def vt_with_d_current(settings: Settings) -> float:
    """Size of the vector-tracking observer's error with 4 A along d at 500 r/min, deg."""
    run = turning(500.0, 0.0, 4.0, seconds=1.0, **settings)
    return float(np.degrees(np.mean(wrapped(run["theta_vt"] - run["theta_true"]))))


def response(hz: float) -> Callable[[Settings], float]:
    """Real part of the vector-tracking observer's answer to a sine added to theta*, at 1000 r/min."""

    def measured(settings: Settings) -> float:
        sine = {"inject": 1, "inject_amplitude": 0.2, "inject_hz": hz}
        own = {f"firmware.injection.{name}": value for name, value in sine.items()}
        run = turning(1000.0, 2.0, seconds=2.0, **own, **settings)
        begins = np.flatnonzero(run["sync"])
        window = slice(begins[0], begins[-1])
        error = wrapped(run["theta_vt"] - run["theta_true"])[window]
        phase = 2.0 * math.pi * hz * T_S * np.arange(len(error))
        return float(2.0 * np.mean(error * np.sin(phase)) / 0.2)

    return measured


def speed_lag(settings: Settings) -> float:
    """True less estimated speed of the vector-tracking observer at a constant acceleration, electrical rad/s."""
    rig = at_work({"firmware.observer": ENCODER, "load.alpha_m_max": 1000.0, **settings})
    rig.load_setpoint(SetpointMode.SPEED, 50.0)
    rig.setpoint(SetpointMode.CURRENT, 2.0, 0.0)
    rig.run(SETTLED)
    rig.load_setpoint(SetpointMode.SPEED, 300.0)
    run = rig.run(0.24)
    late = slice(1600, 3600)
    return float(np.mean((run["omega_true"] - run["omega_vt"])[late]))


def correction_from(settings: Settings) -> float:
    """Electrical speed, rad/s, at which the vector-tracking observer's correction begins."""
    rig = at_work({"firmware.observer": ENCODER, "load.alpha_m_max": 4.0, **settings})
    rig.load_setpoint(SetpointMode.SPEED, 15.0)
    rig.setpoint(SetpointMode.CURRENT, 2.0, 0.0)
    run = rig.run(4.0)
    return float(run["omega_true"][np.argmax(run["on"] == 1)])


def with_load_angle(settings: Settings) -> float:
    """The vector-tracking observer's error with the load angle that it finds after a step of the current, deg."""
    own = {"load_angle_comp": 1, "k_pc": 0.0, "k_ic": 200.0}
    rig = at_work(
        {"firmware.observer": ENCODER, **{f"firmware.vector_tracking.{k}": v for k, v in own.items()}, **settings}
    )
    rig.load_setpoint(SetpointMode.SPEED, 1000.0 * RPM)
    rig.run(SETTLED)
    rig.setpoint(SetpointMode.CURRENT, 4.0, 0.0)
    rig.run(0.1)
    run = rig.run(0.2)
    error = np.degrees(np.mean(wrapped(run["theta_vt"] - run["theta_true"])))
    return float(error / np.degrees(np.mean(run["delta_hat"])))


def learned_dead_time(settings: Settings) -> float:
    """What a leg still loses once a drive has learned for 3 s, V; it was told half the dead time."""
    own = {"dead_time_learn": 1, "dead_time_comp": 0.5}
    rig = at_work({"firmware.observer": ENCODER, **{f"firmware.dead_time.{k}": v for k, v in own.items()}, **settings})
    rig.load_setpoint(SetpointMode.SPEED, 300.0 * RPM)
    rig.setpoint(SetpointMode.CURRENT, 3.0, 0.0)
    rig.run(3.0)
    run = rig.run(0.1)
    return float(np.std(dq(run)[0]))


def kalman_believes(settings: Settings) -> float:
    """Share of half a second, at 500 r/min, in which the Kalman filter believes a sensor whose wire is broken."""
    rig = at_work({"firmware.observer": ENCODER, **settings})
    rig.load_setpoint(SetpointMode.SPEED, 500.0 * RPM)
    rig.setpoint(SetpointMode.CURRENT, 0.0, 0.0)
    rig.run(SETTLED)
    rig.set_load_param("hall_open", 1.0)
    return float(np.mean(rig.run(0.5)["sensors_ek"].astype(int) & 1 == 0))


# -- protection -----------------------------------------------------------------------------------------------------


def trips(rig: Rig, seconds: float, step: Callable[[float], None] = lambda t: None) -> float:
    """s until a fault, and the time given if there is none."""
    n = round(seconds / 0.5e-3)
    for k in range(n):
        step(k / n)
        rig.advance(8)
        if rig.faults:
            return (k + 1) * 0.5e-3
    return seconds


def current_at_trip(settings: Settings) -> float:
    """A, true, with a threshold of 4 A."""
    rig = at_work({"firmware.observer": ENCODER, "firmware.protection.i_trip": 4.0, **settings})
    rig.load_setpoint(SetpointMode.SPEED, 0.0)
    seen = [0.0]

    def step(share: float) -> None:
        seen[0] = math.hypot(rig.truth.i_d, rig.truth.i_q)
        rig.setpoint(SetpointMode.CURRENT, 0.0, 8.0 * share)

    trips(rig, 2.0, step)
    return seen[0]


def speed_at_trip(settings: Settings) -> float:
    """Mechanical rad/s, with a threshold of 200."""
    own = {"firmware.observer": ENCODER, "firmware.protection.omega_m_trip": 200.0, "load.alpha_m_max": 400.0}
    rig = at_work({**own, **settings})
    rig.load_setpoint(SetpointMode.SPEED, 350.0)
    rig.setpoint(SetpointMode.CURRENT, 0.0, 0.0)
    trips(rig, 1.2)
    return rig.truth.omega_m


def threshold_that_trips(name: str, toward: float) -> Callable[[Settings], float]:
    """The threshold of a voltage at which a drive on 24 V trips, coming from `toward`, V."""

    def measured(settings: Settings) -> float:
        rig = at_work({"firmware.observer": ENCODER, **settings})
        at = [toward]

        def step(share: float) -> None:
            at[0] = toward + (48.0 - 2.0 * toward) * share
            rig.set_param(name, at[0])

        trips(rig, 0.4, step)
        return at[0]

    return measured


def turns_to_trip(fault: str, number: float) -> Callable[[Settings], float]:
    """Electrical turns with the wires so until the drive trips; 60 if it does not."""

    def measured(settings: Settings) -> float:
        rig = at_work({"firmware.observer": ENCODER, **settings})
        rig.load_setpoint(SetpointMode.SPEED, 1000.0 * RPM)
        rig.setpoint(SetpointMode.CURRENT, 1.0, 0.0)
        rig.run(SETTLED)
        before = rig.truth.theta_e
        rig.set_load_param(fault, number)
        trips(rig, 0.6)
        return float((rig.truth.theta_e - before) / (2.0 * math.pi))

    return measured


# -- all of it ------------------------------------------------------------------------------------------------------


def recorded(settings: Settings) -> float:
    """A number of all that a fixed short run records: start, load, load angle, reversal, currents, two trips."""
    rig = at_work(settings)
    digest = hashlib.sha256()

    def go_on(seconds: float) -> None:
        run = rig.run(seconds)
        digest.update(run.block.tobytes() + run.captured.tobytes() + bytes([int(rig.faults) & 255]))

    rig.setpoint(SetpointMode.SPEED, 100.0)
    go_on(0.4)
    rig.load_setpoint(SetpointMode.TORQUE, 0.2)
    go_on(0.2)
    rig.set_param("k_pc", 0.01)
    rig.set_param("load_angle_comp", 1.0)
    go_on(0.2)
    rig.setpoint(SetpointMode.SPEED, -250.0)
    go_on(0.6)
    for source in (AngleSource.AVERAGE_SPEED, AngleSource.EDGE_KALMAN):
        rig.set_param("observer", float(source))
        go_on(0.2)
    rig.load_setpoint(SetpointMode.SPEED, 345.0)
    rig.setpoint(SetpointMode.CURRENT, 6.0, 0.0)
    go_on(0.5)
    rig.load_setpoint(SetpointMode.SPEED, 2.0)
    go_on(0.5)
    for name, value in (("hall_open", 1.0), ("hall_open", 0.0)):
        rig.load_setpoint(SetpointMode.SPEED, 50.0)
        rig.set_load_param(name, value)
        go_on(0.3)
    return float(int.from_bytes(digest.digest()[:6], "big"))


# -- shared ---------------------------------------------------------------------------------------------------------

EFFECTS: dict[str, Callable[[Settings], float]] = {
    name: made
    for name, made in globals().items()
    if callable(made) and getattr(made, "__annotations__", {}) == {"settings": "Settings", "return": "float"}
} | {
    "avg_error": estimate("avg", 1000.0), "vt_error": estimate("vt", 1500.0), "vt_error_fast": estimate("vt", 2500.0),
    "vt_error_back": estimate("vt", -1000.0), "ek_error": estimate("ek", 1000.0), "sc_error": estimate("sc", 1000.0),
    "lut_error": estimate("lut", 1000.0), "hv_error": estimate("hv", 1000.0), "hvd_error": estimate("hvd", 1000.0),
    "plf_error": estimate("plf", 1000.0), "q15_error": estimate("q15", 1000.0), "hvd_ripple": ripple("hvd", 150.0),
    "answer_200_hz": response(200.0), "answer_10_hz": response(10.0),
    "over_voltage": threshold_that_trips("u_dc_max", 32.0), "under_voltage": threshold_that_trips("u_dc_min", 16.0),
    "turns_open": turns_to_trip("hall_open", 1.0), "turns_exchanged": turns_to_trip("hall_swap", 1.0),
}  # fmt: skip
"""By name."""


def main() -> None:
    """Print the numbers that were asked for, a line each: NAME SETTINGS, with settings as JSON."""
    for name, settings in zip(sys.argv[1::2], sys.argv[2::2], strict=True):
        print(json.dumps(EFFECTS[name](json.loads(settings))), flush=True)


if __name__ == "__main__":
    main()
