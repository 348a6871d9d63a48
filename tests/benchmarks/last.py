"""The last figures: what each part measured when it last ran in full, when, and on what (last.json, against.json)."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from tests.benchmarks.ratio import Pair
from tests.benchmarks.table import Row

SLOWER = 1.15
"""How many times slower than before, by the ratio to the reference kernel, a figure is named."""


@dataclass(frozen=True, slots=True)
class Measured:
    """What a part measured."""

    date: str
    machine: str
    reference: float  # s of the reference kernel
    rows: tuple[Row, ...]


@dataclass(frozen=True, slots=True)
class Comparison:
    """A part that was measured at two commits turn about."""

    date: str
    machine: str
    commit: str  # the present one
    rows: tuple[Pair, ...]


Last = Mapping[str, Measured]


def read(text: str) -> dict[str, Measured]:
    """The parts' figures, by the part."""
    return {
        part: Measured(**kept | {"rows": tuple(Row(**row) for row in kept["rows"])})
        for part, kept in json.loads(text).items()
    }


def compared(text: str) -> dict[str, Comparison]:
    """Commits' comparisons, by commit and part: "c9185aa sim"."""
    return {
        part: Comparison(**kept | {"rows": tuple(Pair(**row) for row in kept["rows"])})
        for part, kept in json.loads(text).items()
    }


def text_of(last: Mapping[str, Any]) -> str:
    """What `read` or `compared` reads, a line for each row."""
    blocks = []
    for part, measured in last.items():
        kept = asdict(measured)
        rows = ",\n   ".join(json.dumps(row, ensure_ascii=False, default=float) for row in kept.pop("rows"))
        about = json.dumps(kept, ensure_ascii=False).removesuffix("}")
        blocks.append(f' "{part}": {about},\n  "rows": [\n   {rows}\n  ]}}')
    return "{\n" + ",\n".join(blocks) + "\n}\n"


def slower(before: Measured, now: Measured) -> Iterator[tuple[str, float]]:
    """What has become more than `SLOWER` times slower, and how many times."""
    ratios = {row.what: row.ratio for row in before.rows}
    for row in now.rows:
        last = ratios.get(row.what)
        if row.ratio and last:
            times = row.ratio / last if row.at_most else last / row.ratio
            if times > SLOWER:
                yield row.what, times
