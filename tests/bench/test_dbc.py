"""DBC files of streams: what cantools reads out of them, where they come from, and `bench protocol dbc`."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from pathlib import Path
from unittest.mock import patch

import cantools
import numpy as np
import pytest
from collect import Bench
from processes import Program, Sim

from bench.cli import main
from bench.device.client import Client
from bench.device.dbc import ENCODING, NodeStream, configured_streams, dbc_text
from bench.device.node import Node
from protocol.canmap.frame import CAN_RECORD, BusRates
from protocol.descriptor import Channel
from protocol.links import open_link
from protocol.messages import StreamEvent
from protocol.signals import DRIVE_CHANNELS, LOAD_CHANNELS, Flag, RawType, Unit
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


def samples(
    channels: tuple[Channel, ...],
    *,
    node: int = 1,
    stream: int = 0,
    decimation: int = 1,
    block: int = 1,
    slot: int = 0,
    tick0: int = 0,
    name: str = "drive",
) -> NodeStream:
    config = StreamConfig(
        node, stream, 7, StreamEvent.PWM, decimation, channels, block, slot, tick0, tick_hz=20_000_000, pwm_hz=16_000
    )
    return NodeStream(name, config)


def edges(node: int = 1, slot: int = 0, stream: int = 1, name: str = "drive") -> NodeStream:
    return NodeStream(
        name, StreamConfig(node, stream, 8, StreamEvent.EDGES, 1, (), 1, slot, tick_hz=20_000_000, pwm_hz=16_000)
    )


def described(database: Load) -> list[tuple[object, ...]]:
    return [
        (
            message.frame_id,
            message.name,
            message.length,
            message.is_fd,
            message.is_extended_frame,
            message.cycle_time or 0,
            message.senders,
            message.comment,
            [
                (s.name, s.start, s.length, s.byte_order, s.is_signed, s.is_float, s.scale, s.offset, s.unit or "")
                for s in message.signals
            ],
        )
        for message in database.messages
    ]


SIX = tuple(
    channel(name, raw)
    for name, raw in (
        ("hall", RawType.U8),
        ("status", RawType.U8),
        ("theta", RawType.I16),
        ("u_dc", RawType.U16),
        ("omega_m", RawType.F32),
        ("i_a", RawType.I16),
    )
)


# -- what is in a file ------------------------------------------------------------------------------------------


def test_messages_of_a_classic_stream() -> None:
    """By hand: class << 8 | node << 4 | slot, samples in classes 5 and 6, edges in class 4; 6 bytes behind the ctr."""
    database = load(dbc_text([samples(SIX, node=3, slot=30, decimation=16), edges(3, 5)], CLASSIC, False))
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
            ("ctr", 0, 16, "u"),
            ("hall", 16, 8, "u"),
            ("status", 24, 8, "u"),
            ("theta", 32, 16, "i"),
            ("u_dc", 48, 16, "u"),
        ],
        [("ctr", 0, 16, "u"), ("omega_m", 16, 32, "f"), ("i_a", 48, 16, "i")],
        [
            ("tick", 0, 32, "u"),
            ("hall_old", 32, 3, "u"),
            ("hall_new", 35, 3, "u"),
            ("illegal", 38, 1, "u"),
            ("ctr", 40, 8, "u"),
            ("encoder", 48, 16, "u"),
        ],
    ]
    assert {s.byte_order for m in database.messages for s in m.signals} == {"little_endian"}


def test_slots_wrap() -> None:
    twenty = tuple(channel(f"c{n}", RawType.F32) for n in range(3))
    ids = [m.frame_id for m in load(dbc_text([samples(twenty, slot=30)], CLASSIC, False)).messages]
    assert ids == [0x61E, 0x61F, 0x510]


def test_several_samples_in_a_frame() -> None:
    """A frame of CAN FD: index, then 3 samples of 12 bytes, padded from 40 to 48."""
    (message,) = load(dbc_text([samples(SIX, block=3, decimation=8)], FD, False)).messages
    names = [c.name for c in SIX]
    assert (message.length, message.is_fd) == (48, True)
    assert [s.name for s in message.signals] == ["index", *(f"{name}_{n}" for n in range(3) for name in names)]
    assert [s.start // 8 for s in message.signals] == [
        0, 4, 5, 6, 8, 10, 14, 16, 17, 18, 20, 22, 26, 28, 29, 30, 32, 34, 38,
    ]  # fmt: skip
    data = struct.pack("<I", 80) + b"".join(
        struct.pack("<BBhHfh", 1, 2, -3 * n, 65535 - n, n + 0.1, -32768) for n in range(3)
    )
    decoded = message.decode(data.ljust(48, b"\0"))
    assert decoded["index"] == 80
    assert [decoded[f"theta_{n}"] for n in range(3)] == [0, -3, -6]
    assert [decoded[f"u_dc_{n}"] for n in range(3)] == [65535, 65534, 65533]
    assert [decoded[f"omega_m_{n}"] for n in range(3)] == [np.float32(n + 0.1) for n in range(3)]


def test_scale_and_offset_are_exact() -> None:
    scale, offset = (struct.unpack("f", struct.pack("f", value))[0] for value in (0.1, -40.7))
    tiny = struct.unpack("f", struct.pack("f", 1.17549435e-38))[0]
    stream = samples((channel("t", scale=scale, offset=offset), channel("x", scale=tiny), channel("n", RawType.U16)))
    (message,) = load(dbc_text([stream], CLASSIC, False)).messages
    for raw in (-32768, -1, 0, 1, 12345):
        got = message.decode(struct.pack("<HhhH", 0, raw, raw, 7))
        assert (got["t"], got["x"], got["n"]) == (raw * scale + offset, raw * tiny, 7)


@pytest.mark.parametrize(("extended", "number"), [(False, 0x51F), (True, 0x242151F)])
@pytest.mark.parametrize(
    ("rates", "formats"), [(CLASSIC, ("StandardCAN", "ExtendedCAN")), (FD, ("StandardCAN_FD", "ExtendedCAN_FD"))]
)
def test_frame_format_survives(rates: BusRates, formats: tuple[str, str], extended: bool, number: int) -> None:
    text = dbc_text([samples(SIX[:2], slot=15)], rates, extended)
    (message,) = load(load(text).as_dbc_string()).messages
    assert (message.frame_id, message.is_extended_frame, message.is_fd) == (number, extended, rates.fd)
    code = {"StandardCAN": 0, "ExtendedCAN": 1, "StandardCAN_FD": 14, "ExtendedCAN_FD": 15}[formats[extended]]
    stated = re.findall(r'BA_ "VFrameFormat" BO_ (\d+) (\d+);', text)
    assert stated == ([(str(number | extended << 31), str(code))] if code else [])
    assert 'BA_DEF_DEF_  "VFrameFormat" "StandardCAN";' in text


STREAMS = {
    "classic, groups": ([samples(SIX, slot=31), edges()], CLASSIC),
    "classic, 3 in a frame": ([samples((channel("i_a"),), block=3)], CLASSIC),
    "FD, 5 in a frame": ([samples(SIX, block=5), edges()], FD),
    "FD, all": ([samples(DRIVE_CHANNELS, decimation=3), samples(LOAD_CHANNELS, node=2, block=6, name="load")], FD),
}


@pytest.mark.parametrize("extended", [False, True])
@pytest.mark.parametrize("case", STREAMS)
def test_read_and_written_again_it_is_the_same(case: str, extended: bool) -> None:
    streams, rates = STREAMS[case]
    once = load(dbc_text(streams, rates, extended))
    assert described(load(once.as_dbc_string(sort_signals=None))) == described(once)
    assert {m.is_extended_frame for m in once.messages} == {extended}
    assert {m.is_fd for m in once.messages} == {rates.fd}


@pytest.mark.parametrize(
    ("decimation", "block", "ms"), [(16, 1, 1), (8, 1, 0), (1, 3, 0), (16, 3, 3), (24, 2, 3), (65520, 3, 12285)]
)
def test_cycle_time_is_that_of_frames_where_it_is_whole(decimation: int, block: int, ms: int) -> None:
    (message,) = load(dbc_text([samples((channel("a"),), decimation=decimation, block=block)], CLASSIC, False)).messages
    assert (message.cycle_time or 0) == ms


def test_every_unit_can_be_written() -> None:
    units = list(Unit)
    channels = tuple(channel(f"c{unit}", unit=unit) for unit in units)
    text = dbc_text([samples(channels)], FD, False)
    (message,) = load(text).messages
    assert [s.unit or "" for s in message.signals[1:]] == ["Ohm" if u is Unit.OHM else u.symbol for u in units]


HOSTILE = [
    "9 volts",
    "int",
    "ctr",
    "index",
    "ctr_",
    "a b",
    "a_b",
    "a-b",
    "Ω",
    "",
    "VERSION",
    "SG_",
    "BO_",
    "x" * 40,
    "x" * 41,
]


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
    assert len(carried) - carried.count("ctr" if rates is CLASSIC else "index") == len(HOSTILE) * (
        3 if rates is FD else 1
    )


def test_comments_say_how_to_get_index_and_tick() -> None:
    streams = [samples(SIX, decimation=16, tick0=99), samples(SIX[:2], stream=2, slot=8, decimation=4, block=3)]
    first, _, third = load(dbc_text(streams, CLASSIC, False)).messages
    assert first.comment is not None
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
    """A file that is there is kept without --overwrite."""
    path = tmp_path / "drive.dbc"
    path.write_text("mine")
    assert "exists" in refusal(capsys, "can:virtual/x", "-o", str(path))
    assert path.read_text() == "mine"
    watched = Watched(FD)
    watched.bench().stream(("tau_e_true",), 1)
    with patch("bench.device.dbc.open_link", lambda named: watched.link):
        main(["protocol", "dbc", "can:virtual/x?fd=1", "-o", str(path), "--overwrite"])
    database = cantools.database.load_file(path)  # as cp1252, by its default
    assert isinstance(database, Load)
    assert database.messages[0].signals[1].unit == "N·m"
    assert capsys.readouterr().out == ""


def refusal(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    with pytest.raises(SystemExit) as end:
        main(["protocol", "dbc", *arguments])
    assert end.value.code == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    return err


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("tcp:127.0.0.1:7000",), "tcp:127.0.0.1:7000 is no CAN bus"),
        (("serial:/dev/ttyACM0",), "can:socketcan/can0"),
        ((), "Missing argument 'TARGET'"),
        (("can:virtual/x", "-o", "/nowhere/x.dbc"), "/nowhere/x.dbc cannot be written: there is no directory /nowhere"),
    ],
)
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


def test_over_an_slcan_adapter(start_sim: Callable[..., Sim], start: Callable[..., Program], tmp_path: Path) -> None:
    """Two processes: the host that started the streams is gone, they run on, and are read."""
    sim = start_sim("--slcan", "--fd")
    link = open_link(sim.target)
    bench = Bench(link)
    bench.stream(("hall", "i_a", "i_b"), 2)
    configs = bench.drive.active_streams()
    link.close()
    path = tmp_path / "drive.dbc"
    program = start("protocol", "dbc", sim.target, "-o", str(path))
    assert program.end() == 0, program.err
    expected = [NodeStream("simulated drive", config) for config in configs]
    assert path.read_bytes().decode("cp1252") == dbc_text(expected, FD, False)
