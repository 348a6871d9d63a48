"""A CAN bus in virtual time: arbitration, exact frame times, error counters, bus-off, and faults on request.

The bus goes from event to event: whenever it is idle, the pending frame with the best identifier starts, and at its
end every other controller has it. Time moves only in `advance`; no clock is read. What is left out of ISO 11898-1:
overload frames, the pause of an error-passive sender, and the ESI bit, which is as the sender's record says. Two
senders of one identifier do not destroy each other's frames; they are counted as collisions.
"""

from __future__ import annotations

import random
import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from heapq import heappop, heappush
from itertools import count
from math import inf

import numpy as np

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
    FD_LENGTHS,
    FDF,
    RECORD_BYTES,
    REMOTE,
    STANDARD_MASK,
    BusRates,
)
from protocol.errors import LocalProtocolError
from sim.ports.can_bits import arbitration, frame_bits, frame_seconds

WARNING_LIMIT = 96  # of either error counter, as the two below
PASSIVE_LIMIT = 128
BUS_OFF_LIMIT = 256  # of the transmit error counter
RECOVERY_BITS = 128 * 11  # recessive bits that a controller waits for after bus-off
RESTART_DELAY = 0.1  # s from bus-off to the restart

# Error frames, in nominal bit times beyond the time of the frame, which has the interframe space in it.
ERROR_BITS = 6 + 6 + 8  # flag, its echo by those that saw the error only by it, delimiter
NO_ACK_BITS = 6 + 8 - 8  # flag and delimiter, instead of ACK delimiter and end of frame

# data[1] of an error record with ERROR_CONTROLLER, with the bits that Linux uses.
RX_WARNING = 0x04
TX_WARNING = 0x08
RX_PASSIVE = 0x10
TX_PASSIVE = 0x20
ACTIVE_AGAIN = 0x40

_header: Callable[[bytes], tuple[int, int, int]] = struct.Struct("<IBB").unpack_from  # id, length, flags
_TIME = struct.Struct("<d")
_TIME_AT = 8
_DATA_AT = 16
_NO_KEY = 1 << 32


class State(StrEnum):
    """State of a controller by its error counters."""

    ACTIVE = "active"
    WARNING = "warning"
    PASSIVE = "passive"
    BUS_OFF = "bus-off"


@dataclass(slots=True)
class BusFaults:
    """What goes wrong behind the bus's own checks, where no error frame tells of it."""

    drop: float = 0.0
    """Probability that a receiver loses a frame, as when its buffer is full."""

    duplicate: float = 0.0
    """Probability that a receiver gets a frame twice, as after an error in the last bit."""

    delay: Callable[[int], float] | None = None
    """Seconds by which a frame with this `id` comes late; frames of one `id` keep their order."""


class Controller:
    """A node's CAN controller; made by `SimulatedBus.attach`."""

    def __init__(
        self,
        bus: SimulatedBus,
        source: Callable[[], bytes],
        sink: Callable[[bytes], None],
        name: str,
        errors: Callable[[bytes], None] | None,
        auto_restart: float | None,
    ) -> None:
        self.name = name
        self.state = State.ACTIVE
        self.tec = 0
        """Transmit error counter."""
        self.rec = 0
        """Receive error counter; it stays at 128 when error passive."""
        self.auto_restart = auto_restart
        """Seconds after which it restarts by itself when bus-off; None: never."""
        self._bus = bus
        self._source = source
        self._sink = sink
        self._errors = errors
        self._record = b""  # the mailbox; the three below belong to it
        self._key = _NO_KEY
        self._seconds = 0.0
        self._since = 0.0
        self._back_at = inf

    def restart(self) -> None:
        """Rejoin the bus after bus-off, when 128 x 11 bit times have passed; nothing in any other state."""
        if self.state is State.BUS_OFF:
            self._rejoin(0.0)

    @property
    def waits(self) -> float:
        """Seconds that the frame in the mailbox has waited for the bus; 0 if there is none."""
        return self._bus.time - self._since if self._record else 0.0

    def abort(self) -> bool:
        """Take back the frame in the mailbox; False if there is none, or it is on the bus now."""
        if not self._record or self._bus._sender is self:
            return False
        self._record = b""
        return True

    def _rejoin(self, delay: float) -> None:
        bus = self._bus
        self._back_at = min(self._back_at, bus.time + delay + RECOVERY_BITS / bus.rates.bitrate)
        bus._at(self._back_at, self._come_back)

    def _come_back(self) -> None:
        if self._bus.time >= self._back_at:  # else it came back earlier, and may be waiting again
            self._back_at = inf
            self.state, self.tec, self.rec = State.ACTIVE, 0, 0
            self._report(ERROR_RESTARTED)

    def _count(self, tec: int, rec: int) -> None:
        """Set the error counters and follow with the state."""
        self.tec, self.rec = tec, min(rec, PASSIVE_LIMIT)
        worst = max(tec, rec)
        if tec >= BUS_OFF_LIMIT:
            state = State.BUS_OFF
        elif worst >= PASSIVE_LIMIT:
            state = State.PASSIVE
        else:
            state = State.WARNING if worst >= WARNING_LIMIT else State.ACTIVE
        if state is self.state:
            return
        self.state = state
        if state is State.BUS_OFF:
            self._bus.abandoned += self._record != b""
            self._record = b""
            if self.auto_restart is not None:
                self._rejoin(self.auto_restart)
            self._report(ERROR_BUS_OFF)
        elif state is State.PASSIVE:
            self._report(ERROR_CONTROLLER, self._sides(PASSIVE_LIMIT, TX_PASSIVE, RX_PASSIVE))
        elif state is State.WARNING:
            self._report(ERROR_CONTROLLER, self._sides(WARNING_LIMIT, TX_WARNING, RX_WARNING))
        else:
            self._report(ERROR_CONTROLLER, ACTIVE_AGAIN)

    def _sides(self, limit: int, tx: int, rx: int) -> int:
        return (tx if self.tec >= limit else 0) | (rx if self.rec >= limit else 0)

    def _report(self, kind: int, detail: int = 0) -> None:
        if self._errors is not None:
            record = np.zeros(1, CAN_RECORD)
            record["id"] = ERROR | kind
            record["length"] = 8
            record["time"] = self._bus.time
            record["data"][0, 1] = detail
            self._errors(record.tobytes())


class SimulatedBus:
    """A CAN bus without nodes; `attach` adds them.

    Args:
        rates: bit rates; CAN FD frames go only where there is a data bit rate.
        seed: of the random numbers behind `faults`.
    """

    def __init__(self, rates: BusRates, seed: int = 0) -> None:
        self.rates = rates
        self.time = 0.0
        """Virtual seconds."""
        self.faults = BusFaults()
        self.corrupt: Callable[[bytes, float], bool] | None = None
        """Asked for each frame at its end, with record and time: True destroys it by an error frame."""
        self.frames = 0
        """Frames carried."""
        self.busy_seconds = 0.0
        """Time that frames and error frames took, each counted at its end."""
        self.error_frames = 0
        """Frames that were destroyed or not acknowledged."""
        self.collisions = 0
        """Arbitrations that two or more nodes won with the same identifier; the first one attached sends."""
        self.dropped = 0
        """Frames lost at a receiver by `faults.drop`."""
        self.duplicated = 0
        """Frames doubled at a receiver by `faults.duplicate`."""
        self.abandoned = 0
        """Frames that their sender gave up at bus-off."""
        self.rejected = 0
        """Records from a source that this bus cannot carry."""
        self._nodes: tuple[Controller, ...] = ()
        self._sender: Controller | None = None  # whose frame is on the bus
        self._seconds = 0.0  # how long this or an error frame takes
        self._ends = inf  # when it does, inf: the bus is idle
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._serial = count()
        self._due: dict[int, float] = {}  # when the last delayed frame of an id arrives
        self._random = random.Random(seed)

    def attach(
        self,
        source: Callable[[], bytes],
        sink: Callable[[bytes], None],
        name: str,
        errors: Callable[[bytes], None] | None = None,
        auto_restart: float | None = RESTART_DELAY,
    ) -> Controller:
        """Add a node.

        Args:
            source: gives the next record to send, or b""; asked at each arbitration while the mailbox is empty.
            sink: takes each record that another node has sent, at its end, with `time` set to the bus's.
            name: for people.
            errors: takes records with ERROR set: each error that the controller sees, and each change of its state. A
                frame that stays without acknowledgement is reported until the sender is error passive.
            auto_restart: see `Controller.auto_restart`.
        """
        controller = Controller(self, source, sink, name, errors, auto_restart)
        self._nodes = (*self._nodes, controller)
        return controller

    def detach(self, controller: Controller) -> None:
        """Take a node off; a frame that it is sending still goes out."""
        self._nodes = tuple(node for node in self._nodes if node is not controller)

    def babble(self, can_id: int, load: float, length: int = 8) -> Controller:
        """Attach a node that sends frames of zeros, evenly and so many that they take `load` of the time.

        Kept from sending, it catches up by one frame at most. `can_id` as in a record; CAN FD on a CAN FD bus.

        Raises:
            LocalProtocolError: not a share, or not a frame of this bus.
        """
        if not 0.0 < load <= 1.0:
            raise LocalProtocolError(f"a babbling node's load must be above 0 and at most 1, got {load:g}")
        frame = np.zeros(1, CAN_RECORD)
        frame["id"], frame["length"], frame["flags"] = can_id, length, FDF | BRS if self.rates.fd else 0
        record = frame.tobytes()
        if not self._carries(record):
            raise LocalProtocolError(f"no frame with id {can_id:#x} and {length} bytes goes on a {self.rates} bus")
        period = float(frame_seconds(frame, self.rates)[0]) / load
        due = self.time

        def source() -> bytes:
            nonlocal due
            if self.time < due:
                return b""
            due = max(due, self.time - period) + period
            self._at(due, _do_nothing)  # an idle bus asks again
            return record

        return self.attach(source, _ignore, f"babbling node {can_id:#x}")

    def advance(self, until: float) -> None:
        """Run the bus up to `until`, in s; what happens at `until` has then happened, but for the start of a frame.

        A frame under way goes on in the next call: the number of calls makes no difference.
        """
        events = self._events
        while True:
            if self._ends == inf and self.time < until and not (events and events[0][0] <= self.time):
                self._arbitrate()
            if events and events[0][0] <= min(self._ends, until):
                at, _, event = heappop(events)
                self.time = max(self.time, at)
                event()
            elif self._ends <= until:
                self.time, self._ends = self._ends, inf
                self.busy_seconds += self._seconds
                if self._sender is not None:
                    self._finish(self._sender)
            else:
                self.time = max(self.time, until)
                return

    def _at(self, time: float, event: Callable[[], None]) -> None:
        heappush(self._events, (time, next(self._serial), event))

    def _occupy(self, seconds: float) -> None:
        self._seconds = seconds
        self._ends = self.time + seconds

    def _arbitrate(self) -> None:
        """Start the frame that wins, if anybody has one."""
        winner = None
        best = _NO_KEY
        tied = False
        for node in self._nodes:
            if node.state is State.BUS_OFF or not (node._record or self._fill(node)):
                continue
            if node._key < best:
                winner, best, tied = node, node._key, False
            elif node._key == best:
                tied = True
        if winner is not None:
            self.collisions += tied
            self._sender = winner
            self._occupy(winner._seconds)

    def _fill(self, node: Controller) -> bool:
        """Fill a node's mailbox from its source; False when that has nothing."""
        while record := node._source():
            if not self._carries(record):
                self.rejected += 1
                continue
            can_id = _header(record)[0]
            nominal, fast = frame_bits(record)
            rates = self.rates
            node._record = record
            node._since = self.time
            node._key = arbitration(can_id)
            node._seconds = nominal / rates.bitrate + fast / (rates.data_bitrate or rates.bitrate)
            return True
        return False

    def _carries(self, record: bytes) -> bool:
        """Whether a record is a frame that can be sent here."""
        if len(record) != RECORD_BYTES:
            return False
        can_id, length, flags = _header(record)
        if can_id & ERROR or (not can_id & EXTENDED and can_id & ~REMOTE > STANDARD_MASK):
            return False
        if flags & FDF:
            return self.rates.fd and length in FD_LENGTHS and not can_id & REMOTE
        return length <= 8

    def _finish(self, sender: Controller) -> None:
        """End a frame: not acknowledged, destroyed or carried."""
        self._sender = None
        receivers = [node for node in self._nodes if node is not sender and node.state is not State.BUS_OFF]
        if not receivers:
            self._error_frame(NO_ACK_BITS)
            if sender.state is not State.PASSIVE:
                sender._report(ERROR_NO_ACK)
                sender._count(sender.tec + 8, sender.rec)
            return
        record = sender._record
        if self.corrupt is not None and self.corrupt(record, self.time):
            self._error_frame(ERROR_BITS)
            sender._report(ERROR_PROTOCOL)
            sender._count(sender.tec + 8, sender.rec)
            for node in receivers:
                node._report(ERROR_PROTOCOL)
                node._count(node.tec, node.rec + 1)
            return
        self.frames += 1
        sender._record = b""
        if sender.tec:
            sender._count(sender.tec - 1, sender.rec)
        for node in receivers:
            if node.rec:
                node._count(node.tec, node.rec - 1)
        can_id = _header(record)[0]
        due = self.time if self.faults.delay is None else self.time + self.faults.delay(can_id)
        due = max(due, self._due.get(can_id, 0.0))
        if due > self.time:
            self._due[can_id] = due
            self._at(due, lambda: self._deliver(sender, record))
        else:
            self._deliver(sender, record)

    def _error_frame(self, bits: int) -> None:
        self.error_frames += 1
        self._occupy(bits / self.rates.bitrate)

    def _deliver(self, sender: Controller, record: bytes) -> None:
        record = record[:_TIME_AT] + _TIME.pack(self.time) + record[_DATA_AT:]
        drop, duplicate = self.faults.drop, self.faults.duplicate
        for node in self._nodes:
            if node is sender or node.state is State.BUS_OFF:
                continue
            if drop and self._random.random() < drop:
                self.dropped += 1
                continue
            node._sink(record)
            if duplicate and self._random.random() < duplicate:
                self.duplicated += 1
                node._sink(record)


def _do_nothing() -> None:
    pass


def _ignore(record: bytes) -> None:
    pass
