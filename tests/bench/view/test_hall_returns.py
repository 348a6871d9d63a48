"""Bounces and pulses a second by Hall sensor, against recordings by formula."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic

from bench.view import schema
from bench.view.hall_returns import HallReturns
from protocol.streams import EdgeChunk
from tests.bench.hall_cases.recording import Bounce, Encoder, Pulses, Recording, pieces, write_run
from tests.bench.hall_cases.shaft import Way

MADE = Recording(way=Way(((0.0, 240.0), (6.0, 240.0)), ((0.0, 6.0),)), encoder=Encoder())
"""24 electrical revolutions a second: each input has 48 edges in one."""


def rows(recording: Recording, late: float = 0.0, piece: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """Ends of seconds in s, and counts; edges come `late` s after the samples of their time."""
    found = HallReturns()
    waiting: list[EdgeChunk] = []
    ends, counts = [], []
    for item in pieces(recording.capture(), piece):
        if isinstance(item, EdgeChunk):
            waiting.append(item)
            continue
        while waiting and waiting[0].tick[0] + late * recording.tick_hz <= item.tick[-1]:
            found.edges(waiting.pop(0))
        more = found.samples(item)
        ends.append(more[0] / recording.tick_hz)
        counts.append(more[1])
    return np.concatenate(ends), np.concatenate(counts)


@pytest.mark.parametrize(("late", "piece"), [(0.0, 3.0), (0.3, 0.05)])
@pytest.mark.parametrize("seen", [{}, {"encoder": None}, {"decimation": 250}], ids=["encoder", "none", "few samples"])
def test_each_bounce_is_counted_in_its_second(late: float, piece: float, seen: dict[str, Any]) -> None:
    """Also of a shaft that turns by a third of a revolution from sample to sample."""
    ends, counts = rows(MADE.with_effect(Bounce((1,), 1.0, 1, 50e-6)).but(**seen), late, piece)
    assert np.array_equal(ends, np.arange(len(ends)))
    assert len(ends) >= 5
    assert counts[2:5, 1] == pytest.approx(48, abs=1)
    assert not counts[:, [0, 2, 3, 4, 5]].any()


def test_pulses_are_those_that_were_made() -> None:
    it = MADE.with_effect(Pulses((0, 2), 30.0, (5e-6, 10e-6)))
    made = [(len(it.lines[number].times) - len(MADE.lines[number].times)) / 2 for number in range(3)]
    _, counts = rows(it)
    assert counts[:, 3:].sum(axis=0) == pytest.approx(np.array(made) * 5 / 6, rel=0.1)
    assert not counts[:, :3].any()
    assert not counts[:, 4].any()


def test_a_healthy_motor_and_one_at_rest_have_none() -> None:
    for recording in (MADE, MADE.but(way=Way(((0.0, 0.0), (6.0, 0.0)), ((0.0, 6.0),)))):
        ends, counts = rows(recording)
        assert len(ends) >= 5
        assert not counts.any()


def test_a_recording_shows_them(tmp_path: Path) -> None:
    path = write_run(tmp_path / "a.run", MADE.with_effect(Bounce((0,), 0.5, 1, 50e-6)).capture())
    a, b = (synthetic.column(path, schema.RETURNS, f"returns:bounces {sensor}") for sensor in "ab")
    assert [at // 10**9 for at, _ in a] == [0, 1, 2, 3, 4, 5]
    assert float(np.sum([value for _, value in a])) == pytest.approx(0.5 * 48 * 5, rel=0.3)
    assert float(np.sum([value for _, value in b])) == 0.0
