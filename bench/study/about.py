"""What a study says of itself in its report."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from pathlib import Path

from bench.study.answers import About
from bench.study.experiments import limits_of, test_of
from bench.study.sampling import LATIN, RANDOM, SALTELLI, SOBOL
from bench.study.store import MADE_BY
from bench.study.study import ACCEPT, FUNCTION, TURN, VARY, Experiment, Study
from protocol.text import counted

SAMPLING = {
    SOBOL: "points of Sobol's sequence, scrambled", LATIN: "a Latin hypercube", RANDOM: "drives drawn at random",
    SALTELLI: "Saltelli's scheme on Sobol's sequence",
}  # fmt: skip


def about(study: Study, folder: Path, there: Path | None = None) -> About:
    """Of a study whose rows are in a folder; `there`: where that is at present, if it will be elsewhere."""
    sampling = study.plan["sampling"]
    return About(
        title=study.name,
        facts=tuple(_facts(study, there or folder)),
        sampling=SAMPLING[sampling],
        sample_count=study.samples,
        replay=lambda row: f"bench study replay {shlex.quote(str(folder))} {row}",
        points=sampling in (SOBOL, LATIN),
        saltelli=study.variation.factors if sampling == SALTELLI else (),
    )


def _facts(study: Study, folder: Path) -> Iterator[tuple[str, str]]:
    repeated = f", {study.repetitions} times each" if study.repetitions > 1 else ""
    yield "Drives", f"{study.samples}{repeated}, by {SAMPLING[study.plan['sampling']]}, seed {study.seed}"
    yield "Nominal drive", study.plan["drive"] or "the paper's motor"
    for one in study.variation.varied:
        yield one.key, one.words
    for (a, b), r in study.variation.correlated:
        yield f"{a}, {b}", f"correlated, {r:g}"
    for design, changes in study.plan["designs"].items():
        if told := ", ".join(f"{key} = {value}" for key, value in changes.items() if key != VARY):
            yield f"Design {design}", told
    for experiment in study.experiments:
        yield f"Experiment {experiment.name}", _told(study, experiment)
    made_by = json.loads((folder / MADE_BY).read_text("utf-8"))
    yield "Computed by", ", ".join(f"{name} {value}" for name, value in made_by.items())


def _told(study: Study, experiment: Experiment) -> str:
    given = experiment.given
    if experiment.kind == TURN:
        speeds = ", ".join(f"{speed:g}" for speed in given["speed"])
        begin = f"from {given['settle']:g} s on" if given["settle"] else "from the first moment"
        words = f"{speeds} r/min for {given['seconds']:g} s each against {given['load']:g} N m, measured {begin}"
        return words + (f", the control on {given['control']}" if given["control"] else "")
    if experiment.kind == FUNCTION:
        return f"the function {given['function']}"
    tests = {test_of(name, limits) for name, limits in limits_of(study, experiment).items()}
    return f"{counted(len(tests), 'acceptance test')} ({given[ACCEPT]})"
