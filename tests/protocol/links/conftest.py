"""A serial port that can be pulled out, and the link on it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from protocol.links import open_link
from protocol.links.serial import SerialLink
from sim.ports.byte_ports import PtyPort


@pytest.fixture
def port(tmp_path: Path) -> Iterator[PtyPort]:
    port = PtyPort(tmp_path / "ttyBENCH")
    yield port
    port.unplug()


@pytest.fixture
def link(port: PtyPort) -> Iterator[SerialLink]:
    link = open_link(port.target)
    assert isinstance(link, SerialLink)
    yield link
    link.close()
