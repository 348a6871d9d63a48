"""The firmware's constants of its encoder, against the plant's own angle."""

import math

import numpy as np
import pytest
from rig import RPM, Rig

from protocol.messages import DriveState, Fault, SetpointMode

N_P = 6


def off_by(recorded):
    """theta_enc less the rotor's angle, rad."""
    return np.remainder(recorded["theta_enc"] - recorded["theta_true"] + math.pi, math.tau) - math.pi


def turned(bench, rpm, seconds=0.3):
    """The shaft turned from outside, outputs off."""
    bench.load(SetpointMode.SPEED, rpm * RPM)
    bench.run(0.3)
    return bench.run(seconds)


@pytest.mark.parametrize("seed", range(10))
def test_the_constants_that_are_true_make_a_true_angle_of_any_encoder(seed):
    rng = np.random.default_rng(seed)
    lines, reverse, zero = int(rng.integers(200, 10_000)), seed % 2, rng.uniform(-math.pi, math.pi)
    bench = Rig(1, **{
        "encoder.pulses_per_rev": lines, "encoder.offset_deg": -math.degrees(zero), "faults.encoder.reversed": reverse,
        "firmware.encoder_lines": 3600, "load.alpha_m_max": 0.0,
    })  # fmt: skip
    bench.advance(10)
    for name, value in (("lines", lines), ("reverse", reverse), ("zero", zero)):
        bench.set_param(f"encoder_{name}", value)
    rpm = rng.uniform(100.0, 2000.0) * rng.choice([-1.0, 1.0])
    recorded = turned(bench, rpm)
    count = math.tau * N_P / (4 * lines)
    assert np.abs(off_by(recorded)).max() < 0.51 * count + 1e-6
    assert recorded["omega_enc"].mean() == pytest.approx(rpm * RPM * N_P, rel=1e-3)


@pytest.mark.parametrize("zero", [0.0, 1.0, -2.5])
@pytest.mark.parametrize("reverse", [0, 1])
def test_constants_that_are_wrong_are_wrong_as_the_formula_says(reverse, zero):
    lines = 5000
    bench = Rig(1, **{"mechanics.theta_0_deg": 10.0, "load.alpha_m_max": 0.0})
    for name, value in (("lines", lines), ("reverse", reverse), ("zero", zero)):
        bench.set_param(f"encoder_{name}", value)
    bench.load(SetpointMode.SPEED, 300.0 * RPM)
    recorded = bench.run(0.1)
    count = np.floor(recorded["theta_true"] / (math.tau * N_P) * 14_400)  # what 3600 lines show
    assert 0 <= count.min() < count.max() < 14_400
    way = -1.0 if reverse else 1.0
    expected = way * N_P * math.tau * (count + 0.5) / (4 * lines) + float(np.float32(zero))
    assert recorded["theta_enc"] == pytest.approx(expected, abs=1e-9)
    assert recorded["omega_enc"][-400:].mean() == pytest.approx(way * 300.0 * RPM * N_P * 3600 / lines, rel=2e-3)


def test_the_count_at_an_edge_stays_as_it_came():
    def counts(**firmware):
        bench = Rig(1, **{"load.alpha_m_max": 0.0} | {f"firmware.encoder_{k}": v for k, v in firmware.items()})
        return turned(bench, 500.0).edges["encoder"]

    assert len(counts()) > 50
    assert np.array_equal(counts(), counts(reverse=1, zero=1.0))


@pytest.mark.parametrize("rpm", [400.0, -1500.0])
def test_the_control_runs_on_an_encoder_whose_constants_were_found(rpm):
    bench = Rig(1, **{"encoder.offset_deg": 130.0, "faults.encoder.reversed": 1, "firmware.observer": 0})
    bench.set_param("encoder_reverse", 1.0)
    bench.set_param("encoder_zero", math.radians(-130.0))
    bench.start()
    recorded = bench.spin(rpm, 1.0, 0.1)
    assert recorded["omega_m"][-3000:].mean() == pytest.approx(rpm * RPM, rel=0.01)
    assert abs(recorded["i_d"][-3000:].mean()) < 0.05
    assert np.array_equal(recorded["theta_ctrl"], recorded["theta_enc"])


def test_the_speed_does_not_jump_where_the_count_gets_another_length():
    bench = Rig(1, **{"encoder.offset_deg": 100.0})
    bench.advance(100)
    bench.set_param("encoder_lines", 64.0)
    assert np.abs(bench.run(0.2)["omega_enc"]).max() < 1e-9


def test_the_overspeed_trip_goes_by_the_constants():
    for lines, faults in ((3600, 0), (1200, Fault.OVERSPEED)):  # a third of the lines: three times the speed
        bench = Rig(1, **{"load.alpha_m_max": 0.0})
        bench.set_param("encoder_lines", lines)
        bench.load(SetpointMode.SPEED, 200.0)
        bench.run(0.1)
        bench.enter_state(DriveState.ARMED)
        bench.run(0.1)
        assert bench.faults == faults
