"""A shaft, its Hall sensors and its encoder by formula: captures whose every figure is known beforehand.

The sensors are half-turn windows (a from -60 to 120 deg, b 120 deg later, c 240 deg later), and edges are where their
level changes, found by solving for the time; nothing here comes from the code under test or from the simulated drive.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from bench.signal.capture import Capture
from protocol.codes import DriveState, StreamEvent
from protocol.signals import DRIVE_CHANNELS, Flag
from protocol.streams import EdgeChunk, SampleChunk, StreamConfig

TICK_HZ, PWM_HZ = 20_000_000, 16_000
PERIOD = TICK_HZ // PWM_HZ
RUNNING, IDLE = int(DriveState.RUNNING), int(DriveState.IDLE)
R_S, L_S, PSI = 0.158, 0.176e-3, 6.55e-3

Levels = tuple[int, int, int]


@dataclass(frozen=True)
class Motor:
    """What is to be recorded."""

    turns: Sequence[tuple[float, float]] = ((60.0, 2.0), (120.0, 1.5), (0.0, 0.05), (-60.0, 2.0), (-120.0, 1.5))
    """Electrical rad/s and s, one after the other."""
    delta_deg: Sequence[float] = (0.0,) * 6
    """Ideal minus actual angle of the edges that open sectors I to VI."""
    hysteresis_deg: float = 0.0
    jitter_deg: float = 0.0
    delay: float = 0.0
    """s by which edges are captured late."""
    rewire: Callable[[Levels], Levels] = lambda levels: levels
    encoder: Callable[[NDArray[np.float64]], NDArray[np.float64]] = lambda theta: theta
    """theta_enc by the angle of the rotor flux, rad, unwrapped."""
    late: float = 0.0
    """s by which the encoder shows where the rotor was."""
    pulses: Sequence[tuple[float, int]] = ()
    """False pulses of 3 us: when (s), and on which input (0..2)."""
    running: bool = True
    current: Callable[[NDArray[np.float64]], NDArray[np.float64]] = lambda t: np.full(len(t), 1.0)
    """q current in A by the time in s."""
    n_p: int = 6
    without: tuple[str, ...] = ()
    """Channels that are not recorded."""
    seed: int = 1
    parameters: dict[str, float] = field(default_factory=dict)

    def but(self, **changed: object) -> Motor:
        return replace(self, **changed)  # type: ignore[arg-type]


TABLE_I = (-1.2, -3.0, 7.2, -3.3, 0.6, 5.6)
"""deg, the sensors of Kim et al. 2011, which the simulated drive has too."""
REAL = Motor(delta_deg=TABLE_I, hysteresis_deg=0.5, jitter_deg=0.05)


def capture(motor: Motor) -> Capture:
    """Record it."""
    lasts = [round(seconds * PWM_HZ) for _, seconds in motor.turns]
    omega = np.concatenate([np.full(n, speed) for (speed, _), n in zip(motor.turns, lasts, strict=True)])
    theta = np.concatenate([[0.0], np.cumsum(omega)[:-1]]) / PWM_HZ + math.radians(30.0)
    ticks = np.arange(len(theta), dtype=np.int64) * PERIOD
    edge_tick, codes = _edges(motor, theta, omega)
    hall = codes[np.searchsorted(edge_tick, ticks, side="right")]
    channels = tuple(c for c in DRIVE_CHANNELS if c.name not in motor.without and not c.flags & Flag.TRUTH)
    config = StreamConfig(1, 0, 1, StreamEvent.PWM, 1, channels, 32, tick_hz=TICK_HZ, pwm_hz=PWM_HZ)
    values = _values(motor, ticks / TICK_HZ, theta, omega, hall)
    raw = np.zeros(len(theta), config.dtype)
    for channel in channels:
        if channel.name in values:
            raw[channel.name] = np.round(values[channel.name] / channel.scale)
    samples = SampleChunk(config, np.arange(len(theta), dtype=np.int64), ticks, raw, ())
    edges = StreamConfig(1, 1, 2, StreamEvent.EDGES, 1, (), 32, tick_hz=TICK_HZ, pwm_hz=PWM_HZ)
    n = len(edge_tick)
    chunk = EdgeChunk(
        edges, edge_tick, codes[:-1].astype(np.uint8), codes[1:].astype(np.uint8), np.zeros(n, np.bool_),
        np.zeros(n, np.uint16), np.arange(n, dtype=np.int64), (),
    )  # fmt: skip
    parameters = {"n_p": float(motor.n_p), "R_s_hat": R_S, "L_s_hat": L_S} | motor.parameters
    return Capture(samples, chunk, parameters)


def _wrapped(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    return (angle + math.pi) % (2 * math.pi) - math.pi


def _values(
    motor: Motor,
    t: NDArray[np.float64],
    theta: NDArray[np.float64],
    omega: NDArray[np.float64],
    hall: NDArray[np.int64],
) -> dict[str, NDArray[np.float64]]:
    i_q = motor.current(t)
    i = 1j * i_q * np.exp(1j * theta)
    half_ago = theta - 0.5 * omega / PWM_HZ  # the voltage is the mean of the period that ends at the sample
    u = ((R_S + 1j * omega * L_S) * 1j * i_q + 1j * omega * PSI) * np.exp(1j * half_ago)
    on = motor.running
    return {
        "hall": hall.astype(float),
        "status": np.full(len(t), float(RUNNING if on else IDLE)),
        "theta_enc": np.clip(_wrapped(motor.encoder(theta - motor.late * omega)), -math.pi, math.pi - 1e-4),
        "omega_enc": omega,
        "i_a": i.real,
        "i_b": (-i.real + math.sqrt(3.0) * i.imag) / 2.0,
        "i_d": 0.0 * i_q,
        "i_q": i_q,
        "u_alpha": u.real * on,
        "u_beta": u.imag * on,
    }


def _edges(
    motor: Motor, theta: NDArray[np.float64], omega: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Ticks of the edges, and the codes before the first, after the first and so on."""
    rng = np.random.default_rng(motor.seed)
    half = motor.hysteresis_deg / 2.0
    events: list[tuple[float, int]] = []  # ticks, and the sector entered (0..5) or 8 + input for a pulse's two edges
    degrees = np.degrees(theta)
    for edge in range(6):
        for way in (1.0, -1.0):
            place = 60.0 * edge - motor.delta_deg[edge] + way * half
            turn = np.floor((degrees - place) / 360.0)
            passed = np.flatnonzero(np.diff(turn) == way)
            for k in passed.tolist():
                where = (
                    place + 360.0 * (turn[k + 1] if way > 0 else turn[k]) + rng.normal(0.0, motor.jitter_deg or 1e-12)
                )
                t = k / PWM_HZ + (where - degrees[k]) / math.degrees(omega[k]) + motor.delay
                events.append((t * TICK_HZ, edge if way > 0 else (edge - 1) % 6))
    for t, number in motor.pulses:
        events += [(t * TICK_HZ, 8 + number), (t * TICK_HZ + 60.0, 8 + number)]
    events.sort()
    sector, inverted = 0, 0
    ticks, codes = [], [_code(motor, sector)]
    for tick, what in events:
        if what >= 8:
            inverted ^= 1 << (what - 8)
        else:
            sector = what
        code = _code(motor, sector) ^ inverted
        if code != codes[-1]:
            ticks.append(round(tick))
            codes.append(code)
    return np.array(ticks, np.int64), np.array(codes, np.int64)


def _code(motor: Motor, sector: int) -> int:
    middle = 60.0 * sector + 30.0
    a, b, c = (int((middle + 60.0 - 120.0 * sensor) % 360.0 < 180.0) for sensor in range(3))
    a, b, c = motor.rewire((a, b, c))
    return a + 2 * b + 4 * c
