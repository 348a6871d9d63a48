"""The gate before a drive is energised: limits first, then an explicit act.

Nothing here sends a command. A simulated drive needs no act; everything else needs `--yes` or an answered prompt.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from contextlib import ExitStack
from dataclasses import replace

from bench.device.client import Client
from bench.device.node import Node
from bench.errors import BenchError, UnsafeError
from bench.rig.connection import SIM, load_target, open_load_machine, open_target
from bench.rig.envelope import Envelope
from bench.rig.needs import NEEDS, require
from bench.rig.settings import Settings
from bench.signal.units import RPM
from protocol.messages import Feature

FLOAT32 = 1e-7  # to which a drive rounds its parameters, as a share


def check_limits(drive: Node, envelope: Envelope) -> None:
    """Raise BenchError, naming value and limit, if the envelope exceeds what the drive allows."""
    for what, value, parameter, unit, symbol in (  # `unit`: what one `symbol` is in the parameter's own unit
        ("current", envelope.current, "i_max", 1.0, "A"),
        ("speed", envelope.rpm, "omega_m_max", RPM, "r/min"),
        ("load", envelope.load, "i_max", 1.0, "A"),
    ):
        if math.isinf(value) or not drive.has_parameter(parameter):  # without it the drive sets no limit here
            continue
        limit = drive.parameter(parameter).value / unit
        if not abs(value) <= limit * (1.0 + FLOAT32):
            words = f"{what} {value:g} {symbol} is beyond the drive's limit of {limit:.4g} {symbol}"
            raise BenchError(f"{words} (its parameter {parameter})")


def require_consent(
    drive: Node, target: str, envelope: Envelope, yes: bool, confirm: Callable[[str], bool] | None
) -> None:
    """Raise UnsafeError unless the drive is simulated, `yes` was given, or `confirm` answers the question with True.

    `confirm` is None where nobody can be asked.
    """
    if drive.identity.features & Feature.SIMULATED or yes:
        return
    most = min(drive.parameter("i_max").value, envelope.current) if drive.has_parameter("i_max") else None
    current = "its own limit" if most is None else f"{most:g} A"
    speed = f"up to {abs(envelope.rpm):g} r/min, " if envelope.rpm else "to be held at rest, "
    what = (
        f"{drive.identity.name} (boot {drive.identity.boot_id:08x}) on {target}: {speed}phase current up to {current}"
    )
    if confirm is None:
        raise UnsafeError(
            f"refusing to energise {what}: no terminal to confirm; "
            "pass --yes (in Python: yes=True) if the shaft is clear"
        )
    if not confirm(f"{'Spin' if envelope.rpm else 'Energise'} {what}. Is the shaft clear?"):
        raise UnsafeError("not confirmed: the drive was not energised")


def require_agreement(
    target: str,
    settings: Settings,
    asked: Callable[[Node], Envelope],
    yes: bool,
    confirm: Callable[[str], bool] | None,
    needs: Collection[str] = (),
) -> None:
    """Raise UnsafeError unless what turns is simulated or somebody agrees to the most that the tests ask of it.

    `asked` tells that most for the drive. A load machine on a link of its own is a question of its own. `confirm` asks
    a person, None where there is nobody.
    `needs`: applications of `bench.rig.needs`, whose needs come first. BenchError and HbpError where there is no such
    machine.
    """
    if target == SIM:
        return
    with ExitStack() as stack:
        link = open_target(target, settings)
        stack.callback(link.close)
        client = Client(link)
        drive = Node(client, client.connect().node)
        for what in needs:
            require(drive, what, NEEDS[what])
        envelope = asked(drive)
        require_consent(drive, target, at_most(drive, envelope), yes, confirm)
        if machine := load_target(settings):
            load = open_load_machine(machine, stack)
            most = at_most(load, Envelope(envelope.rpm))
            require_consent(load, f"{machine}, the load machine", most, yes, confirm)


def at_most(node: Node, envelope: Envelope) -> Envelope:
    """The envelope with what the machine lets one ask for, where that is slower."""
    most = node.parameter("omega_m_max").value if node.has_parameter("omega_m_max") else math.inf
    return replace(envelope, rpm=min(envelope.rpm, most / RPM))
