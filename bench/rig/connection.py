"""What a rig is connected to: a target's link, the drive at its end, and a load machine on this link or another.

`sim` is the simulated drive in virtual time, in this process but behind a link like every other; a new one for every
rig. Everything else is a target string of a link. Nothing here energises anything.
"""

from __future__ import annotations

import os
from contextlib import ExitStack
from zlib import crc32

from bench.device.client import Client
from bench.device.node import LOAD, Node
from bench.errors import BenchError
from bench.rig.settings import LOADS, Settings
from protocol.errors import NoReply
from protocol.links import Link, open_link
from protocol.messages import Role

SIM = "sim"
VARIABLE = "BENCH_TARGET"
"""Of the environment: it names the target where the command line does not."""


def chosen_target(settings: Settings) -> tuple[str, str]:
    """What $BENCH_TARGET, or else bench.toml, says, and which of them that is; two empty texts where neither does."""
    if named := os.environ.get(VARIABLE):
        return named, f"${VARIABLE}"
    return settings.target, str(settings.path) if settings.target else ""


def target_of(given: str | None, settings: Settings) -> str:
    """By option, environment, bench.toml; else the simulated drive."""
    return given if given is not None else chosen_target(settings)[0] or SIM


def open_target(target: str, settings: Settings, name: str = "") -> Link:
    """A link to `target`; for `sim` to a drive whose noise has the seed of `settings`, or one made of `name`.

    Raises LinkError, and BenchError for figures that the simulated drive cannot have, or a load machine that is not on
    its shaft.
    """
    if target != SIM:
        return open_link(target)
    if machine := load_target(settings):
        raise BenchError(f"load '{machine}' is not on the simulated drive's shaft: set load = \"node\", or a target")
    from sim.ports.virtual import ConfigError, open_virtual

    try:
        seed = crc32(name.encode()) if settings.seed is None else settings.seed
        return open_virtual(settings.config, settings.overrides, seed)
    except ConfigError as error:
        raise BenchError(str(error)) from None


def load_target(settings: Settings) -> str:
    """Target of a load machine on a link of its own; empty where the load is another one."""
    return "" if settings.load in LOADS or ".py:" in settings.load else settings.load


def find_drive(client: Client, target: str) -> Node:
    """The drive at the other end. BenchError for what is none, HbpError if nothing answers."""
    return _found(client, target, Role.DRIVE, "a drive")


def _found(client: Client, target: str, role: Role, what: str) -> Node:
    hello = client.connect()
    if hello.role != role:
        raise BenchError(f"{target} is a {hello.role.name}, not {what}")
    return Node(client, hello.node)


def second_node(client: Client) -> Node | None:
    """Node 2 on the drive's link, if it is there; on a bus only asking can tell."""
    node = Node(client, LOAD)
    if client.hello is not None and client.hello.nodes < LOAD and not client.session.wire.shared:
        return None
    try:
        return node if node.identity.node else None
    except NoReply:
        return None


def open_load_machine(target: str, stack: ExitStack) -> Node:
    """The load machine on a link of its own, which `stack` closes. BenchError for what is none, HbpError if silent."""
    link = open_link(target)
    stack.callback(link.close)
    return _found(Client(link), target, Role.LOAD, "a load machine")
