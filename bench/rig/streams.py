"""Sample streams as a rig configures them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from itertools import product

from bench.device.node import MAX_LATENCY_MS, Node
from bench.errors import BenchError, DoesNotFit
from bench.rig.envelope import Envelope
from bench.signal.units import pole_pairs
from protocol.canmap.host import CanWire
from protocol.descriptor import Channel
from protocol.framing import encoded_length
from protocol.signals import Flag, Unit
from protocol.streams import EDGE_RECORD, MAX_DECIMATION, STREAM_HEADER, StreamConfig

CORE = ("hall", "status", "i_a", "i_d", "i_q")
"""What is streamed, beside reference and estimates, where a link cannot carry everything."""
_TOLERANCE = 1e-4  # rates are printed with six digits
_USABLE = 0.9  # of a byte link; replies are in the rest
_HEARTBEATS = 20 * encoded_length(44)  # bytes/s: a drive's and a load machine's, ten a second each
_LEAST = 0.1  # of a link, that samples get however many edges there are


def decimation_of(pwm_hz: int, rate_hz: float | None) -> int:
    """Return the decimation that makes this rate, 1 for None. Raises BenchError, naming the nearest, if none does."""
    if rate_hz is None:
        return 1
    decimation = round(pwm_hz / rate_hz)
    if decimation > MAX_DECIMATION:
        raise BenchError(f"--rate {rate_hz:g} Hz is too low; the lowest is {pwm_hz / MAX_DECIMATION:g} Hz")
    if decimation < 1 or not math.isclose(pwm_hz / decimation, rate_hz, rel_tol=_TOLERANCE):
        near = pwm_hz / max(decimation, 1)
        raise BenchError(f"--rate {rate_hz:g} Hz is not the PWM rate over a whole number; the nearest is {near:g} Hz")
    return decimation


def most_channels(node: Node, needed: frozenset[str]) -> list[tuple[Channel, ...]]:
    """The most channels of a drive, those `needed` among them, and the fewest that a measurement can do with."""
    known = [c for c in node.descriptor.channels if c.name in needed or not c.flags & Flag.TRUTH]
    wanted = needed.union(CORE)
    usual = [c for c in known if c.name in wanted or not c.flags & Flag.ON_REQUEST]
    for unit, flags in product((Unit.RAD, Unit.RAD_PER_S), (Flag.REFERENCE, Flag.REFERENCE | Flag.ESTIMATE)):
        if not any(c.unit == unit and c.flags & flags for c in usual):  # but on request: then it is asked for
            usual += [c for c in known if c.unit == unit and c.flags & flags]
    channels = tuple(c for c in known if c in usual)
    core = tuple(c for c in channels if c.name in wanted or c.flags & (Flag.REFERENCE | Flag.ESTIMATE))
    return [channels or node.channels(None), core]


def configure(
    node: Node,
    choices: Sequence[tuple[Channel, ...]],
    decimation: int = 1,
    slower: bool = False,
    edges_per_s: float = 0.0,
) -> StreamConfig:
    """Configure the sample stream with the first of `choices` that the link carries at `decimation`.

    With `slower` the last one may come at the highest rate that fits, beside `edges_per_s` Hall edges and the
    heartbeats. Raises DoesNotFit, with what would fit, and NodeError for channels or a rate that the node refuses.
    """
    for channels in choices[:-1]:
        with suppress(DoesNotFit):
            return node.set_samples(channels, decimation)
    channels = choices[-1]
    try:
        return node.set_samples(channels, decimation)
    except DoesNotFit as error:
        if not slower or not error.decimation:
            raise
        config = node.set_samples(channels, error.decimation)
        while (enough := _decimation_beside(node, config, edges_per_s)) > config.decimation:
            config = node.set_samples(channels, enough)
        return config


def edge_rate(node: Node, envelope: Envelope) -> float:
    """Hall edges a second at the speed of `envelope`; 0 where that, or the number of pole pairs, is not known."""
    if not math.isfinite(envelope.rpm) or not node.has_parameter("n_p"):
        return 0.0
    n_p = pole_pairs({"n_p": node.parameter("n_p").value})
    return 6 * (n_p or 0) * envelope.rpm / 60


def _decimation_beside(node: Node, config: StreamConfig, edges_per_s: float) -> int:
    """The decimation at which the link carries samples as in `config`, and edges and heartbeats that come beside them.

    A device counts an edge stream as one frame in each latency, whatever the speed, and its heartbeats not at all
    (SPEC, chapter 11). On CAN it counts 1000 edges a second, and the worst case of everything: enough.
    """
    if node.load <= 0.0 or isinstance(node.client.session.wire, CanWire):
        return config.decimation
    frame = encoded_length(STREAM_HEADER.size + config.block * config.dtype.itemsize)
    frames_per_s = config.rate / config.block
    edge_frame = encoded_length(STREAM_HEADER.size + EDGE_RECORD.itemsize)
    latest = 1000 / MAX_LATENCY_MS  # frames a second of either stream, at least
    link = (frame * frames_per_s + edge_frame * latest) / node.load  # bytes/s
    edge_frames = min(edges_per_s, frames_per_s + latest)  # they go out before samples
    edges = edges_per_s * EDGE_RECORD.itemsize + edge_frames * (edge_frame - EDGE_RECORD.itemsize)
    room = max(_USABLE * link - _HEARTBEATS - edges, _LEAST * link)
    return min(math.ceil(config.decimation * frame * frames_per_s / room), MAX_DECIMATION)
