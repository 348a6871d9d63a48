"""What `bench accept` catches of deliberate faults: makes docs/acceptance-power.md.

python docs/make_acceptance_power.py [--page]

Runs the suite on every fault of tests/bench/accept/sabotages.py and on mutants of the drive's code, unless that is kept
below .sabotage from before (about an hour otherwise), and judges what was measured by the shipped spec. The page's
words are in docs/acceptance-power/, its numbers in numbers.json there. With --page nothing is run.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import shorten
from typing import Any, NamedTuple

from jinja2 import Environment, FileSystemLoader, StrictUndefined

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS.parent))

from tests.bench.accept.sabotages import FAULTS, GROUPS, Fault, Kind, told  # noqa: E402 - a script's own folder

PARTS = DOCS / "acceptance-power"
NUMBERS = PARTS / "numbers.json"
NAMED = 3  # tests that the page names of those which caught a fault
SEED, DRAWN = 1, 50  # of the mutants


class Row(NamedTuple):
    """A kind of fault, for the page."""

    kind: str
    about: str
    effect: str
    sizes: str
    limits: str
    specified: str
    tests: str


def main() -> None:
    """Run what is not kept, and write."""
    if sys.argv[1:] != ["--page"]:
        NUMBERS.write_text(json.dumps(numbers(), indent=1) + "\n")
    (DOCS / "acceptance-power.md").write_text(page(json.loads(NUMBERS.read_text())))


def numbers() -> dict[str, Any]:
    """Of every fault what it changes and which tests caught it; of every mutant the same."""
    from bench.accept.spec import read_spec
    from tests.bench.accept.mutations import trial
    from tests.bench.accept.power import judged, result_of, tree

    made, spec, found = tree(), read_spec("sim"), {}
    for k, (name, fault) in enumerate(FAULTS.items(), 1):
        entry = result_of(made, fault)
        if not fault.shown(entry["healthy"], entry["found"]):
            raise SystemExit(f"{name} does not show its effect: see python -m tests.bench.accept.power '{name}'")
        caught = judged(entry, spec)
        print(f"{k} of {len(FAULTS)} {name}", flush=True)
        found[name] = {
            "healthy": float(f"{entry['healthy']:.5g}"), "found": float(f"{entry['found']:.5g}"),
            "limits": caught.limits[:NAMED], "specified": caught.specified[:NAMED], "unlike": caught.unlike,
        }  # fmt: skip
    return {"faults": found, "mutants": trial(SEED, DRAWN)}


def page(numbers: Mapping[str, Any]) -> str:
    """The page from its words and these numbers."""
    faults, mutants = numbers["faults"], [m for m in numbers["mutants"] if m["differs"]]
    environment = Environment(loader=FileSystemLoader(PARTS), undefined=StrictUndefined, keep_trailing_newline=True)
    return environment.get_template("page.md.j2").render(
        groups={group: [row(name, kind, faults) for name, kind in kinds.items()] for group, kinds in GROUPS.items()},
        totals=totals(faults),
        missed=[
            (fault.about.partition(" (200 %")[0], smallest(fault.kind, faults, "specified")) for fault in unseen(faults)
        ],
        mutants=mutants,
        drawn=len(numbers["mutants"]),
        seed=SEED,
        by_limits=sum(bool(m["limits"]) for m in mutants),
        by_spec=sum(bool(m["limits"] or m["specified"]) for m in mutants),
        survivors=[{**m, "text": changed(m)} for m in mutants if not m["limits"] and not m["specified"]],
    )


def changed(mutant: Mapping[str, Any]) -> str:
    """What became of its expression, for a table."""
    return " → ".join(f"`{shorten(mutant[key], 60, placeholder=' …')}`" for key in ("old", "new")).replace("|", "\\|")


def of_kind(kind: Kind) -> list[tuple[str, Fault]]:
    """The faults of a kind, the smallest first."""
    return [(name, fault) for name, fault in FAULTS.items() if fault.kind is kind]


def is_caught(entry: Mapping[str, Any], by: str) -> bool:
    """By its limits, or with a spec, which has the limits too. What is told wrongly is told by the parameters alone."""
    return bool(entry["limits"] or (by == "specified" and (entry["specified"] or entry["unlike"])))


def smallest(kind: Kind, faults: Mapping[str, Any], by: str) -> str | None:
    """The smallest size from which on all are caught; None: there is none."""
    found = None
    for name, fault in reversed(of_kind(kind)):
        if not is_caught(faults[name], by):
            break
        found = told(fault.size, kind.unit)
    return found


def row(name: str, kind: Kind, faults: Mapping[str, Any]) -> Row:
    """Its line."""
    own = of_kind(kind)
    tests = next((x for key, _ in own for x in [tests_of(faults[key])] if x), ["-"])
    last = faults[own[-1][0]]
    effect = f"`{kind.effect}` {last['healthy']:.3g} → {last['found']:.3g}"
    sizes = ", ".join(told(size, kind.unit) for size in kind.sizes)
    about = kind.about.format(size="…")
    limits, specified = (smallest(kind, faults, by) or "none" for by in ("limits", "specified"))
    return Row(name, about, effect, sizes, limits, specified, ", ".join(tests))


def tests_of(entry: Mapping[str, Any]) -> list[str]:
    """Those that the page names of a fault."""
    return [f"`{test}`" for test in entry["specified"] or entry["limits"]] or ["parameters"] * bool(entry["unlike"])


def totals(faults: Mapping[str, Any]) -> dict[str, int]:
    """How many, of what."""
    kinds: Sequence[Kind] = [kind for group in GROUPS.values() for kind in group.values()]
    return {
        "faults": len(faults),
        "kinds": len(kinds),
        **{f"faults_{by}": sum(is_caught(entry, by) for entry in faults.values()) for by in ("limits", "specified")},
        **{
            f"kinds_{by}": sum(smallest(kind, faults, by) is not None for kind in kinds)
            for by in ("limits", "specified")
        },
    }


def unseen(faults: Mapping[str, Any]) -> list[Fault]:
    """What nothing caught."""
    return [fault for name, fault in FAULTS.items() if not is_caught(faults[name], "specified")]


if __name__ == "__main__":
    main()
