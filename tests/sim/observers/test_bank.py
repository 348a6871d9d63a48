"""All observers fed from one stream: step, run and run in chunks agree bit for bit, with each observer alone too."""

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from ideal_motor import DRIVE, PWM_HZ, TICK_HZ, table
from test_kernels import bits, busy, resets

from sim.observers import bank, sample
from sim.observers.catalogue import CATALOGUE

LOAD_ANGLE = {**DRIVE, "load_angle_comp": 1.0, "k_ic": 11.0}
BACK_EMF = {**DRIVE, "inject": 1.0, "inject_amplitude": 0.1, "inject_hz": 123.4}
HALL = {**BACK_EMF, "inject": 2.0}
TOLD = {**DRIVE, **table()}  # where the edges lie


@cache
def stream():
    """Signals, and where all is forgotten."""
    s = busy()
    return s, resets(s.tick.size)


def make(drive):
    return bank.make_params(TICK_HZ, PWM_HZ, **drive)


def run_whole(drive):
    """State and estimates."""
    s, mask = stream()
    return bank.run(make(drive), bank.init(), *s.arguments(mask))


def run_steps(drive):
    s, mask = stream()
    params, state = make(drive), bank.init()
    bounds = np.searchsorted(s.edge_tick, s.tick, side="right")
    estimates = []
    first = 0
    for k, last in enumerate(bounds.tolist()):
        if mask[k]:
            state = bank.init()
        seen = [int(s.tick[k]), int(s.hall[k]), *(float(c[k]) for c in s[2:8])]
        state, estimate = bank.step(params, state, *seen, s.edge_tick, s.edge_hall, first, last)
        first = last
        estimates.append(estimate)
    return state, [np.array(column).T for column in zip(*estimates, strict=True)]


def run_chunks(drive, seed):
    s, mask = stream()
    params, state = make(drive), bank.init()
    n = mask.size
    rng = np.random.default_rng(seed)
    cuts = np.unique(np.r_[0, rng.integers(0, n, rng.integers(1, 400)), n])
    parts, used = [], 0
    for begin, end in pairwise(cuts):
        here = [c[begin:end] for c in s[:8]]
        # more edges than the chunk can use, as a live stream has them: the rest is given again
        edge_tick, edge_hall = s.edge_tick[used : used + 50], s.edge_hall[used : used + 50]
        state, out = bank.run(params, state, *here, edge_tick, edge_hall, mask[begin:end])
        used += int(np.searchsorted(edge_tick, here[0][-1], side="right"))
        parts.append(out)
    return state, [np.concatenate(c, axis=-1) for c in zip(*parts, strict=True)]


@pytest.mark.parametrize(
    "drive",
    [DRIVE, LOAD_ANGLE, BACK_EMF, HALL, TOLD],
    ids=["plain", "load angle", "sine on theta*", "sine on theta_h", "edges told"],
)
def test_step_run_and_chunks_agree_bit_for_bit(drive):
    state, out = run_whole(drive)
    whole = bits(out, state)
    for last, estimates in (run_steps(drive), *(run_chunks(drive, seed) for seed in range(5))):
        assert bits(estimates, last) == whole
    assert len(getattr(bank.run, "signatures", [None])) == 1  # a state that is fed back compiles no second version


def test_the_bank_is_its_observers_put_together():
    """Each observer's own run gives the bank's columns."""
    s, mask = stream()
    _, out = run_whole(DRIVE)
    _, seen = sample.run(make(DRIVE).front, sample.init(), *s.arguments(mask))
    assert np.array_equal(out.sector, seen.hall.sector)
    for j, (name, entry) in enumerate(CATALOGUE.items()):
        _, alone = entry.run(entry.make_params(PWM_HZ, DRIVE), entry.init(), seen, mask)
        assert np.array_equal(out.theta[j], alone.theta), name
        assert np.array_equal(out.omega[j], alone.omega), name
        if name == "vector_tracking":
            renamed = {"correction_on": "on", "injection_sync": "sync"}
            for mine in ("delta_hat", "e_alpha", "e_beta", *renamed):
                assert np.array_equal(getattr(out, mine), getattr(alone, renamed.get(mine, mine))), mine


def test_parameters_are_rounded_to_what_a_drive_stores_and_others_are_ignored():
    """Of whatever kind they are: no second compilation."""
    params = make(DRIVE)
    stored = make({name: np.float32(value) for name, value in DRIVE.items()} | {"watchdog": 0.2, "i_max": 8})
    assert repr(stored) == repr(params)


def test_a_missing_parameter_is_named():
    with pytest.raises(KeyError, match="tau_max"):
        make({name: value for name, value in DRIVE.items() if name != "tau_max"})
