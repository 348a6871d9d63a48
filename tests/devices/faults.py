"""What a drive may get wrong, by name, and how it then differs; faults combine.

`build(FULL, ["stop-refused", "watchdog-dead"])` makes a device with both.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from math import inf, nan
from typing import Any

import numpy as np
from cobs import cobs

from protocol.canmap.transport import ID_MASK, START, TOGGLE, Reassembler
from protocol.framing import parse_frame
from tests.devices.device import UNFED, Device, Peer
from tests.devices.motor import Samples, hall_code
from tests.devices.spec import ERROR, Code, Command, Event, Flag, Message, Mode, Raw, Refusal, Source, State, Type, Unit
from tests.devices.streams import Record, Stream
from tests.devices.vocabulary import FULL, Channel, Vocabulary, encoded

FAULTS: dict[str, type[Device]] = {}


def fault(name: str, about: str, stream_kind: type[Stream] = Stream, **steps: Callable[..., Any]) -> None:
    """Enter a device under this name.

    Args:
        about: what it gets wrong.
        stream_kind: what makes its streams.
        steps: methods of `Device`, by name, and what happens instead; called with the device, the method that is
            replaced, and the arguments.
    """
    kind = type(name, (Device,), {"__doc__": about})
    if stream_kind is not Stream:
        kind.stream_kind = stream_kind  # type: ignore[attr-defined]
    for step, does in steps.items():
        setattr(kind, step, _instead(kind, step, does))
    FAULTS[name] = kind


def _instead(kind: type, step: str, does: Callable[..., Any]) -> Callable[..., Any]:
    return lambda self, *given: does(self, getattr(super(kind, self), step), *given)


def build(vocabulary: Vocabulary = FULL, faults: Iterable[str] = (), **options: Any) -> Device:
    """A device of this vocabulary with these faults; `options` are those of `Device`. KeyError for an unknown fault."""
    kinds = tuple(FAULTS[name] for name in faults)
    return type("Faulty", (*kinds, Device), {})(vocabulary, **options) if kinds else Device(vocabulary, **options)


def refuses(code: Code, detail: float = 0) -> Callable[..., Any]:
    """A step that is refused."""

    def refuse(self: Device, *_: object) -> None:
        raise Refusal(code, detail)

    return refuse


def told(**fields: Any) -> Callable[..., dict[str, Any]]:
    """Fields of HELLO or a heartbeat that say something else."""
    return lambda self, fields_of, *given: fields_of(*given) | fields


def once(happens: Callable[[Device], object]) -> Callable[..., None]:
    """A moment at which something happens when it is due."""

    def moment(self: Device, before: Callable[[], None]) -> None:
        before()
        if self.due():
            happens(self)

    return moment


def beats(self: Device) -> int:
    """Counts the heartbeats from 1 on."""
    self.beats = getattr(self, "beats", 0) + 1  # type: ignore[attr-defined]
    return self.beats  # type: ignore[attr-defined,no-any-return]


# -- STOP -------------------------------------------------------------------------------------------------------------


def _outputs_stay(self: Device, stop: Callable[[], State]) -> State:
    setpoint = self.motor.setpoint
    stop()
    self.motor.setpoint = setpoint
    return self.state


def _unanswered(self: Device, answer: Callable[..., None], request: Message, *rest: Any) -> None:
    if request.type != Type.STATE_CMD or request.payload[0] != Command.STOP:
        answer(request, *rest)


def _stop_once(self: Any, state_cmd: Callable[..., bytes], message: Message, peer: Peer) -> bytes:
    if message.payload[0] == Command.STOP:
        if message == getattr(self, "last", None):
            return struct.pack("<Bxxx", State.IDLE)
        self.last = message
    return state_cmd(message, peer)


fault(
    "stop-ignored",
    "STOP is confirmed with IDLE, and it goes on RUNNING; the watchdog does not end that.",
    stop=lambda self, _: State.IDLE,
    watchdog_expired=lambda self, _: False,
)
fault("stop-outputs-stay", "STOP is confirmed, the state is IDLE, but outputs_on stays 1.", stop=_outputs_stay)
fault("stop-says-running", "The reply to STOP says RUNNING, and so it is.", stop=lambda self, _: self.state)
fault("stop-refused", "STOP is refused (BUSY).", stop=refuses(Code.BUSY))
fault("stop-unanswered", "STOP is neither obeyed nor answered.", stop=lambda self, _: self.state, answer=_unanswered)
fault(
    "stop-third-time",
    "STOP is obeyed from the third one on; before that it is confirmed with the state as it is.",
    stop=lambda self, stop: stop() if len(self.stops) >= 3 else self.state,
)
fault(
    "stop-confirmed-only",
    "STOP is confirmed with IDLE and not obeyed.",
    stop=lambda self, _: State.IDLE if self.state != State.FAULT else self.state,
)
fault(
    "stop-refused-in-fault",
    "STOP in FAULT is refused.",
    stop=lambda self, stop: refuses(Code.WRONG_STATE, self.state)(self) if self.state == State.FAULT else stop(),
)
fault("stop-once", "A repeated STOP is answered, and not executed again.", state_cmd=_stop_once)

# -- START, and leaving RUNNING -----------------------------------------------------------------------------------


def _without_arm(self: Device, start: Callable[[], State]) -> State:
    if self.state == State.IDLE:
        self.arm(self.boot_id)
    return start()


def _state_first(self: Device, arm: Callable[[int], State], token: int) -> State:
    if self.state not in (State.IDLE, State.ARMED):
        raise Refusal(Code.WRONG_STATE, self.state)
    return arm(token)


def _armed_anew(self: Device, advance: Callable[[], None]) -> None:
    self._armed_at = self.tick()
    advance()


fault("start-stays-armed", "START is answered with RUNNING, but it stays ARMED.", start=lambda self, _: State.RUNNING)
fault("start-says-armed", "The reply to START says ARMED, and so it is.", start=lambda self, _: self.state)
fault("start-without-arm", "START in IDLE is obeyed.", start=_without_arm)
fault("state-before-token", "ARM in a state that forbids it is told that, whatever its token.", arm=_state_first)
fault("armed-for-ever", "ARMED does not lapse.", advance=_armed_anew)
fault("leaves-running", "It goes to IDLE by itself, without a fault, as after a STOP.", moment=once(Device.stop))
fault(
    "foreign-stop",
    "Somebody else on the CAN bus sends a frame of class 0.",
    moment=once(lambda self: self.carrier.foreign(self.node << 4, b"")),  # type: ignore[union-attr]  # on CAN only
)
fault("reboots", "A reset in the middle of a run.", moment=once(lambda self: self.boot()))

# -- watchdog, heartbeats, replies -------------------------------------------------------------------------------------


def _stops_beating(self: Device, heartbeat: Callable[[], None]) -> None:
    if self.started_at is None or self.seconds - self.started_at < self.after:
        heartbeat()


def _booting(self: Device, advance: Callable[[], None]) -> None:
    if self.seconds >= self.after:
        advance()
    else:
        self._periods = self.tick() // self._ticks


def _watchdog_at(share: float) -> Callable[..., bool]:
    """The watchdog waits for this share of its time, whatever it tells."""
    return lambda self, _: self.tick() - self._fed_at >= self.value("watchdog", self.watchdog) * share * 1e6


def _fed_by_requests(self: Device, execute: Callable[..., bytes], message: Message, peer: Peer) -> bytes:
    if message.type != Type.SETPOINT:
        self._fed_at = self.tick()
    return execute(message, peer)


def _fed_by_rejected(self: Device, reject: Callable[..., None], *given: Any) -> None:
    reject(*given)
    self._fed_at = self.tick()


def _late(seconds: float) -> dict[str, Callable[..., None]]:
    """Every answer but that to HELLO waits for so long."""

    def answer(self: Any, as_usual: Callable[..., None], request: Message, *rest: Any) -> None:
        if request.type == Type.HELLO:
            as_usual(request, *rest)
        else:
            self.later = [*getattr(self, "later", []), (self.seconds + seconds, as_usual, (request, *rest))]

    def moment(self: Any, before: Callable[[], None]) -> None:
        before()
        due = [each for each in getattr(self, "later", []) if each[0] <= self.seconds]
        self.later = [each for each in getattr(self, "later", []) if each not in due]
        for _, send, given in due:
            send(*given)

    return {"answer": answer, "answer_again": answer, "moment": moment}


def _mute(kind: Type) -> Callable[..., None]:
    """Requests of this type are executed, and not answered."""

    def answer(self: Device, as_usual: Callable[..., None], request: Message, *rest: Any) -> None:
        if request.type != kind:
            as_usual(request, *rest)

    return answer


def _stop_refused(*states: State, argument: int | None = None) -> Callable[..., bytes]:
    """STOP is refused in these states, or with this argument only."""

    def state_cmd(self: Device, as_usual: Callable[..., bytes], message: Message, peer: Peer) -> bytes:
        given = int.from_bytes(message.payload[4:8], "little")
        if message.payload[0] == Command.STOP and self.state in states and argument in (None, given):
            raise Refusal(Code.WRONG_STATE, self.state)
        return as_usual(message, peer)

    return state_cmd


def _answers_with(tid: Callable[[int], int]) -> Callable[..., None]:
    """Replies, but those to HELLO, have another tid than their request."""

    def answer(self: Device, as_usual: Callable[..., None], request: Message, reply: Message, *rest: Any) -> None:
        as_usual(request, reply if request.type == Type.HELLO else reply._replace(tid=tid(reply.tid)), *rest)

    return answer


fault("no-watchdog", "watchdog_ms is always 0xFFFF: none is at work.", watchdog_left=lambda self, _: UNFED)
fault(
    "no-watchdog-running",
    "watchdog_ms is as it should be in ARMED and 0xFFFF in RUNNING.",
    watchdog_left=lambda self, left: UNFED if self.state == State.RUNNING else left(),
)
fault("watchdog-dead", "The watchdog counts down and never trips.", watchdog_expired=lambda self, _: False)
fault("watchdog-late", "It trips after twice its time.", watchdog_expired=_watchdog_at(2.0))
fault("watchdog-early", "It trips after three quarters of its time.", watchdog_expired=_watchdog_at(0.75))
fault("watchdog-fed-by-requests", "Any request feeds the watchdog.", execute=_fed_by_requests)
fault("watchdog-fed-by-rejected", "A rejected setpoint feeds the watchdog.", reject=_fed_by_rejected)
fault("heartbeats-stop", "No more heartbeats; all else goes on.", heartbeat=_stops_beating)
fault(
    "heartbeats-slow",
    "A heartbeat every 200 ms.",
    heartbeat=lambda self, heartbeat: heartbeat() if beats(self) % 2 == 0 else None,
)
fault("heartbeats-never", "Not one heartbeat.", heartbeat=lambda self, _: None)
fault(
    "boots",
    "It boots for `after` s: until then it neither hears nor sends.",
    receive=lambda self, receive, *given: receive(*given) if self.seconds >= self.after else None,
    advance=_booting,
)
fault("deaf", "It hears nothing, and sends its heartbeats.", receive=lambda self, *_: None)
for _ms in (140, 300, 700, 2000):
    fault(f"late-{_ms}", f"Answers, but those to HELLO, come after {_ms} ms.", **_late(1e-3 * _ms))
for _kind in (Type.TIME_SYNC, Type.BLOB_READ, Type.PARAM_GET, Type.PARAM_SET, Type.STATE_CMD, Type.STREAM_SET,
              Type.STREAM_GET, Type.STREAM_START, Type.STREAM_STOP):  # fmt: skip
    fault(f"mute-{_kind.name.lower().replace('_', '-')}", "Requests of this type get no answer.", answer=_mute(_kind))
for _state in (State.IDLE, State.ARMED, State.RUNNING, State.FAULT):
    fault(f"stop-refused-{_state.name.lower()}", "STOP is refused in this state.", state_cmd=_stop_refused(_state))
fault("stop-refused-argument", "STOP is refused with an argument.",
      state_cmd=_stop_refused(*State, argument=0xDEADBEEF))  # fmt: skip
fault("hello-short", "The reply to HELLO lacks the serial number and what follows.",
      hello=lambda self, hello, *given: hello(*given)[:68])  # fmt: skip
fault("hello-long", "The reply to HELLO has more than this host knows.",
      hello=lambda self, hello, *given: hello(*given) + b"more")  # fmt: skip
fault("tid-zero", "Replies have tid 0.", answer=_answers_with(lambda tid: 0))
fault("tid-other", "Replies have the next request's tid.", answer=_answers_with(lambda tid: tid % 0xFFFF + 1))

# -- a motor that cannot be right ---------------------------------------------------------------------------------


def _jammed(self: Device, moment: Callable[[], None]) -> None:
    moment()
    self.motor.jammed = True


def _off(self: Device, distort: Callable[[Samples], None], samples: Samples) -> None:
    distort(samples)
    samples.estimate += math.radians(103)


def _three_times(self: Device, distort: Callable[[Samples], None], samples: Samples) -> None:
    distort(samples)
    if self.state == State.RUNNING:
        samples.i_dq = np.full(len(samples.index), 3j * self.value("i_max", 8.0))


def _turned_round(self: Device, set_point: Callable[..., None], mode: int, value: float, value2: float) -> None:
    set_point(mode, value, value2)
    self.motor.setpoint = Mode(mode), -value


fault("does-not-turn", "The shaft stands still at i_max, as with exchanged Hall wires.", moment=_jammed)
fault("estimate-off", "The position estimates are 103 deg off.", distort=_off)
fault("overcurrent", "Three times i_max flows while it runs, and nothing trips.", distort=_three_times)
fault("backwards", "The shaft turns against the setpoint.", set_point=_turned_round)

# -- setpoints ------------------------------------------------------------------------------------------------------


def _clipped(self: Device, set_point: Callable[..., None], mode: int, value: float, value2: float) -> None:
    try:
        set_point(mode, value, value2)
    except Refusal as refusal:
        if refusal.code != Code.OUT_OF_RANGE:
            raise
        set_point(mode, math.copysign(refusal.detail, value), value2)


for _code in (Code.OUT_OF_RANGE, Code.WRONG_STATE, Code.BAD_VALUE):
    _name = f"rejects-{_code.name.lower().replace('_', '-')}"
    fault(_name, "Every setpoint is rejected with this code.", set_point=refuses(_code, 10))
fault("setpoint-clipped", "A setpoint beyond the limit is made the limit.", set_point=_clipped)


def _kept_setpoint(*after: State) -> dict[str, Callable[..., Any]]:
    """RUNNING begins with the last setpoint where it was left for these states."""

    def enter(self: Any, as_usual: Callable[[State], None], state: State) -> None:
        if self.state == State.RUNNING and state != State.RUNNING:
            self.before = getattr(self, "last", None) if state in after else None
        as_usual(state)

    def set_point(self: Any, as_usual: Callable[..., None], *given: float) -> None:
        as_usual(*given)
        self.last = self.motor.setpoint

    return {"enter": enter, "set_point": set_point,
            "at_start": lambda self, at_start: getattr(self, "before", None) or at_start()}  # fmt: skip


def _early_setpoint(self: Any, set_point: Callable[..., None], mode: int, value: float, value2: float) -> None:
    self.early = (Mode.SPEED, value) if self.state == State.ARMED else None
    set_point(mode, value, value2)


def _rest_after(step: str) -> dict[str, Callable[..., Any]]:
    """This step sets the setpoint in use back to zero."""

    def does(self: Device, as_usual: Callable[..., Any], *given: Any) -> Any:
        if self.motor.setpoint is not None:
            self.motor.setpoint = Mode.CURRENT, 0.0
        return as_usual(*given)

    return {step: does}


def _limited(beyond: Callable[[Device, int, float, float], float | None]) -> Callable[..., None]:
    """Setpoints that are refused by `beyond` too, with what it gives, or taken where the usual limits refuse them."""

    def set_point(self: Device, as_usual: Callable[..., None], mode: int, value: float, value2: float) -> None:
        limit = beyond(self, mode, value, value2)
        try:
            as_usual(mode, value, value2)
        except Refusal as refusal:
            if refusal.code != Code.OUT_OF_RANGE or limit is not None:
                raise
            self.motor.setpoint = Mode(mode), value
            return
        if limit:
            raise Refusal(Code.OUT_OF_RANGE, limit)

    return set_point


def _of(self: Device, mode: int) -> float:
    return self.value("omega_m_max" if mode == Mode.SPEED else "i_max")


fault("setpoint-kept-over-stop", "RUNNING begins with the setpoint before STOP.", **_kept_setpoint(State.IDLE))
fault("setpoint-kept-over-fault", "RUNNING begins with the setpoint before a fault.", **_kept_setpoint(State.FAULT))
fault(
    "setpoint-before-start",
    "A setpoint in ARMED is rejected, and used from START on.",
    set_point=_early_setpoint,
    at_start=lambda self, at_start: getattr(self, "early", None) or at_start(),
)
fault("rejection-sets-zero", "A rejected setpoint sets the one in use to zero.", **_rest_after("reject"))
fault("hello-sets-zero", "HELLO sets the setpoint in use to zero.", **_rest_after("hello"))
fault("start-sets-zero", "START in RUNNING sets the setpoint in use to zero.", **_rest_after("start"))
fault("limit-excluded", "The limit itself is rejected.",
      set_point=_limited(lambda self, mode, value, _: _of(self, mode) * (abs(value) >= _of(self, mode))))  # fmt: skip
fault("limit-forward-only", "A setpoint beyond the limit in reverse is taken.",
      set_point=_limited(lambda self, mode, value, _: None if value < 0 else 0.0))  # fmt: skip
fault("current-by-component", "i_q and i_d are within i_max each, and the vector may be beyond it.",
      set_point=_limited(lambda self, mode, q, d: 0.0 if mode == Mode.SPEED or max(abs(q), abs(d)) > _of(self, mode)
                         else None))  # fmt: skip
fault("current-of-q", "i_d may be beyond i_max.",
      set_point=_limited(lambda self, mode, q, d: 0.0 if mode == Mode.SPEED or abs(q) > _of(self, mode)
                         else None))  # fmt: skip

# -- numbers ----------------------------------------------------------------------------------------------------------


def _faulty_event(argument: float) -> Callable[..., None]:
    """EVENT FAULT with this argument, idle and running, and no fault in the heartbeat."""

    def heartbeat(self: Device, as_usual: Callable[[], None]) -> None:
        as_usual()
        if beats(self) % 3 == 0:
            self.event(Event.FAULT, argument)

    return heartbeat


def _fits(detail: float) -> Callable[..., bytes]:
    """STREAM_SET of samples is refused with DOES_NOT_FIT and this detail."""

    def stream_set(self: Device, as_usual: Callable[..., bytes], message: Message, peer: Peer) -> bytes:
        if message.payload[1] == Source.PWM:
            raise Refusal(Code.DOES_NOT_FIT, detail)
        return as_usual(message, peer)

    return stream_set


def _load(load: float) -> Callable[..., bytes]:
    """Samples fit from decimation 2 on, and their load is this."""

    def stream_set(self: Device, as_usual: Callable[..., bytes], message: Message, peer: Peer) -> bytes:
        if message.payload[1] == Source.PWM and int.from_bytes(message.payload[2:4], "little") < 2:
            raise Refusal(Code.DOES_NOT_FIT, 2.0)
        reply = as_usual(message, peer)
        return reply[:8] + struct.pack("<f", load) + reply[12:]

    return stream_set


def _value_of(name: str, value: float) -> Callable[..., None]:
    """A parameter that has this value."""

    def boot(self: Device, as_usual: Callable[[], None]) -> None:
        as_usual()
        self.values.update({row.id: value for row in self.vocabulary.parameters if row.name == name})

    return boot


def _nine(self: Device, fields_of: Callable[..., dict[str, Any]], *given: Any) -> dict[str, Any]:
    return fields_of(*given) | ({"state": 9} if self.state == State.IDLE else {})


for _name, _argument in (("inf", inf), ("nan", nan), ("1e20", 1e20), ("negative", -1.0)):
    fault(f"event-fault-{_name}", "EVENT FAULT of such a number.", heartbeat=_faulty_event(_argument))
for _name, _argument in (("nan", nan), ("inf", inf), ("negative", -3.5)):
    fault(f"fits-{_name}", "No decimation fits, by such a number.", stream_set=_fits(_argument))
    fault(f"load-{_name}", "A load of such a number.", stream_set=_load(_argument))
for _name, _argument in (("zero", 0.0), ("nan", nan), ("inf", inf), ("negative", -4.0)):
    fault(f"n-p-{_name}", "So many pole pairs.", boot=_value_of("n_p", _argument))
fault("wrong-pole-pairs", "The encoder's angle is made by them.", boot=_value_of("n_p", 2.0 * FULL.pole_pairs))
fault("i-max-nan", "i_max is NaN.", boot=_value_of("i_max", nan))
fault("watchdog-nan", "watchdog is NaN.", boot=_value_of("watchdog", nan))
for _name, _fields in {
    "pwm-hz-zero": {"pwm_hz": 0},
    "tick-hz-zero": {"tick_hz": 0},
    "tick-hz-odd": {"tick_hz": 1_000_001},
    "role-7": {"role": 7},
    "nodes-zero": {"nodes": 0},
    "nodes-absent": {"nodes": 255},  # only one is there
    "tx-max-zero": {"tx_max": 0},
}.items():
    fault(_name, "HELLO says something else.", hello_fields=told(**_fields))
for _name, _fields in {
    "rx-bad-zero": {"rx_bad": 0},
    "outputs-told-off": {"outputs_on": 0},
    "rejections-uncounted": {"setpoints_rejected": 0},
}.items():
    fault(_name, "Heartbeats say 0, whatever is so.", heartbeat_fields=told(**_fields))
fault(
    "edges-uncounted",
    "The heartbeat counts half of the edges.",
    heartbeat_fields=lambda self, fields_of: fields_of() | {"edges": self.edges // 2},
)
fault("state-9", "It says 9 while it is IDLE.", hello_fields=_nine, heartbeat_fields=_nine)


def _all_beat(self: Device, heartbeat: Callable[[], None]) -> None:
    for self.node in range(1, 256):
        heartbeat()
    self.node = 1


def _is_here(self: Any, _: object, node: int) -> bool:
    self.asked = node or 1
    return True


fault(
    "nodes-silent",
    "HELLO says 255 nodes; only one is there, and nobody answers for the others.",
    hello_fields=told(nodes=255),
    receive=lambda self, receive, message, host: receive(message, host) if self.is_here(message.node) else None,
)
fault(
    "nodes-255",
    "HELLO says 255 nodes, and each of them answers.",
    is_here=_is_here,
    hello_fields=lambda self, fields_of, rx_max: fields_of(rx_max) | {"nodes": 255, "node": self.asked},
    answer=lambda self, as_usual, request, reply, *rest: as_usual(request, reply._replace(node=self.asked), *rest),
    heartbeat=_all_beat,
)

# -- the descriptor ---------------------------------------------------------------------------------------------------


def _endless(self: Device, _: object, message: Message, peer: Peer) -> bytes:
    blob, length, offset = struct.unpack("<BxHI", message.payload)
    length = 0 if offset > 65536 else length
    return struct.pack("<BxHII", blob, length, offset, 0xFFFFFFFF) + bytes(length)


def _other_crc(self: Device, fields_of: Callable[..., dict[str, Any]], rx_max: int) -> dict[str, Any]:
    fields = fields_of(rx_max)
    return fields | {"schema_crc": fields["schema_crc"] ^ 1}


def _past_end(self: Device, blob_read: Callable[..., bytes], message: Message, peer: Peer) -> bytes:
    blob, _, offset = struct.unpack("<BxHI", message.payload)
    total = len(self.descriptor())
    if blob == 0 and offset > total:
        return struct.pack("<BxHII", 0, 0, offset, total)
    return blob_read(message, peer)


SIX_HUNDRED = tuple(
    Channel(number, f"c{number}", Raw.U8, Unit.NONE, Flag(0), 1.0, lambda s: s.index % 256) for number in range(1, 601)
)
fault("no-channels", "It has parameters only.", words=lambda self, _, words: replace(words, channels=()))
fault(
    "on-request",
    "Every channel is streamed on request only.",
    words=lambda self, _, words: replace(
        words, channels=tuple(replace(row, flags=row.flags | Flag.ON_REQUEST) for row in words.channels)
    ),
)
fault("channels-600", "600 channels of a byte.", words=lambda self, _, words: replace(words, channels=SIX_HUNDRED))
fault(
    "descriptor-endless",
    "The descriptor is said to have 2^32 - 1 bytes; it ends after 64 KiB, so that a host does too.",
    blob_read=_endless,
)
fault("descriptor-crc", "HELLO announces another CRC than the descriptor has.", hello_fields=_other_crc)
fault("blob-past-end", "A read past the end of the descriptor has an empty answer.", blob_read=_past_end)
fault(
    "wrong-detail",
    "The refusal of another blob has the detail 0.",
    blob_read=lambda self, read, message, peer: (
        refuses(Code.UNKNOWN_ID)(self) if message.payload[0] else read(message, peer)
    ),
)

# -- text and samples -------------------------------------------------------------------------------------------------

TITLE, CLEAR, OVERRIDE = "\x1b]0;owned\x07", "\x1b[2J\x1b[H", "\u202egnp.evird"


def _control_characters(self: Device, _: object, vocabulary: Vocabulary) -> Vocabulary:
    names = (TITLE, CLEAR, OVERRIDE, "two\nlines", "a\x9b31mred", "b\rc")
    kept, last = vocabulary.channels[: -len(names)], vocabulary.channels[-len(names) :]
    channels = (*kept, *(replace(row, name=name) for row, name in zip(last, names, strict=False)))
    parameters = (*vocabulary.parameters, replace(vocabulary.parameters[0], id=900, name=CLEAR))
    texts = {"name": TITLE + "!", "firmware": CLEAR + "1.0", "serial": OVERRIDE, "build": "2\n" + TITLE}
    return replace(vocabulary, channels=channels, parameters=parameters, **texts)


def _controls(self: Device, heartbeat: Callable[[], None]) -> None:
    heartbeat()
    if beats(self) % 2:
        self.log(f"{TITLE}{CLEAR}{OVERRIDE}\nerror: not ours\r".encode(), 4)


def _bad_utf8(self: Device, _: object, vocabulary: Vocabulary) -> Vocabulary:
    first, *rest = vocabulary.channels
    channels = (replace(first, name=b"\xff\xfe" + encoded(first.name)[:6]), *rest)
    own = replace(vocabulary, name=b"dr\xc3ive \xff", firmware=b"\x80", serial=b"\xff" * 24, build=b"\xe2\x82")
    return replace(own, channels=channels)


def _half_a_letter(self: Device, heartbeat: Callable[[], None]) -> None:
    heartbeat()
    self.log(b"\xf0\x28 half a letter: \xe2\x82")


def _flood(self: Any, moment: Callable[[], None]) -> None:
    moment()
    while self.lines < 2000 * self.seconds:
        self.lines += 1
        self.log(b"line %d" % self.lines, 3)


def _no_lines(self: Any, boot: Callable[[], None]) -> None:
    boot()
    self.lines = 0


def _nan(self: Device, _: object, vocabulary: Vocabulary) -> Vocabulary:
    channels = (
        replace(row, values=lambda s: np.full(len(s.index), nan)) if row.raw == Raw.F32 else row
        for row in vocabulary.channels
    )
    return replace(vocabulary, channels=tuple(channels))


fault(
    "control-characters",
    "Window title, clear screen, right-to-left and new lines in all texts.",
    words=_control_characters,
    heartbeat=_controls,
)
fault("bad-utf8", "Names that are no UTF-8.", words=_bad_utf8, heartbeat=_half_a_letter)
fault("log-flood", "Two thousand lines of LOG a second.", moment=_flood, boot=_no_lines)
fault("nan-samples", "Every f32 channel is NaN.", words=_nan)

# -- requests ---------------------------------------------------------------------------------------------------------


def _without_crc(self: Device, attach: Callable[[Any], None], carrier: Any) -> None:
    """Damaged frames among what comes are taken too; each comes whole."""
    attach(carrier)
    receive, read = carrier.receive, carrier.port.read

    def all_of_it() -> list[tuple[Message, int]]:
        data = read()
        carrier.port.read = lambda: data
        found = receive()
        for chunk in filter(None, data.split(b"\0")):
            with suppress(cobs.DecodeError):
                body = cobs.decode(chunk)[:-4]
                if 8 <= len(body) <= 1032 and body[4] | body[5] << 8 == len(body) - 8:
                    message = parse_frame(body)
                    found += [(message, 0)] if (message, 0) not in found else []
        return found

    carrier.receive = all_of_it


def _length_first(self: Device, admit: Callable[[Message], None], message: Message) -> None:
    if message.type not in list(Type) and message.payload:
        raise Refusal(Code.BAD_LENGTH, len(message.payload))
    admit(message)


def _executed_again(self: Device, answer_again: Callable[..., None], request: Message, *rest: Any) -> None:
    with suppress(Refusal):
        self.execute(request, rest[1])
    answer_again(request, *rest)


def _kept_once(
    self: Device, as_usual: Callable[..., None], request: Message, answer: Message, peer: Peer, keeps: bool
) -> None:
    as_usual(request, answer, peer, keeps)
    if keeps and not answer.flags & ERROR:
        for kept in [kept for kept in peer.kept if kept[1] != answer and not kept[1].flags & ERROR]:
            peer.kept.remove(kept)


def _last_tid(self: Device, as_usual: Callable[..., None], request: Message, *rest: Any) -> None:
    as_usual(request, *rest)
    self.last_tid = request.tid


def _tick_back(self: Any, _: object, message: Message, peer: Peer) -> bytes:
    self.syncs = getattr(self, "syncs", 0) + 1
    tick = self.tick() - (8000 if self.syncs % 5 == 0 else 0)
    return struct.pack("<QQ", max(0, tick), max(0, tick))


def _read_only_set(self: Device, param_set: Callable[..., bytes], message: Message, peer: Peer) -> bytes:
    number, value = struct.unpack("<Hxxf", message.payload)
    if self._parameter(number).flags & Flag.READ_ONLY:
        self.values[number] = value
        return struct.pack("<Hxxf", number, value)
    return param_set(message, peer)


def _parameter_clipped(self: Device, param_set: Callable[..., bytes], message: Message, peer: Peer) -> bytes:
    number, value = struct.unpack("<Hxxf", message.payload)
    try:
        return param_set(message, peer)
    except Refusal as refusal:
        if refusal.code != Code.OUT_OF_RANGE:
            raise
        value = self.values[number] = refusal.detail
    return struct.pack("<Hxxf", number, value)


fault("answers-damaged", "A frame with a wrong CRC is counted, and answered all the same.", attach=_without_crc)
fault("length-before-type", "An unknown type with a payload is told its length.", admit=_length_first)
fault("retry-executed", "A repeated request has the kept reply, and is executed again.", answer_again=_executed_again)
fault("reply-kept-once", "A reply is kept until the next one only.", answer=_kept_once)
fault("last-tid-of-refused", "last_tid is that of the last request, refused or not.", answer=_last_tid)
fault("tick-back", "Every fifth TIME_SYNC tells the time of 8 ms ago.", time_sync=_tick_back)
fault("read-only-set", "A READ_ONLY parameter is set all the same.", param_set=_read_only_set)
fault("parameter-clipped", "A value beyond a parameter's range sets it to the end.", param_set=_parameter_clipped)
fault("fault-clear-any", "FAULT_CLEAR clears whatever it names.", clear=lambda self, clear, faults: clear(self.faults))

# -- streams that lie -------------------------------------------------------------------------------------------------


def _seq_of_sent(self: Device, dropped: Callable[..., None], stream: Stream, frames: int) -> None:
    dropped(stream, frames)
    stream.seq = (stream.seq - frames) & 0xFFFF


def _no_overrun(self: Device, dropped: Callable[..., None], stream: Stream, frames: int) -> None:
    dropped(stream, frames)
    stream.overrun = False


def _stale_set(self: Any, stream_set: Callable[..., bytes], message: Message, peer: Peer) -> bytes:
    reply = stream_set(message, peer)
    self.before, self.newest = getattr(self, "newest", 0), self.streams[message.payload[0]].cfg_id
    return reply


def _stale_flush(self: Any, flush: Callable[..., None], stream: Stream, everything: bool = False) -> None:
    now, stream.cfg_id = stream.cfg_id, self.before or stream.cfg_id
    flush(stream, everything)
    stream.cfg_id = now


def _stale_get(self: Any, stream_get: Callable[..., bytes], message: Message, peer: Peer) -> bytes:
    reply = stream_get(message, peer)
    self.first = getattr(self, "first", 0) or int.from_bytes(reply[8:10], "little")
    return reply[:8] + self.first.to_bytes(2, "little") + reply[10:]


class IndexOdd(Stream):
    def taken(self, index: np.ndarray) -> np.ndarray:
        return (index + 1) % self.decimation == 0


class ChannelsSorted(Stream):
    def put_samples(self, samples: Samples) -> None:
        named, self.channels = self.channels, tuple(sorted(self.channels, key=lambda channel: channel.id))
        super().put_samples(samples)
        self.channels = named


class SampleTickBack(Stream):
    def frame(self, records: list[Record]) -> tuple[Type, bytes]:
        index, tick, data = records[0]
        return super().frame([(index, tick - 3000 * (self.seq % 3 == 2), data), *records[1:]])


class SamplesOfThePast(Stream):
    def frame(self, records: list[Record]) -> tuple[Type, bytes]:
        (index, tick, data), *rest = records
        late = 0 if self.edges else 120 * self.decimation
        return super().frame([(index - late, tick - 1000 * late, data), *rest])


class SamplesOfTheFuture(Stream):
    def frame(self, records: list[Record]) -> tuple[Type, bytes]:
        (index, tick, data), *rest = records
        return super().frame([(index, tick if self.edges else tick + 200_000, data), *rest])


def _later(self: Device, as_usual: Callable[..., bytes], message: Message, peer: Peer) -> bytes:
    reply = as_usual(message, peer)
    return reply[:16] + struct.pack("<Q", 200_000) + reply[24:]


def _busy_ignored(self: Device, stream_set: Callable[..., bytes], message: Message, peer: Peer) -> bytes:
    stream = self.streams.get(message.payload[0])
    running = stream is not None and stream.running
    if stream is not None:
        stream.running = False
    try:
        return stream_set(message, peer)
    except Refusal:
        if stream is not None:
            stream.running = running
        raise


def _stop_drops(self: Device, stream_stop: Callable[..., bytes], message: Message, peer: Peer) -> bytes:
    for stream in self.streams.values():
        stream.waiting.clear()
    return stream_stop(message, peer)


def _edges_late(self: Device, flush: Callable[..., None], stream: Stream, everything: bool = False) -> None:
    newest = stream.waiting[0][1] if stream.edges and stream.waiting else -math.inf
    if everything or not stream.edges or self.tick() - newest >= 30_000:
        flush(stream, everything)


def _counted_as_an_edge(self: Device, param_set: Callable[..., bytes], message: Message, peer: Peer) -> bytes:
    before = self.hall_code(0)
    answer = param_set(message, peer)
    self.edges += self.hall_code(0) != before
    return answer


fault("drop-uncounted", "tx_dropped does not count.", dropped=lambda self, dropped, stream, frames: dropped(stream, 0))
fault("seq-of-sent", "seq counts the frames that were sent only.", dropped=_seq_of_sent)
fault("overrun-missing", "No frame carries OVERRUN.", dropped=_no_overrun)
fault("cfg-id-stale", "Frames carry the cfg_id before.", stream_set=_stale_set, flush=_stale_flush)
fault("get-stale", "STREAM_GET tells the cfg_id of the first configuration since boot.", stream_get=_stale_get)
fault("index-odd", "Periods are taken one too early: no index is divisible by the decimation.", IndexOdd)
fault("sample-tick-back", "Every third frame has a tick of 3 ms ago.", SampleTickBack)
fault(
    "hall-as-read",
    "Hall codes are what the inputs read, whatever it is told.",
    hall_code=lambda self, _, sector: hall_code(sector),
)
fault("hall-set-is-an-edge", "An edge is counted where inputs are taken another way.", param_set=_counted_as_an_edge)
fault("channels-sorted", "Channels lie in a sample by their ids, however they are named.", ChannelsSorted)
fault("samples-of-the-past", "Samples have indices and ticks of 120 samples before.", SamplesOfThePast)
fault(
    "samples-of-the-future",
    "Samples have ticks that are 0.2 s late, as `tick0` is.",
    SamplesOfTheFuture,
    stream_set=_later,
    stream_get=_later,
)
fault("busy-ignored", "A running stream can be configured anew.", stream_set=_busy_ignored)
fault("stop-drops", "STREAM_STOP throws away what waits.", stream_stop=_stop_drops)
fault("edges-after-samples", "Edges wait for 30 ms; samples do not wait for them.", flush=_edges_late)


class EncoderStill(Stream):
    def put_edges(self, edges: Iterable[Any], count: int) -> None:
        super().put_edges([replace(edge, encoder=77) for edge in edges], count)


class EncoderAtSamples(Stream):
    def put_edges(self, edges: Iterable[Any], count: int) -> None:
        super().put_edges([replace(edge, encoder=edge.tick & 0xFFFF) for edge in edges], count)


class CodesOfSectors(Stream):
    def put_edges(self, edges: Iterable[Any], count: int) -> None:
        super().put_edges([replace(edge, before=7 - edge.after) for edge in edges], count)


class EdgesFromZero(Stream):
    def put_edges(self, edges: Iterable[Any], count: int) -> None:
        self.first = getattr(self, "first", count)
        super().put_edges(edges, count - self.first)


class IllegalAlways(Stream):
    def put_edges(self, edges: Iterable[Any], count: int) -> None:
        super().put_edges([replace(edge, after=edge.after | 8) for edge in edges], count)


def _with_samples_only(self: Device, flush: Callable[..., None], stream: Stream, everything: bool = False) -> None:
    if not stream.edges or any(other.running and not other.edges for other in self.streams.values()):
        flush(stream, everything)


def _runs_at_once(self: Device, stream_set: Callable[..., bytes], message: Message, peer: Peer) -> bytes:
    reply = stream_set(message, peer)
    self.streams[message.payload[0]].running = True
    return reply


def _says_configured(self: Any, stream_get: Callable[..., bytes], message: Message, peer: Peer) -> bytes:
    reply = stream_get(message, peer)
    return reply[:1] + bytes([message.payload[0] in getattr(self, "started", ())]) + reply[2:]


def _other_room(self: Device, stream_set: Callable[..., bytes], message: Message, peer: Peer) -> bytes:
    try:
        return stream_set(message, peer)
    except Refusal as refusal:
        raise Refusal(refusal.code, refusal.detail + 16 * (refusal.code == Code.DOES_NOT_FIT)) from None


def _odd_log(self: Device, heartbeat: Callable[[], None]) -> None:
    heartbeat()
    self.log(b"a line\n", 6)


fault("encoder-still", "Every edge has the encoder count 77.", EncoderStill)
fault("encoder-of-time", "The encoder count of an edge is its tick.", EncoderAtSamples)
fault("codes-before-wrong", "The code before an edge is made of the code after.", CodesOfSectors)
fault("edges-from-zero", "The index of edges begins with the stream.", EdgesFromZero)
fault("illegal-always", "Every edge is marked as illegal.", IllegalAlways)
fault("edges-with-samples", "Edges are sent only while samples are, too.", flush=_with_samples_only)
fault("streams-run-at-once", "A stream sends as soon as it is configured.", stream_set=_runs_at_once,
      stream_get=_says_configured)  # fmt: skip
fault("room-with-header", "A sample that is too long is told the room with the header.", stream_set=_other_room,
      words=lambda self, _, words: replace(words, channels=SIX_HUNDRED))  # fmt: skip
fault("log-with-newline", "LOG ends with a new line.", heartbeat=_odd_log)
fault(
    "truth-of-hardware",
    "A physical drive has a channel with TRUTH.",
    words=lambda self, _, words: replace(
        words, channels=(replace(words.channels[0], flags=words.channels[0].flags | Flag.TRUTH), *words.channels[1:])
    ),
)
fault("hall-set-any-time", "The Hall parameters are not IDLE_ONLY.", words=lambda self, _, words: replace(
    words, parameters=tuple(replace(row, flags=row.flags & ~Flag.IDLE_ONLY) if "hall" in str(row.name) else row
                            for row in words.parameters)))  # fmt: skip
fault("status-of-nothing", "The channel `status` holds 0.", words=lambda self, _, words: replace(
    words, channels=tuple(replace(row, values=lambda s: np.zeros(len(s.index))) if row.name == "status" else row
                          for row in words.channels)))  # fmt: skip
fault("angles-unwrapped", "An angle with WRAPS goes from 0 to 2 pi.", words=lambda self, _, words: replace(
    words, channels=tuple(replace(row, raw=Raw.F32, scale=1.0, values=lambda s: s.theta % math.tau + math.pi)
                          if row.flags & Flag.WRAPS else row for row in words.channels)))  # fmt: skip

# -- CAN --------------------------------------------------------------------------------------------------------------


class _TakesRepeated(Reassembler):
    def feed(self, data: bytes) -> bytes | None:
        if data and data[-1] & 0xC0 == 0xC0:
            self._last = b""
        return super().feed(data)


class _AnyToggle(Reassembler):
    def feed(self, data: bytes) -> bytes | None:
        if data and not data[-1] & START and data[-1] & ID_MASK == self._expected & ID_MASK:
            data = data[:-1] + bytes([data[-1] & ~TOGGLE | self._expected & TOGGLE])
        return super().feed(data)


def _attached(**values: Any) -> Callable[..., None]:
    """Works on a carrier on which these are so."""

    def attach(self: Device, as_usual: Callable[[Any], None], carrier: Any) -> None:
        as_usual(carrier)
        vars(carrier).update(values)

    return attach


fault("can-repeated-executed", "A frame that comes twice is taken twice.", attach=_attached(assembler=_TakesRepeated))
fault("can-toggle-unchecked", "The toggle bit is not looked at.", attach=_attached(assembler=_AnyToggle))
fault("can-node-0-answered", "Any request to node 0 is answered.", attach=_attached(for_everybody=tuple(Type)))
fault(
    "can-stop-frame-ignored",
    "A frame of class 0 does nothing.",
    stop_frame=lambda self, _: self.stops.append(self.seconds),
)
