"""A device at work: in real time in a thread of the test process or a process of its own, or in virtual time."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from tests.devices.carriers import IN_REAL_TIME
from tests.devices.device import Device
from tests.devices.faults import build
from tests.devices.virtual import SharedLink, VirtualLink, turn
from tests.devices.vocabulary import VOCABULARIES, Vocabulary

PWM_HZ = {"slcan": 500, "virtual": 250, "CAN": 500}
"""Where it is not the usual 1000: each frame of a CAN bus costs both ends their time."""
STEP = 0.01  # s, at most, between two looks


def run(device: Device, stop: threading.Event) -> None:
    """Serve until `stop` is set."""
    while not stop.is_set():
        device.carrier.wait(STEP)
        turn(device)


@contextmanager
def serving(
    vocabulary: str | Vocabulary = "full", faults: Sequence[str] = (), carrier: str = "pty", **options: float
) -> Iterator[Device]:
    """A device; `device.carrier.target` is what `bench` connects to. See `device.Device` for options.

    On a carrier in real time it works in a thread, and what goes wrong there is raised on leaving. In virtual time
    `device.link` is the link to give to `bench`.
    """
    words = VOCABULARIES[vocabulary] if isinstance(vocabulary, str) else vocabulary
    given: dict[str, Any] = {"pwm_hz": PWM_HZ.get(carrier, 1000)} | options
    if carrier not in IN_REAL_TIME:
        link = VirtualLink(can={"bytes": False, "CAN": True}[carrier])
        device = link.device = build(words, faults, clock=link.clock, **given)
        device.link = link
        device.attach(link.carrier)
        yield device
        return
    device = build(words, faults, **given)
    device.attach(IN_REAL_TIME[carrier]())
    stop, failures = threading.Event(), []

    def serve() -> None:
        try:
            run(device, stop)
        except BaseException as error:
            failures.append(error)

    thread = threading.Thread(target=serve, name="test device")
    thread.start()
    try:
        yield device
    finally:
        stop.set()
        thread.join()
        device.carrier.close()
    if failures:
        raise failures[0]


@contextmanager
def twins(
    carrier: str, *serials: str, interleaved: bool = False, joins: float = 0.0, **options: Any
) -> Iterator[list[Device]]:
    """Devices of these serial numbers that all are node 1 of one link, in virtual time.

    They have not booted at once; from the second on they come `joins` s after the first.
    `device.link` is the link of all.
    """
    link = SharedLink({"bytes": False, "CAN": True}[carrier], interleaved)
    for k, serial in enumerate(serials):
        words = replace(VOCABULARIES["full"], serial=serial)
        given = {"pwm_hz": PWM_HZ.get(carrier, 1000), "clock": link.clock} | options
        device = build(words, ["boots"] if k and joins else [], **given | ({"after": joins} if k else {}))
        device._born -= 0.037 * k
        device.link = link
        device.attach(link.carrier_of())
        device.carrier.port.target = link.port.target  # type: ignore[union-attr]
        link.devices.append(device)
    yield link.devices
