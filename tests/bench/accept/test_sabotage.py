"""Sabotage proves the suite: a broken drive fails in the measurements that should notice, by name.

`sabotage.toml` names what must notice a broken configuration, and says why. The holes that the suite once had are each
held shut on two motors: protection that is dead, observers that are wrong in one line. A sabotage runs what must
notice and a few tests that must not. Whether currents stayed in bounds and the outputs went off is asked of the
simulated drive.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Any
from unittest.mock import patch
from zlib import crc32

import numpy as np
import pytest
from accepting import Accepting, Run, SpoiltLink
from benches import configured
from mutants import Looked, believes, blind_to, flawed, forgets, goes_on, late, limits_changed, mutant
from virtual_run import at_rest

from bench.accept.results import Verdict
from bench.device.simulator import motors
from protocol.device.state import StateMachine
from protocol.messages import DriveState
from protocol.signals import MILLI
from sim.config.params import load_params
from sim.drive.machine import Recorded, SimulatedBench
from sim.ports.device import SimulatedDevice
from tests.choice import sampled

pytestmark = [pytest.mark.long("a good part of the suite for each sabotage")]

SABOTAGES = tomllib.loads(Path(__file__).with_name("sabotage.toml").read_text())
BROKEN_CONFIGS = [name for name, sabotage in SABOTAGES.items() if "config" in sabotage]
QUIET = ("current_offsets", "watchdog", "stop", "trip")
MOTORS = ("", "anaheim-bly172s-24v")  # the paper's, and one of four pole pairs


class WatchedBench(SpoiltLink):
    """A simulated bench that loses a frame of samples at `lose_at` s, and keeps how it stood when it was left."""

    def __init__(self, device: SimulatedDevice, lose_at: float) -> None:
        super().__init__(device)
        self.lose_at = lose_at
        self.left_at_rest = False

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        if self.clock() >= self.lose_at:
            self.lose_at, self.lose = math.inf, 1
        return super().read(timeout, settle)

    def close(self) -> None:
        self.left_at_rest = at_rest(self.device)
        super().close()


@dataclass
class Workshop:
    """Runs the suite on a drive that is broken by `config`, or that loses a frame at a time, by test."""

    accepting: Accepting
    opened: list[WatchedBench] = field(default_factory=list)
    i_trip: float = 0.0
    largest: float = 0.0
    """Phase current in A, of all tests and control periods."""

    def run(
        self, config: str = "", lose_at: Mapping[str, float] | None = None, keyword: str | None = None, motor: str = ""
    ) -> Run:
        file = self.accepting.directory / "sabotage.toml"
        file.write_text((motors()[motor].read_text() if motor else "") + config)
        self.i_trip = load_params(file).firmware.protection.i_trip
        by_seed = {crc32(test.encode()): at for test, at in (lose_at or {}).items()}

        def open_virtual(config: Path, overrides: Mapping[str, float], seed: int) -> WatchedBench:
            device = SimulatedDevice(load_params(config, overrides), seed)
            self.opened.append(WatchedBench(device, by_seed.get(seed, math.inf)))
            return self.opened[-1]

        advance = SimulatedBench.advance

        def watched(bench: SimulatedBench, n: int) -> Recorded:
            recorded = advance(bench, n)
            currents = [np.abs(recorded.samples[phase].astype(int)).max() for phase in ("i_a", "i_b", "i_c")]
            self.largest = max(self.largest, MILLI * float(max(currents)))
            return recorded

        with (
            patch("sim.ports.virtual.open_virtual", open_virtual),
            patch.object(SimulatedBench, "advance", watched),
        ):
            return self.accepting(config=file, keyword=keyword)

    def require_safe(self) -> None:
        """Outputs were off at each test's end, and no current came to the one at which the drive trips."""
        assert {bench.left_at_rest for bench in self.opened} == {True}
        assert 0.0 < self.largest < self.i_trip


@pytest.fixture
def workshop(accepting: Accepting) -> Workshop:
    return Workshop(accepting)


def named(patterns_by_test: Mapping[str, list[str]], run: Run) -> set[str]:
    """Full names of the measurements that are meant."""
    found: set[str] = set()
    for test, patterns in patterns_by_test.items():
        names = {measurement.limits.name for measurement in run[test].measurements}
        meant: set[str] = set()
        for pattern in patterns:
            matched = {name for name in names if fnmatchcase(name, pattern.removeprefix("!"))}
            assert matched, f"{test} measures nothing like '{pattern}'"
            meant = meant - matched if pattern.startswith("!") else meant | matched
        found |= {f"{test}.{name}" for name in meant}
    return found


def _family(test: str) -> str:
    return test.partition("[")[0]


def concerned(sabotage: Mapping[str, Any]) -> str:
    """Keyword of the tests that must notice, and of some that must not."""
    tests = {*sabotage["must"], *sabotage.get("at", {}), *QUIET}
    return " or ".join(sorted({_family(test) for test in tests}))


def assert_noticed(sabotage: Mapping[str, Any], run: Run, verdict: Verdict) -> None:
    """What must notice did, and said so by `verdict`; in no test but those that are named."""
    must = named(sabotage["must"], run)
    noticed = {name: m.verdict for name, m in run.measured.items() if m.verdict is not Verdict.PASS}
    assert must - noticed.keys() == set(), "should have noticed"
    strangers = {
        test.name
        for test in run.result.tests
        if test.verdict is not Verdict.PASS
        and test.name not in sabotage["must"]
        and _family(test.name) not in sabotage.get("may", ())
    }
    assert strangers == set(), "should not have noticed"
    assert set(noticed.values()) == {verdict}


@pytest.mark.parametrize("name", sampled("config", BROKEN_CONFIGS, 1, campaign="sabotage"))
def test_a_broken_drive_fails_where_it_should(name: str, workshop: Workshop) -> None:
    run = workshop.run(SABOTAGES[name]["config"], keyword=concerned(SABOTAGES[name]))
    assert_noticed(SABOTAGES[name], run, Verdict.FAIL)
    assert run.code == 1
    workshop.require_safe()


DIRECTIONS = ("forward", "reverse")
AXES = [f"{phase}{sign}" for phase in "abc" for sign in "+-"]
TRIPS = [f"trip_time.{axis}" for axis in AXES]
PROTECTED = ("trip_over_current", *(f"trip[{it}]" for it in ("over-speed", "under-voltage", "over-voltage")),
             *(f"trip_hall[{it}]" for it in ("open", "shorted", "exchanged")))  # fmt: skip
PAIRS = {"ab": 1, "bc": 2, "ca": 3}


def _turns(kinds: str, whats: Iterable[str], ways: Iterable[str] = DIRECTIONS) -> dict[str, list[str]]:
    """The times of `trip_hall` for these ways to be wrong."""
    return {f"trip_hall[{kind}]": [f"turns.{what}.{way}" for what in whats for way in ways] for kind in kinds.split()}


def _wire_is_wrong(bit: int) -> Callable[[Looked], bool]:
    return lambda seen: bool((int(seen.load["hall_open"]) | int(seen.load["hall_short"])) & bit)


def _pair_is_wrong(number: int) -> Callable[[Looked], bool]:
    return lambda seen: seen.load["hall_swap"] == number


never = lambda limit: math.inf  # noqa: E731
Made = Callable[[], AbstractContextManager[object]]
FLAWS: dict[str, tuple[Made, dict[str, list[str]]]] = {
    "over-current dead": (lambda: limits_changed(i_trip=never), {"trip_over_current": [*TRIPS, "named"]}),
    "over-current at 1.5 times": (
        lambda: limits_changed(i_trip=lambda amps: 1.5 * amps), {"trip_over_current": [*TRIPS, "named"]}
    ),
    "over-current at 1.15 times": (
        lambda: limits_changed(i_trip=lambda amps: 1.15 * amps), {"trip_over_current": [*TRIPS, "named"]}
    ),
    "over-current at 0.8 times": (
        lambda: limits_changed(i_trip=lambda amps: 0.8 * amps),
        {"trip_over_current": [f"no_trip.{axis}" for axis in AXES]},
    ),
    "over-current 50 ms late": (lambda: flawed(late(0.05)), {"trip_over_current": TRIPS}),
    "over-current 2 ms late": (lambda: flawed(late(0.002)), {"trip_over_current": TRIPS}),
    **{
        f"over-current blind to {axis}": (
            lambda axis=axis: flawed(blind_to(axis[0], float(axis[1] + "1"))),
            {"trip_over_current": [f"trip_time.{axis}", "named"]},
        )
        for axis in AXES
    },
    "over-speed dead": (
        lambda: limits_changed(omega_trip=never),
        {"trip[over-speed]": [f"trip_time.{way}" for way in DIRECTIONS]},
    ),
    "over-speed blind in reverse": (
        lambda: flawed(lambda seen: seen.unless(seen.speed < 0.0, "omega_trip")),
        {"trip[over-speed]": ["trip_time.reverse", "named"]},
    ),
    "over-speed blind forward": (
        lambda: flawed(lambda seen: seen.unless(seen.speed > 0.0, "omega_trip")),
        {"trip[over-speed]": ["trip_time.forward", "named"]},
    ),
    "over-speed 50 ms late": (
        lambda: limits_changed(speed_periods=lambda n: n + 800),
        {"trip[over-speed]": [f"trip_time.{way}" for way in DIRECTIONS]},
    ),
    "over-speed at 0.8 times": (
        lambda: limits_changed(omega_trip=lambda speed: 0.8 * speed),
        {"trip[over-speed]": [f"no_trip.{way}" for way in DIRECTIONS]},
    ),
    "under-voltage dead": (lambda: limits_changed(u_dc_min=lambda volts: 0.0), {"trip[under-voltage]": ["trip_time"]}),
    "over-voltage dead": (lambda: limits_changed(u_dc_max=never), {"trip[over-voltage]": ["trip_time"]}),
    **{
        f"HALL blind to wire {wire}": (
            lambda bit=bit: flawed(believes(_wire_is_wrong(bit))), _turns("open shorted", [wire])
        )
        for wire, bit in {"a": 1, "b": 2, "c": 4}.items()
    },
    **{
        f"HALL blind to {pair} exchanged": (
            lambda number=number: flawed(believes(_pair_is_wrong(number))), _turns("exchanged", [pair])
        )
        for pair, number in PAIRS.items()
    },
    "HALL blind to a reversed sequence": (
        lambda: limits_changed(opposed_max=never), _turns("exchanged", PAIRS)
    ),
    "HALL blind in reverse": (
        lambda: flawed(believes(lambda seen: seen.speed < 0.0)),
        _turns("open shorted", "abc", ["reverse"]) | _turns("exchanged", PAIRS, ["reverse"]),
    ),
    "outputs stay on": (goes_on, {test: ["current_after"] for test in PROTECTED}),
    "restarts by itself": (lambda: forgets(DriveState.RUNNING), {"trip_over_current": ["latched"]}),
    "clears its faults": (lambda: forgets(DriveState.IDLE), {"trip_over_current": ["latched"]}),
}  # fmt: skip
"""What is wrong with the protection, and by test the measurements that must notice."""
ALL = ("outputs stay on", "restarts by itself", "clears its faults")  # what is wrong with all of it


@pytest.mark.parametrize(("name", "motor"), sampled("flaw", product(FLAWS, ("", *motors())), 3, campaign="sabotage"))
def test_a_flaw_of_the_protection_fails_in_its_own_test(name: str, motor: str, workshop: Workshop) -> None:
    made, must = FLAWS[name]
    concerned = {test.partition("[")[2].rstrip("]") or test for test in must}
    with made():
        run = workshop.run(keyword=f"trip and ({' or '.join(concerned)} or over-voltage)", motor=motor)
    failed = {name for name, m in run.measured.items() if m.verdict is not Verdict.PASS}
    wanted = {f"{test}.{measurement}" for test, found in must.items() for measurement in found}
    assert failed >= wanted
    strangers = {test for test, verdict in run.tests.items() if verdict != "PASS" and test not in must}
    assert strangers == set() or name in ALL
    if "blind to" in name:  # and to nothing else
        assert {it for it in failed if ".trip_time." in it or ".turns." in it} == wanted - {"trip_over_current.named"}
    workshop.require_safe()


def test_a_threshold_that_nothing_reaches_is_none(workshop: Workshop) -> None:
    run = workshop.run(
        "[firmware.protection]\ni_trip = 900.0\nomega_m_trip = 9000.0\nu_dc_min = 0.0\nu_dc_max = 900.0", keyword="trip"
    )
    failed = {name for name, m in run.measured.items() if m.verdict is Verdict.FAIL}
    thresholds = {f"{test}.threshold" for test in PROTECTED if "hall" not in test}
    assert failed == thresholds | {"trip_over_current.seen"}


BACKWARDS = "+ (0.0873 if {} < 0.0 else 0.0)"  # 5 deg
WRONG = {
    "vector-tracking": (
        ("vector_tracking", "Estimate(theta, omega_lpf,", f"Estimate(theta {BACKWARDS.format('omega_h')}, omega_lpf,"),
        ["error_mean.slow.backwards", "error_mean.fast.backwards"],
    ),
    "sector-centre": (
        ("sector_centre", "Estimate(theta, hall", f"Estimate(theta {BACKWARDS.format('hall.omega')}, hall"),
        ["error_mean.slow.backwards", "error_mean.fast.backwards"],
    ),
    "hall-vector-decoupled": (
        ("hall_vector_decoupled", "return math.sin(sixfold)", "return -math.sin(sixfold)"), ["ratio.slow"],
    ),
    "lookup-table": (
        ("lookup_table", "omega = hall.omega * (passed / SECTOR_WIDTH)", "omega = hall.omega"),
        ["error_std.slow.forwards", "error_std.fast.backwards"],
    ),
    "edge-kalman": (
        ("edge_kalman", "Estimate(theta, omega_lpf, sens", "Estimate(theta + 0.08, omega_lpf, sens"),
        ["error_mean.fast.forwards", "error_mean.fast.backwards"],
    ),
}  # fmt: skip
"""By test: what is wrong in one line of the observer, and the measurements that must notice."""
MORE = {"hall-vector-decoupled": {"module": "hall_vector", "decouple": True}}


QUICK = [*product(("sector-centre", "lookup-table", "hall-vector-decoupled"), MOTORS)]
COMPILED = [*product(("vector-tracking", "edge-kalman"), MOTORS)]


@pytest.mark.parametrize(
    ("name", "motor"),
    [*sampled("quick", QUICK, 2, campaign="sabotage"), *sampled("compiled", COMPILED, 0, campaign="sabotage")],
)
def test_an_observer_that_is_wrong_in_one_line_fails_in_its_own_test(name, motor, workshop, tmp_path_factory) -> None:
    change, must = WRONG[name]
    with mutant(*change, tmp_path_factory.getbasetemp(), **MORE.get(name, {})):
        run = workshop.run(keyword=f"observer and {name} or observer and average", motor=motor)
    failed = {name for name, m in run.measured.items() if m.verdict is Verdict.FAIL}
    assert failed >= {f"observer[{name}].{measurement}" for measurement in must}
    assert run.tests["observer[average-speed]"] == "PASS"
    workshop.require_safe()


def test_the_lines_that_are_made_wrong_are_there() -> None:
    for name, ((module, old, new), _must) in WRONG.items():
        file = find_spec(f"sim.observers.{MORE.get(name, {}).get('module', module)}").origin
        assert Path(file).read_text().count(old) == 1, name
        assert old != new


NAMED = {
    "pole pairs": ("firmware.n_p", lambda motor: motor.n_p + 1, "back_emf_and_encoder.encoder_turns"),
    "flux linkage": ("firmware.psi_f_hat", lambda motor: 0.7 * motor.psi_f, "back_emf_and_encoder.psi_f_deviation"),
    "wiring": ("wiring.hall_swap", lambda motor: 2, "hall_edges.wiring_as_specified"),
}


@pytest.mark.parametrize(("wrong", "motor"), sampled("named", product(NAMED, ("", *motors())), 2, campaign="sabotage"))
def test_what_is_described_wrongly_is_named(wrong: str, motor: str, workshop: Workshop) -> None:
    key, value, measurement = NAMED[wrong]
    config = configured(motor, {key: value(load_params(motors().get(motor)).motor)})
    run = workshop.run(config, keyword="back_emf_and_encoder or hall_edges and not table1")
    assert run.measured[measurement].verdict is Verdict.FAIL
    workshop.require_safe()


def test_a_watchdog_that_does_not_trip_fails_in_its_own_test_and_the_drive_ends_idle_all_the_same(workshop: Workshop):
    sabotage = SABOTAGES["watchdog_does_not_trip"]
    with patch.object(StateMachine, "_watchdog_ticks", lambda machine: 1 << 60):
        run = workshop.run(keyword=concerned(sabotage))
    assert_noticed(sabotage, run, Verdict.FAIL)
    assert run.code == 1
    workshop.require_safe()


@pytest.mark.campaign("sabotage")
def test_samples_that_are_lost_make_invalid_what_was_made_from_them(workshop: Workshop) -> None:
    sabotage = SABOTAGES["dropped_samples"]
    undisturbed = workshop.run(keyword=" or ".join(sabotage["at"]))
    moments = {}
    for test, name in sabotage["at"].items():
        span = undisturbed.measured[f"{test}.{name}"].span
        assert span is not None
        moments[test] = sum(span) / 2.0
    run = workshop.run(lose_at=moments, keyword=concerned(sabotage))
    assert_noticed(sabotage, run, Verdict.INVALID)
    assert (run.code, {test for test in run.tests if run[test].quality.lost_samples}) == (2, moments.keys())
    workshop.require_safe()


def test_without_an_encoder_every_test_passes_or_says_that_it_needs_one(workshop: Workshop) -> None:
    run = workshop.run("[encoder]\npresent = 0\n")
    skipped = {test.name for test in run.result.tests if test.verdict is Verdict.SKIPPED}
    assert run.result.verdict is Verdict.INCOMPLETE
    assert run.code == 6
    assert all("needs an encoder" in run[name].why for name in skipped)
    assert {test.name for test in run.result.tests if test.verdict is Verdict.PASS} == set(run.tests) - skipped
    # those that no encoder is needed for, by what they do
    assert set(run.tests) - skipped == {
        "hall_wire_broken[a]", "hall_wire_broken[b]", "hall_wire_broken[c]", "hall_glitches", "watchdog",
        "watchdog_under_load", "current_offsets", "full_speed", "voltage_limit", "stall_and_restart", "stop",
        *PROTECTED,
    }  # fmt: skip
    workshop.require_safe()
