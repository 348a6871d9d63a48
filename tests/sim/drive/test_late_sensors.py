"""Sensors that answer late: Hall edges and current samples, beside the same drive without delay."""

import numpy as np
import pytest

from tests.sim.drive.rig import Rig

TICK_HZ = 20_000_000
QUIET = {"hall.jitter_deg": 0.0, "current_sensor.noise_rms": 0.0, "current_sensor.bits": 20}


def prompt_and_late(key, seconds, *run):
    """Two benches alike, but for a delay of the second, and what each records of a forced run."""
    rigs = [Rig(3, **QUIET, **{key: t}) for t in (0.0, seconds)]
    return rigs[0].params, *([*rig.start(), rig.forced(*run)][-1] for rig in rigs)


def later_counts(a, b, n):
    """Encoder counts that the last n edges of `b` were latched after those of `a`, mean."""
    moved = b.edges["encoder"][-n:].astype(int) - a.edges["encoder"][-n:].astype(int)
    return np.mean((moved + 7200) % 14_400 - 7200)


@pytest.mark.parametrize("rpm", [300.0, -1500.0])
def test_hall_edges_come_late_by_the_latency_and_the_encoder_is_latched_then(rpm):
    latency = 50e-6
    _, a, b = prompt_and_late("hall.latency", latency, rpm, 0.0, 0.6)
    n = min(len(a.edges), len(b.edges)) - 20
    ticks = a.edge_tick[-n:] - b.edge_tick[-n:]
    assert n > 50
    assert len(a.edges) == len(b.edges)
    np.testing.assert_allclose(-ticks, latency * TICK_HZ, atol=1.01)
    assert later_counts(a, b, n) == pytest.approx(14_400 * rpm / 60.0 * latency, abs=0.5)


def test_a_late_converter_sees_the_current_fall_in_the_low_state():
    delay, rpm, i_q = 2e-6, 1000.0, 0.0
    params, *records = prompt_and_late("current_sensor.delay", delay, rpm, i_q, 0.5)
    motor = params.motor
    tail = slice(-2000, None)
    for record, seconds in zip(records, (0.0, delay), strict=True):
        theta, omega = record["theta_true"][tail], record["omega_true"][tail]
        emf = omega * motor.psi_f * np.exp(1j * (theta + 0.5 * np.pi))
        true = record["i_alpha_true"][tail] + 1j * record["i_beta_true"][tail]
        axes = np.exp(2j * np.pi / 3 * np.arange(3))
        measured = (
            2.0 / 3.0 * sum(record[name][tail] * axis for name, axis in zip(("i_a", "i_b", "i_c"), axes, strict=True))
        )
        gain = 1.0 + np.mean(params.current_sensor.gain_error)
        expected = true - seconds / motor.L_d * (motor.R_s * true + emf)
        offset = np.mean(measured - expected)
        assert np.abs(measured - expected - offset).max() < 0.01 + abs(gain - 1.0) * np.abs(true).max(), seconds
    assert np.abs(emf).max() * delay / motor.L_d > 0.04


@pytest.mark.parametrize("rpm", [300.0, -1500.0])
def test_a_late_encoder_shows_where_the_rotor_was(rpm):
    """At samples and at edges, its speed as it is; nothing else changes in a drive that runs on its Hall sensors."""
    latency = 200e-6
    _, a, b = prompt_and_late("encoder.latency", latency, rpm, 2.0, 0.6)
    turned = 14_400 * rpm / 60.0 * latency  # counts
    lag = (a["theta_enc"] - b["theta_enc"])[-4000:] * 14_400 / (2.0 * np.pi * 6)
    assert np.mean((lag + 7200) % 14_400 - 7200) == pytest.approx(turned, abs=0.15)
    assert -later_counts(a, b, 100) == pytest.approx(turned, abs=0.5)
    assert b["omega_enc"][-1600:].mean() == pytest.approx(rpm / 60.0 * 2.0 * np.pi * 6, rel=1e-3)
    for name in ("theta_true", "theta_avg", "theta_vt", "i_a"):
        assert np.array_equal(a[name], b[name]), name
