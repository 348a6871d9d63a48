"""What a recording says of its run: which drive, which bench, which program."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from bench.device.description import describe
from bench.device.node import Node
from bench.rerunio.schema import AnyChannel, RunInfo


def program_version() -> str:
    """Of this program."""
    try:
        return version("hallbench")
    except PackageNotFoundError:  # a source tree that was never installed
        return "0+unknown"


def run_info(
    drive: Node, target: str, channels: tuple[AnyChannel, ...], parameters: Mapping[str, float], **more: Any
) -> RunInfo:
    """Of a run of `drive`, reached by `target`, that streams `channels`; `more`: what else tells what it was."""
    identity = drive.identity
    return RunInfo(
        tick_hz=identity.tick_hz,
        pwm_hz=identity.pwm_hz,
        channels=channels,
        parameters=parameters,
        identity=describe(identity) | {"target": target, "hallbench": program_version(), **more},
        node=identity.node,
    )
