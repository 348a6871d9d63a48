"""The test signal: which sample shows what of it, and what the limits leave of it."""

import numpy as np
import pytest
from rig import Rig

from protocol.codes import TestSignal
from protocol.messages import SetpointMode
from protocol.signals import Status

N_P = 6
AMPLITUDE = {"test_voltage": 0.5, "test_current": 2.0, "test_speed": 10.0}
SHOWN = {  # channel that shows it, per unit of the parameter that has the amplitude, and samples until it does
    TestSignal.U_D: ("u_d", "test_voltage", 1.0, 2),
    TestSignal.U_Q: ("u_q", "test_voltage", 1.0, 2),
    TestSignal.I_D: ("i_d_ref", "test_current", 1.0, 1),
    TestSignal.I_Q: ("i_q_ref", "test_current", 1.0, 1),
    TestSignal.SPEED: ("omega_ref", "test_speed", N_P, 0),
}


def made(kind, **settings):
    """A drive on the encoder, at a constant reference; for a voltage, on a rotor that is held at the angle zero."""
    bench = Rig(1, **{"firmware.observer": 0, "mechanics.theta_0_deg": 0.0, "load.alpha_m_max": 0.0} | settings)
    for name, value in AMPLITUDE.items():
        bench.set_param(name, value)
    bench.start()
    if kind == TestSignal.SPEED:
        bench.spin(500.0, 1.0)
    else:
        bench.load_setpoint(SetpointMode.SPEED, 0.0)
        voltage = kind in (TestSignal.U_D, TestSignal.U_Q)
        bench.setpoint(SetpointMode.VOLTAGE if voltage else SetpointMode.CURRENT, 0.0, 0.0)
        bench.run(0.2)
    return bench


def shown(recorded, kind):
    """The channel that shows the signal."""
    name = SHOWN[kind][0]
    if name in ("u_d", "u_q"):  # the rotor is at the angle zero
        return recorded["u_alpha" if name == "u_d" else "u_beta"]
    return recorded[name]


def cycles(recorded):
    """Samples that say that a cycle begins with them."""
    return np.flatnonzero(recorded.samples["status"] & Status.INJECTION_SYNC)


def signal(bench, kind, n, **parameters):
    """Of the n samples from the one at which it is set: what it adds to its channel, and where cycles begin."""
    before = shown(bench.advance(10), kind)[-1]
    for name, value in parameters.items():
        bench.set_param(name, value)
    bench.set_param("test", float(kind))
    recorded = bench.advance(n)
    return shown(recorded, kind) - before, cycles(recorded), recorded


KINDS = [kind for kind in TestSignal if kind]
RESOLUTION = 4.0 / 1024


@pytest.mark.parametrize("kind", KINDS, ids=[kind.name for kind in KINDS])
@pytest.mark.parametrize("periods", [1, 2, 7, 50])
def test_the_square_is_in_step_with_the_pwm_and_the_bit_marks_its_first_sample(kind, periods):
    _, parameter, unit, late = SHOWN[kind]
    added, begins, _ = signal(made(kind), kind, 900, test_periods=periods)
    halves = np.arange(900 - late) // periods
    expected = np.where(halves % 2 == 0, 1.0, -1.0) * AMPLITUDE[parameter] * unit
    assert added[:late] == pytest.approx(np.zeros(late), abs=RESOLUTION)
    assert added[late:] == pytest.approx(expected, abs=RESOLUTION)
    assert list(begins) == list(range(late, 900, 2 * periods))


@pytest.mark.parametrize("kind", KINDS, ids=[kind.name for kind in KINDS])
@pytest.mark.parametrize(("length", "periods"), [(1, 1), (1, 3), (5, 1), (37, 4), (4096, 1)])
def test_the_waveform_is_played_sample_by_sample_and_repeated(kind, length, periods):
    _, parameter, unit, late = SHOWN[kind]
    bench = made(kind)
    rng = np.random.default_rng(length)
    bench.waveform[:] = rng.integers(-32767, 32768, len(bench.waveform))
    n = min(3 * length * periods + 50, 9000)
    added, begins, _ = signal(bench, kind, n, test_periods=periods, test_length=length)
    played = np.tile(np.repeat(bench.waveform[:length] / 32767.0, periods), n)[: n - late]
    assert added[late:] == pytest.approx(played * AMPLITUDE[parameter] * unit, abs=RESOLUTION)
    assert list(begins) == list(range(late, n, length * periods))


def test_it_begins_with_start_if_that_comes_later_and_ends_with_the_outputs():
    bench = made(TestSignal.I_Q)
    bench.enable(False)
    bench.set_param("test_periods", 10.0)
    bench.set_param("test", float(TestSignal.I_Q))
    assert not len(cycles(bench.advance(777)))
    bench.enable()
    recorded = bench.advance(400)
    assert list(cycles(recorded)) == list(range(1, 400, 20))
    assert recorded["i_q_ref"][1:11] == pytest.approx([2.0] * 10)
    bench.enable(False)
    recorded = bench.advance(400)
    assert len(cycles(recorded)) == 0
    assert not recorded["i_q_ref"][1:].any()
    bench.enable()
    assert list(cycles(bench.advance(50))) == [1, 21, 41]


def test_each_test_begins_with_its_first_sample_whatever_went_before():
    bench = made(TestSignal.I_D)
    for n in (3, 11, 28):
        _, begins, _ = signal(bench, TestSignal.I_D, n, test_periods=10)
        assert begins[0] == 1
        bench.set_param("test", 0.0)
        bench.set_param("test", float(TestSignal.I_Q))
        recorded = bench.advance(15)
        assert recorded["i_q_ref"][1:11] == pytest.approx([2.0] * 10)
        assert recorded["i_d_ref"][1:] == pytest.approx(np.zeros(14))
        bench.set_param("test", 0.0)


def test_what_repeats_changes_with_the_next_sample_or_cycle_and_never_in_the_middle():
    bench = made(TestSignal.I_Q)
    bench.waveform[:3] = 32767, 0, -16384
    signal(bench, TestSignal.I_Q, 5, test_periods=10)
    bench.set_param("test_periods", 4.0)
    bench.set_param("test_length", 3.0)
    ref = bench.advance(40)["i_q_ref"]
    expected = [2.0] * 6 + [-2.0] * 4 + [2.0] * 4 + [0.0] * 4 + [-1.0] * 4 + [2.0] * 4
    assert ref[: len(expected)] == pytest.approx(expected, abs=2e-3)


def test_a_current_with_its_test_stays_within_the_largest():
    bench = made(TestSignal.I_Q)
    bench.set_param("i_trip", 100.0)
    bench.setpoint(SetpointMode.CURRENT, 6.0, 4.0)
    bench.set_param("test_current", 5.0)
    for kind, held in ((TestSignal.I_Q, (6.0, 4.0)), (TestSignal.I_D, (4.0, 6.0))):
        bench.set_param("test", float(kind))
        recorded = bench.advance(100)
        tested, other = ("i_q_ref", "i_d_ref") if kind == TestSignal.I_Q else ("i_d_ref", "i_q_ref")
        size = np.hypot(recorded["i_d_ref"], recorded["i_q_ref"])[1:]
        assert size.max() == pytest.approx(8.0, abs=2e-3)
        below = recorded[tested][1:] < 2.0  # the half that makes the vector shorter is whole
        assert recorded[tested][1:][below] == pytest.approx(held[0] - 5.0, abs=2e-3)
        assert recorded[other][1:][below] == pytest.approx(held[1], abs=2e-3)
        bench.set_param("test", 0.0)


def test_a_speed_with_its_test_stays_within_the_largest():
    bench = made(TestSignal.SPEED, **{"firmware.omega_m_max": 100.0})
    bench.setpoint(SetpointMode.SPEED, 97.0)
    bench.run(1.0)
    _, _, recorded = signal(bench, TestSignal.SPEED, 400, test_periods=100)
    assert recorded["omega_ref"].max() == pytest.approx(100.0 * N_P)
    assert recorded["omega_ref"].min() == pytest.approx(87.0 * N_P)


def test_a_voltage_with_its_test_stays_within_what_the_link_gives():
    bench = made(TestSignal.U_Q, **{"firmware.protection.u_test_max": 14.0, "firmware.protection.i_trip": 1000.0})
    bench.setpoint(SetpointMode.VOLTAGE, 10.0, 0.0)
    _, _, recorded = signal(bench, TestSignal.U_Q, 6, test_voltage=9.0, test_periods=5)
    assert np.hypot(recorded["u_alpha"], recorded["u_beta"]).max() == pytest.approx(24.0 / np.sqrt(3.0), abs=2e-3)


def test_a_d_current_beside_a_speed_leaves_the_q_current_what_is_left():
    bench = made(TestSignal.SPEED)
    bench.load_setpoint(SetpointMode.TORQUE, 0.2)
    bench.setpoint(SetpointMode.SPEED, 50.0, -3.0)
    bench.run(1.0)
    recorded = bench.run(0.5)
    assert recorded["omega_m"].mean() == pytest.approx(50.0, rel=2e-3)
    assert recorded["i_d"].mean() == pytest.approx(-3.0, abs=0.02)
    assert recorded["i_q"].mean() == pytest.approx((0.2 + 5e-3 + 50e-4) / (1.5 * N_P * 6.55e-3), rel=0.02)
    bench.setpoint(SetpointMode.SPEED, -300.0, -7.0)
    recorded = bench.run(0.3)
    assert np.hypot(recorded["i_d_ref"], recorded["i_q_ref"]).max() == pytest.approx(8.0, abs=2e-3)
    assert recorded["i_d_ref"][10:] == pytest.approx(-7.0)
