"""The suite's figures show what formulas say of a shaft at a constant speed: curves, marks, tables."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hall_motor import TABLE_I, Motor, capture

from bench.accept.plots.by_speed import Panel, draw_by_speed, draw_thd_map
from bench.accept.plots.drive import draw_run
from bench.accept.plots.hall import draw_edge_offsets, draw_misaligned_hall
from bench.accept.plots.response import draw_bode
from bench.accept.plots.steady import draw_steady
from bench.accept.plots.transients import draw_load_angle, draw_transient
from bench.accept.suite.common import Transient
from bench.signal.waveforms import EdgeOffsets

OMEGA = 200.0 * math.pi  # electrical rad/s: 100 turns a second
RUN = capture(Motor(turns=((OMEGA, 1.0),), parameters={"i_max": 8.0}))
T = np.arange(16_000) / 16_000
THETA = OMEGA * T + math.radians(30.0)


def wrapped(radians: np.ndarray) -> np.ndarray:
    return (np.degrees(radians) + 180.0) % 360.0 - 180.0


def test_a_run_counts_from_the_first_mark_that_happened() -> None:
    figure = draw_run(RUN, ("speed", "error", "dq", "phases", "hall"), {"never": math.nan, "trip": 0.25, "end": 0.75})
    speed, error, dq, phases, hall = figure.axes
    for ax in figure.axes:
        marks = [line.get_xdata()[0] for line in ax.lines if len(line.get_xdata()) == 2 and line.get_zorder() == 1]
        assert marks == pytest.approx([0.0, 0.5], abs=1e-9)
        assert ax.get_xlim() == pytest.approx((-0.25, 0.75), abs=1e-3)
    assert [text.get_text() for text in speed.get_legend().get_texts()][-2:] == ["trip", "end"]
    assert error.lines[0].get_ydata() == pytest.approx(wrapped(THETA), abs=0.01)  # the estimate stays at 0
    assert dq.lines[1].get_ydata() == pytest.approx(np.ones(16_000), abs=2e-3)
    a = next(line.get_ydata() for line in phases.lines if line.get_label() == "i_a")
    assert a == pytest.approx(-np.sin(THETA), abs=2e-3)
    assert {tuple(line.get_ydata()) for line in phases.lines if len(line.get_ydata()) == 2} >= {
        (-8.0, -8.0),
        (8.0, 8.0),
    }
    levels = [line.get_ydata() for line in hall.lines[:3]]
    for number, level in enumerate(levels):  # a from -60 to 120 deg, b and c 120 deg later each
        high = (np.degrees(THETA) + 60.0 - 120.0 * number) % 360.0 < 180.0
        assert np.mean(level == 2 - number + 0.7 * high) > 0.99


def test_misaligned_sensors_are_shown_over_two_turns() -> None:
    codes, position, error = draw_misaligned_hall(RUN).axes
    x = error.lines[0].get_xdata()
    assert (x.min(), x.max()) == pytest.approx((0.0, 720.0), abs=2.3)  # a sample is 2.25 deg
    assert error.lines[0].get_ydata() == pytest.approx((x + 180.0) % 360.0 - 180.0, abs=0.01)
    assert [line.get_label() for line in position.lines] == ["actual", "estimated"]
    assert [text.get_text() for text in codes.texts] == ["Hall a", "Hall b", "Hall c"]


@pytest.mark.parametrize("ring_deg", [0.0, 30.0, -75.0])
def test_offsets_of_edges_stand_on_the_circle_and_in_the_chart(ring_deg: float) -> None:
    delta = np.radians(np.array(TABLE_I)[:, None] + np.array([-0.25, 0.25]))
    offsets = EdgeOffsets(delta, np.zeros((6, 2)), np.full((6, 2), 9), 0)
    ring = math.radians(ring_deg)
    circle, chart = draw_edge_offsets(offsets, np.radians(TABLE_I), math.radians(1.0), ring).axes
    ideal, measured = ([line[0][0] for line in lines.get_segments()] for lines in circle.collections[:2])
    assert np.degrees(ideal) == pytest.approx(ring_deg + 60.0 * np.arange(6))
    assert np.degrees(measured) == pytest.approx(ring_deg + 60.0 * np.arange(6) - np.array(TABLE_I))
    names = {text.get_text(): math.degrees(text.get_position()[0]) for text in circle.texts}
    assert names["II"] == pytest.approx(ring_deg + 90.0)
    assert np.sort(np.degrees(circle.get_xticks())) == pytest.approx(np.sort((ring_deg + 60.0 * np.arange(6)) % 360.0))
    shown = {line.get_label(): line.get_ydata() for line in chart.lines}
    for name, off in (("forward", -0.25), ("reverse", 0.25), ("middle", 0.0)):
        assert shown[name] == pytest.approx(np.array(TABLE_I) + off)
    assert [(bar.get_y(), bar.get_height()) for bar in chart.patches[:1]] == [(pytest.approx(-2.2), pytest.approx(2.0))]


def test_approaches_stand_side_by_side_over_the_same_time() -> None:
    figure = draw_steady(RUN, RUN, 0.05)
    assert [ax.lines[0].get_ydata()[:5] for ax in figure.axes[:2]] == [pytest.approx(-np.sin(THETA[:5]), abs=2e-3)] * 2
    assert figure.axes[0].get_ylim() == pytest.approx((-1.1, 1.1), abs=2e-3)
    one, other = (Transient(RUN, 0.5, observer) for observer in ("average-speed", "vector-tracking"))
    speed, _, error, *_ = draw_transient(one, other, -0.1, 0.2, 30.0).axes
    assert (speed.get_xlim(), error.get_ylim()) == (pytest.approx((-0.1, 0.2)), pytest.approx((-30.0, 30.0)))
    assert error.lines[0].get_ydata()[0] == pytest.approx(wrapped(THETA[6400:6401])[0], abs=0.05)
    (ax, *_) = draw_load_angle({"light": (one, other)}).axes
    mean = next(line for line in ax.lines if line.get_label() == "its mean")
    inside = np.isfinite(mean.get_ydata())
    assert np.abs(mean.get_ydata()[inside]).max() < 2.0  # of a whole turn
    assert not inside[np.abs(mean.get_xdata()) < 0.0049].any()


def test_curves_over_speed_and_frequency_are_those_that_were_given() -> None:
    speeds, loads = (100.0, 120.0, 200.0), (1.0, 4.0)
    values = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    (ax,) = draw_by_speed(speeds, loads, [Panel("(a)", "std", "°", values, 2 * values, 7.0)], "other").axes
    assert [line.get_ydata() for line in ax.lines[:4]] == [pytest.approx(row) for row in (*2 * values, *values)]
    assert (ax.lines[4].get_ydata()[0], list(ax.get_xticks())) == (7.0, [120.0, 200.0])  # 100 is too near to 120
    left, right = draw_thd_map(loads, speeds, {"one": values, "two": 10 * values}).axes
    assert left.get_ylim() == right.get_ylim() == pytest.approx((0.8, 75.0))
    assert right.lines[1].get_ydata() == pytest.approx(10 * values[1])
    f = np.array([10.0, 100.0])
    magnitude, phase = draw_bode(f, {"x": 0.1j * np.ones(2)}, {"x": lambda f: np.full(len(f), 1.0j)}).axes
    assert [line.get_ydata()[0] for line in magnitude.lines[:2]] == pytest.approx([0.0, -20.0], abs=1e-9)
    assert [line.get_ydata()[0] for line in phase.lines[:2]] == pytest.approx([90.0, 90.0])
