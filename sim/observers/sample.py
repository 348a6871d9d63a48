"""What every position observer is given of one control period, and the front end that makes it from what is measured.

The front end runs once, for all observers: `hall_speed` and `average_speed` on the Hall edges, Clarke's transform on
the currents. It also passes on when each sensor changed, because an observer that doubts a sensor cannot work with
sectors. It estimates nothing itself, and knows no parameter of the motor.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.native import Cells, Pointer, address, layout, native, with_item
from sim.numba_cache import kernel
from sim.observers import average_speed, hall_speed
from sim.observers.hall_speed import Edge
from sim.observers.transforms import clarke

INIT = -1  # for a number of samples: initialise, take none


class Measured(NamedTuple):
    """What a drive measures at a sample, and what it did over the period that ends there."""

    tick: int
    hall: int  # code, 0..7, as SPEC 12 has it
    u_alpha: float  # V, in force over the period; both 0 where none is, or none is known
    u_beta: float
    i_a: float  # A, at the sample; all 0 where none is known
    i_b: float
    i_c: float
    i_q_err: float  # A, what the q integral of the current loop took in one period ago: below the limit i_q_ref - i_q


class Sample(NamedTuple):
    """One control period. Voltages and the current error are those in force over the period that ends at the sample."""

    hall: hall_speed.Estimate
    theta_avg: float  # electrical rad, by (1)-(2)
    code: int  # 0..7, at the sample
    edges: int  # captured in the period, glitches included
    ages: tuple[float, float, float]  # s from the first of them to the sample, by sensor; negative: none
    u_alpha: float  # V
    u_beta: float
    i_alpha: float  # A
    i_beta: float
    i_q_err: float  # A, as measured
    hall_offset: float  # electrical rad, ideal angle of the edge that opens sector 0


class State(NamedTuple):
    """What the front end remembers."""

    hall: hall_speed.State
    code: int  # after the last edge or sample; -1: none yet


Settings = average_speed.Settings
Params = average_speed.Params
make_params = average_speed.make_params


@kernel
def init() -> State:
    """Nothing known yet."""
    return State(hall_speed.init(), -1)


@kernel
def step(
    params: Params, state: State, measured: Measured, edges: Pointer[Edge], first: int, last: int
) -> tuple[State, Sample]:
    """One control period with the edges [first, last): those after the last sample and up to this one, in order."""
    ages = (-1.0, -1.0, -1.0)
    before = state.code
    for j in range(first, last):
        for k in range(3):
            if ((before ^ edges[j].code) >> k) & 1 == 1 and ages[k] < 0.0:
                ages = with_item(ages, k, (measured.tick - edges[j].tick) * params.hall.tick_period)
        before = edges[j].code
    code = measured.hall & 7
    front, estimate = hall_speed.step(params.hall, state.hall, measured.tick, measured.hall, edges, first, last)
    i_alpha, i_beta = clarke(measured.i_a, measured.i_b, measured.i_c)
    return State(front, code), Sample(
        estimate,
        average_speed.position(params, estimate),
        code,
        last - first,
        ages,
        measured.u_alpha,
        measured.u_beta,
        i_alpha,
        i_beta,
        measured.i_q_err,
        params.hall_offset,
    )


@native
def run(
    params: Pointer[Params],
    state: Pointer[State],
    measured: Pointer[Measured],
    reset: Pointer[np.uint8],
    n: int,
    edges: Pointer[Edge],
    m: int,
    samples: Pointer[Sample],
) -> None:
    """`step` over n samples; n = `INIT`: only `init`."""
    constants = params[0]
    now = init() if n == INIT else state[0]
    first = 0
    for k in range(n):
        seen = measured[k]
        last = first
        while last < m and edges[last].tick <= seen.tick:
            last += 1
        if reset[k] != 0:
            now = init()
        now, samples[k] = step(constants, now, seen, edges, first, last)
        first = last
    state[0] = now


class FrontEnd:
    """The front end at work over measured samples, a portion at a time: its constants and what it remembers."""

    def __init__(self, params: Params) -> None:
        self._params, self.state = Cells(Params), Cells(State)
        self.params = params
        self._at = self._params.at, self.state.at
        run(*self._at, 0, 0, INIT, 0, 0, 0)

    @property
    def params(self) -> Any:
        """Its constants."""
        return self._params.first

    @params.setter
    def params(self, params: Any) -> None:
        self._params.first = params

    def run(self, measured: NDArray[np.void], edges: NDArray[np.void], reset: NDArray[np.bool_]) -> NDArray[np.void]:
        """`step` over n samples of one control period each, with `init` before each where `reset`, shape (n,), is set.

        `measured`: records of `Measured`, shape (n,). `edges`: of `Edge`, shape (m,), rising ticks; an edge is taken in
        with the first sample at or after it, and edges after the last sample are left alone (give them again with the
        next samples). Returns records of `Sample`, shape (n,).
        """
        samples = np.empty(len(measured), layout(Sample))
        n, m = len(measured), len(edges)
        run(*self._at, address(measured), address(reset), n, address(edges), m, address(samples))
        return samples
