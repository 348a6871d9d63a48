"""Running the checks of a level on a device, in a `Rig`, which restores it: streams, parameters, outputs off.

From level 3 on outputs go on, after consent. A device that does not stop when told is not energised again.
"""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace

from bench.conform.captured import leave_waiting, look_for_held
from bench.conform.catalogue import chosen
from bench.conform.checks import Carrier, Check, Result
from bench.conform.device import Device, NotAtRest
from bench.conform.levels import MOTION, STATES
from bench.conform.lines import line_of
from bench.conform.probe import NoAnswer, Probe
from bench.conform.verdicts import Ended, Hopeless
from bench.device.client import Client
from bench.device.node import DRIVE, Node
from bench.errors import Interrupted, NodeError
from bench.rig.consent import check_limits, require_consent
from bench.rig.envelope import Envelope
from bench.rig.interrupts import undisturbed
from bench.rig.lock import alone_on
from bench.rig.restore import failures_of, put_streams_back
from bench.rig.rig import Plan, Rig
from bench.rig.screen import Screen
from bench.signal.verdict import Verdict
from protocol.errors import HbpError, LinkError, NoReply, Refused, RemoteProtocolError
from protocol.links import Link
from protocol.messages import HelloReply, StreamInfo
from protocol.payload import PayloadError

OUTAGE = 3  # times that HELLO is tried for 2.5 s: a link that is out for less is no device that fell silent
ATTEMPTS = 3  # at a check, where this program was held up
CHECK_TAKES = 30.0  # s at most, and on a UART as long as this many bytes take:
CHECK_BYTES = 60_000
MOST = 200.0  # s, and as long on a UART as ten times that; what is not run by then is unknown


@dataclass(frozen=True)
class Options:
    """What is asked for. `idle` lets so many s pass without reading the link."""

    target: str
    level: int
    speed_rpm: float = 100.0
    yes: bool = False
    idle: Callable[[float], None] = time.sleep


@dataclass
class Run:
    """How it went. `hello` is of the device; `unsafe` says why outputs may still be on, `ended` why it ended early."""

    options: Options
    hello: HelloReply
    bus: bool
    results: list[Result] = field(default_factory=list)
    unsafe: str = ""
    ended: str = ""
    loses: str = ""
    """That the link loses frames, and what was seen of it: then no failure is the device's."""
    signal: int = 0
    troubles: list[str] = field(default_factory=list)

    def count(self, verdict: Verdict) -> int:
        """How many checks ended like this."""
        return sum(result.verdict == verdict for result in self.results)


Told = Callable[[Result], None]


def conform(
    link: Callable[[], Link],
    options: Options,
    screen: Screen,
    confirm: Callable[[str], bool] | None,
    told: Told,
) -> Run:
    """Run all checks up to a level on the device that a link leads to; `told` gets each result as it comes.

    `confirm` asks a person, None where there is nobody. Raises BenchError and HbpError for what the user can fix,
    before anything is energised; what goes wrong later is in the result.
    """
    forbidden = ""

    def found(client: Client, target: str) -> Node:
        """The device, whatever it says of itself."""
        nonlocal forbidden
        try:
            return Node(client, client.connect().node)
        except (RemoteProtocolError, Refused, NoReply) as error:
            forbidden = str(error)
            return Node(client, DRIVE)

    envelope = Envelope(options.speed_rpm if options.level >= MOTION else 0.0)
    held = alone_on(options.target)
    with Rig(Plan(link, options.target, envelope=envelope, goes_on=True, held=held, find=found)) as rig:
        if not forbidden:
            streams: list[StreamInfo] = []
            try:
                with suppress(HbpError):
                    streams = rig.drive.node.configured_streams()
                _prepare(rig, options, confirm)
            except (NodeError, RemoteProtocolError, Refused, NoReply) as error:
                forbidden = str(error)  # the checks that are possible still run
            rig.at_end.append(lambda: put_streams_back(rig.drive.node, streams))
        client = rig.client
        line = line_of(client.link)
        device = Device(Probe(client.link, line, options.idle), options.level, options.speed_rpm)
        try:
            device.hello = device.probe.connect()
        except Ended as ended:
            raise NoReply(forbidden or f"{options.target}: {ended}") from None
        run = Run(options, device.hello, line.bus)
        try:
            look_for_held(device)
            _Course(run, rig, device, screen, told, forbidden).go()
        finally:  # another host has talked on this link
            rig.signal.uninterrupted(lambda: failures_of([client.connect]))
        rig.finish()
        run.unsafe, run.signal = rig.unsafe, rig.signal.number
        run.troubles += [f"at the end: {rig.tripped}"] if rig.tripped else []
        run.troubles += [f"not restored: {rig.not_restored}"] if rig.not_restored else []
    return run


def _prepare(rig: Rig, options: Options, confirm: Callable[[str], bool] | None) -> None:
    """Refuse what is not at rest and, where outputs are to go on, ask. Raises BenchError and HbpError."""
    energises, node, envelope = options.level >= STATES, rig.drive.node, rig.plan.envelope
    with nullcontext() if energises else suppress(NodeError):  # one that says nothing may be looked at
        rig.require_rest(or_fault=not energises)
    if energises:
        check_limits(node, envelope)
        require_consent(node, options.target, envelope, options.yes, confirm)


# -- meanwhile --------------------------------------------------------------------------------------------------------


class _Course:
    """One check after the other."""

    def __init__(self, run: Run, rig: Rig, device: Device, screen: Screen, told: Told, forbidden: str) -> None:
        self._run = run
        self._rig = rig
        self._device = device
        self._screen = screen
        self._told = told
        self._forbidden = forbidden  # why nothing is energised any more
        self._hopeless = False  # no other check can say anything, by the last attempt
        self._unanswered = False  # a request was not, in the last attempt
        self._began = device.probe.now()

    def go(self) -> None:
        """All of them; if it cannot go on, the rest is unknown."""
        try:
            self._all()
        finally:
            with suppress(Ended, LinkError):
                leave_waiting(self._device)
        self._run.troubles += [f"not restored: {words}" for words in self._device.not_put_back]

    def _all(self) -> None:
        run, left = self._run, chosen(self._run.options.level, self._run.bus)
        while left:
            self._screen.progress(f"{left[0].id} ({len(run.results) + 1} of {len(run.results) + len(left)})")
            try:
                self._add(self._one(left[0]))
                left = left[1:]
            except (KeyboardInterrupt, Interrupted) as interrupt:
                self._rig.signal.remember(interrupt)
                run.ended = f"ended by {signal.Signals(self._rig.signal.number).name}"
            except LinkError as error:
                run.ended = f"link lost: {error}"
            except NoAnswer as error:
                run.ended = f"the device no longer answers: {error}"
            if not run.ended and left and self._device.probe.now() - self._began > self._most(MOST, 10 * CHECK_BYTES):
                run.ended = f"it took longer than {self._most(MOST, 10 * CHECK_BYTES):.0f} s"
            if run.ended:
                for check in left:
                    self._add(Result(check, Verdict.INVALID, f"not run: {run.ended}"))
                return

    def _most(self, seconds: float, n: int) -> float:
        return seconds + self._device.probe.takes(n)

    def _add(self, result: Result) -> None:
        self._run.results.append(result)
        self._told(result)

    def _one(self, check: Check) -> Result:
        """Run a check as a new host, and leave the device at rest. Raises NoAnswer, LinkError."""
        device, probe = self._device, self._device.probe
        began = probe.now()
        bus = probe.line.bus
        if check.carrier is not Carrier.ANY and bus != (check.carrier is Carrier.BUS):
            return Result(check, Verdict.SKIPPED, f"only on {check.carrier}")
        if check.needs >= STATES and self._forbidden:
            return Result(check, Verdict.INVALID, f"not tried: {self._forbidden}")
        for attempt in range(1, ATTEMPTS + 1):
            held, known, mute = probe.held, dict(device.kept), dict(probe.mute)
            verdict, evidence = self._attempt(check)
            held = probe.held - held
            if held:  # what was measured meanwhile is not to be trusted
                device.kept, probe.mute = known, mute
            if not held or verdict in (Verdict.PASS, Verdict.SKIPPED) or self._run.ended:
                break
            if attempt == ATTEMPTS:
                verdict = Verdict.INVALID
                evidence = f"this program was held up for {held:.2f} s, at the last of {ATTEMPTS} attempts; {evidence}"
        if check.critical and (verdict is Verdict.FAIL or self._unanswered):
            self._forbidden = self._forbidden or f"{check.id} failed"
        if verdict is Verdict.FAIL:
            verdict, evidence = self._doubted(check, evidence)
        if self._hopeless and verdict is Verdict.FAIL:
            self._run.ended = evidence
        return Result(check, verdict, evidence, probe.now() - began)

    def _doubted(self, check: Check, evidence: str) -> tuple[Verdict, str]:
        """A failure, unless the link may be its cause, slow or losing frames, or the second attempt goes well."""
        run = self._run
        if check.needs >= STATES and (words := self._device.dropped()):
            return Verdict.INVALID, f"{words}; {evidence}"
        if not run.loses and (found := self._device.probe.loses()):
            run.loses = f"the link may be the cause ({found})"
            run.results = [
                replace(each, verdict=Verdict.INVALID, evidence=f"{run.loses}: {each.evidence}")
                if each.verdict is Verdict.FAIL
                else each
                for each in run.results
            ]
        if run.loses:
            self._device.probe.mute.clear()
            return Verdict.INVALID, f"{run.loses}: {evidence}"
        again, other = Verdict.FAIL, ""
        if not check.critical and not run.ended:  # else nothing is energised any more
            self._device.kept.clear()
            for _ in range(OUTAGE):
                with suppress(NoAnswer):  # of HELLO: it answers nothing, for now or any more
                    again, other = self._attempt(check)
                    break
        if again is Verdict.FAIL:
            return Verdict.FAIL, evidence
        return Verdict.INVALID, f"only at the first of two attempts: {evidence}; then {other}"

    def _attempt(self, check: Check) -> tuple[Verdict, str]:
        """Make the check once, and leave the device at rest. Raises NoAnswer, LinkError."""
        device, probe = self._device, self._device.probe
        if check.id != "link.hello":
            device.hello = probe.connect()
        verdict, evidence, self._hopeless, self._unanswered = Verdict.PASS, "", False, False
        if check.needs >= STATES:
            self._rig.drive.on = True  # from now on it gets a STOP
        probe.deadline = probe.now() + self._most(CHECK_TAKES, CHECK_BYTES)
        try:
            evidence = check.evidence(device)
        except NoAnswer as nothing:
            verdict, evidence = nothing.verdict, str(nothing)
            if check.id != (first := probe.mute.setdefault(nothing.kind, check.id)):
                verdict, evidence = Verdict.INVALID, f"{evidence}, as {first} has found"
            self._unanswered = True
        except Ended as ended:
            verdict, evidence = ended.verdict, str(ended)
            self._hopeless = isinstance(ended, Hopeless)
        except PayloadError as error:
            verdict, evidence = Verdict.FAIL, str(error)
        except NotAtRest as error:
            verdict, evidence = Verdict.INVALID, str(error)
        finally:
            probe.deadline = math.inf
            if check.needs >= STATES:
                with undisturbed():
                    self._calm(check)
        return verdict, evidence

    def _calm(self, check: Check) -> None:
        try:
            trouble = self._device.rest()
        except NotAtRest as error:
            self._run.ended = f"no heartbeat showed the outputs off: {error}"
            return
        if trouble:
            self._run.troubles.append(f"after {check.id}: {trouble}")
            self._forbidden = self._forbidden or f"after {check.id} {trouble}"
