"""The compiled tick: records, edges, time relations, and that it computes what its source says."""

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rig import Rig, loop_records, physical
from scipy.signal import lfilter

from protocol.messages import DriveState, SetpointMode
from protocol.signals import AngleSource, Status
from sim.drive.tick_record import angle, clipped, edge_codes, quantised

IDEAL = {
    "hall.hysteresis_deg": 0.0,
    "hall.jitter_deg": 0.0,
    "inverter.dead_time": 0.0,
    "firmware.dead_time.dead_time_hat": 0.0,
    "current_sensor.noise_rms": 0.0,
    "current_sensor.bits": 24,
    "load.alpha_m_max": 0.0,
    "mechanics.theta_0_deg": 30.0,
}
TABLE_I = (-1.2, -3.0, 7.2, -3.3, 0.6, 5.6)
CODES = [0b001, 0b011, 0b010, 0b110, 0b100, 0b101]


def forced(bench, omega_m, i_q=None):
    """Load machine at `omega_m`; the drive at `i_q`, or off."""
    bench.load(SetpointMode.SPEED, omega_m)
    if i_q is not None:
        bench.enable()
        bench.setpoint(SetpointMode.CURRENT, i_q)
    return bench


def test_raw_values_round_half_to_even_wrap_and_saturate():
    assert [clipped(x) for x in (0.5, 1.5, -0.5, -2.5, 40000.0, -40000.0)] == [0, 2, 0, -2, 32767, -32768]
    assert [angle(x) for x in (0.0, math.pi / 2, math.pi, -math.pi, 3 * math.pi, 1e6 * 2 * math.pi)] == [
        0, 16384, -32768, -32768, -32768, 0,
    ]  # fmt: skip
    assert quantised(1.0004, 1 / 1024, 1024.0) == 1.0
    assert quantised(99.0, 1 / 1024, 1024.0) == 32767 / 1024
    assert quantised(99.003, 1 / 256, 256.0) == 99.00390625
    assert edge_codes(0b001, 0b011) == 0b001 | 0b011 << 3
    for old, new in ((0b001, 0b010), (0b001, 0b111), (0b101, 0b000)):
        assert edge_codes(old, new) == old | new << 3 | 0x40


def test_edges_come_where_and_when_the_rotor_passes_them():
    """Forced speed from standstill at once: the angle is known in closed form, so is every edge to a tick."""
    omega_m, n = 40.0, 1600
    for sign in (1, -1):
        bench = forced(Rig(**IDEAL), sign * omega_m)
        recorded = bench.advance(n)
        rate = sign * 6 * omega_m  # electrical rad/s; the first step of 1/16000 s is the jump to it
        lost = 0.5 / 16000.0
        expected = []
        for number in range(-200, 200):
            edge = math.radians(60.0 * number - TABLE_I[number % 6])
            t = (edge - math.radians(30.0)) / rate + lost
            if 0.0 < t <= (n - 1) / 16000.0:
                new = number if sign > 0 else number - 1
                expected.append((t * 20e6, CODES[(new - sign) % 6], CODES[new % 6], edge))
        expected.sort()
        assert len(recorded.edges) == len(expected) > 20
        for record, tick, (exact, old, new, edge) in zip(recorded.edges, recorded.edge_tick, expected, strict=True):
            assert 0.0 <= tick - exact <= 1.0 + 1e-3
            assert record["tick"] == tick
            assert record["codes"] == old | new << 3
            assert (edge / 6 / (2 * math.pi) * 14400 - record["encoder"] + 7200) % 14400 - 7200 == pytest.approx(
                0.5, abs=0.501
            )


def test_an_edge_belongs_to_the_sample_that_shows_its_code():
    recorded = forced(Rig(), 200.0).advance(4000)
    ticks = recorded.tick + 1250 * np.arange(4000)
    last = np.searchsorted(recorded.edge_tick, ticks, side="right") - 1
    seen = last >= 0
    codes = recorded.edges["codes"] >> 3 & 7
    assert np.array_equal(codes[last[seen]], recorded.samples["hall"][seen])
    assert np.all(np.diff(recorded.edge_tick) > 0)
    assert set(recorded.samples["hall"][~seen]) == {CODES[0]}


def test_hysteresis_and_jitter_move_the_edges():
    def means(sign, **overrides):
        recorded = forced(Rig(**{**IDEAL, **overrides}), sign * 50.0).advance(32000)
        angles = recorded.edge_tick / 20e6 * 300.0 - 300.0 * 0.5 / 16000.0
        at = np.degrees(sign * angles) + 30.0
        codes = recorded.edges["codes"] >> 3 & 7
        new = np.array([CODES.index(code) for code in codes])
        number = new if sign > 0 else new + 1
        nominal = 60.0 * number - np.array(TABLE_I)[number % 6]
        return (at - nominal + 180.0) % 360.0 - 180.0

    forwards, backwards = means(1, **{"hall.hysteresis_deg": 2.0}), means(-1, **{"hall.hysteresis_deg": 2.0})
    assert np.abs(forwards - 1.0).max() < 1e-3
    assert np.abs(backwards + 1.0).max() < 1e-3
    jittered = means(1, **{"hall.jitter_deg": 0.3})
    assert jittered.std() == pytest.approx(0.3, rel=0.1)
    assert abs(jittered.mean()) < 0.05


def test_a_voltage_pairs_with_the_currents_of_the_period_that_ends_at_its_sample():
    """Held rotor, ideal inverter: L di/dt = u - R i must close for (u_k, i_k, i_{k-1}), and for no other shift."""
    bench = forced(Rig(**IDEAL), 0.0, 0.0)
    bench.set_param("observer", 0)
    bench.advance(100)
    bench.setpoint(SetpointMode.CURRENT, 6.0)
    recorded = bench.advance(40)
    axes = np.exp(2j * np.pi / 3 * np.arange(3))
    i = 2 / 3 * (axes @ [physical(recorded, f"i_{phase}") for phase in "abc"])
    u = physical(recorded, "u_alpha") + 1j * physical(recorded, "u_beta")

    def residual(shift):
        predicted = i[2:-2] + (np.roll(u, -shift)[3:-1] - 0.158 * (i[2:-2] + i[3:-1]) / 2) / (176e-6 * 16000)
        return np.abs(predicted - i[3:-1]).max()

    assert np.abs(i[-1]) == pytest.approx(6.0, abs=0.05)
    assert residual(0) < 3e-3
    assert residual(1) > 0.5
    assert residual(-1) > 0.5


def test_references_are_those_that_the_recorded_voltage_answers():
    """A step of the reference shows in i_q_ref one sample later, in u and in the current two later."""
    bench = forced(Rig(**IDEAL), 0.0, 0.0)
    bench.advance(100)
    bench.setpoint(SetpointMode.CURRENT, 6.0)
    recorded = bench.advance(10)
    u = np.hypot(physical(recorded, "u_alpha"), physical(recorded, "u_beta"))
    i = np.hypot(physical(recorded, "i_d"), physical(recorded, "i_q"))
    assert np.flatnonzero(physical(recorded, "i_q_ref") > 5.9)[0] == 1
    assert np.flatnonzero(u > 1.0)[0] == 2
    assert np.flatnonzero(i > 0.5)[0] == 2
    assert i[1] < 0.05


@pytest.mark.parametrize(("source", "name"), [(AngleSource.AVERAGE_SPEED, "avg"), (AngleSource.VECTOR_TRACKING, "vt")])
def test_the_current_loop_feeds_a_filtered_speed_forward(source, name):
    """The voltage by the loop's equations from what was recorded, the average speed behind the filter of Fig. 4."""
    bench = forced(Rig(**IDEAL | {"firmware.observer": int(source)}), 1000 * math.pi / 30, 4.0)
    bench.advance(8000)
    recorded = bench.advance(4000)
    theta, omega = recorded[f"theta_{name}"], recorded[f"omega_{name}"]
    assert (omega.std() > 70.0) == (name == "avg")
    if name == "avg":
        share = 1.0 - math.exp(-2.0 * math.pi * 50.0 / 16000.0)
        omega = lfilter([share], [1.0, share - 1.0], omega, zi=[(1.0 - share) * omega.mean()])[0]
    alpha, R_s, L_s, psi_f = 2.0 * math.pi * 800.0, 0.158, 0.176e-3, 6.55e-3
    i = recorded["i_d"] + 1j * recorded["i_q"]
    error = 4j - i
    known = alpha * L_s * error + alpha * R_s / 16000.0 * np.cumsum(error) + 1j * omega * (L_s * i + psi_f)
    u = (recorded["u_alpha"] + 1j * recorded["u_beta"])[2:]  # computed two samples before
    seen = u * np.exp(-1j * (theta + 1.5 / 16000.0 * omega))[:-2]
    left = (seen - known[:-2])[800:]  # but for what the integrator had before
    assert np.abs(left - left.mean()).max() < 5e-3


def test_the_speed_loop_takes_the_average_speed_as_it_is():
    bench = Rig(**IDEAL | {"firmware.observer": int(AngleSource.AVERAGE_SPEED)})
    bench.enable()
    bench.setpoint(SetpointMode.SPEED, 50.0)
    bench.advance(16000)
    recorded = bench.advance(4000)
    stepped = np.diff(recorded["omega_avg"])
    asked = np.diff(recorded["i_q_ref"])[1:]  # in force a sample later
    edges = np.flatnonzero(np.abs(stepped[:-1]) > 5.0)
    assert len(edges) > 20
    assert asked[edges] == pytest.approx(-0.2 * stepped[edges] / 6.0, abs=0.02)


def test_noise_offset_and_steps_of_the_current_sensors_are_recorded():
    recorded = forced(Rig(**{"current_sensor.offset": [0.1, 0.0, -0.2]}), 0.0).advance(8000)
    for phase, offset in (("a", 0.1), ("b", 0.0), ("c", -0.2)):
        i = physical(recorded, f"i_{phase}")
        assert i.mean() == pytest.approx(offset, abs=2e-3)
        assert i.std() == pytest.approx(math.hypot(0.02, 20 / 2048 / math.sqrt(12)), rel=0.05)
        assert set(recorded.samples[f"i_{phase}"] % 10) == {0}  # 20 A / 2048 is ten counts


def test_torques_balance_on_the_shaft():
    bench = forced(Rig(**IDEAL), 60.0, 5.0)
    bench.set_param("observer", 0)
    recorded = bench.advance(3000)
    tau_e, tau_load = physical(recorded, "tau_e_true")[-1000:], physical(recorded, "tau_load_true")[-1000:]
    assert tau_e.mean() == pytest.approx(1.5 * 6 * 6.55e-3 * 5.0, abs=1e-3)
    assert (tau_e - tau_load).mean() == pytest.approx(5e-3 + 1e-4 * 60.0, abs=2e-4)
    assert recorded.load_samples["omega_m"][-1] == np.float32(60.0)
    assert recorded.load_samples["tau_load"][-1] == pytest.approx(tau_load[-1], abs=1e-4)
    assert recorded.load_samples["status"][-1] == DriveState.RUNNING


def test_first_sample_is_the_boot():
    recorded = Rig().advance(2)
    assert recorded.index == 0
    assert recorded.samples["status"][0] & Status.OBSERVERS_RESET
    assert not recorded.samples["status"][1] & Status.OBSERVERS_RESET
    error = physical(recorded, "theta_true") - physical(recorded, "theta_vt")
    assert np.degrees(error) == pytest.approx([30.0, 30.0], abs=0.01)  # the largest that Hall sensors leave
    assert list(recorded.samples["hall"]) == [CODES[0]] * 2


def played():
    """All that is recorded of a usual drive and of one with everything that it can have, and a moment with the outputs
    off."""
    injection = {"firmware.injection.inject": 2, "firmware.injection.inject_hz": 500}
    faults = {"hall.rise_delay": [2e-4] * 3, "hall.bounce": [0.5] * 3, "hall.pulse_rate": [9e2] * 3, "hall.pulse_by": 1,
              "hall.contact_open": [0.3] * 3, "encoder.lost_per_rev": 99.0, "begin": 0.004}  # fmt: skip
    faults = {f"faults.{key}": value for key, value in faults.items()}
    full = {"motor.L_q": 2e-4, "wiring.hall_glitch": 2000, "wiring.hall_swap": 3, **injection, **faults}
    found = []
    for bench in (Rig(5, **full), Rig(5)):
        bench.load(SetpointMode.SPEED, 300.0)
        bench.enable()
        bench.setpoint(SetpointMode.CURRENT, 4.0)
        one = bench.advance(200)
        bench.enable(False)
        records = one, bench.advance(30)
        found += [getattr(r, what).tobytes().hex() for r in records for what in ("samples", "edges", "load_samples")]
        found += [column.hex() for column in loop_records(records)]
    return found + [column.hex() for column in loop_records(commissioned())]


def commissioned():
    """What is recorded of a drive with each of the means of commissioning."""
    bench = Rig(5, **{"firmware.observer": 0, "firmware.encoder_zero": 0.5, "firmware.encoder_reverse": 1})
    bench.waveform[:3] = 32767, -9, 12000
    bench.load(SetpointMode.SPEED, 30.0)
    bench.enable()
    bench.set_param("encoder_reverse", 0.0)
    parts = []
    for parameters, setpoint in (
        ({"test_voltage": 0.5, "test_periods": 3, "test": 1}, (SetpointMode.VOLTAGE, 1.0, 0.3)),
        ({"forced_slope": 5e4, "forced_speed": 90.0, "forced": 1}, (SetpointMode.CURRENT, 2.0, -1.0)),
        ({"test": 0, "test_current": 9.0, "test_length": 3}, (SetpointMode.CURRENT, 7.0, 1.0)),
        ({"forced_speed": 0.0, "forced_angle": -1.0, "test": 4}, (SetpointMode.VOLTAGE, 0.5, -0.5)),
        ({"forced": 0, "test": 0, "test_speed": 4.0}, (SetpointMode.SPEED, 20.0, 2.0)),
        ({"test": 5}, (SetpointMode.SPEED, 25.0, 0.0)),
    ):
        for name, value in parameters.items():
            bench.set_param(name, value)
        bench.setpoint(*setpoint)
        parts.append(bench.advance(40))
    assert bench.faults == 0
    return parts


@pytest.mark.slow
def test_compiled_and_plain_python_agree_bit_for_bit():
    here = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    env = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": here}
    code = "import json, test_tick; print(json.dumps(test_tick.played()))"
    plain = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=False)
    assert plain.returncode == 0, plain.stderr
    assert json.loads(plain.stdout) == played()
    assert len(played()[1]) > 0  # there were edges
