"""One device on the link, by its verbs: identity, parameters, states, setpoints, streams.

A drive and a load machine are both nodes; what a node can do is what its descriptor and its refusals say. Nothing here
energises a drive by itself: `arm` and `start` are the explicit acts, and whoever calls them calls `stop`.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import NoReturn
from zlib import crc32

import numpy as np

from bench.device.blob import DESCRIPTOR, MEANINGS, WAVEFORM, part_bytes, read_part
from bench.device.client import WATCHDOG, Client
from bench.device.heard import ParameterSet
from bench.device.safety import HEARTBEATS, Vigil, heard, says, switch_off, why_unfed, without_watchdog
from bench.device.under_way import TRIES, WAIT, UnderWay
from bench.errors import DoesNotFit, DriveFailed, NodeError, OutputsMayBeOn
from protocol.canmap.host import CanWire
from protocol.canmap.layout import EDGES_PER_SECOND, edge_load
from protocol.canmap.plan import BusPlan
from protocol.codes import fault_names
from protocol.descriptor import Channel, Descriptor
from protocol.errors import DeviceDefect, HbpError, NoReply, Refused
from protocol.framing import MAX_PAYLOAD
from protocol.messages import (
    BlobWrite,
    Command,
    DriveState,
    Empty,
    ErrorCode,
    Fault,
    Feature,
    Heartbeat,
    Hello,
    HelloReply,
    ParamCommit,
    ParamGet,
    ParamReply,
    ParamSet,
    ParamStored,
    Setpoint,
    SetpointMode,
    StateCommand,
    StateReply,
    StreamEvent,
    StreamGet,
    StreamInfo,
    StreamReply,
    StreamSet,
    StreamStart,
    StreamStop,
    TimeSync,
    TimeSyncReply,
)
from protocol.payload import whole_from_wire
from protocol.signals import Flag
from protocol.streams import MAX_STREAMS, STREAM_HEADER, StreamConfig
from protocol.text import counted, printable
from protocol.validity import check_parameter

DRIVE, LOAD = 1, 2
SAMPLES, EDGES = 0, 1  # stream numbers that the bench uses
ALL_STREAMS = 0xFFFFFFFF
MAX_LATENCY_MS = 20  # with which the bench configures streams
DUE = 0.15  # s after which the next heartbeat is late
MOST_BLOB = 1 << 20  # bytes of a blob that is read at once


@dataclass(frozen=True, slots=True)
class ClockFit:
    """Host time of device ticks, from one TIME_SYNC; good to half its round trip."""

    tick: float
    host: float  # s
    tick_hz: float
    round_trip: float  # s

    def host_time(self, tick: float) -> float:
        """Host time in s of a device tick."""
        return self.host + (tick - self.tick) / self.tick_hz

    def device_tick(self, host: float) -> int:
        """Device tick at a host time in s."""
        return round(self.tick + (host - self.host) * self.tick_hz)


class Node:
    """Device number `number` on `client`'s link."""

    def __init__(self, client: Client, number: int) -> None:
        self.client = client
        self.number = number
        self.encoder = True
        """False: none is mounted, whatever the firmware tells: then no channel has the flag REFERENCE."""
        self._identity: HelloReply | None = None
        self._descriptor: Descriptor | None = None
        self._streams: dict[int, StreamSet] = {}
        self._vigil: Vigil | None = None  # while it should run
        self._counter: int | None = None  # of the last setpoint
        self._under_way: UnderWay | None = None  # setpoints that are not waited for
        self.stopped_for = ""
        """Why it is stopped, for OutputsMayBeOn to name; until it is off."""
        self.load = 0.0
        """Share of the link that its streams take at most, by the device; 0 = unknown."""

    # -- identity and parameters --------------------------------------------------------------------------------

    @property
    def identity(self) -> HelloReply:
        """Who it is; asked for at first use. Raises NoReply when no such node is on the link."""
        if self._identity is None:
            reply = self.client.request(Hello(nonce=self.client.nonce()), self.number, HelloReply)
            self._identity = reply
        return self._identity

    @property
    def descriptor(self) -> Descriptor:
        """Its channels and parameters; read, and checked against the schema CRC of HELLO, at first use."""
        if self._descriptor is None:
            self._descriptor = self._read_descriptor()
        return self._descriptor

    def forget(self) -> None:
        """The device has rebooted: ask anew for all that it told us."""
        self._identity = self._descriptor = None

    def _read_descriptor(self) -> Descriptor:
        blob = self._read_blob(DESCRIPTOR, "the descriptor")
        if (crc := crc32(blob)) != self.identity.schema_crc:
            raise NodeError(
                f"the descriptor of node {self.number} has CRC {crc:08x}, HELLO announced "
                f"{self.identity.schema_crc:08x}: the firmware's schema_crc is wrong"
            )
        told = Descriptor.unpack(blob, f"node {self.number}")
        self.client.parameters[self.number] = {record.id: record.name for record in told.parameters}
        if self.encoder:
            return told
        return replace(told, channels=tuple(replace(c, flags=c.flags & ~Flag.REFERENCE) for c in told.channels))

    def meanings(self) -> dict[str, str]:
        """What the device itself says that its parameters and channels mean, by name; empty where it says nothing."""
        if not self.identity.features & Feature.MEANINGS:
            return {}
        text = self._read_blob(MEANINGS, "the blob of meanings").decode("utf-8", "replace")
        pairs = (line.partition(" ") for line in text.split("\n"))
        return {name: printable(meaning) for name, _, meaning in pairs if name and meaning}

    def _read_blob(self, number: int, what: str) -> bytes:
        blob, total, part = b"", 1, part_bytes(self.client.session.wire)
        while len(blob) < total:
            reply = read_part(self.client, self.number, number, len(blob), part)
            total = reply.total
            if not reply.data and total:
                raise NodeError(f"{what} of node {self.number} ends at {len(blob)} of {total} bytes")
            blob += reply.data
            if len(blob) > MOST_BLOB:
                raise NodeError(f"{what} of node {self.number} is said to have {total} bytes: more than {MOST_BLOB}")
        return blob

    def waveform_room(self) -> int:
        """Samples that the waveform of the test signal may have. Needs the feature WAVEFORM."""
        return read_part(self.client, self.number, WAVEFORM, 0, 0).total // 2

    def write_waveform(self, data: bytes) -> None:
        """Write the samples of the test signal (i16), from the first on, and read them back; NodeError if they differ.

        Needs the feature WAVEFORM.
        """
        part = min(part_bytes(self.client.session.wire), self.identity.rx_max - BlobWrite.FIXED_BYTES)
        for at in range(0, len(data), part):
            piece = data[at : at + part]
            self.client.request(BlobWrite(WAVEFORM, len(piece), at, piece), self.number, Empty)
            back = read_part(self.client, self.number, WAVEFORM, at, len(piece)).data
            if back != piece[: len(back)]:
                raise NodeError(f"node {self.number} does not hold the waveform that was written to it")

    def parameter(self, name: str) -> ParamReply:
        """Value, range and default of a parameter, in its unit. Raises DeviceDefect if its value cannot be."""
        reply = self.client.request(ParamGet(self._parameter_id(name)), self.number, ParamReply)
        check_parameter(name, reply, f"node {self.number}")
        return reply

    def parameter_replies(self) -> dict[str, ParamReply]:
        """All parameters by name, as the device tells them: to be shown, not to be used."""
        records = self.descriptor.parameters
        return {r.name: self.client.request(ParamGet(r.id), self.number, ParamReply) for r in records}

    def has_parameter(self, name: str) -> bool:
        """Whether it has a parameter of that name."""
        return any(record.name == name for record in self.descriptor.parameters)

    @property
    def offers_edges(self) -> bool:
        """Whether it can stream Hall edges."""
        return bool(self.identity.features & Feature.EDGES)

    @property
    def offers_capture(self) -> bool:
        """Whether it holds samples in its own memory until a trigger freezes them."""
        return bool(self.identity.features & Feature.CAPTURE)

    def parameters(self) -> dict[str, float]:
        """All parameters by name. Raises DeviceDefect if one of the values cannot be."""
        return {record.name: self.parameter(record.name).value for record in self.descriptor.parameters}

    def set(self, name: str, value: float) -> float:
        """Set a parameter; returns the value that the device stored. Raises NodeError with the range if refused."""
        key = self.number, name
        told = self.client.changed.get(key)
        try:
            stored = self.client.request(ParamSet(self._parameter_id(name), value), self.number, ParamStored).stored
        except Refused as refusal:
            if refusal.code == ErrorCode.OUT_OF_RANGE:
                now = self.parameter(name)
                if not now.lo <= value <= now.hi:
                    raise NodeError(f"{name} must be {now.lo:g}..{now.hi:g}, got {value:g}") from None
                limit = f"it is beyond {refusal.detail:g}"
                raise NodeError(f"{name} = {value:g} was refused by node {self.number}: {limit}") from None
            if refusal.code == ErrorCode.WRONG_STATE and self._idle_only(name):
                state = DriveState(int(refusal.detail)).name
                why = f"node {self.number} takes it only with its outputs off, and is {state}: stop it first"
                raise NodeError(f"{name} was not set to {value:g}: {why}") from None
            if refusal.code == ErrorCode.READ_ONLY:
                raise NodeError(f"{name} of node {self.number} can only be read") from None
            raise NodeError(f"{name} = {value:g} was refused by node {self.number}: {refusal}") from None
        if self.client.changed.get(key) is told:  # it has not said so itself
            self.client.changed[key] = ParameterSet(self.client.newest(self.number), self.number, name, stored)
            self.client.tell(self.client.changed[key])
        return stored

    def _idle_only(self, name: str) -> bool:
        return any(record.name == name and record.flags & Flag.IDLE_ONLY for record in self.descriptor.parameters)

    def store(self) -> None:
        """Have all parameters kept for the next boot. Raises NodeError where it will not."""
        try:
            self.client.request(ParamCommit(), self.number, Empty)
        except Refused as refusal:
            raise NodeError(f"node {self.number} did not store its parameters: {refusal}") from None

    def _parameter_id(self, name: str) -> int:
        return self._record(self.descriptor.parameters, name, "parameter").id

    def channels(self, names: Iterable[str] | None) -> tuple[Channel, ...]:
        """The channels of these names in the device's order; for None all but those that are streamed on request.

        Where all names begin with a +, they come on top of these.
        """
        known = self.descriptor.channels
        if not known:
            raise NodeError(f"node {self.number} has no channels to stream")
        names = tuple(names or ())
        if not names and all(channel.flags & Flag.ON_REQUEST for channel in known):
            listed = ", ".join(channel.name for channel in known)
            raise NodeError(
                f"every channel of node {self.number} is streamed on request only: name those that are wanted, with "
                f"--channels (in Python: channels=); it has {listed}"
            )
        chosen = set()
        if all(name.startswith("+") for name in names):
            chosen = {channel.id for channel in known if not channel.flags & Flag.ON_REQUEST}
        chosen |= {self._record(known, name.removeprefix("+"), "channel").id for name in names}
        return tuple(channel for channel in known if channel.id in chosen)

    def _record(self, records: tuple[Channel, ...], name: str, kind: str) -> Channel:
        for record in records:
            if record.name == name:
                return record
        names = [record.name for record in records]
        near = difflib.get_close_matches(name, names, 1)
        hint = f"did you mean {near[0]}?" if near else f"it has {', '.join(names) or 'none'}"
        raise NodeError(f"node {self.number} has no {kind} '{name}': {hint}")

    # -- states and setpoints -----------------------------------------------------------------------------------

    @property
    def state(self) -> DriveState:
        """State by the last heartbeat, by HELLO before the first."""
        heartbeat = self.client.heartbeats.get(self.number)
        return heartbeat.state if heartbeat else self.identity.state

    def command(self, command: Command, argument: int = 0) -> DriveState:
        """Send a state command and return the state after it."""
        return self.client.request(StateCommand(command, argument), self.number, StateReply).state

    def arm(self) -> None:
        """IDLE to ARMED, and start to feed the watchdog. A latched fault is named, not cleared.

        Nothing is armed unless its heartbeats come, and are those of one device: NodeError. Raises NodeError if it is
        refused, and DriveFailed, with the node stopped, unless a heartbeat shows it ARMED with its watchdog at work.
        """
        self.require_alive()
        self.client.feed(self.number, on=True)
        try:
            state = self.command(Command.ARM, self.identity.boot_id)
        except Refused as refusal:
            self.client.feed(self.number, on=False)
            if refusal.code == ErrorCode.WRONG_STATE and refusal.detail == DriveState.FAULT:
                raise NodeError(
                    f"node {self.number} has a latched fault ({self.fault_text()}): find the cause, "
                    "then clear it with --clear-faults"
                ) from None
            raise NodeError(f"node {self.number} refused to arm: {refusal}") from None
        answered = self.client.now()
        beat = heard(self, lambda heartbeat: heartbeat.state == DriveState.ARMED, HEARTBEATS)
        tripped = "" if beat else self._tripped()  # which waits for one more
        beat = beat or self._said_since(answered)
        if beat is None:
            unseen = f"no heartbeat came in the {self.client.now() - answered:.2f} s after that, to see it go off by"
            why = f"it answered ARM with {state.name}, but {unseen}"
        elif beat.state != DriveState.ARMED:
            why = f"it answered ARM with {state.name}, but {tripped or says(beat)}"
        else:
            why = without_watchdog(beat)
        if why:
            self._give_up(f"refusing to energise node {self.number}: {why}")

    def require_alive(self) -> None:
        """NodeError unless it is one device whose heartbeats come: without them nobody would see it go off."""
        number, boots = self.number, self.client.boots.setdefault(self.number, {})
        self.client.listen(number)

        def late() -> bool:
            return max((came for came, _ in boots.values()), default=-math.inf) < self.client.now() - DUE

        if late() and not self.client.wait(lambda: not late(), 2 * HEARTBEATS):
            why = "it sends no heartbeat (one every 100 ms is due), so nobody could see its outputs go off"
            raise NodeError(f"refusing to energise node {number} on {self.client.link.name}: {why}; nothing was armed")
        self.require_boot()

    def require_boot(self) -> None:
        """Have HELLO and heartbeats of the same boot. Raises DeviceDefect if the firmware tells two boot_ids."""
        told = self.client.heartbeats.get(self.number)
        if told is not None and told.boot_id != self.identity.boot_id:
            self.forget()  # it may have rebooted since
            boot_id, now = self.identity.boot_id, self.next_heartbeat()
            if now is not None and now.boot_id != boot_id:
                self.client.listen(self.number)
                said = f"boot_id is {boot_id:08x} in its HELLO and {now.boot_id:08x} in its heartbeats"
                raise DeviceDefect(f"node {self.number}: {said}")

    def _said_since(self, began: float) -> Heartbeat | None:
        """Its newest heartbeat, if it came after a time."""
        came, heartbeat = max(self.client.boots.get(self.number, {}).values(), default=(0.0, None), key=itemgetter(0))
        return heartbeat if came > began else None

    def _give_up(self, why: str) -> NoReturn:
        """STOP, and raise DriveFailed; OutputsMayBeOn, which says why too, if it is not seen to be off."""
        self.stopped_for = why
        try:
            self.stop()
        except DriveFailed as failure:
            raise DriveFailed(f"{why}; {failure}") from None
        raise DriveFailed(why)

    def start(self) -> None:
        """ARMED to RUNNING: the outputs go on. Raises NodeError if it is refused, DriveFailed if it did not start."""
        try:
            state = self.command(Command.START)
        except Refused as refusal:
            if refusal.code == ErrorCode.WRONG_STATE and (tripped := self._tripped()):
                self._give_up(f"node {self.number} refused START, because {tripped}")
            raise NodeError(f"node {self.number} refused to start: {refusal}") from None
        if state != DriveState.RUNNING:
            raise DriveFailed(f"node {self.number} did not start: it answered START with {state.name}")
        self._vigil = Vigil(self)

    def _tripped(self, heartbeat: Heartbeat | None = None) -> str:
        """That it has tripped, by which faults, and why its watchdog ran out, if it did; empty if it has not.

        By this heartbeat, else by the next one.
        """
        heartbeat = heartbeat or self.next_heartbeat()
        if heartbeat is None or heartbeat.state != DriveState.FAULT:
            return ""
        unfed = self.unfed(heartbeat.faults)
        return f"it tripped: {', '.join(fault_names(heartbeat.faults))}{unfed and f': {unfed}'}"

    def unfed(self, faults: Fault, watchdog: float | None = None) -> str:
        """Why its watchdog, which waits `watchdog` s (None: ask it), ran out; empty if that is not among `faults`."""
        if not faults & Fault.WATCHDOG:
            return ""
        if watchdog is None:
            watchdog = WATCHDOG
            with suppress(HbpError, NodeError):
                watchdog = self.parameter("watchdog").value if self.has_parameter("watchdog") else WATCHDOG
        return why_unfed(self, watchdog)

    def astray(self) -> str:
        """Why a node that was started does not run as it should, by its heartbeats; see `bench.device.safety.Vigil`."""
        return "" if self._vigil is None else self._vigil.astray()

    def stop(self) -> DriveState:
        """Outputs off, from any state, and seen to be off: see `bench.device.safety.switch_off` for what it raises."""
        self._vigil = None
        try:
            state = switch_off(self)
        except OutputsMayBeOn as failure:
            raise OutputsMayBeOn(f"{failure} ({self.stopped_for})" if self.stopped_for else str(failure)) from None
        self.stopped_for = ""
        return state

    def clear_faults(self) -> None:
        """Clear exactly the faults that the last heartbeat showed; refused if there are others by now."""
        heartbeat = self.next_heartbeat()
        if heartbeat is not None and heartbeat.state == DriveState.FAULT:
            try:
                self.command(Command.FAULT_CLEAR, int(heartbeat.faults))
            except Refused as refusal:
                raise NodeError(
                    f"node {self.number} did not clear {self.fault_text()}: {refusal}; the cause may persist"
                ) from None
            self.client.faults.pop(self.number, None)
            self.next_heartbeat()  # the last one still shows the fault

    def fault_text(self) -> str:
        """The active faults by name, the first one marked."""
        heartbeat = self.client.heartbeats.get(self.number) or self.next_heartbeat()
        if heartbeat is None or not heartbeat.faults:
            return "none"
        names, first = ", ".join(fault_names(heartbeat.faults)), fault_names(heartbeat.first_fault)
        return names + (f"; first: {', '.join(first)}" if first and "," in names else "")

    def recent_heartbeat(self) -> Heartbeat | None:
        """The last heartbeat of this boot, if the next one is not late yet."""
        heartbeat = self._said_since(self.client.now() - DUE)
        return heartbeat if heartbeat is self.client.heartbeats.get(self.number) else None

    def next_heartbeat(self) -> Heartbeat | None:
        """The next heartbeat; the last one, or None, if none comes within 0.5 s."""
        before = self.client.heartbeats.get(self.number)
        self.client.wait(lambda: self.client.heartbeats.get(self.number) is not before, 0.5)
        return self.client.heartbeats.get(self.number)

    def setpoint(
        self, mode: SetpointMode, value: float, value2: float = 0.0, unless: Callable[[], bool] = lambda: False
    ) -> None:
        """Send a setpoint until a heartbeat confirms it, or `unless()` holds, which is asked meanwhile.

        NodeError if it is rejected, NoReply if it is not confirmed. Within `unwaited` it is sent, and that is all.
        """
        if self._under_way is not None:
            self._under_way.send(self._next_setpoint(mode, value, value2))
            return
        for _ in range(TRIES):
            setpoint = self._next_setpoint(mode, value, value2)
            heartbeat = self.client.heartbeats.get(self.number)
            rejected = heartbeat.setpoints_rejected if heartbeat else 0
            self.client.rejections.pop(self.number, None)
            self.client.session.send(setpoint, self.number)  # a heartbeat tells its fate

            def answered(counter: int = setpoint.counter, rejected: int = rejected) -> bool:
                now = self.client.heartbeats.get(self.number)
                return now is not None and (now.setpoint_counter == counter or now.setpoints_rejected != rejected)

            if self.client.wait(lambda: unless() or answered(), WAIT):
                if not answered():
                    return
                confirmed = self.client.heartbeats[self.number]
                if confirmed.boot_id != self.identity.boot_id:  # it has rebooted, or is another device
                    self.stop()
                    self.client.listen(self.number)
                    raise DriveFailed(f"node {self.number} has rebooted")
                if confirmed.setpoint_counter == setpoint.counter:
                    return
                raise self._rejection(confirmed, setpoint)
        raise NoReply(f"node {self.number} on {self.client.link.name} confirmed no setpoint in {TRIES} tries")

    @contextmanager
    def unwaited(self) -> Iterator[None]:
        """Within this, setpoints are not waited for: `watch_setpoints`, in every turn, sees what became of them."""
        self._under_way = UnderWay(self.client, self.number, self._rejection)
        try:
            yield
        finally:
            self._under_way = None

    def watch_setpoints(self) -> None:
        """Within `unwaited`: see by its heartbeats what became of setpoints. Raises as `setpoint` does."""
        if self._under_way is not None:
            self._under_way.watch(self.setpoint)

    def _next_setpoint(self, mode: SetpointMode, value: float, value2: float) -> Setpoint:
        """One with a counter that the heartbeats do not tell yet, nor told of an earlier host."""
        heartbeat = self.client.heartbeats.get(self.number) or self.next_heartbeat()
        before = self._counter if self._counter is not None else heartbeat.setpoint_counter if heartbeat else 0
        self._counter = before % 0xFFFF + 1
        return Setpoint(mode, self._counter, value, value2)

    def _rejection(self, heartbeat: Heartbeat, setpoint: Setpoint) -> NodeError:
        """The error of a setpoint that was rejected, as this heartbeat tells."""
        if self._vigil is not None and (why := self._vigil.not_running(heartbeat)):
            return DriveFailed(f"node {self.number} {why}")
        if tripped := self._tripped(heartbeat):
            return NodeError(f"node {self.number} took no setpoint, because {tripped}")
        return NodeError(
            f"node {self.number} rejected the setpoint {setpoint.mode.name} {setpoint.value:g}: {self._why_rejected()} "
            f"(state {heartbeat.state.name}, faults: {self.fault_text()})"
        )

    def _why_rejected(self) -> str:
        event = self.client.rejections.get(self.number)
        if event is None:
            return "no reason given"
        code = "no code" if event.number is None else ErrorCode(event.number).name
        return f"{code} ({event.detail:g})"

    def speed(self, omega_m: float, unless: Callable[[], bool] = lambda: False, i_d: float = 0.0) -> None:
        """Speed reference (a drive) or forced speed (a load machine), mechanical rad/s. See `setpoint`.

        `i_d`, A, beside it: of a drive with the feature COMMISSION.
        """
        self.setpoint(SetpointMode.SPEED, omega_m, i_d, unless=unless)

    def current(self, i_q: float, i_d: float = 0.0) -> None:
        """Current references in A."""
        self.setpoint(SetpointMode.CURRENT, i_q, i_d)

    def voltage(self, u_q: float, u_d: float = 0.0) -> None:
        """The voltage vector in V, in the frame of the control's angle: of a drive with the feature COMMISSION."""
        self.setpoint(SetpointMode.VOLTAGE, u_q, u_d)

    def torque(self, tau: float) -> None:
        """Torque of a load machine in N·m, against the drive's positive direction."""
        self.setpoint(SetpointMode.TORQUE, tau)

    # -- streams ------------------------------------------------------------------------------------------------

    def clock_fit(self, tries: int = 3) -> ClockFit:
        """Relate device ticks to host time by the quickest of `tries` TIME_SYNCs."""
        fits = []
        for _ in range(tries):
            sent = self.client.now()
            reply = self.client.request(TimeSync(), self.number, TimeSyncReply)
            got = self.client.now()
            middle = (reply.rx_tick + reply.tx_tick) / 2
            fits.append(ClockFit(middle, (sent + got) / 2, self.identity.tick_hz, got - sent))
        return min(fits, key=lambda fit: fit.round_trip)

    def stop_streams(self) -> None:
        """Stop every stream, those of an earlier host too; what had not come by then is counted as lost."""
        last = self.client.heartbeats.get(self.number)
        try:
            if self._streams:
                last = self.next_heartbeat()  # it tells what is to come
            self.client.request(StreamStop(ALL_STREAMS), self.number, Empty)
        finally:
            self._streams.clear()
            self.load = 0.0
            self.client.end_streams(self.number, last)

    def set_samples(self, channels: tuple[Channel, ...], decimation: int) -> StreamConfig:
        """Configure the sample stream. Raises DoesNotFit, with what would fit, when the link cannot carry it."""
        ids = tuple(channel.id for channel in channels)
        return self._configure(StreamSet(SAMPLES, StreamEvent.PWM, decimation, MAX_LATENCY_MS, ids))

    def set_edges(self) -> StreamConfig:
        """Configure the stream of Hall edges."""
        return self._configure(StreamSet(EDGES, StreamEvent.EDGES, 1, MAX_LATENCY_MS))

    def configured_streams(self) -> list[StreamInfo]:
        """What it says of each stream that somebody has configured in it."""
        found = []
        for number in range(MAX_STREAMS):
            try:
                found.append(self.client.request(StreamGet(number), self.number, StreamInfo))
            except Refused as refusal:
                if refusal.code != ErrorCode.UNKNOWN_ID:
                    raise
        return found

    def active_streams(self) -> list[StreamConfig]:
        """The streams that are configured in it now, by whomever."""
        configs = []
        for info in self.configured_streams():
            if info.event not in (StreamEvent.PWM, StreamEvent.EDGES, StreamEvent.MEAN):
                continue  # of a later version
            request = StreamSet(info.stream, info.event, info.decimation, info.max_latency_ms, info.channels)
            reply = StreamReply(info.stream, info.cfg_id, info.sample_bytes, info.block, 0.0, info.slot, info.tick0)
            configs.append(StreamConfig.of(self.identity, request, reply, self.descriptor))
        return configs

    def start_streams(self) -> None:
        """Start the streams that were configured."""
        self.client.request(StreamStart(sum(1 << stream for stream in self._streams)), self.number, Empty)
        self.client.streams_started(self.number)

    def resume_streams(self) -> None:
        """After a reboot: configure and start again what the device has forgotten."""
        self.forget()
        for request in tuple(self._streams.values()):
            self._configure(request)
        self.start_streams()

    def _configure(self, request: StreamSet) -> StreamConfig:
        most = (self.identity.rx_max - StreamSet.FIXED_BYTES) // 2
        if len(request.channels) > most:
            asked = counted(len(request.channels), "channel")
            takes = f"node {self.number} takes at most {counted(most, 'channel')} per stream"
            raise DoesNotFit(f"{takes}, not {asked}: choose with --channels", 0)
        try:
            reply = self.client.request(request, self.number, StreamReply)
        except Refused as refusal:
            raise self._refusal(refusal, request) from None
        config = StreamConfig.of(self.identity, request, reply, self.descriptor)
        self._streams[request.stream] = request
        self.load = reply.load
        self.client.decode(config)
        return config

    def _refusal(self, refusal: Refused, request: StreamSet) -> NodeError:
        if refusal.code != ErrorCode.DOES_NOT_FIT:
            return NodeError(f"node {self.number} refused to stream: {refusal}")
        pwm_hz, link = self.identity.pwm_hz, self.client.link.name
        asked = f"{counted(len(request.channels), 'channel')} at {pwm_hz / request.decimation:g} Hz"
        by_id = {channel.id: channel for channel in self.descriptor.channels}
        widths = [np.dtype(by_id[number].raw.dtype).itemsize for number in request.channels]
        room = min(self.identity.tx_max, MAX_PAYLOAD) - STREAM_HEADER.size
        wire = self.client.session.wire
        if sum(widths) > room and not isinstance(wire, CanWire):
            why = f"a sample of {sum(widths)} bytes is too long: node {self.number} sends at most {room}"
            return DoesNotFit(f"{why}; choose fewer channels with --channels", 0)
        decimation = (whole_from_wire(refusal.detail) or 0) if widths else 0
        if isinstance(wire, CanWire):
            plan = BusPlan(wire.rates, wire.extended, pwm_hz, request.max_latency_ms)
            if not widths:
                alone = edge_load(wire.rates, wire.extended)
                return DoesNotFit(
                    f"{link} ({wire.rates}) is too slow: the Hall edges alone, counted as {EDGES_PER_SECOND:g} a "
                    f"second, would load it to {alone:.0%}; 250 kbit/s is enough",
                    0,
                )
            fits = ", ".join(
                f"{counted(fit.channels, 'channel')} at {fit.rate:g} Hz ({fit.load:.0%})"
                for fit in plan.choices(widths, request.decimation)
            )
            why = (
                f"{asked} would load {link} ({wire.rates}) to {plan.load(widths, request.decimation):.0%}; what fits: "
                f"{fits or 'nothing'}: choose with --channels and --rate, or let --fit choose the rate"
            )
        else:
            slower = f"they would at --rate {pwm_hz / max(decimation, 1):g} (--fit chooses it), or"
            fits = slower if decimation else "nor do they slower:"
            why = f"{asked} do not fit {link}; {fits} choose fewer with --channels"
        return DoesNotFit(why, decimation)
