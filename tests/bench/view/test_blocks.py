"""Blocks close by the drive's time or the host's; the account of losses is that of the run, not of what is shown."""

from __future__ import annotations

from dataclasses import replace

import synthetic

from bench.device.heard import Missing, Note
from bench.device.losses import Continuity, LossAccount
from bench.view.blocks import Block, BlockBuilder
from protocol.host import HeartbeatReceived
from protocol.streams import Gap


def taken(builder: BlockBuilder, now: float = 0.0, everything: bool = True) -> Block:
    block = builder.close(now, everything)
    assert block is not None
    return block


def test_a_block_closes_after_its_period_of_device_time() -> None:
    builder = BlockBuilder(0.05, synthetic.TICK_HZ)
    sizes = []
    for chunk in synthetic.SyntheticRun(0.5).sample_chunks(160):
        builder.add(chunk, now=0.0)  # the host's clock stands still
        if block := builder.close(0.0):
            sizes.append(block.n_samples)
    assert (sizes, taken(builder).n_samples) == ([960] * 8, 320)
    assert builder.close(0.0, everything=True) is None


def test_without_samples_a_block_closes_by_the_hosts_clock() -> None:
    """What is lost at the end of the streams has no chunk to tell of it."""
    builder = BlockBuilder(0.05, synthetic.TICK_HZ)
    items = [HeartbeatReceived(1, synthetic.heartbeat(5)), Note(5, "something"), Missing(5, 1, 3, 245)]
    for item in items:
        builder.add(item, now=10.0)
    assert builder.close(10.04) is None
    block = taken(builder, 10.05, everything=False)
    assert (block.items, block.of(Note)) == (items, [items[1]])
    assert (block.losses["lost:samples"], block.losses["lost:edges"]) == (3, 245)


def test_losses_are_counted_by_index_by_sequence_and_by_the_device(made: synthetic.SyntheticRun) -> None:
    account = LossAccount()
    chunks = made.sample_chunks(100)
    account.take(chunks[0])
    account.take(replace(chunks[2], gaps=(Gap(0, 100, 7, False),)))
    account.take(replace(made.edge_chunk(4, 8), gaps=(Gap(2, 3, 1, False),)))
    for node, dropped in ((1, 2), (2, 3), (1, 4), (2, 8)):  # 2 and 5 since the run began
        account.take(HeartbeatReceived(node, synthetic.heartbeat(0, tx_dropped=dropped)))
    assert account.counters == {"samples": 100, "sample_frames": 7, "edges": 3, "by_device": 7}


def test_an_outage_that_no_gap_tells_of_becomes_one(made: synthetic.SyntheticRun) -> None:
    """After a lost link streams start anew: the decoder has no gap to tell of, or too small a one; the index has."""
    continuity = Continuity()
    chunks = made.sample_chunks(100)
    first = replace(chunks[20], gaps=(Gap(0, 15, 1, False), Gap(50, 2, 1, True)))  # its first frame is lost too
    came = [continuity.chunk(chunk) for chunk in (chunks[0], chunks[5], first, chunks[1])]  # going back is no loss
    whole = (Gap(0, 1400, 1, False), Gap(50, 2, 1, True))
    assert [chunk.gaps for chunk in came] == [(), (Gap(0, 400, 0, False),), whole, ()]
    continuity.restarted(1)
    assert continuity.chunk(chunks[9]).gaps == ()
