"""DBC files, by which other CAN tools read the streams on a bus.

Only samples and edges are described, a frame of which stands alone; HBP's messages take several frames, for which DBC
has no words. This module reads how streams are configured and changes nothing in a device; it decodes no frames.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from cantools.database import Database
from cantools.database.can import Message, Signal
from cantools.database.can import Node as Sender
from cantools.database.can.formats.dbc import DbcAttribute, DbcAttributeDefinition, DbcSpecifics
from cantools.database.conversion import BaseConversion

from bench.device.client import Client
from bench.device.node import Node
from bench.device.scan import scan
from bench.errors import BenchError
from protocol.canmap.frame import EXTENDED_MASK, BusRates
from protocol.canmap.host import CanWire
from protocol.canmap.ids import STREAM_SLOTS, CanClass, CanId, stream_id
from protocol.canmap.layout import EDGE_BYTES, sample_layout
from protocol.errors import NoReply, TargetError
from protocol.links import CanTarget, open_link, parse_target
from protocol.messages import StreamEvent
from protocol.streams import StreamConfig

ENCODING = "cp1252"
"""Of a DBC file."""


_NAME = 32  # characters that every tool allows a name
_NODE_NAME = _NAME - len("_samples_15")
_CHANNEL_NAME = _NAME - len("_59")
_RESERVED = frozenset(
    "auto bool break case char const continue default do double else enum extern false float for goto if "  # noqa: SIM905
    "inline int long register restrict return short signed sizeof static struct switch true typedef union unsigned "
    "void volatile while FILTER VERSION".split()
)
"""Words of C, and those of DBC that are valid names: tools make C out of a DBC file."""

_FORMATS = ["StandardCAN", "ExtendedCAN", "reserved", "J1939PG", *["reserved"] * 10, "StandardCAN_FD", "ExtendedCAN_FD"]


class NodeStream(NamedTuple):
    """A stream of a device: the device's name, and the stream as it is configured."""

    name: str
    config: StreamConfig


class _Frame(NamedTuple):
    """One kind of frame. `periods`: PWM periods from one to the next, 0 where they come as something happens."""

    can_id: CanId
    length: int
    signals: list[Signal]
    comment: str
    periods: int


def dbc_text(streams: Sequence[NodeStream], rates: BusRates, extended: bool) -> str:
    """Return the DBC of the frames of these streams, in characters that `ENCODING` has.

    One message a group of channels, `NODE_samples_0`, `NODE_samples_1`, …, and one an edge stream, `NODE_edges_0`.
    Where a frame holds several samples, the signals of the n-th one end in `_n`, from 0 on.
    """
    nodes = list(dict.fromkeys((stream.config.node, stream.name) for stream in streams))
    names = dict(zip(nodes, _identifiers([name for _, name in nodes], _NODE_NAME), strict=True))
    count: Counter[str] = Counter()
    messages = []
    for stream in streams:
        edges = stream.config.event == StreamEvent.EDGES
        sender = names[stream.config.node, stream.name]
        stem = f"{sender}_{'edges' if edges else 'samples'}"
        for frame in [_edges(stream)] if edges else _samples(stream, rates.fd):
            messages.append(
                Message(
                    frame.can_id.pack(extended) & EXTENDED_MASK,
                    f"{stem}_{count[stem]}",
                    frame.length,
                    frame.signals,
                    comment=frame.comment,
                    senders=[sender],
                    cycle_time=_whole_ms(frame.periods, stream.config.pwm_hz),
                    is_extended_frame=extended,
                    is_fd=rates.fd,
                )
            )
            count[stem] += 1
    specifics = DbcSpecifics()
    specifics.attribute_definitions["VFrameFormat"] = DbcAttributeDefinition(
        "VFrameFormat", "StandardCAN", "BO_", "ENUM", choices=_FORMATS
    )
    if rates.fd:
        bus_type = DbcAttributeDefinition("BusType", "CAN", type_name="STRING")
        specifics.attribute_definitions["BusType"] = bus_type
        specifics.attributes["BusType"] = DbcAttribute("CAN FD", bus_type)
    database = Database(messages, [Sender(name) for name in names.values()], version="", dbc_specifics=specifics)
    return database.as_dbc_string(sort_signals=None, sort_attribute_signals=None)


def _samples(stream: NodeStream, fd: bool) -> Iterator[_Frame]:
    """Give the frames of a stream of samples, one a group of channels."""
    config = stream.config
    dtypes = [np.dtype(channel.raw.dtype) for channel in config.channels]
    widths = [dtype.itemsize for dtype in dtypes]
    layout = sample_layout(widths, fd, config.block)
    counter = "index" if fd else "ctr"
    names = _identifiers([channel.name for channel in config.channels], _CHANNEL_NAME, taken=counter)
    members = list(zip(config.channels, names, dtypes, accumulate(widths), strict=True))
    about = _about_samples(stream, fd, layout.samples)
    for group, (first, last) in enumerate(layout.groups):
        signals = [Signal(counter, 0, 8 * layout.counter)]
        for sample in range(layout.samples):
            start = layout.counter + sample * (last - first) - first
            signals += [
                Signal(
                    f"{name}_{sample}" if layout.samples > 1 else name,
                    8 * (start + end - dtype.itemsize),
                    8 * dtype.itemsize,
                    is_signed=dtype.kind != "u",
                    conversion=BaseConversion.factory(channel.scale, channel.offset, is_float=dtype.kind == "f"),
                    unit=channel.unit.symbol.replace("Ω", "Ohm"),
                )
                for channel, name, dtype, end in members
                if first < end <= last
            ]
        yield _Frame(
            stream_id(config.node, (config.slot + group) % STREAM_SLOTS),
            layout.length(group),
            signals,
            f"Stream {config.stream} of node {config.node}, part {group + 1} of {len(layout.groups)}: {about}",
            layout.samples * config.decimation,
        )


def _about_samples(stream: NodeStream, fd: bool, samples: int) -> str:
    """Say how often there is a sample, and how to get from the counter to index and tick."""
    config = stream.config
    counter, bits, counted, step = ("index", 32, "index", config.decimation) if fd else ("ctr", 16, "number", 1)
    which = "the sample" if samples == 1 else f"sample _0, that of _1 is {step} more, and so on to _{samples - 1}"
    index = "" if fd else f"; index = number * {config.decimation}"
    means = ", each the mean since the last" if config.event == StreamEvent.MEAN else ""
    return (
        f"{config.rate:g} samples/s, decimation {config.decimation}{means}. "
        f"{counter}: low {bits} bits of the {counted} of {which}{index}; "
        f"tick = {config.tick0} + index * {config.period_ticks}, at {config.tick_hz} ticks/s; "
        "index counts PWM periods."
    )


def _edges(stream: NodeStream) -> _Frame:
    """Return the frame of a stream of edges."""
    config = stream.config
    signals = [
        Signal("tick", 0, 32),
        Signal("hall_old", 32, 3),
        Signal("hall_new", 35, 3),
        Signal("illegal", 38, 1),
        Signal("ctr", 40, 8),
        Signal("encoder", 48, 16, unit="counts"),
    ]
    comment = (
        f"Stream {config.stream} of node {config.node}: one frame per Hall edge. tick: low 32 bits, at "
        f"{config.tick_hz} ticks/s; hall_old, hall_new: code before and after, bit 0 = sensor a; illegal: no step to a "
        "neighbour; ctr: low 8 bits of the number of the edge since boot; encoder: its count at the edge."
    )
    return _Frame(CanId(CanClass.EDGES, config.node, config.slot), EDGE_BYTES, signals, comment, 0)


def _whole_ms(periods: int, pwm_hz: int) -> int | None:
    """Return a time as a DBC file can hold it, None if it cannot."""
    ms, rest = divmod(1000 * periods, pwm_hz)
    return ms if ms and not rest else None


def _identifiers(names: Sequence[str], most: int, taken: str = "") -> list[str]:
    """Return a C identifier of at most `most` characters for each name, no two alike and none like `taken`."""
    made: list[str] = []
    for name in names:
        stem = re.sub(r"\W", "_", name, flags=re.ASCII).strip("_") or "unnamed"
        if stem[0].isdigit():
            stem = f"_{stem}"
        elif stem in _RESERVED:
            stem = f"{stem}_"
        one, number = stem[:most], 1
        while one == taken or one in made:
            number += 1
            one = f"{stem[: most - len(str(number)) - 1]}_{number}"
        made.append(one)
    return made


def configured_streams(client: Client, nodes: Iterable[int]) -> list[NodeStream]:
    """Return the streams that are configured at present in these nodes, by whomever; none is touched.

    Raises:
        NoReply: no device answers.
        RemoteProtocolError: a device lays its frames out otherwise than HBP does, or sends others than this bus's.
        LinkError: the link was lost.
    """
    streams = []
    for number in nodes:
        node = Node(client, number)
        try:
            identity = node.identity
        except NoReply:
            continue
        for config in node.active_streams():
            client.session.decoder(config)  # raises where the layouts differ
            streams.append(NodeStream(identity.name, config))
    return streams


def target_dbc(target: str) -> str:
    """Return the DBC of what the devices on a CAN bus are configured to stream at present.

    Raises:
        BenchError: none of them has a stream.
        TargetError: the target is no CAN bus.
        HbpError: as `configured_streams`; or the link cannot be opened.
    """
    named = parse_target(target)
    if not isinstance(named, CanTarget):
        raise TargetError(f"{target} is not a CAN bus, and a DBC file describes CAN frames: use can:socketcan/can0")
    link = open_link(named)
    try:
        nodes = sorted({reply.node for reply in scan(link)})
        client = Client(link)
        if not nodes:
            client.connect()  # says what to look at when nobody is there
        streams = configured_streams(client, nodes)
        wire = client.session.wire
        assert isinstance(wire, CanWire)
    finally:
        link.close()
    if not streams:
        raise BenchError(f"no device on {link.name} is configured to stream: start `bench live` on it first")
    return dbc_text(streams, wire.rates, named.extended)
