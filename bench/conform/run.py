"""Running the checks of a level on a device, and restoring it: streams, parameters, outputs off.

From level 3 on outputs go on, after consent; every way out sends STOP and waits for the heartbeat that shows them off.
A device that does not stop when told is not energised again.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from contextlib import ExitStack, nullcontext, suppress
from dataclasses import dataclass, field

from bench.conform.bus import BusLine
from bench.conform.catalogue import chosen
from bench.conform.checks import Carrier, Check, Result
from bench.conform.device import Device, NotAtRest
from bench.conform.levels import MOTION, STATES
from bench.conform.probe import ByteLine, Line, NoAnswer, Probe
from bench.conform.verdicts import Ended, Verdict
from bench.device.client import Client
from bench.device.node import Node
from bench.errors import BenchError, DriveFailed, Interrupted, NodeError, OutputsMayBeOn
from bench.rig.consent import check_limits, require_consent
from bench.rig.envelope import Envelope
from bench.rig.interrupts import undisturbed
from bench.rig.rest import require_rest
from bench.rig.screen import Screen
from protocol.canmap.host import CanWire
from protocol.errors import HbpError, LinkError, NoReply, Refused, RemoteProtocolError
from protocol.links import Link
from protocol.messages import Empty, HelloReply, StreamInfo, StreamReply, StreamSet, StreamStart
from protocol.payload import PayloadError


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
    signal: int = 0
    energised: bool = False
    """Whether outputs may have been on."""
    troubles: list[str] = field(default_factory=list)

    def count(self, verdict: Verdict) -> int:
        """How many checks ended like this."""
        return sum(result.verdict == verdict for result in self.results)


Told = Callable[[Result], None]


def conform(link: Link, options: Options, screen: Screen, confirm: Callable[[str], bool] | None, told: Told) -> Run:
    """Run all checks up to a level on the device that an open link leads to; `told` gets each result as it comes.

    `confirm` asks a person, None where there is nobody. Raises BenchError and HbpError for what the user can fix,
    before anything is energised; what goes wrong later is in the result.
    """
    client = Client(link)
    forbidden, streams = "", []
    node = None
    try:
        node = Node(client, client.connect().node)
        with suppress(HbpError):
            streams = node.configured_streams()
        _prepare(node, options, confirm)
    except (NodeError, RemoteProtocolError, Refused, NoReply) as error:
        if node is None and isinstance(error, NoReply):
            raise
        forbidden = str(error)  # what it says of itself is invalid: the checks that are possible still run
    line = _line(link)
    device = Device(Probe(link, line, options.idle), options.level, options.speed_rpm)
    try:
        device.hello = device.probe.connect()
    except Ended as ended:
        raise NoReply(f"{options.target}: {ended}") from None
    run = Run(options, device.hello, line.bus)
    with ExitStack() as stack:
        stack.callback(_leave, link, run, streams)
        _Course(run, device, screen, told, forbidden).go()
    return run


def _line(link: Link) -> Line:
    wire = link.wire()
    if not isinstance(wire, CanWire):
        return ByteLine()
    return BusLine(wire.rates, wire.node, wire.extended, wire.host)


# -- before -----------------------------------------------------------------------------------------------------------


def _prepare(node: Node, options: Options, confirm: Callable[[str], bool] | None) -> None:
    """Refuse what is not at rest and, where outputs are to go on, ask. Raises BenchError and HbpError."""
    energises = options.level >= STATES
    with nullcontext() if energises else suppress(NodeError):  # one that says nothing may be looked at
        require_rest(node, options.target, or_fault=not energises)
    if not energises:
        return
    envelope = Envelope(options.speed_rpm if options.level >= MOTION else 0.0)
    if options.level >= MOTION:
        check_limits(node, envelope)
    require_consent(node, options.target, envelope, options.yes, confirm)


# -- meanwhile --------------------------------------------------------------------------------------------------------


class _Course:
    """One check after the other."""

    def __init__(self, run: Run, device: Device, screen: Screen, told: Told, forbidden: str) -> None:
        self._run = run
        self._device = device
        self._screen = screen
        self._told = told
        self._forbidden = forbidden  # why nothing is energised any more

    def go(self) -> None:
        """All of them; if it cannot go on, the rest is unknown."""
        self._all()
        self._run.troubles += [f"not restored: {words}" for words in self._device.not_put_back]

    def _all(self) -> None:
        run, left = self._run, chosen(self._run.options.level, self._run.bus)
        while left:
            self._screen.progress(f"{left[0].id} ({len(run.results) + 1} of {len(run.results) + len(left)})")
            try:
                self._add(self._one(left[0]))
                left = left[1:]
            except (KeyboardInterrupt, Interrupted) as interrupt:
                run.signal = interrupt.signum if isinstance(interrupt, Interrupted) else signal.SIGINT
                run.ended = f"ended by {signal.Signals(run.signal).name}"
            except LinkError as error:
                run.ended = f"link lost: {error}"
            except NoAnswer as error:
                run.ended = f"the device no longer answers: {error}"
            if run.ended:
                for check in left:
                    self._add(Result(check, Verdict.UNKNOWN, f"not run: {run.ended}"))
                return

    def _add(self, result: Result) -> None:
        self._run.results.append(result)
        self._told(result)

    def _one(self, check: Check) -> Result:
        """Run a check as a new host, and leave the device at rest. Raises NoAnswer, LinkError."""
        device, probe = self._device, self._device.probe
        began = probe.now()
        bus = probe.line.bus
        if check.carrier is not Carrier.ANY and bus != (check.carrier is Carrier.BUS):
            return Result(check, Verdict.NOT_APPLICABLE, f"only on {check.carrier}")
        if check.needs >= STATES and self._forbidden:
            return Result(check, Verdict.UNKNOWN, f"not tried: {self._forbidden}")
        if check.id != "link.hello":
            device.hello = probe.connect()
        verdict, evidence = Verdict.PASSED, ""
        self._run.energised |= check.needs >= STATES
        try:
            evidence = check.body(device)
        except Ended as ended:
            verdict, evidence = ended.verdict, str(ended)
        except PayloadError as error:
            verdict, evidence = Verdict.FAILED, str(error)
        except NotAtRest as error:
            verdict, evidence = Verdict.UNKNOWN, str(error)
        finally:
            if check.needs >= STATES:
                with undisturbed():
                    self._calm(check)
        if check.critical and verdict is Verdict.FAILED:
            self._forbidden = self._forbidden or f"{check.id} failed"
        return Result(check, verdict, evidence, probe.now() - began)

    def _calm(self, check: Check) -> None:
        try:
            trouble = self._device.rest()
        except NotAtRest as error:
            self._run.ended = f"no heartbeat showed the outputs off: {error}"
            return
        if trouble:
            self._run.troubles.append(f"after {check.id}: {trouble}")
            self._forbidden = self._forbidden or f"after {check.id} {trouble}"


# -- after ------------------------------------------------------------------------------------------------------------


def _leave(link: Link, run: Run, streams: list[StreamInfo]) -> None:
    """Outputs off where they may have been on, streams as they were; whatever happens."""
    with undisturbed():
        client = Client(link)
        try:
            node = Node(client, client.connect().node)
        except HbpError as error:
            if run.energised:
                run.unsafe = f"OUTPUTS MAY STILL BE ON: cut the power. STOP was not received: {error}"
            return
        if run.energised:
            _stop(node, run)
        try:
            node.stop_streams()
            _restore(node, streams)
        except (HbpError, BenchError) as error:
            run.troubles.append(f"not restored: streams: {error}")


def _stop(node: Node, run: Run) -> None:
    try:
        node.stop()
    except OutputsMayBeOn as error:
        run.unsafe = str(error)
    except (DriveFailed, HbpError) as error:
        run.troubles.append(f"at the end: {error}")


def _restore(node: Node, streams: list[StreamInfo]) -> None:
    for s in streams:
        asked = StreamSet(s.stream, s.event, s.decimation, s.max_latency_ms, s.channels)
        node.client.request(asked, node.number, StreamReply)
        if s.running:
            node.client.request(StreamStart(1 << s.stream), node.number, Empty)
