"""A row of a study once more: its figures, bit for bit, with recordings of what the drive did."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bench.errors import BenchError
from bench.study.experiments import INPUT, MEASURED, VERDICT, WHOLE, WHY, row_of, write_drive
from bench.study.store import open_study, row_in
from bench.study.study import Study

SAME = (INPUT, MEASURED, VERDICT, WHY, *WHOLE)
"""What columns begin with that must be the same again."""


def replay(
    folder: Path, row: int, save: Path | None = None, drive: Path | None = None
) -> tuple[dict[str, Any], list[str]]:
    """A row, computed anew, and what of it is not as the study in `folder` has it: a line each; one that is not there.

    `save`: a folder that gets recordings and reports; `drive`: a file that gets the drive's configuration. BenchError
    for a row that the study does not have.
    """
    study = open_study(folder)
    if not 0 <= row < len(study):
        raise BenchError(f"{folder} has the rows 0 to {len(study) - 1}, not {row}")
    values = study.inputs([row])[0]
    if drive is not None:
        write_drive(drive, study.drive(row, values.tolist()))
    if save is not None:
        save.mkdir(parents=True, exist_ok=True)
    found = row_of(study, row, values, save)
    there = row_in(folder, row)
    return found, ["the study has no such row yet"] if there is None else list(_differences(found, there))


def _differences(found: dict[str, Any], there: dict[str, Any]) -> Iterator[str]:
    for name in sorted(key for key in found.keys() | there.keys() if key.startswith(SAME)):
        a, b = found.get(name), there.get(name)
        both_unknown = isinstance(a, float) and isinstance(b, float) and math.isnan(a) and math.isnan(b)
        if a != b and not both_unknown:
            yield f"{name} was {b!r}, and is {a!r} now"


def described(study: Study, row: int) -> str:
    """A row in words."""
    sample, repetition, design = study.place(row)
    words = f"drive {sample}"
    words += f", repetition {repetition}" if study.repetitions > 1 else ""
    words += f", design {study.designs[design]}" if len(study.designs) > 1 else ""
    return f"row {row}: {words}, seed {study.noise(row)}"
