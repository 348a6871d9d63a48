"""Shares of what a drive is rated for: of limits, of setpoints, in bench.toml, and where nobody tells the ratings."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from accepting import Accepting, SpoiltLink

from bench.accept import RATED_CURRENT, RATED_SPEED, energises
from bench.accept.accept import closing_lines
from bench.errors import BenchError
from bench.rig.ratings import ratings
from bench.rig.settings import write_rated
from bench.signal.limits import LOAD_ANGLE, Limits
from protocol.descriptor import Descriptor
from sim.config.params import load_params
from sim.ports.device import SimulatedDevice

PAPER = {"omega_m_max": 330.0, "i_max": 8.0}
TURNS = """
from bench.accept import RATED_CURRENT, RATED_SPEED
@limit("speed", "r/min", lo=0.099, hi=0.101, of=RATED_SPEED)
@limit("current", "A", hi=1.1, of=RATED_CURRENT)
@energises(rated_speed=0.1, rated_current=0.5)
def test_turns(drive, rated, record, measure):
    turn(drive, record, 0.1 * rated.speed_rpm)
    record.wait(0.4)
    run = record(0.2)
    measure("speed", run["omega_enc"].mean() / RPM / drive.n_p, run)
    measure("current", drive.parameters["i_max"] + 0 * np.abs(run["i_a"]).max(), run)
    drive.speed(rpm=0.11 * rated.speed_rpm)
"""


@pytest.mark.parametrize(("told", "own", "expected"), [
    (PAPER, {}, {RATED_SPEED: 3000.0, RATED_CURRENT: 8.0}),
    (PAPER, {"current": 5.0}, {RATED_SPEED: 3000.0, RATED_CURRENT: 5.0}),
    ({"omega_m_max": 48.4}, {}, {RATED_SPEED: 440.0}),
    # 8 A through 1 mH are 8 mV s: as much as the magnets give
    ({"i_max": 9.0, "L_s_hat": 1e-3, "psi_f_hat": 8e-3}, {"current": 8.0}, {RATED_CURRENT: 8.0, LOAD_ANGLE: 45.0}),
    ({"L_s_hat": 1e-3, "psi_f_hat": 8e-3}, {}, {}),
    ({}, {"speed_rpm": 1234.0}, {RATED_SPEED: 1234.0}),
    ({"omega_m_max": 0.0, "i_max": 0.0}, {}, {}),
])  # fmt: skip
def test_the_drive_tells_and_the_file_says_less(told, own, expected) -> None:
    assert ratings(told, own).told == pytest.approx(expected)


def test_a_rating_that_nobody_tells_is_said_with_who_may_say_it() -> None:
    with pytest.raises(BenchError, match=r"rated current: it has no parameter i_max; set \[rated\] current in bench"):
        _ = ratings({"omega_m_max": 330.0}, {}).current


def test_limits_are_shares_until_the_drive_is_known() -> None:
    limits = Limits("i", "A", -0.5, 1.25, of=RATED_CURRENT)
    assert str(limits) == "-0.5 … 1.25 × rated current"
    assert limits.resolved({RATED_SPEED: 3000.0}) is limits
    known = limits.resolved({RATED_CURRENT: 8.0})
    assert (known.lo, known.hi, known.of) == (-4.0, 10.0, "")
    assert (str(known), known.margin(9.0)) == ("-4 … 10 A (-0.5 … 1.25 × rated current)", 1.0)
    with pytest.raises(ValueError, match="no rating 'rated voltage'"):
        Limits("u", "V", of="rated voltage")


def test_limits_are_wider_by_a_share_of_the_load_angle() -> None:
    limits = Limits("error", "deg", -2.5, plus=0.1)
    assert str(limits) == "≥ -2.5 deg, widened by 0.1 × load angle"
    assert limits.resolved({RATED_CURRENT: 8.0}) is limits  # a drive that does not tell it has them as they are
    with pytest.raises(ValueError, match="shares of the rated current or widened by load angle, not both"):
        Limits("i", "A", hi=1.0, of=RATED_CURRENT, plus=0.1)
    known = limits.resolved({LOAD_ANGLE: 20.0})
    assert (known.lo, known.hi) == (-4.5, None)
    assert known.allow(-4.4)
    assert not known.allow(-4.6)
    assert str(known) == "≥ -4.5 deg (≥ -2.5 deg, widened by 0.1 × load angle)"


@pytest.mark.parametrize("arguments", [
    {},
    {"rpm": 5},
    {"rpm": 5, "rated_speed": 1, "current": 1},
    {"rpm": 5, "current": 1, "rated_current": 1},
])  # fmt: skip
def test_a_test_announces_speed_and_current_once(arguments: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="give rpm or rated_speed, and current or rated_current"):
        energises(**arguments)


def test_set_points_and_limits_scale_and_a_test_keeps_to_the_share_that_it_announced(accepting: Accepting) -> None:
    run = accepting(TURNS)
    assert run["turns"].why.startswith("speed 330 r/min is beyond the announced limit of 300 r/min")
    measured = run.measured
    assert measured["turns.speed"].limits.lo == pytest.approx(297.0)
    assert measured["turns.speed"].value == pytest.approx(300.0, rel=0.01)
    assert measured["turns.current"].limits.scaled == "≤ 1.1 × rated current"
    assert measured["turns.current"].value == 4.0  # `i_max` is lowered to what the test announced
    Path("bench.toml").write_text("[rated]\nspeed_rpm = 2000\ncurrent = 5\n[limits]\n'turns.current' = { hi = 9 }\n")
    measured = accepting(TURNS).measured
    assert measured["turns.speed"].value == pytest.approx(200.0, rel=0.01)
    assert (measured["turns.current"].value, measured["turns.current"].limits.hi) == (2.5, 9.0)


def test_the_list_shows_numbers_and_where_they_come_from(accepting: Accepting) -> None:
    listed = accepting(list_only=True).screen.notes
    assert "hall_wire_broken[a].current_max: ≤ 10 A (≤ 1.25 × rated current)" in listed


def _unrated(*lacking: str) -> SpoiltLink:
    """A simulated drive without these parameters, for all that a host can know."""
    device = SimulatedDevice(load_params(None, {}), 1)
    for session in device.sessions:
        session.app.parameters = [p for p in session.app.parameters if p.name not in lacking]  # type: ignore[misc]
        session.descriptor = Descriptor.of(session.app.channels, session.app.parameters)
        session._blobs._fixed[0] = session.descriptor.pack()
    return SpoiltLink(device)


BOTH = ("omega_m_max", "i_max")
CHOSEN = "watchdog or test_stop or full_speed"


@pytest.mark.parametrize("lacking", [BOTH, BOTH[:1], BOTH[1:]], ids=" ".join)
def test_what_needs_no_rating_is_tested_without_one(accepting: Accepting, lacking: tuple[str, ...]) -> None:
    run = accepting(link=_unrated(*lacking), keyword=CHOSEN, yes=True)
    assert run.tests["watchdog"] == "PASS"
    assert {run.measured[f"stop.{name}"].verdict for name in ("command_time", "idle_share")} == {"PASS"}
    for name, parameter, key in (("speed", "omega_m_max", "speed_rpm"), ("current", "i_max", "current")):
        said = f"needs the drive's rated {name}: it has no parameter {parameter}; set [rated] {key} in bench.toml"
        assert (said in run["full_speed"].why) == (parameter in lacking)
        assert (said in run["stop"].why) == (parameter in lacking)
    assert run["full_speed"].verdict == "SKIPPED"
    lines = closing_lines(run.result)
    at = lines.index("    [rated]")
    filled = [re.sub(r"=\s+#", "= 5 #", line) for line in lines[at : at + 1 + len(lacking)]]
    assert set(tomllib.loads("\n".join(filled))["rated"]) == {
        key for parameter, key in zip(BOTH, ("speed_rpm", "current"), strict=True) if parameter in lacking
    }
    with pytest.raises(tomllib.TOMLDecodeError):  # nobody runs a motor at a number that nobody gave
        tomllib.loads("\n".join(lines[at : at + 2]))


def test_ratings_that_are_given_are_written_and_used(accepting: Accepting) -> None:
    Path("bench.toml").write_text("station = 'x'  # mine\n[limits]\n'turns.current' = { hi = 9 }\n")
    given = {"rated_speed": 2000.0, "rated_current": 5.0}
    run = accepting(link=_unrated(*BOTH), keyword="watchdog", yes=True, **given)
    assert set(run.tests.values()) == {"PASS"}
    assert "    [rated]" not in closing_lines(run.result)
    text = Path("bench.toml").read_text()
    assert "# mine" in text
    assert tomllib.loads(text)["rated"] == {"speed_rpm": 2000.0, "current": 5.0}
    accepting(link=_unrated(*BOTH), keyword="test_watchdog and not load", yes=True, **given)
    assert Path("bench.toml").read_text() == text
    with pytest.raises(BenchError, match=r"bench.toml says \[rated\] current = 5, not 6: change it there"):
        accepting(keyword="test_watchdog", rated_current=6.0)


@pytest.mark.parametrize(("before", "after"), [
    ("", "[rated]\nspeed_rpm = 7.5\n"),
    ("[rated]  # r\ncurrent = 2\n[rig]\n", "[rated]  # r\nspeed_rpm = 7.5\ncurrent = 2\n[rig]\n"),
    ("station = 'x'\n", "station = 'x'\n\n[rated]\nspeed_rpm = 7.5\n"),
])  # fmt: skip
def test_a_rating_goes_where_it_belongs(tmp_path: Path, before: str, after: str) -> None:
    file = tmp_path / "bench.toml"
    file.write_text(before)
    write_rated(file, {"speed_rpm": 7.5, "current": None})
    assert file.read_text() == after


def test_a_rating_that_cannot_be_put_there_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "bench.toml"
    file.write_text("rated = { current = 2 }\n")
    with pytest.raises(BenchError, match=r"does not fit into .*: write it there by hand"):
        write_rated(file, {"speed_rpm": 7.5})
    assert file.read_text() == "rated = { current = 2 }\n"
