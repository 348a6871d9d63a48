"""What a current loop's integral took in, from its channels, against a loop that is simulated here and tells."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hall_motor import L_S, PSI, R_S, Motor, capture

from bench.replay.current_error import CurrentError
from bench.signal.chunks import part
from protocol.streams import SampleChunk

PWM_HZ, ALPHA, U_DC = 16_000, 2.0 * math.pi * 800.0, 24.0
PARAMETERS = {"bw_current": 800.0}


def loop(reference: np.ndarray, omega: float) -> tuple[SampleChunk, np.ndarray]:
    """A q current loop at a constant speed: what it streams, and its integral by its gain at each sample, A samples."""
    n, T = len(reference), 1.0 / PWM_HZ
    i, integral, queue = 0.0, 0.0, [omega * PSI, omega * PSI]
    columns = {name: np.zeros(n) for name in ("i_q", "i_q_ref", "u_alpha", "u_beta", "u_dc")}
    sums = np.zeros(n)
    before = 0.0
    for k in range(n):
        sums[k] = integral / (ALPHA * R_S * T)  # at k the observer sees what the loop did at k - 1
        columns["i_q"][k], columns["i_q_ref"][k] = i, before
        columns["u_alpha"][k], columns["u_dc"][k] = queue[0], U_DC
        error, before = reference[k] - i, reference[k]
        integral += ALPHA * R_S * T * error
        u = ALPHA * L_S * error + integral + omega * PSI
        over = max(u - U_DC / math.sqrt(3.0), 0.0)
        integral -= over * R_S * T / L_S
        queue.append(u - over)
        i += T / L_S * (queue.pop(0) - R_S * i - omega * PSI)
    chunk = capture(Motor(turns=((100.0, n / PWM_HZ),))).samples
    raw = np.zeros_like(chunk.raw)
    for channel in chunk.config.channels:
        if channel.name in columns:
            raw[channel.name] = np.rint(columns[channel.name] / channel.scale)
    return replace(chunk, raw=raw), sums


def taken(chunk: SampleChunk, cuts: tuple[int, ...] = (), reset: int = 0, **parameters: float) -> np.ndarray:
    """The error in portions."""
    error = CurrentError(PARAMETERS | parameters, PWM_HZ)
    flags = np.arange(len(chunk)) == reset
    bounds = [0, *cuts, len(chunk)]
    return np.concatenate([error.of(part(chunk, a, b), flags[a:b]) for a, b in pairwise(bounds)])


def steps(amps: float, times: int) -> np.ndarray:
    """So many times 0.1 s at that current, and 0.1 s at none."""
    return np.tile(np.repeat([amps, 0.0], PWM_HZ // 10), times)


def test_below_the_limit_it_is_reference_less_current_to_the_last_bit():
    chunk, sums = loop(steps(4.0, 2), 400.0)
    error = taken(chunk)
    i_q = chunk.physical("i_q")
    assert np.array_equal(error, chunk.physical("i_q_ref") - np.r_[0.0, i_q[:-1]])
    assert np.cumsum(error) == pytest.approx(sums, abs=1.0)


def test_at_the_limit_it_neither_winds_up_nor_drifts():
    """2100 rad/s leave 0.1 V for the current, which never gets to 8 A."""
    chunk, sums = loop(steps(8.0, 10), 2100.0)
    raw = np.cumsum(chunk.physical("i_q_ref") - np.r_[0.0, chunk.physical("i_q")[:-1]])
    ampere = PWM_HZ / ALPHA  # A samples that an ampere of current makes in steady state
    assert raw[-1] > 1000.0 * ampere
    off = np.abs(np.cumsum(taken(chunk)) - sums) / ampere
    at_rest = off.reshape(20, -1)[:, -400:]  # at the end of each 0.1 s
    assert at_rest.max() < 3.0  # what the integral was from its steady state when the voltage left the limit
    assert at_rest[-2:].max() < at_rest[:2].max() + 0.1


def test_portions_and_a_reset_make_no_difference_but_that_it_begins_anew():
    chunk, _ = loop(steps(8.0, 3), 2100.0)
    whole = taken(chunk)
    assert taken(chunk, (1, 700, 701, 3333)) == pytest.approx(whole, abs=1e-9)
    anew = taken(chunk, reset=6000)  # where no current flows and the voltage suffices
    assert np.abs(anew - whole)[:6000].max() < 1e-9
    assert np.cumsum(anew[6000:])[-1] == pytest.approx(np.cumsum(whole)[-1], abs=2.0)


def test_what_is_not_streamed_or_told_leaves_the_plain_error_or_none():
    chunk, _ = loop(steps(8.0, 1), 2100.0)
    plain = chunk.physical("i_q_ref") - np.r_[0.0, chunk.physical("i_q")[:-1]]
    assert np.array_equal(taken(chunk, bw_current=0.0), plain)
    names = [name for name in chunk.raw.dtype.names if name != "i_q"]
    assert not taken(replace(chunk, raw=chunk.raw[names])).any()
