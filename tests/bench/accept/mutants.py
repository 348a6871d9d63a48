"""Observers that are wrong in one line, and protection with a flaw: simulated drives run them in place of their own."""

from __future__ import annotations

import hashlib
import importlib.util
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import patch

from protocol.device.state import StateMachine
from protocol.messages import DriveState, Fault
from protocol.signals import STATUS_STATE_MASK
from sim.drive import tick_protection
from sim.drive.apps import DriveApp
from sim.drive.machine import SOURCES, SimulatedBench
from sim.observers.entry import Entry


@cache
def _module(name: str, old: str, new: str, directory: Path) -> ModuleType:
    """The observer module `name` with `new` in the place of `old`, which it must have once."""
    original = importlib.util.find_spec(f"sim.observers.{name}")
    assert original.origin is not None
    text = Path(original.origin).read_text()
    assert text.count(old) == 1, f"sim/observers/{name}.py has changed: '{old}' is in it {text.count(old)} times"
    file = directory / f"wrong_{name}_{hashlib.sha256(new.encode()).hexdigest()[:12]}.py"
    file.write_text(text.replace(old, new))
    spec = importlib.util.spec_from_file_location(file.stem, file)
    module = sys.modules[file.stem] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def mutant(
    observer: str, old: str, new: str, directory: Path, module: str = "", **make: bool
) -> AbstractContextManager[object]:
    """While it is entered, simulated drives have `observer` with that change in its module, or in another `module`.

    `make`: what `make_params` of that module takes beside the usual.
    """
    wrong = _module(module or observer, old, new, directory)
    number, entry = next((number, entry) for number, entry in SOURCES.items() if entry.name == observer)
    changed: Entry = replace(
        entry,
        init=wrong.init,
        step=wrong.step,
        make=partial(wrong.make_params, **make) if make else wrong.make_params,
        settings=wrong.Settings,
    )
    return patch.dict(SOURCES, {number: changed})


# -- protection ---------------------------------------------------------------------------------------------------

OFTEN = 8  # periods, after which a flaw looks at the drive anew
Flaw = Callable[["Looked"], None]


class Looked:
    """A simulated bench every `OFTEN` periods, for a flaw to spoil its firmware's protection until the next time."""

    def __init__(self, bench: SimulatedBench) -> None:
        self.bench, self.load, self.speed = bench, bench.load_parameters, bench.truth.omega_m
        self.limits = bench._params.array["firmware"]["protection"]  # as the next periods use them
        self.own = bench._constants.firmware.protection
        self.memory = bench._state.array["firmware"]["protection"]
        electric = bench._state.array["world"]["electric"][0]
        alpha, beta = float(electric["i_alpha"]), 0.5 * math.sqrt(3.0) * float(electric["i_beta"])
        self.phases = {"a": alpha, "b": -0.5 * alpha + beta, "c": -0.5 * alpha - beta}

    def unless(self, blind: bool, limit: str) -> None:
        """This limit is in force unless the drive is blind to what it limits."""
        self.limits[limit] = math.inf if blind else getattr(self.own, limit)


@contextmanager
def flawed(flaw: Flaw) -> Iterator[None]:
    """While it is entered, simulated drives have the flaw."""
    run = SimulatedBench._run

    def spoilt(bench: SimulatedBench, *arguments: Any) -> None:
        flaw(Looked(bench))
        run(bench, *arguments)

    with patch("sim.drive.machine.PORTION", OFTEN), patch.object(SimulatedBench, "_run", spoilt):
        yield


@contextmanager
def limits_changed(**changed: Callable[[Any], float]) -> Iterator[None]:
    """While it is entered, simulated drives have these limits, of what they would be."""
    make_params = tick_protection.make_params

    def wrong(*arguments: Any) -> tick_protection.Params:
        own = make_params(*arguments)
        return own._replace(**{name: change(getattr(own, name)) for name, change in changed.items()})

    with patch.object(tick_protection, "make_params", wrong):
        yield


def blind_to(phase: str, sign: float) -> Flaw:
    """To too much current of this sign in a phase, as long as no other has more."""

    def flaw(seen: Looked) -> None:
        size = max(map(abs, seen.phases.values()))
        seen.unless(size > 0.0 and sign * seen.phases[phase] == size, "i_trip")

    return flaw


def late(seconds: float) -> Flaw:
    """To too much current until it has been there for so long."""
    since: dict[int, int] = {}

    def flaw(seen: Looked) -> None:
        bench = seen.bench
        over = max(map(abs, seen.phases.values())) > seen.own.i_trip
        first = since.setdefault(id(bench), bench.n) if over else since.pop(id(bench), bench.n)
        seen.unless(bench.n - first < seconds * bench.params.clock.pwm_hz, "i_trip")

    return flaw


def believes(when: Callable[[Looked], bool]) -> Flaw:
    """The Hall sensors, whatever they say, in these cases."""

    def flaw(seen: Looked) -> None:
        if when(seen):
            seen.memory["doubt"] = seen.memory["opposed"] = 0.0

    return flaw


@contextmanager
def goes_on() -> Iterator[None]:
    """While it is entered, simulated drives that trip say so, and keep their outputs on until the fault is cleared."""
    real, run, enter = SimulatedBench.faults, SimulatedBench._run, SimulatedBench.enter_state
    said: dict[int, Fault] = {}

    def lying(bench: SimulatedBench, source: int, n: int, block: Any, begin: int, end: int) -> None:
        run(bench, source, n, block, begin, end)
        firmware = bench._state.array["firmware"]
        if firmware["faults"][0]:
            said[id(bench)] = real.fget(bench)  # type: ignore[attr-defined]
        if said.get(id(bench)):
            firmware["faults"] = 0
            status = bench._sections.column(block, n, "status")[begin:end]
            status[:] = status & ~STATUS_STATE_MASK | DriveState.FAULT

    def entered(bench: SimulatedBench, state: DriveState) -> None:
        if state is not DriveState.FAULT:
            said.pop(id(bench), None)
            enter(bench, state)

    def blind(seen: Looked) -> None:
        for limit in ("i_trip", "omega_trip", "u_dc_max", "opposed_max"):
            seen.unless(id(seen.bench) in said, limit)
        seen.limits["u_dc_min"] = 0.0 if id(seen.bench) in said else seen.own.u_dc_min
        if id(seen.bench) in said:
            seen.memory["doubt"] = 0.0

    with ExitStack() as stack:
        stack.enter_context(patch.object(SimulatedBench, "_run", lying))
        stack.enter_context(patch.object(SimulatedBench, "enter_state", entered))
        stack.enter_context(patch.object(SimulatedBench, "faults", property(lambda b: said.get(id(b)) or Fault(0))))
        stack.enter_context(flawed(blind))
        yield


@contextmanager
def forgets(then: DriveState) -> Iterator[None]:
    """While it is entered, simulated drives clear a fault themselves once its cause has gone, and enter that state."""
    advance = StateMachine.advance

    def forgetful(machine: StateMachine, now: int) -> None:
        advance(machine, now)
        of_drive = isinstance(machine._app, DriveApp)
        if of_drive and machine.state is DriveState.FAULT and not machine._app.clear_faults(machine.faults):
            machine.faults = machine.first_fault = Fault(0)
            machine.feed(now)
            machine._enter(then)

    with patch.object(StateMachine, "advance", forgetful):
        yield
