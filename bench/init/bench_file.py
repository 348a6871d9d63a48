"""The text of a bench.toml that a person reads: what was found and answered, and what else may stand there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import tomli_w

from bench.init.search import Seen
from bench.rig.ratings import TOLD_BY, ratings
from bench.signal.units import RPM, pole_pairs
from protocol.messages import HelloReply
from protocol.text import printable

LOADS = '"node": number 2 on the link, "none", "person", a target, or "FILE.py:Class"'
ABOUT = (
    ("station", "bench 3", "which bench this is, for recordings and reports"),
    ("operator", "A. Person", "who runs it; for one run: --operator"),
    ("motor", "type 42, no. 17", "which motor the drive has; for one run of bench accept: --motor"),
)
"""What may be stated: key, example, what it is."""
WHICH = {"speed_rpm": "r/min", "current": "A, peak"}


@dataclass(frozen=True)
class Answers:
    """What a bench.toml says besides the target; empty text and no value: nobody has said it."""

    load: str = "none"
    person: bool = False
    encoder: bool = True
    rated: Mapping[str, float] = field(default_factory=dict)
    """`speed_rpm` and `current`, where the bench allows less than the drive."""
    station: str = ""
    operator: str = ""
    motor: str = ""


def proposed(seen: Seen) -> dict[str, float]:
    """What the drive's own limits amount to, by the keys of [rated]; what it has no limit for is not there."""
    told = ratings(seen.parameters, {}).told
    return {key: told[what] for what, (_, key) in TOLD_BY.items() if what in told}


def text(seen: Seen, answers: Answers, when: str) -> str:
    """The file, which `read_settings` reads; `when` it is written, for its first line."""
    most = proposed(seen)
    lines = [
        f"# This bench, as bench init found it {when}. Every command takes from here what it is not told.",
        *(f"# {printable(line)}" for line in described(seen)),
        "",
        _line("target", seen.target, "of commands without TARGET; $BENCH_TARGET goes before it"),
        *(
            _line(name, getattr(answers, name) or example, about, bool(getattr(answers, name)))
            for name, example, about in ABOUT
        ),
        "",
        "[rig]",
        _line("load", answers.load, f"what brakes the shaft: {LOADS}"),
        _line("person", answers.person, "whether somebody is there to turn knobs and pull wires when asked"),
        _line("encoder", answers.encoder, "false: none is mounted, whatever the drive tells", bool(seen.encoder)),
        "",
        "[rated]  # the most that tests ask for, and the current of bench live, if less than the drive's own limits",
        *(_rated(key, answers.rated.get(key), most.get(key)) for key in WHICH),
        "",
        "# [limits]  # of measurements, by the names that bench accept --list shows",
        '# "fig08_steady.error_std_proposed" = { hi = 6.0 }',
    ]
    return "\n".join(lines) + "\n"


def described(seen: Seen) -> list[str]:
    """What was found, in a few lines for people."""
    lines = [f"Drive: {_who(seen.drive)}"]
    facts = [f"{n_p} pole pairs"] if (n_p := pole_pairs(seen.parameters)) else []
    facts += [f"largest speed {value / RPM:.0f} r/min" for value in _of(seen, "omega_m_max")]
    facts += [f"largest phase current {value:g} A, peak" for value in _of(seen, "i_max")]
    lines += [f"It says: {', '.join(facts)}"] if facts else []
    lines += [f"Encoder: its channel {seen.encoder}" if seen.encoder else "Encoder: none, it has no reference angle"]
    return [*lines, f"Load machine: {_who(seen.load)}" if seen.load else "Load machine: none on this link"]


def _who(identity: HelloReply) -> str:
    named = {"serial": identity.serial, "build": identity.build}
    more = "".join(f", {what} {value}" for what, value in named.items() if value)
    return f"{identity.name}, firmware {identity.firmware}{more}, node {identity.node}"


def _of(seen: Seen, name: str) -> list[float]:
    return [seen.parameters[name]] if name in seen.parameters else []


def _line(key: str, value: str | bool | float, about: str, stated: bool = True) -> str:
    """A key with what it is about; what nobody has stated stands there as an example, as a comment."""
    return f"{'' if stated else '# '}{tomli_w.dumps({key: value}).strip()}  # {about}"


def _rated(key: str, value: float | None, most: float | None) -> str:
    own = f"by the drive {most:.7g}" if most is not None else "the drive tells no limit, and bench accept needs one"
    return _line(key, value or float(f"{most or 0.0:.7g}"), f"{WHICH[key]}; {own}", value is not None)
