"""Bytes of a link to numpy columns, CRC checked: ns of CPU time a sample of 16 channels, 32 bytes."""

from __future__ import annotations

import os
import sys
from inspect import signature
from typing import Any

import probe

BARE = "--bare" in sys.argv
COMPILED = ("cobs.cobs._cobs_ext", "cobs.cobsr._cobsr_ext")
"""What is compiled of the libraries that frames are decoded with, and what pip makes without a compiler lacks."""
if BARE:
    sys.modules.update(dict.fromkeys(COMPILED))  # importing them fails
    os.environ["PATH"] = os.path.dirname(sys.executable)  # nor is there a compiler

import numpy as np  # noqa: E402

from protocol.descriptor import Descriptor  # noqa: E402
from protocol.host import HostSession  # noqa: E402
from protocol.messages import Role, StreamEvent, StreamSet  # noqa: E402
from protocol.signals import Flag, RawType, Signal, Unit  # noqa: E402
from protocol.streams import SampleDecoder, StreamConfig  # noqa: E402

N, REPEAT = (100_000, 5) if probe.SHORT else (300_000, 7)
READS = (65_536, 8192)
WORDS = tuple(Signal(k + 1, f"x{k}", Unit.A, RawType.I16, 1 / 1024, Flag.CHANNEL, "") for k in range(16))
TICKS = 1250  # a period

app: Any = probe.newest("protocol.device.app", "protocol.device_app")
streams: Any = probe.newest("protocol.device.streams", "protocol.device_streams")
TxQueue: Any = probe.newest("protocol.device.tx", "protocol.device_tx").TxQueue
OLD = not probe.there("protocol.device.carrier")


def sent(raw: Any) -> tuple[bytes, Any]:
    """What a device sends of these samples, and how its stream is configured."""
    identity = app.Identity(1, Role.DRIVE, "bench", "0", boot_id=1)
    descriptor, tx = Descriptor.of(WORDS, ()), TxQueue(1 << 30)
    carrier = tx if OLD else probe.newest("protocol.device.carrier").ByteCarrier(tx)
    table = streams.StreamTable(identity, WORDS, carrier)
    request = StreamSet(0, StreamEvent.PWM, 1, 100, tuple(c.id for c in WORDS))
    reply = table.configure(request, 1024)
    table.start(1)
    late = "names" in signature(table.push_samples).parameters  # since samples may be made late
    table.push_samples(0, 0, raw, *([frozenset(c.name for c in WORDS)] if late else []))
    table.stop(1)
    node: Any = 1 if OLD else identity
    return tx.take(), StreamConfig.of(node, request, reply, descriptor)


def decode(data: bytes, config: Any, read: int) -> tuple[float, list[Any]]:
    """s, and what came of it."""
    host: Any = HostSession()
    tick = host.tick_reference(1)
    decoder: Any = SampleDecoder(config, TICKS, tick) if OLD else host.decoder(config)  # type: ignore[call-arg]
    pieces = [data[k : k + read] for k in range(0, len(data), read)]
    chunks = []
    begun = probe.cpu()
    for piece in pieces:
        host.receive_data(piece, 0.0)
        while (event := host.next_event()) is not None:
            chunks.append(decoder.decode(event.frames))
    took = probe.cpu() - begun
    return took, [chunk for chunk in chunks if chunk is not None]


if __name__ == "__main__":
    rng = np.random.default_rng(0)
    raw = rng.integers(0, 256, N * 32, np.uint8).view(Descriptor.of(WORDS, ()).dtype)
    data, config = sent(raw)
    least = dict.fromkeys(READS, float("inf"))
    for _ in range(REPEAT):  # turn about
        for read in READS:
            took, chunks = decode(data, config, read)
            least[read] = min(least[read], took)
    if b"".join(chunk.raw.tobytes() for chunk in chunks) != raw.tobytes():
        raise SystemExit("what was decoded is not what was sent")
    if BARE and any(sys.modules.get(name) for name in COMPILED):
        raise SystemExit("the compiled libraries were not hidden")
    what = ", without compiled libraries" if BARE else ""
    costs = {f"decode{what}, reads of {read // 1024} KiB, a sample, ns": 1e9 * took / N for read, took in least.items()}
    costs[f"decode{what}, reads of 8 KiB over reads of 64, within a run"] = least[8192] / least[65_536]
    if not probe.SHORT and not BARE:
        costs |= probe.other("--bare")
    probe.tell(costs)
