"""Level 3, first part: states, STOP, faults, watchdog. Chapters 5 and 7 of SPEC. Outputs go on, at zero current."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from bench.conform.checks import Group
from bench.conform.device import PATIENCE, Device, faults_text, require_granted
from bench.conform.levels import STATES
from bench.conform.probe import accepted, read, refusal, state_name
from bench.conform.verdicts import Failed, Unknown
from bench.device.safety import is_off, says
from protocol.codes import Command, DriveState, ErrorCode, EventCode, Fault, MessageType, SetpointMode
from protocol.messages import BlobRead, DeviceEvent, Heartbeat, StateReply
from protocol.signals import Flag

check = Group("state", STATES)
watchdog = Group("watchdog", STATES)

ARMED = 5.0  # s
LAPSE_ERROR = 0.15  # s by which a lapse may come late, by events
BEAT_PERIOD = 0.1  # s, to which a change is known without an event
EARLY = 0.002  # s: the watchdog's resolution is a millisecond, and so is that of its time in the heartbeat
LATE, LATE_SHARE = 0.02, 0.1
"""s, and the share of the watchdog's time, the larger of which is the allowed delay: SPEC gives no value."""
OTHER_ARGUMENT = 0xDEADBEEF
UNFED = 0xFFFF
ON_WATCH = (DriveState.ARMED, DriveState.RUNNING)
"""States in which the watchdog is at work."""


@check("stop-obeyed", 7, "STOP is never refused", critical=True)
def stop_obeyed(device: Device) -> str:
    """STOP takes ARMED and RUNNING to IDLE, with any argument, and a later heartbeat shows it."""
    words = []
    for name, state, argument in (
        ("IDLE", DriveState.IDLE, 0),
        ("ARMED", DriveState.ARMED, OTHER_ARGUMENT),
        ("RUNNING", DriveState.RUNNING, 0),
        ("RUNNING with an argument", DriveState.RUNNING, OTHER_ARGUMENT),
    ):
        device.enter(state)
        device.probe.feed_every = None
        answer = device.probe.command(Command.STOP, argument)
        accepted(answer, f"STOP in {name}")
        told, beat = read(answer.frame, StateReply).state, device.fresh()
        if told != DriveState.IDLE or beat.state != DriveState.IDLE or not is_off(beat):
            raise Failed(f"STOP in {name}: the reply has {state_name(told)}; after it {says(beat)}")
        words.append(f"in {name} after {1e3 * answer.after:.0f} ms")
    return f"STOP {', '.join(words)}: IDLE in the reply, IDLE and outputs off in a later heartbeat"


@check("arm-token", 7, "a wrong token is BAD_TOKEN")
def arm_token(device: Device) -> str:
    """ARM requires the boot_id."""
    token = device.hello.boot_id ^ 1
    words = refusal(device.probe.command(Command.ARM, token), ErrorCode.BAD_TOKEN, 0, f"ARM with {token:08x}")
    return f"{words}; {_still(device, DriveState.IDLE)}"


def _still(device: Device, state: DriveState) -> str:
    now = device.fresh().state
    if now != state:
        raise Failed(f"refused, but the state changed from {state.name} to {state_name(now)}")
    return f"the state is still {state.name}"


@check("unknown-command", 7, "An unknown command is refused (BAD_VALUE, `detail` = the command)")
def unknown_command(device: Device) -> Iterator[str]:
    """Commands 0, 5 and 255 are refused."""
    return (refusal(device.probe.command(n), ErrorCode.BAD_VALUE, n, f"command {n}") for n in (0, 5, 255))


@check("start-needs-arm", 7, "In any other state a command is refused with WRONG_STATE (`detail` = the state)")
def start_needs_arm(device: Device) -> str:
    """START in IDLE is refused."""
    words = refusal(device.probe.command(Command.START), ErrorCode.WRONG_STATE, DriveState.IDLE, "START in IDLE")
    return f"{words}; {_still(device, DriveState.IDLE)}"


@check("arm-and-start", 7, "| START | ARMED; RUNNING (changes nothing) | 0, else BAD_VALUE |")
def arm_and_start(device: Device) -> str:
    """ARM leads to ARMED and START to RUNNING, by reply and heartbeat; a second START changes nothing."""
    words = []
    for command, argument, state in (
        (Command.ARM, device.hello.boot_id, DriveState.ARMED),
        (Command.ARM, device.hello.boot_id, DriveState.ARMED),
        (Command.START, 0, DriveState.RUNNING),
        (Command.START, 0, DriveState.RUNNING),
    ):
        answer = require_granted(device.probe.command(command, argument), command.name)
        words.append(f"{command.name}: {answer}")
        device.feed()
        told, seen = read(answer.frame, StateReply).state, device.fresh().state
        if told != state or seen != state:
            raise Failed(
                f"{command.name}: the reply has {state_name(told)}, a heartbeat {state_name(seen)}, not {state.name}"
            )
    return f"{words[0]}: ARMED; {words[2]}: RUNNING, each by reply and heartbeat"


@check("stop-each-time", 3, "they are executed and answered afresh every time")
def stop_each_time(device: Device) -> str:
    """A repeated STOP, identical byte for byte, is obeyed again."""
    probe = device.probe
    stop = probe.frame(MessageType.STATE_CMD, struct.pack("<BxxxI", Command.STOP, 0))
    for _ in range(2):
        device.arm()
        probe.feed_every = None
        accepted(probe.ask_frame(stop), "STOP")
        beat = device.fresh()
        if beat.state != DriveState.IDLE:
            raise Failed(f"after a repeated STOP the state is {state_name(beat.state)}")
    return f"STOP with tid {stop.tid} twice, with ARM in between: IDLE both times"


@check("outputs-as-told", 7, "The outputs are on in RUNNING and in no other state")
def outputs_as_told(device: Device) -> str:
    """outputs_on is 1 in RUNNING, and 0 in IDLE and ARMED."""
    said = {}
    for state in (DriveState.IDLE, DriveState.ARMED, DriveState.RUNNING):
        device.enter(state)
        beat = device.fresh()
        if beat.state != state:
            raise Unknown(f"the state is {state_name(beat.state)}, not {state.name}")
        said[state] = int(beat.outputs_on)
        if said[state] != (state == DriveState.RUNNING):
            raise Failed(f"outputs_on is {said[state]} in {state.name}")
    return ", ".join(f"{on} in {state.name}" for state, on in said.items())


@check("arguments-first", 7, "The arguments of ARM and START are checked before the state")
def arguments_first(device: Device) -> str:
    """If both argument and state are wrong, the argument is reported."""
    probe = device.probe
    start = refusal(probe.command(Command.START, 7), ErrorCode.BAD_VALUE, 7, "START with argument 7 in IDLE")
    device.run()
    token = device.hello.boot_id ^ 1
    arm = refusal(probe.command(Command.ARM, token), ErrorCode.BAD_TOKEN, 0, "ARM with a wrong token in RUNNING")
    return f"{start}; {arm}"


@check("wrong-states", 7, "In any other state a command is refused with WRONG_STATE (`detail` = the state)")
def wrong_states(device: Device) -> Iterator[str]:
    """ARM in RUNNING, ARM and START in FAULT, and FAULT_CLEAR in IDLE are refused with the state."""
    probe, token = device.probe, device.hello.boot_id
    yield refusal(probe.command(Command.FAULT_CLEAR), ErrorCode.WRONG_STATE, DriveState.IDLE, "FAULT_CLEAR in IDLE")
    device.run()
    yield refusal(probe.command(Command.ARM, token), ErrorCode.WRONG_STATE, DriveState.RUNNING, "ARM in RUNNING")
    probe.feed_every = None
    device.wait_state(DriveState.FAULT, 2 * device.watchdog + PATIENCE)
    for command, argument in ((Command.ARM, token), (Command.START, 0)):
        answer = probe.command(command, argument)
        yield refusal(answer, ErrorCode.WRONG_STATE, DriveState.FAULT, f"{command.name} in FAULT")


@check("stop-in-fault", 7, "STOP is never refused")
def stop_in_fault(device: Device) -> str:
    """STOP in FAULT is answered, and the state stays FAULT."""
    device.fault()
    answer = device.probe.command(Command.STOP, OTHER_ARGUMENT)
    words = accepted(answer, "STOP in FAULT")
    told, seen = read(answer.frame, StateReply).state, device.fresh().state
    if told != DriveState.FAULT or seen != DriveState.FAULT:
        raise Failed(f"{words}: the reply has {state_name(told)}, a heartbeat {state_name(seen)}, not FAULT")
    return f"{words}: FAULT in reply and heartbeat"


@check("fault-clear", 7, "exactly the `faults` of the heartbeat, else FAULTS_CHANGED (`detail` = the faults now)")
def fault_clear(device: Device) -> Iterator[str]:
    """FAULT_CLEAR must name exactly the present faults, or nothing is cleared."""
    probe = device.probe
    beat = device.fault()
    if not beat.faults & Fault.WATCHDOG or not beat.first_fault & Fault.WATCHDOG:
        raise Failed(
            f"faults {faults_text(beat.faults)}, first_fault {faults_text(beat.first_fault)}: the watchdog tripped"
        )
    for other in (0, int(beat.faults) | Fault.INTERNAL):
        answer = probe.command(Command.FAULT_CLEAR, other)
        yield refusal(answer, ErrorCode.FAULTS_CHANGED, float(beat.faults), f"FAULT_CLEAR 0x{other:x}")
    _still(device, DriveState.FAULT)
    yield (words := accepted(probe.command(Command.FAULT_CLEAR, beat.faults), f"FAULT_CLEAR 0x{int(beat.faults):x}"))
    after = device.fresh()
    if after.state != DriveState.IDLE or after.faults or after.first_fault:
        raise Failed(f"{words}, then {state_name(after.state)}, faults 0x{int(after.faults):x}")


@check("arm-lapses", 7, "ARMED lapses to IDLE 5 s after the last ARM")
def arm_lapses(device: Device) -> str:
    """ARMED lapses after its time, even while the watchdog is fed."""
    probe = device.probe
    device.arm()
    probe.listen(0.5)
    first = probe.tick()[1]
    device.arm()
    last = probe.tick()[0]
    since = len(probe.heard)
    probe.until(lambda: _left(device, since, DriveState.ARMED) is not None, ARMED + 0.8)
    left = _left(device, since, DriveState.ARMED)
    if left is None:
        raise Failed(f"still ARMED {(probe.tick()[0] - first) / device.hz:.2f} s after the last ARM")
    after, resolution = left
    early, late = (after - first) / device.hz, (after - last) / device.hz
    words = f"ARMED ended {late:.3f} s after the last ARM (resolution {1e3 * resolution:.0f} ms)"
    if early < ARMED - EARLY or late > ARMED + LAPSE_ERROR + resolution:
        raise Failed(words)
    if (now := device.fresh().state) != DriveState.IDLE:
        raise Failed(f"{words} in {state_name(now)}, not IDLE")
    return words


def _left(device: Device, since: int, state: DriveState) -> tuple[int, float] | None:
    """When a state was left by what came from place `since` on: the tick, and how exact that is in s."""
    probe = device.probe
    for each in probe.heard[since:]:
        if each.frame.node != probe.node:
            continue
        if each.frame.type == MessageType.EVENT:
            event = read(each.frame, DeviceEvent)
            if event.code == EventCode.STATE_CHANGED and event.arg != state:
                return event.tick, 0.0
        elif each.frame.type == MessageType.HEARTBEAT:
            beat = read(each.frame, Heartbeat)
            if beat.state != state:
                events = [e for e in device.events(EventCode.STATE_CHANGED) if e.arg == beat.state]
                return (events[-1].tick, 0.0) if events else (beat.tick, BEAT_PERIOD)
    return None


# -- the watchdog -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Trip:
    """When the watchdog ran out after the last ALIVE, s: at least and at most; `resolution` of that, s."""

    state: DriveState
    least: float
    most: float
    resolution: float

    def __str__(self) -> str:
        return f"{self.state.name} ended {1e3 * self.most:.1f} ms after the last ALIVE"


def trips(device: Device) -> list[Trip]:
    """The watchdog in ARMED and in RUNNING, measured once for all that look at it. Raises Failed where it is dead."""
    return device.once("trips", lambda: [_trip(device, state) for state in ON_WATCH])


def _trip(device: Device, state: DriveState) -> Trip:
    device.rest()
    device.enter(state)
    device.probe.listen(2 * BEAT_PERIOD)
    first, last = device.unfed()
    return trip_after(device, state, first, last, lambda: None)


def trip_after(device: Device, state: DriveState, first: int, last: int, meanwhile: Callable[[], None]) -> Trip:
    """Wait for the watchdog to end `state`, `meanwhile` called every quarter of its time. Raises Failed."""
    probe, hz = device.probe, device.hz
    since, limit = len(probe.heard), 2.5 * device.watchdog + PATIENCE
    end = probe.now() + limit
    while _left(device, since, state) is None and probe.now() < end:
        probe.until(lambda: _left(device, since, state) is not None, device.watchdog / 4)
        if _left(device, since, state) is None:
            meanwhile()
    left = _left(device, since, state)
    if left is None:
        raise Failed(
            f"still {state.name} {limit:.2f} s after the last ALIVE, the watchdog's time is {device.watchdog:.3g} s"
        )
    tick, resolution = left
    return Trip(state, (tick - last) / hz, (tick - first) / hz, resolution)


@watchdog("trips", 7, "When it expires: outputs off, FAULT with the bit WATCHDOG", critical=True)
def trips_at_all(device: Device) -> str:
    """If the watchdog is not fed, ARMED and RUNNING end in FAULT, outputs off."""
    found = trips(device)
    beat = device.fresh()
    if beat.state != DriveState.FAULT or not beat.faults & Fault.WATCHDOG or beat.outputs_on:
        raise Failed(f"{'; '.join(map(str, found))}: {says(beat)}")
    return f"{'; '.join(map(str, found))}: FAULT, {faults_text(beat.faults)}, outputs off"


@watchdog("not-early", 7, "Its time is 200 ms, or the parameter")
def not_early(device: Device) -> str:
    """The watchdog does not trip before its time."""
    return _judged(device, lambda trip: trip.most < device.watchdog - EARLY)


@watchdog("not-late", 7, "Its time is 200 ms, or the parameter")
def not_late(device: Device) -> str:
    """The watchdog is at most 20 ms late, or a tenth of its time if that is more."""
    return _judged(device, lambda trip: trip.least > device.watchdog + late(device) + trip.resolution)


def late(device: Device) -> float:
    """s by which the watchdog may be late."""
    return max(LATE, LATE_SHARE * device.watchdog)


def _judged(device: Device, wrong: Callable[[Trip], bool]) -> str:
    found = trips(device)
    words = f"{'; '.join(map(str, found))}: its time is {1e3 * device.watchdog:.0f} ms"
    if any(map(wrong, found)):
        raise Failed(words)
    return f"{words}, at most {1e3 * late(device):.0f} ms late"


@watchdog("told", 5, "time left; 0xFFFF while the watchdog is inactive")
def told(device: Device) -> str:
    """In ARMED and RUNNING, watchdog_ms in the heartbeat is the time left."""
    words = []
    for state in ON_WATCH:
        device.enter(state)
        left = device.fresh().watchdog_ms
        if left == UNFED or left > 1e3 * device.watchdog + 1:
            raise Failed(f"watchdog_ms is {left} in {state.name}, the whole time is {1e3 * device.watchdog:.0f} ms")
        words.append(f"{left} in {state.name}")
    return f"watchdog_ms {', '.join(words)}, of {1e3 * device.watchdog:.0f}"


@watchdog(
    "not-fed-by-requests", 7, "It is fed by ALIVE and by an *accepted* SETPOINT, and by nothing else: not by requests"
)
def not_fed_by_requests(device: Device) -> str:
    """Requests do not feed the watchdog."""

    def ask(_: int) -> None:
        device.probe.ask(MessageType.BLOB_READ, BlobRead(0, 8, 0).pack())

    return _not_fed(device, ask, "requests meanwhile")


@watchdog("not-fed-by-rejected", 7, "not by telemetry, not by a rejected setpoint")
def not_fed_by_rejected(device: Device) -> str:
    """Rejected setpoints do not feed the watchdog."""

    def reject(sent: int) -> None:
        setpoint = struct.pack("<BxHff", SetpointMode.SPEED, sent & 0xFFFF, 0.0, 0.0)
        device.probe.send(device.probe.frame(MessageType.SETPOINT, setpoint))

    return _not_fed(device, reject, "rejected setpoints meanwhile")


def _not_fed(device: Device, send: Callable[[int], None], what: str) -> str:
    """The watchdog trips in ARMED as soon as ever, although `send` is called again and again, with its count."""
    trips(device)  # where it is dead this would tell nothing more
    device.arm()
    first, last = device.unfed()
    sent = 0

    def next_one() -> None:
        nonlocal sent
        sent += 1
        send(sent)

    trip = trip_after(device, DriveState.ARMED, first, last, next_one)
    words = f"{trip}, with {sent} {what}"
    usual = max(each.least for each in trips(device))
    if trip.least > usual + late(device) + trip.resolution:
        raise Failed(f"{words}; {1e3 * usual:.0f} ms without them")
    return words


# -- what the outputs forbid ------------------------------------------------------------------------------------------


@check("idle-only", 5, "WRONG_STATE (IDLE_ONLY while the outputs are on)")
def idle_only(device: Device) -> str:
    """In RUNNING, an IDLE_ONLY parameter cannot be set, not even to its present value."""
    record = device.parameters(Flag.IDLE_ONLY, Flag.READ_ONLY)[0]
    value = device.parameter(record).value
    device.run()
    answer = device.set(record, value)
    return refusal(answer, ErrorCode.WRONG_STATE, DriveState.RUNNING, f"{record.name} = {value:g} in RUNNING")


@check(
    "commit-at-rest", 5, "Refused, in this order: WRONG_STATE while the outputs are on; NOT_SUPPORTED without a store"
)
def commit_at_rest(device: Device) -> str:
    """In RUNNING, PARAM_COMMIT is refused with WRONG_STATE."""
    device.run()
    return device.probe.refused(ErrorCode.WRONG_STATE, DriveState.RUNNING, MessageType.PARAM_COMMIT)


@check("hello-in-running", 4, "HELLO is legal in every state and does not change it")
def hello_in_running(device: Device) -> str:
    """HELLO in RUNNING reports RUNNING and does not change it."""
    device.run()
    state, seen = device.probe.hello().state, device.fresh().state
    if state != DriveState.RUNNING or seen != DriveState.RUNNING:
        raise Failed(f"HELLO in RUNNING has {state_name(state)}, a heartbeat after it {state_name(seen)}")
    return "HELLO in RUNNING has RUNNING, and so has the heartbeat after it"
