"""What the firmware's inputs read of each Hall code through wires that are rotated, inverted, open or shorted."""

import itertools

import pytest

from protocol.signals import HallSwap
from sim.plant import hall_wiring

TABLES = {  # the inputs c b a for the sensors' codes c b a = 000 .. 111, written out by hand
    ("hall_swap", HallSwap.A_B): ["000", "010", "001", "011", "100", "110", "101", "111"],
    ("hall_swap", HallSwap.B_C): ["000", "001", "100", "101", "010", "011", "110", "111"],
    ("hall_swap", HallSwap.C_A): ["000", "100", "010", "110", "001", "101", "011", "111"],
    ("hall_swap", HallSwap.A_ON_B): ["000", "010", "100", "110", "001", "011", "101", "111"],
    ("hall_swap", HallSwap.A_ON_C): ["000", "100", "001", "101", "010", "110", "011", "111"],
    ("hall_invert", 1): ["001", "000", "011", "010", "101", "100", "111", "110"],
    ("hall_invert", 6): ["110", "111", "100", "101", "010", "011", "000", "001"],
    ("hall_short", 2): ["000", "001", "000", "001", "100", "101", "100", "101"],
}


def inputs(**wrong):
    params = hall_wiring.make_params(20e6, **dict.fromkeys(hall_wiring.PARAMETERS, 0.0) | wrong)
    return [hall_wiring.pins(params, code, 0, 0) for code in range(8)]


@pytest.mark.parametrize(("name", "value"), list(TABLES))
def test_one_thing_wrong(name, value):
    assert inputs(**{name: float(value)}) == [int(bits, 2) for bits in TABLES[name, value]]


def test_a_dead_wire_reads_the_same_whatever_is_on_it():
    for swap, invert in itertools.product(HallSwap, range(8)):
        assert all(code & 4 for code in inputs(hall_swap=float(swap), hall_invert=invert, hall_open=4.0))
        assert not any(code & 4 for code in inputs(hall_swap=float(swap), hall_invert=invert, hall_short=4.0))
