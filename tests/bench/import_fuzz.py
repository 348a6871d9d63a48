"""Damaged files for every reader: `python tests/bench/import_fuzz.py FORMAT SEED COUNT` prints what came of them.

A file is made by its format's own library, damaged, and imported in memory: it gives samples or one BenchError. Of a
text that is taken, every number is what Python's own parser reads in that line.
"""

from __future__ import annotations

import faulthandler
import gzip
import io
import json
import math
import sys
import tempfile
import warnings
import zipfile
from collections import Counter
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from random import Random
from typing import Any

import imports_made as made
import numpy as np

from bench.errors import BenchError
from bench.importer.convert import Converter
from bench.importer.guess import complete
from bench.importer.importer import prepare
from bench.importer.mapping import Mapping
from bench.importer.opened import opened
from protocol.streams import SampleChunk

ROWS = 40
SCOPE = "Sample Interval,500,us\nX,CH1,Start,Increment\nSequence,Volt,-6e-3,5e-4\n"
FORMATS: dict[str, Any] = {
    **made.WIDE, **{name: make for name, (make, _) in made.LOGIC.items()}, **dict.fromkeys(made.CAN, made.can_log),
    "scope.csv": lambda path: path.write_text(SCOPE + "".join(f"{k},{k % 7 / 4}\n" for k in range(ROWS))),
    "codes.dat": lambda path: path.write_bytes(b"".join(bytes([0x5A, code, 0]) for code in made.columns()["hall"])),
}  # fmt: skip
NUMBERS = (
    b"nan",
    b"1e999",
    b"-",
    b"",
    b"0x1F",
    b"1,5",
    b"9" * 40,
    b"-0",
    b"inf",
    b"1e-400",
    b"True",
    b"\xff\xfe",
    b'"',
)


def damaged(data: bytes, chance: Random) -> bytes:
    """The same with a few changes, of a kind that chance chooses."""
    found = bytearray(data)
    for _ in range(chance.choice((1, 1, 2, 5, 20))):
        if not found:
            break
        at = chance.randrange(len(found))
        n = min(chance.choice((1, 2, 4, 16, 200)), len(found) - at)
        match chance.randrange(8):
            case 0:
                found[at] ^= 1 << chance.randrange(8)
            case 1:
                found[at : at + n] = chance.randbytes(n)
            case 2:
                del found[at : at + n]
            case 3:
                found[at:at] = found[at : at + n]
            case 4:
                found[at : at + n] = chance.choice((b"\0", b"\xff", b"\x7f", b",", b"\n", b";", b" ")) * n
            case 5:
                found[at:at] = chance.choice(NUMBERS)
            case 6:
                other = chance.randrange(len(found))
                found[at : at + n], found[other : other + n] = found[other : other + n], found[at : at + n]
            case 7:
                del found[at:]
    return bytes(found)


def damaged_inside(name: str, data: bytes, chance: Random) -> bytes:
    """The same with a change of what is packed in it, and packed again; of other formats a change as it is."""
    if name.endswith(".gz"):
        return gzip.compress(damaged(gzip.decompress(data), chance), 1)
    if not name.endswith((".npz", ".sr")):
        return damaged(data, chance)
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(out, "w") as new:
        chosen = chance.choice(old.namelist())
        for member in old.namelist():
            new.writestr(member, damaged(old.read(member), chance) if member == chosen else old.read(member))
    return out.getvalue()


def imported(path: Path) -> int:
    """Import it in memory. Raises BenchError; AssertionError for a number that is not in it."""
    dbc = path.with_suffix(".dbc")
    source = opened(path, Mapping(), dbc if dbc.exists() else None)
    guess = complete(source, Mapping())
    prepared = prepare(source, guess.mapping, guess.guessed)
    converter = Converter(prepared.source, prepared.plan, prepared.seen, prepared.when)
    last = -1
    for chunk in converter.chunks():
        if isinstance(chunk, SampleChunk):
            assert (np.diff(chunk.tick, prepend=last) > 0).all()
            last = int(chunk.tick[-1])
            assert (chunk.raw["hall"] < 8).all() if "hall" in (chunk.raw.dtype.names or ()) else True
    list(prepared.notes)
    if path.suffix in (".csv", ".txt"):
        same_as_python_reads(source, path)
    return converter.samples


def same_as_python_reads(source: Any, path: Path) -> None:
    """Every number of a wide text is one that stands in its column, in that order."""
    if len(source.tables) != 1 or source.tables[0].name or any("another number" in one for one in source.left_out):
        return
    (table,) = source.tables
    text = path.read_bytes().decode("latin-1" if b"\xb5" in path.read_bytes() else "utf-8", "replace")
    separator, decimal = source.about["separator"], source.about["decimal"]
    if separator == " " or '"' in text:
        return
    rows = [line.split(separator) for line in io.StringIO(text, newline=None)]
    for batch in source.batches({"": table.names}):
        for values in batch[""].values():
            known = set(np.asarray(values, np.float64)[np.isfinite(np.asarray(values, np.float64))].tolist())
            cells = {number(cell, decimal) for row in rows for cell in row}
            assert known <= cells | {0.0, 1.0}, sorted(known - cells)[:3]


def number(cell: str, decimal: str) -> float:
    try:
        return float(cell.strip().replace(decimal, "."))
    except ValueError:
        return math.nan


def original(name: str, folder: Path) -> bytes:
    """A small file of the format."""
    made.columns.cache_clear()
    whole = made.columns
    path = folder / name
    if name in made.WIDE:
        short = {key: values[7000 : 7000 + ROWS] for key, values in whole().items()}
        made.columns = lambda every=1, n=0: short  # type: ignore[assignment]
        try:
            FORMATS[name](path)
        finally:
            made.columns = whole
    else:
        FORMATS[name](path)
    return path.read_bytes()


def run(name: str, seed: int, count: int) -> Counter[str]:
    """What came of so many damaged files; an exception that is no BenchError is raised, its file kept."""
    faulthandler.enable()
    warnings.simplefilter("error", RuntimeWarning)  # of numpy: a number that went wrong unseen
    outcomes: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        data = original(name, Path(folder))
        if name in made.LOGIC or name in made.CAN or name == "codes.dat":
            data = data if name.endswith((".sr", ".blf")) else data[:4_000]
        for k in range(seed, seed + count):
            path = Path(folder) / f"x{k % 2}{name}" if name not in made.CAN else Path(folder) / name
            chance = Random(k)
            path.write_bytes(damaged_inside(name, data, chance) if k % 2 else damaged(data, chance))
            print(name, k, flush=True, file=sys.stderr)
            try:
                with redirect_stdout(io.StringIO()):
                    imported(path)
                outcomes["taken"] += 1
            except BenchError as error:
                outcomes["refused" if "\n" not in str(error) else f"more than a line: {k}: {error}"] += 1
            except Exception as error:
                error.add_note(f"{name}, seed {k}")
                raise
    return outcomes


if __name__ == "__main__":
    name, seed, count = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    with open("/dev/null", "w") as nowhere, redirect_stderr(nowhere):
        found = run(name, seed, count)
    print(json.dumps({"format": name, "seed": seed, **found}))
