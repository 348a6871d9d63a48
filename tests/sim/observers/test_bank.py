"""The same kernels in three places: step, run, run in chunks and the plain Python agree bit for bit."""

import hashlib
import os
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from ideal_motor import DRIVE, PAPER_EDGES, PWM_HZ, T_S, TICK_HZ, error_deg, rpm, signals, table

from sim.observers import average_speed, bank, hall_speed, sample
from sim.observers.catalogue import CATALOGUE

MILLI = 1 / 1024
LOAD_ANGLE = {**DRIVE, "load_angle_comp": 1.0, "k_ic": 11.0}
BACK_EMF = {**DRIVE, "inject": 1.0, "inject_amplitude": 0.1, "inject_hz": 123.4}
HALL = {**BACK_EMF, "inject": 2.0}
TOLD = {**DRIVE, **table()}  # where the edges lie


def busy(seconds=0.6):
    """Standstill, start, 400 r/min, back through zero, a stop; misplaced sensors, noise, glitches, lost edges."""
    a, omega = 5000.0, rpm(400)
    up = omega / a

    def angle(t):
        speed_up = np.clip(t - 0.05, 0, up)
        steady = np.clip(t - 0.05 - up, 0, 0.1)
        turning = np.clip(t - 0.15 - up, 0, 2 * up)
        back = np.clip(t - 0.15 - 3 * up, 0, 0.1)
        way = a * speed_up**2 / 2 + omega * steady + omega * turning - a * turning**2 / 2 - omega * back
        return 0.4 + way

    s = signals(angle, seconds, i_q=5.0, edges_deg=PAPER_EDGES, fine=10, noise=0.02, seed=7)
    rounded = [np.round(c / MILLI) * MILLI for c in s[2:7]]
    rng = np.random.default_rng(3)
    keep = np.ones(s.edge_tick.size, bool)
    keep[20] = False
    tick = np.r_[s.edge_tick[keep], s.edge_tick[8] + 100, s.edge_tick[8] + 140]
    code = np.r_[s.edge_hall[keep], np.uint8(7), s.edge_hall[8]]
    order = np.argsort(tick, kind="stable")
    hall = s.hall.copy()
    hall[4000] = 0
    return s._replace(
        hall=hall,
        u_alpha=rounded[0],
        u_beta=rounded[1],
        i_a=rounded[2],
        i_b=rounded[3],
        i_c=rounded[4],
        i_q_err=np.round(rng.standard_normal(s.tick.size) * 0.05 / MILLI) * MILLI,
        edge_tick=tick[order],
        edge_hall=code[order],
    )


def learning():
    """1500 r/min and then 200, too short for a reset: edges are learned, then R_s."""
    fast, slow, then = rpm(1500), rpm(200), 0.08
    return signals(
        lambda t: 0.3 + fast * np.minimum(t, then) + slow * np.maximum(t - then, 0),
        0.15,
        i_q=5.0,
        edges_deg=PAPER_EDGES,
        noise=0.02,
        seed=7,
    )


def resets(n):
    mask = np.zeros(n, bool)
    mask[[k for k in (0, 2500, 2501, 5200) if k < n]] = True
    return mask


def bits(estimates, state):
    """Every bit of a run's result."""
    digest = hashlib.sha256()
    for column in estimates:
        digest.update(np.asarray(column, np.float64).tobytes())
    digest.update(np.array(list(numbers(state))).tobytes())
    return digest.hexdigest()


def numbers(value):
    """The numbers of nested tuples, in order."""
    if isinstance(value, tuple):
        for part in value:
            yield from numbers(part)
    else:
        yield float(value)


def run_whole(drive=DRIVE, make=busy):
    s = make()
    params = bank.make_params(TICK_HZ, PWM_HZ, **drive)
    state, out = bank.run(params, bank.init(), *s.arguments(resets(s.tick.size)))
    return bits(out, state)


def run_steps(drive=DRIVE):
    s = busy()
    params = bank.make_params(TICK_HZ, PWM_HZ, **drive)
    mask = resets(s.tick.size)
    columns = [
        np.empty((bank.COUNT, s.tick.size) if j < 2 else s.tick.size) for j in range(len(bank.BankEstimate._fields))
    ]
    state = bank.init()
    bounds = np.searchsorted(s.edge_tick, s.tick, side="right")
    first = 0
    for k in range(s.tick.size):
        if mask[k]:
            state = bank.init()
        last = int(bounds[k])
        seen = [int(s.tick[k]), int(s.hall[k]), *(float(c[k]) for c in s[2:8])]
        state, estimate = bank.step(params, state, *seen, s.edge_tick, s.edge_hall, first, last)
        first = last
        for column, value in zip(columns, estimate, strict=True):
            column[..., k] = value
    return bits(columns, state)


def run_chunks(seed, drive=DRIVE):
    s = busy()
    params = bank.make_params(TICK_HZ, PWM_HZ, **drive)
    n = s.tick.size
    rng = np.random.default_rng(seed)
    cuts = np.unique(np.r_[0, rng.integers(0, n, rng.integers(1, 400)), n])
    state, parts, used = bank.init(), [], 0
    samples = s.arguments(resets(n))
    for begin, end in pairwise(cuts):
        here = [c[begin:end] for c in (*samples[:8], samples[10])]
        # more edges than the chunk can use, as a live stream has them: the rest is given again
        edge_tick, edge_hall = s.edge_tick[used : used + 50], s.edge_hall[used : used + 50]
        state, out = bank.run(params, state, *here[:8], edge_tick, edge_hall, here[8])
        used += int(np.searchsorted(edge_tick, here[0][-1], side="right"))
        parts.append(out)
    return bits([np.concatenate(c, axis=-1) for c in zip(*parts, strict=True)], state)


@pytest.mark.parametrize(
    "drive",
    [DRIVE, LOAD_ANGLE, BACK_EMF, HALL, TOLD],
    ids=["plain", "load angle", "sine on theta*", "sine on theta_h", "edges told"],
)
def test_step_run_and_chunks_agree_bit_for_bit(drive):
    whole = run_whole(drive)
    assert run_steps(drive) == whole
    for seed in range(5):
        assert run_chunks(seed, drive) == whole


def test_the_uncompiled_kernels_agree_bit_for_bit():
    code = (
        "import test_bank as t; print(t.run_whole(t.TOLD), t.run_steps(t.LOAD_ANGLE), t.run_whole(t.DRIVE, t.learning))"
    )
    here = Path(__file__).parent
    env = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join([str(here), *sys.path])}
    plain = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True)
    assert plain.stdout.split() == [run_whole(TOLD), run_steps(LOAD_ANGLE), run_whole(DRIVE, learning)]


def test_what_can_be_learned_is_learned_where_the_bits_are_compared():
    s = learning()
    state, _ = bank.run(bank.make_params(TICK_HZ, PWM_HZ, **DRIVE), bank.init(), *s.arguments(resets(s.tick.size)))
    assert state.learned_edges.edges.learned == 6
    assert state.learned_edges.edges.c != 0.0
    assert state.learned_edges.voltage.v != 0.0
    assert state.learned_edges.voltage.R_error != 0.0


def test_the_bank_is_its_observers_put_together():
    """Each observer's own run gives the bank's columns."""
    s = busy()
    mask = resets(s.tick.size)
    params = bank.make_params(TICK_HZ, PWM_HZ, **DRIVE)
    _, out = bank.run(params, bank.init(), *s.arguments(mask))
    _, seen = sample.run(params.front, sample.init(), *s.arguments(mask))
    edge_args = (s.tick, s.hall, s.edge_tick, s.edge_hall, mask)
    _, hall = hall_speed.run(params.front.hall, hall_speed.init(), *edge_args)
    _, average = average_speed.run(params.front, average_speed.init(), *edge_args)
    for mine, alone in zip(seen.hall, hall, strict=True):
        assert np.array_equal(mine, alone)
    assert np.array_equal(out.sector, hall.sector)
    assert np.array_equal(out.column("theta_avg"), average.theta)
    assert np.array_equal(out.column("omega_avg"), average.omega)
    for j, (name, entry) in enumerate(CATALOGUE.items()):
        _, alone = entry.run(entry.make_params(PWM_HZ, DRIVE), entry.init(), seen, mask)
        assert np.array_equal(out.theta[j], alone.theta), name
        assert np.array_equal(out.omega[j], alone.omega), name
        if name == "vector_tracking":
            for mine, its in (("correction_on", "on"), ("injection_sync", "sync")):
                assert np.array_equal(getattr(out, mine), getattr(alone, its)), mine
            for its in ("delta_hat", "e_alpha", "e_beta"):
                assert np.array_equal(getattr(out, its), getattr(alone, its)), its


def test_a_reset_forgets_everything():
    s = busy()
    params = bank.make_params(TICK_HZ, PWM_HZ, **DRIVE)
    at = 3000
    mask = np.zeros(s.tick.size, bool)
    mask[at] = True
    _, out = bank.run(params, bank.init(), *s.arguments(mask))
    later = s.edge_tick > s.tick[at - 1]
    rest = [c[at:] for c in s[:8]]
    _, fresh = bank.run(
        params, bank.init(), *rest, s.edge_tick[later], s.edge_hall[later], np.zeros(s.tick.size - at, bool)
    )
    for a, b in zip(out, fresh, strict=True):
        assert np.array_equal(a[..., at:], b)


def test_angles_are_within_plus_minus_pi_and_the_estimates_useful():
    s = busy()
    params = bank.make_params(TICK_HZ, PWM_HZ, **DRIVE)
    _, out = bank.run(params, bank.init(), *s.arguments())
    for column in (out.column("theta_avg"), out.column("theta_vt")):
        assert column.min() >= -np.pi
        assert column.max() < np.pi
    steady = (s.tick > 0.11 * TICK_HZ) & (s.tick < 0.15 * TICK_HZ)
    assert np.abs(error_deg(s.theta, out.column("theta_vt")))[steady].std() < 3.5


def test_one_compiled_version_serves_state_and_parameters_of_all_kinds():
    """Whole numbers from a host, states fed back, numpy scalars: no second compilation."""
    if not hasattr(bank.run, "signatures"):
        pytest.skip("not compiled")
    run_whole()
    whole_numbers = {name: int(value) if float(value).is_integer() else value for name, value in DRIVE.items()}
    run_whole(whole_numbers)
    run_chunks(0, {name: np.float32(value) for name, value in DRIVE.items()})
    assert len(bank.run.signatures) == 1


def test_parameters_are_rounded_to_what_a_drive_stores():
    exact = bank.make_params(TICK_HZ, PWM_HZ, **DRIVE)
    stored = bank.make_params(TICK_HZ, PWM_HZ, **{k: float(np.float32(v)) for k, v in DRIVE.items()})
    assert exact == stored


def test_a_missing_parameter_is_named_and_others_are_ignored():
    with pytest.raises(KeyError, match="tau_max"):
        bank.make_params(TICK_HZ, PWM_HZ, **{k: v for k, v in DRIVE.items() if k != "tau_max"})
    assert bank.make_params(TICK_HZ, PWM_HZ, **DRIVE, watchdog=0.2, i_max=8.0) == bank.make_params(
        TICK_HZ, PWM_HZ, **DRIVE
    )


def test_extreme_parameters_divide_by_nothing():
    """Zero is allowed for each of these; a standing rotor, no voltage, no current."""
    zeros = dict.fromkeys(("k_p_vt", "k_i_vt", "tau_max", "omega_on", "omega_off", "omega_m_max"), 0.0)
    params = bank.make_params(TICK_HZ, PWM_HZ, **{**DRIVE, **zeros})
    s = signals(lambda t: 0.2 + 0 * t, 0.05)
    still = s._replace(u_alpha=0 * s.u_alpha, u_beta=0 * s.u_beta, i_a=0 * s.i_a, i_b=0 * s.i_b, i_c=0 * s.i_c)
    _, out = bank.run(params, bank.init(), *still.arguments())
    moving = signals(lambda t: 0.2 + rpm(500) * t, 0.05)
    _, out = bank.run(params, bank.init(), *moving.arguments())
    assert np.isfinite(out.column("theta_vt")).all()
    assert T_S * PWM_HZ == 1
