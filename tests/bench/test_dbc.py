"""DBC files of streams: what cantools reads out of them, where they come from, and `bench protocol dbc`."""

from __future__ import annotations

import re
import struct
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import cantools
import numpy as np
import pytest
from against import said
from collect import Bench

from bench.cli import main
from bench.device.client import Client
from bench.device.dbc import ENCODING, NodeStream, configured_streams, dbc_text
from bench.device.node import Node
from protocol.canmap.frame import CAN_RECORD, BusRates
from protocol.descriptor import Channel
from protocol.messages import Empty, StreamEvent, StreamReply, StreamSet, StreamStart
from protocol.signals import Flag, RawType, Unit
from protocol.streams import StreamConfig
from sim.config.params import load_params
from sim.ports.device import SimulatedDevice
from sim.ports.networks import CanNetwork
from sim.ports.virtual import VirtualLink

CLASSIC = BusRates(1_000_000)
FD = BusRates(1_000_000, 5_000_000)

Load = cantools.database.can.Database


def load(text: str) -> Load:
    database = cantools.database.load_string(text.encode(ENCODING).decode("cp1252"), "dbc", strict=True)
    assert isinstance(database, Load)
    return database


def channel(
    name: str, raw: RawType = RawType.I16, unit: Unit = Unit.A, scale: float = 1.0, offset: float = 0.0
) -> Channel:
    return Channel(1, name, unit, raw, scale, Flag.CHANNEL, offset)


STREAM = StreamConfig(1, 0, 7, StreamEvent.PWM, 1, (), 1, 0, tick_hz=20_000_000, pwm_hz=16_000)


def samples(channels: tuple[Channel, ...], name: str = "drive", **changed: int) -> NodeStream:
    return NodeStream(name, replace(STREAM, channels=channels, **changed))


def edges(name: str = "drive", **changed: int) -> NodeStream:
    return NodeStream(name, replace(STREAM, **{"stream": 1, "event": StreamEvent.EDGES} | changed))


SIX = (
    channel("hall", RawType.U8),
    channel("status", RawType.U8),
    channel("theta"),
    channel("u_dc", RawType.U16),
    channel("omega_m", RawType.F32),
    channel("i_a"),
)


# -- what is in a file ------------------------------------------------------------------------------------------


def test_messages_of_a_classic_stream() -> None:
    """By hand: class << 8 | node << 4 | slot, samples in classes 5 and 6, edges in class 4; 6 bytes behind the ctr."""
    database = load(dbc_text([samples(SIX, node=3, slot=30, decimation=16), edges(node=3, slot=5)], CLASSIC, False))
    got = [(m.name, m.frame_id, m.length, m.cycle_time or 0, m.is_fd, m.is_extended_frame) for m in database.messages]
    assert got == [
        ("drive_samples_0", 0x63E, 8, 1, False, False),
        ("drive_samples_1", 0x63F, 8, 1, False, False),
        ("drive_edges_0", 0x435, 8, 0, False, False),
    ]
    signals = [
        [(s.name, s.start, s.length, "f" if s.is_float else "i" if s.is_signed else "u") for s in m.signals]
        for m in database.messages
    ]
    assert signals == [
        [
            ("ctr", 0, 16, "u"), ("hall", 16, 8, "u"), ("status", 24, 8, "u"), ("theta", 32, 16, "i"),
            ("u_dc", 48, 16, "u"),
        ],
        [("ctr", 0, 16, "u"), ("omega_m", 16, 32, "f"), ("i_a", 48, 16, "i")],
        [
            ("tick", 0, 32, "u"), ("hall_old", 32, 3, "u"), ("hall_new", 35, 3, "u"), ("illegal", 38, 1, "u"),
            ("ctr", 40, 8, "u"), ("encoder", 48, 16, "u"),
        ],
    ]  # fmt: skip
    assert {s.byte_order for m in database.messages for s in m.signals} == {"little_endian"}


def test_slots_wrap() -> None:
    twenty = tuple(channel(f"c{n}", RawType.F32) for n in range(3))
    ids = [m.frame_id for m in load(dbc_text([samples(twenty, slot=30)], CLASSIC, False)).messages]
    assert ids == [0x61E, 0x61F, 0x510]


def test_scale_and_offset_are_exact() -> None:
    scale, offset = (struct.unpack("f", struct.pack("f", value))[0] for value in (0.1, -40.7))
    tiny = struct.unpack("f", struct.pack("f", 1.17549435e-38))[0]
    stream = samples((channel("t", scale=scale, offset=offset), channel("x", scale=tiny), channel("n", RawType.U16)))
    (message,) = load(dbc_text([stream], CLASSIC, False)).messages
    for raw in (-32768, -1, 0, 1, 12345):
        got = message.decode(struct.pack("<HhhH", 0, raw, raw, 7))
        assert (got["t"], got["x"], got["n"]) == (raw * scale + offset, raw * tiny, 7)


@pytest.mark.parametrize(("rates", "extended", "number", "stated"), [
    (CLASSIC, False, 0x51F, []),
    (CLASSIC, True, 0x242151F, [(str(1 << 31 | 0x242151F), "1")]),
    (FD, False, 0x51F, [(str(0x51F), "14")]),
    (FD, True, 0x242151F, [(str(1 << 31 | 0x242151F), "15")]),
])  # fmt: skip
def test_frame_format_survives(rates: BusRates, extended: bool, number: int, stated: list[tuple[str, str]]) -> None:
    text = dbc_text([samples(SIX[:2], slot=15)], rates, extended)
    (message,) = load(load(text).as_dbc_string()).messages
    assert (message.frame_id, message.is_extended_frame, message.is_fd) == (number, extended, rates.fd)
    assert re.findall(r'BA_ "VFrameFormat" BO_ (\d+) (\d+);', text) == stated
    assert 'BA_DEF_DEF_  "VFrameFormat" "StandardCAN";' in text


@pytest.mark.parametrize(
    ("decimation", "block", "ms"), [(16, 1, 1), (8, 1, 0), (1, 3, 0), (16, 3, 3), (24, 2, 3), (65520, 3, 12285)]
)
def test_cycle_time_is_that_of_frames_where_it_is_whole(decimation: int, block: int, ms: int) -> None:
    (message,) = load(dbc_text([samples((channel("a"),), decimation=decimation, block=block)], CLASSIC, False)).messages
    assert (message.cycle_time or 0) == ms


def test_every_unit_can_be_written() -> None:
    units = list(Unit)
    channels = tuple(channel(f"c{unit}", unit=unit) for unit in units)
    (message,) = load(dbc_text([samples(channels)], FD, False)).messages
    assert [s.unit or "" for s in message.signals[1:]] == ["Ohm" if u is Unit.OHM else u.symbol for u in units]


HOSTILE = [
    "9 volts", "int", "ctr", "index", "ctr_", "a b", "a_b", "a-b", "Ω", "", "VERSION", "SG_", "BO_", "x" * 40, "x" * 41,
]  # fmt: skip


@pytest.mark.parametrize("rates", [CLASSIC, FD])
def test_names_are_identifiers(rates: BusRates) -> None:
    """Two devices with one name, and channels named as badly as can be: every DBC tool and C compiler takes these."""
    channels = tuple(channel(name, RawType.U8) for name in HOSTILE)
    streams = [
        samples(channels, name="FILTER", block=3),
        edges(name="FILTER"),
        edges(name="FILTER", stream=2, slot=1),
        samples(channels[:1], node=2, name='a "drive" with a very long name, over 32'),
        samples(channels[:1], node=3, name='a "drive" with a very long name, over 32'),
        samples(channels[:1], node=4, name="μ"),
    ]
    database = load(dbc_text(streams, rates, False))
    for names in (
        [node.name for node in database.nodes],
        [message.name for message in database.messages],
        *([signal.name for signal in message.signals] for message in database.messages),
    ):
        assert len(set(names)) == len(names)
        for name in names:
            assert re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]{0,31}", name), name
            assert name not in ("int", "VERSION", "FILTER", "SG_", "BO_")
    assert len(database.nodes) == 4
    carried = [s.name for m in database.messages for s in m.signals if m.name.startswith("FILTER__samples")]
    counters = carried.count("ctr" if rates is CLASSIC else "index")
    assert len(carried) - counters == len(HOSTILE) * (3 if rates is FD else 1)


def test_comments_say_how_to_get_index_and_tick() -> None:
    streams = [samples(SIX, decimation=16, tick0=99), samples(SIX[:2], stream=2, slot=8, decimation=4, block=3)]
    first, _, third = load(dbc_text(streams, CLASSIC, False)).messages
    assert third.comment is not None
    assert "stream 0 of node 1, part 1 of 2: 1000 samples/s, decimation 16." in first.comment.lower()
    assert (
        "ctr: low 16 bits of the number of the sample; index = number * 16; tick = 99 + index * 1250" in first.comment
    )
    assert "sample _0, that of _1 is 1 more, and so on to _2; index = number * 4" in third.comment
    (of_fd,) = load(dbc_text([samples(SIX[:2], decimation=4, block=3)], FD, False)).messages
    assert of_fd.comment is not None
    assert (
        "index: low 32 bits of the index of sample _0, that of _1 is 4 more, and so on to _2; tick = 0" in of_fd.comment
    )


# -- the command ------------------------------------------------------------------------------------------------


class Watched:
    """A simulated bench on a CAN bus in virtual time, and all frames that its devices sent."""

    def __init__(self, rates: BusRates, extended: bool = False) -> None:
        self.network = CanNetwork(rates, extended)
        self.device = SimulatedDevice(load_params(), 1, boot_id=64, network=self.network)
        self.frames: list[bytes] = []
        self.network.bus.attach(lambda: b"", self.frames.append, "listener")
        self.link = VirtualLink(self.device)

    def bench(self) -> Bench:
        return Bench(self.link)

    def dbc(self, capsysbinary: pytest.CaptureFixture[bytes], target: str) -> Load:
        with patch("bench.device.dbc.open_link", lambda named: self.link):
            main(["protocol", "dbc", target])
        self.link.reopen()
        out, err = capsysbinary.readouterr()
        assert err == b""
        return load(out.decode("cp1252"))


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    """What a fresh machine says while it compiles the simulated drive, it has said before."""
    bench = Watched(CLASSIC).bench()
    bench.stream(("i_a",), 1)
    bench.turn(50.0)
    bench.client.run_for(0.01)


def numbers(frames: list[bytes]) -> np.ndarray:
    """The ctr of a drive's classic samples, slot 0 of node 1 (its boot_id is a multiple of 32)."""
    records = np.frombuffer(b"".join(frames), CAN_RECORD)
    return records["data"][records["id"] == 0x510][:, :2].copy().view("<u2")[:, 0].astype(int)


def test_reading_disturbs_no_stream(capsysbinary: pytest.CaptureFixture[bytes]) -> None:
    watched = Watched(CLASSIC)
    bench = watched.bench()
    bench.stream(("i_a", "i_b"), 4)
    bench.turn(50.0)
    bench.client.run_for(0.2)
    before = len(numbers(watched.frames))
    database = watched.dbc(capsysbinary, "can:virtual/x")
    during = len(numbers(watched.frames))
    bench.client.run_for(0.2)
    after = numbers(watched.frames)
    assert [m.name for m in database.messages] == ["simulated_drive_samples_0", "simulated_drive_edges_0"]
    assert before + 1000 < during < len(after) - 700
    assert (np.diff(after) % 65536 == 1).all()
    assert bench.drive.active_streams() == [s.config for s in configured_streams(Client(watched.link), (1, 2))]


def test_a_stream_of_means_is_described_as_floats(capsysbinary: pytest.CaptureFixture[bytes]) -> None:
    """What cantools makes of its frames is what the host's own decoder does."""
    watched = Watched(CLASSIC)
    bench = watched.bench()
    bench.turn(50.0)
    channels = [bench.drive.descriptor.channel(name) for name in ("theta_enc", "i_q")]
    request = StreamSet(2, StreamEvent.MEAN, 160, 20, tuple(channel.id for channel in channels))
    bench.client.request(request, 1, StreamReply)
    (config,) = (each for each in bench.drive.active_streams() if each.stream == 2)
    assert [channel.raw for channel in config.channels] == [RawType.F32, RawType.F32]
    bench.client.request(StreamStart(1 << 2), 1, Empty)
    bench.client.run_for(0.3)
    database = watched.dbc(capsysbinary, "can:virtual/x")
    messages = [m for m in database.messages if "mean" in (m.comment or "")]
    assert [signal.is_float for m in messages for signal in m.signals] == [False, True, False, True]
    records = np.frombuffer(b"".join(watched.frames), CAN_RECORD)
    for message, channel in zip(messages, channels, strict=True):
        frames = records["data"][records["id"] == message.frame_id][:, :6].tobytes()
        assert len(frames) >= 6 * 25
        told = database.decode_message(message.frame_id, frames[-6:])[channel.name]
        assert told == pytest.approx(struct.unpack("<f", frames[-4:])[0] * channel.scale)
        assert abs(told) < 4.0


def test_streams_of_every_node_that_is_there(capsysbinary: pytest.CaptureFixture[bytes]) -> None:
    watched = Watched(FD)
    bench = watched.bench()
    bench.stream(("i_a",), 1)
    load_machine = Node(bench.client, 2)
    load_machine.set_samples(load_machine.descriptor.channels, 2)
    for session in watched.device.sessions:
        session.nodes = 5  # three of them are switched off
    database = watched.dbc(capsysbinary, "can:virtual/x?fd=1")
    assert [(m.name, m.frame_id >> 4 & 15) for m in database.messages] == [
        ("simulated_drive_samples_0", 1),
        ("simulated_drive_edges_0", 1),
        ("load_machine_samples_0", 2),
    ]
    assert {s.name for s in database.messages[2].signals} >= {"omega_m_0", "tau_load_0", "status_0"}
    assert all(s.is_float for s in database.messages[2].signals if s.name.startswith(("omega", "tau")))


def test_written_to_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "drive.dbc"
    path.write_text("of an earlier run")
    watched = Watched(FD)
    watched.bench().stream(("tau_e_true",), 1)
    with patch("bench.device.dbc.open_link", lambda named: watched.link):
        main(["protocol", "dbc", "can:virtual/x?fd=1", "-o", str(path), "--overwrite"])
    database = cantools.database.load_file(path)  # as cp1252, by its default
    assert isinstance(database, Load)
    assert (database.messages[0].signals[1].unit, capsys.readouterr().out) == ("N·m", "")


def refusal(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    out, err = said(capsys, "protocol", "dbc", *arguments, code=2)
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    return err


@pytest.mark.parametrize(("arguments", "says"), [
    (("tcp:127.0.0.1:7000",), "tcp:127.0.0.1:7000 is not a CAN bus"),
    (("serial:/dev/ttyACM0",), "can:socketcan/can0"),
    ((), "no TARGET: name one, set $BENCH_TARGET, or let `bench init` write a bench.toml"),
])  # fmt: skip
def test_refusals(capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], says: str) -> None:
    assert says in refusal(capsys, *arguments)


@pytest.mark.parametrize(
    ("extended", "says"),
    [(False, "no device on virtual: is configured to stream: start `bench live`"), (True, "no HBP device answered on")],
)
def test_a_bus_without_streams_or_devices(capsys: pytest.CaptureFixture[str], extended: bool, says: str) -> None:
    """There is none where the devices have identifiers of the other length."""
    watched = Watched(CLASSIC)
    watched.link.wire = CanNetwork(CLASSIC, extended).wire  # type: ignore[method-assign]
    with patch("bench.device.dbc.open_link", lambda named: watched.link):
        assert says in refusal(capsys, "can:virtual/x")
