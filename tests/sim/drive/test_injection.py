"""The test sine in the vector-tracking observer: its response is (11), its phase is known from the stream."""

from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from rig import PWM_HZ, Rig, column

from protocol.signals import Injection, Status

K_P, K_I = 1268.0, 54289.0  # of Fig. 6
ALIGNED = {"hall.delta_deg": [0.0] * 6, "hall.hysteresis_deg": 0.0, "hall.jitter_deg": 0.0}


def running(**overrides):
    """A shaft forced to 500 r/min, 2 A by the encoder: no estimate feeds back."""
    bench = Rig(1, **{"firmware.observer": 0} | overrides)
    bench.start()
    bench.forced(500, 2.0, 1.0)
    return bench


def inject(bench, where, amplitude, hz):
    bench.set_param("inject_amplitude", amplitude)
    bench.set_param("inject_hz", hz)
    bench.set_param("inject", float(where))


def response(where, hz, amplitude=0.05):
    """Complex gain of the estimate against sin(phase), the phase counted from the first sample with the sync bit."""
    bench = running(**ALIGNED)
    inject(bench, where, amplitude, hz)
    recorded = bench.advance(32_000)
    first = int(np.flatnonzero(recorded.samples["status"] & Status.INJECTION_SYNC)[0])
    settled = slice(first + 8_000, None)
    phase = 2 * np.pi * hz / PWM_HZ * (np.arange(len(recorded)) - first)
    error = np.angle(np.exp(1j * (column(recorded, "theta_vt") - column(recorded, "theta_e"))))
    basis = np.column_stack([np.sin(phase), np.cos(phase), np.ones_like(phase)])[settled]
    (in_phase, ahead, _), *_ = np.linalg.lstsq(basis, error[settled], rcond=None)
    return (in_phase + 1j * ahead) / amplitude


@pytest.mark.parametrize("hz", [23.0, 170.0, 1130.0])
@pytest.mark.parametrize("where", [Injection.BACK_EMF, Injection.HALL])
def test_the_response_is_that_of_equation_11(where, hz):
    s = 2j * np.pi * hz
    share = K_P * s + K_I if where is Injection.BACK_EMF else s * s
    expected = share / (s * s + K_P * s + K_I)
    # what the sampled loop differs by: its prediction to the middle of a period leaves out the correction
    assert abs(response(where, hz) - expected) < 0.023


@pytest.mark.parametrize("hz", [437.5, 100.0, 1234.0, 3.0])
def test_the_sync_bit_marks_the_first_sample_and_every_new_turn(hz):
    bench = running()
    assert not np.any(bench.advance(100).samples["status"] & Status.INJECTION_SYNC)
    for _ in range(2):  # and every injection starts at phase 0
        inject(bench, Injection.BACK_EMF, 0.0, hz)
        recorded = bench.advance(16_000)
        turns = [Fraction(hz) * n / PWM_HZ for n in range(-1, 16_000)]
        expected = [a // 1 != b // 1 for a, b in pairwise(turns)]
        assert list(recorded.samples["status"] & Status.INJECTION_SYNC > 0) == expected
        bench.set_param("inject", 0.0)
        assert not np.any(bench.advance(10).samples["status"] & Status.INJECTION_SYNC)


@pytest.mark.parametrize(
    ("bench", "amplitude"),
    [(running, 0.0), (lambda: Rig(1), 0.5)],
    ids=["at amplitude zero", "while the correction is off"],
)
def test_nothing_is_added(bench, amplitude):
    logs = set()
    for where in Injection:
        injected = bench()
        inject(injected, where, amplitude, 123.0)
        logs.add(injected.advance(1_000).rows.tobytes())
    assert len(logs) == 1
