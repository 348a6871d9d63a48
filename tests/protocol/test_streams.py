"""Decoders against what was sent: any loss, order, repetition and wrap-around, in batches of any size."""

from __future__ import annotations

import hbp_reference as reference
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_drive import CHANNELS, TICKS, identity, samples

from protocol.descriptor import Descriptor
from protocol.errors import RemoteProtocolError
from protocol.messages import StreamEvent, StreamReply, StreamSet
from protocol.streams import DISCONTINUITY, SampleDecoder, StreamConfig, TickReference
from protocol.wire import Decoder

DESCRIPTOR = Descriptor.of(CHANNELS, [])
BLOCK = 4


def config(decimation: int = 1, block: int = BLOCK) -> StreamConfig:
    return StreamConfig(
        1, 0, 77, StreamEvent.PWM, decimation, DESCRIPTOR.channels, block, tick_hz=20_000_000, pwm_hz=16_000
    )


def data_frame(seq: int, index: int, tick: int, raw: np.ndarray, flags: int = 0) -> bytes:
    head = reference.fields(
        ("u8", 0), ("u8", flags), ("u16", len(raw)), ("u16", 77),
        ("u16", seq & 0xFFFF), ("u32", index & 0xFFFFFFFF), ("u32", tick & 0xFFFFFFFF),
    )  # fmt: skip
    return reference.body(0x40, 1, 0, 1, head + raw.tobytes())


def run_of_frames(n: int, index0: int = 0, tick0: int = 0, seq0: int = 0, decimation: int = 1) -> list[bytes]:
    """Return n full blocks in a row."""
    step = BLOCK * decimation
    return [
        data_frame(seq0 + k, index0 + at, tick0 + at * TICKS, samples(index0 + at, step)[::decimation])
        for k, at in enumerate(range(0, n * step, step))
    ]


def decode_all(decoder: Decoder, batches: list) -> tuple[list, list[tuple]]:
    """Return the chunks, and their gaps with positions from the first sample on."""
    chunks, gaps, n = [], [], 0
    for chunk in map(decoder.decode, batches):
        if chunk is not None:
            gaps += [(n + g.position, g.lost_samples, g.lost_frames, g.overrun) for g in chunk.gaps]
            n += len(chunk)
            chunks.append(chunk)
    return chunks, gaps


def joined(chunks: list, name: str) -> list:
    return [value for chunk in chunks for value in getattr(chunk, name).tolist()]


def samples_at(index: np.ndarray) -> np.ndarray:
    """Return the sample that belongs to each index, whatever came."""
    return np.concatenate([samples(int(i), 1) for i in index])


deliveries = st.lists(st.integers(0, 30), max_size=50)  # which frame arrives next: lost, repeated, swapped
cuts = st.lists(st.integers(0, 50), max_size=8)


@given(deliveries, cuts, st.sampled_from([1, 3]))
def test_any_delivery_is_accounted_for(order: list[int], cut: list[int], decimation: int) -> None:
    step = BLOCK * decimation
    index0 = 2**32 - 15 * step
    tick0 = 2**32 - 17_000
    frames = run_of_frames(31, index0, tick0, decimation=decimation)
    decoder = SampleDecoder(config(decimation), TickReference(tick0))
    bounds = sorted({0, len(order), *(c for c in cut if c < len(order))})
    arrived = [frames[k] for k in order]
    batches = [arrived[a:b] for a, b in zip(bounds, bounds[1:] or [len(order)], strict=False)]
    chunks, gaps = decode_all(decoder, batches)
    for chunk in chunks:
        full = chunk.index + np.where(chunk.index < 2**31, 2**32, 0)
        assert (chunk.raw == samples_at(full)).all()

    newest, delivered, lost, rejected = -1, [], 0, 0
    for k in order:  # the oracle: a frame counts if it is newer than all before it
        if k <= newest:
            rejected += 1
            continue
        lost += k - newest - 1
        newest = k
        delivered.append(k)
    expected = [index0 + k * step + i * decimation for k in delivered for i in range(BLOCK)]
    shift = 2**32 if delivered and delivered[0] >= 15 else 0  # the first index that comes is taken as it is
    assert joined(chunks, "index") == [i - shift for i in expected]
    assert joined(chunks, "tick") == [tick0 + (i - index0) * TICKS for i in expected]
    counters = decoder.counters
    assert (counters.frames, counters.samples) == (len(delivered), len(expected))
    assert (counters.lost_by_seq, counters.lost_by_index) == (lost, lost * BLOCK)
    assert counters.out_of_order == rejected
    assert sum(g[1] for g in gaps) == counters.lost_by_index
    assert sum(g[2] for g in gaps) == counters.lost_by_seq


def test_a_gap_of_more_than_65536_frames_is_counted_in_full() -> None:
    decoder = SampleDecoder(config(), TickReference())
    lost = 3 * 65536 + 5
    decoder.decode(run_of_frames(1))
    chunk = decoder.decode(run_of_frames(1, (lost + 1) * BLOCK, (lost + 1) * BLOCK * TICKS, lost + 1))
    assert (chunk.gaps[0].lost_frames, chunk.gaps[0].lost_samples) == (lost, lost * BLOCK)


def test_ticks_unwrap_against_a_fresh_reference_after_a_long_pause() -> None:
    reference_ = TickReference()
    decoder = SampleDecoder(config(), reference_)
    decoder.decode(run_of_frames(1))
    pause = 1_000_000_000_000  # 14 hours: 232 wraps; the heartbeats went on
    reference_.tick = pause - 2_000_000
    chunk = decoder.decode(run_of_frames(1, pause // TICKS, pause, 1))
    assert chunk.tick[0] == pause


@pytest.mark.parametrize("ahead", [2**31 - 1, -(2**31) + 1, 0])
def test_unwrapping_takes_the_nearest(ahead: int) -> None:
    base = 7 * 2**32 + 12345
    got = TickReference(base).unwrap(np.array([(base + ahead) & 0xFFFFFFFF], np.uint32))
    assert got.tolist() == [base + ahead]


def test_physical_values() -> None:
    decoder = SampleDecoder(config(), TickReference())
    chunk = decoder.decode(run_of_frames(2))
    assert len(chunk) == 8
    assert chunk.physical("i_a").tolist() == [(k - 1000) / 1024 for k in range(8)]
    assert chunk.physical("i_a").dtype == np.float64
    assert chunk.config.channel("theta").scale == float(np.float32(np.pi / 32768))
    with pytest.raises(KeyError, match="no channel 'i_b' in the stream; there are: hall, status"):
        chunk.physical("i_b")


def test_nothing_decodes_to_nothing() -> None:
    decoder = SampleDecoder(config(), TickReference())
    assert decoder.decode([]) is None
    assert decoder.decode([b"short"]) is None
    assert decoder.counters.malformed == 1


@pytest.mark.parametrize(
    ("seq", "late", "flags", "gaps"),
    [
        (1, 0, DISCONTINUITY, [(BLOCK, 0, 0)]),  # without loss
        (2, 0, 0, [(BLOCK, 0, 1)]),  # a seq is missing, no sample is
        (1, 3, 0, []),  # the tick of each frame is believed
        (1, 0, 0x80, []),  # a flag of a later minor
    ],
)
def test_what_a_frame_says_besides_its_samples(seq: int, late: int, flags: int, gaps: list[tuple]) -> None:
    decoder = SampleDecoder(config(), TickReference())
    frames = [*run_of_frames(1), data_frame(seq, BLOCK, BLOCK * TICKS + late, samples(BLOCK, BLOCK), flags)]
    chunk = decoder.decode(frames)
    assert [(g.position, g.lost_samples, g.lost_frames) for g in chunk.gaps] == gaps
    assert (decoder.counters.lost_by_index, decoder.counters.lost_by_seq) == (0, seq - 1)
    assert chunk.tick.tolist() == [k * TICKS + late * (k >= BLOCK) for k in range(2 * BLOCK)]


def test_the_configuration_must_agree_with_the_descriptor() -> None:
    def of(sample_bytes: int, block: int, *channels: int) -> StreamConfig:
        request = StreamSet(0, StreamEvent.PWM, 1, 20, channels)
        return StreamConfig.of(identity(), request, StreamReply(0, 5, sample_bytes, block, 0.0), DESCRIPTOR)

    assert of(3, 10, 3, 1).dtype.names == ("theta", "hall")
    with pytest.raises(RemoteProtocolError, match="stream 0: 4 bytes a sample, 10 a frame by the device, 3"):
        of(4, 10, 3, 1)
    with pytest.raises(RemoteProtocolError, match="3 bytes a sample, 0 a frame"):
        of(3, 0, 3, 1)
    with pytest.raises(RemoteProtocolError, match=r"no channels with the ids \[99\]"):
        of(3, 10, 3, 99)
