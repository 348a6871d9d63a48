"""Looks for a drive on a link, at the usual rates of UARTs, and reads what it says of itself. Energises nothing.

What is sent are HELLO and questions. On CAN no other bit rate is tried: one that the bus has not disturbs those on it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace

from bench.device.client import Client
from bench.device.scan import Found, look_around
from bench.errors import BenchError, SeveralDevices
from bench.rig.connection import SIM, find_drive, open_load_machine, open_target, second_node
from bench.rig.ratings import RATING_PARAMETERS
from bench.rig.settings import LOADS, Settings
from bench.signal.channels import reference_angle
from protocol.errors import NoReply, TargetError
from protocol.links import Link
from protocol.links.target import CanTarget, SerialTarget, Target, parse_target
from protocol.messages import HelloReply, Role
from protocol.text import either

RATES = (115_200, 3_000_000, 1_000_000, 921_600, 2_000_000, 460_800, 230_400, 12_000_000, 57_600, 38_400)
"""Baud, in the order in which they are tried after the one that the target has."""
ANSWER = 0.6  # s for HELLO at one rate: SPEC asks for an answer within 0.1 s
Choose = Callable[[str, list[int]], int]
"""Which node of several; BenchError where nobody can be asked."""


@dataclass(frozen=True)
class Seen:
    """A drive that answered."""

    target: str
    """Its link as it is to be opened: with the rate, on CAN with the node."""
    drive: HelloReply
    load: HelloReply | None
    """Node 2 of the same link, if that is a load machine."""
    encoder: str
    """The channel of its reference angle; empty where it has none."""
    parameters: Mapping[str, float]
    """Those of `RATING_PARAMETERS` and `n_p` that it has, in SI units."""


def find(text: str, say: Callable[[str], None], choose: Choose) -> Seen:
    """The drive on the link that the target `text` names; `say` gets what is going on.

    Raises BenchError where several devices answer as one, or what answers is no drive; NoReply where nothing that
    speaks HBP answers at any rate; TargetError and LinkError where the link cannot be opened.
    """
    named = None if text == SIM else parse_target(text)
    asked, refused, last = [], None, None
    for each, patience in _tries(named):
        target = SIM if each is None else str(each)
        say(f"asking {target} …")
        try:
            link = open_target(target, Settings())
        except TargetError as error:  # a rate that this port cannot run at; the others may do
            refused = error
            continue
        with closing(link):
            last = look_around(link, ANSWER if patience else 1.0, patience)
            if last.several:
                raise SeveralDevices("; ".join(last.several))
            drive = _of_a_drive(each, text, last, choose) if last.replies else None
            if last.replies and drive == each:
                return _read(link, target)
        if drive is not None:  # another node of this bus, which is the one that a new link leads to
            with closing(open_target(str(drive), Settings())) as link:
                return _read(link, str(drive))
        asked += [each]
    if last is None:
        raise refused or NoReply(f"nothing could be asked on {text}")
    more = "if its firmware does not speak HBP yet, docs/firmware.md adds it"
    raise NoReply(f"no HBP device answered on {_asked(text, asked)}: {last.advice}; {more}")


def check_load_machine(load: str, seen: Seen) -> None:
    """BenchError or HbpError unless the load of a bench, as bench.toml has it, is there, as far as that can be asked.

    A load machine on a link of its own is asked who it is. A person, and a class of the user's, are not looked for.
    """
    if load == "node" and seen.load is None:
        raise BenchError(f"load = node: no load machine answers as node 2 on {seen.target}; is the shaft free: none?")
    if load not in LOADS and ".py:" not in load:
        with ExitStack() as stack:
            open_load_machine(load, stack)


def _tries(named: Target | None) -> Iterator[tuple[Target | None, float | None]]:
    """Targets, and s for which each is asked; None: as long as what it leads to may take to boot."""
    if isinstance(named, SerialTarget):
        for rate in dict.fromkeys((named.baud, *RATES)):
            yield replace(named, baud=rate), ANSWER
    yield named, None


def _asked(text: str, asked: list[Target | None]) -> str:
    rates = dict.fromkeys(str(target.baud) for target in asked if isinstance(target, SerialTarget))
    return f"{text.partition('?')[0]} at {either(rates)} baud" if rates else text


def _of_a_drive(target: Target | None, text: str, found: Found, choose: Choose) -> Target | None:
    """The target with the node of a drive: on a bus there may be several. BenchError where there is none."""
    drives = [reply.node for reply in found.replies if reply.role == Role.DRIVE]
    if not drives:
        others = ", ".join(f"node {reply.node} is a {reply.role.name}" for reply in found.replies)
        raise BenchError(f"there is no drive on {text}: {others}")
    if not isinstance(target, CanTarget) or ("node=" in text and target.node in drives):
        return target
    return replace(target, node=drives[0] if len(drives) == 1 else choose(text, drives))


def _read(link: Link, target: str) -> Seen:
    client = Client(link)
    drive = find_drive(client, target)
    client.listen(drive.number)
    load = second_node(client) if drive.number != 2 else None
    parameters = {
        name: drive.parameter(name).value for name in (*RATING_PARAMETERS, "n_p") if drive.has_parameter(name)
    }
    is_load = load is not None and load.identity.role == Role.LOAD
    return Seen(
        target,
        drive.identity,
        load.identity if load is not None and is_load else None,
        reference_angle(drive.descriptor.channels),
        parameters,
    )
