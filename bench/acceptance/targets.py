"""Which drive the tests run against, who agrees to that, and nobody else meanwhile.

`sim` is the simulated drive in virtual time, in this process but behind a link like every other; a new one for every
test. Everything else is a target string of a link. Nothing here energises anything.
"""

from __future__ import annotations

import getpass
import hashlib
import math
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from zlib import crc32

from bench.acceptance.marks import Envelope
from bench.acceptance.settings import Settings
from bench.client import Client
from bench.energise import RPM, Plan, require_consent
from bench.errors import BenchError
from bench.node import Node
from protocol.links import Link, open_link

SIM = "sim"


def target_of(given: str | None, settings: Settings) -> str:
    """By option, environment, bench.toml; else the simulated drive."""
    return given or os.environ.get("BENCH_TARGET") or settings.target or SIM


def open_target(target: str, settings: Settings, test: str) -> Link:
    """A link to `target`; for `sim` to a drive whose noise is that of the test's name.

    Raises LinkError, and BenchError for figures that the simulated drive cannot have.
    """
    if target != SIM:
        return open_link(target)
    from sim.drive.virtual import open_virtual
    from sim.ranges import ConfigError

    try:
        return open_virtual(settings.config, {}, crc32(test.encode()))
    except ConfigError as error:
        raise BenchError(str(error)) from None


def require_agreement(
    target: str, settings: Settings, envelope: Envelope, yes: bool, confirm: Callable[[str], bool] | None
) -> None:
    """Raise UnsafeError unless the drive is simulated or somebody agrees to the most that the tests ask of it.

    `confirm` asks a person, None where there is nobody. BenchError and HbpError where no drive answers.
    """
    if target == SIM:
        return
    link = open_target(target, settings, "")
    try:
        client = Client(link)
        drive = Node(client, client.connect().node)
        fastest = drive.parameter("omega_m_max").value if drive.has_parameter("omega_m_max") else math.inf
        plan = Plan(min(envelope.speed_rpm, fastest / RPM), current_a=envelope.current)
        require_consent(drive, target, plan, yes, confirm)
    finally:
        link.close()


@contextmanager
def alone_on(target: str) -> Iterator[None]:
    """Hold the lock on a target, at most as long as this process lives. BenchError if another process holds it."""
    if target == SIM:
        yield
        return
    from filelock import FileLock, Timeout

    name = f"hallbench-{getpass.getuser()}-{hashlib.sha256(_resolved(target).encode()).hexdigest()[:16]}.lock"
    lock = FileLock(Path(tempfile.gettempdir()) / name)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise BenchError(f"{target} is in use by another acceptance run: wait for its end") from None
    try:
        yield
    finally:
        lock.release()


def _resolved(target: str) -> str:
    """The target without what may be written in several ways: a serial port by its device, no options."""
    kind, _, rest = target.partition(":")
    place = rest.partition("?")[0]
    return f"{kind}:{Path(place).resolve() if kind == 'serial' else place}"
