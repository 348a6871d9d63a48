"""`bench plot FILE.toml` and `bench live --profile`, as a person types them."""

from __future__ import annotations

import io
import json
import re
import tomllib
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from against import said as bench
from hypothesis import HealthCheck, given, settings
from profiles import DRIVE, LOAD, pieces_of, profiles
from virtual_run import WatchedLink, never_armed, reached_by, simulated

from bench.motion.read import STEP, TOP, profile_of
from bench.plot.plot import draw_profile
from bench.plot.profile import draw, points
from bench.report.style import save
from protocol.messages import DriveState

PAGE = Path(__file__).parents[2] / "docs" / "motion.md"
EXAMPLE = PAGE.parent / "examples" / "motion.toml"


def test_a_profile_is_drawn_before_it_is_played(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out, err = bench(capsys, "plot", str(EXAMPLE), "-o", str(tmp_path / "out"))
    assert "8.2 s, 10 steps, speed -600 … 700 r/min, load torque 0 … 0.12 N·m" in " ".join(out.split())
    assert err == ""
    picture = matplotlib.image.imread(tmp_path / "out" / "profile.png")
    assert picture.shape[0] > 600
    assert (picture[..., :3].min(axis=2) < 0.5).mean() > 0.01  # there are lines
    assert (
        "profile.png exists: choose another name"
        in bench(capsys, "plot", str(EXAMPLE), "-o", str(tmp_path / "out"), code=2)[1]
    )
    (plain := tmp_path / "a.toml").write_bytes(EXAMPLE.read_bytes())
    told = json.loads(bench(capsys, "plot", str(plain), "--svg", "--json=-")[0])
    (figure,) = told["figures"]
    assert (tmp_path / "a.figures" / "profile.svg").read_text().count("reversal") >= 1
    assert figure["numbers"]["seconds"] == pytest.approx(8.2)
    names = [step["name"] for step in figure["numbers"]["steps"]]
    assert names == ["step 1", "load step", "softer", "step 4", *["reversal", "step 5.2"] * 2, "sine", "step 7"]
    speed = figure["numbers"]["quantities"]["speed_rpm"]
    data = tomllib.loads(EXAMPLE.read_text())
    for piece in pieces_of(data, DRIVE):
        t = np.linspace(piece.begin + 1e-6, piece.end - 1e-6, 50)
        assert np.interp(t, speed["t_s"], speed["value"]) == pytest.approx(piece.at(t), abs=1.0)


def test_the_page_shows_profiles_that_can_be_played_and_the_example_as_it_is_drawn() -> None:
    text = PAGE.read_text()
    whole, free = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
    assert whole == EXAMPLE.read_text()
    assert profile_of(tomllib.loads(free), "free").max_speed == 900.0
    keys = set(re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE))
    assert keys == {*STEP, *TOP}
    figure = draw_profile(EXAMPLE).figure
    assert figure is not None
    drawn = io.BytesIO()
    save(figure, drawn)  # type: ignore[arg-type]
    drawn.seek(0)
    now, kept = (matplotlib.image.imread(of)[..., :3] for of in (drawn, PAGE.with_suffix(".png")))
    assert now.shape == kept.shape
    assert np.abs(now - kept).mean() < 0.01  # else: bench plot docs/examples/motion.toml


@settings(max_examples=30, deadline=None, suppress_health_check=list(HealthCheck))
@given(profiles())
def test_the_drawn_lines_are_the_profile(data: dict[str, object]) -> None:
    """But for sines, whose points are a fortieth of a period apart, exactly."""
    lines = points(profile_of(data, "a.toml"))
    for quantities in (DRIVE, LOAD):
        if not any(name in quantities for name in lines):
            continue
        for piece in pieces_of(data, quantities):
            if piece.end - piece.begin > 1e-6:
                t, values = lines[piece.quantity]
                inside = np.linspace(piece.begin + 1e-7, piece.end - 1e-7, 23)
                size = 1.0 if piece.sine is None else piece.sine["amplitude"]
                largest = max(1.0, float(np.abs(piece.at(inside)).max()))
                allowed = 1e-4 * largest if piece.sine is None else 0.004 * size + 1e-4 * largest
                assert np.interp(inside, t, values) == pytest.approx(piece.at(inside), abs=allowed)


@pytest.mark.parametrize("count", [1, 30, 150])
def test_many_steps_can_be_drawn_and_gaps_are_gaps(count: int, tmp_path: Path) -> None:
    steps = [{"speed_rpm": 100, "for_s": 0.5, "mark": "a"}, {"current_A": 1, "for_s": 0.5}]
    asked = profile_of({"max_speed_rpm": 500, "steps": [{"repeat": count, "steps": steps}]}, "a")
    figure = draw(asked)
    assert len(figure.axes) == 2
    assert len(figure.axes[0].texts) <= 24
    _, speed = points(asked)["speed_rpm"]
    assert np.isnan(speed).sum() == count - 1
    figure.savefig(tmp_path / "a.png")


def test_what_is_no_profile_is_told(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text("[motor]\nR_s = 0.2\n")
    said = bench(capsys, "plot", str(tmp_path / "a.toml"), code=2)[1]
    assert re.search(r"^error: unknown key motor in .*a.toml: there are steps, name, max_current_A", said)
    assert not (tmp_path / "a.figures").exists()
    said = bench(capsys, "plot", str(EXAMPLE), "--from", "1", code=2)[1]
    assert "--from and --to are for a recorded run: a motion profile is drawn whole" in said
    assert "no such file" in bench(capsys, "plot", str(tmp_path / "none.toml"), code=2)[1]


def test_live_plays_a_profile(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "m.toml").write_text('steps = [{ speed_rpm = 300, ramp_s = 0.2, for_s = 0.4, mark = "up" }]\n')
    link = WatchedLink(simulated())
    with reached_by(link):
        out, _ = bench(
            capsys, "live", "serial:x", "--profile", str(tmp_path / "m.toml"), "--viewer", "none", "--json=-"
        )
    assert json.loads(out)["asked"][0]["title"] == "step 1 (up): speed 300 r/min in 0.2 s"
    assert DriveState.RUNNING in link.states


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--speed", "100"), "--profile and --speed exclude each other: write it into the profile"),
        (("--load", "1"), "--profile and --load exclude each other: write it into the profile"),
        (("--current", "3"), "step 1: current_A comes to 5 A, beyond 3 A, what was announced or agreed to"),
    ],
)
def test_what_live_does_not_take_beside_a_profile(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, arguments: tuple[str, ...], words: str
) -> None:
    (tmp_path / "m.toml").write_text("max_speed_rpm = 500\nsteps = [{ current_A = 5, for_s = 0.4 }]\n")
    link = WatchedLink(simulated())
    with reached_by(link):
        command = ["live", "serial:x", "--profile", str(tmp_path / "m.toml"), "--viewer", "none", *arguments]
        assert words in bench(capsys, *command, code=2)[1]
    assert never_armed(link)


def test_live_says_what_is_wrong_with_a_file_before_it_opens_a_link(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "m.toml").write_text("steps = [{ speed = 5, for_s = 0.4 }]\n")
    said = bench(capsys, "live", "serial:/dev/none", "--profile", str(tmp_path / "m.toml"), code=2)[1]
    assert "unknown key speed in step 1" in said
    said = bench(capsys, "live", "serial:/dev/none", "--profile", str(tmp_path / "none.toml"), code=2)[1]
    assert "none.toml: no such file" in said
