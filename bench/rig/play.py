"""Plays a motion profile on a bench: setpoints by the clock, parameters and marks where steps begin.

The profile says what is asked for at any time; nothing here waits for a drive's confirmation before it goes on, so that
steps keep their times on every link. What a drive does not confirm, or rejects, is seen a moment later. Nothing here
energises or switches off.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from functools import partial
from typing import Protocol

from bench.device.client import GRACE, LATE, POLL, Client
from bench.errors import BenchError
from bench.motion import profile
from bench.motion.profile import Act
from bench.rig.drive import OBSERVER, Drive
from bench.rig.loads import Load
from bench.rig.machine import Machine
from bench.rig.played import Span
from protocol.errors import HbpError

PERIOD = 0.02  # s between setpoints while a quantity changes
LEAST = 1e-5  # s of a turn: time goes on


class Stage(Protocol):
    """What a player needs of a rig."""

    client: Client
    drive: Drive
    load: Load
    tripped: str

    @property
    def machines(self) -> list[Machine]:
        """What has a watchdog."""

    def turn(self, timeout: float, collect: bool = True) -> None:
        """One turn of the link, see `Client.poll`."""

    def see_clock(self) -> None:
        """Look at the drive's clock."""

    def device_tick(self, host: float) -> int | None:
        """The device's tick at a time of the link's clock; None while that is not known."""

    def gave_up(self, error: BenchError | HbpError) -> None:
        """What is asked for cannot be had: raise it, or let the motor go."""


class Player:
    """Plays acts. `begun` is called when what an act begins with has been sent, `marked` when it is over.

    `look` is called in every turn of the link. `max_speed`: r/min at which the motor is switched off while a current
    turns it.
    """

    def __init__(
        self,
        stage: Stage,
        max_speed: float | None,
        begun: Callable[[Act], None],
        marked: Callable[[Span], None],
        look: Callable[[], object] = lambda: None,
    ) -> None:
        self._stage, self._max_speed, self._begun, self._marked, self._look = stage, max_speed, begun, marked, look
        self._given: dict[int, tuple[str, float]] = {}  # what was last asked for, by place in `Act.courses`
        self._due = 0.0  # when the next point of a course is sent, s

    def play(self, acts: Iterable[Act]) -> None:
        """Play them one after the other. Raises what the rig raises where something goes wrong."""
        client = self._stage.client
        with ExitStack() as stack:
            stack.callback(setattr, self._stage.drive, "on_course", False)
            for machine in self._stage.machines:
                stack.enter_context(machine.node.unwaited())
            begin = client.now()
            for act in acts:
                self._play(act, begin)
                begin += act.seconds

    def _play(self, act: Act, begin: float) -> None:
        stage, client = self._stage, self._stage.client
        began = client.now()
        if played := not stage.tripped:
            self._attempt(partial(self._begin, act, began - begin))
        self._begun(act)
        if played:
            with suppress(HbpError):  # who polls next is told
                stage.see_clock()
        until, last, pauses = begin + act.seconds, math.inf, client.pauses
        try:
            while (left := until - client.now()) > 0.0 or client.behind:
                t = client.now() - begin
                if not stage.tripped:
                    self._attempt(partial(self._go_on, act, t))
                elif last == math.inf:
                    last = client.now()
                self._look()
                changing = () if stage.tripped else [course for course in act.courses if course.changes(t)]
                ends = (course.ramp - t for course in changing if course.ramp > t)
                self._turn(min(left, *ends, self._due - client.now() if changing else left))
                if pauses != client.pauses:  # what came meanwhile is looked at first
                    pauses, until = client.pauses, max(until, client.now() + min(act.seconds, GRACE))
        finally:
            if played and act.seconds < math.inf:
                self._mark(act, began, min(last, begin + act.seconds, client.now()))

    def _turn(self, left: float) -> None:
        """A turn that ends when `left` s are over, at the latest: only where there is time for that does it collect."""
        if left > 1.5 * LATE:
            self._stage.turn(min(POLL, 0.5 * (left - LATE)))
        else:
            self._stage.turn(max(left, LEAST), collect=False)

    def _attempt(self, do: Callable[[], None]) -> None:
        try:
            do()
        except (BenchError, HbpError) as error:
            self._stage.gave_up(error)

    def _begin(self, act: Act, t: float) -> None:
        drive = self._stage.drive
        for name, value in act.sets.items():
            drive.set(name, value)
        if OBSERVER in act.sets:  # another speed is watched
            drive.on_course = False
        drive.may_turn_freely(self._max_speed if act.drive.quantity == profile.CURRENT else None)
        self._due = -math.inf
        self._go_on(act, t)

    def _go_on(self, act: Act, t: float) -> None:
        """Send what is asked for at `t` s of the act, where that is another, and see what became of what was sent."""
        now = self._stage.client.now()
        if due := now >= self._due:
            self._due = now + PERIOD
        for place, course in enumerate(act.courses):
            asked = course.quantity, course.at(t)
            if asked != self._given.get(place) and (due or not course.changes(t)):
                self._give(*asked)
                self._given[place] = asked
        for machine in self._stage.machines:
            if machine.on:
                machine.node.watch_setpoints()

    def _give(self, quantity: str, value: float) -> None:
        drive, load = self._stage.drive, self._stage.load
        match quantity:
            case profile.SPEED:
                drive.speed(rpm=value)
                drive.on_course = True
            case profile.CURRENT:
                drive.current(value)
                drive.on_course = True
            case profile.LOAD_TORQUE:
                load.torque(value)
            case profile.LOAD_CURRENT:
                load.torque(drive.torque_constant * value)
            case profile.LOAD_SPEED:
                load.speed(rpm=value)

    def _mark(self, act: Act, began: float, ended: float) -> None:
        first, last = (self._stage.device_tick(at) for at in (began, ended))
        if first is not None and last is not None and first <= last:
            self._marked(Span(act.name, first, last))
