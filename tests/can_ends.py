"""Our link's end of a CAN bus in tests: opened for a block, and read until enough has come."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from protocol.canmap.frame import CAN_RECORD
from protocol.links import open_link
from protocol.links.can import CanLink


@contextmanager
def opened(target: str) -> Iterator[CanLink]:
    link = open_link(target)
    assert isinstance(link, CanLink)
    try:
        yield link
    finally:
        link.close()


def read(link: CanLink, n: int, timeout: float = 10.0, settle: float = 0.0) -> np.ndarray:
    """Rows of CAN_RECORD: `n` or more, or what has come within `timeout` s."""
    data, deadline = b"", time.monotonic() + timeout
    while len(data) < n * CAN_RECORD.itemsize and time.monotonic() < deadline:
        data += link.read(0.1, settle)
    return np.frombuffer(data, CAN_RECORD)
