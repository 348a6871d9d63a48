"""Outputs off, and seen to be off: what STOP must come to, and what a running node must go on saying of itself.

A reply to STOP is a promise; the heartbeats that follow are what the node's power stage does. Nothing here energises
anything, and nothing here feeds a watchdog: a node that is being stopped has its own watchdog left as the last resort.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Protocol

from bench.device.client import HEARD, Client
from bench.errors import UNSAFE, DriveFailed, OutputsMayBeOn
from protocol.codes import fault_names
from protocol.errors import HbpError, LinkError, NoReply, Refused
from protocol.messages import Command, DriveState, Heartbeat, HelloReply

TRIES = 3  # STOPs that are sent, each repeated by the session while it is not answered
HEARTBEATS = 0.35  # s: three heartbeats, of which one at least must have come
WATCHDOG = 1.5  # s in which a node that is no longer fed should have switched itself off
LINK_BACK = 2.0  # s that STOP waits for a link that is gone
DARK = 3  # heartbeats in a row
QUIET = 1.0  # s without a heartbeat after which the state of a running node is not known
NO_WATCHDOG = 0xFFFF  # `watchdog_ms` of a watchdog that is not at work
OFF = (DriveState.BOOT, DriveState.IDLE, DriveState.FAULT)


class Node(Protocol):
    """What is needed of a node to stop it and to watch it; see `bench.device.node`."""

    client: Client
    number: int

    @property
    def identity(self) -> HelloReply:
        """Who it is."""

    def command(self, command: Command) -> DriveState:
        """Send a state command and return the state after it."""


def is_off(heartbeat: Heartbeat) -> bool:
    """Whether the node says that its power stage is off, and is in a state in which it stays off."""
    return heartbeat.state in OFF and not heartbeat.outputs_on


def says(heartbeat: Heartbeat | None) -> str:
    """State and outputs by a heartbeat, in words."""
    if heartbeat is None:
        return "it sends no heartbeat"
    return f"its heartbeat says {_state(heartbeat)}"


def _state(heartbeat: Heartbeat) -> str:
    faults = f" ({', '.join(fault_names(heartbeat.faults))})" if heartbeat.faults else ""
    return f"{heartbeat.state.name}{faults}, outputs {'on' if heartbeat.outputs_on else 'off'}"


def heard(node: Node, condition: Callable[[Heartbeat], bool], timeout: float) -> Heartbeat | None:
    """The next heartbeat of `node` for which `condition` holds; None if there is none within `timeout` s."""
    before = node.client.heartbeats.get(node.number)

    def came() -> bool:
        now = node.client.heartbeats.get(node.number)
        return now is not None and now is not before and condition(now)

    return node.client.heartbeats[node.number] if node.client.wait(came, timeout) else None


class _Unseen(DriveFailed):
    """Nobody has seen whether the outputs are off."""


def switch_off(node: Node) -> DriveState:
    """STOP `node` until a heartbeat shows its outputs off; returns the state that it is in then.

    Raises OutputsMayBeOn if that is never seen, after `TRIES` STOPs and the time that a watchdog takes; DriveFailed if
    it is seen, but the node did not do what STOP asks for. What a sink raises meanwhile keeps nothing from being sent;
    it is raised at the end.
    """
    client = node.client
    client.feed(node.number, on=False)
    troubles: list[str] = []
    lies: list[str] = []  # those of the troubles that are the node's own
    failure: Exception | None = None
    state: DriveState | None = None
    while state is None and len(troubles) < TRIES:
        try:
            state = _stop_once(node)
        except DriveFailed as lie:
            troubles.append(str(lie))
            if not isinstance(lie, _Unseen):
                lies.append(str(lie))
        except NoReply as error:
            why = str(error).partition(" tries")[2]
            troubles.append(f"{_name(node)} did not answer STOP{'' if HEARD in why else why}")
        except LinkError as error:
            troubles.append(f"STOP was not sent, or its answer not heard: {error}")
            if not _back(client):
                break
        except Exception as error:  # of a sink, which polling calls
            failure, client.sinks = failure or error, []
            troubles.append(f"STOP was interrupted: {error}")
    if state is None:
        state = _by_itself(node, troubles)
    if failure is not None:
        raise failure
    if lies:
        raise DriveFailed(f"{lies[0]}; it obeyed STOP only at attempt {len(troubles) + 1}")
    return state


def _stop_once(node: Node) -> DriveState:
    """One STOP; the state in which the node was then seen to be off. Raises DriveFailed if it was not, HbpError.

    _Unseen where no heartbeat came that could have shown it: the link may have lost them.
    """
    try:
        answer = node.command(Command.STOP)
    except Refused as refusal:
        raise DriveFailed(f"{_name(node)} refused STOP ({refusal})") from None
    if answer not in OFF:
        raise DriveFailed(f"{_name(node)} answered STOP with {answer.name}")
    since = node.client.now()
    if not node.client.wait(lambda: _all_off(node, since), 2 * HEARTBEATS if len(_heard(node)) > 1 else HEARTBEATS):
        silent = not any(came > since for came, _ in node.client.boots.get(node.number, {}).values())
        kind = _Unseen if silent else DriveFailed
        raise kind(f"{_name(node)} answered STOP with {answer.name}, but {_still(node, since)}")
    return node.client.heartbeats[node.number].state


def _heard(node: Node) -> list[tuple[float, Heartbeat]]:
    """When the newest heartbeat came of each boot that was heard lately, and what it says: two are two devices."""
    beats = node.client.boots.get(node.number, {}).values()
    return [each for each in beats if node.client.now() - each[0] <= HEARTBEATS]


def _all_off(node: Node, since: float) -> bool:
    """Whether each device that is heard as `node` has said after `since` that it is off."""
    beats = _heard(node)
    return bool(beats) and all(came > since and is_off(heartbeat) for came, heartbeat in beats)


def _still(node: Node, since: float) -> str:
    """Why it is not seen to be off, in words."""
    newest = max(node.client.boots.get(node.number, {}).values(), default=None, key=lambda each: each[0])
    if newest is None:
        return says(None)
    if newest[0] <= since:
        silent = node.client.now() - newest[0]
        return f"no heartbeat came for {silent:.1f} s, and the last one said {_state(newest[1])}"
    wrong = [heartbeat for came, heartbeat in _heard(node) if not (came > since and is_off(heartbeat))]
    return says(wrong[-1] if wrong else newest[1])


def _name(node: Node) -> str:
    return f"node {node.number} on {node.client.link.name}"


def _by_itself(node: Node, troubles: list[str]) -> DriveState:
    """Watch whether `node`, which no longer is fed, switches itself off. Raises OutputsMayBeOn or DriveFailed."""
    since = node.client.now()
    with suppress(HbpError):
        node.client.wait(lambda: _all_off(node, since), WATCHDOG)
    often = "" if len(troubles) == 1 else f" ({len(troubles)} tries)"
    if _all_off(node, since):
        raise DriveFailed(f"{troubles[-1]}{often}; now {says(node.client.heartbeats.get(node.number))}")
    raise OutputsMayBeOn(f"{UNSAFE}. {troubles[-1]}{often}; {_name(node)} was not confirmed off")


def _back(client: Client) -> bool:
    """Whether a link that is gone comes back in time for another STOP."""
    with suppress(LinkError):
        return client.wait(lambda: client.health.down_since is None, LINK_BACK)
    return False


class Vigil:
    """Looks at the heartbeats of a node that has been started, until it is stopped."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._began = self._came = node.client.now()
        self._newest = node.client.heartbeats.get(node.number)
        self._gaps = node.client.pauses, node.client.health.downtime
        """Pauses of this program and outages of its link: what came meanwhile is still to be looked at."""
        self._boot = node.identity.boot_id
        self._seen_running = False
        self._dark = 0  # heartbeats in a row that say RUNNING with outputs off: one may be the first of a fault

    def astray(self) -> str:
        """Why the node is not running under a watchdog as it should, in words; empty while it is.

        A fault, a reboot and a lost link have words of their own elsewhere: for them this is empty.
        """
        client = self._node.client
        now, heartbeat = client.now(), client.heartbeats.get(self._node.number)
        new = heartbeat is not self._newest
        gaps = client.pauses, client.health.downtime
        if client.health.down_since is not None or gaps != self._gaps or client.behind:
            self._came = self._began = now  # what it has said since START may still be on its way
        elif new:
            self._came = now
        self._newest, self._gaps = heartbeat, gaps
        if now - self._came > QUIET:
            return f"no heartbeat for {now - self._came:.1f} s: its state is unknown"
        if heartbeat is None or heartbeat.boot_id != self._boot or heartbeat.state == DriveState.FAULT:
            return ""
        if heartbeat.state == DriveState.RUNNING and heartbeat.outputs_on:
            self._seen_running, self._dark = True, 0
            return without_watchdog(heartbeat)
        if heartbeat.state == DriveState.RUNNING:
            self._dark += new
            return "" if self._dark < DARK else f"its outputs are off in RUNNING: {says(heartbeat)}"
        if self._seen_running or now - self._began > HEARTBEATS:
            return self.not_running(heartbeat)
        return ""

    def not_running(self, heartbeat: Heartbeat) -> str:
        """Why a heartbeat does not show RUNNING, in words; empty if it does, and in FAULT."""
        if heartbeat.state in (DriveState.RUNNING, DriveState.FAULT):
            return ""
        if self._seen_running:
            return f"left RUNNING without a fault and without a STOP from this program: {says(heartbeat)}"
        return f"did not start: START was answered RUNNING, but {says(heartbeat)}"


def why_unfed(node: Node, watchdog: float) -> str:
    """Why the watchdog of `node`, which waits `watchdog` s by what it tells, may have run out; never empty."""
    client, number = node.client, node.number
    if found := client.starved(number, watchdog):
        return found
    longest = client.longest_unfed(number)
    return (
        f"this host sent an ALIVE at least every {longest:.2f} s: the link lost them or carried them late, or the "
        f"drive's watchdog is shorter than the {watchdog:g} s that it tells"
    )


def without_watchdog(heartbeat: Heartbeat) -> str:
    """Why a node in ARMED or RUNNING must not be energised, in words; empty where its watchdog is at work."""
    if heartbeat.watchdog_ms != NO_WATCHDOG:
        return ""
    return (
        f"its watchdog is inactive (watchdog_ms = {NO_WATCHDOG} in {heartbeat.state.name}): nothing would switch it "
        "off if this program died"
    )
