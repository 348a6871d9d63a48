"""`bench hall learn --write` on a drive that does not know where its ring stands, or how its wires are connected.

The oracle is the plant: the sector that the rotor is in by its own angle, and the speed that it turns at.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import random
import re
from unittest.mock import patch

import numpy as np
import pytest
from hall_motor import REAL, Motor, capture
from virtual_run import run, simulated

from bench.cli import main
from bench.errors import BenchError
from bench.findings.health import examine
from bench.hall.learn import Learnt, learnt
from bench.hall.trace import trace
from bench.signal.verdict import Verdict
from protocol.messages import DriveState, SetpointMode
from protocol.signals import ANGLE, AngleSource
from sim.ports.device import SimulatedDevice
from sim.ports.virtual import VirtualLink
from tests.choice import sampled
from tests.tools import needs

pytestmark = pytest.mark.slow

TARGET = f"serial:/dev/ttySETTINGS-{os.getpid()}"
CODES = (1, 3, 2, 6, 4, 5)  # of sectors I to VI, SPEC 12
RINGS = [0.0, 30.0, -100.0, 180.0, 77.0]


def hall(device: SimulatedDevice, *arguments: str) -> int:
    """The exit code of `bench hall` on this device."""
    with patch("bench.rig.connection.open_link", lambda target: VirtualLink(device)):
        try:
            main(["hall", arguments[0], TARGET, *arguments[1:]])
        except SystemExit as ended:
            return int(ended.code or 0)
    return 0


def runs_by_its_hall_sensors(device: SimulatedDevice, rad_s: float = 40.0) -> float:
    """Mechanical rad/s of the rotor once it was told to turn, over a fifth of a second; and its codes are right."""
    bench = device.bench
    bench.set_param("observer", AngleSource.AVERAGE_SPEED)
    for state in (DriveState.ARMED, DriveState.RUNNING):
        bench.enter_state(state)
        bench.advance(1)
    bench.setpoint(SetpointMode.SPEED, rad_s)
    bench.advance(16_000)
    before, n = bench.truth.theta_e, 3200
    part = bench.advance(n).samples
    by_rotor = np.degrees(part["theta_true"] * ANGLE - bench.parameters["hall_offset"]) % 360.0
    right = np.count_nonzero(part["hall"] == np.array(CODES)[(by_rotor / 60.0).astype(int) % 6])
    speed = (bench.truth.theta_e - before) / 6.0 / n * 16_000
    assert not bench.faults
    assert right > 0.85 * n  # sensors stand up to 7 deg off
    bench.enter_state(DriveState.IDLE)
    bench.advance(8000)
    return speed


@pytest.mark.long("learns, checks and runs: twenty seconds of a motor each")
@pytest.mark.parametrize(("swap", "invert"), sampled(
    "ways to wire that are learnt", itertools.product(range(6), range(8)), 4, campaign="hall",
))  # fmt: skip
def test_any_wiring_and_any_ring_are_learnt_over_any_setting_that_the_drive_has(swap: int, invert: int) -> None:
    rng = random.Random(8 * swap + invert)
    device = simulated(
        wiring__hall_swap=swap, wiring__hall_invert=invert, hall__offset_deg=rng.choice(RINGS),
        firmware__hall_swap_hat=rng.randrange(6), firmware__hall_invert_hat=rng.randrange(8),
        firmware__hall_offset=rng.choice([0.0, 0.5, -2.0]),
    )  # fmt: skip
    assert hall(device, "learn", "--yes", "--write") == 0
    assert hall(device, "check", "--yes") == 0
    assert runs_by_its_hall_sensors(device) == pytest.approx(40.0, rel=0.1)


@pytest.mark.long("checks, learns, runs and accepts: ten seconds of a motor each")
@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=needs("C compiler"))], ids=["Python", "C"])
def test_a_motor_made_for_six_step_commutation_is_checked_learnt_run_and_accepted(
    compiled: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    device = simulated(compiled=compiled, hall__offset_deg=30.0, firmware__hall_offset=0.0)
    assert hall(device, "check", "--yes") == 1
    assert "the ring stands at 29.0 deg, and the drive takes it to stand at 0.0 deg" in text(capsys)
    assert hall(device, "learn", "--yes", "--write") == 0
    assert re.search(r"hall_offset: 0 -> 0\.506[45] 14 parameters written to node 1 and read back", text(capsys))
    assert hall(device, "check", "--yes", "--json=-") == 0
    assert json.loads(capsys.readouterr().out)["outcome"] == "healthy"
    outcome = run(VirtualLink(device), observer="average-speed", duration=2.0)
    assert outcome.verdict is Verdict.PASS
    with (
        patch("bench.rig.connection.open_link", lambda target: VirtualLink(device)),
        pytest.raises(SystemExit) as ended,
    ):
        main(["accept", TARGET, "-k", "test_stop or hall_edges", "--yes"])
    assert ended.value.code == 0, text(capsys)


def text(capsys: pytest.CaptureFixture[str]) -> str:
    return " ".join(capsys.readouterr().out.split())


# -- drives that have no such parameters ------------------------------------------------------------------------


def by_formula(motor: Motor) -> Learnt:
    recorded = capture(motor)
    return learnt(examine(trace(recorded)), recorded.parameters)


SIX_STEP = REAL.but(delta_deg=[delta - 30.0 for delta in REAL.delta_deg])


def test_a_drive_without_the_parameters_is_told_what_to_turn_or_to_program() -> None:
    stands = (
        "the ring stands at 29.0 deg, the drive takes it to stand at 0: turn it, or give the firmware hall_offset, "
    )
    with pytest.raises(BenchError, match=stands):
        by_formula(SIX_STEP)
    exchanged = REAL.but(rewire=lambda abc: (abc[1], abc[0], abc[2]))
    for parameters, offset in (({}, "hall_offset, "), ({"hall_offset": 0.0}, "")):
        words = (
            rf"exchanged; .*, or give the firmware {offset}hall_swap_hat, hall_invert_hat \(docs/firmware.md, step 5"
        )
        with pytest.raises(BenchError, match=words):
            by_formula(exchanged.but(parameters=parameters))


def test_a_ring_that_stands_where_the_drive_takes_it_to_is_not_moved() -> None:
    """The edges are 1 deg off in the mean: that is in `edge_up` and `edge_down`, as before there was an offset."""
    found = by_formula(REAL.but(parameters={"hall_offset": 0.1, "hall_swap_hat": 0.0, "hall_invert_hat": 0.0}))
    assert found.settings == {"hall_offset": 0.1, "hall_swap_hat": 0.0, "hall_invert_hat": 0.0}
    true = [delta - 0.25 + math.degrees(0.1) for delta in REAL.delta_deg]
    assert [math.degrees(value) for value in found.edge_up] == pytest.approx(true, abs=0.1)


def test_a_direction_that_nothing_tells_is_said_to_be_assumed() -> None:
    hats = {"hall_offset": 0.0, "hall_swap_hat": 0.0, "hall_invert_hat": 0.0}
    exchanged = REAL.but(rewire=lambda abc: (abc[1], abc[0], abc[2]), parameters=hats)
    for without, words in ((), ""), (("u_alpha", "u_beta"), "Verify it: start the motor forward by its Hall sensors"):
        found = by_formula(exchanged.but(without=without))
        assert found.settings["hall_swap_hat"] == 1.0
        assert bool(found.assumed) == bool(words)
        assert words in found.assumed
