"""slcan adapters as a python-can interface that keeps up with a full bus: `can.Bus(interface="hallbench_slcan", …)`.

python-can's own slcan reads one byte at a time; this one empties the descriptor at each read and turns many lines into
frames at once. It takes the same keywords. It has no `fileno`: frames that are already read make no descriptor
readable, so a `can.Notifier` must use its thread. It waits for an adapter's answers only when it opens the channel;
later it counts them.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from inspect import signature
from typing import Any

import can
import numpy as np
from can.util import check_or_adjust_timing_clock

from protocol.canmap.frame import CAN_RECORD, RECORD_BYTES
from protocol.canmap.slcan import BELL, BITRATES, DATA_BITRATES, END, TIMING_CLOCK, SlcanParser, encode
from protocol.errors import LinkError, TargetError
from protocol.links.can_message import to_messages, to_record
from protocol.links.serial import SerialLink
from protocol.links.target import DEFAULT_BAUD, SerialTarget

ANSWER_TIMEOUT = 0.3
"""Seconds that an adapter may take to answer the commands that open its channel; some answer nothing."""

_MORE = 0.05  # s in which the answer to an empty line would have come
_PATIENCE = 1.0  # s that one wait of an endless `recv` takes
_KEPT_REPLIES = 16


@dataclass(frozen=True)
class SlcanOptions:
    """What an slcan adapter is opened with, by python-can's names; ValueError for what it cannot be opened with.

    Args:
        channel: serial port, `/dev/ttyACM0` or `/dev/ttyACM0@3000000` with the port's rate.
        tty_baudrate: the port's rate in baud; an adapter on USB ignores it.
        bitrate: of the bus, in bit/s; None leaves the adapter's own setting.
        timing: in place of the bit rates: `BitTiming` sets the registers, `BitTimingFd` both bit rates.
        sleep_after_open: seconds before the first command. python-can waits 2 s, for boards that reset when their port
            is opened; USB adapters do not, so here it is 0.
        rtscts: hardware handshake of the port.
        listen_only: neither send nor acknowledge.
        timeout, single_handle: accepted as python-can's, and ignored: reading waits on the descriptor.
        fd: the bus carries CAN FD frames.
        data_bitrate: of CAN FD's data phase, in bit/s; implies `fd`. None leaves the adapter's own setting.
        can_filters: as `can.BusABC` takes them.
    """

    channel: str
    tty_baudrate: int = DEFAULT_BAUD
    bitrate: int | None = None
    timing: can.BitTiming | can.BitTimingFd | None = None
    sleep_after_open: float = 0.0
    rtscts: bool = False
    listen_only: bool = False
    timeout: float = 0.001
    fd: bool = False
    data_bitrate: int | None = None
    single_handle: bool = False
    can_filters: can.typechecking.CanFilters | None = None

    def __post_init__(self) -> None:
        if not self.channel:
            raise ValueError("channel must name a serial port, for example /dev/ttyACM0")
        if not isinstance(self.sleep_after_open, (int, float)) or self.sleep_after_open < 0:
            raise ValueError(f"sleep_after_open must be a number of seconds from 0 on, got '{self.sleep_after_open}'")

    @property
    def protocol(self) -> can.CanProtocol:
        """CAN FD, or classic CAN."""
        flexible = self.fd or self.data_bitrate is not None or isinstance(self.timing, can.BitTimingFd)
        return can.CanProtocol.CAN_FD if flexible else can.CanProtocol.CAN_20

    def target(self) -> SerialTarget:
        """The port, with its rate."""
        port, at, baud = self.channel.rpartition("@")
        if at and not baud.isdecimal():
            raise ValueError(f"channel '{self.channel}': the port's rate must be a whole number, got '{baud}'")
        return SerialTarget(port, int(baud)) if at else SerialTarget(self.channel, self.tty_baudrate)

    def commands(self) -> list[tuple[bytes, str]]:
        """What sets up and opens the adapter's channel, each with what the adapter refuses when it refuses that."""
        found: list[tuple[bytes, str]] = []
        bitrate, data_bitrate = self.bitrate, self.data_bitrate
        if isinstance(self.timing, can.BitTiming):
            timing = check_or_adjust_timing_clock(self.timing, [TIMING_CLOCK])
            found.append((b"s%02X%02X" % (timing.btr0, timing.btr1), f"the bit rate {timing.bitrate}"))
            bitrate = None
        elif self.timing is not None:
            bitrate, data_bitrate = self.timing.nom_bitrate, self.timing.data_bitrate
        if bitrate is not None:
            found.append((_command("bitrate", bitrate, BITRATES), f"the bit rate {bitrate}"))
        if data_bitrate is not None:
            command = _command("data_bitrate", data_bitrate, DATA_BITRATES)
            found.append((command, f"the data bit rate {data_bitrate}"))
        found.append((b"L", "to open in order to listen only") if self.listen_only else (b"O", "to open"))
        return found


@contextmanager
def _as_can_errors() -> Iterator[None]:
    """A ValueError is that of a frame that cannot be sent, or of a port that another thread has closed."""
    try:
        yield
    except (LinkError, OSError, ValueError) as error:
        raise can.CanOperationError(str(error)) from None


class SlcanBus(can.BusABC):
    """An slcan adapter on a serial port, opened and locked; one thread may receive while others send.

    Its arguments are those of `SlcanOptions`.

    Raises:
        TypeError, ValueError: not what `SlcanOptions` takes.
        can.CanInitializationError: the port is missing, held by another program or no serial port, or the adapter
            refused a command.
    """

    __signature__ = signature(SlcanOptions)

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        options = SlcanOptions(*arguments, **keywords)
        commands, target = options.commands(), options.target()
        self.refused = 0
        """Bells of the adapter: commands that it refused, or frames for which its transmit buffer had no room."""
        self.replies: deque[bytes] = deque(maxlen=_KEPT_REPLIES)
        """The adapter's newest answers that are no acknowledgement, such as `F00`."""
        self.channel_info = f"slcan {options.channel}"
        self._can_protocol = options.protocol
        self._parser = SlcanParser()
        self._pending = memoryview(b"")  # records read and not yet given to `recv`
        self._sending = threading.Lock()
        self._unfinished = False  # a line may have been cut by a write that failed
        try:
            self._port = _Port(target, options.rtscts)
        except TargetError as error:
            raise ValueError(str(error)) from None
        except (LinkError, OSError) as error:
            raise can.CanInitializationError(str(error)) from None
        try:
            time.sleep(options.sleep_after_open)
            self._start(commands)
            self._port.expect(math.inf)  # a bus carries what others send
            super().__init__(options.channel, options.can_filters)
        except (LinkError, OSError) as error:
            self._port.close()
            raise can.CanInitializationError(str(error)) from None
        except BaseException:
            self._port.close()
            raise

    @property
    def malformed(self) -> int:
        """Lines of the adapter that could not be read; they are dropped."""
        return self._parser.malformed

    @property
    def strange(self) -> bytes:
        """The first line of the adapter that could not be read."""
        return self._parser.strange

    def oddities(self) -> list[str]:
        """See `SerialLink.oddities`."""
        return self._port.oddities()

    def _start(self, commands: Sequence[tuple[bytes, str]]) -> None:
        """Open the channel and look at the answers: an end of line or a bell for each command.

        The frames that come meanwhile are kept. Where text comes that is no slcan nothing is concluded.

        Raises:
            LinkError: the port has failed, or the adapter refused one of these commands.
        """
        lines = [b"", b"C", *(command for command, _ in commands)]  # first end what another program left unfinished
        self._port.write(END.join(lines) + END)
        answers: list[bytes] = []
        frames: list[bytes] = []
        deadline = time.monotonic() + ANSWER_TIMEOUT
        while len(answers) < len(lines) and (left := deadline - time.monotonic()) > 0.0:
            last = len(answers) == len(lines) - 1  # unless the adapter answers the empty line too
            data = self._port.read(min(left, _MORE) if last else left)
            if last and not data:
                break
            frames.append(self._parser.feed(data, time.monotonic()).tobytes())
            answers += self._take_replies()
        self._pending = memoryview(b"".join(frames))
        if self.malformed or len(answers) < len(lines) - 1:
            return
        # a bell for C says that the channel was closed
        for (command, what), answer in zip(commands, answers[-len(commands) :], strict=True):
            if answer == BELL:
                with suppress(LinkError):
                    self._port.write(b"C" + END)
                raise LinkError(f"the adapter refused {what} ({command.decode()})")

    def _take_replies(self) -> list[bytes]:
        """Return the ends of line and bells that have come, and keep the answers that say more."""
        texts = [reply.text for reply in self._parser.replies]
        self._parser.replies.clear()
        self.replies += [text for text in texts if text not in (b"", b"z", b"Z", BELL)]
        return [text for text in texts if text in (b"", BELL)]

    def recv_records(self, timeout: float, settle: float = 0.0) -> bytes:
        """Return the frames that have come, as CAN_RECORDs; b"" when none came within `timeout` s.

        `settle`: seconds to go on collecting after the first byte. `time` in the records is that of `time.monotonic`.

        Raises:
            can.CanOperationError: the port is gone. Frames that came before are returned first.
        """
        if self._pending:
            records, self._pending = bytes(self._pending), memoryview(b"")
            return records
        deadline = time.monotonic() + timeout
        while True:  # answers of the adapter are no frames: wait on
            with _as_can_errors():
                data = self._port.read(deadline - time.monotonic(), settle)
            now = time.monotonic()
            frames = self._parser.feed(data, now)
            self.refused += self._take_replies().count(BELL)
            if len(frames) or now >= deadline:
                return frames.tobytes()

    def send_records(self, data: bytes) -> None:
        """Send the frames in these CAN_RECORDs, in one write.

        Raises:
            can.CanOperationError: the port is gone or did not take all of it within 0.5 s, or a frame that slcan cannot
                carry; then nothing was sent.
        """
        with _as_can_errors():
            lines = encode(np.frombuffer(data, CAN_RECORD))
        self._write(lines)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self._pending:
            self._pending = memoryview(self.recv_records(_PATIENCE if timeout is None else timeout))
            if not self._pending:
                return None, False
        record, self._pending = self._pending[:RECORD_BYTES], self._pending[RECORD_BYTES:]
        (message,) = to_messages(bytes(record))
        message.timestamp = float(np.frombuffer(record, CAN_RECORD)["time"][0]) + time.time() - time.monotonic()
        message.is_rx = True
        return message, False

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """See `can.BusABC.send`. `timeout` is not needed: the port takes the frame within 0.5 s or has failed.

        Raises:
            can.CanOperationError: the port is gone or takes nothing, or a frame that the bus or slcan cannot carry.
        """
        if msg.is_fd and self.protocol is not can.CanProtocol.CAN_FD:
            raise can.CanOperationError(f"{self.channel_info}: a CAN FD frame needs a bus opened with fd=True")
        with _as_can_errors():
            record = to_record(msg, 0.0)
        self.send_records(record)

    def _write(self, lines: bytes) -> None:
        with _as_can_errors(), self._sending:
            text = END + lines if self._unfinished else lines
            self._unfinished = True
            self._port.write(text)
            self._unfinished = False

    def shutdown(self) -> None:
        """Close the adapter's channel and the port, also one that has gone. Doing it again does nothing."""
        if not self._is_shutdown:
            super().shutdown()
            with suppress(can.CanOperationError):
                self._write(b"C" + END)
            self._port.close()


class _Port(SerialLink):
    """A serial port, with hardware handshake where it is asked for."""

    def __init__(self, target: SerialTarget, rtscts: bool) -> None:
        self._rtscts = rtscts
        super().__init__(target)

    def _open(self) -> None:
        super()._open()
        if self._rtscts and self._port is not None:
            self._port.rtscts = True
            self._there.set_up()  # pyserial has just set it back


def _command(name: str, value: int, commands: dict[int, bytes]) -> bytes:
    if value not in commands:
        raise ValueError(f"{name} {value} is not an slcan rate: choose one of {', '.join(map(str, commands))}")
    return commands[value]
