"""Simulated devices that `bench param` reaches by made-up targets, in virtual time, well or misbehaving."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import numpy as np
from virtual_run import simulated

from bench.cli import main
from protocol.errors import Refused
from protocol.links import Link
from protocol.messages import ErrorCode, Feature
from protocol.signals import Flag
from sim.ports.device import SimulatedDevice
from sim.ports.virtual import VirtualLink

_NUMBERS = itertools.count(1)


def device(serial: str = "SIM-0001", stores: bool = False, **settings: Any) -> SimulatedDevice:
    """A drive and a load machine; `serial`: the drive's. `stores`: it says that it can store its parameters."""
    made = simulated(**settings)
    identity = made.drive.identity
    features = identity.features | (Feature.COMMIT if stores else Feature(0))
    made.drive.identity = replace(identity, serial=serial, features=features)
    if stores:
        made.drive.app.commit = lambda: None  # type: ignore[method-assign]
    return made


def refusing(made: SimulatedDevice, name: str, code: ErrorCode = ErrorCode.OUT_OF_RANGE) -> None:
    """From now on the drive refuses to set this parameter to anything but what it has, whatever its range says."""
    set_param = made.drive.app.set_param

    def refuse(asked: str, value: float) -> None:
        if asked == name and value != made.drive.app.get_param(name):
            raise Refused(name, code, 1.0)
        set_param(asked, value)

    made.drive.app.set_param = refuse  # type: ignore[method-assign]


def rounding(made: SimulatedDevice, name: str, step: float) -> None:
    """From now on the drive keeps this parameter in steps."""
    set_param = made.drive.app.set_param
    made.drive.app.set_param = lambda asked, value: set_param(  # type: ignore[method-assign]
        asked, float(np.float32(round(value / step) * step)) if asked == name else value
    )


def settable(made: SimulatedDevice) -> dict[str, float]:
    """The drive's parameters that a host can write, as the plant's side has them."""
    app = made.drive.app
    return {p.name: app.get_param(p.name) for p in app.parameters if not p.flags & (Flag.READ_ONLY | Flag.VOLATILE)}


@contextmanager
def reached(**devices: SimulatedDevice) -> Iterator[dict[str, str]]:
    """Targets of these devices, by name; each time that one is opened it is a new link to the same device."""
    targets = {name: f"tcp:test-{name}-{next(_NUMBERS)}:1" for name in devices}
    by_target = {targets[name]: made for name, made in devices.items()}

    def opened(target: str, *others: object) -> Link:
        return VirtualLink(by_target[target])

    with patch("bench.param.sources.open_target", opened):
        yield targets


def bench(capsys: Any, *arguments: object) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of a command."""
    code = 0
    try:
        main([str(argument) for argument in arguments])
    except SystemExit as end:
        code = int(end.code or 0)
    out, err = capsys.readouterr()
    return code, out, err


Run = Callable[..., tuple[int, str, str]]
