from __future__ import annotations

from dataclasses import replace

import synthetic

from bench.view.blocks import Block, BlockBuilder
from protocol.streams import Gap


def taken(builder: BlockBuilder, now: float = 0.0, everything: bool = True) -> Block:
    block = builder.take(now, everything)
    assert block is not None
    return block


def test_a_block_closes_after_its_period_of_device_time() -> None:
    builder = BlockBuilder(0.05, synthetic.TICK_HZ)
    sizes = []
    for chunk in synthetic.SyntheticRun(0.5).sample_chunks(160):
        builder.samples(chunk, now=0.0)  # the host's clock stands still
        if block := builder.take(0.0):
            sizes.append(block.n_samples)
    assert (sizes, taken(builder).n_samples) == ([960] * 8, 320)
    assert builder.take(0.0, everything=True) is None


def test_without_samples_a_block_closes_by_the_hosts_clock() -> None:
    builder = BlockBuilder(0.05, synthetic.TICK_HZ)
    builder.heartbeat(1, synthetic.heartbeat(5), now=10.0)
    builder.note("something", "INFO", now=10.01)
    assert builder.take(10.04) is None
    block = taken(builder, 10.05, everything=False)
    assert len(block.heartbeats) == 1
    assert block.notes == [(5, "something", "INFO")]  # at the device's time when it was said


def test_losses_are_counted_by_index_by_sequence_and_by_the_device(made: synthetic.SyntheticRun) -> None:
    builder = BlockBuilder(1e9, synthetic.TICK_HZ)
    chunks = made.sample_chunks(100)
    builder.samples(chunks[0], 0.0)
    builder.samples(replace(chunks[2], gaps=(Gap(0, 100, 7, False),)), 0.0)
    builder.edges(replace(made.edge_chunk(4, 8), gaps=(Gap(2, 3, 1, False),)), 0.0)
    builder.heartbeat(1, synthetic.heartbeat(0, tx_dropped=2), 0.0)
    builder.heartbeat(2, synthetic.heartbeat(0, tx_dropped=3), 0.0)
    builder.heartbeat(1, synthetic.heartbeat(0, tx_dropped=4), 0.0)
    builder.heartbeat(2, synthetic.heartbeat(0, tx_dropped=8), 0.0)  # 2 and 5 since the run began
    block = taken(builder)
    assert block.losses == {
        "lost:samples": 100,
        "lost:sample_frames": 7,
        "lost:edges": 3,
        "lost:by_device": 7,
    }


def test_what_is_lost_at_the_end_of_the_streams_is_counted_without_a_chunk_to_tell_of_it() -> None:
    builder = BlockBuilder(0.055, synthetic.TICK_HZ)
    builder.missing(3, 245, 10.0)
    assert builder.take(10.0) is None
    block = taken(builder, 11.0, everything=False)
    assert (block.losses["lost:samples"], block.losses["lost:edges"]) == (3, 245)


def test_an_outage_that_no_gap_tells_of_becomes_one(made: synthetic.SyntheticRun) -> None:
    """After a lost link streams start anew: the decoder has no gap to tell of, the index has."""
    builder = BlockBuilder(1e9, synthetic.TICK_HZ)
    chunks = made.sample_chunks(100)
    for chunk in (chunks[0], chunks[5], replace(chunks[1])):  # the last one goes back: a reboot is no loss
        builder.samples(chunk, 0.0)
    block = taken(builder)
    assert [chunk.gaps for chunk in block.samples] == [(), (Gap(0, 400, 0, False),), ()]
    assert block.losses["lost:samples"] == 400


def test_an_outage_is_counted_whole_when_the_first_frame_after_it_is_lost_too(made: synthetic.SyntheticRun) -> None:
    builder = BlockBuilder(1e9, synthetic.TICK_HZ)
    chunks = made.sample_chunks(100)
    builder.samples(chunks[0], 0.0)
    builder.samples(replace(chunks[20], gaps=(Gap(0, 15, 1, False), Gap(50, 2, 1, True))), 0.0)
    block = taken(builder)
    assert block.samples[1].gaps == (Gap(0, 1900, 1, False), Gap(50, 2, 1, True))
    assert block.losses["lost:samples"] == 1902
