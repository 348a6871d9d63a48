"""Runs every observer on every motor, kind and unkind, and with one effect of a real bench each; makes docs/effects.md.

python docs/make_effects.py [--page]

The page's words are in docs/effects/effects.md.j2, its numbers in docs/effects/numbers.json. With --page nothing is
run. The encoder is in the control loop, so that all observers see the same; errors are against the rotor itself.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from numpy.typing import NDArray

from bench.device.simulator import motors
from protocol.messages import DriveState, SetpointMode
from sim.config.params import BenchParams, Value, load_params
from sim.config.unkind import effects, unkind
from sim.drive.machine import SOURCES, SimulatedBench

DOCS = Path(__file__).parent
PARTS = DOCS / "effects"
NUMBERS = PARTS / "numbers.json"
MOTORS = {"": "the paper's motor", "anaheim-bly172s-24v": "Anaheim BLY172S", "maxon-ec45-flat": "maxon EC 45 flat"}
"""By configuration."""
SPEEDS = (0.03, 0.1, 0.33, 0.9)  # of the largest
LOADS = (0.125, 0.5)  # of the largest current
LESSONS = ((0.33, 0.06, 1.0), (0.33, 0.5, 0.7), (0.33, 1.0, 0.7), (0.33, 0.12, 0.6))
"""For the observer that learns: speed and current as shares, s."""
WARM_UP = 60.0  # s at the largest current, where something gets warm
SEEDS = (1, 2)
SETTLING = 0.25  # s
SEEN = 0.25  # s
LEAST = 0.05  # deg: a cost below it is not told from noise


def main() -> None:
    """Run and write."""
    if sys.argv[1:] != ["--page"]:
        numbers = {"effects": {name: run(name) for name in MOTORS}, "motors": reached()}
        NUMBERS.write_text(json.dumps(numbers, indent=1) + "\n")
    (DOCS / "effects.md").write_text(page(json.loads(NUMBERS.read_text())))


def run(name: str) -> dict[str, Any]:
    """What all observers' errors are on the kind bench of a motor, and by how much each effect changes them, deg."""
    file = motors()[name] if name else None
    kind = load_params(file)
    plain = errors(file, {}).rms
    cases = {**effects(kind), "all of it": unkind(kind)}
    found = {effect: errors(file, overrides).rms for effect, overrides in cases.items()}
    return {
        "kind": {observer: rounded(error) for observer, error in plain.items()},
        "costs": {
            effect: {observer: rounded(error - plain[observer]) for observer, error in of.items()}
            for effect, of in found.items()
        },
    }


def rounded(value: float) -> float:
    """Three digits behind the point."""
    return round(value, 3)


def reached() -> dict[str, dict[str, dict[str, list[float]]]]:
    """[rms, largest] of each observer's error, deg, by motor ("": the paper's) and bench (kind, unkind)."""
    found = {}
    for name, file in {"": None, **motors()}.items():
        benches = {"kind": {}, "unkind": unkind(load_params(file))}
        both = {bench: errors(file, overrides) for bench, overrides in benches.items()}
        found[name] = {
            bench: {observer: [rounded(of.rms[observer]), rounded(of.largest[observer])] for observer in of.rms}
            for bench, of in both.items()
        }
    return found


class Errors(NamedTuple):
    """Each observer's, electrical degrees."""

    rms: dict[str, float]
    largest: dict[str, float]


def errors(file: Path | None, overrides: Mapping[str, Value]) -> Errors:
    """Over all points and seeds."""
    points = [point for seed in SEEDS for point in seen(load_params(file, overrides), seed)]
    return Errors(
        {name: math.sqrt(np.mean([np.mean(point[name] ** 2) for point in points])) for name in points[0]},
        {name: float(np.max([np.abs(point[name]).max() for point in points])) for name in points[0]},
    )


def seen(params: BenchParams, seed: int) -> list[dict[str, NDArray[np.float64]]]:
    """Each observer's error at each point, deg."""
    from observers.recordings import edges

    bench = SimulatedBench(params, seed)
    angles = {entry.name: next(iter(entry.channels)) for entry in SOURCES.values()}
    bench.set_param("observer", 0)
    for key, value in edges(params).items():
        bench.set_param(key, value)
    bench.watch(frozenset(angles.values()))
    for state in (DriveState.ARMED, DriveState.RUNNING):
        bench.enter_state(state)
        bench.load_enter_state(state)
        bench.advance(1)
    found = []
    pwm_hz = params.clock.pwm_hz

    def go(speed: float, current: float, seconds: float) -> Any:
        bench.load_setpoint(SetpointMode.SPEED, speed * params.firmware.omega_m_max)
        bench.setpoint(SetpointMode.CURRENT, current * params.firmware.i_max)
        return bench.advance(round(seconds * pwm_hz))

    if params.thermal.on:
        go(0.33, 1.0, WARM_UP)
    for lesson in LESSONS:
        go(*lesson)
    for current in LOADS:
        for speed in SPEEDS:
            slow = 4.0 * math.tau / (speed * params.firmware.omega_m_max * params.motor.n_p)
            go(speed, current, SETTLING + slow)
            run = go(speed, current, max(SEEN, slow))
            theta = run["theta_true"]
            off = {name: np.degrees(theta - run[channel]) for name, channel in angles.items()}
            found.append({name: (error + 180) % 360 - 180 for name, error in off.items()})
    assert not bench.faults, bench.faults
    return found


def page(numbers: Mapping[str, Any]) -> str:
    """The page from its words and these numbers."""
    tables = [table(MOTORS[name], of["kind"], of["costs"]) for name, of in numbers["effects"].items()]
    ranks = ranked(numbers["effects"])
    environment = Environment(loader=FileSystemLoader(PARTS), undefined=StrictUndefined, keep_trailing_newline=True)
    return environment.get_template("effects.md.j2").render(
        tables=tables,
        ranks=ranks,
        reach=reach(numbers["motors"]),
        speeds=SPEEDS,
        loads=LOADS,
        seeds=len(SEEDS),
        least=LEAST,
        warm_up=WARM_UP,
    )


def reach(of: Mapping[str, Mapping[str, Mapping[str, Sequence[float]]]]) -> list[tuple[str, list[str]]]:
    """Observers, the best unkind first: rms / largest with the paper's motor, and the worst of the others."""

    def cells(observer: str) -> list[str]:
        paper = [of[""][bench][observer] for bench in ("kind", "unkind")]
        others = [[of[name][bench][observer] for name in of if name] for bench in ("kind", "unkind")]
        worst = [[max(each) for each in zip(*motor, strict=True)] for motor in others]
        return [f"{rms:.2f} / {largest:.1f}" for rms, largest in (*paper, *worst)]

    unkind_rms = {observer: figures[0] for observer, figures in of[""]["unkind"].items()}
    return [(observer, cells(observer)) for observer in sorted(unkind_rms, key=lambda name: unkind_rms[name])]


def ranked(numbers: Mapping[str, Any]) -> list[tuple[str, str, float, str]]:
    """Each effect, dearest first: the observer and the motor that it costs most, and how much, deg."""
    worst = []
    first = next(iter(numbers.values()))["costs"]
    for effect in first:
        cost, name, observer = max(
            (of["costs"][effect][observer], name, observer) for name, of in numbers.items() for observer in of["kind"]
        )
        worst.append((effect, observer, cost, MOTORS[name]))
    return sorted(worst, key=lambda one: -one[2])


def table(title: str, kind: Mapping[str, float], costs: Mapping[str, Mapping[str, float]]) -> str:
    """A motor's table: a row an effect, dearest first, a column an observer."""
    short = {entry.name: entry.short for entry in SOURCES.values()}
    order = sorted(costs, key=lambda effect: -max(costs[effect].values()))
    lines = [f"#### {title[:1].upper()}{title[1:]}", "", f"| | {' | '.join(short[name] for name in kind)} |"]
    lines += ["|---" * (len(kind) + 1) + "|", f"| kind bench | {' | '.join(f'{x:.2f}' for x in kind.values())} |"]
    for effect in order:
        cells = (costs[effect][name] for name in kind)
        lines.append(f"| {effect} | {' | '.join(cell(x) for x in cells)} |")
    return "\n".join(lines)


def cell(cost: float) -> str:
    """A cost with its sign; nothing where it is not told from noise."""
    return f"{cost:+.2f}" if abs(cost) >= LEAST else "·"


if __name__ == "__main__":
    main()
