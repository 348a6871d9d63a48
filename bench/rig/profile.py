"""A motion profile before it is played: what it asks of a bench at most, and whether drive and load machine allow it.

Every refusal names the step, the value and the limit. Nothing here is sent but questions, until `start_for`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from bench.device.node import Node
from bench.errors import BenchError, NodeError
from bench.motion.profile import CURRENT, LOAD_CURRENT, LOAD_SPEED, LOAD_TORQUE, SPEED, UNITS, Act, Profile
from bench.rig.consent import FLOAT32
from bench.rig.drive import OBSERVER, Drive
from bench.rig.envelope import Envelope
from bench.rig.loads import SPEED as FORCES
from bench.rig.loads import TORQUE, Load, NodeLoad, PersonLoad
from bench.rig.needs import NEEDS, offers, require
from bench.signal.sources import source_name
from bench.signal.units import RPM, pole_pairs
from protocol.signals import Flag
from protocol.text import did_you_mean

Limits = dict[str, list[tuple[float, str]]]
"""By quantity, the most that it may be, in its unit, and whose limit that is."""


def envelope_of(profile: Profile, current: float, drive: Node) -> Envelope:
    """The most that a profile asks of a drive; `current`: A that the motor may get at most, inf: as the drive says."""
    if not profile.uses(SPEED) and profile.uses(CURRENT):
        current = min(current, profile.peak(CURRENT))
    constant = _torque_constant(drive)
    load = max(profile.peak(LOAD_CURRENT), profile.peak(LOAD_TORQUE) / constant if constant else 0.0)
    return Envelope(max(profile.peak(SPEED, LOAD_SPEED), profile.max_speed or 0.0), current, load)


def check_profile(profile: Profile, drive: Drive, load: Load) -> list[str]:
    """Raise BenchError for what drive, load machine or what was announced do not allow; return what is good to know."""
    try:
        return _checked(profile, drive, load)
    except BenchError as error:
        raise type(error)(f"{profile.source}, {error}") from None


def _checked(profile: Profile, drive: Drive, load: Load) -> list[str]:
    node = drive.node
    _check_load(profile, node, load)
    limits = _limits(drive, load)
    if profile.max_speed is not None:
        _within(profile.max_speed, SPEED, limits, "max_speed_rpm")
    for act in profile.acts:
        for course in act.courses:
            _within(act.peak(course.quantity), course.quantity, limits, f"{act.place}: {course.quantity}")
        for name, value in act.sets.items():
            _check_parameter(node, act, name, value)
    return [f"{profile.source}, {words}" for words in dict.fromkeys(_too_steep(profile, node))]


def start_for(profile: Profile, drive: Drive, load: Load) -> None:
    """Start what a profile needs and is off, the load machine first, with the motor's current limited to the profile's.

    BenchError where the drive is on already with a higher limit.
    """
    most, now = profile.max_current, drive.parameters.get("i_max")
    if most is not None and now is not None and most < now:
        if drive.on:
            raise BenchError(f"max_current_A = {most:g} comes too late, the drive is on with {now:g} A: stop it first")
        drive.set("i_max", most)
    if profile.loads and isinstance(load, NodeLoad):
        load.start()
    if not drive.on:
        set_first(profile, drive)
        drive.start()


def set_first(profile: Profile, drive: Drive) -> None:
    """Set the parameters of the first step, while the drive is off: with its angle source it is to start."""
    for name, value in profile.acts[0].sets.items():
        drive.set(name, value)


def _torque_constant(drive: Node) -> float | None:
    """N·m per A of q current, by the drive's parameters; None where it has not what it takes."""
    if not all(map(drive.has_parameter, ("n_p", "psi_f_hat"))):
        return None
    n_p = pole_pairs({"n_p": drive.parameter("n_p").value})
    return 1.5 * n_p * drive.parameter("psi_f_hat").value if n_p else None


def _check_load(profile: Profile, drive: Node, load: Load) -> None:
    for quantity, ability in ((LOAD_TORQUE, TORQUE), (LOAD_CURRENT, TORQUE), (LOAD_SPEED, FORCES)):
        if not profile.uses(quantity):
            continue
        if isinstance(load, PersonLoad):
            raise BenchError(f"{quantity} needs a load machine: a person with a brake cannot keep to a profile's times")
        if ability not in load.abilities:
            what = "a load machine" + (" that forces a speed" if ability == FORCES else "")
            raise BenchError(f"{quantity} needs {what}, and this bench has none")
    if profile.uses(LOAD_CURRENT):
        require(drive, LOAD_CURRENT, NEEDS["--load"])


def _limits(drive: Drive, load: Load) -> Limits:
    limits: Limits = {quantity: [] for quantity in UNITS}

    def add(value: float, quantities: tuple[str, ...], whose: str) -> None:
        for quantity in quantities:
            limits[quantity].append((value, whose))

    def add_parameter(node: Node, name: str, whose: str, factor: float, *quantities: str) -> None:
        if node.has_parameter(name):
            add(node.parameter(name).value * factor, quantities, f"{whose} (its parameter {name})")

    envelope, constant = drive.envelope, _torque_constant(drive.node)
    agreed = "what was announced or agreed to"
    add(envelope.rpm, (SPEED, LOAD_SPEED), agreed)
    add(envelope.current, (CURRENT, LOAD_CURRENT), agreed)
    add_parameter(drive.node, "omega_m_max", "the drive's limit", 1.0 / RPM, SPEED)
    add_parameter(drive.node, "i_max", "the drive's limit", 1.0, CURRENT, LOAD_CURRENT)
    if constant:
        add(envelope.current * constant, (LOAD_TORQUE,), f"the torque of the {envelope.current:g} A of {agreed}")
        add_parameter(drive.node, "i_max", "the torque of the drive's largest current", constant, LOAD_TORQUE)
    if isinstance(load, NodeLoad):
        add_parameter(load.node, "tau_max", "the load machine's limit", 1.0, LOAD_TORQUE)
        add_parameter(load.node, "omega_m_max", "the load machine's limit", 1.0 / RPM, LOAD_SPEED)
        if constant:
            add_parameter(load.node, "tau_max", "the load machine's limit", 1.0 / constant, LOAD_CURRENT)
    return limits


def _within(value: float, quantity: str, limits: Limits, what: str) -> None:
    for limit, whose in limits[quantity]:
        if not value <= limit * (1.0 + FLOAT32):
            unit = UNITS[quantity]
            raise BenchError(f"{what} comes to {value:.4g} {unit}, beyond {limit:.4g} {unit}, {whose}")


def _check_parameter(drive: Node, act: Act, name: str, value: float) -> None:
    """Raise NodeError unless a running drive takes this value."""
    record = next((one for one in drive.descriptor.parameters if one.name == name), None)
    if record is None:
        known = [one.name for one in drive.descriptor.parameters]
        hint = did_you_mean(name, known, "bench info lists what it has")
        raise NodeError(f"{act.place} sets {name}, and the drive has no such parameter: {hint}")
    if record.flags & Flag.READ_ONLY:
        raise NodeError(f"{act.place} sets {name}, which the drive only tells (READ_ONLY): leave it out")
    if record.flags & Flag.IDLE_ONLY:
        raise NodeError(f"{act.place} sets {name}, which can be set only while the outputs are off (IDLE_ONLY)")
    if record.flags & Flag.WHOLE and value != int(value):
        raise NodeError(f"{act.place} sets {name} = {value:g}, and it takes whole numbers only")
    if name == OBSERVER and not offers(drive, source_name(value)):
        raise NodeError(
            f"{act.place} sets the angle source {source_name(value) or f'{value:g}'}, which the drive lacks"
        )
    now = drive.parameter(name)
    if not now.lo <= value <= now.hi:
        unit = f" {record.unit.symbol}".rstrip()
        raise NodeError(f"{act.place} sets {name} = {value:g}{unit}, and it must be {now.lo:g} to {now.hi:g}{unit}")


def _too_steep(profile: Profile, drive: Node) -> Iterator[str]:
    """Which ramps and sines are steeper than the drive's own slope, so that it comes later."""
    slope = drive.parameter("alpha_m_max").value if drive.has_parameter("alpha_m_max") else math.inf
    for act in profile.acts:
        slope = act.sets.get("alpha_m_max", slope)
        if act.drive.quantity == SPEED and act.drive.slope * RPM > slope * (1.0 + FLOAT32):
            yield (
                f"{act.place} changes the speed by {act.drive.slope:.4g} r/min in a second, and the drive follows by "
                f"{slope / RPM:.4g} at most (its parameter alpha_m_max): it will lag"
            )
