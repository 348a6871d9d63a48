"""A commissioning over a bus that carries a fraction of the samples: the drive's memory holds what the steps need."""

from __future__ import annotations

import pytest
from drawn_benches import NAMES, PAPER, MadeBench, drawn, made
from test_commission_command import left_alone, run_on
from test_commission_drive import EDGES, WITHIN, edge_errors, errors
from virtual_run import WatchedLink, simulated

from bench.commission.commissioned import Commissioned
from bench.files import leaves
from tests.tools import needs

SEEDS = 3300
"""The first of benches that nothing was set on."""


def over(of: MadeBench, network: str, compiled: bool = False, seed: int = 1, **settings: float) -> Commissioned:
    """Commissioned over that network, with the drive left as it was."""
    figures = {name.replace(".", "__"): value for name, value in leaves(of.config)}
    link = WatchedLink(simulated(seed, network, compiled, **(figures | settings)))
    before = dict(link.device.bench.parameters)
    done = run_on(link, current_a=of.i_max, speed_rpm=of.rpm)
    assert left_alone(link.device, before)
    return done


def assert_found(of: MadeBench, done: Commissioned) -> None:
    values, truth = done.found, {**of.truth, **of.turning}
    assert not done.refused
    assert {*truth} <= {*values}
    for key, error in errors(of, done.outcomes).items():
        assert abs(error) < WITHIN.get(key, 15e-3), key
        assert values[key].covers(truth[key]), key
    for key, error in edge_errors(of, done.outcomes).items():
        assert abs(error) < min(EDGES, values[key].half_width), key


@pytest.mark.long("captures over a slow bus")
def test_over_classic_can_all_is_found_out_of_the_drives_memory() -> None:
    of = made(PAPER, hard=True)
    assert_found(of, over(of, "CAN"))


@pytest.mark.campaign("commission")
@pytest.mark.parametrize("side", ["Python", pytest.param("C", marks=needs("C compiler"))])
@pytest.mark.parametrize("name", NAMES)
def test_of_any_motor_over_classic_can(name: str, side: str) -> None:
    of = drawn(name, SEEDS + (side == "C"))
    assert_found(of, over(of, "CAN", side == "C", SEEDS))


@pytest.mark.campaign("commission")
@pytest.mark.parametrize("name", NAMES)
def test_a_small_memory_keeps_a_lap_in_two(name: str) -> None:
    """It tells less of resistance and dead time, and of friction by short coasts."""
    of = drawn(name, SEEDS + 2)
    done = over(of, "CAN", memory__capture=262_144)
    values, truth = done.found, {**of.truth, **of.turning}
    assert not done.refused
    assert {*truth} <= {*values}
    for key, error in errors(of, done.outcomes).items():
        assert abs(error) < 3.0 * WITHIN.get(key, 15e-3), key
    for key, error in edge_errors(of, done.outcomes).items():
        assert abs(error) < EDGES, key


@pytest.mark.campaign("commission")
def test_what_a_tiny_memory_does_not_hold_is_refused_and_the_rest_is_told() -> None:
    done = over(made(PAPER, hard=True), "CAN FD", memory__capture=60_000)
    assert "do not fit into the drive's 60000 bytes for captures: use a faster link" in done.refused["inductance"]
    assert {"offsets", "first-current", "resistance"} <= {*done.outcomes}


@pytest.mark.campaign("commission")
def test_without_an_encoder_a_slow_bus_does_not_spin_the_shaft() -> None:
    of = made(PAPER, hard=True, encoder__present=0)
    done = over(of, "CAN")
    assert "without an encoder nothing tells the speed meanwhile" in done.refused["spin"]
    assert {"turn", "inductance", "check"} <= {*done.outcomes}
    assert "psi_f" not in done.found
