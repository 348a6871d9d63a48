"""A drive without a link measures what it did: its figures against its own plant's state, taken another way."""

from __future__ import annotations

import numpy as np
import pytest

from protocol.messages import DriveState, SetpointMode
from sim.config.params import load_params
from sim.drive.machine import SimulatedBench
from sim.ports.direct import ConfigError, Course, Driven, measured_by, nominal, with_values

COURSE = Course((300.0, -800.0), 0.1, 0.6, 0.2, "vector_tracking", ("vector_tracking", "edge_kalman"))


def test_its_figures_are_those_of_the_same_drive_run_as_a_whole() -> None:
    params = load_params(None, {"hall.delta_deg": [3.0, -2.0, 1.0, 0.0, -3.0, 2.0]})
    found = Driven(params, 5, COURSE).measure()
    bench = SimulatedBench(params, 5)
    bench.set_param("observer", 2)
    bench.watch(frozenset({"theta_vt", "theta_ek"}))
    for state in (DriveState.ARMED, DriveState.RUNNING):
        bench.enter_state(state)
        bench.load_enter_state(state)
        bench.advance(1)
    bench.load_setpoint(SetpointMode.TORQUE, 0.1)
    parts = []
    for rpm in COURSE.speeds:
        bench.setpoint(SetpointMode.SPEED, rpm * 2 * np.pi / 60)
        parts.append((bench.advance(9600), rpm))
    angles = {"control": "theta_vt", "vector_tracking": "theta_vt", "edge_kalman": "theta_ek"}
    for name, channel in angles.items():
        off = np.concatenate([(r["theta_true"] - r[channel])[3200:] for r, _ in parts])
        error = np.degrees(np.angle(np.exp(1j * off)))
        wanted = error.mean(), error.std(), np.sqrt((error**2).mean()), np.abs(error).max()
        got = [found[f"{name}.{of}"] for of in ("mean", "std", "rms", "max")]
        assert got == pytest.approx(wanted, rel=1e-9, abs=1e-9)
    speed = np.concatenate([(r["omega_m"] * 60 / (2 * np.pi) - rpm)[3200:] for r, rpm in parts])
    assert [found["speed.mean"], found["speed.std"]] == pytest.approx([speed.mean(), speed.std()], rel=1e-9)
    current = np.concatenate([np.hypot(r["i_alpha_true"], r["i_beta_true"])[3200:] for r, _ in parts])
    assert found["current.max"] == pytest.approx(current.max())
    assert found["current.rms"] == pytest.approx(np.sqrt((current**2).mean()))
    assert found["tripped"] == 0.0
    assert found.keys() == measured_by(COURSE).keys()


@pytest.mark.parametrize(("observer", "channel"), [(0, "theta_enc"), (1, "theta_avg"), (5, "theta_lut")])
def test_the_angle_in_control_is_measured(observer: int, channel: str) -> None:
    params = load_params(None, {"firmware.observer": observer, "encoder.offset_deg": 3.0})
    driven, seen = Driven(params, 1, COURSE._replace(control="", speeds=(500.0,), observers=())), []
    driven.watch = seen.append
    found = driven.measure()
    off = np.concatenate([part["theta_true"] - part[channel] for part in seen])[2 + 3200 :]
    assert found["control.mean"] == pytest.approx(np.degrees(np.angle(np.exp(1j * off))).mean())
    if not observer:
        assert found["control.mean"] == pytest.approx(-3.0, abs=0.2)


def test_the_same_seed_gives_the_same_bits_and_another_one_others() -> None:
    params = load_params()
    assert Driven(params, 1, COURSE).measure() == Driven(params, 1, COURSE).measure()
    assert Driven(params, 1, COURSE).measure() != Driven(params, 2, COURSE).measure()


def test_a_drive_that_trips_measures_nothing_else() -> None:
    params = load_params(None, {"firmware.protection.i_trip": 1.0})
    driven = Driven(params, 1, COURSE._replace(load=0.3))
    assert driven.measure() == {"tripped": 1.0}
    assert driven.fault == "OVERCURRENT"


def test_a_drive_with_other_figures_keeps_all_others() -> None:
    figures = nominal(None, {"motor.R_s": 0.3})
    params = with_values(figures, {"motor.psi_f": 0.01, "hall.delta_deg": [1.0] * 6})
    assert (params.motor.R_s, params.motor.psi_f, params.firmware.R_s_hat) == (0.3, 0.01, 0.3)
    assert params.firmware.psi_f_hat == load_params().motor.psi_f
    assert figures["hall"]["delta_deg"] == load_params().hall.delta_deg  # as it was
    with pytest.raises(ConfigError, match="psi_f must be > 0"):
        with_values(figures, {"motor.psi_f": -1.0})


@pytest.mark.parametrize(
    ("course", "words"),
    [
        (COURSE._replace(speeds=(4000.0,)), r"speed 4000 r/min is above"),
        (COURSE._replace(load=9.0), r"load 9 N m is above load.tau_max"),
    ],
)
def test_what_its_firmware_would_refuse_is_refused(course: Course, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        Driven(load_params(), 1, course)
