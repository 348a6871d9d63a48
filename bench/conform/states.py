"""Level 3, first part: states, STOP, faults, watchdog. Chapters 5 and 7 of SPEC. Outputs go on, at zero current."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from bench.conform.checks import Group
from bench.conform.device import PATIENCE, SLOW_LINK, Device, faults_text, require_granted, width
from bench.conform.identity import outputs_told, spare
from bench.conform.levels import STATES
from bench.conform.link import ANSWER, IN_BETWEEN
from bench.conform.link import LATE as LATE_HERE
from bench.conform.probe import accepted, read, refusal, state_name, steps
from bench.conform.verdicts import Failed, NotApplicable, Unknown
from bench.device.safety import is_off, says
from protocol.codes import Command, DriveState, ErrorCode, EventCode, Fault, MessageType, SetpointMode
from protocol.descriptor import Channel
from protocol.messages import DeviceEvent, Heartbeat, ParamStored, StateReply
from protocol.signals import Flag

check = Group("state", STATES)
watchdog = Group("watchdog", STATES)

ARMED = 5.0  # s
LAPSE_ERROR = 0.1  # s by which a lapse may come late, by events
BEAT_PERIOD = 0.1  # s, to which a change is known without an event
EARLY = 0.002  # s: the watchdog's resolution is a millisecond, and so is that of its time in the heartbeat
COARSE = 0.02  # share of its range by which a parameter with coarser steps may miss what it is set to
ROUGH = 3.0  # ms that `watchdog_ms` may be off
LONGEST = 1.0  # s of a watchdog
LATCHED = 0.4  # s
BEATS = 0.55  # s in which five heartbeats come
LATE, LATE_SHARE = 0.02, 0.1
"""s, and the share of the watchdog's time, the larger of which is the allowed delay: SPEC gives no value."""
STREAMED_ANYWAY = 100.0  # Hz
OTHER_ARGUMENT = 0xDEADBEEF
UNFED = 0xFFFF
OTHERS = (EventCode.PARAM_CHANGED, EventCode.CAPTURED)
"""Events that are no change of state, nor a fault."""
ON_WATCH = (DriveState.ARMED, DriveState.RUNNING)
"""States in which the watchdog is at work."""


@check("stop-obeyed", "7.9 7.7 5.36", critical=True)
def stop_obeyed(device: Device) -> str:
    """STOP takes ARMED and RUNNING to IDLE, with any argument, and a later heartbeat shows it."""
    words = []
    for name, state, argument in (
        ("IDLE", DriveState.IDLE, 0),
        ("IDLE with an argument", DriveState.IDLE, OTHER_ARGUMENT),
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


@check("arm-token", "7.5")
def arm_token(device: Device) -> str:
    """ARM requires the boot_id, in ARMED too."""
    words = []
    for state in (DriveState.IDLE, DriveState.ARMED):
        device.enter(state)
        for token in (device.hello.boot_id ^ 1, device.hello.boot_id ^ 1 << 31):
            answer = device.probe.command(Command.ARM, token)
            words.append(refusal(answer, ErrorCode.BAD_TOKEN, 0, f"ARM with {token:08x} in {state.name}"))
        words.append(_still(device, state))
    return "; ".join(words)


def _still(device: Device, state: DriveState) -> str:
    now = device.fresh().state
    if now != state:
        raise Failed(f"refused, but the state changed from {state.name} to {state_name(now)}")
    return f"the state is still {state.name}"


@check("unknown-command", "7.10")
def unknown_command(device: Device) -> Iterator[str]:
    """Commands 0, 5 and 255 are refused, in IDLE and in RUNNING."""
    for state in (DriveState.IDLE, DriveState.RUNNING):
        device.enter(state)
        for n in (0, 5, 255):
            yield refusal(device.probe.command(n), ErrorCode.BAD_VALUE, n, f"command {n} in {state.name}")
        yield _still(device, state)


@check("start-needs-arm", "7.4")
def start_needs_arm(device: Device) -> str:
    """START in IDLE is refused."""
    words = refusal(device.probe.command(Command.START), ErrorCode.WRONG_STATE, DriveState.IDLE, "START in IDLE")
    return f"{words}; {_still(device, DriveState.IDLE)}"


@check("arm-and-start", "7.6 7.5 5.36")
def arm_and_start(device: Device) -> str:
    """ARM leads to ARMED and START to RUNNING, by reply and heartbeat; a second START changes nothing."""
    words = []
    for command, argument, state in (
        (Command.ARM, device.hello.boot_id, DriveState.ARMED),
        (Command.ARM, device.hello.boot_id, DriveState.ARMED),
        (Command.START, 0, DriveState.RUNNING),
        (Command.START, 0, DriveState.RUNNING),
    ):
        answer = device.probe.command(command, argument)
        if answer.error is not None and answer.error.code == ErrorCode.WRONG_STATE:
            raise Failed(f"{command.name}: {answer}")
        words.append(f"{command.name}: {require_granted(answer, command.name)}")
        device.feed()
        told, seen = read(answer.frame, StateReply).state, device.fresh().state
        if told != state or seen != state:
            raise Failed(
                f"{command.name}: the reply has {state_name(told)}, a heartbeat {state_name(seen)}, not {state.name}"
            )
    return f"{words[0]}: ARMED; {words[2]}: RUNNING, each by reply and heartbeat"


@check("stop-each-time", "3.15 7.9")
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


@check("outputs-as-told", "7.1 5.18")
def outputs_as_told(device: Device) -> str:
    """outputs_on is 1 in RUNNING, and 0 in IDLE, ARMED and FAULT."""
    said = {}
    for state in (DriveState.IDLE, DriveState.ARMED, DriveState.RUNNING, DriveState.FAULT):
        if state == DriveState.FAULT:
            device.probe.feed_every = None
            device.wait_state(state, 2 * device.watchdog + PATIENCE)
        device.enter(state)
        beat = device.fresh()
        if beat.state != state:
            raise Unknown(f"the state is {state_name(beat.state)}, not {state.name}")
        said[state] = outputs_told(device)
        if said[state] != (state == DriveState.RUNNING):
            raise Failed(f"outputs_on is {said[state]} in {state.name}")
    return ", ".join(f"{on} in {state.name}" for state, on in said.items())


@check("arguments-first", "7.11")
def arguments_first(device: Device) -> str:
    """If both argument and state are wrong, the argument is reported."""
    probe = device.probe
    start = refusal(probe.command(Command.START, 7), ErrorCode.BAD_VALUE, 7, "START with argument 7 in IDLE")
    device.run()
    token = device.hello.boot_id ^ 1
    arm = refusal(probe.command(Command.ARM, token), ErrorCode.BAD_TOKEN, 0, "ARM with a wrong token in RUNNING")
    again = refusal(probe.command(Command.START, 7), ErrorCode.BAD_VALUE, 7, "START with argument 7 in RUNNING")
    return f"{start}; {arm}; {again}; {_still(device, DriveState.RUNNING)}"


@check("wrong-states", "7.4 7.8 7.12")
def wrong_states(device: Device) -> Iterator[str]:
    """ARM in RUNNING, ARM and START in FAULT, and FAULT_CLEAR in all others are refused with the state."""
    probe, token = device.probe, device.hello.boot_id
    for state in (DriveState.IDLE, DriveState.ARMED, DriveState.RUNNING):
        device.enter(state)
        for faults in (0, Fault.WATCHDOG):
            answer = probe.command(Command.FAULT_CLEAR, faults)
            yield refusal(answer, ErrorCode.WRONG_STATE, state, f"FAULT_CLEAR {faults:#x} in {state.name}")
        _still(device, state)
    yield refusal(probe.command(Command.ARM, token), ErrorCode.WRONG_STATE, DriveState.RUNNING, "ARM in RUNNING")
    device.trip()
    for command, argument in ((Command.ARM, token), (Command.START, 0)):
        answer = probe.command(command, argument)
        yield refusal(answer, ErrorCode.WRONG_STATE, DriveState.FAULT, f"{command.name} in FAULT")


@check("stop-in-fault", "7.9 7.7")
def stop_in_fault(device: Device) -> str:
    """STOP in FAULT is answered, and the state stays FAULT."""
    device.fault()
    answer = device.probe.command(Command.STOP, OTHER_ARGUMENT)
    words = accepted(answer, "STOP in FAULT")
    told, seen = read(answer.frame, StateReply).state, device.fresh().state
    if told != DriveState.FAULT or seen != DriveState.FAULT:
        raise Failed(f"{words}: the reply has {state_name(told)}, a heartbeat {state_name(seen)}, not FAULT")
    return f"{words}: FAULT in reply and heartbeat"


@check("fault-clear", "7.8 7.19 5.13")
def fault_clear(device: Device) -> Iterator[str]:
    """FAULT_CLEAR must name exactly the present faults, or nothing is cleared."""
    probe = device.probe
    beat = device.fault()
    if not beat.faults & Fault.WATCHDOG or not beat.first_fault & Fault.WATCHDOG:
        raise Failed(
            f"faults {faults_text(beat.faults)}, first_fault {faults_text(beat.first_fault)}: the watchdog tripped"
        )
    for other in (0, int(beat.faults) | Fault.INTERNAL, 1 << 31 | int(beat.faults)):
        answer = probe.command(Command.FAULT_CLEAR, other)
        yield refusal(answer, ErrorCode.FAULTS_CHANGED, float(beat.faults), f"FAULT_CLEAR 0x{other:x}")
    _still(device, DriveState.FAULT)
    if (now := device.fresh()).faults != beat.faults or now.first_fault != beat.first_fault:
        raise Failed(f"FAULT_CLEAR was refused, but faults {faults_text(beat.faults)} became {faults_text(now.faults)}")
    yield (words := accepted(probe.command(Command.FAULT_CLEAR, beat.faults), f"FAULT_CLEAR 0x{int(beat.faults):x}"))
    after = device.fresh()
    if after.state != DriveState.IDLE or after.faults or after.first_fault:
        raise Failed(f"{words}, then {state_name(after.state)}, faults 0x{int(after.faults):x}")


@check("arm-lapses", "7.13")
def arm_lapses(device: Device) -> str:
    """ARMED lapses after its time, even while the watchdog is fed; only an ARM that is obeyed restarts it."""
    probe = device.probe
    device.arm()
    probe.listen(0.5)
    first = probe.tick()[1]
    device.arm()
    last = probe.tick()[0]
    since = len(probe.heard)
    probe.until(lambda: _left(device, since, DriveState.ARMED) is not None, ARMED / 2)
    probe.command(Command.ARM, device.hello.boot_id ^ 1)
    probe.command(Command.START, 7)
    probe.hello()
    probe.until(lambda: _left(device, since, DriveState.ARMED) is not None, ARMED / 2 + 0.8)
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
    lapses = device.events(EventCode.ARM_LAPSED)
    if device.events(EventCode.STATE_CHANGED) and [event.arg for event in lapses] != [ARMED]:
        raise Failed(f"{words}, with {len(lapses)} EVENTs ARM_LAPSED {[event.arg for event in lapses]}, not one of 5")
    return words


@check("events", "7.18 5.43 5.42")
def events(device: Device) -> str:
    """Each change of state has its EVENT, a fault its own; commands that change nothing have none."""
    probe = device.probe
    due: dict[EventCode, list[float]] = {
        EventCode.STATE_CHANGED: [DriveState.ARMED, DriveState.RUNNING, DriveState.IDLE, DriveState.ARMED,
                                  DriveState.FAULT, DriveState.IDLE],
        EventCode.FAULT: [Fault.WATCHDOG],
    }  # fmt: skip
    lacking = ""
    for _ in range(2):  # a device may drop one
        since, began = len(probe.heard), probe.tick()[0]
        for _ in range(2):
            device.arm()
        for _ in range(2):
            require_granted(probe.command(Command.START), "START")
        for _ in range(2):
            probe.stop()
        beat = device.fault()
        probe.stop()
        require_granted(probe.command(Command.FAULT_CLEAR, beat.faults), "FAULT_CLEAR")
        device.fresh()
        ended, lacking = probe.tick()[1], ""
        came = [event for _, event in probe.came(DeviceEvent, since) if event.code not in OTHERS]
        for event in came:
            if not began <= event.tick <= ended or event.node != probe.node or event.detail:
                raise Failed(f"{event}: its tick must be in {began}..{ended}, its node {probe.node}, its detail 0")
        for code, values in due.items():
            told = [event.arg for event in came if event.code == code]
            if told == values:
                continue
            words = f"EVENTs {code.name} of {', '.join(f'{arg:g}' for arg in told) or 'none'}, not {values}"
            if not _within(told, values):
                raise Failed(words)
            lacking = lacking or words
        if any(heard.frame.type == MessageType.EVENT and (words := spare(heard)) for heard in probe.heard[since:]):
            raise Failed(words)
        if not lacking:
            return f"{len(came)} EVENTs: each change of state, and the fault"
    raise Failed(f"{lacking}, twice, although the link had room")


def _within(some: Sequence[float], row: Sequence[float]) -> bool:
    """Whether `some` is `row` with some left out."""
    rest = iter(row)
    return all(each in rest for each in some)


@check("fault-latches", "7.17 7.2")
def fault_latches(device: Device) -> str:
    """ALIVE, setpoints, HELLO, STOP and time do not end FAULT, nor clear its bits."""
    probe, beat = device.probe, device.fault()
    device.feed()
    probe.hello()
    probe.stop()
    probe.send(probe.frame(MessageType.SETPOINT, struct.pack("<BxHff", SetpointMode.SPEED, 1, 0.0, 0.0)))
    probe.listen(LATCHED)
    probe.feed_every = None
    probe.listen(2 * LATCHED)
    now = device.fresh()
    if now.state != DriveState.FAULT or now.faults != beat.faults or now.first_fault != beat.first_fault:
        raise Failed(f"after ALIVE, a setpoint, HELLO and STOP: {says(now)}, was {says(beat)}")
    return f"after {LATCHED:g} s with ALIVE, a setpoint, HELLO and STOP: still {says(now)}"


@check("heartbeats-always", "5.8")
def heartbeats_always(device: Device) -> str:
    """Heartbeats come in ARMED, RUNNING and FAULT as in IDLE."""
    probe = device.probe
    said = []
    for state in (DriveState.ARMED, DriveState.RUNNING, DriveState.FAULT):
        if state == DriveState.FAULT:
            probe.feed_every = None
            device.wait_state(state, 2 * device.watchdog + PATIENCE)
        device.enter(state)
        since = len(probe.heard)
        probe.listen(BEATS)
        ticks = [beat.tick for _, beat in probe.came(Heartbeat, since) if beat.state == state]
        gap = 1e3 * max(steps(ticks), default=0) / device.hz
        if len(ticks) < 3 or gap > 190:
            raise Failed(f"{len(ticks)} heartbeats within {BEATS:g} s in {state.name}, up to {gap:.0f} ms apart")
        said.append(f"{len(ticks)} in {state.name}")
    return f"{', '.join(said)} within {BEATS:g} s each"


@check("in-time", "3.8")
def in_time(device: Device) -> str:
    """ARM, START and STOP are answered within 100 ms, one of three times at least."""
    probe, least = device.probe, dict.fromkeys((Command.ARM, Command.START, Command.STOP), math.inf)
    for _ in range(3):
        for command in least:
            argument = device.hello.boot_id if command == Command.ARM else 0
            answer = require_granted(probe.command(command, argument), command.name)
            least[command] = min(least[command], answer.after)
        if max(least.values()) <= ANSWER:
            break
    words = ", ".join(f"{command.name} after {1e3 * after:.0f} ms" for command, after in least.items())
    if max(least.values()) > ANSWER + LATE_HERE + probe.takes(IN_BETWEEN):
        raise Failed(f"{words} at the soonest of three times")
    return words


def _left(device: Device, since: int, state: DriveState, after: int = 0) -> tuple[int, float] | None:
    """When a state was left by what came from place `since` on: the tick, and how exact that is in s.

    What is of the tick `after` or before says nothing: a slow link may bring it late.
    """
    probe = device.probe
    for each in probe.heard[since:]:
        if each.frame.node != probe.node:
            continue
        if each.frame.type == MessageType.EVENT:
            event = read(each.frame, DeviceEvent)
            if event.code == EventCode.STATE_CHANGED and event.arg != state and event.tick > after:
                return event.tick, 0.0
        elif each.frame.type == MessageType.HEARTBEAT:
            beat = read(each.frame, Heartbeat)
            if beat.state != state and beat.tick > after:
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


def trip_after(
    device: Device, state: DriveState, first: int, last: int, meanwhile: Callable[[], None], entered: int = 0
) -> Trip:
    """Wait for the watchdog to end `state`, `meanwhile` called every quarter of its time. Raises Failed.

    Ticks: of the last ALIVE, `first` before and `last` after it; `entered`: of what led to the state, if it was later.
    """
    probe, hz = device.probe, device.hz
    since, limit = len(probe.heard), 2.5 * device.watchdog + PATIENCE

    def left_now() -> tuple[int, float] | None:
        return _left(device, since, state, max(first, entered))

    end = probe.now() + limit
    while left_now() is None and probe.now() < end:
        probe.until(lambda: left_now() is not None, device.watchdog / 4)
        if left_now() is None:
            meanwhile()
    left = left_now()
    if left is None:
        words = f"{limit:.2f} s after the last ALIVE, the watchdog's time is {device.watchdog:.3g} s"
        if device.fresh().state != state:  # a slow link was not yet told
            raise Unknown(f"left {state.name}, and it was not told {words}")
        raise Failed(f"still {state.name} {words}")
    tick, resolution = left
    return Trip(state, (tick - last) / hz, (tick - first) / hz, resolution)


@watchdog("trips", "7.28 7.16 7.21", critical=True)
def trips_at_all(device: Device) -> str:
    """If the watchdog is not fed, ARMED and RUNNING end in FAULT, outputs off."""
    found = trips(device)
    beat = device.fresh()
    if beat.state != DriveState.FAULT or not beat.faults & Fault.WATCHDOG or beat.outputs_on:
        raise Failed(f"{'; '.join(map(str, found))}: {says(beat)}")
    return f"{'; '.join(map(str, found))}: FAULT, {faults_text(beat.faults)}, outputs off"


@watchdog("not-early", "7.28 7.22")
def not_early(device: Device) -> str:
    """The watchdog does not trip before its time."""
    return _judged(device, lambda trip: trip.most < device.watchdog - EARLY)


@watchdog("not-late", "7.28 7.22")
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


@watchdog("told", "5.17")
def told(device: Device) -> str:
    """In ARMED and RUNNING, watchdog_ms in the heartbeat is the time left; in IDLE and FAULT it is 65535."""
    words, whole, rough = [], 1e3 * device.watchdog, ROUGH + 1e3 / device.pwm_hz  # a heartbeat is of its last period
    for state in ON_WATCH:
        device.rest()
        device.enter(state)
        left = device.fresh().watchdog_ms
        if left == UNFED or left > whole + 1:
            raise Failed(f"watchdog_ms is {left} in {state.name}, the whole time is {whole:.0f} ms")
        device.probe.beat()
        device.probe.listen(0.3 * BEAT_PERIOD)  # what is left and what has passed are not to be the same
        first, last = device.unfed()
        since = len(device.probe.heard)
        device.trip()
        for _, beat in device.probe.came(Heartbeat, since):
            least, most = (whole - 1e3 * (beat.tick - tick) / device.hz for tick in (first, last))
            if beat.state == state and beat.tick > last and not least - rough <= beat.watchdog_ms <= most + rough:
                due = f"{least:.0f} to {most:.0f} ms are left of {whole:.0f}"
                raise Failed(f"watchdog_ms is {beat.watchdog_ms} in {state.name}; {due}")
        words.append(f"{left} in {state.name}")
    if (left := device.fresh().watchdog_ms) != UNFED:
        raise Failed(f"watchdog_ms is {left} in FAULT")
    return f"watchdog_ms {', '.join(words)}, of {whole:.0f}, and 65535 in FAULT"


@watchdog("fed-by-alive", "7.25 5.19")
def fed_by_alive(device: Device) -> str:
    """ALIVE alone keeps ARMED and RUNNING."""
    for state in ON_WATCH:
        device.enter(state)
        device.probe.feed_every = None
        for _ in range(10):  # with one counter
            device.probe.send(device.probe.frame(MessageType.ALIVE, bytes(4)))
            device.probe.listen(device.watchdog / 4)
        now = device.fresh()
        if now.state != state:
            raise Failed(f"{2.5 * device.watchdog:.2f} s with ALIVE in {state.name}: {says(now)}")
    return f"{2.5 * device.watchdog:.2f} s with ALIVE in ARMED and in RUNNING: the state is kept"


@watchdog("arm-restarts", "7.24")
def arm_restarts(device: Device) -> str:
    """An ARM in ARMED restarts the watchdog."""
    device.arm()
    device.unfed()
    device.probe.listen(0.6 * device.watchdog)
    first = device.probe.tick()[1]
    answer = device.probe.command(Command.ARM, device.hello.boot_id)
    if answer.error is not None:
        raise Unknown(f"ARM in ARMED: {answer}")
    trip = trip_after(device, DriveState.ARMED, first, device.probe.tick()[0], lambda: None)
    words = f"ARMED ended {1e3 * trip.most:.1f} ms after a second ARM, unfed, of {1e3 * device.watchdog:.0f} ms"
    if trip.most < device.watchdog - EARLY:
        raise Failed(words)
    return words


@watchdog("parameter", "7.23 7.22 7.28 9.8 4.15")
def parameter(device: Device) -> Iterator[str]:
    """The parameter `watchdog` takes both ends of its range, HELLO leaves it, and it counts from the set on."""
    record = device.named("watchdog")
    if record is None or record.flags & Flag.READ_ONLY:
        raise NotApplicable("the device has no parameter `watchdog` that can be set")
    told = device.parameter(record)
    own, usual = told.value, device.watchdog
    if not 0 < told.lo <= own <= told.hi <= LONGEST:
        raise Failed(f"watchdog is {own:g}, from {told.lo:g} to {told.hi:g} s: not within 0.05 to 1 s")
    try:
        for value in (told.lo, told.hi):
            _took(device, record, value)
        before = device.parameter(record).value
        device.probe.hello()
        if (now := device.parameter(record).value) != before:
            raise Failed(f"a HELLO set watchdog to {now:g}, it was {before:g}")
        for value in (max(told.lo, own / 3), min(told.hi, 3 * own)):
            if not own / 1.5 < value < own * 1.5:
                yield _takes_effect(device, record, own, float(np.float32(value)))
    finally:
        device.__dict__["watchdog"] = usual
        device.rest()
        device.put_back(record, own)


def _took(device: Device, record: Channel, value: float) -> None:
    """Set a parameter. Raises Failed where it is not then as it was set."""
    answer = device.set(record, value)
    if answer.error is not None:
        raise Failed(f"{record.name} = {value:g}, which is within its range: {answer}")
    stored, told = read(answer.frame, ParamStored).stored, device.parameter(record)
    now = told.value
    if stored != now or abs(now - value) > COARSE * (told.hi - told.lo):
        raise Failed(f"{record.name} = {value:g}: the reply has {stored:g}, PARAM_GET {now:g}")


def _takes_effect(device: Device, record: Channel, own: float, value: float) -> str:
    """ARMED with `own` s; after the last ALIVE the watchdog's time becomes `value` s."""
    device.rest()
    _took(device, record, own)
    device.arm()
    first, last = device.unfed()
    answer = device.set(record, value)
    if answer.error is not None:
        raise Failed(f"watchdog = {value:g} in ARMED: {answer}")
    since = (device.probe.tick()[1] - first) / device.hz
    device.__dict__["watchdog"] = value
    trip = trip_after(device, DriveState.ARMED, first, last, lambda: None)
    words = f"watchdog set from {1e3 * own:.0f} to {1e3 * value:.0f} ms after the last ALIVE in ARMED: {trip}"
    if trip.most < value - EARLY or trip.least > max(value, since) + late(device) + trip.resolution:
        raise Failed(words)
    return words


# -- what the outputs forbid ------------------------------------------------------------------------------------------


@check("idle-only", "5.32 9.10 5.26")
def idle_only(device: Device) -> str:
    """In RUNNING, an IDLE_ONLY parameter cannot be set, not even to its present value; in ARMED and FAULT it can."""
    record = device.parameters(Flag.IDLE_ONLY, Flag.READ_ONLY)[0]
    told = device.parameter(record)
    value, beyond = told.value, told.hi + 1.0
    device.arm()
    armed = accepted(device.set(record, value), f"{record.name} = {value:g} in ARMED")
    require_granted(device.probe.command(Command.START), "START")
    words = [armed]
    for given, code, detail in (
        (value, ErrorCode.WRONG_STATE, float(DriveState.RUNNING)), (math.nan, ErrorCode.BAD_VALUE, math.nan),
        (beyond, ErrorCode.OUT_OF_RANGE, told.hi),
    ):  # fmt: skip
        words.append(refusal(device.set(record, given), code, detail, f"{record.name} = {given:g} in RUNNING"))
    device.trip()
    words.append(accepted(device.set(record, value), f"{record.name} = {value:g} in FAULT"))
    return "; ".join(words)


@check("set-any-time", "9.9")
def set_any_time(device: Device) -> str:
    """In RUNNING, a parameter that is not IDLE_ONLY can be set to its present value."""
    record = device.parameters(without=Flag.IDLE_ONLY | Flag.READ_ONLY)[0]
    value = device.parameter(record).value
    device.run()
    return accepted(device.set(record, value), f"{record.name} = {value:g} in RUNNING")


@check("streams-anyway", "11.8")
def streams_anyway(device: Device) -> str:
    """Streams are configured, started and stopped in RUNNING and in FAULT as in IDLE."""
    narrow = min(device.channels, key=width)
    decimation = device.configure(0, [narrow.id], STREAMED_ANYWAY).asked.decimation
    for state in (DriveState.RUNNING, DriveState.FAULT):
        if state == DriveState.FAULT:
            device.probe.feed_every = None
            device.wait_state(state, 2 * device.watchdog + PATIENCE)
        device.enter(state)
        asked = device.stream_set(0, [narrow.id], decimation)
        accepted(asked, f"STREAM_SET in {state.name}")
        frames, dropped = _streamed(device), device.fresh().tx_dropped
        accepted(device.probe.ask(MessageType.STREAM_START, struct.pack("<I", 1)), f"STREAM_START in {state.name}")
        seconds = SLOW_LINK + 2.2 * decimation / device.pwm_hz
        if not device.probe.until(lambda frames=frames: _streamed(device) > frames, seconds):  # type: ignore[misc]
            device.require_undropped(dropped)
            raise Failed(f"no frame of a stream came within {seconds:.2g} s in {state.name}")
        accepted(device.probe.ask(MessageType.STREAM_STOP, struct.pack("<I", 1)), f"STREAM_STOP in {state.name}")
        device.probe.quiet()
        device.probe.forget()
    return "streams in RUNNING and in FAULT"


def _streamed(device: Device) -> int:
    return len(device.blocks(0)) + len(device.probe.stream_frames)


@check("commit-at-rest", "5.34")
def commit_at_rest(device: Device) -> str:
    """In RUNNING, PARAM_COMMIT is refused with WRONG_STATE."""
    device.run()
    return device.probe.refused(ErrorCode.WRONG_STATE, DriveState.RUNNING, MessageType.PARAM_COMMIT)


@check("hello-in-running", "4.14")
def hello_in_running(device: Device) -> str:
    """HELLO in ARMED, RUNNING and FAULT reports the state and does not change it."""
    for state in (DriveState.ARMED, DriveState.RUNNING, DriveState.FAULT):
        if state == DriveState.FAULT:
            device.probe.feed_every = None
            device.wait_state(state, 2 * device.watchdog + PATIENCE)
        device.enter(state)
        told, seen = device.probe.hello().state, device.fresh().state
        if told != state or seen != state:
            raise Failed(f"HELLO in {state.name} has {state_name(told)}, a heartbeat after it {state_name(seen)}")
    return "HELLO in ARMED, RUNNING and FAULT has that state, and so has the heartbeat after it"
