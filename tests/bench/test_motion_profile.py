"""A motion profile is what its file says at any time: against a walk of its own; what a file cannot say is refused."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st
from profiles import DRIVE, LOAD, Piece, flat, pieces_of, profiles

from bench.errors import BenchError
from bench.motion.profile import Act, Profile, Sine
from bench.motion.read import profile_of, read_profile


def at(profile: Profile, machine: int, t: float) -> tuple[str, float] | None:
    """What a machine is asked for at a time within an act."""
    for begin, act in profile.begins():
        if begin <= t < begin + act.seconds:
            course = act.courses[machine]
            return course.quantity, course.at(t - begin)
    return None


def within(piece: Piece) -> list[float]:
    """Times in a piece, none so near its ends that rounding could put it into another."""
    return [piece.begin + (piece.end - piece.begin) * share for share in (0.001, 0.2, 0.5, 0.77, 0.999)]


@settings(max_examples=80, deadline=None)
@given(profiles())
def test_at_any_time_it_asks_for_what_the_file_says(data: dict[str, Any]) -> None:
    profile = profile_of(data, "a.toml")
    steps = list(flat(data["steps"]))
    assert profile.seconds == pytest.approx(sum(step.get("for_s", step.get("ramp_s")) for step in steps))
    assert [act.seconds for act in profile.acts] == [step.get("for_s", step.get("ramp_s")) for step in steps]
    assert profile.loads == any(key in LOAD for step in steps for key in step)
    for machine, quantities in enumerate((DRIVE, LOAD) if profile.loads else (DRIVE,)):
        for piece in pieces_of(data, quantities):
            for t in within(piece):
                quantity, value = at(profile, machine, t) or ("", math.nan)
                assert quantity == piece.quantity
                assert value == pytest.approx(piece.at(t), rel=1e-9, abs=1e-6 * max(1.0, abs(piece.last - piece.first)))


@settings(max_examples=60, deadline=None)
@given(profiles())
def test_its_peaks_are_the_largest_values_and_no_more(data: dict[str, Any]) -> None:
    profile = profile_of(data, "a.toml")
    largest: dict[str, float] = {}
    for quantities in (DRIVE, LOAD) if profile.loads else (DRIVE,):
        for piece in pieces_of(data, quantities):
            values = np.abs(piece.at(np.linspace(piece.begin, piece.end, 4001)))
            largest[piece.quantity] = max(largest.get(piece.quantity, 0.0), float(values.max()))
    assert largest.keys() == {course.quantity for act in profile.acts for course in act.courses}
    for quantity, value in largest.items():
        assert value <= profile.peak(quantity) * (1 + 1e-9) + 1e-9
        assert profile.peak(quantity) == pytest.approx(value, rel=1e-3, abs=1e-9)


@settings(max_examples=60, deadline=None)
@given(profiles(), st.integers(1, 4000))
def test_to_fill_a_time_it_is_repeated_and_cut(data: dict[str, Any], hundredths: int) -> None:
    profile, seconds = profile_of(data, "a.toml"), hundredths / 100.0
    acts: list[Act] = list(profile.timed(seconds))
    assert sum(act.seconds for act in acts) == pytest.approx(seconds)
    assert min(act.seconds for act in acts) > 0.0
    twice = {
        **data,
        "steps": [{"repeat": 1 + math.ceil(seconds / profile.seconds), "steps": list(flat(data["steps"]))}],
    }
    for played, written in zip(acts, profile_of(twice, "b.toml").acts, strict=False):
        assert played.courses == written.courses


@settings(max_examples=40, deadline=None)
@given(data=profiles())
def test_a_file_says_the_same_as_plain_data(tmp_path_factory: pytest.TempPathFactory, data: dict[str, Any]) -> None:
    file = tmp_path_factory.getbasetemp() / "motion.toml"
    file.write_bytes(b"\xef\xbb\xbf" + tomli_w.dumps(data).encode())
    assert read_profile(file).acts == profile_of(data, "x").acts == read_profile(data).acts


def test_names_are_those_of_marks_or_the_places_in_the_file() -> None:
    inner = {"repeat": 2, "steps": [{"for_s": 1, "mark": "b"}, {"for_s": 1}]}
    profile = read_profile({"steps": [{"for_s": 1}, {"repeat": 2, "steps": [inner, {"for_s": 1}]}]})
    assert [act.name for act in profile.acts] == [
        "step 1", *["b", "step 2.1.2", "b", "step 2.1.2", "step 2.2"] * 2,
    ]  # fmt: skip
    assert profile.acts[1].place == "step 2.1.1 (b)"
    assert profile.acts[1].title == "step 2.1.1 (b): hold"


@pytest.mark.parametrize(
    ("sine", "seconds", "extremes"),
    [
        (Sine(2.0, 1.0), 0.25, (0.0, 2.0)),
        (Sine(2.0, 1.0), 0.125, (0.0, math.sqrt(2.0))),
        (Sine(2.0, 1.0, 10.0), 0.75, (8.0, 12.0)),
        (Sine(2.0, 1.0, 0.0, 90.0), 0.25, (0.0, 2.0)),
        (Sine(2.0, 1.0, 0.0, 135.0), 0.25, (-math.sqrt(2.0), math.sqrt(2.0))),
        (Sine(2.0, 1.0, 0.0, -135.0), 0.5, (-2.0, math.sqrt(2.0))),
    ],
)
def test_a_sine_that_is_short_has_only_the_peaks_that_it_comes_to(
    sine: Sine, seconds: float, extremes: tuple[float, float]
) -> None:
    assert sine.extremes(seconds) == pytest.approx(extremes, abs=1e-12)


# -- what a file cannot say -------------------------------------------------------------------------------------------

GOOD = "steps = [\n  { speed_rpm = 500, for_s = 1 },\n  { for_s = 1 },\n]\n"
SECOND = "{ for_s = 1 }"
DEEP = "{ repeat = 2, steps = [{ repeat = 2, steps = [{ repeat = 2, steps = [{ for_s = 1 }] }] }] }"

WRONG = [
    ("{ speed = 500, for_s = 1 }", "unknown key speed in step 2 of F: speed is given in r/min: write speed_rpm"),
    ("{ speed_rad_s = 50, for_s = 1 }", "unknown key speed_rad_s in step 2 of F: speed is given in r/min"),
    ("{ for_ms = 100 }", "unknown key for_ms in step 2 of F: for is given in s: write for_s"),
    ("{ torque_Nm = 1, for_s = 1 }", "unknown key torque_Nm in step 2 of F: did you mean load_torque_Nm?"),
    ("{ load_torque_mNm = 1, for_s = 1 }", "load torque is given in N·m: write load_torque_Nm"),
    ("{ sped_rpm = 1, for_s = 1 }", "unknown key sped_rpm in step 2 of F: did you mean speed_rpm?"),
    ("{ x = 1, for_s = 1 }", "unknown key x in step 2 of F: there are speed_rpm, current_A, load_torque_Nm"),
    ('{ speed_rpm = "500", for_s = 1 }', "speed_rpm in step 2 of F must be a number of r/min, or .*, got '500'"),
    ("{ speed_rpm = true, for_s = 1 }", "speed_rpm in step 2 of F must be a number of r/min, or .*, got True"),
    ("{ speed_rpm = inf, for_s = 1 }", "speed_rpm in step 2 of F must be finite, got inf"),
    ("{ speed_rpm = nan, for_s = 1 }", "speed_rpm in step 2 of F must be finite, got nan"),
    ('{ for_s = "1" }', "for_s in step 2 of F must be a number of s, got '1'"),
    ("{ for_s = 0 }", "for_s in step 2 of F must be at least 0.01 s, got 0"),
    ("{ for_s = -1 }", "for_s in step 2 of F must be at least 0.01 s, got -1"),
    ("{ for_s = inf }", "for_s in step 2 of F must be finite, got inf"),
    ("{ speed_rpm = 5 }", "step 2 of F does not say how long it takes: add for_s = 1"),
    ("{ speed_rpm = 5, ramp_s = 0, for_s = 1 }", "ramp_s in step 2 of F must be more than 0 s, got 0"),
    ("{ speed_rpm = 5, ramp_s = 2, for_s = 1 }", "step 2 of F ends after for_s = 1 s, before its ramp_s = 2 s are"),
    ("{ ramp_s = 1 }", "step 2 of F has ramp_s and nothing that ramps: add speed_rpm or current_A as a number"),
    ("{ speed_rpm = 5, current_A = 1, for_s = 1 }", "step 2 of F has both speed_rpm and current_A"),
    ("{ load_torque_Nm = 5, load_speed_rpm = 1, for_s = 1 }", "has both load_torque_Nm and load_speed_rpm"),
    ("{ speed_rpm = { amplitude = 5 }, for_s = 1 }", "speed_rpm in step 2 of F is a sine without frequency_Hz"),
    ("{ speed_rpm = { frequency_Hz = 5 }, for_s = 1 }", "is a sine without amplitude: it needs amplitude and"),
    ("{ speed_rpm = { amplitude = 5, frequency_Hz = 0 }, for_s = 1 }", "frequency_Hz in speed_rpm in step 2 of F must "
     "be more than 0 Hz, got 0"),
    ("{ speed_rpm = { amplitude = 5, frequency = 1 }, for_s = 1 }", "frequency is given in Hz: write frequency_Hz"),
    ("{ speed_rpm = { amplitude = 5, frequency_Hz = 1, shape = 1 }, for_s = 1 }", "unknown key shape in speed_rpm in"),
    ("{ set = 5, for_s = 1 }", "set in step 2 of F must be a table such as { k_p_vt = 12.0 }, got 5"),
    ('{ set = { k_p_vt = "a" }, for_s = 1 }', "set.k_p_vt in step 2 of F must be a number, got 'a'"),
    ('{ observer = "edge-kalmann", for_s = 1 }', "observer in step 2 of F is 'edge-kalmann': did you mean edge-k"),
    ('{ observer = "encoder", set = { observer = 1 }, for_s = 1 }', "step 2 of F gives the observer twice"),
    ("{ mark = 5, for_s = 1 }", "mark in step 2 of F must be text in one line, got 5"),
    ('{ mark = "a\\nb", for_s = 1 }', "mark in step 2 of F must be text in one line, got 'a\\\\nb'"),
    ('{ mark = "", for_s = 1 }', "mark in step 2 of F is empty: give it a name, or leave it out"),
    ("5", "step 2 of F must be a table such as { speed_rpm = 500, for_s = 2 }, got 5"),
    ("{ repeat = 2 }", "step 2 of F has no steps: write steps = "),
    ("{ repeat = 2, steps = [] }", "step 2 of F has no steps: write steps = "),
    ("{ repeat = 0, steps = [{ for_s = 1 }] }", "repeat in step 2 of F must be a whole number from 1 to 10000, got 0"),
    ("{ repeat = 1.5, steps = [{ for_s = 1 }] }", "repeat in step 2 of F must be a whole number"),
    ("{ repeat = 2, steps = [{ for_s = 1 }], for_s = 1 }", "unknown key for_s in step 2 of F: "),
    ("{ steps = [{ for_s = 1 }] }", "step 2 of F has steps and does not say how often: add repeat = 3"),
    ("{ repeat = 2, steps = [{ for_s = 1 }, { for = 1 }] }", "unknown key for in step 2.2 of F: for is given in s"),
    (DEEP, "step 2.1.1 of F repeats within a repeat within a repeat: write the inner one out"),
    ("{ repeat = 9999, steps = [{ repeat = 9999, steps = [{ for_s = 1 }] }] }", "F has more than 10000 steps, repeats "
     "written out: repeat less"),
    ("{ current_A = 1, for_s = 1 }", "step 2 of F gives current_A, with which the motor turns as fast as its load lets "
     "it: write max_speed_rpm at the top"),
    ("{ load_current_A = 1, for_s = 1 }, { load_torque_Nm = 0, ramp_s = 1 }", "F, step 3: load_torque_Nm cannot ramp, "
     "because load_current_A was asked for before it"),
    ("{ load_speed_rpm = 1, ramp_s = 1 }", "F, step 2: load_speed_rpm cannot ramp, because load_torque_Nm was asked"),
]  # fmt: skip


@pytest.mark.parametrize(("step", "words"), WRONG)
def test_a_wrong_step_is_refused_by_file_and_number(tmp_path: Path, step: str, words: str) -> None:
    file = tmp_path / "F"
    file.write_text(GOOD.replace(SECOND, step), encoding="utf-8")
    with pytest.raises(BenchError) as refused:
        read_profile(file)
    said = str(refused.value).replace(str(file), "F")
    assert re.search(words.replace("{", r"\{"), said), said
    assert "\n" not in said


@pytest.mark.parametrize(
    ("top", "words"),
    [
        ("max_current = 5", "unknown key max_current in F: max current is given in A: write max_current_A"),
        ("max_current_A = 0", "max_current_A in F must be more than 0 A, got 0"),
        ('max_current_A = "5"', "max_current_A in F must be a number of A, got '5'"),
        ("max_speed_rpm = 100", "max_speed_rpm in F is for steps with current_A, and there are none: leave it out"),
        ("name = 5", "name in F must be text in one line, got 5"),
        ("motor = 5", "unknown key motor in F: there are steps, name, max_current_A, max_speed_rpm"),
        ("name = ", r"cannot read F: Invalid value \(at line 1"),
    ],
)
def test_a_wrong_top_is_refused(tmp_path: Path, top: str, words: str) -> None:
    file = tmp_path / "F"
    file.write_text(f"{top}\n{GOOD}", encoding="utf-8")
    with pytest.raises(BenchError) as refused:
        read_profile(file)
    assert re.search(words, str(refused.value).replace(str(file), "F"))


def test_no_file_no_steps_and_no_text(tmp_path: Path) -> None:
    with pytest.raises(BenchError, match=r"no profile .*none.toml"):
        read_profile(tmp_path / "none.toml")
    (tmp_path / "empty.toml").write_text("")
    with pytest.raises(BenchError, match=r"empty.toml has no steps: write steps = \["):
        read_profile(tmp_path / "empty.toml")
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(BenchError, match=r"cannot read .*bytes.toml"):
        read_profile(tmp_path / "bytes.toml")
    with pytest.raises(BenchError, match="cannot read"):
        read_profile(tmp_path)


def test_what_cannot_follow_itself_is_not_repeated() -> None:
    """It ramps from rest in the first round, and in the second from a current that says nothing of the speed."""
    data = {"max_speed_rpm": 900, "steps": [{"speed_rpm": 5, "ramp_s": 1}, {"current_A": 0, "for_s": 1}]}
    assert [act.seconds for act in read_profile(data).timed(1.5)] == [1.0, 0.5]
    with pytest.raises(BenchError, match="step 1: speed_rpm cannot ramp, because current_A was asked for before it"):
        list(read_profile(data).timed(2.5))
