"""A rig for `bench.connect`: agreed to when something is first energised, and alone on its target."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import cache, partial

from bench.device.node import Node
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
    channels: Sequence[str] | None,
    recording: Recording,
) -> Rig:
    """See `bench.connect`."""
    target = target_of(target, settings)
    link = partial(open_target, target, settings, "notebook")
    held = alone_on(target, load_target(settings))
    rig = Rig(Plan(link, target, settings, limits, virtual=target == SIM, held=held))
    try:
        drive = rig.drive.node
        check_limits(drive, limits)
        rig.prepare(None if channels is None else [drive.channels(channels)], recording)
    except BaseException:
        rig.close()
        raise

    @cache
    def agree(node: Node, what: str) -> None:
        require_consent(node, what, at_most(node, limits), yes, _confirm if _somebody_is_there() else None)

    for machine in rig.machines:
        ours = machine.node.client is rig.client
        machine.agreed = partial(agree, drive, target) if ours else partial(agree, machine.node, machine.title)
    rig.drive.starts_by_itself = True
    return rig


def _somebody_is_there() -> bool:
    """Whether a question can be asked: on a terminal, or in a notebook."""
    return "ipykernel" in sys.modules or (sys.stdin is not None and sys.stdin.isatty())


def _confirm(question: str) -> bool:
    """Ask, by whatever `input` is here."""
    return input(f"{question} [y/N]: ").strip().lower() in ("y", "yes")
