"""The test sine in the vector-tracking observer: its phase is known from the stream (Fig. 6: `bench accept`)."""

from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from rig import PWM_HZ, Rig, loop_records

from protocol.signals import Injection, Status


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
        logs.add(tuple(loop_records([injected.advance(1_000)])))
    assert len(logs) == 1
