"""What `bench tune` has found, in files: tune.json, trials.csv, a picture, configurations with the best parameters."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from bench.files import finite, write
from bench.study.experiments import write_drive
from bench.study.objectives import MAX, Objective
from bench.study.search import Trial
from bench.study.tune_file import Tuned
from bench.study.tune_plots import draw
from protocol.text import counted
from sim.ports.direct import with_values

HEAD = """# {name}: trial {number} of {trials} of bench tune, by {objectives}.
# Only what was tuned; {whole}
"""
MOST_PICTURED = 6  # parameters beside the course of the search


def plain(tuned: Tuned) -> dict[str, Any]:
    """All of it, as plain data."""
    plan = tuned.plan
    before = dict(zip((one.name for one in plan.objectives), tuned.before.objectives, strict=True))
    return {
        "name": plan.name, "trials": len(tuned.trials), "out": sum(bool(one.why) for one in tuned.trials),
        "seed": plan.seed, "drives": len(plan.recordings) or (plan.study.samples if plan.study else 0),
        "objectives": {one.name: {"of": one.of, "over": one.over, "sense": one.sense, "unit": one.unit,
                                  "as_it_was": before[one.name]} for one in plan.objectives},
        "parameters": {one.key: {one.kind: list(one.given), "as_it_was": one.before} for one in plan.parameters},
        "best": None if tuned.best is None else tuned.best.number,
        "points": [_point(tuned, one) for one in tuned.points],
    }  # fmt: skip


def as_json(tuned: Tuned) -> dict[str, Any]:
    """The same, without what JSON cannot say."""
    data: dict[str, Any] = finite(plain(tuned))
    return data


def _point(tuned: Tuned, trial: Trial) -> dict[str, Any]:
    names = [one.name for one in tuned.plan.objectives]
    checked = {
        name: {"as_it_was": before, "tuned": after, "difference": change.value, "from": change.lo, "to": change.hi,
               "share_better": share}
        for name, (before, after, change, share) in zip(names, tuned.checked.get(trial.number, ()), strict=False)
    }  # fmt: skip
    at_end = [one.key for one in tuned.plan.parameters if one.at_end(trial.values[one.key])]
    return {
        "trial": trial.number, "parameters": dict(trial.values), "at_an_end": at_end,
        "objectives": dict(zip(names, trial.objectives, strict=True)), "on_other_drives": checked,
    }  # fmt: skip


def lines(tuned: Tuned) -> Iterator[str]:
    """For the terminal."""
    plan, n_out = tuned.plan, sum(bool(one.why) for one in tuned.trials)
    out = next((f", {n_out} out of the running ({one.why})" for one in tuned.trials if one.why), "")
    yield f"{counted(len(tuned.trials), 'trial')}{out}"
    if tuned.best is None:
        yield "none can be used: widen the ranges, or take an objective that the drives have"
        return
    if len(plan.objectives) > 1:
        checked = f", {len(tuned.checked)} of them checked" if len(tuned.checked) < len(tuned.points) else ""
        points = counted(len(tuned.points), "point")
        yield f"{points} on the Pareto front{checked}; the middle one is trial {tuned.best.number}:"
    for one in plan.parameters:
        value = tuned.best.values[one.key]
        end = "; at an end of its range: widen it" if one.at_end(value) else ""
        yield f"  {one.key}: {_was(one.before)}{value:.4g} ({one.kind} {', '.join(f'{x:g}' for x in one.given)}){end}"
    for k, objective in enumerate(plan.objectives):
        yield f"  {objective.name} ({objective.over} of {objective.of}): {_in_words(tuned, tuned.best, k, objective)}"


def _was(before: float | None) -> str:
    return "" if before is None else f"{before:.4g} -> "


def _in_words(tuned: Tuned, trial: Trial, k: int, objective: Objective) -> str:
    unit = f" {objective.unit}".rstrip()
    words = f"{tuned.before.objectives[k]:.4g} -> {trial.objectives[k]:.4g}{unit} where it was tuned; "
    if trial.number not in tuned.checked:
        return f"{words}not checked elsewhere: name other recordings as tune.check"
    before, after, change, share = tuned.checked[trial.number][k]
    kind = "recordings" if tuned.plan.study is None else "drives"
    words += f"on other {kind} {before:.4g} -> {after:.4g}{unit}, {change.value:+.3g}"
    if math.isnan(change.lo):
        why = "a largest value has no interval" if objective.over == MAX else "too few for an interval of it"
        return f"{words} ({why}), better in {share:.0%}"
    seen = "" if change.certain else ": no difference seen"
    return f"{words} (95 %: {change.lo:+.3g} to {change.hi:+.3g}){seen}, better in {share:.0%}"


def write_results(tuned: Tuned) -> None:
    """Write all files of the folder."""
    plan, folder = tuned.plan, tuned.folder
    _write(folder / "tune.json", json.dumps(as_json(tuned), indent=1) + "\n")
    _write(folder / "trials.csv", _csv(tuned))
    for old in folder.glob("trial-*.toml"):
        old.unlink()
    chosen = {f"trial-{one.number}.toml": one for one in tuned.points} if len(plan.objectives) > 1 else {}
    if tuned.best is not None:
        chosen["best.toml"] = tuned.best
        if plan.study is not None:
            write_drive(folder / "best-drive.toml", with_values(plan.figures(tuned.best.values), {}))
    for name, trial in chosen.items():
        _write(folder / name, _toml(tuned, trial))
    draw(tuned, folder / "tune.png", MOST_PICTURED)


def _write(file: Path, text: str) -> None:
    write(file, text, str(file))


def _toml(tuned: Tuned, trial: Trial) -> str:
    whole = "best-drive.toml is the whole drive." if tuned.plan.study else "the names are those of bench replay --set."
    names = ", ".join(one.name for one in tuned.plan.objectives)
    head = HEAD.format(
        name=tuned.plan.name, number=trial.number, trials=len(tuned.trials), objectives=names, whole=whole
    )
    return head + tomli_w.dumps(nested({
        key: value for key, value in tuned.plan.overrides(trial.values).items() if key not in tuned.plan.given
        or any(one.key.startswith(key) for one in tuned.plan.parameters)
    }))  # fmt: skip


def nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Tables within tables, of dotted keys."""
    found: dict[str, Any] = {}
    for dotted, value in values.items():
        table, *keys = found, *dotted.split(".")
        for key in keys[:-1]:
            table = table.setdefault(key, {})
        table[keys[-1]] = value
    return found


def _csv(tuned: Tuned) -> str:
    text = io.StringIO()
    out = csv.writer(text, lineterminator="\n")
    names: Sequence[str] = [one.name for one in tuned.plan.objectives]
    out.writerow(["trial", *(one.key for one in tuned.plan.parameters), *names, "lacking", "why"])
    for one in tuned.trials:
        values = ["" if np.isnan(value) else value for value in one.objectives]
        out.writerow([one.number, *(one.values[p.key] for p in tuned.plan.parameters), *values, one.lacking, one.why])
    return text.getvalue()
