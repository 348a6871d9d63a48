"""Streams from a device to a host over CAN frames that are lost, doubled, delayed, forged; every value is checked.

The oracle is the small drive's rule by which each value follows from its index (`small_drive.samples`).
"""

from __future__ import annotations

import numpy as np
import pytest
from can_pair import CLASSIC, FD, HZ, TICKS, CanPair, Spoil
from hypothesis import given
from hypothesis import strategies as st

from protocol.canmap.frame import CAN_RECORD, FD_LENGTHS, BusRates
from protocol.canmap.host import MAX_HELD
from protocol.canmap.layout import sample_layout
from protocol.canmap.plan import BusPlan
from protocol.host import Rebooted
from protocol.messages import DriveState, StreamEvent, StreamSet, StreamStop
from protocol.signals import RawType
from protocol.streams import Beat, LossCounters
from tests.choice import examples

pytestmark = pytest.mark.slow

ALL = ("hall", "status", "theta", "i_a", "count")
CASES = [
    (CLASSIC, ("hall",), 1),
    (CLASSIC, ("i_a",), 2),
    (CLASSIC, ("hall", "status", "theta"), 7),
    (CLASSIC, ALL, 40),
    (FD, ("i_a",), 1),
    (FD, ALL, 1),
    (FD, ALL, 40),
]


def kinds(record: np.ndarray) -> np.ndarray:
    return record["id"] >> 8 & 7


def pair(rates: BusRates, names: tuple[str, ...], decimation: int, extended: bool = False) -> CanPair:
    made = CanPair(rates, extended)
    made.connect()
    made.stream(names, decimation)
    return made


@pytest.mark.parametrize("extended", [False, True])
@pytest.mark.parametrize(("rates", "names", "decimation"), CASES)
def test_every_sample_and_edge_arrives_with_its_time(
    rates: BusRates, names: tuple[str, ...], decimation: int, extended: bool
) -> None:
    bus = pair(rates, names, decimation, extended)
    at = tuple(range(3, 4000, 31))
    bus.run(4000, at)
    got = bus.samples()
    n = len(range(0, 4000, decimation)) // got.config.block * got.config.block
    assert got.index.tolist() == [decimation * k for k in range(n)]
    edges = bus.edges()
    assert np.concatenate([e.tick for e in edges]).tolist() == [p * TICKS - TICKS // 2 for p in at]
    assert np.concatenate([e.index for e in edges]).tolist() == list(range(len(at)))
    assert np.concatenate([e.encoder for e in edges]).tolist() == [(p * TICKS - TICKS // 2) % 4096 for p in at]
    for decoder in bus.decoders.values():
        assert decoder.counters == LossCounters(samples=decoder.counters.samples, frames=decoder.counters.frames)
    assert bus.wire.counters.stale == bus.wire.counters.foreign == bus.wire.counters.bad == 0


def test_a_group_that_never_comes_costs_its_samples_and_no_memory() -> None:
    bus = pair(CLASSIC, ALL, 40)
    bus.run(400)
    before = len(bus.samples())
    bus.run(40 * 1000, spoil=lambda records: records[records["id"] != bus.decoders[0].ids[1]])
    assert len(bus.samples()) == before
    assert all(len(numbers) <= 257 for numbers, _ in bus.decoders[0]._waiting)
    bus.run(400)
    _, counters = bus.account(40)
    assert (counters.lost_by_index, counters.lost_by_seq) == (1000, 1000)


def test_edges_that_come_after_their_samples_are_marked() -> None:
    bus = pair(FD, ALL, 1)
    held: list[np.ndarray] = []

    def delay(records: np.ndarray) -> np.ndarray:
        edges = kinds(records) == 4
        held.append(records[edges])
        return np.concatenate([records[~edges], *([held.pop(0)] if len(held) > 2 else [])])

    bus.run(800, (200,))
    assert bus.decoders[1].counters.late == 0
    bus.run(800, (100, 300), spoil=delay)
    counters = bus.decoders[1].counters
    assert (counters.samples, counters.late, counters.lost_by_index) == (3, 2, 0)
    gaps = [gap for chunk in bus.edges() for gap in chunk.gaps]
    assert [(gap.lost_samples, gap.lost_frames) for gap in gaps] == [(0, 0), (0, 0)]


def trouble(bus: CanPair, kind: str, n: int) -> None:
    """Let `n` PWM periods pass with an edge every 16, while what is sent to the host has this trouble."""
    rng = np.random.default_rng(n)
    edges, kept = tuple(range(1, n, 16)), []

    def keep(records: np.ndarray) -> np.ndarray:
        kept.append(records)
        return records[:0]

    spoils: dict[str, Spoil] = {
        "frames lost": lambda records: records[(rng.random(len(records)) > 0.2) | (kinds(records) < 4)],
        "frames twice": lambda records: np.repeat(records, 2),
        "a silent bus": lambda records: records[:0],
        "silent streams": lambda records: records[kinds(records) < 4],
        "one group gone": lambda records: records[records["id"] != bus.decoders[0].ids[-1]],
        "a frame is another": lambda records: mutated(records, rng, bus.wire.rates.fd),
        "noise": lambda records: np.concatenate([records, noise(rng, bus)]),
    }
    if kind in spoils:
        bus.run(n, edges, 80 if n < 20_000 else 1600, spoils[kind])
    elif kind == "read late":  # an adapter keeps the frames of a host that stands still
        bus.run(min(n, 48_000), edges, spoil=keep)
        bus.run(80, spoil=lambda records: np.concatenate([*kept, records]))
    else:  # it ran over meanwhile
        bus.run(n, edges, spoil=keep)
        streams = [records[kinds(records) >= 4] for records in kept]
        bus.run(80, spoil=lambda records: np.concatenate([*streams[:60], *streams[-10:], records]))


def noise(rng: np.random.Generator, bus: CanPair) -> np.ndarray:
    """Frames with any identifier and content, half of them with an identifier of HBP; the device has them too."""
    n, lengths = 200, FD_LENGTHS if bus.wire.rates.fd else FD_LENGTHS[:9]
    records = np.zeros(n, CAN_RECORD)
    records["id"] = np.where(rng.random(n) < 0.5, rng.integers(0, 0x800, n), rng.integers(0, 1 << 32, n))
    records["length"], records["flags"] = rng.choice(lengths, n), rng.integers(0, 8, n)
    records["data"] = rng.integers(0, 256, (n, 64))
    bus.device.receive(records.tobytes())
    assert bus.device.session.state is DriveState.IDLE
    return records[~np.isin(records["id"], [*bus.decoders[0].ids, *bus.decoders[1].ids])]


def mutated(records: np.ndarray, rng: np.random.Generator, fd: bool) -> np.ndarray:
    """Some frames with another identifier, length or content, some gone, some twice.

    The content of streams, and of frames that stand alone, as a heartbeat in FD, is left: CAN's own CRC protects that.
    """
    records = records.copy()
    stream, what = kinds(records) >= 4, rng.random(len(records))
    ids, lengths = what < 0.02, (what > 0.02) & (what < 0.04)
    records["id"][ids] = rng.integers(0, 0x400, int(ids.sum()))  # never that of a stream
    before = records["length"].copy()
    records["length"][lengths] = rng.choice(FD_LENGTHS if fd else FD_LENGTHS[:9], int(lengths.sum()))
    contents = (what > 0.04) & (what < 0.3) & ~stream & (not fd)
    records["data"][contents, rng.integers(0, 8)] ^= np.uint8(rng.integers(1, 256))
    keep = ~(lengths & stream & (records["length"] == before))
    return np.repeat(records, np.where(what > 0.97, 0, np.where(what > 0.94, 2, 1)) * keep)


SPOILT = ("frames lost", "frames twice", "a silent bus", "silent streams", "one group gone", "a frame is another")
TROUBLE = st.tuples(
    st.sampled_from((*SPOILT, "noise", "read late", "ran over")), st.sampled_from([3200, 3200, 3205, 16_000, 66_336])
)


@examples(8, 200, campaign="can")
@given(st.sampled_from(CASES), st.lists(TROUBLE, min_size=2, max_size=4))
def test_whatever_happens_each_sample_and_edge_comes_or_is_counted(
    case: tuple, troubles: list[tuple[str, int]]
) -> None:
    """However long, a whole turn of the counter included: heartbeats, or the next one, say what time it is."""
    *_, decimation = case
    bus = pair(*case)
    bus.run(3200, tuple(range(1, 3200, 16)))
    for kind, n in troubles:
        trouble(bus, kind, n)
        bus.run(4800 + n % 16, tuple(range(1, 4800, 16)))
    got, _ = bus.account(decimation)
    assert got.index[-1] > bus.periods - 2 * decimation * max(5, got.config.block)
    edges = bus.decoders[1].counters
    assert edges.samples + edges.lost_by_index == bus.edges_made
    assert bus.edges()[-1].index[-1] == bus.edges_made - 1
    for chunk in bus.edges():
        assert (chunk.tick % 4096 == chunk.encoder).all()
    for number, decoder in bus.decoders.items():
        gaps = [gap.lost_samples for chunk in bus.chunks[number] for gap in chunk.gaps]
        assert sum(gaps) == decoder.counters.lost_by_index
        assert decoder.missing(None, Beat((bus.periods - 1) * TICKS, bus.edges_made)) == 0


def test_without_heartbeats_frames_are_held_back_and_then_given_up() -> None:
    bus = CanPair(FD)
    bus.connect()
    bus.stream(("hall",), 1, edges=False, latency=0)  # a frame a sample
    bus.run(1600)
    before = len(bus.samples())
    bus.run(16_000, spoil=lambda records: records[kinds(records) >= 4])
    assert len(bus.samples()) - before < 0.5 * 16_000  # some 0.35 s go on, the rest waits for a heartbeat
    bus.run(16_000 * 3, portion=800, spoil=lambda records: records[kinds(records) >= 4])
    assert bus.wire.counters.overdue > 0
    assert sum(len(part) for part in bus.wire._nodes[1].held) == MAX_HELD
    bus.run(3200)
    assert bus.account()[0].index[-1] > bus.periods - 100


def test_a_new_configuration_has_slots_of_its_own() -> None:
    """Frames that were under way when a stream was configured anew belong to no stream."""
    bus = CanPair(FD)
    bus.connect()
    old: np.ndarray = np.empty(0, CAN_RECORD)
    slots = set()
    for names in (("i_a",), ("theta",), ("hall", "status"), ALL) * 3:
        config = bus.stream(names, edges=False)
        slots.add(config.slot)
        stale = bus.wire.counters.stale
        bus.receive(old)
        assert bus.wire.counters.stale - stale == len(old)
        recorded: list[np.ndarray] = []
        bus.run(1600, spoil=lambda each, recorded=recorded: (recorded.append(each[kinds(each) >= 4]), each)[1])
        old = np.concatenate(recorded)
        assert len(old)
        bus.samples()
        bus.ask(StreamStop())
    assert len(slots) == 12


def test_frames_that_waited_in_the_device_are_given_up_there() -> None:
    """A device off the bus for 10 s does not send what is older than half a second, and says so."""
    bus = pair(CLASSIC, ("hall",), 1)
    bus.run(3200)
    take, stopped = bus.device.tx.take, [True]
    bus.device.tx.take = lambda limit=None: b"" if stopped[0] else take(limit)  # type: ignore[method-assign]
    bus.run(160_000, portion=800)
    stopped[0] = False
    bus.run(4800)
    assert bus.account()[1].lost_by_seq == bus.device.session.heartbeat().tx_dropped > 20_000


def test_edges_are_placed_from_the_first_on_however_many_there_are() -> None:
    """2000 a second: some 200 come between a heartbeat and the first frame of a stream."""
    bus = CanPair(FD)
    bus.connect()
    for n in range(12):
        bus.run(1600 + 130 * n, tuple(range(1, 1600 + 130 * n, 8)))
        bus.decoders.clear()
        made = bus.edges_made
        bus.stream(ALL)
        bus.run(160, tuple(range(1, 160, 8)))
        first = next((chunk for chunk in bus.edges()), None)
        if first is not None:
            assert first.index[0] == made
        bus.run(3200, tuple(range(1, 3200, 8)))
        assert bus.edges()[-1].index[-1] == bus.edges_made - 1
        bus.ask(StreamStop())


def test_after_a_reboot_frames_belong_to_nobody_until_a_stream_is_configured() -> None:
    bus = pair(CLASSIC, ("hall",), 1)
    bus.run(1600)
    before = len(bus.chunks[0])
    slots = bus.decoders[0].ids
    again = CanPair(CLASSIC, boot_id=77)
    again.connect()
    again.stream(("status",), 1)
    assert again.decoders[0].ids != slots
    again.host.receive_data = lambda data, now: None  # type: ignore[method-assign]
    bus.device = again.device
    bus.periods = 0
    bus.run(4800)
    assert any(isinstance(event, Rebooted) for event in bus.events)
    assert len(bus.chunks[0]) == before
    assert bus.wire.counters.stale > 100


def test_a_forged_edge_far_ahead_does_not_stop_the_edges() -> None:
    bus = pair(FD, ALL, 1)
    bus.run(1600, tuple(range(1, 1600, 16)))
    forged = np.zeros(1, CAN_RECORD)
    forged["id"], forged["length"] = bus.decoders[1].ids[0], 8
    forged["data"][0, :4] = np.frombuffer(((bus.periods + 40_000) * TICKS).to_bytes(4, "little"), np.uint8)
    bus.receive(forged)
    bus.run(1600, tuple(range(1, 1600, 16)))
    counters = bus.decoders[1].counters
    assert (counters.samples, counters.lost_by_index, counters.out_of_order) == (200, 0, 1)


# -- what a device answers --------------------------------------------------------------------------------------------


def test_what_does_not_fit_the_bus_is_refused_with_what_would() -> None:
    bus = CanPair(CLASSIC)
    bus.connect()
    refusal = bus.ask(StreamSet(0, StreamEvent.PWM, 1, 20, (3, 4)))
    fits = int(refusal.detail)
    # 6-byte frames, one sample each: 54 stuffed bits at most 16 stuff bits, 13 that are never stuffed, at 16 kHz
    worst = (34 + 48 + (34 + 48 - 1) // 4 + 13) * 16_000 / 1e6
    assert fits == int(np.ceil(worst / 0.95)) == 2
    reply = bus.ask(StreamSet(0, StreamEvent.PWM, fits, 20, (3, 4)))
    assert reply.load == pytest.approx(worst / 2, rel=1e-6)


def test_layouts_by_hand() -> None:
    assert sample_layout([2], False, 100).samples == 3
    assert sample_layout([1, 1, 2, 2, 4], False, 100).groups == ((0, 6), (6, 10))
    assert sample_layout([4, 4], False, 100).groups == ((0, 4), (4, 8))
    fd = sample_layout([1, 1, 2, 2, 4], True, 100)
    assert (fd.samples, fd.length(0)) == (6, 64)
    wide = sample_layout([2] * 31, True, 100)
    assert (wide.groups, wide.length(1)) == (((0, 60), (60, 62)), 6)
    assert sample_layout([2], True, 4).samples == 4
    assert sample_layout([2], True, 0).samples == 1


@pytest.mark.parametrize(("data_bitrate", "most"), [(None, 1), (2_000_000, 4), (5_000_000, 7), (8_000_000, 11)])
def test_how_many_channels_fit_at_16_khz(data_bitrate: int | None, most: int) -> None:
    plan = BusPlan(BusRates(1_000_000, data_bitrate), False, HZ // TICKS)
    fit = plan.most([2] * 14, 1)
    assert fit.channels == most
    for each in plan.choices([2] * 14):
        widths = [2] * each.channels
        assert plan.load(widths, round(16_000 / each.rate)) == each.load <= 0.95
        assert each.rate == 16_000 or plan.load(widths, round(16_000 / each.rate) - 1) > 0.95


def test_raw_types_fit_a_classic_frame() -> None:
    assert max(np.dtype(kind.dtype).itemsize for kind in RawType) <= 6
