"""The firmware's watch over its Hall sensors: what trips it, how soon, and all that must not."""

from itertools import product

import numpy as np
import pytest
from rig import RPM, Rig

from protocol.messages import DriveState, Fault, SetpointMode
from sim.config.params import load_params
from sim.drive import tick_protection as protection
from tests.choice import sampled

pytestmark = pytest.mark.slow

BENCH = load_params()
PARAMS = protection.make_params(16000.0, BENCH.drive_parameters(), True, BENCH.firmware.protection)
QUIET = protection.Sensed(0.0, 0.0, 24.0, 1, 0, 1, 0.0, 0.0)


def tripped(samples, on=False):
    """Number of the sample with which HALL has a cause, None if there is none."""
    state = protection.init()
    for number, sensed in enumerate(samples, 1):
        state = protection.step(PARAMS, state, sensed, on)
        if state.causes:
            assert state.causes == Fault.HALL
            return number
    return None


def back_emf(omega, samples, size=1.0, direction=1):
    angles = omega / 16000.0 * np.arange(samples)
    return [
        QUIET._replace(direction=direction, e_alpha=size * x, e_beta=size * y)
        for x, y in zip(np.cos(angles), np.sin(angles), strict=True)
    ]


def test_the_noise_of_differentiated_currents_turns_no_way():
    """A back-EMF at its threshold under 0.2 V rms: 12 mA of noise through 0.5 mH at 16 kHz, 1.5 times."""
    rng, slow = np.random.default_rng(1), 40.0
    noise = np.diff(rng.normal(0.0, 0.14, (2, 30_001)))
    for size in (0.25, 0.4):
        noisy = [
            sensed._replace(e_alpha=sensed.e_alpha + x, e_beta=sensed.e_beta + y)
            for sensed, x, y in zip(back_emf(slow, 30_000, size), *noise, strict=True)
        ]
        assert tripped(noisy, on=True) is None
    turns = 6 * 2 * np.pi / slow * 16000
    against = [sensed._replace(direction=-1) for sensed in noisy]
    assert tripped(against, on=True) == pytest.approx(turns, rel=0.05)


@pytest.mark.parametrize("code", [0, 7])
def test_an_illegal_code_trips_once_it_has_stood_for_its_time(code):
    assert tripped([QUIET._replace(hall=code)] * 100) == 80  # 5 ms
    assert tripped(([QUIET._replace(hall=code)] * 79 + [QUIET] * 8_000) * 2) is None


def test_implausible_edges_trip_by_their_number_and_are_forgotten():
    assert tripped([QUIET._replace(edges=1)] * 100) == 40
    assert tripped([QUIET._replace(edges=2)] * 100) == 20
    assert tripped(([QUIET._replace(edges=1)] * 39 + [QUIET] * 8_000) * 3) is None  # 0.5 s forget it all
    assert tripped(([QUIET._replace(edges=1)] + [QUIET] * 209) * 200) is None  # 76 a second


def test_one_spike_of_the_back_emf_is_no_turn():
    spike = QUIET._replace(e_alpha=-40.0, e_beta=40.0)
    quiet = QUIET._replace(e_alpha=0.35, e_beta=0.35)
    assert tripped([quiet, spike, quiet] * 3, on=True) is None


def test_a_back_emf_against_the_hall_sensors_trips_after_its_turns():
    omega = 300.0
    turns = 6 * 2 * np.pi / omega * 16000
    assert tripped(back_emf(-omega, 5000), on=True) == pytest.approx(turns, abs=25)
    assert tripped(back_emf(omega, 5000, direction=-1), on=True) == pytest.approx(turns, abs=25)
    assert tripped(back_emf(omega, 5000), on=True) is None
    assert tripped(back_emf(-omega, 5000, direction=0), on=True) is None
    assert tripped(back_emf(-omega, 5000, size=0.29), on=True) is None
    assert tripped(back_emf(-omega, 5000), on=False) is None
    assert tripped((back_emf(-omega, 1500) + back_emf(omega, 1500)) * 3, on=True) is None


def drive(observer=2, **overrides):
    bench = Rig(1, **{"firmware.observer": observer, **overrides})
    bench.enable()
    bench.load_enter_state(DriveState.RUNNING)
    return bench


def forced(rpm, observer=2):
    """The drive at 2 A on a shaft that the load machine turns."""
    bench = drive(observer)
    bench.forced(rpm, 2.0, 1.0)
    assert bench.faults == 0
    return bench


def loaded(rpm, torque, observer=2):
    """The drive at a speed against a torque."""
    bench = drive(observer)
    bench.spin(rpm, 0.75)
    run = bench.spin(rpm, 0.5, torque)
    assert bench.faults == 0
    assert run["omega_m"][-4000:].mean() == pytest.approx(rpm * RPM, rel=0.25)
    return bench


BROKEN = product((0, 1, 2), (50, 100, -100, 500, 1500), (1, 2, 4))


@pytest.mark.parametrize(("observer", "rpm", "wires"), sampled("broken", BROKEN, 15, campaign="protection"))
def test_a_broken_wire_trips_within_a_second(observer, rpm, wires):
    for bench in (forced(rpm, observer), loaded(rpm, 0.05 if rpm == 50 else 0.2, observer)):
        bench.set_load_param("hall_open", wires)
        bench.advance(16_000)
        assert bench.faults == Fault.HALL
        assert not bench.outputs_on


def test_a_mended_wire_lets_the_drive_run_again():
    bench = forced(500)
    bench.set_load_param("hall_open", 4)
    bench.advance(3_200)
    assert bench.faults == Fault.HALL
    bench.enter_state(DriveState.FAULT)
    bench.set_load_param("hall_open", 0)
    bench.advance(10)
    assert bench.fault_causes == 0
    bench.clear_faults()
    bench.enable()
    bench.set_load_param("hall_glitch", 1100.0)
    bench.advance(320)  # what was believed broken gets a full credit of trust again
    assert bench.faults == 0


@pytest.mark.parametrize("observer", [1, 2])
@pytest.mark.parametrize("rpm", [0, 100, 1000])
def test_a_burst_of_twenty_false_pulses_in_twenty_milliseconds_trips_nothing(rpm, observer):
    bench = forced(rpm, observer)
    bursts = 0
    for _ in range(20):
        bench.set_load_param("hall_glitch", 1100.0)
        bursts += len(bench.advance(320).edges) >= 2 * 20
        bench.set_load_param("hall_glitch", 0.0)
        bench.advance(16_000)
        assert bench.faults == 0
    assert bursts >= 10


EXCHANGED = product((1, 2), (100, -300, 1000), (1, 2, 3))


@pytest.mark.parametrize(("observer", "rpm", "swap"), sampled("exchanged", EXCHANGED, 6, campaign="protection"))
def test_exchanged_wires_on_a_shaft_turned_from_outside_trip_within_a_second(observer, rpm, swap):
    bench = forced(rpm, observer)
    bench.set_load_param("hall_swap", swap)
    bench.advance(16_000)
    assert bench.faults == Fault.HALL


def watched(bench, periods):
    """Advance in pieces; the greatest doubt and angle against the Hall sensors."""
    doubt, opposed = 0.0, 0.0
    for _ in range(periods // 80):
        bench.advance(80)
        state = bench._state.array[0]["firmware"]["protection"]
        doubt, opposed = max(doubt, state["doubt"]), max(opposed, state["opposed"])
    assert bench.faults == 0
    return doubt, opposed


WRONG = product((0, 1, 2), (0.8, 1.0, 1.2))


@pytest.mark.parametrize(("observer", "error"), sampled("wrong", WRONG, 3, campaign="protection"))
def test_normal_running_raises_no_doubt(observer, error):
    """Random speeds, reversals, load steps and coasting, with the firmware's R, L and psi wrong by up to 20 %."""
    bench = drive(
        observer,
        **{
            "firmware.R_s_hat": 0.158 * error,
            "firmware.L_s_hat": 0.176e-3 * error,
            "firmware.psi_f_hat": 6.55e-3 * error,
            "load.alpha_m_max": 2e4,
        },
    )
    rng = np.random.default_rng(observer)
    worst = 0.0
    for _ in range(60):
        speed = rng.choice([0, 5, 50, 200, 1000, 3000]) * rng.choice([-1, 1]) * RPM
        what = rng.integers(4)
        if what < 2:
            bench.setpoint(SetpointMode.SPEED, speed)
        elif what == 2:
            bench.load_setpoint(SetpointMode.TORQUE, rng.uniform(-0.4, 0.4))
        else:
            bench.load_setpoint(SetpointMode.SPEED, speed)
        doubt, opposed = watched(bench, 80 * int(rng.integers(1, 60)))
        assert doubt == 0.0
        worst = max(worst, opposed)
    assert worst < 0.5 * 2 * np.pi  # of 6 turns


def test_jitter_at_an_edge_raises_no_doubt_at_standstill():
    bench = drive(**{"mechanics.theta_0_deg": 62.2, "hall.hysteresis_deg": 0.0, "hall.jitter_deg": 0.15})
    bench.setpoint(SetpointMode.CURRENT, 0.0)
    edges = 0
    for k in range(100):
        bench.load_setpoint(SetpointMode.SPEED, (-1) ** k * 1.0)
        edges += len(bench.advance(80).edges)
        assert bench._state.array[0]["firmware"]["protection"]["doubt"] == 0.0
    assert edges > 50
    assert bench.faults == 0
