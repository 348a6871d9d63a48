"""`[rig] encoder = false`: whatever a drive tells, nothing is compared with an encoder, and no control goes by one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from against import said
from virtual_run import WatchedLink, never_armed, run, simulated

import bench
from bench.errors import BenchError, NodeError
from bench.rig.settings import Settings, read_settings
from protocol.signals import AngleSource, Flag

BLIND = Settings(encoder=False)
NONE = r"bench.toml says that none is mounted \(\[rig\] encoder\)"


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bench.toml").write_text("[rig]\nencoder = false\n")


def test_a_run_is_judged_without_it() -> None:
    link = WatchedLink(simulated())
    ended = run(link, observer="average-speed", duration=1.5, settings=BLIND)
    assert ended.exit_code == 0
    assert "position error (no angle with the flag REFERENCE)" in ended.words
    assert run(WatchedLink(simulated()), observer="average-speed", duration=1.5).words == "ok"


def test_a_control_that_would_go_by_it_is_not_energised() -> None:
    """By the parameter that the drive has, by an option, and by a change while it runs."""
    device = simulated()
    device.drive.app.set_param("observer", float(AngleSource.ENCODER))
    first, second = WatchedLink(device), WatchedLink(device)
    with pytest.raises(BenchError, match=NONE):
        run(first, settings=BLIND)
    with pytest.raises(NodeError, match="--observer needs the angle source encoder"):
        run(second, observer="encoder", settings=BLIND)
    assert never_armed(first, second)
    with bench.connect("sim", settings="bench.toml") as rig:
        with pytest.raises(BenchError, match=NONE):
            rig.drive.start("encoder")
        rig.drive.start("average-speed")
        rig.drive.speed(rpm=500)
        with pytest.raises(BenchError, match=NONE):
            rig.drive.set("observer", 0.0)
        seen = rig.record(1.0)
        assert not rig.has_encoder
    assert 200 < len(seen.edges) < 6 * 6 * 500 / 60 + 10  # six edges in each of six pole pairs' turns: it turned
    with pytest.raises(BenchError):
        assert seen.reference is not None


def test_a_capture_has_no_reference(capsys: pytest.CaptureFixture[str]) -> None:
    said(capsys, "capture", "sim", "--trigger", "now", "--for", "0.02", "-o", "held.run")
    Path("bench.toml").unlink()
    said(capsys, "capture", "sim", "--trigger", "now", "--for", "0.02", "-o", "seen.run")
    flagged = [
        [channel.name for channel in bench.open(path).info.channels if channel.flags & Flag.REFERENCE]
        for path in ("held.run", "seen.run")
    ]
    assert flagged == [[], ["theta_enc", "omega_enc"]]


def test_acceptance_skips_what_needs_one(capsys: pytest.CaptureFixture[str]) -> None:
    out, _ = said(capsys, "accept", "sim", "-k", "fig08", code=6)
    assert "needs an encoder: the drive streams no reference position" in out


def test_a_check_of_hall_sensors_turns_without_it(capsys: pytest.CaptureFixture[str]) -> None:
    out, err = said(capsys, "hall", "check", "sim", "--json", code=2)
    assert "the drive by its encoder" not in err
    assert "no encoder was recorded" in json.dumps(json.loads(out))


def test_without_the_key_there_is_one() -> None:
    Path("bench.toml").write_text("")
    assert read_settings(None).encoder
