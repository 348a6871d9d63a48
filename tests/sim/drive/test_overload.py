"""The i2t guard: when it trips follows from the current alone."""

import math
from pathlib import Path

import numpy as np
import pytest
from rig import PWM_HZ, Rig

import sim
from protocol.messages import DriveState, Fault, SetpointMode
from sim.config.params import load_params

I_CONT = 2.0
MOTORS = {file.stem: file for file in sorted((Path(sim.__file__).parent / "motors").glob("*.toml"))}


def held(i2t_max, **settings):
    """A rotor that the load machine holds, the drive on the encoder."""
    settings = {"firmware.observer": 0, "load.alpha_m_max": 0.0, "current_sensor.noise_rms": 0.0} | settings
    bench = Rig(1, **settings)
    bench.start()
    bench.load_setpoint(SetpointMode.SPEED, 0.0)
    bench.set_param("i_cont", I_CONT)
    bench.set_param("i2t_max", i2t_max)
    return bench


def trip(bench, i, most):
    """Seconds until the drive trips at a current; infinite where it does not within `most`."""
    bench.setpoint(SetpointMode.CURRENT, i.imag, i.real)
    for n in range(round(most * PWM_HZ / 8)):
        bench.advance(8)
        if bench.faults:
            assert bench.faults == Fault.OVERLOAD
            assert not bench.outputs_on
            return 8.0 * n / PWM_HZ
    return math.inf


@pytest.mark.parametrize("seed", range(10))
def test_it_trips_when_the_excess_of_the_squared_current_is_there(seed):
    rng = np.random.default_rng(seed)
    size, i2t_max = rng.uniform(2.2, 7.9), float(np.float32(rng.uniform(0.5, 12.0)))
    i = size * np.exp(1j * rng.uniform(0.0, math.tau))
    expected = i2t_max / (size**2 - I_CONT**2)
    assert trip(held(i2t_max), i, 2.0 * expected + 0.01) == pytest.approx(expected, rel=0.01, abs=2e-3)


def test_it_never_trips_at_what_the_winding_bears_nor_where_it_is_off():
    assert trip(held(0.1), 1.98j, 2.0) == math.inf
    assert trip(held(0.0), 7.9j, 2.0) == math.inf


def test_it_forgets_while_the_current_is_small_but_not_below_zero():
    i2t_max, per_second = 8.0, 6.0**2 - I_CONT**2
    bench = held(i2t_max)
    warm, rest = 0.2, 0.5
    assert trip(bench, 6j, warm) == math.inf
    bench.setpoint(SetpointMode.CURRENT, 0.0)
    bench.run(rest)
    left = warm * per_second - rest * I_CONT**2
    assert left > 0.0
    assert trip(bench, 6j, 1.0) == pytest.approx((i2t_max - left) / per_second, rel=0.02, abs=2e-3)
    cold = held(i2t_max)
    cold.run(5.0)  # five seconds of no current are no credit
    assert trip(cold, 6j, 1.0) == pytest.approx(i2t_max / per_second, rel=0.02, abs=2e-3)


def test_it_goes_on_in_every_state_and_a_drive_that_is_cleared_at_once_trips_soon_again():
    bench = held(4.0)
    first = trip(bench, 7j, 1.0)
    bench.enter_state(DriveState.FAULT)
    bench.advance(160)  # 10 ms of 4 A2
    assert bench.fault_causes == 0
    bench.clear_faults()
    bench.enable()
    again = trip(bench, 7j, 1.0)
    assert again == pytest.approx(0.01 * I_CONT**2 / (49.0 - I_CONT**2), abs=2.5e-3)
    assert again < 0.05 * first


def test_it_acts_on_a_given_voltage_at_a_forced_angle_as_it_does_on_a_current():
    bench = held(4.0, **{"inverter.dead_time": 0.0, "firmware.dead_time.dead_time_hat": 0.0})
    bench.set_param("forced", 1.0)
    bench.setpoint(SetpointMode.VOLTAGE, 0.0, 0.158 * 6.0)
    bench.run(4.0 / (36.0 - I_CONT**2) + 0.01)
    assert bench.faults == Fault.OVERLOAD
    assert not bench.outputs_on


@pytest.mark.parametrize("motor", ["paper", *MOTORS])
def test_every_motor_bears_its_largest_current_for_half_a_minute(motor):
    firmware = load_params(MOTORS.get(motor)).firmware
    limits = firmware.protection
    assert limits.i_cont == pytest.approx(0.7 * firmware.i_max, rel=0.05)
    seconds = limits.i2t_max / (firmware.i_max**2 - limits.i_cont**2)
    assert seconds == pytest.approx(30.0, rel=0.05)
