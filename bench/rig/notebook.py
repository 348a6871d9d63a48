"""A rig for `bench.connect`: agreed to when something is first energised, and alone on its target."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import cache, partial

from bench.device.node import Node
from bench.errors import UnsafeError
from bench.rig.connection import SIM, load_target, open_target, target_of
from bench.rig.consent import at_most, check_limits, require_consent
from bench.rig.envelope import Envelope
from bench.rig.lock import alone_on
from bench.rig.rig import Plan, Recording, Rig
from bench.rig.settings import Settings


def open_rig(
    target: str | None,
    settings: Settings,
    limits: Envelope,
    yes: bool,
    channels: Sequence[str] | str | None,
    recording: Recording,
) -> Rig:
    """See `bench.connect`."""
    target = target_of(target, settings)
    link = partial(open_target, target, settings, "notebook")
    held = alone_on(target, load_target(settings))
    rig = Rig(Plan(link, target, settings, limits, virtual=target == SIM, held=held))
    drive = rig.drive.node

    @cache
    def agree(node: Node, what: str) -> None:
        require_consent(node, what, at_most(node, limits), yes, _confirm if _somebody_is_there() else None)

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


def _somebody_is_there() -> bool:
    """Whether a question can be asked: on a terminal, or in a notebook."""
    return "ipykernel" in sys.modules or (sys.stdin is not None and sys.stdin.isatty())


def _confirm(question: str) -> bool:
    """Ask, by whatever `input` is here; UnsafeError where that asks nobody."""
    try:
        return input(f"{question} [y/N]: ").strip().lower() in ("y", "yes")
    except (EOFError, NotImplementedError) as error:  # a notebook that a program runs
        raise UnsafeError(f"nobody answers '{question}': give yes=True if the shaft is clear") from error
