"""What the five classic observers have in common: the same bits in three places, gaps, parameters that are zero."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from ideal_motor import DRIVE, PAPER_EDGES, PWM_HZ, T_S, constant, error_deg, rpm, samples, signals, table, track
from test_bank import bits, busy, resets

from sim.observers import (
    hall_vector,
    hall_vector_decoupled,
    lookup_table,
    programmable_filter,
    sample,
    zeroth_order,
)
from sim.observers.hall_edges import EDGES

MODEL = {name: DRIVE[name] for name in ("n_p", "psi_f_hat")} | {"J_hat": 2e-4, "bw_hall_vector": 10.0}
FLUX = {name: DRIVE[name] for name in ("R_s_hat", "L_s_hat", "psi_f_hat", "omega_on", "omega_off", "bw_omega_lpf")}
SPEED = {name: DRIVE[name] for name in ("n_p", "omega_m_max")}
DRIVES = {
    zeroth_order: {},
    lookup_table: SPEED | table(),
    hall_vector: MODEL,
    hall_vector_decoupled: MODEL,
    programmable_filter: FLUX,
}
OBSERVERS = pytest.mark.parametrize("observer", DRIVES, ids=lambda module: module.__name__.rpartition(".")[2])


def make(observer, **drive):
    return observer.make_params(PWM_HZ, observer.Settings(**{**DRIVES[observer], **drive}))


def run_whole(observer):
    s = busy()
    reset = resets(s.tick.size)
    state, out = observer.run(make(observer), observer.init(), samples(s, reset), reset)
    return bits(out, state)


def run_steps(observer):
    s = busy()
    reset = resets(s.tick.size)
    seen = samples(s, reset)
    params, state = make(observer), observer.init()
    columns = [np.empty(s.tick.size) for _ in observer.Estimate._fields]
    for k in range(s.tick.size):
        if reset[k]:
            state = observer.init()
        state, estimate = observer.step(params, state, sample.at(seen, k))
        for column, value in zip(columns, estimate, strict=True):
            column[k] = value
    return bits(columns, state)


@OBSERVERS
def test_step_and_run_agree_bit_for_bit(observer):
    assert run_steps(observer) == run_whole(observer)


def test_the_uncompiled_kernels_agree_bit_for_bit():
    code = "import test_classic_kernels as t; print(*(t.run_whole(observer) for observer in t.DRIVES))"
    here = Path(__file__).parent
    env = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join([str(here), *sys.path])}
    plain = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True)
    assert plain.stdout.split() == [run_whole(observer) for observer in DRIVES]


@OBSERVERS
def test_an_estimate_begins_with_angle_and_speed(observer):
    assert observer.Estimate._fields[:2] == ("theta", "omega")
    assert observer.Estimate._fields == observer.Estimates._fields
    out = track(observer, make(observer), busy())
    assert out.theta.min() >= -np.pi
    assert out.theta.max() < np.pi


@OBSERVERS
def test_a_gap_forgets_everything(observer):
    """From the reset on it is a run that begins there."""
    s = busy()
    at = 3000
    reset = np.zeros(s.tick.size, bool)
    reset[at] = True
    out = track(observer, make(observer), s, reset)
    later = s.edge_tick > s.tick[at - 1]
    rest = type(s)(*(c[at:] for c in s[:8]), s.edge_tick[later], s.edge_hall[later], s.theta[at:])
    for mine, fresh in zip(out, track(observer, make(observer), rest), strict=True):
        assert np.array_equal(mine[at:], fresh)


@OBSERVERS
def test_one_compiled_version_serves_parameters_of_all_kinds(observer):
    """Whole numbers from a host, numpy scalars: no second compilation."""
    if not hasattr(observer.run, "signatures"):
        pytest.skip("not compiled")
    reset = np.zeros(100, bool)
    seen = samples(signals(constant(rpm(100)), 100 * T_S))
    for kind in (float, np.float32, int):
        params = make(observer, **{name: kind(value) for name, value in DRIVES[observer].items()})
        state, _ = observer.run(params, observer.init(), seen, reset)
        observer.run(params, state, seen, reset)
    assert len(observer.run.signatures) == 1


@OBSERVERS
@pytest.mark.parametrize("speed", [0.0, 500.0, -3000.0])
def test_parameters_that_are_zero_divide_by_nothing(observer, speed):
    """All of them, and each alone: finite estimates, standing and turning, with and without voltage."""
    names = [name for name in DRIVES[observer] if name != "n_p"]
    s = signals(constant(rpm(speed)), 0.05, i_q=8.0)
    still = s._replace(u_alpha=0 * s.u_alpha, u_beta=0 * s.u_beta)
    for zeros in [names, *([name] for name in names)]:
        params = make(observer, **dict.fromkeys(zeros, 0.0))
        for seen in (s, still):
            for column in track(observer, params, seen):
                assert np.isfinite(column).all(), zeros


@OBSERVERS
def test_a_parameter_that_is_missing_is_named(observer):
    for name in set(DRIVES[observer]) - set(EDGES):  # an edge that is not given is an ideal one
        given = {other: value for other, value in DRIVES[observer].items() if other != name}
        with pytest.raises(TypeError, match=name):
            observer.Settings(**given)


def test_at_a_fast_steady_speed_the_order_is_that_of_their_information():
    """One motor, the sensors of Table I, 1000 r/min: what each one knows of them shows in its error."""
    s = signals(constant(rpm(1000)), 1.5, edges_deg=PAPER_EDGES)
    std = {o: error_deg(s.theta, track(o, make(o), s).theta)[PWM_HZ:].std() for o in DRIVES}
    assert std[lookup_table] < 0.01
    assert std[zeroth_order] == pytest.approx(17.8, abs=0.2)
    assert std[hall_vector] == pytest.approx(1.0, abs=0.1)
    assert std[hall_vector_decoupled] == pytest.approx(0.77, abs=0.1)
    assert std[programmable_filter] == pytest.approx(1.1, abs=0.15)
