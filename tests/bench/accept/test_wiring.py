"""Wirings told apart from codes that are made here, sensor by sensor, from half-turn windows."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from bench.findings.wiring import diagnose

Floats = NDArray[np.float64]
Levels = NDArray[np.bool_]
Rewire = Callable[[Levels, Levels, Levels], tuple[Levels, Levels, Levels]]

WIRINGS: dict[str, Rewire] = {
    "as specified": lambda a, b, c: (a, b, c),
    "sensors a and b exchanged": lambda a, b, c: (b, a, c),
    "sensors b and c exchanged": lambda a, b, c: (a, c, b),
    "sensors c and a exchanged": lambda a, b, c: (c, b, a),
    "sensors rotated (a on b, b on c, c on a)": lambda a, b, c: (c, a, b),
    "sensors rotated (a on c, b on a, c on b)": lambda a, b, c: (b, c, a),
    "sensor a inverted": lambda a, b, c: (~a, b, c),
    "sensor b inverted": lambda a, b, c: (a, ~b, c),
    "sensor c inverted": lambda a, b, c: (a, b, ~c),
    "sensor a open (always 1)": lambda a, b, c: (a | True, b, c),
    "sensor b open (always 1)": lambda a, b, c: (a, b | True, c),
    "sensor c open (always 1)": lambda a, b, c: (a, b, c | True),
    "sensor a shorted (always 0)": lambda a, b, c: (a & False, b, c),
    "sensor b shorted (always 0)": lambda a, b, c: (a, b & False, c),
    "sensor c shorted (always 0)": lambda a, b, c: (a, b, c & False),
}


def read(theta: Floats, rewire: Rewire = WIRINGS["as specified"], placement_deg: Floats | None = None) -> Floats:
    """What the drive reads: sensor a is high from -60 to 120 deg, b 120 deg later, c 240 deg later."""
    placement = np.zeros(3) if placement_deg is None else placement_deg
    levels = [(np.degrees(theta) + 60.0 - 120.0 * sensor - placement[sensor]) % 360.0 < 180.0 for sensor in range(3)]
    a, b, c = rewire(*levels)
    return (a + 2 * b + 4 * c).astype(np.uint8)


def turning(turns: float = 3.0, n: int = 3001) -> Floats:
    return np.linspace(-math.pi, 2 * math.pi * turns, n)


def test_the_windows_give_the_codes_of_the_specification() -> None:
    assert read(np.radians([30.0, 90.0, 150.0, 210.0, 270.0, 330.0])).tolist() == [1, 3, 2, 6, 4, 5]


@pytest.mark.parametrize("name", WIRINGS)
@settings(max_examples=10, deadline=None)
@given(placement=st.tuples(*[st.floats(-11.9, 11.9)] * 3), backwards=st.booleans())
def test_each_wiring_is_named_however_the_sensors_are_placed(name, placement, backwards) -> None:
    theta = turning()[::-1] if backwards else turning()
    found = diagnose(theta, read(theta, WIRINGS[name], np.array(placement)))
    assert (found.best, found.share) == (name, 1.0)
    assert found.runner_up != name
    assert found.runner_up_share <= 2.0 / 3.0  # no two wirings agree in more than four sectors
    assert found.n + found.left_out == len(theta)
    assert found.left_out / len(theta) == pytest.approx(0.4, abs=0.01)  # 24 of 60 deg


def test_a_sensor_out_of_place_beyond_the_margin_costs_its_share() -> None:
    theta = turning(n=30_001)
    hall = read(theta, placement_deg=np.array([0.0, 0.0, 20.0]))
    whole = diagnose(theta, hall, margin=0.0)
    assert (whole.best, whole.n, whole.left_out) == ("none of the known wirings", len(theta), 0)
    assert whole.share == pytest.approx(1.0 - 2 * 20.0 / 360.0, abs=1e-3)
    assert (whole.runner_up, whole.runner_up_share) == ("as specified", whole.share)
    assert diagnose(theta, hall, margin=math.radians(20.1)).best == "as specified"


def test_noise_is_within_the_share_and_more_than_that_is_not() -> None:
    theta = turning(n=20_001)
    rng = np.random.default_rng(1)
    for glitches, best in ((0.02, "sensors b and c exchanged"), (0.2, "none of the known wirings")):
        hall = read(theta, WIRINGS["sensors b and c exchanged"])
        hit = rng.random(len(theta)) < glitches
        hall[hit] ^= 7
        found = diagnose(theta, hall)
        assert (found.best, found.share) == (best, pytest.approx(1.0 - glitches, abs=0.01))


@pytest.mark.parametrize(("shift_deg", "best"), [
    (120.0, "sensors rotated (a on b, b on c, c on a)"),
    (-120.0, "sensors rotated (a on c, b on a, c on b)"),
    (60.0, "none of the known wirings"),
    (180.0, "none of the known wirings"),
    (-60.0, "none of the known wirings"),
])  # fmt: skip
def test_an_encoder_zero_that_is_off_looks_as_the_docstring_says(shift_deg: float, best: str) -> None:
    theta = turning()  # the rotor is `shift_deg` ahead of what the encoder says
    assert diagnose(theta, read(theta + math.radians(shift_deg))).best == best


def test_standing_in_a_sector_does_not_outweigh_the_others() -> None:
    """Sensors a and b exchanged read as specified in two of the sectors: the rotor stands in one of them."""
    theta = np.concatenate([np.full(100_000, math.radians(90.0)), turning()])
    found = diagnose(theta, read(theta, WIRINGS["sensors a and b exchanged"]))
    assert found.best == "sensors a and b exchanged"
    both_off = diagnose(theta, read(theta, lambda a, b, c: (b, a, c | (~a & b))))
    assert both_off.best == "none of the known wirings"


def test_sectors_that_were_not_seen_are_named() -> None:
    theta = np.radians(np.linspace(15.0, 225.0, 500))
    with pytest.raises(ValueError, match=r"^no samples at 240\.\.300, 300\.\.360 deg \(electrical\): turn the rotor"):
        diagnose(theta, read(theta))
    edge_only = np.radians(np.linspace(-5.0, 5.0, 100))
    with pytest.raises(ValueError, match=r"0\.\.60, 60\.\.120, .*300\.\.360 deg"):
        diagnose(edge_only, read(edge_only))


def test_unfit_input_is_refused() -> None:
    theta = turning()
    hall = read(theta)
    with pytest.raises(ValueError, match=r"a Hall code is 0\.\.7, got 1 to 9"):
        diagnose(theta, np.where(theta > 3.0, 9, hall))
    with pytest.raises(ValueError, match="hall: shape"):
        diagnose(theta, hall[1:])
    with pytest.raises(ValueError, match="theta: 1 of 3001"):
        diagnose(np.where(np.arange(3001) == 5, math.nan, theta), hall)
    with pytest.raises(ValueError, match="below 30 deg, got 30 deg"):
        diagnose(theta, hall, margin=math.radians(30.0))
