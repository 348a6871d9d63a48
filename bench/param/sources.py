"""Where parameters come from: a device on a link, a dump, the beginning of a recorded run, a device's defaults."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from bench.device.client import Client
from bench.device.description import describe
from bench.device.node import Node
from bench.errors import BenchError, NodeError
from bench.files import RRD, RUN, is_run, run_folder
from bench.param import dump
from bench.param.table import ParameterEntry, Parameters, vocabulary
from bench.rig.connection import SIM, open_target
from bench.rig.lock import alone_on
from bench.rig.settings import Settings, read_settings
from protocol.errors import NoReply, Refused

DEFAULTS = "defaults"
RECONNECT = 30.0
"""s that a device which is lost while it is written to is waited for."""


@contextmanager
def connected(target: str, number: int | None = None, writes: bool = False) -> Iterator[Node]:
    """The device of a target: number `number`, None: the one that answers. With `writes` nobody else of this computer
    uses it meanwhile, and it is waited for where it is lost.

    The simulated drive has the configuration of bench.toml. Raises BenchError and HbpError where it cannot be had.
    """
    with alone_on(*([target] if writes else [])):
        settings = Settings(config=read_settings(None).config) if target == SIM else Settings()
        link = open_target(target, settings, "parameters")
        try:
            client = Client(link, RECONNECT if writes else 0.0)
            hello = client.connect()
            node = Node(client, hello.node if number is None else number)
            try:
                client.require_alone(node.identity.node)
            except (NoReply, Refused):
                there = f"node {hello.node} says that there are {hello.nodes}"
                raise NodeError(f"there is no node {number} on {target}: {there}") from None
            yield node
        finally:
            link.close()


def of_node(node: Node, target: str) -> Parameters:
    """All parameters of a device, asked one by one. Raises HbpError, and DeviceDefect for a value that cannot be."""
    identity = describe(node.identity)
    meanings, known = node.meanings(), vocabulary(identity["role"])
    entries = {}
    for record in node.descriptor.parameters:
        reply, name = node.parameter(record.name), record.name
        meaning = meanings.get(name) or (known[name].about if name in known else "")
        entries[name] = ParameterEntry(
            name, reply.value, record.unit.symbol, reply.default, reply.lo, reply.hi, record.flags, meaning
        )
    number = f", node {node.number}," if node.number != 1 else ""
    serial = f" (serial {identity['serial']})" if identity["serial"] else ""
    return Parameters(f"{identity['name']}{serial}{number} on {target}", entries, identity)


def of_run(path: Path) -> Parameters:
    """Those of the drive when a recorded run began. Raises BenchError where there is none."""
    from bench.record.reader import Run

    run = Run(run_folder(path) if path.suffix == RRD else path)
    known = vocabulary(str(run.info.identity.get("role", "")))
    entries = {}
    for name, value in run.info.parameters.items():
        entries[name] = ParameterEntry(name, value)
        if (record := known.get(name)) is not None:
            entries[name] = ParameterEntry(name, value, record.unit.symbol, flags=record.flags, meaning=record.about)
    return Parameters(str(path), entries, run.info.identity)


def defaults_of(parameters: Parameters) -> Parameters:
    """The same with their defaults as values. BenchError where they are not known."""
    if not any(entry.default is not None for entry in parameters.entries.values()):
        raise BenchError(f"{parameters.title} tells no defaults: compare a device with its defaults, by its target")
    entries = {
        name: replace(entry, value=entry.default)
        for name, entry in parameters.entries.items()
        if entry.default is not None
    }
    return Parameters(f"the defaults of {parameters.title}", entries, parameters.identity)


def is_recorded(source: str) -> bool:
    """Whether a source is a recorded run."""
    return source != SIM and (source.endswith((RUN, RRD)) or is_run(Path(source)))


def is_dump(source: str) -> bool:
    """Whether a source is a file."""
    return source != SIM and (source.endswith(".toml") or os.path.isfile(source))


def read(source: str, number: int | None = None) -> Parameters:
    """Parameters of a recorded run, a dump, or else of the device that a target names."""
    if is_recorded(source):
        return of_run(Path(source))
    if is_dump(source):
        return dump.read(Path(source)).parameters
    with connected(source, number) as node:
        return of_node(node, source)


def read_two(a: str, b: str, number: int | None = None) -> tuple[Parameters, Parameters]:
    """Two sources, of which one may be `defaults`: those of the other. Raises BenchError."""
    if a == b == DEFAULTS:
        raise BenchError("defaults are those of a device: give its target as the other side")
    if DEFAULTS in (a, b):
        known = read(b if a == DEFAULTS else a, number)
        return (defaults_of(known), known) if a == DEFAULTS else (known, defaults_of(known))
    return read(a, number), read(b, number)
