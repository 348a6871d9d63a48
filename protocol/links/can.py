"""Link to a CAN bus through python-can: SocketCAN, PEAK, Kvaser, slcan, socketcand, python-can's virtual bus, …

What it reads and writes are rows of `CAN_RECORD`. It is the one link with a thread, which empties the adapter as frames
arrive, because few drivers hold many. It knows no HBP, repeats no frame that the adapter has taken, and lets no
exception of python-can through.
"""

from __future__ import annotations

import queue
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, field

import can
import numpy as np

from protocol.canmap.frame import CAN_RECORD, ERROR, ERROR_BUS_OFF, ERROR_RESTARTED, RECORD, RECORD_BYTES
from protocol.canmap.host import CanWire
from protocol.errors import HbpError, LinkClosed, LinkError
from protocol.links.base import MAX_READ, WRITE_TIMEOUT
from protocol.links.can_message import ERROR_KINDS, WITH_KINDS, error_kind, to_messages, to_record
from protocol.links.can_open import (
    bus_arguments,
    bus_rates,
    cannot_open,
    is_full,
    is_gone,
    one_line,
    open_bus,
    remedy,
    shut_down,
)
from protocol.links.slcan_bus import SlcanBus
from protocol.links.target import CanTarget
from protocol.text import counted, printable
from protocol.wire import HostWire

STALL = 0.25
"""Seconds without a look at the bus after which what has come may be old: an idle bus is looked at every 0.1 s."""

MISTRUST = 0.3
"""Seconds after such a stall in which an adapter may still hand over what it had kept."""

MAX_BUFFER = (8 << 20) // RECORD_BYTES * RECORD_BYTES
"""Most bytes that wait for `read`; frames that come on top are dropped and counted."""

SHOWN = 40
"""Most characters of an adapter's text that an error shows."""

_READ = MAX_READ // RECORD_BYTES * RECORD_BYTES
_POLL = 0.1  # s that the thread waits for a frame before it looks around
_SETTLE = 0.001  # s that it goes on collecting from an adapter that sends text
_JOIN = 1.0  # s that a driver may take to let the thread go
_FULL_PAUSE = 0.001  # s before a full transmit buffer is tried again
_BUSY_WINDOW = 0.5  # s in which nothing came, and
_BUSY_SHARE = 0.1  # more of them computed than this: python-can's socketcand does not wait at an end of file


@dataclass(slots=True)
class CanHealth:
    """What a CAN link has counted since it was made, over every `reopen`."""

    received: int = 0
    """Frames, without error frames."""
    sent: int = 0
    malformed: int = 0
    """Frames from the adapter that could not be read."""
    refused: int = 0
    """Commands and frames that an slcan adapter refused."""
    dropped: int = 0
    """Records for which the buffer had no room."""
    bus_off: bool = False
    """Whether the adapter last said that it is off the bus."""
    error_frames: dict[str, int] = field(default_factory=lambda: dict.fromkeys(ERROR_KINDS, 0))
    """Error frames by kind (`ERROR_KINDS`), each counted once, as the gravest thing that it says."""


class CanLink:
    """A CAN bus through python-can.

    Raises:
        TargetError: no such interface, or options that it refuses.
        LinkNotFound: no such adapter, driver or server, or an interface that is down.
        LinkBusy: another program holds it.
        LinkError: it may not be opened by this user.
    """

    def __init__(self, target: CanTarget) -> None:
        self.target = target
        self.rates = target.rates
        """Bit rates by the target and by python-can's configuration."""
        self.node = target.node
        self.extended = target.extended
        self.health = CanHealth()
        self.name = str(CanTarget(target.interface, target.channel))
        """The link as errors show it, for example `can:socketcan/can0`."""
        self._reader: _Reader | None = None
        self._open()

    def clock(self) -> float:
        """Seconds of the machine's monotonic clock, which is also that of the records."""
        return time.monotonic()

    def wire(self) -> HostWire:
        """See `Link.wire`."""
        return CanWire(self.rates, self.node, self.extended, self.target.host)

    def _open(self) -> None:
        arguments = bus_arguments(self.target)
        interface, channel = arguments["interface"], arguments["channel"]
        self.name = str(CanTarget(interface, None if channel is None else str(channel)))
        self.rates = bus_rates(arguments)
        bus = None
        try:
            bus = open_bus(self.name, arguments)
            self._reader = _Reader(bus, self.name, self.health, interface)
        except BaseException as error:  # a driver raises what it likes, and a user may interrupt
            if bus is not None:
                shut_down(bus)
            if isinstance(error, HbpError) or not isinstance(error, Exception):
                raise
            raise cannot_open(self.name, interface, error) from None

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        """See `Link.read`; whole records."""
        return self._opened.take(timeout, settle)

    def write(self, data: bytes) -> None:
        """See `Link.write`; whole records."""
        reader = self._opened
        if reader.lost is not None:
            raise LinkClosed(reader.lost)
        before, deadline = self.health.sent, time.monotonic() + WRITE_TIMEOUT
        try:
            if isinstance(reader.bus, SlcanBus):
                reader.bus.send_records(data)
                self.health.sent += len(data) // RECORD_BYTES
            else:
                for message in to_messages(data):
                    _send(reader.bus, message, deadline)
                    self.health.sent += 1
        except Exception as error:
            sent = self.health.sent - before
            text = f"{self.name} took {sent} of {len(data) // RECORD_BYTES} frames: {one_line(error)}"
            if is_gone(error):
                reader.end(text)
                raise LinkClosed(text) from None
            if is_full(error):
                text += f" for {WRITE_TIMEOUT:g} s: is another node on the bus, at the same bit rate?"
            raise LinkError(text) from None

    def close(self) -> None:
        """See `Link.close`."""
        reader, self._reader = self._reader, None
        if reader is not None:
            reader.close()

    def reopen(self) -> None:
        """See `Link.reopen`."""
        self.close()
        self._open()

    def oddities(self) -> list[str]:
        """Why nothing may come, if that is known: what the adapter refused, other text of it, another program there."""
        health, bus = self.health, None if self._reader is None else self._reader.bus
        told = [f"the adapter refused {health.refused} commands or frames"] if health.refused else []
        if isinstance(bus, SlcanBus):
            if health.malformed:
                text = printable(bus.strange[:SHOWN].decode("latin1"))
                told.append(
                    f"the adapter sent text that is no slcan ({counted(health.malformed, 'line')}), such as '{text}'"
                )
            told += bus.oddities()
        return told

    @property
    def _opened(self) -> _Reader:
        if self._reader is None:
            raise LinkClosed(f"{self.name} is closed")
        return self._reader


class _Reader:
    """The thread that empties one open bus into a buffer. Once the bus is lost it ends and stays ended.

    It reads once on the caller's thread first, so that an interface that is down is an error of the opening. The time
    of a record is that at which it was read; after a stall (`STALL`, `MISTRUST`) it is that of the last look before,
    because an adapter that nobody empties keeps old frames and loses new ones.
    """

    def __init__(self, bus: can.BusABC, name: str, health: CanHealth, interface: str) -> None:
        self.bus = bus
        self.lost: str | None = None
        """Why nothing more will come."""
        self._name = name
        self._health = health
        self._with_kinds = interface in WITH_KINDS
        self._spins = interface == "socketcand"
        self._changing = threading.Lock()  # no Condition, no Event: Ctrl-C in their methods would leave them locked
        self._news: queue.SimpleQueue[None] = queue.SimpleQueue()  # something has come, or nothing more will
        self._buffer = bytearray()
        self._off = False  # what the bus object last said
        self._rejected = (0, 0)  # malformed and refused, of the bus object
        self._looked = time.monotonic()  # when the last look at the bus ended
        self._certain = self._looked  # the last look before a stall
        self._trusted = self._looked  # from then on records have the time at which they were read
        first = bytearray()
        self._collect(first, 0.0)
        self._date(first)
        self._store(first)
        self._thread = threading.Thread(target=self._run, name=f"reads {name}", daemon=True)
        self._thread.start()

    def take(self, timeout: float, settle: float) -> bytes:
        """Do `Link.read`."""
        until = time.monotonic() + timeout
        with suppress(queue.Empty):
            while not self._buffer and self.lost is None:
                self._news.get(timeout=max(0.0, until - time.monotonic()))
        waiting = len(self._buffer)
        if not waiting and self.lost is not None:
            raise LinkClosed(self.lost)
        if settle > 0.0 and 0 < waiting < _READ:
            time.sleep(settle)
        with self._changing:
            data = bytes(self._buffer[:_READ])
            del self._buffer[:_READ]
        return data

    def end(self, reason: str) -> None:
        """Let the thread end and wake who waits for it; the first reason stays."""
        with self._changing:
            self.lost = self.lost or reason
        self._news.put(None)

    def close(self) -> None:
        """End, and let go of the bus."""
        self.end(f"{self._name} is closed")
        self._thread.join(_JOIN)
        shut_down(self.bus)

    def _run(self) -> None:
        since, computed = time.monotonic(), time.thread_time()  # of the wait for the next frame
        while self.lost is None:
            rows = bytearray()
            reason = ""
            try:
                self._collect(rows, _POLL)
                if not rows:
                    self._look_at_state(rows)
            except Exception as error:
                reason = f"{self._name} was lost: {one_line(error)}{remedy(self._name, error)}"
            self._date(rows)
            waited, busy = time.monotonic() - since, time.thread_time() - computed
            if rows:
                self._store(rows)
            elif self._spins and not reason and waited >= _BUSY_WINDOW and busy > _BUSY_SHARE * waited:
                reason = f"{self._name} was closed by the other end"
            if rows or waited >= _BUSY_WINDOW:
                since, computed = time.monotonic(), time.thread_time()
            if reason:
                self.end(reason)

    def _collect(self, rows: bytearray, timeout: float) -> None:
        """Append what the bus has, so that what came before an exception is kept."""
        if isinstance(self.bus, SlcanBus):
            rows += self.bus.recv_records(timeout, _SETTLE)
            rejected = (self.bus.malformed, self.bus.refused)
            self._health.malformed += rejected[0] - self._rejected[0]
            self._health.refused += rejected[1] - self._rejected[1]
            self._rejected = rejected
            return
        message = self.bus.recv(timeout)
        while message is not None:
            try:
                rows += to_record(message, time.monotonic(), self._with_kinds)
            except ValueError:
                self._health.malformed += 1
            if len(rows) >= _READ:
                return
            message = self.bus.recv(0.0)

    def _look_at_state(self, rows: bytearray) -> None:
        """Some drivers report no error frame, but a state: make a record of its changes."""
        off = self.bus.state is can.BusState.ERROR
        if off != self._off:
            self._off = off
            kind = ERROR_BUS_OFF if off else ERROR_RESTARTED
            rows += RECORD.pack(ERROR | kind, 8, 0, 0, time.monotonic(), b"")

    def _date(self, rows: bytearray) -> None:
        """End a look at the bus: where it follows a stall, its records get the time of the last look before that."""
        now = time.monotonic()
        if rows and now - self._looked > STALL:
            if self._looked >= self._trusted:
                self._certain = self._looked
            self._trusted = now + MISTRUST
        if rows and now < self._trusted:
            np.frombuffer(rows, CAN_RECORD)["time"] = self._certain
        self._looked = now

    def _store(self, rows: bytearray) -> None:
        records = np.frombuffer(bytes(rows), CAN_RECORD)
        errors = records[records["id"] & ERROR != 0]
        self._health.received += len(records) - len(errors)
        for error in errors:
            self._count_error(error)
        with self._changing:
            kept = rows[: MAX_BUFFER - len(self._buffer)]
            self._health.dropped += (len(rows) - len(kept)) // RECORD_BYTES
            self._buffer += kept
        if self._news.empty():
            self._news.put(None)

    def _count_error(self, record: np.void) -> None:
        kind = error_kind(int(record["id"]), int(record["data"][1]))
        self._health.error_frames[kind] += 1
        if kind in ("bus-off", "restarted"):
            self._health.bus_off = kind == "bus-off"


def _send(bus: can.BusABC, message: can.Message, deadline: float) -> None:
    while True:
        try:
            bus.send(message, max(0.0, deadline - time.monotonic()))
            return
        except can.CanError as error:
            if not is_full(error) or time.monotonic() >= deadline:
                raise
        time.sleep(_FULL_PAUSE)
