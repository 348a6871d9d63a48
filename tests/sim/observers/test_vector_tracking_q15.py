"""The fixed-point observer: as good as the floating-point one, and integer for integer what its C file does."""

import math
import subprocess

import numpy as np
import pytest
import q15_harness
from hypothesis import given
from hypothesis import strategies as st
from ideal_motor import (
    PAPER_EDGES,
    PWM_HZ,
    constant,
    error_deg,
    own,
    quantised,
    rpm,
    run,
    samples,
    signals,
    turning_back,
)
from test_kernels import busy

from sim.native import value
from sim.observers import vector_tracking
from sim.observers import vector_tracking_q15 as q15
from sim.observers.sample import Sample
from tests.choice import examples
from tests.tools import needs

pytestmark = pytest.mark.slow

PARAMS = q15.make_params(PWM_HZ, own(q15))
TURN = 1 << 32


def both(s):
    """Estimates of the fixed-point and of the floating-point observer."""
    seen = samples(s)
    return run(q15, PARAMS, seen)[1], run(
        vector_tracking, vector_tracking.make_params(PWM_HZ, own(vector_tracking)), seen
    )[1]


def traced(constants, state, rows):
    """The kernel's states after each row of integers: reset, and the fields of Counts."""
    states = []
    for reset, *counts in rows.tolist():
        state = q15.advance(constants, q15.init() if reset else state, q15.Counts(*counts))
        states.append(state)
    return np.array(states, np.int64)


def outputs_off(seconds, i_q):
    """500 r/min, from the middle to three quarters without a reference voltage."""
    s = signals(constant(rpm(500)), seconds, i_q=i_q, edges_deg=PAPER_EDGES, noise=0.02)
    off = np.arange(s.tick.size) * 4 // s.tick.size == 2
    return s._replace(u_alpha=np.where(off, 0.0, s.u_alpha), u_beta=np.where(off, 0.0, s.u_beta))


# --- the C file ---

needs_compiler = needs("gcc", f"gcc {q15_harness.CHECKED[1]}")


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    """The C file with every undefined operation trapped."""
    flags = (*q15_harness.CHECKED, "-Wconversion", "-Wsign-conversion")
    return q15_harness.build(tmp_path_factory.mktemp("q15") / "harness", *flags)


def agreed(program, constants, rows, state):
    """The states after each row, which both have found."""
    mine = traced(constants, state, rows)
    assert np.array_equal(mine, q15_harness.trace(program, constants, state, rows))
    return mine


INT16 = (1 << 15) - 1


def extreme(count):
    """0..count in size, its ends more often than all else."""
    return st.one_of(st.sampled_from([-count, -1, 0, 1, count]), st.integers(-count, count))


def limits(low, high):
    return st.one_of(st.sampled_from([low, high]), st.integers(low, high))


@st.composite
def constants(draw):
    z_now = draw(limits(0, INT16))
    speed = limits(0, q15.TURN_MAX)
    return q15.Constants(
        z_now,
        draw(limits(-z_now, z_now)),
        draw(limits(0, 15)),
        draw(limits(1, INT16)),
        *(draw(speed) for _ in range(4)),
        draw(limits(4, (1 << 30) - 1)),
        draw(limits(0, (1 << 30) - 1)),
        draw(limits(1, INT16)),
        draw(limits(0, TURN - 1)),
    )


states = st.builds(
    q15.State,
    st.integers(0, 1),
    st.integers(0, 1),
    st.sampled_from([-1, 1]),
    extreme(INT16),
    extreme(INT16),
    extreme(INT16 << 15),
    extreme(INT16 << 15),
    limits(0, TURN - 1),
    extreme(q15.TURN_MAX),
    extreme(q15.OMEGA_MAX),
)
inputs = st.tuples(
    st.sampled_from([0] * 20 + [1]),
    *[extreme(INT16)] * 4,
    st.one_of(extreme(1 << 20), extreme((1 << 31) - 1)),
    limits(0, 65535),
    st.integers(-1, 5),
    st.integers(-1, 1),
    st.integers(0, 1),
)


@needs_compiler
@examples(40, 150, campaign="c")
@given(constants(), states, st.lists(inputs, min_size=1, max_size=40), st.integers(0, 99))
def test_c_and_kernel_agree_at_the_limits_of_every_type(program, constants, state, some, seed):
    """Nothing overflows (the C file is trapped), and what is stored stays within what the header says."""
    rng = np.random.default_rng(seed)
    rows = np.array(some, np.int64)
    rows = np.concatenate([rows, rows[rng.integers(0, len(rows), 200)]])  # on and on, in any order
    mine = agreed(program, constants, rows, state)
    column = dict(zip(q15.State._fields, mine.T, strict=True))
    assert np.abs(column["corr_i"]).max() <= q15.TURN_MAX
    assert np.abs(column["omega"]).max() <= q15.OMEGA_MAX
    assert max(np.abs(column["e_alpha"]).max(), np.abs(column["e_beta"]).max()) <= INT16 << 15
    assert column["theta"].min() >= 0
    assert column["theta"].max() < TURN


@needs_compiler
@pytest.mark.parametrize("scale", [20, 2000, INT16])
def test_c_and_kernel_agree_on_noise_with_the_correction_held_on(program, scale):
    """Every interval of the table of sines, both directions, any back-EMF; half a second each."""
    rng = np.random.default_rng(scale)
    n = 8000
    omega = np.cumsum(rng.integers(-200_000, 200_001, n))
    angle = np.cumsum(omega) & (TURN - 1)
    columns = [
        np.zeros(n),
        *rng.integers(-scale, scale + 1, (4, n)),
        omega,
        angle >> 16,
        angle * 6 >> 32,
        np.where(omega < 0, -1, 1),
        rng.integers(0, 50, n) == 0,
    ]
    rows = np.stack(columns, axis=-1).astype(np.int64)
    free = PARAMS.q._replace(turn_on=0, turn_off=0)
    mine = agreed(program, free, rows, q15.init())
    assert mine[:, 1].mean() > 0.2


@needs_compiler
def test_the_printed_constants_are_c(tmp_path):
    """Compiled and printed again, they are the same numbers."""
    prints = "".join(f'    printf("%ld\\n", (long)drive.{name});\n' for name in q15.Constants._fields)
    source = tmp_path / "constants.c"
    source.write_text(
        '#include <stdio.h>\n#include "vector_tracking_q15.h"\n'
        f"{q15.c_source(PARAMS, 'drive')}int main(void)\n{{\n{prints}    return 0;\n}}\n"
    )
    program = q15_harness.build(tmp_path / "constants", sources=(source,))
    printed = subprocess.run([program], capture_output=True, text=True, check=True).stdout
    assert [int(line) for line in printed.split()] == list(PARAMS.q)


@needs_compiler
def test_the_c_file_needs_nothing_of_a_library(tmp_path):
    """Neither a function nor a variable from outside, and none of its own that can change."""
    compiled = tmp_path / "q15.o"
    q15_harness.build(compiled, "-O2", "-ffreestanding", "-c", sources=(q15_harness.SOURCES[1],))
    symbols = subprocess.run(["nm", compiled], capture_output=True, text=True, check=True).stdout
    kinds = {line.split()[-1]: line.split()[-2] for line in symbols.splitlines()}
    assert {name for name, kind in kinds.items() if kind == "T"} == {"hbq_init", "hbq_step"}
    assert set(kinds.values()) <= set("Ttr")


# --- the constants ---


def test_constants_of_table_ii_by_hand():
    """L/T = 2.816 ohm, R/2 = 0.079 ohm; 2^32 / (2 pi 16000) = 42722.83 steps a rad/s; 2^30 / 32 = 33554432 a volt."""
    q = PARAMS.q
    assert (q.z_now, q.z_before, q.z_shift) == (round(2.895 * 8192), round(2.737 * 8192), 13)
    assert q.a_min == round(32768 / (1 + 4e-4 * 16000))
    assert q.k_p == pytest.approx(1268 * 42722.83, rel=1e-7)
    assert q.k_i == pytest.approx(54289 * 42722.83 / 16000, abs=1)
    assert q.turn_on == pytest.approx(20 * 42722.83, abs=1)
    assert q.turn_off == pytest.approx(12 * 42722.83, abs=1)
    assert q.e_min == pytest.approx(0.131 * 33554432, abs=1)
    assert q.e_turn == pytest.approx(0.0393 * 33554432, abs=1)
    assert q.a_omega == round(32768 * (1 - math.exp(-2 * math.pi * 50 / 16000)))
    assert [
        q15.make_params(PWM_HZ, own(q15, hall_offset=math.radians(deg))).q.hall_offset for deg in (0, 90, -90, 180)
    ] == [0, 1 << 30, 3 << 30, 1 << 31]


@pytest.mark.parametrize(
    ("name", "value", "largest"),
    [("k_p_vt", 1e5, 12566.0), ("k_i_vt", 1e9, 2.0106e8), ("omega_on", 2e4, 12566.0), ("L_s_hat", 10.0, 2047.0)],
)
def test_constants_that_do_not_fit_are_the_largest_that_do(name, value, largest):
    """The limits that docs/fixed-point.md names; L_s_hat's is that of the 16-bit impedance."""
    at_limit = q15.make_params(PWM_HZ, own(q15, **{name: largest}))
    beyond = q15.make_params(PWM_HZ, own(q15, **{name: value}))
    if name == "L_s_hat":
        assert beyond.q.z_now == 32767
    for mine, its in zip(beyond.q, at_limit.q, strict=True):
        assert name == "L_s_hat" or mine == pytest.approx(its, rel=1e-3)


# --- how well it observes ---


HALF = 1.5
HARD = {  # signals, and how far the two may be apart, deg
    "constant speed": (lambda: signals(constant(rpm(1000)), 1.0, edges_deg=PAPER_EDGES, noise=0.02), 0.15),
    "starts, a reversal, lost edges": (busy, 0.5),
    "outputs off": (lambda: outputs_off(0.4, 4.0), 0.1),
    "26 rad/s and back in 3 s": (
        lambda: signals(lambda t: 0.3 + 13 * (t - HALF / np.pi * np.sin(np.pi * t / HALF)), 2 * HALF, fine=10),
        0.2,
    ),
    "back between two edges": (
        lambda: signals(turning_back(rpm(200), 0.2, 20_000.0, 0.6), 0.5, i_q=-3.0, fine=20, noise=0.02),
        1.0,
    ),
}


@pytest.mark.parametrize("name", HARD)
def test_it_starts_stops_reverses_and_doubts_as_the_floating_point_observer_does(name):
    """The correction is on at the same samples, and the estimates stay close."""
    make, limit = HARD[name]
    s = quantised(make())
    fixed, exact = both(s)
    assert np.array_equal(fixed.on, exact.on)
    assert fixed.on.mean() > 0.1
    assert 1e-4 < np.abs(error_deg(fixed.theta, exact.theta)).max() < limit
    assert np.abs(fixed.omega - exact.omega).max() < 20 * limit


def test_full_scale_saturates_and_a_larger_base_does_not():
    """A motor at twenty times the voltage and current, bases with it, is the same motor: R and L stay."""
    small = quantised(signals(constant(rpm(500)), 0.3, edges_deg=PAPER_EDGES))
    large = small._replace(**{k: 20 * getattr(small, k) for k in ("u_alpha", "u_beta", "i_a", "i_b", "i_c")})
    seen, reset = samples(large), np.zeros(small.tick.size, np.bool_)
    more = own(q15, psi_f_hat=20 * own(q15).psi_f_hat)
    wide = q15.make_params(PWM_HZ, more, base_u=640.0, base_i=640.0)
    assert wide.q == PARAMS.q
    _, out = run(q15, wide, seen, reset)
    _, same = run(q15, PARAMS, samples(small), reset)
    assert np.array_equal(out.theta, same.theta)
    assert q15.make_params(PWM_HZ, own(q15, i_range=75.0)) == q15.make_params(PWM_HZ, own(q15), base_i=128.0)
    narrow = q15.make_params(PWM_HZ, more)
    counts = np.array([q15.counts(narrow, value(Sample, seen[k]))[:4] for k in range(100)])
    assert np.abs(counts).max() == INT16
