"""A rig for `bench.connect`: agreed to when something is first energised, and alone on its target."""

from __future__ import annotations

import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any, TypedDict

from bench.device.client import Client
from bench.device.node import Node
from bench.device.simulator import configuration
from bench.errors import BenchError, UnsafeError
from bench.rig.connection import SIM, load_target, open_target, target_of
from bench.rig.consent import at_most, check_limits, require_consent
from bench.rig.envelope import Envelope
from bench.rig.interrupts import undisturbed
from bench.rig.lock import alone_on
from bench.rig.outputs import Recording
from bench.rig.rig import Plan, Rig
from bench.rig.settings import Settings
from protocol.errors import HbpError


class Simulated(TypedDict, total=False):
    """What is given for the simulated drive."""

    config: Mapping[str, Any] | str | Path
    seed: int


def open_rig(
    target: str | None,
    settings: Settings,
    limits: Envelope,
    yes: bool,
    channels: Sequence[str] | str | None,
    recording: Recording,
    simulated: Simulated,
) -> Rig:
    """See `bench.connect`."""
    target = target_of(target, settings)
    if unknown := sorted(simulated.keys() - Simulated.__annotations__.keys()):
        raise TypeError(f"connect() got an unexpected keyword argument '{unknown[0]}'")
    settings = _with_simulated(settings, target, **simulated)
    link = partial(open_target, target, settings, "notebook")
    held = alone_on(target, load_target(settings))
    rig = Rig(Plan(link, target, settings, limits, virtual=target == SIM, held=held))
    drive = rig.drive.node

    confirm = partial(_confirm, rig.client)

    @cache
    def agree(node: Node, what: str) -> None:
        require_consent(node, what, at_most(node, limits), yes, confirm if _somebody_is_there() else None)

    try:
        check_limits(drive, limits)
        if isinstance(channels, str):
            channels = channels.split(",")
        rig.prepare(None if channels is None else [drive.channels(channels)], recording)
        for machine in rig.machines:
            ours = machine.node.client is rig.client
            machine.agreed = partial(agree, drive, target) if ours else partial(agree, machine.node, machine.title)
        rig.drive.starts_by_itself = True
        if rig.outputs is not None and rig.outputs.view is not None:
            print(f"dashboard: {rig.outputs.view.url}")
    except BaseException:
        rig.close()
        raise
    return rig


def _with_simulated(
    settings: Settings, target: str, config: Mapping[str, Any] | str | Path | None = None, seed: int | None = None
) -> Settings:
    if (config, seed) != (None, None) and target != SIM:
        raise BenchError(f"config and seed are for the simulated drive, not for {target}")
    if isinstance(config, Mapping):
        settings = replace(settings, overrides=config)
    elif config is not None:
        settings = replace(settings, config=configuration(Path(config), str(config)))
    return settings if seed is None else replace(settings, seed=seed)


def _somebody_is_there() -> bool:
    """Whether a question can be asked: on a terminal, or in a notebook."""
    return "ipykernel" in sys.modules or (sys.stdin is not None and sys.stdin.isatty())


def _confirm(client: Client, question: str) -> bool:
    """Ask, by whatever `input` is here, and read the link meanwhile: what waits there would come late, or be lost.

    UnsafeError where that asks nobody.
    """
    answered = threading.Event()

    def read() -> None:
        with suppress(HbpError):  # whoever polls next meets it, too
            while not answered.is_set():
                client.poll()

    reader = threading.Thread(target=read)
    reader.start()
    try:
        return input(f"{question} [y/N]: ").strip().lower() in ("y", "yes")
    except (EOFError, NotImplementedError) as error:  # a notebook that a program runs
        raise UnsafeError(f"no terminal to answer '{question}': pass yes=True if the shaft is clear") from error
    finally:
        with undisturbed():
            answered.set()
            reader.join()
