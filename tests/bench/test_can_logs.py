"""What other tools make of our frames: cantools by our DBC, and python-can's log formats.

The numbers to agree with are those that the host got while the simulated drive streamed to it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import can
import cantools
import numpy as np
import pytest
from collect import Bench

from bench.device.dbc import NodeStream, configured_streams, dbc_text
from bench.device.node import Node
from protocol.canmap.frame import CAN_RECORD, EXTENDED, BusRates
from protocol.links.can_message import to_messages, to_record
from protocol.streams import EdgeChunk, SampleChunk
from sim.config.params import load_params
from sim.ports.device import SimulatedDevice
from sim.ports.networks import CanNetwork
from sim.ports.virtual import VirtualLink
from tests.choice import sampled

pytestmark = pytest.mark.slow

EPOCH = 1_700_000_000.0  # s: when a recording begins, for formats that want a date

Chunk = SampleChunk | EdgeChunk
Database = cantools.database.can.Database
Message = cantools.database.can.Message


@dataclass(frozen=True)
class Case:
    """What is streamed, on what kind of bus. `load`: the load machine streams all it has, 500 times a second."""

    rates: BusRates
    names: tuple[str, ...] | None
    decimation: int
    extended: bool = False
    load: bool = False


CASES = {
    "classic, two groups": Case(
        BusRates(1_000_000), ("hall", "theta_enc", "i_a", "i_b", "i_c", "omega_enc"), 8, load=True
    ),
    "classic, three samples": Case(BusRates(1_000_000), ("i_a",), 1),
    "extended": Case(BusRates(1_000_000), ("status", "i_d", "i_q"), 4, extended=True, load=True),
    "FD, six samples": Case(BusRates(1_000_000, 5_000_000), ("hall", "status", "theta_vt", "i_a", "i_b"), 1),
    "FD, all channels": Case(BusRates(1_000_000, 8_000_000), None, 4, load=True),
    "FD, extended": Case(
        BusRates(1_000_000, 4_000_000),
        ("hall", "theta_enc", "omega_enc", "i_a", "i_b", "i_c", "u_dc", "i_d", "i_q"),
        2,
        extended=True,
        load=True,
    ),
}


class StreamingBench:
    """A simulated bench in virtual time that streams as a case says, and a second adapter that hears the bus."""

    def __init__(self, case: Case) -> None:
        self.case = case
        network = CanNetwork(case.rates, case.extended)
        self.heard: list[bytes] = []
        network.bus.attach(lambda: b"", self.heard.append, "second adapter")
        self.host = Bench(VirtualLink(SimulatedDevice(load_params(), 1, network=network)))

    def start(self) -> list[NodeStream]:
        """Start the drive, against a torque, and when it turns the streams; return these."""
        host, case = self.host, self.case
        host.turn(60.0)
        host.load.arm()
        host.load.start()
        host.load.torque(0.3)
        host.client.run_for(0.3)
        if case.load:
            machine = Node(host.client, 2)
            machine.set_samples(machine.descriptor.channels, 32)
            machine.start_streams()
        host.stream(case.names, case.decimation)
        return configured_streams(host.client, (1, 2))

    def stop(self) -> None:
        """Switch off, and wait for the last frame."""
        self.host.drive.stop()
        self.host.drive.stop_streams()
        self.host.load.stop()
        self.host.load.stop_streams()
        self.host.client.run_for(0.3)


@dataclass
class Recording:
    """Frames on a bus (rows of CAN_RECORD), and what a host made of them."""

    case: Case
    streams: list[NodeStream]
    frames: np.ndarray
    chunks: list[Chunk]

    @property
    def database(self) -> Database:
        text = dbc_text(self.streams, self.case.rates, self.case.extended)
        database = cantools.database.load_string(text, "dbc", strict=True)
        assert isinstance(database, Database)
        return database


@lru_cache
def recording(name: str) -> Recording:
    """6000 frames of a case, and those that are under way then."""
    bench = StreamingBench(CASES[name])
    streams = bench.start()
    while len(bench.heard) < 6_000:
        bench.host.client.run_for(0.25)
    bench.stop()
    assert bench.host.client.losses(1).samples.lost_by_index == 0
    frames = np.frombuffer(b"".join(bench.heard), CAN_RECORD)
    return Recording(CASES[name], streams, frames, bench.host.collector.chunks)


def joined(chunks: Iterable[Chunk], stream: NodeStream, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """The columns `names` of all chunks of a stream, which must have no gap."""
    of_stream = [c for c in chunks if (c.config.node, c.config.stream) == (stream.config.node, stream.config.stream)]
    assert of_stream
    assert not any(chunk.gaps for chunk in of_stream)
    return {name: np.concatenate([getattr(chunk, name) for chunk in of_stream]) for name in names}


def agree(recorded: Recording, frames: np.ndarray, chunks: list[Chunk]) -> int:
    """cantools decodes `frames` to the numbers in `chunks`; return how many frames it decoded."""
    database = recorded.database
    decoded = 0
    for stream in recorded.streams:
        edges = stream.config.stream == 1
        stem = f"{stream.name.replace(' ', '_')}_{'edges' if edges else 'samples'}"
        messages = [message for message in database.messages if message.name.startswith(stem)]
        assert messages
        for message in messages:
            number = message.frame_id | (EXTENDED if message.is_extended_frame else 0)
            payloads = [f["data"][: f["length"]].tobytes() for f in frames[frames["id"] == number]]
            raw = columns(message, [message.decode(payload, scaling=False) for payload in payloads])
            scaled = columns(message, [message.decode(payload) for payload in payloads])
            if edges:
                agree_on_edges(stream, raw, scaled, chunks)
            else:
                agree_on_samples(stream, raw, scaled, chunks)
            decoded += len(payloads)
    return decoded


def columns(message: Message, rows: list[dict]) -> dict[str, list]:
    """Values by the names of the signals, from one dict a frame."""
    return {signal.name: [row[signal.name] for row in rows] for signal in message.signals}


def agree_on_edges(stream: NodeStream, raw: dict[str, list], scaled: dict[str, list], chunks: list[Chunk]) -> None:
    names = ("tick", "hall_old", "hall_new", "illegal", "encoder", "index")
    edges = joined(chunks, stream, names)
    assert (raw, raw["tick"]) == (scaled, (edges["tick"] & 0xFFFFFFFF).tolist())
    assert raw["ctr"] == (edges["index"] & 0xFF).tolist()
    for name in names[1:5]:
        assert raw[name] == edges[name].tolist(), name


def agree_on_samples(stream: NodeStream, raw: dict[str, list], scaled: dict[str, list], chunks: list[Chunk]) -> None:
    config = stream.config
    samples = joined(chunks, stream, ("index", "raw"))
    index, k = samples["index"], config.block
    assert (np.diff(index) == config.decimation).all()
    if "ctr" in raw:
        assert raw["ctr"][: len(index) // k] == (index[::k] // config.decimation & 0xFFFF).tolist()
    else:
        assert raw["index"][: len(index) // k] == (index[::k] & 0xFFFFFFFF).tolist()
    whole = SampleChunk(config, index, index, samples["raw"], ())
    found = 0
    for channel in config.channels:
        names = [channel.name] if k == 1 else [f"{channel.name}_{n}" for n in range(k)]
        if names[0] not in raw:  # in another group
            continue
        found += 1
        raws = np.array([raw[name] for name in names]).T.reshape(-1)
        values = np.array([scaled[name] for name in names], np.float64).T.reshape(-1)
        np.testing.assert_array_equal(raws, samples["raw"][channel.name], channel.name)
        np.testing.assert_array_equal(values, whole.physical(channel.name), channel.name)
    assert found == (len(raw) - 1) / k


# -- frames as they were on the bus -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", sampled("cantools", tuple(CASES), 3, campaign="can"))
def test_cantools_reads_our_numbers(name: str) -> None:
    """Six times 5000 frames and more, every one: the same integers, and the same float64s."""
    recorded = recording(name)
    assert agree(recorded, recorded.frames, recorded.chunks) > 5_000
    assert len(np.unique(joined(recorded.chunks, recorded.streams[0], ("raw",))["raw"])) > 50


# -- log files --------------------------------------------------------------------------------------------------


def written(path: Path, frames: np.ndarray) -> None:
    """Record frames with python-can's logger."""
    with can.Logger(path) as log:
        for message, when in zip(to_messages(frames.tobytes()), frames["time"].tolist(), strict=True):
            message.timestamp = EPOCH + when
            log(message)


def read_log(path: Path) -> np.ndarray:
    """The frames in a log file."""
    with can.LogReader(path) as messages:
        return np.frombuffer(b"".join(to_record(message, message.timestamp) for message in messages), CAN_RECORD)


@pytest.mark.parametrize(("suffix", "name"), [(".asc", "extended"), (".blf", "FD, extended"), (".log", "FD, extended")])
def test_log_files(name: str, suffix: str, tmp_path: Path) -> None:
    """ASC, BLF and candump keep every frame as it is. ASC and candump round times to 1 µs, and BLF's reader to what a
    float64 of seconds since 1970 has, 0.24 µs; where time 0 is, ASC and BLF tell to a millisecond."""
    frames = recording(name).frames[:3000]
    path = tmp_path / f"run{suffix}"
    written(path, frames)
    logged = read_log(path)
    for name in ("id", "length", "flags", "data"):
        np.testing.assert_array_equal(logged[name], frames[name], name)
    shift = logged["time"] - frames["time"]
    assert shift.max() - shift.min() < 1.6e-6
