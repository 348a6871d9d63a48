"""Faults on the wires between Hall sensors and firmware: what the pins read and the timer captures."""

import numpy as np
import pytest
from rig import Rig, column

from protocol.messages import SetpointMode
from protocol.streams import EDGE_ILLEGAL
from sim.config.params import ConfigError

CODE_OF_SECTOR = np.array([1, 3, 2, 6, 4, 5])
PLAIN = {"hall.delta_deg": [0.0] * 6, "hall.hysteresis_deg": 0.0, "hall.jitter_deg": 0.0, "mechanics.theta_0_deg": 30.0}


def turning(omega_m, seed=0, **overrides):
    bench = Rig(seed, **PLAIN | overrides)
    bench.load(SetpointMode.SPEED, omega_m)
    return bench


def sensor_codes(recorded):
    """The codes of the sensors themselves, by the plant's angle."""
    return CODE_OF_SECTOR[np.floor(np.degrees(column(recorded, "theta_e")) / 60.0).astype(int) % 6]


def old_and_new(recorded):
    return recorded.edges["codes"] & 7, recorded.edges["codes"] >> 3 & 7


@pytest.mark.parametrize("wires", range(1, 8))
def test_broken_wires_read_one_and_their_edges_vanish(wires):
    recorded = turning(60.0, **{"wiring.hall_open": wires}).advance(8000)
    assert np.array_equal(recorded.samples["hall"], sensor_codes(recorded) | wires)
    old, new = old_and_new(recorded)
    assert not np.any((old ^ new) & wires)
    assert np.all(old != new)
    assert np.array_equal(old[1:], new[:-1])
    turns = (recorded["theta_true"][-1] - recorded["theta_true"][0]) / (2 * np.pi)
    connected = 3 - wires.bit_count()
    assert len(old) == pytest.approx(2 * connected * turns, abs=2)
    jumps = np.array([int(c).bit_count() > 1 for c in old ^ new], bool)
    assert np.array_equal(recorded.edges["codes"] & EDGE_ILLEGAL > 0, (new == 7) | (new == 0) | jumps)


def test_a_wire_that_breaks_in_a_run_is_an_edge_where_it_changes_the_code():
    bench = Rig(**PLAIN)  # at rest in sector 0: code 1
    bench.advance(10)
    bench.set_load_param("hall_open", 1)
    assert len(bench.advance(10).edges) == 0
    bench.set_load_param("hall_open", 3)
    broken = bench.advance(10)
    assert [tuple(int(x[0]) for x in old_and_new(broken))] == [(1, 3)]
    assert broken.edge_tick[0] == broken.tick - 1250 + 1
    assert set(broken.samples["hall"]) == {3}
    bench.set_load_param("hall_open", 0)
    assert [tuple(int(x[0]) for x in old_and_new(bench.advance(10)))] == [(3, 1)]


def test_false_pulses_are_short_independent_and_as_many_as_asked_for():
    rate = 2000.0
    bench = Rig(7, **PLAIN | {"wiring.hall_glitch": rate})
    recorded = bench.advance(160_000)
    old, new = old_and_new(recorded)
    assert set(old[0::2]) == set(new[1::2]) == {1}
    pulses = len(old) // 2
    assert pulses == pytest.approx(rate * 10.0, rel=4.0 / np.sqrt(rate * 10.0))
    begin, end = recorded.edge_tick[0::2][:pulses], recorded.edge_tick[1::2][:pulses]
    width = (end - begin) / 20e6
    assert 2e-6 <= width.min() < 2.1e-6
    assert 4.9e-6 < width.max() <= 5.05e-6
    sensors, counts = np.unique(old[0::2] ^ new[0::2], return_counts=True)
    assert list(sensors) == [1, 2, 4]
    assert np.all(np.abs(counts / pulses - 1 / 3) < 4.0 * np.sqrt(2 / 9 / pulses))
    gap = (begin[1:] - end[:-1]) / 20e6
    assert gap.std() == pytest.approx(gap.mean(), rel=0.05)  # exponential
    assert np.mean(gap > 2.0 * gap.mean()) == pytest.approx(np.exp(-2.0), abs=0.01)
    inside = np.searchsorted(begin, np.arange(160_000) * 1250, side="right") > np.searchsorted(
        end, np.arange(160_000) * 1250, side="right"
    )
    assert inside.sum() > 500
    assert np.array_equal(recorded.samples["hall"] != 1, inside)


def test_false_pulses_and_edges_of_the_sensors_are_captured_in_order():
    bench = turning(300.0, **{"wiring.hall_glitch": 1e5, "load.alpha_m_max": 0.0})
    recorded = bench.advance(16_000)
    old, new = old_and_new(recorded)
    assert np.all(np.diff(recorded.edge_tick) >= 0)
    assert np.array_equal(old[1:], new[:-1])
    assert len(old) == pytest.approx(2e5, rel=0.05)
    assert np.array_equal(recorded.samples["hall"][-1:], new[-1:])
    settled = recorded.edge_tick > 100 * 1250
    theta = np.interp(recorded.edge_tick[settled], np.arange(16_000) * 1250, column(recorded, "theta_e"))
    counts = theta / (2 * np.pi * 6) * 14400
    off = (recorded.edges["encoder"][settled] - counts + 7200) % 14400 - 7200
    assert np.abs(off + 0.5).max() < 0.6
    bench.set_load_param("hall_glitch", 0.0)
    bench.advance(1)  # a pulse ends
    quiet = bench.advance(16_000)
    assert np.array_equal(quiet.samples["hall"], sensor_codes(quiet))


def test_a_bench_without_pulses_draws_no_random_number_for_them():
    plain, other = turning(50.0, 5), turning(50.0, 5, **{"wiring.hall_open": 1, "wiring.hall_swap": 2})
    noise = [b.advance(2000).samples["i_a"].tobytes() for b in (plain, other)]
    assert noise[0] == noise[1]


def test_sensors_that_are_moved_open_their_sectors_where_they_stand():
    bench = turning(60.0, **{"hall.jitter_deg": 0.0, "hall.hysteresis_deg": 0.0})
    deltas = (-15.0, 10.0, 10.0, -15.0, 10.0, 10.0)
    for number, delta in enumerate(deltas, 1):
        bench.set_load_param(f"hall_delta_{number}", np.radians(delta))
    bench.advance(1000)
    recorded = bench.advance(8000)
    theta = np.interp(recorded.edge_tick, recorded.tick + 1250 * np.arange(8000), column(recorded, "theta_e"))
    _, new = old_and_new(recorded)
    sector = np.array([list(CODE_OF_SECTOR).index(code) for code in new])
    offset = np.degrees(sector * np.pi / 3 - theta)
    assert np.abs((offset - np.array(deltas)[sector] + 180) % 360 - 180).max() < 0.05


def test_a_sensor_that_would_leave_no_room_is_refused_and_stays():
    bench = turning(60.0, **{"hall.hysteresis_deg": 4.0})
    bench.set_load_param("hall_delta_1", np.radians(-28.0))
    with pytest.raises(ConfigError, match="sector 1 only"):
        bench.set_load_param("hall_delta_2", np.radians(29.0))
    assert bench.load_parameters["hall_delta_2"] == 0.0
