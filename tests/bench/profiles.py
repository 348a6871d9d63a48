"""Motion profiles at random, as a file says them, and what they ask for at any time by a walk of its own."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from hypothesis import strategies as st

DRIVE, LOAD = ("speed_rpm", "current_A"), ("load_torque_Nm", "load_current_A", "load_speed_rpm")
MOST = {"speed_rpm": 3000.0, "current_A": 8.0, "load_torque_Nm": 0.5, "load_current_A": 8.0, "load_speed_rpm": 3000.0}


@dataclass(frozen=True)
class Piece:
    """What one quantity does from `begin` to `end`, s: a line between two values, or a sine."""

    quantity: str
    begin: float
    end: float
    first: float
    last: float
    sine: Mapping[str, float] | None = None

    def at(self, t: Any) -> Any:
        """At a time, or at times (n,)."""
        if self.sine is not None:
            turns = self.sine["frequency_Hz"] * (t - self.begin) + self.sine.get("phase_deg", 0.0) / 360.0
            return self.sine.get("offset", 0.0) + self.sine["amplitude"] * np.sin(2.0 * np.pi * turns)
        share = (t - self.begin) / (self.end - self.begin)
        return self.first * (1.0 - share) + self.last * share


def flat(steps: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """The steps of a file with repeats written out."""
    for step in steps:
        if "repeat" in step:
            for _ in range(step["repeat"]):
                yield from flat(step["steps"])
        else:
            yield step


def pieces_of(data: Mapping[str, Any], quantities: tuple[str, ...]) -> list[Piece]:
    """What a machine is asked for, piece by piece; of its first quantity 0 until a step names one."""
    steps = list(flat(data["steps"]))
    now, value = next((key for step in steps for key in step if key in quantities), quantities[0]), 0.0
    found, t = [], 0.0
    for step in steps:
        end = t + step.get("for_s", step.get("ramp_s"))
        key = next((key for key in step if key in quantities), None)
        if key is None:
            found.append(Piece(now, t, end, value, value))
        elif isinstance(step[key], Mapping):
            found.append(Piece(key, t, end, 0.0, 0.0, step[key]))
            now, value = key, found[-1].at(end)
        else:
            reached = t + step.get("ramp_s", 0.0)
            if reached > t:
                found.append(Piece(key, t, reached, value, step[key]))
            now, value = key, float(step[key])
            if end > reached:
                found.append(Piece(key, reached, end, value, value))
        t = end
    return found


def numbers(most: float) -> st.SearchStrategy[float]:
    return st.integers(-1000, 1000).map(lambda share: most * share / 1000.0)


@st.composite
def sines(draw: st.DrawFn, most: float) -> dict[str, float]:
    sine = {"amplitude": most * draw(st.integers(1, 500)) / 1000.0, "frequency_Hz": draw(st.integers(1, 80)) / 8.0}
    if draw(st.booleans()):
        sine["offset"] = 0.5 * draw(numbers(most))
    if draw(st.booleans()):
        sine["phase_deg"] = float(draw(st.integers(-180, 180)))
    return sine


@st.composite
def steps(draw: st.DrawFn, drive: str | None, load: str | None) -> dict[str, Any]:
    """A step for one quantity of each machine, so that each ramp has something to begin from."""
    step: dict[str, Any] = {"for_s": draw(st.integers(1, 300)) / 100.0}
    for key in (drive, load):
        if key is not None and draw(st.booleans()):
            step[key] = draw(st.one_of(numbers(MOST[key]), numbers(MOST[key]), sines(MOST[key])))
    if any(isinstance(value, float) for key, value in step.items() if key != "for_s") and draw(st.booleans()):
        step["ramp_s"] = step["for_s"] * draw(st.integers(1, 4)) / 4.0
        if step["ramp_s"] == step["for_s"] and draw(st.booleans()):
            del step["for_s"]
    if draw(st.integers(0, 3)) == 0:
        step["mark"] = draw(st.sampled_from(["reversal", "load step", "Lüfter an", "3"]))
    return step


@st.composite
def profiles(draw: st.DrawFn, drive: str | None = "", load: str | None = "") -> dict[str, Any]:
    """A file as plain data; of the given quantities, None for none, or of any."""
    drive = draw(st.sampled_from(DRIVE)) if drive == "" else drive
    load = draw(st.sampled_from((None, *LOAD[:2]))) if load == "" else load
    one = steps(drive, load)
    inner = st.fixed_dictionaries({"repeat": st.integers(1, 3), "steps": st.lists(one, min_size=1, max_size=3)})
    outer = st.fixed_dictionaries(
        {"repeat": st.integers(1, 3), "steps": st.lists(st.one_of(one, inner), min_size=1, max_size=3)}
    )
    data: dict[str, Any] = {"steps": draw(st.lists(st.one_of(one, one, outer), min_size=1, max_size=5))}
    if any("current_A" in step for step in flat(data["steps"])):
        data["max_speed_rpm"] = 1000.0
    return data
