"""All observers fed from one stream: step, run and run in chunks agree bit for bit, with each observer alone too."""

from itertools import pairwise

import numpy as np
import pytest
from ideal_motor import DRIVE, PWM_HZ, TICK_HZ, table
from test_kernels import bits, busy, resets

from sim.observers import bank, sample
from sim.observers.catalogue import CATALOGUE

MILLI = 1 / 1024
LOAD_ANGLE = {**DRIVE, "load_angle_comp": 1.0, "k_ic": 11.0}
BACK_EMF = {**DRIVE, "inject": 1.0, "inject_amplitude": 0.1, "inject_hz": 123.4}
HALL = {**BACK_EMF, "inject": 2.0}
TOLD = {**DRIVE, **table()}  # where the edges lie


def run_whole(drive=DRIVE):
    s = busy()
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


def test_the_bank_is_its_observers_put_together():
    """Each observer's own run gives the bank's columns."""
    s = busy()
    mask = resets(s.tick.size)
    params = bank.make_params(TICK_HZ, PWM_HZ, **DRIVE)
    _, out = bank.run(params, bank.init(), *s.arguments(mask))
    _, seen = sample.run(params.front, sample.init(), *s.arguments(mask))
    assert np.array_equal(out.sector, seen.hall.sector)
    for j, (name, entry) in enumerate(CATALOGUE.items()):
        _, alone = entry.run(entry.make_params(PWM_HZ, DRIVE), entry.init(), seen, mask)
        assert np.array_equal(out.theta[j], alone.theta), name
        assert np.array_equal(out.omega[j], alone.omega), name
        if name == "vector_tracking":
            for mine, its in (("correction_on", "on"), ("injection_sync", "sync")):
                assert np.array_equal(getattr(out, mine), getattr(alone, its)), mine
            for its in ("delta_hat", "e_alpha", "e_beta"):
                assert np.array_equal(getattr(out, its), getattr(alone, its)), its


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
