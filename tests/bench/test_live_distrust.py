"""What `bench live` says of Hall sensors that the drive itself distrusts, against the channel that it streams."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from virtual_run import RecordingScreen, WatchedLink, run, simulated

from bench.device.heard import ClockRestarted
from bench.live.distrust import CHANNEL, SETTLED, Distrust
from bench.live.run import LiveOutcome
from bench.live.summary import run_rows
from bench.record.reader import Run
from bench.signal.chunks import part

PATIENT = {"firmware__protection__hall_fault_time": 1.0, "firmware__protection__hall_fault_count": 1000}
DEAD_B = {"faults__hall__contact_open": [0.0, 0.999, 0.0], "faults__hall__contact_stretch": 1.0}
FOR_A_SECOND = {"faults__begin": 2.0, "faults__end": 3.0}
LOOSE_B = {"faults__hall__contact_open": [0.0, 0.3, 0.0], "faults__begin": 2.0}
AT = re.compile(
    r"(the drive (?:distrusts|trusts|finds that) Hall sensor ([abc])(?: again| has moved)?), from (\d+\.\d+) s on"
)


def words_of(path: Path, settings: dict[str, Any], **options: Any) -> tuple[LiveOutcome, list[re.Match[str]], Run]:
    screen = RecordingScreen()
    options = {"observer": "edge-kalman", "duration": 5.5} | options
    ended = run(WatchedLink(simulated(**settings)), screen=screen, save=path, **options)
    return ended, [found for note in screen.notes if (found := AT.fullmatch(note))], Run(path)


def test_a_sensor_that_is_dead_for_a_second_is_named_and_so_is_that_it_came_back(tmp_path: Path) -> None:
    ended, said, recording = words_of(tmp_path / "a.run", PATIENT | DEAD_B | FOR_A_SECOND)
    samples, hz = recording.samples, recording.info.tick_hz
    untrusted = samples.raw[CHANNEL] == 0b010
    first, last = samples.tick[np.flatnonzero(untrusted)[[0, -1]]].tolist()
    words = ["the drive distrusts Hall sensor b", "the drive trusts Hall sensor b again"]
    assert [found[1] for found in said] == words
    assert [float(found[3]) for found in said] == pytest.approx([first / hz, last / hz], abs=1e-3)
    assert 2.0 < first / hz < 2.2
    assert 3.0 < last / hz < 3.3
    marks = [(mark.name, mark.first_tick, mark.verdict) for mark in recording.marks if "trusts" in mark.name]
    assert marks == list(zip(words, (first, last), (None, None), strict=True))
    assert ended.summary.distrusted == {"b": pytest.approx(untrusted.mean(), abs=1e-3)}
    row = f"b for {ended.summary.distrusted['b']:.1%} of the time"
    assert ["Hall sensors that the drive distrusted", row] in run_rows(ended.summary)
    assert "trust" not in ended.summary.result  # that is the verdict of who judges its edges

    anew: list[object] = []
    distrust = Distrust(1, lambda *told: anew.append(told))
    half = int(np.searchsorted(samples.tick, (first + last) // 2))
    for item in (part(samples, 0, half), ClockRestarted(1, 0), part(samples, 0, 1000)):
        distrust.take(item)
    assert anew == [("the drive distrusts Hall sensor b", first, True)]  # it has booted since, and trusts all three


def test_a_drive_that_trips_distrusts_the_dead_sensor_to_the_end(tmp_path: Path) -> None:
    ended, said, _ = words_of(tmp_path / "a.run", DEAD_B | {"faults__begin": 1.0}, duration=3.0)
    assert [found[1] for found in said] == ["the drive distrusts Hall sensor b"]
    assert ended.summary.result.startswith("the drive tripped: HALL")
    assert ended.summary.distrusted["b"] > 0.5


@pytest.mark.slow
def test_of_a_loose_contact_little_is_said(tmp_path: Path) -> None:
    """The channel changes much more often than a person would read."""
    _, said, recording = words_of(tmp_path / "a.run", PATIENT | LOOSE_B, speed_rpm=2000.0, duration=8.0)
    assert np.count_nonzero(np.diff(recording.samples.raw[CHANNEL])) > 2 * len(said)
    for sensor in "abc":
        told = [(found[1].endswith("again"), float(found[3])) for found in said if found[2] == sensor]
        assert [again for again, _ in told] == [bool(k % 2) for k in range(len(told))]
        assert (np.diff([at for _, at in told])[1::2] >= SETTLED).all()


def test_a_sensor_that_moves_is_named_once(tmp_path: Path) -> None:
    late = {"faults__hall__rise_delay": [0.0, 0.0, 3e-4], "faults__hall__fall_delay": [0.0, 0.0, 3e-4]}  # 6 deg
    ended, said, recording = words_of(tmp_path / "a.run", late | {"faults__begin": 3.0}, speed_rpm=660.0, duration=5.0)
    assert [found[1] for found in said] == ["the drive finds that Hall sensor c has moved"]
    assert 3.0 < float(said[0][3]) < 3.5
    assert [mark.name for mark in recording.marks if "moved" in mark.name] == [said[0][1]]
    assert (ended.summary.moved, ended.summary.distrusted, ended.summary.angle_lost) == (["c"], {}, 0.0)
    assert ["Hall sensors that moved, as the drive found", "c"] in run_rows(ended.summary)


def test_a_drive_that_loses_the_angle_is_said_to_and_that_it_has_found_it_again(tmp_path: Path) -> None:
    ended, _, recording = words_of(tmp_path / "a.run", {}, duration=3.0, load_a=3.0)
    samples, told = recording.samples, []
    n = len(samples)
    assert (samples.raw[CHANNEL] & 0b1000000).any()  # the load turns the shaft once the outputs are off
    assert ended.summary.angle_lost == 0.0
    samples.raw[CHANNEL][n // 4 : n // 3 : 2] |= 0b1000000  # it flickers
    distrust = Distrust(1, lambda *words: told.append(words))
    for k in range(0, n, 500):
        distrust.take(part(samples, k, min(k + 500, n)))
    lost = np.flatnonzero(samples.raw[CHANNEL][: n // 3] & 0b1000000)
    assert told == [
        ("the drive does not know the rotor's angle", int(samples.tick[lost[0]]), True),
        ("the drive knows the rotor's angle again", int(samples.tick[lost[-1]]), False),
    ]
    assert (distrust.lost, distrust.shares, distrust.moved) == (pytest.approx(len(lost) / n), {}, [])


def test_of_a_healthy_drive_and_of_one_that_does_not_tell_nothing_is_said(tmp_path: Path) -> None:
    for observer, shares in (("edge-kalman", {}), ("encoder", None)):
        ended, said, recording = words_of(tmp_path / f"{observer}.run", {}, observer=observer, duration=2.0)
        assert (said, ended.summary.distrusted, ended.exit_code) == ([], shares, 0)
        assert not [row for row in run_rows(ended.summary) if "distrusted" in row[0]]
        assert (CHANNEL in recording.samples.raw.dtype.names) == (shares is not None)
