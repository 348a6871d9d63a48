"""The firmware's watch over its Hall sensors: what trips it, how soon, and all that must not."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from rig import RPM, Rig

from protocol.messages import DriveState, Fault, SetpointMode
from sim.config.params import load_params
from sim.drive import tick_protection as protection
from tests.choice import sampled
from tests.sim.observers.lost import bench_of, drawn, operated

pytestmark = pytest.mark.slow

BENCH = load_params()
PARAMS = protection.make_params(16000.0, BENCH.drive_parameters(), True, BENCH.firmware.protection)
QUIET = protection.Sensed(0.0, 0.0, 24.0, 1, 0, 0, 0.0, 0.0, 0.0, 0.0)


def tripped(samples, on=False):
    """Number of the sample with which HALL has a cause, None if there is none."""
    state = protection.init()
    for number, sensed in enumerate(samples, 1):
        state = protection.step(PARAMS, state, sensed, on, True)
        if state.causes:
            assert state.causes == Fault.HALL
            return number
    return None


PSI, R, L = 6.55e-3, 0.158, 0.176e-3  # what the firmware takes them for: V s, ohm, H


def seen(theta, current=None, psi=PSI, R=R, L=L, way=1):
    """What a motor with these values shows at the rotor's angles and currents (n,); `way` -1: wires exchanged."""
    i = np.zeros(len(theta), complex) if current is None else current
    flux = psi * np.exp(1j * theta) + L * i
    u = np.diff(flux) * 16000.0 + R * 0.5 * (i[1:] + i[:-1])
    sectors = np.floor(way * theta / (np.pi / 3)).astype(int) % 6
    return [
        QUIET._replace(sector=sector, u_alpha=volts.real, u_beta=volts.imag, i_alpha=amps.real, i_beta=amps.imag)
        for sector, volts, amps in zip(sectors[1:].tolist(), u.tolist(), i[1:].tolist(), strict=True)
    ]


def steady(omega, seconds):
    return 0.01 + omega / 16000.0 * np.arange(round(16000 * seconds))


def test_the_noise_of_differentiated_currents_turns_no_way():
    """A back-EMF at its threshold under 12 mA of noise."""
    rng, slow = np.random.default_rng(1), 60.0
    noise = rng.normal(0.0, 0.012, 32_000) + 1j * rng.normal(0.0, 0.012, 32_000)
    theta = steady(slow, 2.0)
    noisy = [
        sensed._replace(i_alpha=amps.real, i_beta=amps.imag)
        for sensed, amps in zip(seen(theta), noise[1:].tolist(), strict=True)
    ]
    assert tripped(noisy, on=True) is None
    against = [s._replace(sector=5 - s.sector) for s in noisy]
    assert tripped(against, on=True) == pytest.approx(6 * 2 * np.pi / slow * 16000, rel=0.05)


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
    for way in (1, -1):
        samples = seen(steady(300.0, 0.5), psi=1e-4, way=way)
        samples[1000::1600] = [it._replace(u_alpha=-40.0, u_beta=40.0) for it in samples[1000::1600]]
        assert tripped(samples, on=True) is None


@pytest.mark.parametrize("omega", [300.0, -300.0, 60.0, 2500.0])
def test_a_back_emf_against_the_hall_sensors_trips_after_its_turns(omega):
    theta, turn = steady(omega, 50.0 / abs(omega)), 2 * np.pi / abs(omega) * 16000
    assert tripped(seen(theta, way=-1), on=True) == pytest.approx(6 * turn, abs=4)
    assert tripped(seen(theta), on=True) is None
    assert tripped(seen(theta, way=-1), on=False) is None
    assert tripped(seen(theta, psi=0.9 * 0.3 / abs(omega), way=-1), on=True) is None  # too little to look at


def test_a_flux_linkage_that_is_told_wrongly_by_root_3_hides_no_exchanged_wires():
    for told in (1 / 1.73, 1.73):
        assert tripped(seen(steady(300.0, 0.5), psi=PSI / told, way=-1), on=True) is not None


def test_a_rotor_that_reverses_on_healthy_sensors_opposes_nothing():
    theta = steady(300.0, 0.1)
    assert tripped(seen(np.concatenate([theta, theta[::-1]] * 6)), on=True) is None


def wandering(rng, samples):
    """A current that turns as it likes, no more than a control brings about."""
    pace = rng.normal(0.0, rng.choice([5.0, 100.0, 1000.0]), 4)
    size = rng.uniform(0.0, rng.choice([0.5, 8.0]), 4)
    t = np.arange(samples) / 16000.0
    return (size[:, None] * np.exp(1j * (pace[:, None] * t + rng.uniform(0.0, 6.28, (4, 1))))).sum(axis=0)


@pytest.mark.parametrize("seed", range(30))
def test_no_current_whatsoever_opposes_healthy_sensors_if_r_and_l_are_wrong_by_two(seed):
    """Shafts that turn, stand, reverse, unevenly; currents that turn with them, against them, or on their own."""
    rng = np.random.default_rng(seed)
    samples = 24_000
    pace = np.interp(np.arange(samples), np.linspace(0, samples, 9), rng.choice([0.0, 3.0, 40.0, 300.0, -300.0], 9))
    theta = np.cumsum(pace) / 16000.0
    i = wandering(rng, samples)
    i += rng.uniform(-8.0, 8.0) * np.exp(1j * rng.choice([-1.0, 1.0]) * theta)
    R_s, L_s = R * rng.choice([0.5, 1.0, 2.0]), L * rng.choice([0.5, 1.0, 2.0])
    psi = PSI * rng.choice([0.58, 1.0, 1.73])
    assert tripped(seen(theta, i, psi, R_s, L_s), on=True) is None


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
def test_a_broken_wire_trips_within_a_second_if_the_control_uses_it(observer, rpm, wires):
    for bench in (forced(rpm, observer), loaded(rpm, 0.05 if rpm == 50 else 0.2, observer)):
        bench.set_load_param("hall_open", wires)
        bench.advance(16_000)
        assert bench.faults == (Fault.HALL if observer else 0)
        assert bench.outputs_on == (not observer)


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
    """Advance in pieces; the greatest doubt, and turns against the Hall sensors."""
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
        assert doubt == opposed == 0.0


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


FARTHEST = {"R_s_hat": (0.5, 1, 2), "L_s_hat": (0.5, 1, 2), "psi_f_hat": (0.58, 1, 1.73), "dead_time_hat": (0, 1, 2)}
SOURCES = ("edge_kalman", "vector_tracking", "load_angle", "average_speed", "lookup_table", "sector_centre")
HEALTHY = product(range(1000, 1200), SOURCES)


@pytest.mark.parametrize(("seed", "observer"), sampled("healthy", HEALTHY, 24, campaign="protection"))
def test_wrong_parameters_trip_no_healthy_sensors(seed, observer):
    """Motors, benches and operations as drawn; the control on the observer's angle, whether that is lost or not."""
    draw = np.random.default_rng(seed)
    factors = {name: float(draw.choice(values)) for name, values in FARTHEST.items()}
    case = replace(drawn(seed), factors=factors)
    bench = bench_of(case, observer)
    operated(bench, case)
    assert not bench.faults & Fault.HALL, case


@pytest.mark.parametrize("way", [1, -1])
@pytest.mark.parametrize("swap", [1, 2, 3])
@pytest.mark.parametrize("observer", ["average_speed", "vector_tracking"])
def test_wrong_parameters_hide_no_exchanged_wires(observer, way, swap):
    factors = {"R_s_hat": 2.0, "L_s_hat": 2.0, "psi_f_hat": 1.73, "dead_time_hat": 0.0}
    case = replace(drawn(swap), motor="", kind=True, factors=factors)
    bench = bench_of(case, observer)
    bench.forced(way * bench.top / 3.0, 0.3 * bench.i_max, 0.5)
    assert bench.faults == 0
    bench.set_load_param("hall_swap", swap)
    bench.run(12.0 * 60.0 / (bench.top / 3.0) / bench.params.motor.n_p)
    assert bench.faults == Fault.HALL
