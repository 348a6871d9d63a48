"""Watches a shaft that somebody turns by hand. Energises nothing, and leaves state, faults and parameters alone.

So it also works on a drive that keeps a fault because of its Hall sensors, and beside a power stage that is off.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from bench import __version__
from bench.device.client import Client, Sink
from bench.device.description import describe
from bench.device.node import Node
from bench.errors import BenchError, DoesNotFit
from bench.hall.turning import ENOUGH, Turned, electrical_turns
from bench.rerunio.schema import RunInfo
from bench.rig.needs import NEEDS, require
from bench.rig.recorder import Recorder
from protocol.descriptor import Channel
from protocol.errors import HbpError
from protocol.links import Link
from protocol.messages import Role

if TYPE_CHECKING:
    from bench.hall.source import Options

WATCHED = ("hall", "status", "theta_enc", "omega_enc", "i_a", "i_b")
FURTHER = "once round at least, and take longer (--duration)"
LOOK = 0.5  # s between looks at how far it turned


def watch(link: Link, options: Options, progress: Callable[[str], None]) -> tuple[Turned, Node]:
    """Record for `options.duration`, or until the shaft was turned far enough both ways, or Ctrl-C.

    The caller closes `link`.

    Returns what was recorded, and the drive. Raises BenchError for what is no drive, and without samples; HbpError.
    """
    target, seconds, save = options.source, options.duration, options.save
    client = Client(link)
    hello = client.connect()
    if hello.role != Role.DRIVE:
        raise BenchError(f"{target} answers as {hello.role.name}, not as a drive")
    node = Node(client, hello.node)
    for what in options.needs:
        require(node, what, NEEDS[what])
    node.stop_streams()
    recorder = Recorder(node.number, hello.tick_hz)
    recorder.expect(node.set_edges())
    channels = _stream(node)
    parameters = node.parameters()
    with ExitStack() as stack:
        client.sinks = [recorder]
        if save is not None:
            about = describe(hello) | {"target": target, "hallbench": __version__}
            run = RunInfo(hello.tick_hz, hello.pwm_hz, channels, parameters, about, hello.node)
            client.sinks.append(_file(save, run, stack))
        node.start_streams()
        first, end = round(node.clock_fit(1).tick), client.now() + seconds
        with suppress(KeyboardInterrupt):
            while (left := end - client.now()) > 0:
                client.run_for(min(LOOK, left))
                up, down = electrical_turns(recorder, first, parameters)
                progress(f"turn the shaft by hand: {up:.1f} electrical turns up, {down:.1f} down, {left:.0f} s left")
                if min(up, down) >= ENOUGH:
                    break
        with suppress(HbpError):
            node.stop_streams()
    return Turned(recorder.capture(first, recorder.newest, parameters), "by hand", further=FURTHER), node


def _stream(node: Node) -> tuple[Channel, ...]:
    """Configure what is watched, as often as the link carries it."""
    there = {channel.name for channel in node.descriptor.channels}
    channels = node.channels([name for name in WATCHED if name in there])
    try:
        node.set_samples(channels, 1)
    except DoesNotFit as error:
        if not error.decimation:
            raise
        node.set_samples(channels, error.decimation)
    return channels


def _file(path: Path, run: RunInfo, stack: ExitStack) -> Sink:
    from bench.rerunio.sinks import FileSink

    file = FileSink(path, run, overwrite=True)
    stack.callback(file.close)
    return file
