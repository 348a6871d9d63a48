"""What is left to gain: edge_kalman's constants against the best that a search finds. `python -m tests.tuning`.

    python -m tests.tuning screen       each constant x 0.7 and x 1.4, one at a time, on the drives to tune on
    python -m tests.tuning tune         CMA-ES over those that matter, by the same drives (needs `pip install cmaes`)
    python -m tests.tuning prove        what it found on other seeds and other motors, beside it and in control
    python -m tests.tuning paper        the paper's gains of vector_tracking against the best that bench tune finds
    python -m tests.tuning              all of them

Each writes its part of tests/tuning/found.json. The loss is the mean over drives and over RANGES and steps of
log((error + FLOOR) / (error as it is + FLOOR)): 0 as it is, -0.1 for errors that are 10 % smaller. What the filter says
of its own error has to stay true: for each percent of the time that more of it is beyond three standard deviations the
loss is 0.1 larger. A quarter of the drives to tune on have pulses on their Hall inputs; it was screened without them.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from bench.cli.output import Progress
from sim.drive.machine import SOURCES
from tests.tuning import paper
from tests.tuning.benches import (
    DESIGNED_ON,
    KIND,
    LOST,
    OBSERVER,
    OTHERS,
    PULSES,
    RANGES,
    STEPS,
    UNKIND,
    Drive,
    drive,
)
from tests.tuning.constants import Constants

FOUND = Path(__file__).with_name("found.json")
TUNED_ON = range(1, 9)
"""Seeds."""
PROVED_ON = range(101, 111)
KINDS = (*RANGES, STEPS)
FLOOR = 0.05  # deg
HONEST = 10.0
TRIPPED = 2.0  # in the place of a share
MOST = 40  # constants that are tuned together
TIMES = 1.4  # by which each is changed to see what it does
FURTHEST = math.log(4.0)  # by which a constant may change
SIGMA = 0.2  # of the search at its begin, natural logarithm


def sizes(constants: Constants, one: Drive) -> list[float]:
    """Of a drive by kind of stretch the mean of log(error + FLOOR), then the share beyond three standard deviations."""
    found = constants.start(one.pwm_hz, one.parameters).run(one.samples, one.reset)
    errors: dict[str, list[float]] = {}
    for kind, error in one.errors(found["theta"]):
        errors.setdefault(kind, []).append(math.log(error + FLOOR))
    return [float(np.mean(errors[kind])) for kind in KINDS] + [one.beyond(found["theta"], found["sigma"])]


class Beside:
    """The observer beside drives that are recorded."""

    def __init__(self, constants: Constants, drives: Sequence[Drive]) -> None:
        self._constants, self.drives = constants, drives
        self.as_it_is = self.table({})

    def table(self, values: Mapping[str, float]) -> np.ndarray:
        """(drives, kinds + 1) of `sizes` with these constants."""
        self._constants.set(values)
        return np.array([sizes(self._constants, one) for one in self.drives])

    def loss(self, values: Mapping[str, float]) -> float:
        """See the module."""
        *changed, beyond = (self.table(values) - self.as_it_is).mean(0)
        return float(np.mean(changed) + HONEST * max(beyond, 0.0))


@contextmanager
def in_control(constants: Constants):  # type: ignore[no-untyped-def]
    """Drives that are made meanwhile use this observer, with the constants of now."""
    source = next(source for source, entry in SOURCES.items() if entry.name == OBSERVER)
    before = SOURCES[source]
    SOURCES[source] = constants.entry
    try:
        yield
    finally:
        SOURCES[source] = before


def _beside(constants: Constants, pulses: bool = True) -> Beside:
    """The drives to tune on, with pulses on a quarter of them."""
    kinds = {seed: UNKIND if seed % 4 or not pulses else PULSES for seed in TUNED_ON}
    constants.set({})
    return Beside(constants, [drive(name, seed, kind) for name in DESIGNED_ON for seed, kind in kinds.items()])


def screen(beside: Beside, constants: Constants) -> dict[str, list[float]]:
    """Loss by constant, of a value `TIMES` smaller and larger."""
    found = {}
    for name, value in constants.as_they_are.items():
        found[name] = [round(beside.loss({name: value * times}), 5) for times in (1.0 / TIMES, TIMES)]
        print(f"{name} {found[name]}", flush=True)
    return found


def tune(beside: Beside, constants: Constants, names: Sequence[str], seconds: float) -> dict[str, Any]:
    """The best of a search over these constants."""
    from cmaes import CMA

    n = len(names)
    search = CMA(np.zeros(n), SIGMA, np.array([[-FURTHEST, FURTHEST]] * n), seed=1)
    best, trials, end = (0.0, np.zeros(n)), 0, time.monotonic() + seconds
    while time.monotonic() < end and not search.should_stop():
        told = []
        for _ in range(search.population_size):
            x = search.ask()
            loss = beside.loss(
                {name: constants.as_they_are[name] * math.exp(v) for name, v in zip(names, x, strict=True)}
            )
            told.append((x, loss))
            trials += 1
            if loss < best[0]:
                best = loss, x
        search.tell(told)
        print(
            f"{trials} trials, generation {search.generation}: {min(v for _, v in told):.4f}, best {best[0]:.4f}",
            flush=True,
        )
    return {
        "trials": trials, "loss": best[0],
        "constants": {name: constants.as_they_are[name] * math.exp(v) for name, v in zip(names, best[1], strict=True)},
    }  # fmt: skip


PROOFS = (
    ("the four that were tuned on", DESIGNED_ON, UNKIND),
    ("seven other motors", OTHERS, UNKIND),
    ("all eleven", (*DESIGNED_ON, *OTHERS), PULSES),
    ("all ten motors", (*DESIGNED_ON[1:], *OTHERS), KIND),
)


def prove(constants: Constants, values: Mapping[str, float], done: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Rows: errors with these constants by those as they are, with 95 % intervals, on drives that were not tuned on."""
    there = {(row["drives"], row["kind"], row["control"]) for row in done}
    for (what, names, kind), control in product(PROOFS, (False, True)):
        if (what, kind, control) in there:
            continue
        by_name = [[_pair(constants, values, name, seed, kind, control) for seed in PROVED_ON] for name in names]
        judged = [np.array([pair for pair in pairs if pair]) for pairs in by_name]
        every = np.concatenate(judged)
        change = (every[:, 1] - every[:, 0])[:, :-1]
        if names is not DESIGNED_ON:  # what is told is of motors: ten drives of one are not ten of them
            change = np.array([(pairs[:, 1] - pairs[:, 0])[:, :-1].mean(0) for pairs in judged])
        yield {
            "drives": what, "kind": kind, "control": control, "n": len(every), "over": len(change),
            "tripped": [len(names) * len(PROVED_ON) - len(every), int((every[:, 1, -1] > TRIPPED - 0.5).sum())],
            "beyond": [round(100.0 * float(every[:, k, -1].clip(0.0, 1.0).mean()), 3) for k in (0, 1)],
        } | ratios(change)  # fmt: skip


def _pair(
    constants: Constants, values: Mapping[str, float], name: str, seed: int, kind: str, control: bool
) -> list[list[float]]:
    """`sizes` of a drive as it is, and with these constants; nothing of one that trips as it is."""
    constants.set({})
    try:
        before = drive(name, seed, kind)
    except AssertionError:
        return []
    found = [sizes(constants, before)]
    constants.set(values)
    try:
        with in_control(constants) if control else nullcontext():
            found.append(sizes(constants, drive(name, seed, kind) if control else before))
    except AssertionError:  # it has lost its angle
        found.append([math.log(LOST)] * len(KINDS) + [TRIPPED])
    return found


def ratios(changed: np.ndarray) -> dict[str, list[float]]:
    """Of changes (drives, kinds) of a logarithm: the factor, and the ends of its 95 % interval over drives; by kind."""
    found = {}
    for k, kind in enumerate((*KINDS, "all")):
        values = changed.mean(1) if kind == "all" else changed[:, k]
        half = float(stats.t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / math.sqrt(len(values)))
        mean = float(values.mean())
        found[kind] = [round(math.exp(x), 4) for x in (mean, mean - half, mean + half)]
    return found


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(prog="python -m tests.tuning", description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", help="screen, tune, prove, paper")
    parser.add_argument("--minutes", type=float, default=18.0, help="for the search")
    parser.add_argument("--most", type=int, default=MOST, help="constants that are tuned together")
    parser.add_argument("--folder", type=Path, help="where the tunes of the paper's gains are kept")
    parser.add_argument("--file", type=Path, default=FOUND)
    given = parser.parse_args()
    parts = given.parts or ["screen", "tune", "prove", "paper"]
    found = json.loads(given.file.read_text()) if given.file.exists() else {}
    if "paper" in parts:
        with tempfile.TemporaryDirectory() as folder, Progress() as progress:
            found["paper"] = list(paper.rows(given.folder or Path(folder), progress, time.monotonic))
    constants = Constants()
    for part in parts:
        if part == "paper":
            pass
        elif part == "screen":
            found[part] = screen(_beside(constants, pulses=False), constants)
        elif part == "tune":
            effects = found["screen"]
            names = sorted(effects, key=lambda name: -max(map(abs, effects[name])))[: given.most]
            found.pop("prove", None)
            found[part] = tune(_beside(constants), constants, names, 60.0 * given.minutes)
        else:
            found.setdefault(part, [])
            for row in prove(constants, found["tune"]["constants"], found[part]):
                print(row, flush=True)
                found[part].append(row)
                given.file.write_text(json.dumps(found, indent=1) + "\n")
        found["as_they_are"] = constants.as_they_are
        given.file.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
