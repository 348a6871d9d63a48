"""Hall edges measured on captures made by formula: angles, confidence, delay, duty, false pulses, back-EMF, turns."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hall_motor import TABLE_I, Motor, capture
from scipy import stats

from bench.errors import BenchError
from bench.hall.trace import trace
from bench.signal import hall_inputs, pulses, reference
from bench.signal.hall_edges import measure
from tests.bench.hall_cases.faults import by_name
from tests.choice import chosen


def deltas(measured):
    return np.degrees([[edge.delta(p) for p in (edge.up, edge.down)] for edge in measured.edges])


# -- edges ------------------------------------------------------------------------------------------------------


def test_edges_lie_where_they_were_put_with_half_the_hysteresis_on_either_side():
    found = measure(trace(capture(Motor(delta_deg=TABLE_I, hysteresis_deg=0.8))))
    assert deltas(found)[:, 0] == pytest.approx(np.array(TABLE_I) - 0.4, abs=0.02)
    assert deltas(found)[:, 1] == pytest.approx(np.array(TABLE_I) + 0.4, abs=0.02)
    assert np.degrees([edge.hysteresis for edge in found.edges]) == pytest.approx([0.8] * 6, abs=0.03)
    widths = [60.0 + TABLE_I[s] - TABLE_I[(s + 1) % 6] for s in range(6)]
    assert np.degrees(found.widths) == pytest.approx(widths, abs=0.03)
    assert sum(found.widths) == pytest.approx(2 * math.pi)
    # c falls where I opens and rises where IV does, b rises at II and falls at V, a falls at III and rises at VI
    at = [60.0 * s - TABLE_I[s] for s in range(6)]
    duty = [(at[2] - at[5]) % 360 / 360, (at[4] - at[1]) % 360 / 360, (at[0] - at[3]) % 360 / 360]
    assert (found.duty, found.outliers) == (pytest.approx(duty, abs=1e-4), 0)


def test_an_edge_is_measured_whatever_input_its_sensor_is_on():
    straight = measure(trace(capture(Motor(delta_deg=TABLE_I))))
    exchanged = measure(trace(capture(Motor(delta_deg=TABLE_I, rewire=lambda abc: (abc[1], abc[0], abc[2])))))
    names = {edge.name: edge for edge in straight.edges}
    for edge in exchanged.edges:
        twin = names[{"a": "b", "b": "a"}.get(edge.name[0], "c") + edge.name[1:]]
        assert edge.up.angle == pytest.approx(twin.up.angle, abs=1e-9)
        assert edge.up.n == twin.up.n > 20


def test_jitter_and_confidence_are_those_of_the_passages():
    inside = widths = 0
    for seed in range(12):
        found = measure(trace(capture(Motor(delta_deg=TABLE_I, jitter_deg=0.5, seed=seed))))
        off = np.abs(deltas(found) - np.array(TABLE_I)[:, None])
        half = np.degrees([[p.half_width for p in (edge.up, edge.down)] for edge in found.edges])
        inside += int((off <= half).sum())
        widths += half.size
        jitter = np.degrees([[p.jitter for p in (edge.up, edge.down)] for edge in found.edges])
        assert jitter.mean() == pytest.approx(0.5, rel=0.12)
        assert half.mean() == pytest.approx(0.5 * 2.0 / math.sqrt(found.edges[0].up.n), rel=0.5)
    assert stats.binomtest(inside, widths, 0.95).pvalue > 1e-3  # 95 % of 144, neither fewer nor more


@pytest.mark.slow
def test_confidence_holds_where_codes_are_sampled_so_slowly_that_their_times_beat_with_the_speed():
    for seed in chosen("codes sampled", range(1000), 3):
        made = by_name(f"codes_sampled/2000/fast/unkind/encoder/{seed}").recording
        found = measure(trace(made.capture()))
        off = np.degrees(found.placement) - (made.sensors.displaced - np.mean(made.sensors.displaced))
        assert np.all(np.abs(off) < 2.0 * np.degrees(found.placement_half_width[0])), seed  # four standard errors


def test_a_delay_is_told_from_the_place_of_an_edge_by_speeds_that_differ():
    delay = 200e-6
    found = measure(trace(capture(Motor(delta_deg=TABLE_I, jitter_deg=0.05, delay=delay))))
    assert found.delay == pytest.approx(delay, abs=2 * found.delay_half_width)
    assert 0.5e-6 < found.delay_half_width < 20e-6
    assert deltas(found) == pytest.approx(np.array([TABLE_I, TABLE_I]).T, abs=0.1)
    one_speed = measure(trace(capture(Motor(turns=((60.0, 2.0), (-60.0, 2.0)), delay=delay))))
    assert math.isnan(one_speed.delay)
    late = math.degrees(60.0 * delay)
    assert deltas(one_speed)[:, 0] == pytest.approx([-late] * 6, abs=0.02)
    assert deltas(one_speed)[:, 1] == pytest.approx([late] * 6, abs=0.02)


def test_what_was_not_met_is_nan_and_counts_none():
    up = measure(trace(capture(Motor(turns=((60.0, 2.0),)))))
    assert all(edge.up.n > 10 and edge.down.n == 0 for edge in up.edges)
    assert all(math.isnan(edge.down.angle) and math.isnan(edge.hysteresis) for edge in up.edges)
    assert (up.least(), up.widest(), deltas(up)[:, 0]) == (0, math.inf, pytest.approx([0.0] * 6, abs=0.02))


# -- traces -----------------------------------------------------------------------------------------------------


def test_false_pulses_are_taken_out_of_the_edges_and_kept():
    clean = trace(capture(Motor()))
    when = [(0.1 + 0.0317 * k, k % 3) for k in range(60)]
    disturbed = trace(capture(Motor(pulses=when)))
    with_them, without = (hall_inputs.read(one.edges, one.tick_hz) for one in (disturbed, clean))
    assert np.bincount(with_them.returns.input).tolist() == [20, 20, 20]
    assert with_them.returns.width == pytest.approx(3e-6)
    assert np.array_equal(with_them.changes.tick, without.changes.tick)
    assert np.array_equal(with_them.changes.high, without.changes.high)
    assert len(without.returns) == 0


@pytest.mark.parametrize("without", [(), ("theta_enc", "omega_enc")], ids=["encoder", "none"])
def test_an_edge_that_the_shaft_undoes_is_no_return(without):
    there_and_back = [(way * 40.0, 0.009) for _ in range(9) for way in (1.0, -1.0)]
    made = trace(capture(Motor(turns=[(40.0, 0.0145), *there_and_back, (40.0, 0.5)], without=without)))
    found = hall_inputs.read(made.edges, made.tick_hz)
    assert len(made.edges.tick) >= 20
    assert len(found.returns) == 0
    assert found.reach < 4.0


def counted(motor: Motor) -> pulses.Pulses:
    made = trace(capture(motor))
    return pulses.count(made, hall_inputs.read(made.edges, made.tick_hz))


def test_pulses_are_set_against_the_current():
    rng = np.random.default_rng(4)
    seconds = sum(t for _, t in Motor().turns)
    high = lambda t: np.where(np.sin(20.0 * t) > 0, 4.0, 1.0) + 0.1 * np.sin(77.0 * t)  # noqa: E731
    anywhere = np.sort(rng.uniform(0.0, seconds, 150))
    anywhere = anywhere[
        np.abs(anywhere - 3.525) > 0.035
    ]  # where it stands nothing tells a pulse from a shaft that trembles
    with_current = anywhere[high(anywhere) > 2.0]
    one = counted(Motor(current=high, pulses=[(t, 0) for t in with_current]))
    assert one.with_current
    assert one.bins[0].n == one.bins[1].n == 0
    assert one.bins[2].n + one.bins[3].n == one.n == len(with_current)
    assert one.bins[0].hi < 2.0 < one.bins[3].lo
    assert one.rate == pytest.approx(len(with_current) / seconds, rel=1e-6)
    other = counted(Motor(current=high, pulses=[(t, 0) for t in anywhere]))
    assert not other.with_current
    assert other.n == len(anywhere)
    assert abs(other.excess) < 3.0


def test_edges_beside_a_gap_and_edges_without_speed_are_left_out_and_counted():
    whole = capture(Motor())
    samples = whole.samples
    keep = (samples.tick <= 4_000_000) | (samples.tick >= 8_000_000)
    parts = {name: getattr(samples, name)[keep] for name in ("index", "tick", "raw")}
    made = trace(replace(whole, samples=replace(samples, **parts)))
    inside = (whole.edges.tick > 4_000_000) & (whole.edges.tick < 8_000_000)
    assert made.unplaced == np.count_nonzero(inside) > 5
    assert measure(made).outliers == 0
    slow = trace(capture(Motor(turns=((3.0, 3.0), (60.0, 1.0)))))
    assert slow.slow == pytest.approx(3.0 * 3.0 / (math.pi / 3), abs=1.5)


def test_a_capture_without_the_hall_channel_is_refused():
    with pytest.raises(BenchError, match="channel 'hall' was not recorded"):
        trace(capture(Motor(without=("hall",))))


# -- the encoder ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("changed", [
    {"running": False}, {"without": ("u_beta",)}, {"turns": ((8.0, 2.0), (-8.0, 2.0))}, {"turns": ((60.0, 0.01),)},
    {"encoder": lambda theta: theta * 4 / 6},
], ids=["off", "no voltage", "too slow", "too short", "other pole pairs"])  # fmt: skip
def test_there_is_no_back_emf_to_go_by(changed):
    assert reference.back_emf(trace(capture(Motor(**changed)))) is None
