"""The simulated CAN bus: who gets it, for how long, and what errors and faults do."""

from __future__ import annotations

from collections import deque

import numpy as np
import pytest
from can_rows import frame

from protocol.canmap.frame import (
    BRS,
    CAN_RECORD,
    ERROR,
    ERROR_BUS_OFF,
    ERROR_CONTROLLER,
    ERROR_NO_ACK,
    ERROR_PROTOCOL,
    ERROR_RESTARTED,
    EXTENDED,
    FDF,
    REMOTE,
    BusRates,
)
from protocol.errors import LocalProtocolError
from sim.ports.can_bus import SimulatedBus, State

BIT = 1e-6
CLASSIC = BusRates(1_000_000)
FD = BusRates(1_000_000, 5_000_000)
RECOVERY = 1408 * BIT  # 128 x 11 recessive bits


# A frame without stuff bits: no five equal bits in header and data, nor in its CRC, which is 110110000111101.
PLAIN_DATA = b"\x5a" * 8
PLAIN = frame(0x555, PLAIN_DATA)
PLAIN_BITS = 111


class Node:
    """A node with a queue to send and lists of what it got."""

    def __init__(self, bus: SimulatedBus, name: str, auto_restart: float | None = 0.1) -> None:
        self.queue: deque[bytes] = deque()
        self.got: list[np.void] = []
        self.errors: list[tuple[int, int]] = []
        self.error_times: list[float] = []
        self.controller = bus.attach(self._next, self._take, name, self._take_error, auto_restart)

    def _next(self) -> bytes:
        return self.queue.popleft() if self.queue else b""

    def _take(self, row: bytes) -> None:
        self.got.append(np.frombuffer(row, CAN_RECORD)[0])

    def _take_error(self, row: bytes) -> None:
        error = np.frombuffer(row, CAN_RECORD)[0]
        assert int(error["id"]) & ERROR
        assert error["length"] == 8
        self.errors.append((int(error["id"]) & ~ERROR, int(error["data"][1])))
        self.error_times.append(float(error["time"]))

    @property
    def ids(self) -> list[int]:
        return [int(row["id"]) for row in self.got]

    @property
    def times(self) -> list[float]:
        return [float(row["time"]) for row in self.got]


def pair(rates: BusRates = CLASSIC, seed: int = 0) -> tuple[SimulatedBus, Node, Node]:
    bus = SimulatedBus(rates, seed)
    return bus, Node(bus, "first"), Node(bus, "second")


def test_a_frame_arrives_at_its_end_with_its_content() -> None:
    bus, first, second = pair()
    first.queue.append(PLAIN)
    bus.advance(PLAIN_BITS * BIT - 1e-9)
    assert second.got == []
    bus.advance(PLAIN_BITS * BIT + 1e-9)
    bus.advance(0.0)  # the past
    assert second.times == [pytest.approx(PLAIN_BITS * BIT)]
    assert second.got[0]["id"] == 0x555
    assert second.got[0]["length"] == 8
    assert second.got[0]["data"].tobytes() == PLAIN_DATA + bytes(56)
    assert first.got == []  # nobody hears himself
    assert (bus.frames, bus.time) == (1, PLAIN_BITS * BIT + 1e-9)


def test_arbitration_follows_the_bits_on_the_wire() -> None:
    order = [
        0x000,
        0x0FF,
        0x100,
        0x100 | REMOTE,  # RTR recessive
        0x100 << 18 | EXTENDED,  # SRR and IDE recessive
        0x100 << 18 | EXTENDED | REMOTE,
        0x100 << 18 | 1 | EXTENDED,
        0x101,
        0x7FF,
        0x1FFFFFFF | EXTENDED,
        0x1FFFFFFF | EXTENDED | REMOTE,
    ]
    bus = SimulatedBus(CLASSIC)
    listener = Node(bus, "listener")
    for can_id in np.random.default_rng(1).permutation(np.array(order)).tolist():
        Node(bus, f"{can_id:#x}").queue.append(frame(can_id))
    bus.advance(0.01)
    assert listener.ids == order
    assert bus.collisions == 0


def test_of_two_with_one_identifier_the_first_attached_sends_and_it_is_counted() -> None:
    bus, first, second = pair()
    listener = Node(bus, "listener")
    second.queue.append(frame(0x10, b"2"))
    first.queue.append(frame(0x10, b"1"))
    bus.advance(0.01)
    assert [row["data"][0] for row in listener.got] == [ord("1"), ord("2")]
    assert bus.collisions == 1


@pytest.mark.parametrize("bits", [50, PLAIN_BITS], ids=["under way", "as it ends"])
def test_a_better_frame_waits_for_the_end_of_the_one_under_way(bits: int) -> None:
    bus, first, second = pair()
    listener = Node(bus, "listener")
    first.queue.extend([PLAIN, PLAIN])
    bus.advance(bits / 1_000_000)
    assert listener.ids == [0x555] * (bits == PLAIN_BITS)
    second.queue.append(frame(0))
    bus.advance(0.01)
    assert listener.ids == [0x555, 0, 0x555]


@pytest.mark.parametrize(
    ("rates", "row", "seconds"),
    [
        (CLASSIC, PLAIN, 111e-6),
        # SOF to BRS 17 and the tail 13 at 1 Mbit/s; ESI, DLC, 64 bytes and CRC field 4 + 21 + 7 at 5 Mbit/s
        (FD, frame(0x555, b"\x55" * 64, FDF | BRS), 30e-6 + (5 + 512 + 32) / 5e6),
        (FD, frame(0x555, b"\x55" * 64, FDF), (30 + 5 + 512 + 32) * 1e-6),
    ],
    ids=["classic", "CAN FD", "CAN FD at one rate"],
)
def test_a_saturated_bus_carries_one_frame_per_frame_time(rates: BusRates, row: bytes, seconds: float) -> None:
    bus = SimulatedBus(rates)
    times: list[float] = []
    bus.attach(lambda: row, lambda _: None, "sender")
    bus.attach(lambda: b"", lambda _: times.append(bus.time), "receiver")
    bus.advance(0.5)
    assert bus.frames == int(0.5 / seconds)
    assert np.diff(times) == pytest.approx(seconds)
    assert bus.busy_seconds == pytest.approx(bus.frames * seconds)


@pytest.mark.parametrize("load", [0.05, 0.8, 1.0])
@pytest.mark.parametrize("rates", [CLASSIC, FD])
def test_a_babbling_node_takes_its_share_in_equal_steps_until_it_is_detached(load: float, rates: BusRates) -> None:
    bus = SimulatedBus(rates)
    babbler = bus.babble(0x123, load)
    listener = Node(bus, "listener")
    bus.advance(0.5)
    assert bus.busy_seconds / 0.5 == pytest.approx(load, abs=1e-3)
    assert np.ptp(np.diff(listener.times)) < 1e-9
    assert bus.busy_seconds / bus.frames / load == pytest.approx(np.diff(listener.times).mean())
    bus.detach(babbler)
    bus.advance(0.51)
    carried = bus.frames
    bus.advance(0.52)
    assert bus.frames == carried


@pytest.mark.parametrize(("load", "length"), [(0.0, 8), (1.1, 8), (0.5, 9)])
def test_a_babbling_node_that_cannot_be_is_refused(load: float, length: int) -> None:
    with pytest.raises(LocalProtocolError):
        SimulatedBus(CLASSIC).babble(0x123, load, length)


def drive(step: float | None, seed: int = 7) -> tuple[list[float], list[int], tuple[float, ...]]:
    """A bus with all that keeps state between calls, run for 0.1 s at once or in steps."""
    bus = SimulatedBus(CLASSIC, seed)
    bus.babble(0x200, 0.3)
    sender, listener = Node(bus, "sender", auto_restart=0.01), Node(bus, "listener")
    sender.queue.extend(frame(0x300 + k % 7, bytes([k % 256] * (k % 9))) for k in range(2000))
    bus.faults.drop, bus.faults.duplicate, bus.faults.delay = 0.1, 0.1, lambda can_id: 1e-4 * (can_id % 3)
    ends = iter(range(10**9))
    bus.corrupt = lambda row, _: int.from_bytes(row[:4], "little") == 0x303 and next(ends) % 60 > 20
    if step is None:
        bus.advance(0.1)
    else:
        for k in range(int(0.1 / step)):
            bus.advance((k + 1) * step)
        bus.advance(0.1)
    assert (0x40, 0) in sender.errors  # bus-off was part of it
    assert min(bus.dropped, bus.duplicated, bus.error_frames, bus.abandoned) > 0
    state = (bus.time, bus.busy_seconds, bus.frames, bus.error_frames, bus.dropped, bus.duplicated, bus.abandoned)
    return listener.times, listener.ids, (*state, sender.controller.tec, listener.controller.rec)


def test_the_size_of_the_steps_makes_no_difference_and_the_seed_does() -> None:
    whole = drive(None)
    assert drive(1e-4) == drive(7.3e-6) == drive(0.033) == whole
    assert drive(None, 8)[0] != whole[0]


@pytest.mark.parametrize("delay", [PLAIN_BITS / 1_000_000, 0.002], ids=["as a frame ends", "on an idle bus"])
def test_what_happens_at_one_time_happens_before_the_next_frame_starts(delay: float) -> None:
    bus, first, second = pair()
    third = Node(bus, "third")
    answers = iter([(second, 0x300), (third, 0x100)])

    def answer(row: bytes) -> None:
        if row[:4] == PLAIN[:4]:
            node, can_id = next(answers)
            node.queue.append(frame(can_id))

    bus.attach(lambda: b"", answer, "answering")
    delays = iter([delay, 0.0, 0.0, 0.0])  # the second frame waits for the first: both arrive at once
    bus.faults.delay = lambda _: next(delays)
    first.queue.extend([PLAIN, PLAIN])
    bus.advance(0.01)
    assert second.times[0] == second.times[1]
    assert first.ids == [0x100, 0x300]


def test_alone_on_the_bus_a_node_repeats_its_frame_and_turns_error_passive() -> None:
    bus = SimulatedBus(CLASSIC)
    lonely = Node(bus, "lonely")
    lonely.queue.append(PLAIN)
    # up to the ACK slot, then flag, delimiter and interframe space: 111 - 11 + 17 bits, again and again
    bus.advance(15.5 * 117 * BIT)
    assert (lonely.controller.tec, lonely.controller.state) == (15 * 8, State.WARNING)
    bus.advance(1.0)
    assert (lonely.controller.tec, lonely.controller.state) == (128, State.PASSIVE)
    assert lonely.errors == [
        *[(ERROR_NO_ACK, 0)] * 12,
        (ERROR_CONTROLLER, 0x08),  # TEC 96
        *[(ERROR_NO_ACK, 0)] * 4,
        (ERROR_CONTROLLER, 0x20),  # TEC 128
    ]
    assert bus.frames == 0
    assert bus.error_frames == pytest.approx(1.0 / (117 * BIT), abs=1)
    assert bus.busy_seconds == pytest.approx(1.0, abs=2e-4)
    listener = Node(bus, "listener")
    bus.advance(1.01)
    assert (len(listener.got), bus.frames, lonely.controller.tec) == (1, 1, 127)


def test_a_destroyed_frame_is_repeated_and_counted() -> None:
    bus, first, second = pair()
    asked: list[tuple[bytes, float]] = []

    def corrupt(row: bytes, now: float) -> bool:
        asked.append((row, now))
        return len(asked) <= 3

    bus.corrupt = corrupt
    first.queue.append(PLAIN)
    bus.advance(3 * (PLAIN_BITS + 20) * BIT + 1e-9)  # a frame and an error frame of 23 bits, interframe space once
    assert (first.controller.tec, second.controller.rec) == (24, 3)
    assert second.got == []
    assert bus.error_frames == 3
    assert bus.busy_seconds == pytest.approx(3 * 131 * BIT)
    bus.advance(0.01)
    assert second.times == [pytest.approx((3 * 131 + 111) * BIT)]
    assert (first.controller.tec, second.controller.rec) == (23, 2)
    assert (first.controller.rec, second.controller.tec) == (0, 0)
    assert [row for row, _ in asked] == [PLAIN] * 4
    assert [now for _, now in asked] == pytest.approx([(k * 131 + 111) * BIT for k in range(4)])
    assert first.errors == second.errors == [(ERROR_PROTOCOL, 0)] * 3


def test_a_receiver_warns_turns_passive_and_comes_back() -> None:
    bus = SimulatedBus(CLASSIC)
    receiver = Node(bus, "receiver")
    for k in range(5):  # each is off after 32 errors, the best first
        Node(bus, f"sender {k}", auto_restart=None).queue.append(frame(k))
    bus.corrupt = lambda _, __: True
    bus.advance(0.1)
    assert (receiver.controller.rec, receiver.controller.tec) == (128, 0)
    assert bus.error_frames == bus.abandoned * 32 == 160
    protocol = (ERROR_PROTOCOL, 0)
    assert receiver.errors == [
        *[protocol] * 96,
        (ERROR_CONTROLLER, 0x04),  # REC 96
        *[protocol] * 32,
        (ERROR_CONTROLLER, 0x10),  # REC 128, where it stays
        *[protocol] * 32,
    ]
    bus.corrupt = None
    Node(bus, "good sender").queue.extend([PLAIN] * 33)
    bus.advance(0.2)
    assert (receiver.controller.rec, receiver.controller.state) == (128 - 33, State.ACTIVE)
    assert receiver.errors[-2:] == [(ERROR_CONTROLLER, 0x04), (ERROR_CONTROLLER, 0x40)]


def go_off(auto_restart: float | None) -> tuple[SimulatedBus, Node, Node, float]:
    bus = SimulatedBus(CLASSIC)
    node, other = Node(bus, "node", auto_restart), Node(bus, "other")
    bus.corrupt = lambda row, _: row == PLAIN
    node.queue.extend([PLAIN, frame(0x22)])
    bus.advance(0.01)
    assert node.controller.state is State.BUS_OFF
    assert node.error_times[-1] == pytest.approx(((31 * 131) + 111) * BIT)  # at the end of the last frame
    return bus, node, other, node.error_times[-1]


def test_thirty_two_errors_are_bus_off_and_the_frame_is_given_up() -> None:
    bus, first, second, _ = go_off(0.1)
    assert (first.controller.tec, second.controller.rec) == (256, 32)
    protocol = (ERROR_PROTOCOL, 0)
    assert first.errors == [
        *[protocol] * 12,
        (ERROR_CONTROLLER, 0x08),
        *[protocol] * 4,
        (ERROR_CONTROLLER, 0x20),
        *[protocol] * 16,
        (ERROR_BUS_OFF, 0),
    ]
    assert bus.abandoned == 1
    second.queue.append(frame(0x33))
    bus.advance(0.05)
    assert (first.got, second.got) == ([], [])  # it neither receives nor sends, nor acknowledges
    assert second.controller.state is State.PASSIVE
    listener = Node(bus, "listener")
    bus.advance(0.06)
    assert (first.got, listener.ids) == ([], [0x33])


def test_a_controller_restarts_by_itself() -> None:
    bus, node, other, off = go_off(0.1)
    back = off + 0.1 + RECOVERY
    bus.advance(back - 1e-9)
    assert (node.controller.state, other.got) == (State.BUS_OFF, [])
    bus.advance(back + 1e-9)
    assert (node.controller.state, node.controller.tec, node.controller.rec) == (State.ACTIVE, 0, 0)
    assert (node.errors[-1], node.error_times[-1]) == ((ERROR_RESTARTED, 0), pytest.approx(back, abs=1e-12))
    bus.advance(back + 1e-3)
    assert other.ids == [0x22]
    assert other.times[0] == pytest.approx(back + 51 * BIT, abs=6 * BIT)  # an empty base frame: 47 to 55 bits


@pytest.mark.parametrize("by_itself", [0.1, None])
def test_a_controller_restarts_when_told(by_itself: float | None) -> None:
    bus, node, other, _ = go_off(by_itself)
    told = 0.05 if by_itself else 5.0  # it would not without
    bus.advance(told)
    node.controller.restart()
    bus.advance(told + 0.0005)
    node.controller.restart()  # no later for being told again
    bus.advance(told + RECOVERY - 1e-9)
    assert node.controller.state is State.BUS_OFF
    bus.advance(told + RECOVERY + 1e-3)
    assert node.controller.state is State.ACTIVE
    node.controller.restart()  # nothing: it is on
    assert (node.errors[-1], node.error_times[-1]) == ((ERROR_RESTARTED, 0), pytest.approx(told + RECOVERY, abs=1e-12))
    assert other.ids == [0x22]
    node.queue.append(PLAIN)
    bus.advance(told + 0.01)
    assert node.controller.state is State.BUS_OFF
    back = node.error_times[-1] + (by_itself or 99.0) + RECOVERY
    bus.advance(back - 1e-9)  # beyond the time for which the first restart had been due
    assert node.controller.state is State.BUS_OFF
    bus.advance(back + 1e-9)
    assert (node.controller.state is State.ACTIVE) == (by_itself is not None)


def within_five_sigma(hits: int, n: int, p: float) -> bool:
    return abs(hits - n * p) < 5.0 * (n * p * (1.0 - p)) ** 0.5


def test_dropped_and_doubled_frames_are_as_many_as_asked_for_at_each_receiver() -> None:
    bus, first, second = pair(seed=3)
    third = Node(bus, "third")
    bus.faults.drop, bus.faults.duplicate = 0.2, 0.1
    n = 4000
    first.queue.extend(frame(0x10, k.to_bytes(2, "little")) for k in range(n))
    bus.advance(1.0)
    assert bus.frames == n
    lost = doubled = 0
    for node in (second, third):
        numbers = [int.from_bytes(row["data"][:2].tobytes(), "little") for row in node.got]
        assert numbers == sorted(numbers)
        lost += n - len(set(numbers))
        doubled += len(numbers) - len(set(numbers))
        assert within_five_sigma(n - len(set(numbers)), n, 0.2)
        assert within_five_sigma(len(numbers) - len(set(numbers)), len(set(numbers)), 0.1)
    assert (bus.dropped, bus.duplicated) == (lost, doubled)
    assert second.times != third.times
    assert (bus.error_frames, first.controller.tec) == (0, 0)  # nobody knows


def test_a_delay_is_as_long_as_asked_for_and_reorders_identifiers_but_not_the_frames_of_one() -> None:
    bus, first, second = pair()
    bus.faults.delay = lambda can_id: 0.002 if can_id == 0x555 else 0.0
    first.queue.extend([PLAIN, frame(0x7FF)])
    bus.advance(0.01)
    assert second.ids == [0x7FF, 0x555]
    assert second.times[1] == pytest.approx(PLAIN_BITS * BIT + 0.002)
    rng = np.random.default_rng(5)
    bus.faults.delay = lambda can_id: 0.0 if can_id == 0x10 else float(rng.uniform(0.0, 0.01))
    second.got.clear()
    for k in range(300):
        first.queue.append(frame((0x10, 0x20, 0x30)[k % 3], k.to_bytes(2, "little")))
    bus.advance(0.035)  # some are under way
    bus.faults.delay = None
    bus.advance(1.0)
    numbers = [int.from_bytes(row["data"][:2].tobytes(), "little") for row in second.got]
    assert sorted(numbers) == list(range(300))
    assert numbers != sorted(numbers)
    for can_id in (0x10, 0x20, 0x30):
        own = [number for number, got in zip(numbers, second.ids, strict=True) if got == can_id]
        assert own == sorted(own)
    assert second.times == sorted(second.times)


@pytest.mark.parametrize(
    ("rates", "row"),
    [
        (CLASSIC, b"\0" * 79),
        (CLASSIC, frame(ERROR | 0x20, bytes(8))),
        (CLASSIC, frame(0x800)),
        (CLASSIC, frame(0x10, bytes(9))),
        (CLASSIC, frame(0x10, bytes(64), FDF)),
        (FD, frame(0x10, bytes(9), FDF)),
        (FD, frame(0x10 | REMOTE, b"", FDF)),
    ],
    ids=["short record", "error frame", "12-bit identifier", "9 bytes", "CAN FD", "9 bytes of CAN FD", "remote CAN FD"],
)
def test_what_a_bus_cannot_carry_is_counted_and_skipped(rates: BusRates, row: bytes) -> None:
    bus, first, second = pair(rates)
    first.queue.extend([row, PLAIN])  # a classic frame goes on a CAN FD bus too
    bus.advance(0.01)
    assert (bus.rejected, second.ids) == (1, [0x555])
