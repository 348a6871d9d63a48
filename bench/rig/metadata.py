"""What a recording says of its run: which drive, which bench, who, which programs."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bench.device.description import describe
from bench.device.node import Node
from bench.files import leaves
from bench.record.info import AnyChannel, RunInfo
from bench.rig.settings import Settings
from bench.signal.versions import PROGRAM, versions
from protocol import __version__


def run_info(
    drive: Node,
    target: str,
    channels: tuple[AnyChannel, ...],
    parameters: Mapping[str, float],
    settings: Settings,
    **more: Any,
) -> RunInfo:
    """Of a run of `drive`, reached by `target`, that streams `channels`; `more`: what else tells what it was."""
    identity = drive.identity
    about = describe(identity) | {"target": target, PROGRAM: __version__} | about_bench(settings) | more
    return RunInfo(
        tick_hz=identity.tick_hz,
        pwm_hz=identity.pwm_hz,
        channels=channels,
        parameters=parameters,
        identity=about | {"versions": versions()},
        node=identity.node,
    )


def about_bench(settings: Settings) -> dict[str, Any]:
    """Station, operator and motor, if they are known, and how the simulated drive differs from the default, by key."""
    about: dict[str, Any] = {}
    for name in ("station", "operator", "motor"):
        if said := getattr(settings, name):
            about[name] = said
    if settings.config is not None:
        about["configuration"] = {"file": str(settings.config), **changed_keys(settings.config)}
    if settings.overrides:
        about["configuration"] = {**about.get("configuration", {}), **dict(leaves(settings.overrides))}
    return about


def changed_keys(path: Path) -> dict[str, Any]:
    """What a configuration of the simulated drive puts in the place of defaults, by dotted key; empty if unreadable."""
    try:
        return dict(leaves(tomllib.loads(path.read_text(encoding="utf-8-sig"))))
    except (OSError, ValueError):  # whoever opens the drive says what is wrong with it
        return {}
