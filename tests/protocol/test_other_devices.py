"""Devices that are unlike the simulated one in what they say of themselves: info shows them, or says what is wrong."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable
from dataclasses import replace

import pytest
from click.testing import CliRunner
from lying_link import LyingLink
from small_drive import PARAMETERS, SmallDrive, identity, small_link

from bench.cli import cli
from bench.device import description as inspect
from bench.device.client import Client
from bench.device.node import Node
from bench.errors import DoesNotFit, NodeError
from protocol.device.session import DeviceLink
from protocol.errors import DeviceDefect, VersionError
from protocol.framing import Frame
from protocol.messages import HelloReply, MessageType, Role
from protocol.signals import Flag, RawType, Signal, Unit


class Other(SmallDrive):
    """A small drive with channels, parameters and values of its own."""

    def __init__(self, channels: tuple[Signal, ...] = (), parameters: tuple = (), **values: float) -> None:
        super().__init__()
        self.channels = channels
        self.parameters = parameters
        self.values |= values


def link_to(app: SmallDrive, nodes: Iterable[int] = (1,), **changes: object) -> LyingLink:
    device = DeviceLink()
    for node in nodes:
        device.add(app, identity(node, **changes))
    device.advance(0)
    return LyingLink(device=device)


def hello_with(**changes: object) -> Callable[[Frame], Frame]:
    """Lie about these fields of HELLO's reply."""

    def lie(frame: Frame) -> Frame:
        if frame.type != MessageType.HELLO or frame.is_error:
            return frame
        return frame._replace(payload=replace(HelloReply.unpack(frame.payload), **changes).pack())

    return lie


def many(n: int, raw: RawType) -> tuple[Signal, ...]:
    return tuple(Signal(k, f"x{k}", Unit.W, raw, 1.0, Flag.CHANNEL, "") for k in range(n))


def node_of(link: LyingLink) -> Node:
    client = Client(link)
    return Node(client, client.connect().node)


@pytest.fixture
def info(monkeypatch: pytest.MonkeyPatch):
    """Run `bench info` on a link; return what it finds, prints and raises."""

    def run(link: LyingLink) -> tuple[dict, str, BaseException | None]:
        monkeypatch.setattr(inspect, "open_link", lambda target: link)
        result = CliRunner().invoke(cli, ["info", "tcp:x:1", "--json"])
        text = CliRunner().invoke(cli, ["info", "tcp:x:1"]).output
        return json.loads(result.stdout, parse_constant=pytest.fail), text, result.exception

    return run


def test_unknown_role_state_unit_and_limits_are_shown_as_they_are(info) -> None:
    gain = replace(PARAMETERS[0], lo=-math.inf, hi=math.inf, unit=Unit(40))
    link = link_to(Other(many(2, RawType.U8), (gain,), gain=math.nan), role=Role(7))
    found, text, error = info(link)
    assert error is None
    (node,) = found["nodes"]
    assert node["identity"]["role"] == "role 7"
    (parameter,) = node["parameters"]
    assert [parameter[key] for key in ("value", "lo", "hi", "default", "unit")] == [None, None, None, 2.5, "unit 40"]
    assert "(role 7)" in text
    assert "unit 40" in text


def test_a_device_with_neither_channels_nor_parameters(info) -> None:
    link = link_to(Other())
    found, _, error = info(link)
    assert error is None
    assert (found["nodes"][0]["channels"], found["nodes"][0]["parameters"]) == ([], [])
    with pytest.raises(NodeError, match="node 1 has no channels to stream"):
        node_of(link).channels(None)


def test_all_nodes_of_a_link(info) -> None:
    found, _, error = info(link_to(Other(), range(1, 41)))
    assert error is None
    assert [node["identity"]["node"] for node in found["nodes"]] == list(range(1, 41))
    assert not found["unread"]


def test_nodes_that_are_not_there_are_named_after_those_that_are(info) -> None:
    found, text, error = info(LyingLink(hello_with(nodes=3), small_link()[0]))
    assert [node["identity"]["node"] for node in found["nodes"]] == [1]
    assert found["unread"] == {number: f"HELLO was refused: UNKNOWN_NODE ({number})" for number in ("2", "3")}
    assert isinstance(error, NodeError)
    assert "theta" in text


@pytest.mark.parametrize(
    ("most", "n", "raw", "rx_max", "words"),
    [
        (508, 600, RawType.U8, 1024, "node 1 takes at most 508 channels per stream, not 600 channels"),
        (60, 61, RawType.U8, 128, "node 1 takes at most 60 channels per stream, not 61 channels"),
        (252, 300, RawType.U32, 1024, "a sample of 1200 bytes is too long: node 1 sends at most 1008"),
    ],
)
def test_more_than_a_frame_takes_is_said_before_it_is_tried(
    most: int, n: int, raw: RawType, rx_max: int, words: str
) -> None:
    node = node_of(link_to(Other(many(most, raw)), rx_max=rx_max))
    assert len(node.set_samples(node.channels(None), 1).channels) == most
    node.start_streams()
    node = node_of(link_to(Other(many(n, raw)), rx_max=rx_max))
    with pytest.raises(DoesNotFit) as caught:
        node.set_samples(node.channels(None), 1)
    assert str(caught.value).startswith(words)
    assert caught.value.decimation == 0
    assert "--channels" in str(caught.value)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("n_p", 0.0, "parameter 'n_p' of node 1 is 0, must be a whole number of pole pairs"),
        ("n_p", 2.5, "parameter 'n_p' of node 1 is 2.5"),
        ("n_p", math.nan, "parameter 'n_p' of node 1 is nan, must be a finite number"),
        ("gain", -math.inf, "parameter 'gain' of node 1 is -inf, must be a finite number"),
    ],
)
def test_a_parameter_that_cannot_be_is_not_used(name: str, value: float, words: str) -> None:
    node = node_of(link_to(Other((), PARAMETERS, **{name: value})))
    for use in (lambda: node.parameter(name), node.parameters):
        with pytest.raises(DeviceDefect, match=words):
            use()
    assert set(node.parameter_replies()) == {"gain", "n_p", "serial", "watchdog"}


def test_a_descriptor_of_4096_records_is_read() -> None:
    assert len(node_of(link_to(Other(many(4096, RawType.U8)))).descriptor.channels) == 4096
    with pytest.raises(DeviceDefect, match="the descriptor of node 1 has 131104 bytes"):
        _ = node_of(link_to(Other(many(4097, RawType.U8)))).descriptor


def test_a_device_of_another_major_says_so_at_once() -> None:
    link = LyingLink(hello_with(major=2))
    with pytest.raises(VersionError, match=r"the device speaks HBP 2.0, this host 1"):
        Client(link).connect()
    assert link.clock() < 0.2
