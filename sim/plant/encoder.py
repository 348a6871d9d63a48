"""The incremental encoder: counts within a turn of the shaft, and the speed by a tracking filter on them.

Four counts a line; the index pulse sets the counter to zero once a turn, so the count is an absolute angle. A
misaligned zero adds `offset` to the angle that the firmware reads. With an index search the counter begins at zero
wherever the rotor is, and is an absolute angle from the first index pulse on. A disc that sits off its centre adds a
sine with a period a turn, and marks that are not evenly read one with a period a line, which makes counts of unequal
width. One that is late (a filter, a serial interface) shows the angle that was `latency` ago, at the speed of now.

What may be wrong: the disc has slipped on the shaft, its index with it, or is dragged along by friction only, which
gives it no more than so much acceleration, and slips whenever the shaft has more; counts are lost, or counted twice, at
random places, either way; the firmware takes the disc to have another number of lines; channels are exchanged, so that
it counts the wrong way. Against the last two, and a misaligned zero, the firmware has constants of its own (`read_as`).
Where the index pulse sets the counter to zero each turn, what was lost is put right there.

Never interpolates between counts.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sim.hints import seldom
from sim.numba_cache import kernel
from sim.plant import noise

TWO_PI = 2.0 * math.pi
SALT = np.uint64(0xD1B54A32D192ED03)


class Params(NamedTuple):
    """The encoder's constants, and those of the filter on it."""

    counts: int  # a turn
    counts_hat: int  # the same, as the firmware takes it
    counts_per_rad: float  # counts an electrical radian
    offset: float  # electrical rad
    rad_per_count: float  # electrical, as the firmware takes it; below zero where it takes the count to go down
    zero: float  # electrical rad, at the count 0, as the firmware takes it
    a_position: float  # filter gains: share of the error, and
    a_speed: float  # counts/s a count of error
    T_s: float
    eccentric: float  # counts, amplitude with a period a turn
    within: float  # counts, amplitude with a period of four counts
    latency: float  # s, short beside what the speed takes to change
    lost: float  # share of counts that are lost; below zero: counted twice
    resets: int  # 1: each index pulse sets the counter to zero
    grip: float  # rad/s2, mechanical, that friction gives the disc; 0: it is fixed


class Index(NamedTuple):
    """What the firmware's counter lacks of the absolute count."""

    lacks: int  # counts, until the index pulse has come by
    missed: int  # counts that were lost
    last: int  # absolute count at the last sample
    found: int  # 1: the index pulse sets nothing right any more


class Disc(NamedTuple):
    """The disc, where it is not fixed to the shaft."""

    omega: float  # rad/s, mechanical
    behind: float  # rad, mechanical, by which it has slipped


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
        counts,
        counts / (TWO_PI * n_p),
        math.radians(offset_deg),
        TWO_PI * n_p_hat / counts,
        0.0,
        1.0 - pole * pole,
        (1.0 - pole) ** 2 / T_s,
        float(T_s),
        eccentricity_deg / 360.0 * counts,
        float(unevenness),
        0.0,
        0.0,
        0,
        0.0,
    )


def read_as(params: Params, lines: float, reverse: float, zero: float) -> Params:
    """The constants with what the firmware takes for the disc's lines, its way (1: down) and its zero (electrical rad).

    They change angle and speed, and no count but that it begins anew after so many.
    """
    counts_hat = 4 * int(lines)
    way = -1.0 if reverse else 1.0
    return params._replace(
        counts_hat=counts_hat,
        rad_per_count=way * params.rad_per_count * (params.counts / counts_hat),
        zero=float(zero),
    )


def make_faulty(
    params: Params, slip_deg: float, slip_alpha: float, lost_per_rev: float, pulses_hat: int, reversed: int
) -> Params:
    """The constants with these faults.

    In electrical degrees, rad/s2 (0: none), counts a turn, lines (0: as the firmware has it), 0 or 1.
    """
    counts_hat = 4 * pulses_hat or params.counts_hat
    return params._replace(
        counts_hat=counts_hat,
        counts_per_rad=-params.counts_per_rad if reversed else params.counts_per_rad,
        offset=params.offset + math.radians(slip_deg),
        rad_per_count=params.rad_per_count * (params.counts_hat / counts_hat),
        lost=lost_per_rev / params.counts,
        grip=float(slip_alpha),
    )


@kernel
def dragged(params: Params, disc: Disc, omega_0: float, omega_1: float) -> Disc:
    """The disc a period later, in which the shaft's speed goes straight from `omega_0` to `omega_1`, mechanical rad/s.

    Whatever it has slipped is forgotten while it is fixed.
    """
    return _dragged(params, disc, omega_0, omega_1) if seldom(params.grip > 0.0) else Disc(omega_1, 0.0)


@kernel
def _dragged(params: Params, disc: Disc, omega_0: float, omega_1: float) -> Disc:
    left = params.T_s
    alpha = (omega_1 - omega_0) / params.T_s
    slip = omega_0 - disc.omega  # rad/s
    behind = disc.behind
    for _ in range(2):
        if slip == 0.0 and abs(alpha) <= params.grip:
            return Disc(omega_1, behind)
        forward = slip > 0.0 or (slip == 0.0 and alpha > 0.0)
        rate = alpha - params.grip if forward else alpha + params.grip
        stops = slip * rate < 0.0 and -slip / rate < left
        h = -slip / rate if stops else left
        behind += h * (slip + 0.5 * rate * h)
        slip = 0.0 if stops else slip + rate * h
        left -= h
        if left <= 0.0:
            break
    return Disc(omega_1 - slip, behind)


@kernel
def slipped(params: Params, disc: Disc, n_p: float) -> Params:
    """The constants with the disc where it is now, on the shaft of a motor with `n_p` pole pairs."""
    return params._replace(offset=params.offset - n_p * disc.behind) if seldom(params.grip > 0.0) else params


@kernel
def _sine(turns: float) -> float:
    """sin of so many turns, to 2e-4: of errors that nobody knows better."""
    x = turns - math.floor(turns) - 0.5  # of the turn's half, so the sign is the other
    y = 0.5 - abs(x) if abs(x) > 0.25 else abs(x)
    z = TWO_PI * y
    w = z * z
    size = z * (1.0 - w * (0.16605 - w * 0.00761))
    return -size if x > 0.0 else size


@kernel
def count(params: Params, theta_e: float, omega_e: float) -> int:
    """The absolute count, not wrapped, at an unwrapped electrical angle (rad) and a speed (rad/s)."""
    counts = (theta_e - params.latency * omega_e + params.offset) * params.counts_per_rad
    if params.eccentric != 0.0 or params.within != 0.0:
        counts += params.eccentric * _sine(counts / params.counts)
        counts += params.within * _sine(0.25 * counts)
    return math.floor(counts)


@kernel
def booted(params: Params, absolute: int, search: int) -> Index:
    """At boot, at an absolute count; with `search` 1 the counter begins at zero."""
    return Index(absolute if search == 1 else 0, 0, absolute, 0 if search == 1 or params.resets == 1 else 1)


@kernel
def sought(params: Params, index: Index, absolute: int, rng: np.uint64) -> Index:
    """At the next sample, at an absolute count: counts may be lost, and the index pulse lies at whole turns.

    `rng`: the current sensors draw from it, too.
    """
    missed = index.missed
    if params.lost != 0.0:
        way = absolute - index.last
        lost = math.floor(abs(way * params.lost) + noise.uniform(noise.advance(rng ^ SALT)))
        missed += lost if way * params.lost > 0.0 else -lost
    lacks, found = index.lacks, index.found
    if found == 0:
        turn = absolute // params.counts
        before = index.last // params.counts
        if turn != before:
            lacks = max(turn, before) * params.counts - missed
            found = 1 - params.resets
    return Index(lacks, missed, absolute, found)


@kernel
def counted(params: Params, index: Index, absolute: int) -> int:
    """What the firmware has counted at an absolute count, within a turn, if it were not for the index."""
    return (absolute - index.missed) % params.counts_hat


@kernel
def shown(params: Params, index: Index, counter: int) -> int:
    """The firmware's counter where that is what it has counted."""
    if index.lacks == 0:
        return counter
    return (counter - index.lacks) % params.counts_hat


@kernel
def angle(params: Params, counter: int) -> float:
    """The electrical angle (rad, not wrapped) of the middle of a count."""
    return (counter + 0.5) * params.rad_per_count + params.zero


@kernel
def init(counter: int) -> State:
    """The filter at rest."""
    return State(float(counter), 0.0)


@kernel
def track(params: Params, state: State, counter: int) -> tuple[State, float]:
    """One sample of the filter: the next state and the electrical speed (rad/s)."""
    error = counter - state.position
    half = 0.5 * params.counts_hat
    if error > half:
        error -= params.counts_hat
    elif error < -half:
        error += params.counts_hat
    speed = state.speed + params.a_speed * error
    position = state.position + params.a_position * error + params.T_s * speed
    if position >= params.counts_hat:
        position -= params.counts_hat
    elif position < 0.0:
        position += params.counts_hat
    return State(position, speed), speed * params.rad_per_count
