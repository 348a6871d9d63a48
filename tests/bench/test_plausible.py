"""What `bench live` says of a run by what was seen: ok, ok as far as was seen, or implausible.

The simulated drive is given what its firmware does not know; that is told by its configuration, not by what it streams.
"""

from __future__ import annotations

import pytest
from virtual_run import WatchedLink, run, simulated

HEALTHY = {
    "500 r/min": ({}, {"speed_rpm": 500.0}),
    "backwards": ({}, {"speed_rpm": -500.0}),
    "slowly": ({}, {"speed_rpm": 50.0}),
    "3000 r/min": ({}, {"speed_rpm": 3000.0}),
    "at rest": ({}, {"speed_rpm": 0.0}),
    "loaded": ({}, {"speed_rpm": 1000.0, "load_a": 4.0}),
    "four pole pairs that it knows": ({"motor__n_p": 4}, {"speed_rpm": 500.0}),
    "by its Hall sensors": ({}, {"speed_rpm": 500.0, "observer": "average-speed"}),
}
WRONG = {
    "four pole pairs": (
        {"motor__n_p": 4, "firmware__n_p": 6},
        {},
        "wrong number of pole pairs: 6 in the drive, 4 would fit; or the encoder has 1/1.5 of the lines",
    ),
    "wires a and b exchanged": ({"wiring__hall_swap": 1}, {}, "300 r/min were asked for, it turned at"),
    "the same, slowly": ({"wiring__hall_swap": 1}, {"speed_rpm": 50.0}, "50 r/min were asked for, it turned at"),
    "an encoder turned by 120 deg": ({"encoder__offset_deg": 120.0}, {}, "off the encoder: more than a Hall sector"),
    "wires rotated, no encoder": ({"wiring__hall_swap": 4, "encoder__present": 0}, {}, "by its Hall sensors"),
}
NO_REFERENCE = "position error (no angle with the flag REFERENCE)"
UNSEEN = {
    "no encoder": ({"encoder__present": 0}, {}, NO_REFERENCE),
    "nor for long": ({"encoder__present": 0}, {"duration": 2.2, "speed_rpm": 370.0}, NO_REFERENCE),
    "too short": ({}, {"duration": 0.4}, "whether 300 r/min are held (too short a time)"),
    "sampled too seldom": (
        {},
        {"speed_rpm": 1000.0, "rate_hz": 64.0},  # 100 electrical revolutions a second
        "Hall sensors against the encoder (too few samples in an electrical revolution)",
    ),
    "too slow": ({}, {"speed_rpm": 3.0}, "whether 3 r/min are held (too slow to tell)"),
}


@pytest.mark.parametrize(("config", "options"), HEALTHY.values(), ids=HEALTHY)
def test_a_healthy_run_is_ok(config: dict[str, float], options: dict[str, object]) -> None:
    ended = run(WatchedLink(simulated(**config)), duration=3.0, **options)
    assert (ended.summary.result, ended.exit_code) == ("ok", 0)


@pytest.mark.parametrize(("config", "options", "words"), WRONG.values(), ids=WRONG)
def test_what_cannot_be_right_is_named(config: dict[str, float], options: dict[str, object], words: str) -> None:
    ended = run(WatchedLink(simulated(**config)), **({"duration": 4.0, "speed_rpm": 300.0} | options))
    assert ended.summary.result.startswith("implausible: ")
    assert words in ended.summary.result
    assert "bench hall check" in ended.summary.result
    assert ended.exit_code == 1


@pytest.mark.parametrize(("config", "options", "words"), UNSEEN.values(), ids=UNSEEN)
def test_what_was_not_seen_is_not_called_ok(config: dict[str, float], options: dict[str, object], words: str) -> None:
    ended = run(WatchedLink(simulated(**config)), **({"duration": 3.0, "speed_rpm": 300.0} | options))
    assert ended.summary.result == f"ok as far as was seen; unverified: {words}"
    assert ended.exit_code == 0
