"""A commissioning that ends at any moment: by a signal, and by a link that is lost. Asked of the plant."""

from __future__ import annotations

import math
import signal
from collections.abc import Callable
from contextlib import ExitStack
from unittest.mock import patch

import numpy as np
import pytest
from drawn_benches import NAMES, MadeBench, drawn
from plant_watch import PlantWatch
from test_commission_command import left_alone

from bench.commission.command import Options, commission
from bench.errors import BenchError, Interrupted, OutputsMayBeOn
from protocol.errors import LinkClosed
from protocol.messages import DriveState, Fault
from protocol.signals import DRIVE_PARAMETERS, Flag
from sim.config.params import load_params
from sim.ports.device import SimulatedDevice
from tests.bench.virtual_run import TARGET, RecordingScreen, WatchedLink
from tests.choice import sampled

SHARE, FAST = 0.8, 0.6
"""Of the bench's current and speed, that are agreed to."""
LONGEST = 50.0
"""s of drive time, within which it ends: some runs are over before."""
WATCHDOG = 0.2
"""s, of the simulated drive."""


class EndedAt:
    """A commissioning of a bench that nobody has tuned on, to which something happens at a random moment."""

    def __init__(self, number: int, happens: Callable[[WatchedLink], None]) -> None:
        self.of: MadeBench = drawn(NAMES[number % len(NAMES)], 4000 + number)
        self.moment = np.random.default_rng([number, 45]).uniform(0.0, LONGEST)
        self.device = SimulatedDevice(load_params(None, self.of.config), number)
        self.watch, self.before = PlantWatch(self.device), dict(self.device.bench.parameters)
        self.link = WatchedLink(self.device, self._look)
        self.happened, self.on, self.raised = False, False, None
        self._happens = happens
        given = Options(TARGET, current_a=SHARE * self.of.i_max, speed_rpm=FAST * self.of.rpm)
        with ExitStack() as stack:
            stack.enter_context(patch("bench.commission.command.open_target", lambda *_: self.link))
            stack.enter_context(patch("bench.device.client.REOPEN_PERIOD", 0.0))
            try:
                commission(given, RecordingScreen(), None)
            except (KeyboardInterrupt, Exception) as error:
                self.raised = error

    def _look(self, call: int) -> None:
        if self.device.periods >= self.moment * self.device.pwm_hz:
            if not self.happened:
                self.happened, self.on = True, self.device.bench.outputs_on
            self._happens(self.link)

    def within_what_was_agreed_to(self) -> bool:
        rpm = self.watch.fastest * 60.0 / math.tau
        return self.watch.largest <= SHARE * self.of.i_max and rpm <= FAST * self.of.rpm


def interrupted(link: WatchedLink) -> None:
    if not getattr(link, "done", False):
        link.done = True  # type: ignore[attr-defined]
        signal.raise_signal(signal.SIGINT)


def pulled(link: WatchedLink) -> None:
    link.device.advance(link.device.pwm_hz // 100)
    raise LinkClosed("unplugged")


@pytest.mark.long("a part of a commissioning")
@pytest.mark.parametrize("number", sampled("stopped", range(100), 3, campaign="commission"))
def test_stop_at_any_moment_leaves_it_off_and_as_it_was(number: int) -> None:
    ended = EndedAt(number, interrupted)
    assert isinstance(ended.raised, Interrupted | KeyboardInterrupt) if ended.happened else ended.raised is None
    assert left_alone(ended.device, ended.before), ended.moment
    assert ended.device.drive.machine.faults == Fault(0)  # STOP did it, not the watchdog
    assert ended.within_what_was_agreed_to(), (ended.moment, ended.watch.largest, ended.watch.fastest)


@pytest.mark.long("a part of a commissioning")
@pytest.mark.parametrize("number", sampled("unplugged", range(100, 200), 2, campaign="commission"))
def test_a_link_that_is_lost_at_any_moment_leaves_it_off(number: int) -> None:
    """The drive's own watchdog sees to it; what could not be put back is told."""
    ended = EndedAt(number, pulled)
    if not ended.happened:
        assert ended.raised is None
        return
    assert isinstance(ended.raised, OutputsMayBeOn if ended.on else BenchError | LinkClosed), ended.raised
    ended.device.advance(round(2.0 * WATCHDOG * ended.device.pwm_hz))
    assert not ended.device.bench.outputs_on
    assert ended.device.drive.state != DriveState.RUNNING
    assert ended.within_what_was_agreed_to(), (ended.moment, ended.watch.largest, ended.watch.fastest)
    after = dict(ended.device.bench.parameters)
    volatile = [parameter.name for parameter in DRIVE_PARAMETERS if Flag.VOLATILE in parameter.flags]
    assert {name: after[name] for name in volatile} == {name: ended.before[name] for name in volatile}
    changed = [name for name, value in ended.before.items() if after[name] != value]
    told = str(ended.raised) + " ".join(getattr(ended.raised, "__notes__", []))
    assert all(name in told for name in changed), (changed, told)
