"""What `bench init` asks: which link, then what a drive cannot tell of its bench. Nothing here prints."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from bench.errors import BenchError
from bench.init.bench_file import Answers, proposed
from bench.init.search import Seen, check_load_machine
from bench.rig.ratings import ratings
from bench.rig.settings import check_load

Read = TypeVar("Read")
NOTHING = (
    "no serial ports and no CAN interfaces found: is the adapter plugged in, and its driver loaded (Linux: dmesg)? "
    "tcp:HOST:PORT is a drive on the network, sim the simulated one (--target)"
)


class Person(Protocol):
    """Somebody who can be asked."""

    def ask(self, question: str, default: str, read: Callable[[str], Read]) -> Read:
        """What `read` makes of the answer. Where it raises BenchError or HbpError that is told, and asked again."""

    def confirm(self, question: str, default: bool) -> bool:
        """Yes or no."""


def which(places: Sequence[Mapping[str, str]], person: Person | None, use: Callable[[str], Read]) -> Read:
    """What `use` makes of the target that is chosen among `places`, or typed; without a person of the only one.

    BenchError where nobody can be asked and there is none, or more than one.
    """
    targets = [place["target"] for place in places]
    if person is None:
        if not targets:
            raise BenchError(NOTHING)
        if len(targets) > 1:
            raise BenchError(f"{len(targets)} places to look at, {', '.join(targets)}: choose one with --target")
        return use(targets[0])
    numbered = {str(number): target for number, target in enumerate(targets, 1)}
    question = "Which has the drive: a number, or a target, such as tcp:192.168.0.7:7000 or sim"
    return person.ask(question, "1" if targets else "", lambda text: use(numbered.get(text, text)))


def which_node(person: Person | None) -> Callable[[str, list[int]], int]:
    """What chooses among several drives on a bus."""

    def choose(place: str, nodes: list[int]) -> int:
        words = f"nodes {', '.join(map(str, nodes))} of {place} are drives"
        if person is None:
            raise BenchError(f"{words}: add node=N to the target")
        return person.ask(f"{words}; which one", str(nodes[0]), lambda text: _one_of(nodes, text))

    return choose


def _one_of(nodes: list[int], text: str) -> int:
    if text not in map(str, nodes):
        raise BenchError(f"{text or 'nothing'} is none of them")
    return int(text)


@dataclass(frozen=True)
class Questions:
    """What is asked of a person, None where there is nobody, for all that `given` has no value for, by option."""

    seen: Seen
    given: Mapping[str, Any]
    person: Person | None

    def answers(self) -> Answers:
        """Asked one by one. BenchError and HbpError for an option that cannot be."""
        load = self._text(
            "load", "What brakes the shaft: node, none (a free shaft), person, a target or FILE.py:Class",
            "node" if self.seen.load else "none", self._load,
        )  # fmt: skip
        return Answers(
            load=load,
            person=load == "person" or self._sure("person", "Is somebody there to turn knobs and pull wires", False),
            encoder=not self.seen.encoder
            or self._sure("encoder", f"Is the encoder ({self.seen.encoder}) mounted", True),
            rated={
                **self._rated("speed_rpm", "rated_speed", "speed, r/min"),
                **self._rated("current", "rated_current", "phase current, A peak"),
            },
            **{name: self._text(name, f"{what}, for recordings and reports", "", str) for name, what in ABOUT.items()},
        )

    def _load(self, text: str) -> str:
        check_load(text, "load")
        check_load_machine(text, self.seen)
        return text

    def _rated(self, key: str, option: str, what: str) -> dict[str, float]:
        """Less than the drive allows; nothing where it is as much."""
        most = proposed(self.seen).get(key)

        def read(text: str) -> float | None:
            return self._number(key, text) if text else None

        default = "" if most is None or self.person is None else f"{most:.7g}"
        value = self._text(option, f"Largest {what}, on this bench", default, read)
        as_proposed = self.given[option] is None and value == float(default or "nan")
        return {} if value is None or as_proposed else {key: value}

    def _number(self, key: str, text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not 0.0 < value < math.inf:
            raise BenchError(f"{text} is not a number above 0")
        ratings(self.seen.parameters, {key: value})  # which refuses what is beyond the drive's limits
        return value

    def _text(self, option: str, question: str, default: str, read: Callable[[str], Read]) -> Read:
        if (told := self.given[option]) is not None:
            return read(str(told))
        return read(default) if self.person is None else self.person.ask(question, default, read)

    def _sure(self, option: str, question: str, default: bool) -> bool:
        if (told := self.given[option]) is not None:
            return bool(told)
        return default if self.person is None else self.person.confirm(question, default)


ABOUT = {"station": "Which bench this is", "operator": "Who runs it", "motor": "Which motor the drive has"}
