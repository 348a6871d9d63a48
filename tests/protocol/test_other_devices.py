"""Devices that are unlike the simulated one in what they say of themselves: info shows them, or says what is wrong."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest
from click.testing import CliRunner
from lying_link import LyingLink
from small_drive import PARAMETERS, SmallDrive, identity

from bench.cli import cli
from bench.device import description as inspect
from bench.device.client import Client
from bench.device.node import Node
from bench.errors import DoesNotFit
from protocol.device.session import DeviceLink
from protocol.errors import DeviceDefect, VersionError
from protocol.framing import Frame
from protocol.messages import HelloReply, MessageType
from protocol.signals import Flag, RawType, Signal, Unit


class Other(SmallDrive):
    """A small drive with channels, parameters and values of its own."""

    def __init__(self, channels: tuple[Signal, ...] = (), parameters: tuple = (), **values: float) -> None:
        super().__init__()
        self.channels = channels
        self.parameters = parameters
        self.values |= values


def link_to(app: SmallDrive, **changes: object) -> LyingLink:
    device = DeviceLink()
    device.add(app, identity(**changes))
    device.advance(0)
    return LyingLink(device=device)


def many(n: int, raw: RawType) -> tuple[Signal, ...]:
    return tuple(Signal(k, f"x{k}", Unit.W, raw, 1.0, Flag.CHANNEL, "") for k in range(n))


def node_of(link: LyingLink) -> Node:
    client = Client(link)
    return Node(client, client.connect().node)


def test_unknown_unit_and_limits_are_shown_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    gain = replace(PARAMETERS[0], lo=-math.inf, hi=math.inf, unit=Unit(40))
    link = link_to(Other(many(2, RawType.U8), (gain,), gain=math.nan))
    monkeypatch.setattr(inspect, "open_link", lambda target: link)
    result = CliRunner().invoke(cli, ["info", "tcp:x:1", "--json"])
    (node,) = json.loads(result.stdout, parse_constant=pytest.fail)["nodes"]
    (parameter,) = node["parameters"]
    assert [parameter[key] for key in ("value", "lo", "hi", "default", "unit")] == [None, None, None, 2.5, "unit 40"]


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


def test_a_device_of_another_major_says_so_at_once() -> None:
    def lie(frame: Frame) -> Frame:
        if frame.type != MessageType.HELLO or frame.is_error:
            return frame
        return frame._replace(payload=replace(HelloReply.unpack(frame.payload), major=2).pack())

    link = LyingLink(lie)
    with pytest.raises(VersionError, match=r"the device speaks HBP 2.1, this host 1"):
        Client(link).connect()
    assert link.clock() < 0.2
