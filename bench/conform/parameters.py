"""Level 1, second part: PARAM_GET and PARAM_SET. Chapters 5 and 9 of SPEC. Every parameter is left as it was."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from bench.conform.checks import Group
from bench.conform.device import Device, require_granted
from bench.conform.levels import IDENTITY
from bench.conform.probe import read, refusal
from bench.conform.verdicts import Failed, NotApplicable, Unknown
from protocol.codes import ErrorCode, EventCode, Feature, MessageType
from protocol.descriptor import Channel
from protocol.messages import ParamGet, ParamReply, ParamSet, ParamStored
from protocol.signals import Flag

check = Group("parameter", IDENTITY)

ABSENT = 0xFFF0  # from here down, an unused id is looked for
SOME = 6  # parameters whose refusals are checked: the others behave alike


@check("read", "5.25 9.7")
def read_all(device: Device) -> str:
    """Each parameter is finite and within its range, and so is its default."""
    records = device.parameters()
    for record in records:
        answer = device.probe.ask(MessageType.PARAM_GET, ParamGet(record.id).pack())
        if answer.error is not None:
            raise Failed(f"{record.name}: {answer}")
        told = read(answer.frame, ParamReply)
        words = f"{record.name} (id {record.id}) is {told.value:g}, from {told.lo:g} to {told.hi:g}"
        if told.id != record.id:
            raise Failed(f"{record.name}: the reply has id {told.id}, not {record.id}")
        if not all(map(math.isfinite, (told.value, told.lo, told.hi, told.default))):
            raise Failed(f"{words}, default {told.default:g}: not all finite")
        if not told.lo <= told.value <= told.hi and not record.flags & Flag.READ_ONLY:
            raise Failed(f"{words}: out of range")
        if not told.lo <= told.default <= told.hi:
            raise Failed(f"{words}: its default {told.default:g} is out of range")
        if record.flags & Flag.WHOLE and told.value != round(told.value):
            raise Failed(f"{words}: WHOLE, but not a whole number")
    return f"{len(records)} parameters, all finite and within their ranges"


@check("unknown-id", "5.24 5.27 5.26")
def unknown_id(device: Device) -> str:
    """An unknown id is refused with UNKNOWN_ID and the id."""
    taken = {record.id for record in device.descriptor.parameters}
    number = next(n for n in range(ABSENT, 0, -1) if n not in taken)
    get = device.probe.refused(ErrorCode.UNKNOWN_ID, number, MessageType.PARAM_GET, ParamGet(number).pack())
    put = device.probe.refused(ErrorCode.UNKNOWN_ID, number, MessageType.PARAM_SET, ParamSet(number, math.nan).pack())
    return f"id {number}: {get}; {put} (with NaN)"


@check("set-own-value", "5.33")
def set_own_value(device: Device) -> str:
    """Setting a parameter to its present value changes nothing."""
    records = device.parameters(without=Flag.READ_ONLY)
    for record in records:
        before = device.parameter(record)
        answer = device.set(record, before.value)
        if answer.error is not None:
            raise Failed(f"{record.name} = {before.value:g}, its present value: {answer}")
        stored, after = read(answer.frame, ParamStored), device.parameter(record)
        if (stored.id, stored.stored) != (record.id, before.value) or after != before:
            raise Failed(f"{record.name} was {before.value:g}, stored {stored.stored:g}, is now {after.value:g}")
    return f"{len(records)} parameters set to their present values, and unchanged"


def value_refused(device: Device, record: Channel, value: float, code: ErrorCode, detail: float) -> str:
    """Evidence that a value is refused and nothing changes; the value is restored whatever happens."""
    before = device.parameter(record).value
    try:
        words = refusal(device.set(record, value), code, detail, f"{record.name} = {value:.9g}")
        if (after := device.parameter(record).value) != before:
            raise Failed(f"{words}, but it changed from {before:g} to {after:g}")
        return words
    finally:
        device.put_back(record, before)


@check("read-only", "5.28 5.26")
def read_only(device: Device) -> Iterator[str]:
    """A READ_ONLY parameter cannot be set: not to its present value, not to NaN, not beyond its range."""
    record = device.parameters(Flag.READ_ONLY)[0]
    told = device.parameter(record)
    values = (told.value, math.nan, _beyond(told.hi, math.inf))
    return (value_refused(device, record, value, ErrorCode.READ_ONLY, record.id) for value in values)


@check("not-finite", "5.29 5.26")
def not_finite(device: Device) -> Iterator[str]:
    """NaN and infinity are refused before the range is checked."""
    records = device.parameters(without=Flag.READ_ONLY)[:SOME]
    return (
        value_refused(device, record, value, ErrorCode.BAD_VALUE, value)
        for record in records
        for value in (math.nan, math.inf, -math.inf)
    )


@check("whole", "5.30 5.26")
def whole(device: Device) -> Iterator[str]:
    """A WHOLE parameter cannot be set to a fraction, whether within or beyond its range."""
    for record in device.parameters(Flag.WHOLE, Flag.READ_ONLY)[:SOME]:
        told = device.parameter(record)
        values = [told.value + (0.5 if told.value < told.hi else -0.5), told.hi + 1.5]
        yield from (value_refused(device, record, v, ErrorCode.BAD_VALUE, v) for v in values if abs(v) < 1 << 22)


@check("beyond-range", "5.31 5.33")
def beyond_range(device: Device) -> list[str]:
    """The next value beyond either limit is refused with that limit, and never clipped."""
    words = []
    for record in device.parameters(without=Flag.READ_ONLY)[:SOME]:
        told = device.parameter(record)
        for limit, direction in ((told.hi, math.inf), (told.lo, -math.inf)):
            whole_number = record.flags & Flag.WHOLE
            value = limit + math.copysign(1.0, direction) if whole_number else _beyond(limit, direction)
            if math.isfinite(value) and value != limit:
                words.append(value_refused(device, record, value, ErrorCode.OUT_OF_RANGE, limit))
    if not words:
        raise NotApplicable("every float32 is within range")
    return words


def _beyond(limit: float, direction: float) -> float:
    with np.errstate(over="ignore"):
        return float(np.nextafter(np.float32(limit), np.float32(direction)))


GROUPS = Flag.IDENTITY | Flag.CALIBRATION | Flag.TUNING | Flag.LIMITS
LASTING = ("i_cont", "i2t_max", "u_test_max")
PASSING = (
    "forced", "forced_speed", "forced_angle", "forced_slope", "test", "test_voltage", "test_current", "test_speed",
    "test_periods",
)  # fmt: skip
"""Parameters that a device with the feature COMMISSION has: those that stay, and those that are VOLATILE."""


@check("groups", "9.13")
def groups(device: Device) -> str:
    """A parameter is in one group at most."""
    found = [record for record in device.parameters() if record.flags & GROUPS]
    if not found:
        raise NotApplicable("no parameter is in a group")
    for record in found:
        if (record.flags & GROUPS).bit_count() > 1:
            raise Failed(f"{record.name} has flags 0x{int(record.flags):x}: more than one group")
    return f"{len(found)} of {len(device.parameters())} parameters are in a group, each in one"


@check("of-commissioning", "20.5")
def of_commissioning(device: Device) -> str:
    """A device that can be commissioned has all parameters for it, VOLATILE but for those that protect."""
    device.require(Feature.COMMISSION)
    due = dict.fromkeys(LASTING, False) | dict.fromkeys(PASSING, True)
    if device.named("test_length") or device.offers(Feature.WAVEFORM):
        due["test_length"] = True
    for name, volatile in due.items():
        record = device.named(name)
        if record is None:
            raise Failed(f"there is no parameter {name}")
        if bool(record.flags & Flag.VOLATILE) != volatile:
            raise Failed(f"{name} is {'not ' * volatile}VOLATILE")
    return f"{len(due)} parameters, of which {sum(due.values())} are VOLATILE"


def changed(device: Device, record: Channel) -> float:
    """Set a parameter to another value within its range; the value that is stored. Raises Unknown where it cannot be.

    Whoever calls puts it back.
    """
    told = device.parameter(record)
    values = [told.lo, told.hi, float(np.float32((told.lo + told.hi) / 2))]
    for value in (round(v) if record.flags & Flag.WHOLE else v for v in values):
        if value == told.value:
            continue
        answer = device.set(record, value)
        if answer.error is None:
            return read(answer.frame, ParamStored).stored
    raise Unknown(f"{record.name} cannot be set to another value")


def harmless(device: Device) -> Channel:
    """A parameter that nothing depends on while the outputs are off. Raises NotApplicable."""
    for name in ("forced_angle", "test_periods", "watchdog"):
        record = device.named(name)
        if record is not None and not record.flags & Flag.READ_ONLY:
            return record
    raise NotApplicable("no parameter that does nothing while the outputs are off")


@check("changes-told", "5.52")
def changes_told(device: Device) -> str:
    """A value that changes has its EVENT PARAM_CHANGED, with id and value; one that stays has none."""
    if not device.hello.minor:
        raise NotApplicable("the device speaks HBP 1.0")
    record = harmless(device)
    before = device.parameter(record).value
    for _ in range(2):  # a device may drop one
        since = len(device.events(EventCode.PARAM_CHANGED))
        try:
            other = changed(device, record)
            require_granted(device.set(record, other), f"{record.name} = {other:g}, again")
            require_granted(device.set(record, before), f"{record.name} = {before:g}")
            device.fresh()
        finally:
            device.put_back(record, before)
        told = [(event.arg, event.detail) for event in device.events(EventCode.PARAM_CHANGED)[since:]]
        due = [(record.id, other), (record.id, before)]
        if told == due:
            return f"{record.name} (id {record.id}) = {other:g}, {other:g}, {before:g}: two EVENTs PARAM_CHANGED"
        if not set(told) <= set(due) or len(told) > len(due):
            break
    raise Failed(f"{record.name} = {other:g}, {other:g}, {before:g}: EVENTs PARAM_CHANGED {told}, not {due}")


@check("commit", "5.34 5.44")
def commit(device: Device) -> str:
    """Without the feature COMMIT, PARAM_COMMIT is refused; with it, nothing is tried."""
    if device.offers(Feature.COMMIT):
        raise NotApplicable("parameters can be stored: not tried")
    return device.probe.refused(ErrorCode.NOT_SUPPORTED, 0, MessageType.PARAM_COMMIT)
