"""The incremental encoder: counts within a turn of the shaft, and the speed by a tracking filter on them.

Four counts a line; the index pulse sets the counter to zero once a turn, so the count is an absolute angle. A
misaligned zero adds `offset` to the angle that the firmware reads. A disc that sits off its centre adds a sine with a
period a turn, and marks that are not evenly read one with a period a line, which makes counts of unequal width. One
that is late (a filter, a serial interface) shows the angle that was `latency` ago, at the speed of now.

Never interpolates between counts.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sim.numba_cache import kernel

TWO_PI = 2.0 * math.pi


class Params(NamedTuple):
    """The encoder's constants, and those of the filter on it."""

    counts: int  # a turn
    counts_per_rad: float  # counts an electrical radian
    offset: float  # electrical rad
    rad_per_count: float  # electrical, as the firmware takes it
    a_position: float  # filter gains: share of the error, and
    a_speed: float  # counts/s a count of error
    T_s: float
    turns_per_rad: float  # 2 pi turns an electrical radian
    eccentric: float  # counts, amplitude with a period a turn
    within: float  # counts, amplitude with a period of four counts
    latency: float  # s, short beside what the speed takes to change


class State(NamedTuple):
    """The tracking filter."""

    position: float  # counts within a turn, predicted for the next sample
    speed: float  # counts/s


def make_params(
    pulses_per_rev: int,
    offset_deg: float,
    bw_speed: float,
    n_p: float,
    n_p_hat: float,
    T_s: float,
    eccentricity_deg: float = 0.0,
    unevenness: float = 0.0,
) -> Params:
    """Constants from lines a turn, electrical degrees, the filter's natural frequency in Hz, pole pairs, s.

    `eccentricity_deg`: amplitude in mechanical degrees; `unevenness`: in counts, below 0.6, so that none goes back.
    `n_p`: of the motor, by which `count` goes; `n_p_hat`: those by which the firmware makes angle and speed electrical.

    The filter is the critically damped alpha-beta filter: both poles at exp(-2 pi bw_speed T_s). It lags no
    constant speed, and an acceleration by 2 / (2 pi bw_speed) seconds.
    """
    counts = 4 * int(pulses_per_rev)
    pole = math.exp(-TWO_PI * bw_speed * T_s)
    return Params(
        counts,
        counts / (TWO_PI * n_p),
        math.radians(offset_deg),
        TWO_PI * n_p_hat / counts,
        1.0 - pole * pole,
        (1.0 - pole) ** 2 / T_s,
        float(T_s),
        1.0 / n_p,
        eccentricity_deg / 360.0 * counts,
        float(unevenness),
        0.0,
    )


@kernel
def count(params: Params, theta_e: float, omega_e: float) -> int:
    """The counter, 0..counts-1, at an unwrapped electrical angle (rad) and a speed (rad/s)."""
    seen = theta_e - params.latency * omega_e + params.offset
    counts = seen * params.counts_per_rad
    if params.eccentric != 0.0 or params.within != 0.0:
        counts += params.eccentric * math.sin(seen * params.turns_per_rad)
        counts += params.within * math.sin(0.5 * math.pi * counts)
    return math.floor(counts) % params.counts


@kernel
def angle(params: Params, counter: int) -> float:
    """The electrical angle (rad, not wrapped) of the middle of a count."""
    return (counter + 0.5) * params.rad_per_count


@kernel
def init(counter: int) -> State:
    """The filter at rest."""
    return State(float(counter), 0.0)


@kernel
def track(params: Params, state: State, counter: int) -> tuple[State, float]:
    """One sample of the filter: the next state and the electrical speed (rad/s)."""
    error = counter - state.position
    half = 0.5 * params.counts
    if error > half:
        error -= params.counts
    elif error < -half:
        error += params.counts
    speed = state.speed + params.a_speed * error
    position = state.position + params.a_position * error + params.T_s * speed
    if position >= params.counts:
        position -= params.counts
    elif position < 0.0:
        position += params.counts
    return State(position, speed), speed * params.rad_per_count
