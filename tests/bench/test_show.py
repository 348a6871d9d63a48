"""How long the scripted show takes."""

from __future__ import annotations

import math

import pytest

from bench.live.manoeuvres import Act, show, timed

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
