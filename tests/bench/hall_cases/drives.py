"""Motors and drives that nothing is wrong with, drawn: ten motors, sensors as real ones are, encoders, resolutions.

Placement as measured on some sixteen real motors: a sensor 3.0 deg rms off (electrical, common part removed), an edge
3.4, 8.4 at most; the ends of magnets 0.85 to 1.36 deg. Rises up to 150 us late and falls up to 66 us, as far as the
highest speed of the recording makes at most `DELAY_ANGLE` of it.
"""

from __future__ import annotations

import math

import numpy as np

from tests.bench.hall_cases.recording import PAPER, Encoder, Motor, Recording, Sensors, Three
from tests.bench.hall_cases.shaft import Way, check, coast, hand

MOTORS = (
    Motor(1, 0.9, 0.9e-3, 40e-3, 0.3), Motor(2, 0.55, 0.6e-3, 15.4e-3, 0.4), Motor(3, 0.11, 0.15e-3, 9.6e-3, 0.8),
    Motor(4, 0.40, 0.52e-3, 5.5e-3, 0.5), Motor(5, 2.8, 2.4e-3, 8.3e-3, 0.2), PAPER,
    Motor(7, 0.15, 0.1e-3, 4.4e-3, 0.9), Motor(10, 0.28, 0.15e-3, 4.8e-3, 0.5), Motor(15, 0.15, 0.3e-3, 17e-3, 1.2),
    Motor(23, 0.12, 0.24e-3, 12e-3, 1.5),
)  # fmt: skip
LARGEST, DELAY_ANGLE = 8.4, 2.0
ELECTRICAL_HZ = {"slow": 24.0, "fast": 120.0}
"""Of the highest speed: 240 and 1200 r/min of six pole pairs."""


def top_rpm(motor: Motor, speed: str) -> float:
    return 60.0 * ELECTRICAL_HZ[speed] / motor.n_p


def drawn(rng: np.random.Generator, n_p: int, omega: float) -> Sensors:
    """Sensors of a motor that nothing is wrong with; `omega`: the highest speed, electrical deg/s."""
    off = rng.normal(0.0, 1.0, 3)
    off -= off.mean()
    off *= min(LARGEST, 2.4 * math.exp(rng.normal(0.0, 0.86))) / np.abs(off).max()  # 2.4 in the median, 7.2 at 90 %
    room = LARGEST - np.abs(off)
    apart = np.clip(rng.normal(0.0, 1.6, 3), -room, room)
    magnets = rng.normal(0.0, rng.uniform(0.85, 1.36), 2 * n_p)
    late = min(1.0, DELAY_ANGLE / (omega * 150e-6)) * rng.uniform(0.0, 1.0)
    if n_p == 1:
        magnets *= 0.0  # all there is of it is in `off` and `apart`
    rise, fall = (tuple(late * seconds * rng.uniform(0.8, 1.0, 3)) for seconds in (150e-6, 66e-6))
    return Sensors(
        float(rng.uniform(-180.0, 180.0)), _three(off), _three(apart), _three(rng.uniform(0.2, 2.0, 3)),
        _three(rng.uniform(0.05, 0.3, 3)), tuple(magnets.tolist()), 120.0, _three(rise), _three(fall),
    )  # fmt: skip


def _three(values: object) -> Three:
    a, b, c = np.asarray(values, float).tolist()
    return a, b, c


def around(rng: np.random.Generator, motor: Motor, way: Way, encoder: bool) -> Recording:
    """A drive that nothing is wrong with: what does not depend on its sensors; it does not tell where its ring is."""
    top = 6.0 * motor.n_p * way.top
    coarse = top < 3000.0 and rng.uniform() < 0.3
    hertz, pwm = ((20_000_000, 16_000), (1_000_000, 20_000))[int(rng.integers(2))]
    its = Encoder(int(rng.choice([500, 512, 1000, 1024, 2048, 2500, 4096])), float(rng.uniform(-2.0, 2.0)),
                  eccentric=float(rng.uniform(0.0, 0.5)))  # fmt: skip
    return Recording(
        motor, way, encoder=its if encoder else None, voltages=bool(rng.uniform() < 0.7), start=float(rng.uniform()),
        tick_hz=hertz, pwm_hz=pwm, decimation=int(rng.choice([4, 8] if coarse else [4])),
        seed=int(rng.integers(1 << 30)),
    )  # fmt: skip


def telling_ring(recording: Recording) -> Recording:
    """Its drive knows where the ring is: `hall_offset`, rad in [-pi, pi)."""
    ring = (math.radians(recording.sensors.ring) + math.pi) % math.tau - math.pi
    return recording.but(parameters=recording.parameters | {"hall_offset": ring})


def healthy(seed: int) -> Recording:
    """The drive of this number: any motor, its shaft turned as `bench hall check` does it, coasting or by hand."""
    rng = np.random.default_rng((38, seed))
    motor = MOTORS[seed % len(MOTORS)]
    top = top_rpm(motor, "slow") * float(np.exp(rng.uniform(math.log(0.7), math.log(5.0))))
    ripple = (float(rng.uniform(0.0, 0.003)), float(rng.uniform(0.0, 0.002)))
    kind = seed // len(MOTORS) % 5
    if kind < 3:
        way = check(top, motor.n_p)
    elif kind == 3:
        way = coast(top, float(rng.uniform(1.5, 4.0)))
    else:
        way = hand(float(rng.uniform(30.0, 90.0)), float(rng.uniform(2.0, 5.0)))
    way = Way(way.knots, way.powered, way.by_hand, ripple=ripple)
    recording = around(rng, motor, way, encoder=bool(rng.uniform() < 0.6))
    recording = recording.but(sensors=drawn(rng, motor.n_p, recording.omega))
    if recording.encoder and rng.uniform() < 0.1:
        recording = recording.encoding(indexed=False)
    if rng.uniform() < 0.2:
        recording = recording.but(resolution=float(rng.choice([1 / 5000, 1 / 16000, 1 / 30000])))
    return telling_ring(recording) if rng.uniform() < 0.4 else recording
