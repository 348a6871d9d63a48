"""How a run ends: every step is tried whatever another raises, and a node gets back what it had. Nothing energises."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial

from bench.device.node import Node
from protocol.messages import Empty, StreamInfo, StreamReply, StreamSet, StreamStart


def failures_of(steps: Iterable[Callable[[], object]]) -> list[Exception]:
    """Take every step, whatever one of them raises; return what was raised, in that order."""
    failures: list[Exception] = []
    for step in steps:
        try:
            step()
        except Exception as error:
            failures.append(error)
    return failures


def try_all(steps: Iterable[Callable[[], object]]) -> None:
    """The same, but raise the first of that at the end."""
    for failure in failures_of(steps):
        raise failure


def put_back(node: Node, before: dict[str, float]) -> None:
    """Set the parameters of `node` to the values `before`, in that order, and take out of it what was set.

    If one cannot be restored, it stays in `before` and the others still are; the first error is raised at the end.
    """

    def set_one(name: str) -> None:
        node.set(name, before[name])
        del before[name]

    try_all([partial(set_one, name) for name in before])


def put_streams_back(node: Node, before: Iterable[StreamInfo]) -> None:
    """End the streams of `node`, and configure and start again those that there were `before`. Raises HbpError."""
    node.stop_streams()
    for told in before:
        asked = StreamSet(told.stream, told.event, told.decimation, told.max_latency_ms, told.channels)
        node.client.request(asked, node.number, StreamReply)
        if told.running:
            node.client.request(StreamStart(1 << told.stream), node.number, Empty)


def not_put_back(before: Mapping[str, float], where: str = "") -> str:
    """What `put_back` has left of `before`, as a part of a sentence; empty where that is nothing."""
    names = ", ".join(f"{name} (was {value:g})" for name, value in before.items())
    return f"; not restored{where}: {names}" if names else ""
