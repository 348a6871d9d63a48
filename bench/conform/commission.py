"""Level 3, fifth part: commissioning, at zero current and zero amplitude. Chapter 20 of SPEC."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from bench.conform.blobs import WAVEFORM, write
from bench.conform.captured import physical
from bench.conform.checks import Group
from bench.conform.commissioned import blind, put, require, restored, run_at_zero_volts, value_of
from bench.conform.data import by_index, split_sample
from bench.conform.device import ALL, Configured, Device, ids, require_granted
from bench.conform.levels import STATES
from bench.conform.means import every_period
from bench.conform.motion import reference
from bench.conform.parameters import changed, value_refused
from bench.conform.probe import accepted, refusal
from bench.conform.setpoints import is_taken, rejected
from bench.conform.verdicts import Failed, NotApplicable, Unknown
from protocol.codes import DriveState, ErrorCode, EventCode, Fault, Feature, SetpointMode, TestSignal
from protocol.descriptor import Channel
from protocol.signals import Flag, Status

check = Group("commission", STATES)

BEYOND = 1.05  # a vector of voltage, over its limit
UNMOVED = ("forced_angle", "forced_slope", "test_periods", "test_length", "forced")
"""VOLATILE parameters that move nothing at zero current."""
SPEED, SLOPE = 20.0, 200.0  # electrical rad/s, rad/s²
RATE = 500.0  # Hz of the samples of an angle
SETTLED, RAMPED, MOVED = 0.1, 0.7, 0.8  # s for which the angle is watched, at rest, at speed, and when it moves
JUMP = 0.1  # rad between two samples, beyond what the speed makes
RESOLVED = 0.01  # rad
SPEED_ERROR = 0.02  # share
AT_REST = 2 * math.pi  # rad/s, largest speed towards the forced angle
CYCLES = ((37, 0, 74), (11, 5, 55))
"""test_periods, test_length, and the periods of a cycle of both."""
TURNED, STILL = 1.0, 0.05  # rad by which encoder_zero is changed, and by which a shaft at rest may move
TINY = 1e-6  # A²s
TRIPS = 1.0  # s in which the noise of a current sensor makes that
SURE = 10.0  # times that, with which it must have tripped


@check("limits", "20.15 20.8")
def limits(device: Device) -> Iterator[str]:
    """Amplitudes beyond u_test_max, i_max and omega_m_max are refused with them, and a forced speed too fast."""
    device.require(Feature.COMMISSION)
    tried = 0
    for name, of in (
        ("test_voltage", ("u_test_max",)), ("test_current", ("i_max",)), ("test_speed", ("omega_m_max",)),
        ("forced_speed", ("n_p", "omega_m_max")),
    ):  # fmt: skip
        record = require(device, name)
        limit = float(np.float32(math.prod(value_of(device, each) for each in of)))
        told = device.parameter(record)
        for sign in (1.0, -1.0):
            beyond = float(np.nextafter(np.float32(sign * limit), np.float32(sign * math.inf)))
            if not told.lo <= beyond <= told.hi:
                continue
            tried += 1
            yield value_refused(device, record, beyond, ErrorCode.OUT_OF_RANGE, limit)
            try:
                yield accepted(device.set(record, sign * limit), f"{name} = {sign * limit:g}, the limit")
            finally:
                device.put_back(record, told.value)
    if not tried:
        raise NotApplicable("no limit lies within the ranges of the amplitudes")


@check("test-busy", "20.16 5.51")
def test_busy(device: Device) -> Iterator[str]:
    """Another test signal is refused while one is set, and so is BLOB_WRITE, until it is off."""
    record = require(device, "test")
    try:
        put(device, "test", TestSignal.U_D)
        for value in (TestSignal.I_Q, TestSignal.U_D):
            yield refusal(device.set(record, value), ErrorCode.BUSY, value, f"test = {value} while it is 1")
        if device.offers(Feature.WAVEFORM):
            within = write(device, WAVEFORM, 0, device.read_blob(WAVEFORM)[:2])
            yield refusal(within, ErrorCode.BUSY, WAVEFORM, "BLOB_WRITE while test is 1")
            beyond = write(device, WAVEFORM, 0xFFFFFFFF, b"12")
            yield refusal(beyond, ErrorCode.OUT_OF_RANGE, None, "BLOB_WRITE past the end while test is 1")
        yield accepted(device.set(record, TestSignal.OFF), "test = 0")
        yield accepted(device.set(record, TestSignal.I_Q), "test = 4 after 0")
    finally:
        device.put_back(record, 0.0)


@check("no-waveform", "20.13")
def no_waveform(device: Device) -> str:
    """Without the feature WAVEFORM a length of the waveform is refused, but 0."""
    device.require(Feature.COMMISSION)
    record = device.named("test_length")
    if device.offers(Feature.WAVEFORM) or record is None:
        raise NotApplicable("the device has the feature WAVEFORM" if record else "there is no parameter test_length")
    answer = device.set(record, 1.0)
    device.put_back(record, 0.0)
    if answer.error is None:
        raise Failed("test_length = 1: accepted, without the feature WAVEFORM")
    return f"test_length = 1: {answer}"


@check("volatile", "9.12 20.5 20.1 5.52")
def volatile(device: Device) -> Iterator[str]:
    """VOLATILE parameters are at their defaults once RUNNING has ended, by STOP or by a fault, and tell so."""
    passing = device.parameters(Flag.VOLATILE, Flag.READ_ONLY)
    records = [record for record in passing if record.name in UNMOVED] or passing[:1]
    for trips in (False, True):
        device.run()
        values = {}
        for record in records:
            values[record.id] = changed(device, record)
        since = len(device.events(EventCode.PARAM_CHANGED))
        if trips:
            device.trip()
        else:
            device.probe.stop()
        device.fresh()
        what = "a fault" if trips else "STOP"
        for record in passing:
            told = device.parameter(record)
            if told.value != told.default:
                raise Failed(f"after {what} {record.name} is {told.value:g}, its default {told.default:g}")
        events = {event.arg for event in device.events(EventCode.PARAM_CHANGED)[since:]}
        moved = {record.id for record in records if values[record.id] != device.parameter(record).default}
        if events and not moved <= events:
            raise Failed(f"after {what} parameters {sorted(moved)} changed, EVENTs PARAM_CHANGED tell {sorted(events)}")
        if not events:
            raise Failed(f"after {what} {len(moved)} parameters changed, and no EVENT PARAM_CHANGED was received")
        device.rest()
        yield f"after {what} {len(passing)} parameters are at their defaults, {len(moved)} of them were not"


@check("angle-needed", "20.10 20.4 8.4 20.9")
def angle_needed(device: Device) -> Iterator[str]:
    """VOLTAGE needs an angle that is known, SPEED one that is measured."""
    forced, most = require(device, "forced"), value_of(device, "u_test_max")
    with blind(device):
        device.run()
        nan = (SetpointMode.VOLTAGE, 1, math.nan, 0.0)
        yield rejected(device, "VOLTAGE NaN", nan, ErrorCode.BAD_VALUE, math.nan)
        voltage = (SetpointMode.VOLTAGE, 2)
        yield rejected(device, "VOLTAGE 0 with Hall sensors", voltage, ErrorCode.NOT_SUPPORTED, SetpointMode.VOLTAGE)
        put(device, "forced", 1.0)
        speed = (SetpointMode.SPEED, 3)
        yield rejected(device, "SPEED 0 with forced 1", speed, ErrorCode.NOT_SUPPORTED, SetpointMode.SPEED)
        for n, (u_q, u_d) in enumerate(((BEYOND, 0.0), (0.0, -BEYOND), (0.8, 0.8)), 4):
            what = f"VOLTAGE {u_q:g}, {u_d:g} times u_test_max"
            given = (SetpointMode.VOLTAGE, n, u_q * most, u_d * most)
            if most:
                yield rejected(device, what, given, ErrorCode.OUT_OF_RANGE, most)
        if not is_taken(device, SetpointMode.VOLTAGE, 9):
            raise Failed("VOLTAGE 0 with forced 1 was rejected")
        yield "VOLTAGE 0 with forced 1: accepted"
        device.rest()
        device.run()
        if not is_taken(device, SetpointMode.SPEED, 10):
            raise Unknown("SPEED 0 was not accepted")
        yield refusal(device.set(forced, 1.0), ErrorCode.WRONG_STATE, None, "forced = 1 while SPEED is in use")


def _angles(device: Device, told: Configured, channel: Channel) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times in s and the angle in rad, unwrapped, of what came of a stream of this channel."""
    found = by_index(device, told, (channel,))
    ordered = sorted(found)
    if len(ordered) < 10:
        raise Unknown(f"{len(ordered)} samples of {channel.name} received")
    raw = b"".join(found[index] for index in ordered)
    angles = np.frombuffer(raw, channel.raw.dtype) * channel.scale + channel.offset
    return np.array(ordered) / device.pwm_hz, np.unwrap(angles)


@check("forced-angle", "20.6 20.7")
def forced_angle(device: Device) -> Iterator[str]:
    """The forced angle begins where the control's is, follows its ramp, and goes to its target the shorter way."""
    require(device, "forced")
    channel = device.channel_named("theta_ctrl")
    if channel is None:
        raise Unknown("the device has no channel theta_ctrl")
    fastest = value_of(device, "n_p") * value_of(device, "omega_m_max")
    if fastest < SPEED:
        raise Unknown(f"the largest forced speed is {fastest:g} rad/s")
    told = device.configure(0, ids([channel]), RATE, share=ALL)
    device.run()
    device.start_streams(1)
    device.probe.listen(SETTLED)
    for name, value in (("forced_slope", SLOPE), ("forced", 1.0)):
        put(device, name, value)
    device.probe.listen(SETTLED)
    put(device, "forced_speed", SPEED)
    device.probe.listen(RAMPED)
    times, angles = _angles(device, told, channel)
    steps, spans = np.diff(angles), np.diff(times)
    if (jump := float(np.max(np.abs(steps) - SPEED * spans))) > JUMP:
        raise Failed(f"theta_ctrl jumps by {jump:.3g} rad")
    late = times > times[-1] - RAMPED / 2
    speed = float(np.polyfit(times[late], angles[late], 1)[0])
    yield f"forced_speed {SPEED:g} rad/s: theta_ctrl goes with {speed:.4g} rad/s"
    if abs(speed - SPEED) > SPEED_ERROR * SPEED:
        raise Failed(f"forced_speed is {SPEED:g} rad/s, theta_ctrl goes with {speed:.4g} rad/s")
    # what it lags behind a speed that were there at once is half of the ramp's time, whenever that began
    moving = np.abs(angles - angles[0]) > RESOLVED
    behind = times[moving][0] - (times[-1] - (angles[-1] - angles[0]) / SPEED)
    began = math.sqrt(2 * RESOLVED / SLOPE)  # s after which so much is passed
    due = -SPEED / SLOPE / 2 + began
    if abs(behind - due) > 0.25 * SPEED / SLOPE + 2 * float(spans.max()):
        raise Failed(f"with forced_slope {SLOPE:g} rad/s² the angle lags {-behind:.3g} s, not {-due:.3g} s")
    put(device, "forced_speed", 0.0)
    device.probe.listen(2 * SETTLED)
    rest = float(_angles(device, told, channel)[1][-1])
    target = float((rest + 2.5 + math.pi) % (2 * math.pi) - math.pi)
    put(device, "forced_angle", target)
    device.probe.listen(MOVED)
    times, angles = _angles(device, told, channel)
    travel = float(angles[-1]) - rest
    moving = times > times[-1] - MOVED
    fast = float(np.max(np.abs(np.diff(angles[moving]) / np.diff(times[moving]))))
    words = f"forced_angle {target:.4g} rad from {rest % (2 * math.pi):.4g} rad: it turned {travel:.4g} rad"
    if abs(travel - 2.5) > RESOLVED:
        raise Failed(f"{words}, not 2.5 rad")
    if fast > 1.1 * AT_REST:
        raise Failed(f"{words}, with {fast:.3g} rad/s")
    yield words


@check("test-cycle", "20.12 20.13 20.14")
def test_cycle(device: Device) -> Iterator[str]:
    """Bit 7 of `status` is set each time that a cycle of the test signal begins; its amplitude is 0."""
    require(device, "test")
    channel = device.channel_named("status")
    if channel is None:
        raise NotApplicable("the device has no channel `status`")
    for periods, length, cycle in CYCLES:
        if length and not device.offers(Feature.WAVEFORM):
            continue
        device.run()
        put(device, "test_periods", periods)
        if device.named("test_length"):
            put(device, "test_length", length)
        put(device, "test", TestSignal.I_D)
        samples = every_period(device, [channel])
        device.rest()
        ordered = sorted(samples)
        marks = [index for index in ordered if samples[index][0] & Status.INJECTION_SYNC]
        apart = set(np.diff(marks).tolist())
        words = f"test_periods {periods}, test_length {length}: {len(marks)} cycles begin in {len(ordered)} periods"
        if apart != {cycle}:
            raise Failed(f"{words}, {sorted(apart) or 'none'} periods apart, not {cycle}")
        yield f"{words}, {cycle} periods apart"


@check("protects", "20.1")
def protects(device: Device) -> Iterator[str]:
    """With a forced angle and a given voltage of zero, limits of current and DC link that are lowered to 0 trip."""
    for name, fault in (("i_trip", Fault.OVERCURRENT), ("u_dc_max", Fault.OVERVOLTAGE)):
        record = require(device, "forced") and device.named(name)
        if record is None or record.flags & (Flag.READ_ONLY | Flag.IDLE_ONLY) or device.parameter(record).lo > 0:
            yield f"{name} cannot be set to 0"
            continue
        with restored(device, name):
            run_at_zero_volts(device)
            before = device.parameter(record).value
            put(device, name, 0.0)
            try:
                beat = device.probe.beat(lambda beat: beat.state == DriveState.FAULT, TRIPS, "with FAULT ")
            except Unknown as nothing:
                if fault == Fault.OVERVOLTAGE:
                    raise Failed(f"{name} = 0 in VOLTAGE with forced 1: {nothing}") from None
                raise Unknown(f"{name} = 0: {nothing}: perhaps its sensors show no current at all") from None
            require_granted(device.set(record, before), f"{name} = {before:g}")
            if not beat.faults & fault or beat.outputs_on:
                raise Failed(f"{name} = 0 in VOLTAGE with forced 1 led to faults 0x{int(beat.faults):x}")
        yield f"{name} = 0 in VOLTAGE with forced 1: {fault.name}"


@check("encoder-zero", "20.17")
def encoder_zero(device: Device) -> str:
    """Another encoder_zero turns the encoder's angle by as much."""
    record, channel = device.named("encoder_zero"), reference(device)
    if record is None or channel is None:
        raise NotApplicable("the device lacks the parameter encoder_zero, or an encoder's angle")
    before = device.parameter(record).value
    found = []
    try:
        for value in (before, before + TURNED if before < 0 else before - TURNED):
            require_granted(device.set(record, value), f"encoder_zero = {value:g}")
            device.probe.forget()
            told = device.configure(0, ids([channel]), RATE, share=ALL)
            device.start_streams(1)
            device.probe.listen(SETTLED)
            samples = by_index(device, told, (channel,))
            device.stop_streams()
            if not samples:
                raise Unknown(f"no sample of {channel.name} received")
            angle = physical(channel, samples[max(samples)])[0]
            found.append((value, float(angle)))
    finally:
        device.put_back(record, before)
    (zero, first), (other, second) = found
    off = (second - first - (other - zero) + math.pi) % (2 * math.pi) - math.pi
    words = f"encoder_zero {zero:.4g}, then {other:.4g} rad: {channel.name} {first:.4g}, then {second:.4g} rad"
    if abs(off) > STILL:
        raise Failed(words)
    return words


def _square(device: Device) -> float:
    """The mean square of the current vector in A², as i_d and i_q show it now; 0 where there are no such channels."""
    found = [channel for channel in device.channels if channel.name in ("i_d", "i_q")]
    if len(found) < 2:
        return 0.0
    samples = every_period(device, found)
    rows = [split_sample(sample, tuple(found)) for sample in samples.values()]
    columns = [physical(channel, b"".join(row[at] for row in rows)) for at, channel in enumerate(found)]
    return float(np.mean(columns[0] ** 2 + columns[1] ** 2))


@check("overload", "20.2 20.1")
def overload(device: Device) -> str:
    """With i_cont 0 and next to no i2t_max, what the current sensors show at zero current trips OVERLOAD."""
    bears, most = require(device, "i_cont"), require(device, "i2t_max")
    if device.parameter(bears).lo > 0 or bears.flags & most.flags & Flag.READ_ONLY:
        raise NotApplicable("i_cont cannot be set to 0")
    with restored(device, "i_cont", "i2t_max"):
        device.run()
        put(device, "i_cont", 0.0)
        put(device, "i2t_max", TINY)
        try:
            beat = device.probe.beat(lambda beat: beat.state == DriveState.FAULT, TRIPS, "with FAULT ")
        except Unknown as nothing:
            if (square := _square(device)) * TRIPS > SURE * TINY:
                raise Failed(f"i_cont 0, i2t_max {TINY:g} A²s, a mean square of {square:.3g} A²: {nothing}") from None
            raise Unknown(f"{nothing}: perhaps its sensors show no current at all") from None
        if not beat.faults & Fault.OVERLOAD:
            raise Failed(f"i2t_max {TINY:g} A²s led to faults 0x{int(beat.faults):x}, not OVERLOAD")
        put(device, "i2t_max", 0.0)
    return f"i_cont 0, i2t_max {TINY:g} A²s: OVERLOAD"
