"""The firmware's means of commissioning: an angle that is made, a voltage that is given, and test signals.

The forced angle begins where the control's angle is, at rest. Its speed follows a ramp, and the angle is the integral
of that. With the outputs off it stands still.

The test signal is a square, or samples that repeat. It is worked out once a period, for the reference or the voltage
that the control computes then. `cycle` comes with the sample that is the first to show it: a speed at once, a current
one sample later, a voltage two.

Nothing jumps: where the control takes over from a given voltage, or gets another angle than its own, it goes on at the
voltage that is there, and its integrals are set so that it does; a given voltage comes no further in a period than
`u_test_max`.

`tick_firmware` calls it only where `Params.on` is 1, so that other drives have nothing of it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from protocol.codes import TestSignal
from sim.circle import cos_sin
from sim.control import speed_loop
from sim.control.transforms import clip, inverse_park, park
from sim.native import Pointer
from sim.numba_cache import kernel

OFF, U_D, U_Q = int(TestSignal.OFF), int(TestSignal.U_D), int(TestSignal.U_Q)
I_D, I_Q, SPEED = int(TestSignal.I_D), int(TestSignal.I_Q), int(TestSignal.SPEED)
AT_REST = math.tau  # rad/s, with which the forced angle goes to where it is told at rest
FULL = 32767.0  # a sample of the waveform that is the whole amplitude
SAMPLES = 4096  # of the waveform
TWO_PI = 2.0 * math.pi

Two = tuple[float, float]


class Params(NamedTuple):
    """What is asked for."""

    on: int  # 1: any of it is in use, or was since the outputs went on
    forced: int  # 1: the control uses the forced angle
    speed: float  # electrical rad/s
    slope: float  # rad/s a period
    goes: int  # 1: at rest it goes to `angle`
    angle: float  # electrical rad
    step: float  # rad a period, with which it does
    T_s: float
    test: int  # TestSignal
    amplitude: float  # V, A, or mechanical rad/s
    periods: int  # that each sample of the signal lasts
    length: int  # samples of the waveform; 0: a square
    u_max: float  # V, largest step of a given voltage
    i_max: float  # A
    omega_m_max: float  # mechanical rad/s


class State(NamedTuple):
    """What is remembered of it; all zero where there is nothing."""

    forced: int  # 1: the angle was forced at the last sample
    theta: float  # electrical rad, the forced angle
    omega: float  # rad/s
    begun: int  # 1: the test signal has begun
    sample: int  # of it
    left: int  # periods for which this sample goes on
    length: int  # samples of the cycle, 0: a square
    shown: int  # bit n: a cycle begins in what the record shows n samples later
    u_alpha: float  # V, what the test signal is in the voltage computed last
    u_beta: float


def make_params(drive: Mapping[str, float], pwm_hz: float, used: bool, goes: bool) -> Params:
    """Constants from the drive's parameters; `used`: it has been since the outputs went on; `goes`: see `Params`."""
    T_s = 1.0 / pwm_hz
    test = int(drive["test"])
    fastest = drive["n_p"] * drive["omega_m_max"]
    amplitude = {
        OFF: 0.0,
        U_D: min(drive["test_voltage"], drive["u_test_max"]),
        I_D: min(drive["test_current"], drive["i_max"]),
        SPEED: min(drive["test_speed"], drive["omega_m_max"]),
    }[{U_Q: U_D, I_Q: I_D}.get(test, test)]
    return Params(
        int(used or drive["forced"] != 0.0 or test != OFF),
        int(drive["forced"]),
        min(max(drive["forced_speed"], -fastest), fastest),
        drive["forced_slope"] * T_s,
        int(goes),
        drive["forced_angle"],
        AT_REST * T_s,
        T_s,
        test,
        amplitude,
        int(drive["test_periods"]),
        int(drive["test_length"]),
        drive["u_test_max"],
        drive["i_max"],
        drive["omega_m_max"],
    )


@kernel
def init() -> State:
    """Nothing is forced, nothing tested."""
    return State(0, 0.0, 0.0, 0, 0, 0, 0, 0, 0.0, 0.0)


@kernel
def _wrapped(angle: float) -> float:
    """An angle within half a turn of zero."""
    return angle - TWO_PI * math.floor((angle + math.pi) / TWO_PI)


@kernel
def forced(params: Params, state: State, theta: float, running: bool) -> State:
    """The forced angle at a sample; `theta`: the angle that the control would have otherwise, electrical rad."""
    if params.forced == 0:
        return state._replace(forced=0)
    if state.forced == 0:
        return state._replace(forced=1, theta=_wrapped(theta), omega=0.0)
    if not running:
        return state._replace(omega=0.0)
    omega = state.omega + clip(params.speed - state.omega, params.slope)
    moves = 0.5 * params.T_s * (state.omega + omega)
    if params.goes == 1 and params.speed == 0.0 and state.omega == 0.0:
        moves = clip(_wrapped(params.angle - state.theta), params.step)
    return state._replace(theta=_wrapped(state.theta + moves), omega=omega)


@kernel
def tested(params: Params, state: State, waveform: Pointer[float], running: bool) -> tuple[State, float, int]:
    """The test signal in this period: (state, its value, 1 where the record first shows a cycle at this sample)."""
    shown = state.shown >> 1
    if not running or params.test == OFF:
        state = state._replace(begun=0, shown=shown)
        return (state if running else state._replace(u_alpha=0.0, u_beta=0.0)), 0.0, shown & 1
    sample, left, length = state.sample, state.left, state.length
    if state.begun == 0 or left == 0:
        sample += 1
        left = params.periods
        if state.begun == 0 or sample >= (2 if length == 0 else length):
            sample = 0
            length = params.length
            later = 0
            if params.test != SPEED:
                later = 2 if params.test == U_D or params.test == U_Q else 1
            shown |= 1 << later
    value = waveform[sample]
    if length == 0:
        value = 1.0 if sample == 0 else -1.0
    state = state._replace(begun=1, sample=sample, left=left - 1, length=length, shown=shown)
    return state, value * params.amplitude, shown & 1


@kernel
def speed_limits(params: Params, speed: speed_loop.Params, i_d: float) -> speed_loop.Params:
    """The speed loop's constants with as much q current as a d current (A) leaves."""
    return speed._replace(i_max=math.sqrt(max(params.i_max * params.i_max - i_d * i_d, 0.0)))


@kernel
def added_speed(params: Params, value: float, omega_m_ref: float) -> float:
    """What the test signal adds to a reference of the mechanical speed (rad/s)."""
    if params.test != SPEED:
        return 0.0
    return clip(omega_m_ref + value, params.omega_m_max) - omega_m_ref


@kernel
def within(size: float, vector: Two) -> Two:
    """The vector, or where it is longer than that the one of this length."""
    length = math.sqrt(vector[0] * vector[0] + vector[1] * vector[1])
    if length > size:
        return vector[0] * (size / length), vector[1] * (size / length)
    return vector


@kernel
def currents(params: Params, value: float, i_d_ref: float, i_q_ref: float) -> Two:
    """The references of the currents (A) with the test signal, the vector at most `i_max`."""
    if params.test == I_D:
        i_d_ref += value
    elif params.test == I_Q:
        i_q_ref += value
    else:
        return i_d_ref, i_q_ref
    return within(params.i_max, (i_d_ref, i_q_ref))


@kernel
def going_on(state: State, u_alpha: float, u_beta: float, turned: float, cos: float, sin: float) -> Two:
    """The last voltage without its test signal, (d, q) in V, in the frame of cos and sin.

    `turned`: by how much (rad) a voltage turns until the next one that goes on with it.
    """
    u_d, u_q = park(u_alpha - state.u_alpha, u_beta - state.u_beta, cos, sin)
    c, s = cos_sin(turned)
    return inverse_park(u_d, u_q, c, s)


@kernel
def given(params: Params, old: Two, u_d: float, u_q: float) -> Two:
    """A given voltage (V), or as much of the way there from `old` as it may come in a period."""
    u_d, u_q = within(params.u_max, (u_d - old[0], u_q - old[1]))
    return old[0] + u_d, old[1] + u_q


@kernel
def with_test(
    params: Params, state: State, value: float, u: Two, u_max: float, cos: float, sin: float
) -> tuple[State, Two]:
    """The voltage (d, q) with the test signal, the vector at most `u_max` V, in the frame of cos and sin."""
    u_d, u_q = u
    if params.test == U_D:
        u_d += value
    elif params.test == U_Q:
        u_q += value
    u_d, u_q = within(u_max, (u_d, u_q))
    u_alpha, u_beta = inverse_park(u_d - u[0], u_q - u[1], cos, sin)
    return state._replace(u_alpha=u_alpha, u_beta=u_beta), (u_d, u_q)
