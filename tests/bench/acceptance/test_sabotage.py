"""Sabotage proves the suite: a broken drive fails in exactly the measurements that should notice, by name.

`sabotage.toml` names what must notice, and says why that and nothing else. One sabotage runs the whole shipped suite,
in virtual time; the others run what must or may notice, and a few tests that must not, since an untouched drive passes
all in `test_suite`. Whether currents stayed in bounds and the outputs went off is asked of the simulated drive.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from unittest.mock import patch
from zlib import crc32

import numpy as np
import pytest
from accepting import Accepting, Run, SpoiltLink
from virtual_run import at_rest

from bench.acceptance.results import Verdict
from protocol.device.state import StateMachine
from protocol.signals import MILLI
from sim.config.params import load_params
from sim.drive.machine import Recorded, SimulatedBench
from sim.ports.device import SimulatedDevice

SABOTAGES = tomllib.loads(Path(__file__).with_name("sabotage.toml").read_text())
BROKEN_CONFIGS = [name for name, sabotage in SABOTAGES.items() if "config" in sabotage]
OF_THE_WHOLE_SUITE = "observer_disabled"  # a third of the tests must not notice it, and most others in part only
QUIET = ("current_offsets", "hall_wire_broken", "hall_wires_exchanged", "stall_and_restart", "stop_500_rpm")


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
    largest: float = 0.0
    """Phase current in A, of all tests and control periods."""

    def run(self, config: str = "", lose_at: Mapping[str, float] | None = None, keyword: str | None = None) -> Run:
        file = self.accepting.directory / "sabotage.toml"
        file.write_text(config)
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
        assert 0.0 < self.largest < load_params().firmware.protection.i_trip


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


def concerned(sabotage: Mapping[str, Mapping[str, list[str]]]) -> str:
    """Keyword of the tests that must or may notice, and of some that must not."""
    return " or ".join({*sabotage["must"], *sabotage.get("may", {}), *sabotage.get("at", {}), *QUIET})


def assert_noticed(sabotage: Mapping[str, Mapping[str, list[str]]], run: Run, verdict: Verdict) -> None:
    """Exactly what should notice did, and said so by `verdict`."""
    must, may = named(sabotage["must"], run), named(sabotage.get("may", {}), run)
    noticed = {name: m.verdict for name, m in run.measured.items() if m.verdict is not Verdict.PASS}
    assert must - noticed.keys() == set(), "should have noticed"
    assert noticed.keys() - must - may == set(), "should not have noticed"
    assert set(noticed.values()) == {verdict}


@pytest.mark.parametrize("name", BROKEN_CONFIGS)
def test_a_broken_drive_fails_where_it_should(name: str, workshop: Workshop) -> None:
    keyword = None if name == OF_THE_WHOLE_SUITE else concerned(SABOTAGES[name])
    run = workshop.run(SABOTAGES[name]["config"], keyword=keyword)
    assert_noticed(SABOTAGES[name], run, Verdict.FAIL)
    assert run.code == 1
    workshop.require_safe()


def test_a_watchdog_that_does_not_trip_fails_in_its_own_test_and_the_drive_ends_idle_all_the_same(
    workshop: Workshop,
) -> None:
    sabotage = SABOTAGES["watchdog_does_not_trip"]
    with patch.object(StateMachine, "_watchdog_ticks", lambda machine: 1 << 60):
        run = workshop.run(keyword=concerned(sabotage))
    assert_noticed(sabotage, run, Verdict.FAIL)
    assert run.code == 1
    workshop.require_safe()


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
    assert run.code == 2
    assert {test for test in run.tests if run[test].quality.lost_samples} == moments.keys()
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
        "watchdog_under_load", "current_offsets", "full_speed_3000_rpm", "stall_and_restart", "stop_500_rpm",
    }  # fmt: skip
    workshop.require_safe()
