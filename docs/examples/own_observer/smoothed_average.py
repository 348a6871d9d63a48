"""The average-speed estimate behind an alpha-beta filter: an observer that another package brings."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from typing import NamedTuple

from sim.numba_cache import kernel
from sim.observers.entry import EDGES_ALONE, Entry
from sim.observers.sample import Sample
from sim.observers.transforms import wrap


@dataclass(frozen=True, kw_only=True)
class Settings:  # the drive's parameters that it takes, by their names
    bw_omega_lpf: float  # Hz


class Params(NamedTuple):  # its constants
    T_s: float
    a_theta: float
    a_omega: float  # 1/s


class State(NamedTuple):  # what it remembers
    primed: int
    theta: float
    omega: float


class Estimate(NamedTuple):  # its results: theta and omega come first
    theta: float  # electrical rad in [-pi, pi)
    omega: float  # electrical rad/s


def make_params(pwm_hz: float, drive: Settings) -> Params:
    pole = math.exp(-2.0 * math.pi * drive.bw_omega_lpf / pwm_hz)
    return Params(1.0 / pwm_hz, 1.0 - pole * pole, (1.0 - pole) ** 2 * pwm_hz)


@kernel
def init() -> State:
    return State(0, 0.0, 0.0)


@kernel
def step(params: Params, state: State, sample: Sample) -> tuple[State, Estimate]:
    if state.primed == 0 or sample.hall.omega == 0.0:
        return State(1, sample.theta_avg, 0.0), Estimate(sample.theta_avg, sample.hall.omega)
    theta = state.theta + params.T_s * state.omega
    error = wrap(sample.theta_avg - theta)
    omega = state.omega + params.a_omega * error
    theta = wrap(theta + params.a_theta * error)
    return State(1, theta, omega), Estimate(theta, omega)


OBSERVER = Entry.of(sys.modules[__name__], "sm", "our bench, 2026", needs=EDGES_ALONE)
