"""The same scenarios for every observer: recordings of the simulated drive with the truth beside them, and the table
of what each observer makes of them.

The encoder is in the loop, so that all observers see the same run. Sensors as in Table I, 20 mA of noise, 10 % of the
dead time's error uncompensated: the defaults of the simulated bench. Unless a scenario begins at standstill, a lap of
2.4 s at 1000 r/min and 1 A, both ways, comes first: an observer that learns has learned then.

`python tests/sim/observers/battery.py` prints the table, means over five seeds; tests/data/battery.txt is such a table.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from ideal_motor import N_P, PSI_F, PWM_HZ, TABLE_I, TICK_HZ, error_deg, table

from protocol.signals import AngleSource
from sim.drive.machine import Recorded
from sim.observers.catalogue import CATALOGUE
from tests.sim.drive.rig import Rig, column, front_end

TORQUE = 1.5 * N_P * PSI_F  # N m/A
HALF_HYSTERESIS = 0.25  # deg
INSIDE = 5.0  # deg from the end of the sector where a start-up begins
MISPLACED = np.abs(TABLE_I).max() + HALF_HYSTERESIS + 4 * 0.05  # deg, four sigma of jitter
TOLD = {"lookup_table": table(TABLE_I - HALF_HYSTERESIS, TABLE_I + HALF_HYSTERESIS)}
"""Drive parameters that an observer gets instead of the defaults: the table was measured beforehand."""


class Recording(NamedTuple):
    """A run of the drive: what observers are given, and the truth; arrays of shape (n,)."""

    samples: np.ndarray  # of the front end
    reset: np.ndarray
    scored: np.ndarray  # where errors count
    theta: np.ndarray  # electrical rad, unwrapped
    omega: np.ndarray  # electrical rad/s
    edge_samples: np.ndarray  # shape (m,): the sample that takes in each edge
    drive: dict[str, float]  # parameters
    theta_vt: np.ndarray  # electrical rad, as the drive's own vector tracking had it

    def run(self, name: str, believed: Mapping[str, float] | None = None):
        """State and estimates of the observer; `believed`: factors on the drive's parameters."""
        entry = CATALOGUE[name]
        drive = self.drive | TOLD.get(name, {})
        drive |= {key: drive[key] * factor for key, factor in (believed or {}).items()}
        at_work = entry.start(entry.make_params(PWM_HZ, drive))
        estimates = at_work.run(self.samples, self.reset).view(np.recarray)
        return at_work.state.first, estimates

    def estimates(self, name: str, believed: Mapping[str, float] | None = None):
        return self.run(name, believed)[1]

    def error(self, out) -> np.ndarray:
        """Actual less estimated angle, deg."""
        return error_deg(self.theta, out.theta)


class Tape:
    """A bench that is recorded phase by phase; `scored` marks the phases whose errors count."""

    def __init__(self, seed: int = 1, **settings: object) -> None:
        """`settings`: as `section__name=value`."""
        self.bench = Rig(seed, **{key.replace("__", "."): value for key, value in settings.items()})
        self.bench.set_param("observer", AngleSource.ENCODER)
        self._parts, self._scored, self._resets, self._reset = [], [], [], True
        for part in self.bench.start():
            self._keep(part)

    def _keep(self, part: Recorded, scored: bool = False) -> None:
        n = len(part.samples)
        self._parts.append(part)
        self._scored.append(np.full(n, scored))
        self._resets.append(np.arange(n) < self._reset)
        self._reset = False

    def lose(self, n: int) -> None:
        """Go on for `n` periods of which nothing arrives: a reset follows."""
        self.bench.advance(n)
        self._reset = True

    def forced(self, rpm: float, i_q: float, seconds: float, scored: bool = False) -> None:
        self._keep(self.bench.forced(rpm, i_q, seconds), scored)

    def spin(self, rpm: float, seconds: float, scored: bool = False, load: float = 0.0) -> None:
        """Speed by the drive; `load`: torque worth so many A."""
        self._keep(self.bench.spin(rpm, seconds, load * TORQUE), scored)

    def recording(self) -> Recording:
        assert not self.bench.faults

        def joined(name):
            return np.concatenate([column(part, name) for part in self._parts])

        edges = np.concatenate([part.captured for part in self._parts])
        tick = np.concatenate([part.tick + np.arange(len(part)) * (TICK_HZ // PWM_HZ) for part in self._parts])
        reset = np.concatenate(self._resets)
        return Recording(
            front_end(self.bench, self._parts, reset),
            reset,
            np.concatenate(self._scored),
            joined("theta_e"),
            joined("omega_e"),
            np.searchsorted(tick, edges["tick"]),
            dict(self.bench.parameters),
            joined("theta_vt"),
        )


Figures = tuple[float, float]


def std_and_largest(errors: list[np.ndarray], spared: float = 0.0) -> Figures:
    """Of the errors, deg, without the share `spared` of them, the largest."""
    error = np.concatenate(errors)
    error = error[np.argsort(np.abs(error))][: round((1.0 - spared) * error.size)]
    return float(error.std()), float(np.abs(error[-1]))


@dataclass(frozen=True)
class Scenario:
    """What is done after the lap; `believed`: factors on parameters that the observers are given.

    `spared`: such a share of the samples may be as wrong as it likes. `tolerance`: relative, of the table's figures.
    """

    play: Callable[[Tape], None]
    settings: Mapping[str, object] = field(default_factory=dict)
    believed: Mapping[str, float] = field(default_factory=dict)
    spared: float = 0.0
    tolerance: float = 0.25

    def record(self, seed: int = 1) -> list[Recording]:
        """The lap and the rest."""
        tape = Tape(seed, **self.settings)
        tape.forced(1000, 1.0, 1.2)
        tape.forced(-1000, 1.0, 1.2)
        self.play(tape)
        return [tape.recording()]

    def figures(self, recordings: list[Recording], estimates: list) -> Figures:
        """Std and largest size of the error where it counts, deg."""
        pairs = zip(recordings, estimates, strict=True)
        return std_and_largest([one.error(out)[one.scored] for one, out in pairs], self.spared)


class StartUp(Scenario):
    """From rest at either end of each of the six sectors; no lap before."""

    def record(self, seed: int = 1) -> list[Recording]:
        """One a start. What counts begins with the second edge."""
        opens = 60.0 * np.arange(7) - np.r_[TABLE_I, TABLE_I[0]]
        found = []
        for theta_0 in np.r_[opens[:6] + INSIDE, opens[1:] - INSIDE]:
            tape = Tape(seed, mechanics__theta_0_deg=theta_0)
            self.play(tape)
            one = tape.recording()
            found.append(one._replace(scored=np.arange(one.reset.size) >= one.edge_samples[1]))
        return found


class Stop(Scenario):
    """A shaft that is blocked."""

    def figures(self, recordings: list[Recording], estimates: list) -> Figures:
        """Time until the speed stays below a tenth of what it was, ms, and largest size of the error, deg."""
        ((one, out),) = zip(recordings, estimates, strict=True)
        above = np.abs(out.omega[one.scored]) > 0.1 * np.abs(one.omega).max()
        seen = np.flatnonzero(above).max(initial=-1) + 1
        return float(seen) / PWM_HZ * 1e3, std_and_largest([one.error(out)[one.scored]])[1]


def steady(rpm: float, seconds: float = 0.6) -> Callable[[Tape], None]:
    """Constant speed at 4 A."""

    def play(tape: Tape) -> None:
        tape.forced(rpm, 4.0, 0.6)
        tape.forced(rpm, 4.0, seconds, scored=True)

    return play


def change(before: float, after: float, load: float = 0.0) -> Callable[[Tape], None]:
    """From one speed to another, the load torque from nothing to one worth `load` A, and half a second of it."""

    def play(tape: Tape) -> None:
        tape.spin(before, 0.8)
        tape.spin(after, 0.5, scored=True, load=load)

    return play


def glitches(tape: Tape) -> None:
    tape.bench.set_load_param("hall_glitch", 50.0)
    steady(500)(tape)


def gaps(tape: Tape) -> None:
    """Six losses of 50 ms and more, each ending at another place in the turn; 0.1 s to find back."""
    tape.forced(500, 4.0, 0.4)
    for k in range(6):
        tape.lose(800 + 53 * k)
        tape.forced(500, 4.0, 0.1)
        tape.forced(500, 4.0, 0.1, scored=True)


def broken_wire(tape: Tape) -> None:
    """Sensor b's wire breaks at 500 r/min: its input reads 1."""
    tape.forced(500, 4.0, 0.4)
    tape.bench.set_load_param("hall_open", 2)
    tape.forced(500, 4.0, 0.6, scored=True)


def brake(tape: Tape) -> None:
    """As hard as 8 A can."""
    tape.bench.set_param("alpha_m_max", 10_000.0)
    change(1000, 200)(tape)


def blocked(tape: Tape) -> None:
    tape.forced(-1000, 4.0, 0.4)
    tape.forced(0, 4.0, 0.6, scored=True)


def standstill(tape: Tape) -> None:
    """Still to be held at 4 A, long after the last edge."""
    tape.forced(500, 4.0, 0.4)
    tape.forced(0, 4.0, 0.5)
    tape.forced(0, 4.0, 1.0, scored=True)


SCENARIOS = {
    "steady 50": Scenario(steady(50, 1.0)),
    "steady 200": Scenario(steady(200)),
    "steady 500": Scenario(steady(500)),
    "steady 1000": Scenario(steady(1000)),
    "steady 3000": Scenario(steady(3000)),
    "steady -500": Scenario(steady(-500)),
    "start 400": StartUp(lambda tape: tape.spin(400, 0.4)),
    "start -400": StartUp(lambda tape: tape.spin(-400, 0.4)),
    "reversal": Scenario(change(500, -500), tolerance=0.35),
    "speed step": Scenario(change(500, 1000)),
    "load step": Scenario(change(500, 500, load=4.0)),
    "braking": Scenario(brake),
    "sudden stop": Stop(blocked, {"load__alpha_m_max": 0.0}),
    "glitches": Scenario(glitches, spared=0.02),
    "gaps": Scenario(gaps),
    "50 mA offset": Scenario(steady(200), {"current_sensor__offset": [0.05, -0.05, 0.0]}),
    "R_s +30 %": Scenario(steady(200), believed={"R_s_hat": 1.3}),
    "L_s +20 %": Scenario(steady(200), believed={"L_s_hat": 1.2}),
    "psi_f -10 %": Scenario(steady(200), believed={"psi_f_hat": 0.9}),
    "broken wire": Scenario(broken_wire, {"firmware__protection__hall_fault_time": 10.0}),
}
STANDSTILL = Scenario(standstill)
LABEL = 13  # width of the table's first column


def measured(seeds: Sequence[int]) -> Iterator[str]:
    """The table's lines: means over the seeds."""
    yield " " * LABEL + " ".join(f"{entry.short:>9}" for entry in CATALOGUE.values())
    for label, scenario in SCENARIOS.items():
        found: dict[str, list[Figures]] = {name: [] for name in CATALOGUE}
        for seed in seeds:
            recordings = scenario.record(seed)
            for name, figures in found.items():
                estimates = [one.estimates(name, scenario.believed) for one in recordings]
                figures.append(scenario.figures(recordings, estimates))
        cells = ["{:.1f}/{:.1f}".format(*np.mean(figures, axis=0)) for figures in found.values()]
        yield f"{label:{LABEL}}" + " ".join(f"{cell:>9}" for cell in cells)


def limits(text: str) -> dict[tuple[str, str], Figures | None]:
    """The table's cells by scenario and observer's short name; None for "-": nothing is claimed there."""
    header, *lines = text.strip("\n").splitlines()
    found: dict[tuple[str, str], Figures | None] = {}
    for line in lines:
        for short, cell in zip(header.split(), line[LABEL:].split(), strict=True):
            first, _, second = cell.partition("/")
            found[line[:LABEL].strip(), short] = None if cell == "-" else (float(first), float(second))
    return found


if __name__ == "__main__":
    for row in measured(range(1, 6)):
        print(row, flush=True)
