"""A drive that is commissioned, as checks need it: its parameters, which are put back, and a forced angle.

Chapter 20 of SPEC.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from bench.conform.device import Device, require_granted
from bench.conform.setpoints import is_taken
from bench.conform.verdicts import Unknown
from protocol.codes import Feature, SetpointMode
from protocol.descriptor import Channel
from protocol.signals import AngleSource

FEW = 20  # VOLTAGEs of zero until one is near enough to what the current loop gives


def require(device: Device, name: str) -> Channel:
    """A parameter of commissioning. Raises NotApplicable without the feature, Unknown where it is not there."""
    device.require(Feature.COMMISSION)
    record = device.named(name)
    if record is None:
        raise Unknown(f"there is no parameter {name}: see parameter.of-commissioning")
    return record


@contextmanager
def restored(device: Device, *names: str) -> Iterator[None]:
    """Parameters that are as before afterwards, at rest."""
    before = [(record := require(device, name), device.parameter(record).value) for name in names]
    try:
        yield
    finally:
        try:
            device.rest()
        finally:
            for record, value in reversed(before):
                device.put_back(record, value)


def put(device: Device, name: str, value: float) -> None:
    """Set a parameter. Raises Unknown where it is refused."""
    require_granted(device.set(require(device, name), value), f"{name} = {value:g}")


def value_of(device: Device, name: str) -> float:
    """A parameter's value. Raises Unknown."""
    return device.parameter(require(device, name)).value


@contextmanager
def blind(device: Device) -> Iterator[None]:
    """The angle source is not the encoder. Raises Unknown where there is no other."""
    record = device.named("observer")
    told = None if record is None else device.parameter(record)
    if told is None or told.value != AngleSource.ENCODER:
        yield
        return
    with restored(device, "observer"):
        put(device, "observer", max(told.lo, 1.0))
        yield


def run_at_zero_volts(device: Device) -> None:
    """RUNNING with a forced angle, in VOLTAGE 0. Raises Unknown."""
    device.run()
    put(device, "forced", 1.0)
    if not any(is_taken(device, SetpointMode.VOLTAGE, 0x0100 + n) for n in range(FEW)):
        raise Unknown(f"VOLTAGE 0 was not accepted, u_test_max is {value_of(device, 'u_test_max'):.3g} V")
