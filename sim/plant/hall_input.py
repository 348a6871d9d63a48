"""What may be wrong between a Hall sensor's output and the firmware's input, by sensor: late and bouncing edges,
contacts that come and go, pulses.

In this order:
- An edge of the sensor's output reaches the input late, a rising one by another time than a falling one: pull-up, cable
  and filter with a comparator behind them. A level that the sensor leaves before the delay into it is over never
  reaches the input, as with an RC element; so edges of one sensor never overtake one another.
- Some edges bounce: the input goes back and comes again, equally spaced, a number of times.
- A contact opens for a while, exponentially distributed, and the input reads 1.
- A pulse inverts the input for a time evenly distributed between two widths. Pulses come at random: at a steady mean
  rate, at one that goes with the current's amplitude, or each at an edge of the PWM while the outputs are on.

Wires that are exchanged, inverted or shorted are beyond (`hall_wiring`). Its random numbers are its own: noise and
jitter are the same with such faults and without. What begins at random is drawn anew in every period, since an
exponential wait has no memory: a new rate is used at once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sim.native import with_item
from sim.numba_cache import kernel
from sim.plant import noise
from sim.plant.hall_wiring import NEVER

SENSORS = 3
BOUNCE, CONTACT, PULSE, EVENTS = 3, 6, 9, 12  # where kinds of event begin in `State.due`; late edges come first
AT_RANDOM, BY_CURRENT, BY_PWM = range(3)
SALT = np.uint64(0x9E3779B97F4A7C15)

Three = tuple[float, float, float]
Ticks = tuple[int, int, int, int, int, int, int, int, int, int, int, int]


class Settings(NamedTuple):
    """What is wrong, as the configuration's keys say it: times in s, rates in 1/s, one item a sensor."""

    rise_delay: Sequence[float]
    fall_delay: Sequence[float]
    bounce: Sequence[float]
    bounce_returns: int
    bounce_spacing: float
    pulse_rate: Sequence[float]
    pulse_min: float
    pulse_max: float
    pulse_by: int
    contact_open: Sequence[float]
    contact_stretch: float

    @property
    def busy(self) -> float:
        """Edges a second, mean, that are none of the sensors'."""
        return 2.0 * (sum(self.pulse_rate) + sum(self.contact_open) / self.contact_stretch)


class Params(NamedTuple):
    """What is wrong; times in ticks."""

    on: int  # 1: something is
    delay: tuple[int, int, int, int, int, int]  # of rising edges of a, b, c, then of falling ones
    bounce: Three  # share of a sensor's edges
    changes: int  # of a bounce: two a return
    spacing: int
    rate: Three  # pulses a tick
    pulse_min: float
    pulse_spread: float
    by: int  # what pulses go with
    per_ampere: float  # BY_CURRENT: of the rate
    closed: Three  # mean time for which a contact is closed; 0: always
    stretch: float  # mean time for which it is open


class State(NamedTuple):
    """What is under way, by sensor, and what comes of it."""

    on: int
    rng: np.uint64
    output: int  # code of the sensors' outputs
    late: int  # code after the delays
    code: int  # after bounces, too
    open: int  # inputs whose contact is open, a bit each
    pulse: int  # inputs that a pulse inverts
    due: Ticks  # of the next event of each kind and sensor; NEVER: there is none
    left: tuple[int, int, int]  # changes of a bounce to come
    gap: Three  # mean ticks from a pulse to the next, as things are now; 0: none comes


def make_params(tick_hz: float, i_max: float, settings: Settings) -> Params:
    """The constants; `i_max` (A): amplitude of the current at which pulses that go with it have their rate."""
    s = settings

    def closed(share: float) -> float:
        return s.contact_stretch * tick_hz * (1.0 - share) / share if share else 0.0

    rise, fall = ([round(delay * tick_hz) for delay in delays] for delays in (s.rise_delay, s.fall_delay))
    wrong = (*rise, *fall, *s.bounce, *s.pulse_rate, *s.contact_open)
    return Params(
        int(any(wrong)),
        (rise[0], rise[1], rise[2], fall[0], fall[1], fall[2]),
        _three(s.bounce),
        2 * s.bounce_returns,
        max(1, round(s.bounce_spacing * tick_hz)),
        _three([rate / tick_hz for rate in s.pulse_rate]),
        s.pulse_min * tick_hz,
        (s.pulse_max - s.pulse_min) * tick_hz,
        int(s.pulse_by),
        1.0 / i_max,
        _three([closed(share) for share in s.contact_open]),
        s.contact_stretch * tick_hz,
    )


def _three(values: Sequence[float]) -> Three:
    a, b, c = values
    return float(a), float(b), float(c)


@kernel
def switched(params: Params, state: State, code: int, rng: np.uint64) -> State:
    """Faults begin, with the sensors at `code`, or end; what goes on stays as it is."""
    if params.on == state.on:
        return state
    due = (NEVER, NEVER, NEVER, NEVER, NEVER, NEVER, NEVER, NEVER, NEVER, NEVER, NEVER, NEVER)
    return State(params.on, noise.advance(rng ^ SALT), code, code, code, 0, 0, due, (0, 0, 0), (0.0, 0.0, 0.0))


@kernel
def _first(due: Ticks) -> int:
    """Which event is the next."""
    first = 0
    for k in range(1, EVENTS):
        if due[k] < due[first]:
            first = k
    return first


@kernel
def next_due(state: State) -> int:
    """The tick of the next event."""
    return state.due[_first(state.due)]


@kernel
def _wait(rng: np.uint64, mean: float) -> int:
    """Ticks, one at least, exponentially distributed; half of one is what rounding up adds to the mean."""
    return 1 + math.floor(-max(mean - 0.5, 0.5) * math.log(1.0 - noise.uniform(rng)))


@kernel
def _arrived(params: Params, state: State, sensor: int, tick: int) -> State:
    """An edge of a sensor's output comes to the input, and may bounce."""
    late = state.late ^ 1 << sensor
    code = state.code & ~(1 << sensor) | late & 1 << sensor
    rng, left, due = state.rng, 0, NEVER
    if params.bounce[sensor] > 0.0:
        rng = noise.advance(rng)
        if noise.uniform(rng) < params.bounce[sensor]:
            left, due = params.changes, tick + params.spacing
    dues = with_item(with_item(state.due, sensor, NEVER), BOUNCE + sensor, due)
    return state._replace(rng=rng, late=late, code=code, left=with_item(state.left, sensor, left), due=dues)


@kernel
def sensed(params: Params, state: State, code: int, tick: int) -> State:
    """The sensors' outputs change to `code`."""
    changed = state.output ^ code
    state = state._replace(output=code)
    for sensor in range(SENSORS):
        if changed >> sensor & 1 == 0:
            continue
        delay = params.delay[sensor if code >> sensor & 1 == 1 else SENSORS + sensor]
        if (code ^ state.late) >> sensor & 1 == 0:  # back before it has come
            state = state._replace(due=with_item(state.due, sensor, NEVER))
        elif delay == 0:
            state = _arrived(params, state, sensor, tick)
        else:
            state = state._replace(due=with_item(state.due, sensor, tick + delay))
    return state


@kernel
def happened(params: Params, state: State) -> State:
    """The next event happens."""
    k = _first(state.due)
    tick = state.due[k]
    sensor = k % SENSORS
    if k < BOUNCE:
        return _arrived(params, state, sensor, tick)
    due = NEVER
    if k < CONTACT:
        left = state.left[sensor] - 1
        state = state._replace(left=with_item(state.left, sensor, left), code=state.code ^ 1 << sensor)
        if left > 0:
            due = tick + params.spacing
    elif k < PULSE:
        state = state._replace(rng=noise.advance(state.rng), open=state.open ^ 1 << sensor)
        due = tick + _wait(state.rng, params.stretch if state.open >> sensor & 1 == 1 else params.closed[sensor])
    else:
        state = state._replace(rng=noise.advance(state.rng), pulse=state.pulse ^ 1 << sensor)
        if state.pulse >> sensor & 1 == 1:
            due = tick + max(1, round(params.pulse_min + params.pulse_spread * noise.uniform(state.rng)))
        elif state.gap[sensor] > 0.0:
            due = tick + _wait(state.rng, state.gap[sensor])
    return state._replace(due=with_item(state.due, k, due))


@kernel
def _pwm_edge(rng: np.uint64, tick: int, period_ticks: int, duties: Three) -> int:
    """The tick of one of the six edges of the legs in the period after `tick`; a leg is high about its middle."""
    x = 6.0 * noise.uniform(rng)
    k = math.floor(x)
    half = 0.5 * min(max(duties[k % 3], 0.0), 1.0)
    return tick + 1 + math.floor((period_ticks - 1) * (0.5 - half if k < 3 else 0.5 + half))


@kernel
def begun(
    params: Params, state: State, tick: int, period_ticks: int, current: float, outputs_on: int, duties: Three
) -> State:
    """What comes at random in the period after `tick`, with a current of that amplitude (A), is drawn anew."""
    rng, due, gaps = state.rng, state.due, state.gap
    for sensor in range(SENSORS):
        if params.closed[sensor] > 0.0:
            rng = noise.advance(rng)
            mean = params.stretch if state.open >> sensor & 1 == 1 else params.closed[sensor]
            due = with_item(due, CONTACT + sensor, tick + _wait(rng, mean))
        rate = params.rate[sensor]
        if params.by == BY_CURRENT:
            rate *= current * params.per_ampere
        gap = 0.0
        if params.by != BY_PWM and rate > 0.0:
            gap = max(1.0 / rate - params.pulse_min - 0.5 * params.pulse_spread, 1.0)
        gaps = with_item(gaps, sensor, gap)
        if params.rate[sensor] == 0.0 or state.pulse >> sensor & 1 == 1:
            continue
        at = NEVER
        rng = noise.advance(rng)
        if gap > 0.0:
            at = tick + _wait(rng, gap)
        elif params.by == BY_PWM and outputs_on == 1 and noise.uniform(rng) < rate * period_ticks:
            rng = noise.advance(rng)
            at = _pwm_edge(rng, tick, period_ticks, duties)
        due = with_item(due, PULSE + sensor, at)
    return state._replace(rng=rng, due=due, gap=gaps)
