"""The scripted show: how long it takes, and what is said to have been seen in it."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from virtual_run import WatchedLink, run, simulated

from bench.live.manoeuvres import show
from bench.motion.profile import LOAD_CURRENT, SPEED, Profile, Step
from bench.record.reader import Run

SHOW = show(330.0, 8.0)  # the paper's motor
WHOLE = SHOW.seconds


@pytest.mark.parametrize("seconds", [0.5, 3.0, 7.25, WHOLE, 2.5 * WHOLE])
def test_a_show_takes_as_long_as_asked_for(seconds: float) -> None:
    acts = list(SHOW.timed(seconds))
    assert sum(act.seconds for act in acts) == pytest.approx(seconds)
    assert min(act.seconds for act in acts) > 0
    assert [act.title for act in acts] == [SHOW.acts[i % len(SHOW.acts)].title for i in range(len(acts))]


def test_speeds_and_load_are_shares_of_what_the_drive_can() -> None:
    assert {step.targets[SPEED] for step in SHOW.steps} == {500.0, 1000.0}
    assert {step.targets[LOAD_CURRENT] for step in SHOW.steps} == {0.0, 4.0}
    slow = show(49.0, 1.0)
    assert {step.targets[SPEED] for step in slow.steps} == {74.0, 148.0}
    assert slow.acts[3].title == "switch to vector tracking, 0.5 A"


def test_by_itself_it_is_played_once_and_what_has_no_end_goes_on() -> None:
    assert tuple(SHOW.timed(None)) == SHOW.acts
    endless = Profile((Step("500 r/min", math.inf, {SPEED: 500.0}),))
    assert next(endless.timed(None)).seconds == math.inf
    assert [act.seconds for act in endless.timed(20.0)] == [20.0]


@pytest.mark.slow
def test_what_was_seen_in_each_act_is_what_was_recorded_in_its_last_third(tmp_path: Path) -> None:
    """By the plant's own speed in the recording, from note to note; the next act's load and speed are none of it."""
    ended = run(WatchedLink(simulated()), target=None, speed_rpm=None, duration=WHOLE, save=tmp_path / "show.run")
    recorded = Run(tmp_path / "show.run")
    samples, hz = recorded.samples, recorded.info.tick_hz
    t = samples.tick / hz
    rpm = samples.physical("omega_enc") * 60 / (2 * math.pi) / 6
    begins = {text: tick / hz for tick, text, _ in recorded.notes if text in {act.title for act in SHOW.acts}}
    assert [came.title for came in ended.summary.asked] == [act.title for act in SHOW.acts] == list(begins)
    for act, came in zip(SHOW.acts, ended.summary.asked, strict=True):
        last = begins[act.title] + act.seconds
        third = (t > last - act.seconds / 3 - 0.05) & (t < last - 0.1)
        assert (came.speed_asked_rpm, came.load_asked_a) == (act.drive.last, act.load.last)
        assert came.speed_came_rpm == pytest.approx(rpm[third].mean(), abs=0.004 * act.drive.last)
        assert came.i_q_came_a == pytest.approx(samples.physical("i_q")[third].mean(), abs=0.1)
