"""A ring of Hall sensors anywhere, wired anyhow, and a firmware that is told: SPEC 12."""

import itertools
import math

import numpy as np
import pytest
from rig import Rig, column, error_deg

from protocol.messages import DriveState, Fault
from protocol.signals import AngleSource, HallSwap, Status, hall_map
from sim.config.params import load_params
from sim.plant import hall_wiring
from tests.choice import chosen

WIRINGS = [(int(swap), invert) for swap, invert in itertools.product(HallSwap, range(8))]
ELSEWHERE = [(swap, invert) for swap, invert in WIRINGS if swap or invert]
CODES = [1, 3, 2, 6, 4, 5]  # of sectors I..VI
STILL = {"hall.delta_deg": [0.0] * 6, "hall.hysteresis_deg": 0.0, "hall.jitter_deg": 0.0, "mechanics.theta_0_deg": 30.0}


def wired(swap, invert, told=(0, 0), seed=1, **settings):
    """A bench with these wires, and a firmware that takes them to be `told`."""
    swap_hat, invert_hat = told
    wiring = {"wiring.hall_swap": swap, "wiring.hall_invert": invert}
    firmware = {"firmware.hall_swap_hat": swap_hat, "firmware.hall_invert_hat": invert_hat}
    return Rig(seed, **wiring, **firmware, **settings)


def journey(bench):
    """Start, a speed, a load, a reversal: all that is recorded, as bytes."""
    parts = [*bench.start(), bench.spin(300.0, 0.2), bench.spin(300.0, 0.1, 0.1), bench.spin(-300.0, 0.3)]
    assert not bench.faults
    return [(part.samples.tobytes(), part.edges.tobytes()) for part in parts]


@pytest.mark.parametrize(("swap", "invert"), WIRINGS)
def test_the_map_undoes_each_wiring(swap, invert):
    wires = {"hall_swap": swap, "hall_invert": invert, "hall_open": 0.0, "hall_short": 0.0, "hall_glitch": 0.0}
    params = hall_wiring.make_params(20e6, **wires)
    told = hall_map(swap, invert)
    assert [told[hall_wiring.pins(params, code, 0, 0)] for code in range(8)] == list(range(8))


@pytest.mark.parametrize(("swap", "invert"), chosen("wirings that a firmware is told", ELSEWHERE, 3))
def test_a_firmware_that_is_told_its_wiring_runs_as_with_the_specified_one(swap, invert):
    assert journey(wired(swap, invert, (swap, invert))) == journey(wired(0, 0))


def test_sensors_60_degrees_apart_trip_until_the_firmware_knows_the_middle_one():
    tripped = wired(0, 2)
    tripped.start()
    tripped.spin(300.0, 0.2)
    assert tripped.faults == Fault.HALL
    assert journey(wired(0, 2, (0, 2)))


def test_false_pulses_and_broken_wires_come_through_the_map_as_the_sensors_they_are_on():
    """Wire of sensor b on input c, inverted: broken, its input reads 1, so b reads 0."""
    bench = wired(2, 4, (2, 4), **STILL)
    assert set(bench.advance(10).samples["hall"]) == {1}
    bench.set_load_param("hall_open", 4)
    broken = bench.advance(10)
    assert set(broken.samples["hall"]) == {1}
    bench = wired(2, 4, (2, 4), **{**STILL, "mechanics.theta_0_deg": 90.0})
    assert set(bench.advance(10).samples["hall"]) == {3}
    bench.set_load_param("hall_open", 4)
    broken = bench.advance(10)
    assert set(broken.samples["hall"]) == {1}
    assert [(int(c) & 7, int(c) >> 3 & 7) for c in broken.edges["codes"]] == [(3, 1)]


@pytest.mark.parametrize(("name", "value"), [("hall_invert_hat", 5), ("hall_swap_hat", 4), ("hall_offset", 1.0)])
def test_a_set_is_no_movement_of_the_shaft(name, value):
    """Other codes, observers anew from them, and no edge, no doubt; the next edge begins where the codes are now."""
    bench = Rig(0, **STILL, **{"firmware.observer": 1})  # at rest in sector I
    bench.advance(100)
    bench.enter_state(DriveState.ARMED)  # where the protection looks
    bench.advance(100)
    doubt = float(bench._state.array["firmware"]["protection"]["doubt"][0])
    bench.set_param(name, value)
    after = bench.advance(200)
    told = hall_map(bench.parameters["hall_swap_hat"], bench.parameters["hall_invert_hat"])
    sector = CODES.index(told[1])
    assert set(after.samples["hall"]) == {CODES[sector]}
    assert len(after.edges) == 0
    assert float(bench._state.array["firmware"]["protection"]["doubt"][0]) == doubt == 0.0
    assert [k for k, bits in enumerate(after.samples["status"]) if bits & Status.OBSERVERS_RESET] == [0]
    centre = 60.0 * sector + 30.0 + math.degrees(bench.parameters["hall_offset"])
    assert np.degrees(column(after, "theta_avg")) % 360.0 == pytest.approx(np.full(200, centre % 360.0))
    bench.load_enter_state(DriveState.RUNNING)
    first = bench.forced(300.0, 0.0, 0.1).edges["codes"][0]
    assert (int(first) & 7, int(first) >> 3 & 7) == (told[1], told[3])


RING = chosen("rings in the loop", [30.0, 17.0, -75.0, 180.0, -300.0, 91.0], 1)
OBSERVERS = [source.short for source in AngleSource if source is not AngleSource.ENCODER]
NOISE = 0.2  # deg, of mean and standard deviation over whole turns


@pytest.mark.parametrize("ring_deg", RING)
def test_every_observer_errs_as_much_wherever_the_ring_sits(ring_deg):
    """The rotor starts turned with the ring; shaft, currents and the sensors' placement are those of the paper."""

    def errors(offset_deg):
        turned = {"hall.offset_deg": offset_deg, "mechanics.theta_0_deg": (240.0 + offset_deg) % 360.0 - 180.0}
        bench = Rig(3, **turned, **{"firmware.observer": 0, "load.alpha_m_max": 0.0})
        bench.watch(frozenset(f"theta_{name}" for name in OBSERVERS))
        bench.start()
        found = []
        for rpm in (500.0, -500.0):
            bench.forced(rpm, 4.0, 1.0)
            part = bench.forced(rpm, 4.0, 60.0 / 500.0 * 3)
            errors = [error_deg(part, f"theta_{name}") for name in OBSERVERS]
            found += [[error.mean() for error in errors], [error.std() for error in errors]]
        return np.array(found)

    assert np.abs(errors(ring_deg) - errors(0.0)).max(axis=0) == pytest.approx(np.zeros(len(OBSERVERS)), abs=NOISE)


@pytest.mark.parametrize("ring_deg", [-360.0, -180.0, -75.0, 30.0, 180.0, 300.0])
def test_the_firmware_knows_where_the_ring_sits(ring_deg):
    told = load_params(None, {"hall.offset_deg": ring_deg}).drive_parameters()["hall_offset"]
    assert math.remainder(told - math.radians(ring_deg), math.tau) == pytest.approx(0.0, abs=1e-12)
    assert -math.pi <= told <= math.pi
    wrong = load_params(None, {"hall.offset_deg": ring_deg, "firmware.hall_offset": 0.1}).drive_parameters()
    assert wrong["hall_offset"] == 0.1
