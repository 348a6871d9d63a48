"""Records of MEAN are of whole runs of `decimation` periods that end at its multiples, however samples are pushed."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from small_drive import CHANNELS, samples

from protocol.descriptor import sample_dtype
from protocol.device.records import Means, rows_of

CURRENT, HALL = (next(channel for channel in CHANNELS if channel.name == name) for name in ("i_a", "hall"))
DTYPE = sample_dtype(CHANNELS)


@given(
    index0=st.integers(0, 5000),
    decimation=st.integers(1, 400),
    pushes=st.lists(st.tuples(st.integers(1, 300), st.sampled_from([0, 0, 0, 0, 1, 77])), min_size=1, max_size=30),
)
def test_means_are_of_whole_records_wherever_pushes_are_cut(
    index0: int, decimation: int, pushes: list[tuple[int, int]]
) -> None:
    means = Means(DTYPE, [CURRENT, HALL], decimation)
    index, begin, found, due = index0, index0, {}, set()
    for n, missed in pushes:
        first, records = means.take(index, rows_of(samples(index, n), DTYPE))
        rows = records.view("<f4").reshape(-1, 2) if len(records) else []
        found |= {first + k * decimation: tuple(row) for k, row in enumerate(rows)}
        index += n
        due |= {end for end in range(begin, index) if end % decimation == 0 and end - decimation + 1 >= begin}
        index += missed
        begin = index if missed else begin
    assert found.keys() == due
    for end, (current, hall) in found.items():
        periods = samples(end - decimation + 1, decimation)
        assert current == np.float32(np.mean(periods["i_a"].astype(np.float64)))
        assert hall == periods["hall"][-1]
