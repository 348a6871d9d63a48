"""The scripted show: how long it takes, and what is said to have been seen in it."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from virtual_run import WatchedLink, run, simulated

from bench.live.manoeuvres import Act, show, timed
from bench.record.reader import Run

SHOW = show(330.0, 8.0)  # the paper's motor
WHOLE = sum(act.seconds for act in SHOW)


@pytest.mark.parametrize("seconds", [0.5, 3.0, 7.25, WHOLE, 2.5 * WHOLE])
def test_a_show_takes_as_long_as_asked_for(seconds: float) -> None:
    acts = list(timed(SHOW, seconds))
    assert sum(act.seconds for act in acts) == pytest.approx(seconds)
    assert min(act.seconds for act in acts) > 0
    assert [act.title for act in acts] == [SHOW[i % len(SHOW)].title for i in range(len(acts))]


def test_speeds_and_load_are_shares_of_what_the_drive_can() -> None:
    assert {act.speed_rpm for act in SHOW} == {500.0, 1000.0}
    assert {act.load_a for act in SHOW} == {0.0, 4.0}
    slow = show(49.0, 1.0)
    assert {act.speed_rpm for act in slow} == {74.0, 148.0}
    assert slow[3].title == "switch to vector tracking, 0.5 A"


def test_by_itself_it_is_played_once_and_what_has_no_end_goes_on() -> None:
    assert tuple(timed(SHOW, None)) == SHOW
    endless = Act("watching", math.inf, 0.0, 0.0, None)
    assert next(timed((endless,), None)).seconds == math.inf
    assert [act.seconds for act in timed((endless,), 20.0)] == [20.0]


@pytest.mark.slow
def test_what_was_seen_in_each_act_is_what_was_recorded_in_its_last_third(tmp_path: Path) -> None:
    """By the plant's own speed in the recording, from note to note; the next act's load and speed are none of it."""
    ended = run(WatchedLink(simulated()), target=None, speed_rpm=None, duration=WHOLE, save=tmp_path / "show.run")
    recorded = Run(tmp_path / "show.run")
    samples, hz = recorded.samples, recorded.info.tick_hz
    t = samples.tick / hz
    rpm = samples.physical("omega_enc") * 60 / (2 * math.pi) / 6
    begins = {text: tick / hz for tick, text, _ in recorded.notes if text in {act.title for act in SHOW}}
    assert [came.title for came in ended.summary.asked] == [act.title for act in SHOW] == list(begins)
    for act, came in zip(SHOW, ended.summary.asked, strict=True):
        last = begins[act.title] + act.seconds
        third = (t > last - act.seconds / 3 - 0.05) & (t < last - 0.1)
        assert (came.speed_asked_rpm, came.load_asked_a) == (act.speed_rpm, act.load_a)
        assert came.speed_came_rpm == pytest.approx(rpm[third].mean(), abs=0.004 * act.speed_rpm)
        assert came.i_q_came_a == pytest.approx(samples.physical("i_q")[third].mean(), abs=0.1)
