"""The transmit queue against a list of frames: what finds room, in which order it leaves, cut anywhere."""

from __future__ import annotations

from itertools import accumulate

from hypothesis import example, given
from hypothesis import strategies as st

from protocol.device.tx import TxQueue

SIZES = st.lists(st.integers(1, 9), min_size=1, max_size=7)
STEP = st.one_of(
    st.tuples(st.just("put"), SIZES),
    st.tuples(st.just("control"), st.integers(1, 9)),
    st.tuples(st.just("take"), st.none() | st.integers(0, 30)),
    st.tuples(st.just("expire"), st.just(0)),
)


PARTS = [("put", [3, 3, 3, 3]), ("take", 3), ("take", 3), *[("expire", 0)] * 4]


@example(60, PARTS)
@given(st.integers(0, 60), st.lists(STEP, max_size=40))
def test_frames_leave_whole_and_in_order_whatever_is_taken(room, steps):
    """A frame that found no room leaves no trace; one of which a part is gone is finished before a reply goes."""
    tx = TxQueue(bulk_limit=room)
    bulk, control, rest = [], [], b""
    number = now = 0
    queued_at = []  # of each frame in `bulk`, the call of `expire` that follows
    for step, what in steps:
        if step == "put":
            frames = [bytes([number + k & 0xFF]) * size for k, size in enumerate(what)]
            number += len(frames)
            found = tx.put_bulk(b"".join(frames), list(accumulate(map(len, frames))))
            fits = 0
            while fits < len(frames) and sum(map(len, [*bulk, *frames[: fits + 1]])) <= room:
                fits += 1
            assert found == fits
            bulk += frames[:fits]
            queued_at += [now] * fits
        elif step == "control":
            wire = bytes([0xFF]) * what
            assert tx.put_control(wire)
            control.append(wire)
        elif step == "take":
            taken = tx.take(what)
            limit = len(rest) + sum(map(len, [*control, *bulk])) if what is None else what
            while len(rest) < limit and (control or bulk):
                if control:
                    rest += control.pop(0)
                else:
                    rest += bulk.pop(0)
                    queued_at.pop(0)
            assert taken == rest[:limit]
            rest = rest[limit:]
        else:
            now += 1
            old = sum(now - at > 2 for at in queued_at)
            assert tx.expire(now, 1) == old
            del bulk[:old], queued_at[:old]
        assert len(tx) == len(rest) + sum(map(len, [*control, *bulk]))
