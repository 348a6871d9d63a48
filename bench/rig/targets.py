"""Which drive the tests run against, who agrees to that, and nobody else meanwhile.

`sim` is the simulated drive in virtual time, in this process but behind a link like every other; a new one for every
test. Everything else is a target string of a link. A load machine on a link of its own is asked for and held like the
drive. Nothing here energises anything.
"""

from __future__ import annotations

import getpass
import hashlib
import math
import os
import tempfile
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from zlib import crc32

from bench.analysis.units import RPM
from bench.device.client import Client
from bench.device.node import Node
from bench.errors import BenchError
from bench.rig.consent import Plan, require_consent
from bench.rig.envelope import Envelope
from bench.rig.loads import open_load_machine
from bench.rig.needs import NEEDS, require
from bench.rig.settings import LOADS, Settings
from protocol.links import Link, open_link

SIM = "sim"


def target_of(given: str | None, settings: Settings) -> str:
    """By option, environment, bench.toml; else the simulated drive."""
    return given or os.environ.get("BENCH_TARGET") or settings.target or SIM


def open_target(target: str, settings: Settings, test: str) -> Link:
    """A link to `target`; for `sim` to a drive whose noise is that of the test's name.

    Raises LinkError, and BenchError for figures that the simulated drive cannot have, or a load machine that is not on
    its shaft.
    """
    if target != SIM:
        return open_link(target)
    if machine := load_target(settings):
        raise BenchError(f"load '{machine}' is not on the simulated drive's shaft: set load = \"node\", or a target")
    from sim.ports.virtual import ConfigError, open_virtual

    try:
        return open_virtual(settings.config, {}, crc32(test.encode()))
    except ConfigError as error:
        raise BenchError(str(error)) from None


def load_target(settings: Settings) -> str:
    """Target of a load machine on a link of its own; empty where the load is another one."""
    return "" if settings.load in LOADS or ".py:" in settings.load else settings.load


def require_agreement(
    target: str,
    settings: Settings,
    envelope: Envelope,
    yes: bool,
    confirm: Callable[[str], bool] | None,
    needs: Collection[str] = (),
) -> None:
    """Raise UnsafeError unless what turns is simulated or somebody agrees to the most that the tests ask of it.

    A load machine on a link of its own is a question of its own. `confirm` asks a person, None where there is nobody.
    `needs`: applications of `bench.rig.needs`, whose needs come first. BenchError and HbpError where there is no such
    machine.
    """
    if target == SIM:
        return
    with ExitStack() as stack:
        link = open_target(target, settings, "")
        stack.callback(link.close)
        client = Client(link)
        drive = Node(client, client.connect().node)
        for what in needs:
            require(drive, what, NEEDS[what])
        plan = Plan(_fastest(drive, envelope), current_a=envelope.current)
        require_consent(drive, target, plan, yes, confirm)
        if machine := load_target(settings):
            load = open_load_machine(machine, stack)
            require_consent(load, f"{machine}, the load machine", Plan(_fastest(load, envelope)), yes, confirm)


def _fastest(node: Node, envelope: Envelope) -> float:
    """Mechanical r/min that the tests announce, or what the machine lets them if that is less."""
    most = node.parameter("omega_m_max").value if node.has_parameter("omega_m_max") else math.inf
    return min(envelope.speed_rpm, most / RPM)


@contextmanager
def alone_on(*targets: str) -> Iterator[None]:
    """Hold the locks on targets, at most as long as this process lives; `sim` and none need none.

    BenchError if another process holds one.
    """
    with ExitStack() as stack:
        for target in targets:
            if target not in (SIM, ""):
                stack.enter_context(_held(target))
        yield


@contextmanager
def _held(target: str) -> Iterator[None]:
    from filelock import FileLock, Timeout

    name = f"hallbench-{getpass.getuser()}-{hashlib.sha256(_resolved(target).encode()).hexdigest()[:16]}.lock"
    lock = FileLock(Path(tempfile.gettempdir()) / name)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise BenchError(f"{target} is in use by another acceptance run: wait for its end") from None
    except OSError as error:  # a symbolic link in its place is not followed
        why = error.strerror or error
        raise BenchError(f"cannot lock {target} for this run: {lock.lock_file}: {why}; remove that file") from None
    try:
        yield
    finally:
        lock.release()


def _resolved(target: str) -> str:
    """The target without what may be written in several ways: a serial port by its device, no options."""
    kind, _, rest = target.partition(":")
    place = rest.partition("?")[0]
    return f"{kind}:{Path(place).resolve() if kind == 'serial' else place}"
