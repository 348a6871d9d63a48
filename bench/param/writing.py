"""Setting parameters all or none: what is wrong is found before, and what was set goes back where one is refused.

Nothing is stored for the next boot before all of it was read back, so a device that loses its power meanwhile has the
old parameters or the new ones; it is waited for, and looked at.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from enum import Enum
from typing import NamedTuple, NoReturn

from bench.device.client import POLL
from bench.device.node import Node
from bench.errors import BenchError, DriveFailed, Interrupted, NodeError
from bench.param import history
from bench.param.sources import RECONNECT, of_node
from bench.param.table import ParameterEntry, Parameters, same, shortest
from bench.rig.interrupts import undisturbed
from bench.rig.restore import not_put_back, put_back
from protocol.errors import HbpError, LinkError
from protocol.messages import DriveState, Feature
from protocol.signals import Flag
from protocol.text import counted

SETTLE = 0.5  # s after which a link that has failed once tells whether it is gone


class Why(NamedTuple):
    """Why something is changed, and by which command."""

    reason: str = ""
    by: str = "set"


class NotPutBack(BenchError):
    """A parameter could not be set, and not all of the others have their old values again."""


def check(parameters: Parameters, wanted: Mapping[str, float]) -> None:
    """Raise BenchError, naming all that the device would refuse whatever its state; nothing is sent."""
    wrong = [words for name, value in wanted.items() if (words := _refused(parameters.entry(name), value))]
    if wrong:
        raise BenchError("; ".join(wrong) + ("; nothing was set" if len(wanted) > 1 else ""))


def _refused(entry: ParameterEntry, value: float) -> str:
    name, unit = entry.name, f" {entry.unit}" if entry.unit else ""
    if entry.flags & Flag.READ_ONLY:
        return f"{name} can only be read"
    if entry.flags & Flag.WHOLE and value != round(value):
        return f"{name} must be a whole number, got {shortest(value)}"
    if entry.lo is None or entry.hi is None or entry.lo <= _within(entry, value) <= entry.hi:
        return ""
    return f"{name} must be {shortest(entry.lo)} to {shortest(entry.hi)}{unit}, got {shortest(value)}"


def write(node: Node, before: Parameters, wanted: Mapping[str, float]) -> dict[str, float]:
    """Set all of these and read them back; returns what the device stored, by name.

    A value that is refused is tried again after the others, because limits may depend on each other. Where one stays
    refused, or is read back as something else, all get the values `before`: NodeError says which and why, NotPutBack
    what could not be put back. HbpError where the link is lost: what the device has then is for the caller to see.
    """
    check(before, wanted)
    idle = [name for name in wanted if before.entry(name).flags & Flag.IDLE_ONLY]
    if idle and node.state == DriveState.RUNNING:
        raise NodeError(
            f"node {node.number} is RUNNING and takes {', '.join(idle)} only with its outputs off: stop it first; "
            "nothing was set"
        )
    left, stored = {name: _within(before.entry(name), value) for name, value in wanted.items()}, dict[str, float]()
    try:
        while left:
            done, refusal = len(stored), None
            for name, value in list(left.items()):
                try:
                    stored[name] = node.set(name, value)
                    del left[name]
                except NodeError as error:
                    refusal = refusal or error
            if refusal is not None and len(stored) == done:
                raise refusal
        for name, value in stored.items():
            if not same(now := node.parameter(name).value, value):
                raise NodeError(f"{name} was set to {shortest(value)} and is read back as {shortest(now)}")
    except NodeError as error:
        undo(node, {name: before[name] for name in reversed(list(stored))}, error)
    except (KeyboardInterrupt, Interrupted):
        with undisturbed(), suppress(BenchError, HbpError):
            put_back(node, {name: before[name] for name in reversed(list(wanted))})
        raise
    return stored


def undo(node: Node, old: dict[str, float], error: BenchError) -> NoReturn:
    """Put back these values, in that order, and raise `error` with what came of that."""
    count = len(old)
    try:
        with undisturbed():
            put_back(node, old)
    except (BenchError, HbpError) as reason:
        raise NotPutBack(f"{error}; {reason}{not_put_back(old)}") from None
    again = f"; {counted(count, 'parameter')} set before it {'have' if count > 1 else 'has'} the old value again"
    raise type(error)(f"{error}{again if count else ''}") from None


def _within(entry: ParameterEntry, value: float) -> float:
    """The value, and where it is a limit as float32 the limit itself: a decimal may lie beyond it."""
    for limit in (entry.lo, entry.hi):
        if limit is not None and same(value, limit):
            return limit
    return value


def keep(parameters: Parameters, node: Node, asked: Mapping[str, float], stored: Mapping[str, float], why: Why) -> str:
    """Keep why these were changed from what they were in `parameters`; returns what a person should know of that.

    Raises BenchError where the reason cannot be kept.
    """
    changed = {name: value for name, value in stored.items() if not same(value, parameters[name])}
    rounded = [name for name, value in stored.items() if not same(value, asked[name])]
    if not parameters.serial:
        return "the device tells no serial number: the reason is not kept" if why.reason else ""
    when, who = history.now(), history.who()
    history.add(
        parameters.serial,
        (
            history.Changed(when, who, node.number, name, parameters[name], asked[name], stored[name], *why)
            for name in parameters
            if name in changed or name in rounded
        ),
    )
    return ""


class Has(Enum):
    """What a device was seen to have after something went wrong."""

    OLD = "the old parameters"
    NEW = "the new parameters, all of them"
    MIXED = "some of the old parameters and some of the new"


def what_it_has(device: Parameters, old: Mapping[str, float], new: Mapping[str, float]) -> Has:
    """Which of two sets of values, of the same names, a device has."""
    if all(same(device[name], value) for name, value in new.items()):
        return Has.NEW
    return Has.OLD if all(same(device[name], old[name]) for name in new) else Has.MIXED


def carry_out(
    node: Node, device: Parameters, wanted: Mapping[str, float], save: bool, say: Callable[[str], None], why: Why
) -> dict[str, float]:
    """Write these to a device whose parameters are `device`, read them back, with `save` have all of them stored.

    Returns what the device made of each, by name. BenchError where it refuses, with everything as it was. A device that
    is lost meanwhile is waited for and looked at: it is well if it has all of the new values, else DriveFailed says
    what it has. `say` tells a person what happens.
    """
    boot = node.identity.boot_id
    if save:
        require_store(node)
    try:
        stored = write(node, device, wanted)
        if save:
            _store(node, device, wanted)
    except HbpError as error:
        say(f"{error}; waiting up to {RECONNECT:g} s for the device")
        now = _after_loss(node, device.title, error)
        stored = {name: now.entry(name).value for name in wanted}
        _look_at(node, device, wanted, now, save, boot, error, say)
    if words := keep(device, node, wanted, stored, why):
        say(words)
    return stored


def require_store(node: Node) -> None:
    """Raise NodeError where a device cannot store parameters."""
    if not node.identity.features & Feature.COMMIT:
        raise NodeError(f"node {node.number} cannot store parameters (feature COMMIT): without --save they last until "
                        "it loses power")  # fmt: skip


def _store(node: Node, before: Parameters, wanted: Iterable[str]) -> None:
    """Have all stored; NodeError, with the old values put back, where the device refuses that."""
    try:
        node.store()
    except NodeError as error:
        undo(node, {name: before[name] for name in reversed(list(wanted))}, error)


def _after_loss(node: Node, title: str, error: HbpError) -> Parameters:
    """What a device has that was lost, once it is back; DriveFailed where it does not come back."""
    client = node.client
    node.forget()
    end = client.now() + RECONNECT
    while client.now() < end:
        with suppress(LinkError):
            client.wait(lambda: client.health.down_since is None, max(end - client.now(), POLL))
            client.run_for(SETTLE)
            if client.health.down_since is not None:
                continue
            try:
                return of_node(node, title)
            except HbpError:
                node.forget()
    raise DriveFailed(
        f"{error}; {title} did not come back within {RECONNECT:g} s, and what it has is not known: look at it with "
        "bench param list, or bench param load FILE TARGET --check, when it is back"
    )


def _look_at(
    node: Node,
    before: Parameters,
    wanted: Mapping[str, float],
    now: Parameters,
    save: bool,
    boot: int,
    error: HbpError,
    say: Callable[[str], None],
) -> None:
    """A device is back and has the parameters `now`: return if they are the new ones; DriveFailed, which says what."""
    if now.serial != before.serial:
        raise DriveFailed(
            f"{error}; then another device came: {now.title}, not {before.title}; nothing was written to it"
        )
    restarted = node.identity.boot_id != boot
    how = "the device has restarted" if restarted else "the link is back, and the device has not restarted"
    has = what_it_has(now, before, wanted)
    if has is Has.NEW:
        if save and not restarted:
            _store(node, before, wanted)  # whether the first request arrived is not known
        say(f"{how}: it has {has.value}")
        return
    if has is Has.MIXED and not restarted:
        old = {name: before[name] for name in reversed(list(wanted)) if not same(now[name], before[name])}
        undo(node, old, DriveFailed(f"{error}; {how}: it had {has.value}"))
    again = "nothing of the new ones is stored; write them again" if has is Has.OLD else "compare it with your file"
    raise DriveFailed(f"{error}; {how}: it has {has.value}; {again}")
