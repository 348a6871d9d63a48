"""What a link's nodes say of themselves, as plain data: identity, health, channels, parameters. Reads only."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from typing import Any

import numpy as np

from bench.device.bus import BusMeter
from bench.device.client import Client
from bench.device.node import Node
from bench.device.scan import scan
from bench.errors import NodeError
from bench.files import finite
from protocol.canmap.host import CanWire
from protocol.canmap.plan import BusPlan
from protocol.codes import fault_names
from protocol.descriptor import Channel
from protocol.errors import NoReply, Refused, RemoteProtocolError
from protocol.links import open_link
from protocol.links.target import MAX_NODE
from protocol.messages import Feature, Heartbeat, HelloReply, Role
from protocol.signals import Flag

FEW = 4  # nodes that are asked one by one; of more it is looked first which are there
SCAN_SECONDS = 0.6  # for which further nodes on a bus are waited for
BUS_SECONDS = 1.0  # for which a bus is watched


def inspect_link(target: str) -> dict[str, Any]:
    """All nodes on the link of `target` and, on CAN, the bus, as plain data without numbers that are not finite.

    `unread` says why nodes that should be there could not be read, by their number. Raises LinkError, NoReply,
    DeviceDefect (of the first node) or TargetError.
    """
    link = open_link(target)
    try:
        client = Client(link)
        shared = client.session.wire.shared
        there = {reply.node for reply in scan(link, SCAN_SECONDS)} if shared else set()
        hello = client.connect()
        announced = set(range(1, min(hello.nodes, MAX_NODE if shared else hello.nodes) + 1))
        if hello.nodes > FEW and not shared:  # each that is not there would be waited for
            there = {reply.node for reply in scan(link)}
        numbers = there | {hello.node} if there else announced | {hello.node}
        first = Node(client, hello.node)
        missing = sorted(announced - numbers)
        words = f"node {hello.node} announces {hello.nodes} nodes, of which {_spans(missing)} did not answer"
        nodes, unread = [], dict.fromkeys(missing, words)
        client.listen(hello.node)
        for number in sorted(numbers):
            try:
                client.require_alone(number)
                nodes.append(inspect_node(first if number == hello.node else Node(client, number)))
            except (NoReply, Refused, RemoteProtocolError, NodeError) as error:
                if number == hello.node:
                    raise
                unread[number] = str(error)
        bus = inspect_bus(client, first)
        found: dict[str, Any] = finite({"target": target, "nodes": nodes, "unread": unread, "bus": bus})
        return found
    finally:
        link.close()


def _spans(numbers: Iterable[int]) -> str:
    """Numbers in words: 2 to 7, 9."""
    spans: list[tuple[int, int]] = []
    for n in numbers:
        spans = [*spans[:-1], (spans[-1][0], n)] if spans and spans[-1][1] == n - 1 else [*spans, (n, n)]
    return ", ".join(f"{first} to {last}" if first < last else f"{first}" for first, last in spans)


def inspect_bus(client: Client, drive: Node) -> dict[str, Any] | None:
    """Load and traffic of a CAN bus as it is now, and which streams of the drive's channels fit; None on others."""
    wire = client.session.wire
    if not isinstance(wire, CanWire):
        return None
    streamed: tuple[Channel, ...] = ()
    meter = BusMeter(client)
    client.run_for(BUS_SECONDS)
    plan = BusPlan(wire.rates, wire.extended, drive.identity.pwm_hz)
    with suppress(NodeError):  # none is streamed unless it is asked for
        streamed = drive.channels(None)
    widths = [np.dtype(channel.raw.dtype).itemsize for channel in streamed]
    fits = [{"channels": f.channels, "rate_hz": f.rate, "load": f.load} for f in plan.choices(widths)]
    return (meter.report() or {}) | {"fits": fits, "fits_node": drive.number}


def inspect_node(node: Node) -> dict[str, Any]:
    """One node, as plain data in SI units; `odd` says what is strange about it."""
    found = {
        "identity": describe(node.identity),
        "health": _health(node.next_heartbeat()),
        "channels": [
            {
                "id": channel.id,
                "name": channel.name,
                "unit": channel.unit.symbol,
                "type": channel.raw.name.lower(),
                "scale": channel.scale,
                "offset": channel.offset,
                "flags": _flags(channel.flags),
            }
            for channel in node.descriptor.channels
        ],
        "parameters": [
            {
                "id": record.id,
                "name": record.name,
                "unit": record.unit.symbol,
                "value": reply.value,
                "default": reply.default,
                "lo": reply.lo,
                "hi": reply.hi,
                "flags": _flags(record.flags),
            }
            for record, reply in zip(node.descriptor.parameters, node.parameter_replies().values(), strict=True)
        ],
    }
    return found | {"odd": _odd(found)}


def _odd(node: dict[str, Any]) -> list[str]:
    """What a firmware engineer would want to know of a node as `inspect_node` describes it."""
    found = []
    if "heartbeat" in node["health"]:
        found.append("no heartbeat in 0.5 s; SPEC asks for one every 100 ms: does the main loop run?")
    if node["identity"]["role"] not in (Role.DRIVE.name.lower(), Role.LOAD.name.lower()):
        found.append(f"its {node['identity']['role']} is not in SPEC")
    for row in (*node["channels"], *node["parameters"]):
        if row["unit"].startswith("unit "):
            found.append(f"{row['name']}: {row['unit']} is not in SPEC")
    for parameter in node["parameters"]:
        name, value, lo, hi = (parameter[key] for key in ("name", "value", "lo", "hi"))
        for what in ("value", "default"):
            if not lo <= parameter[what] <= hi:
                found.append(f"{name}: its {what} {parameter[what]:.6g} is not in {lo:.6g} … {hi:.6g}")
        if "whole" in parameter["flags"] and not float(value).is_integer():
            found.append(f"{name} = {value:.6g} is not a whole number, although its flag says WHOLE")
    return found


def _health(heartbeat: Heartbeat | None) -> dict[str, Any]:
    if heartbeat is None:
        return {"heartbeat": "none within 0.5 s"}
    return {
        "state": heartbeat.state.name,
        "outputs_on": heartbeat.outputs_on,
        "faults": fault_names(heartbeat.faults),
        "first_fault": fault_names(heartbeat.first_fault),
        "frames_dropped": heartbeat.tx_dropped,
        "frames_damaged": heartbeat.rx_bad,
        "setpoints_rejected": heartbeat.setpoints_rejected,
    }


def _flags(flags: Flag) -> str:
    kinds = Flag.CHANNEL | Flag.PARAMETER
    return ", ".join((flag.name or "").lower().replace("_", " ") for flag in Flag if flag & flags & ~kinds)


def describe(identity: HelloReply) -> dict[str, Any]:
    """A node's identity as plain data."""
    return {
        "name": identity.name,
        "firmware": identity.firmware,
        "serial": identity.serial,
        "build": identity.build,
        "node": identity.node,
        "role": identity.role.name.lower(),
        "boot_id": f"{identity.boot_id:08x}",
        "protocol": f"{identity.major}.{identity.minor}",
        "schema_crc": f"{identity.schema_crc:08x}",
        "tick_hz": identity.tick_hz,
        "pwm_hz": identity.pwm_hz,
        "features": [feature.name.lower() for feature in Feature if feature & identity.features and feature.name],
        "nodes": identity.nodes,
    }
