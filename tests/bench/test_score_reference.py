"""Scores without an encoder: by a recording's own edges, and of observers against each other; observers on edges alone.

Recordings are by formula (`hall_cases`), so what the encoder would say is known.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from virtual_run import WatchedLink, simulated
from virtual_run import run as live

import bench
from bench.cli.score import command
from bench.errors import BenchError
from bench.hall.lessons import learned
from bench.replay.estimators import Estimators
from bench.replay.replay import replay
from bench.score.report import as_html
from bench.score.table import as_text
from bench.signal.capture import Capture
from bench.signal.chunks import narrowed, of_channels
from sim.observers.catalogue import CATALOGUE
from tests.bench.hall_cases.drives import healthy
from tests.bench.hall_cases.recording import Motor, Recording, Sensors, write_run
from tests.bench.hall_cases.shaft import Way, ways

NEED_EDGES = {"average_speed", "sector_centre", "lookup_table", "hall_vector", "hall_vector_decoupled", "edge_kalman"}
WAY = Way(ways((0.3, 600.0), (2.0, 600.0), (0.2, 1200.0), (2.0, 1200.0), (0.4, -900.0), (2.0, -900.0)))
LATE = 276e-6
KNOWN = {"n_p": 4.0, "omega_m_max": 200.0}


def recorded(late: float = 0.0) -> Recording:
    sensors = Sensors(displaced=(3.0, -2.0, -1.0), rise_late=(late,) * 3)
    return Recording(Motor(4), WAY, sensors, decimation=1, parameters={"hall_timeout": 0.2})


@cache
def captured(late: float = 0.0) -> Capture:
    return recorded(late).capture()


def edges_alone(capture: Capture, decimation: int = 1) -> Capture:
    """Its Hall codes and edges, as a logic analyser has them, and no parameter of a drive."""
    config = narrowed(capture.samples.config, {"hall"})
    samples = of_channels(capture.samples, config)
    config = replace(config, decimation=decimation)
    kept = {name: getattr(samples, name)[::decimation] for name in ("index", "tick", "raw")}
    return Capture(replace(samples, config=config, **kept), capture.edges)


def test_the_catalogue_says_who_needs_a_voltage() -> None:
    """Told apart by what an estimate is made of: without voltages it stays the same, or it is refused."""
    own = {name for name, entry in CATALOGUE.items() if not entry.needs.required and "." not in name}
    assert own >= NEED_EDGES
    capture = edges_alone(captured())
    for name, entry in CATALOGUE.items():
        if entry.needs.required:
            with pytest.raises(BenchError, match=f"{name} cannot be run on this capture: it has no channel u_alpha"):
                bench.estimate(capture, name, **KNOWN)
        else:
            theta = bench.estimate(capture, name, **KNOWN)[f"theta_{entry.short}_host"]
            assert np.isfinite(theta).all()


@pytest.mark.parametrize("name", sorted(NEED_EDGES - {"hall_vector", "hall_vector_decoupled", "edge_kalman"}))
def test_what_needs_edges_only_gives_the_same_with_voltages_and_without(name: str) -> None:
    whole = captured()
    with_all = Estimators([name], whole.parameters, whole.samples.config)
    few = edges_alone(whole)
    alone = Estimators([name], whole.parameters, few.samples.config)
    for one in (with_all, alone):
        one.edges(whole.edges)
    for a, b in zip(with_all.samples(whole.samples)[name], alone.samples(few.samples)[name], strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("decimation", [4, 16])
def test_a_decimated_stream_gives_what_its_samples_have_at_full_rate(decimation: int) -> None:
    """Edges keep their ticks: an estimate that is made of them does not know how many samples there are."""
    whole, few = edges_alone(captured()), edges_alone(captured(), decimation)
    for name in ("average_speed", "sector_centre"):
        theta = f"theta_{CATALOGUE[name].short}_host"
        at_full, at_few = (bench.estimate(one, name, **KNOWN)[theta] for one in (whole, few))
        np.testing.assert_array_equal(at_few, at_full[::decimation])


@pytest.mark.parametrize("decimation", [1, 4])
@pytest.mark.parametrize("name", ["hall_vector", "hall_vector_decoupled", "edge_kalman"])
def test_what_profits_from_more_follows_the_shaft_without_it(name: str, decimation: int) -> None:
    """At any rate, but that the Hall vector may be seen half a sample late: it knows codes, no times of edges."""
    capture = edges_alone(captured(), decimation)
    theta = bench.estimate(capture, name, **KNOWN)[f"theta_{CATALOGUE[name].short}_host"]
    shaft = (recorded().shaft * 4)[::decimation]
    error = np.degrees((shaft - theta + math.pi) % math.tau - math.pi)
    for first, last in ((1.0, 2.3), (3.0, 4.5), (5.6, 6.9)):
        part = error[(capture.t > first) & (capture.t < last)]
        speed = np.gradient(recorded().shaft * 4)[round(16_000 * first)]  # rad a period
        late = np.degrees(abs(speed)) * decimation / 2.0 if name.startswith("hall_vector") else 0.0
        assert -0.6 < part.mean() * np.sign(speed) < late + 0.6
        assert 0.02 < part.std() < 2.5
    assert np.abs(error[capture.t > 0.5]).max() < 60


@pytest.mark.long("ten drives")
def test_on_edges_alone_the_kalman_filter_keeps_its_place_on_other_drives() -> None:
    """Ten motors, checked, coasting and turned by hand: not those captures on which its constant was chosen."""
    rms: dict[str, list[float]] = {"edge_kalman": [], "average_speed": []}
    for number in range(1000, 1050, 5):
        drive = healthy(number + number // 5 % 5).but(decimation=1)
        capture = drive.capture()
        known = {name: capture.parameters[name] for name in ("n_p", "omega_m_max")}
        theta = drive.shaft * drive.motor.n_p - math.radians(drive.sensors.ring)
        turns = np.abs(np.gradient(theta, drive.t)) > 3 * math.tau
        for name, of in rms.items():
            found = bench.estimate(edges_alone(capture), name, **known)[f"theta_{CATALOGUE[name].short}_host"]
            error = np.degrees((theta - found + math.pi) % math.tau - math.pi)[turns]
            assert np.abs(error).max(initial=0.0) < 90, (number, name)
            of.append(float(np.sqrt(np.mean(error**2))))
    assert 2 < np.nanmedian(rms["edge_kalman"]) < np.nanmedian(rms["average_speed"]) < 8


def test_without_an_encoder_figures_are_those_with_one() -> None:
    """At steady speed: by an encoder that is right, and by the edges of misplaced sensors, in their own turns."""
    capture = captured()
    by_encoder = bench.score(capture.between(3.0, 4.4), observers=sorted(NEED_EDGES)).pooled
    board = bench.score(edges_alone(capture).between(2.3, 4.6), observers=sorted(NEED_EDGES), **KNOWN)
    assert board.reference == "edges"
    track = board.tracks[0]
    assert 0 < track.unknown < track.samples
    assert 0.05 < track.sd.rms < 2.5
    for name in ("average_speed", "sector_centre"):
        for key in ("std", "rms", "bias"):
            expected = by_encoder[name]["error"][key]
            assert board.pooled[name]["error"][key] == pytest.approx(expected, abs=0.5), (name, key)
    assert 16.5 < board.pooled["sector_centre"]["error"]["std"] < 18.5  # 60 / sqrt 12


def test_edges_that_rise_late_make_every_estimate_late() -> None:
    """By half of it, as falling edges are not: the reference goes by these."""
    board = bench.score(edges_alone(captured(LATE)), observers=["ek", "hvd", "sc"], **KNOWN)
    (stated,) = (file["reference"] for file in board.as_json()["files"])
    assert (stated["kind"], stated["edges"]) == ("edges", "falling")
    assert stated["rising_after_falling_s"] == pytest.approx(LATE, abs=5e-6)
    for name in ("hall_vector_decoupled", "sector_centre"):
        assert board.pooled[name]["lag"]["angle_us"] == pytest.approx(1e6 * LATE / 2, abs=20)
    text = "\n".join(as_text(board))
    for words in (
        "angle by its own edges minus estimate", "reference: its own edges, falling edges only (rising ones come 27",
        "samples (", "bias is against the mean place of the edges",
        "not run" if len(board.pooled) > 3 else "edge_kalman: without", "not streamed",
    ):  # fmt: skip
        assert words in text


@pytest.mark.long("draws a page")
def test_against_an_observer_there_are_differences_and_no_errors() -> None:
    capture = edges_alone(captured())
    names = ["average_speed", "hall_vector"]
    boards = [bench.score(capture, observers=names, reference=name, **KNOWN) for name in names]
    assert [list(board.pooled) for board in boards] == [names[1:], names[:1]]
    one, other = (board.pooled[name]["moving"] for board, name in zip(boards, reversed(names), strict=True))
    assert one["bias"] == pytest.approx(-other["bias"], abs=0.3)  # what moves is told by each for itself
    assert one["std"] == pytest.approx(other["std"], rel=0.1)
    (text, page), data = ("\n".join(as_text(boards[0])), as_html(boards[0])), boards[0].as_json()
    assert "Position difference (average_speed minus estimate)" in text
    assert "error" not in text
    assert "error" not in re.sub(r"<style>.*?</style>|base64,[^\"]*", "", page, flags=re.S).lower()
    assert data["definitions"]["error"] == "difference: average_speed less estimated"
    with pytest.raises(BenchError, match=r"cannot be scored: it has no estimate"):
        bench.score(capture, observers=["avg"], reference="average-speed", **KNOWN)


def test_a_recorded_estimate_is_a_reference_too(tmp_path: Path) -> None:
    path = write_run(tmp_path / "a.run", edges_alone(captured()))
    done = replay(path, ["avg"], KNOWN)
    board = bench.score(done.path, observers=["avg"], reference="replayed-avg", **KNOWN)
    assert board.pooled["average_speed"]["moving"]["max"] < 0.02  # its raw format


def test_a_largest_speed_that_is_too_low_is_said() -> None:
    """Observers go by it: those that hold a speed cut it, and the Kalman filter takes it for a measure of all."""
    board = bench.score(edges_alone(captured()), observers=["avg"], n_p=4, omega_m_max=50)
    assert any("omega_m_max is 200 electrical rad/s, and the edges show 503: --set more" in n for n in board.notes)
    assert not any("omega_m_max" in n for n in bench.score(edges_alone(captured()), observers=["avg"], **KNOWN).notes)


def test_what_is_missing_is_named_and_what_to_do() -> None:
    few, whole = edges_alone(captured()), captured()
    with pytest.raises(BenchError, match="it has no channel u_alpha"):
        bench.score(few, observers=["vector_tracking"])
    assert any("observers expect 1.5 times the fastest" in note for note in bench.score(few, observers=["avg"]).notes)
    with pytest.raises(BenchError, match="against an encoder: it has none; use --reference edges"):
        bench.score(few, reference="encoder", **KNOWN)
    with pytest.raises(
        BenchError, match="no reference 'edgse': it is encoder, edges, a recorded estimate or an observer; no obs"
    ):
        bench.score(few, reference="edgse", **KNOWN)
    with pytest.raises(BenchError, match="against vector_tracking: it has no channel u_alpha"):
        bench.score(few, reference="vt", **KNOWN)
    with pytest.raises(BenchError, match=r"omega_m_max: must be 0\.\.6000, got 1e\+06"):
        bench.score(few, n_p=4, omega_m_max=1e6)
    with pytest.raises(BenchError, match=r"nothing to pool: the capture.* by encoder, the capture.* by edges"):
        bench.score(whole, few, observers=["avg"], **KNOWN)
    with pytest.raises(BenchError, match=r"no reference angle: it needs an encoder, or Hall codes and edges"):
        bench.score(replace(few, edges=replace(few.edges, config=replace(few.edges.config, block=0))), **KNOWN)


def test_edges_are_not_learned_without_voltages() -> None:
    """The filter would know them to each other only, and say no less of its certainty."""
    with pytest.raises(BenchError, match="the Kalman filter cannot run on this recording: it has no channel u_alpha"):
        learned(replace(edges_alone(captured()), parameters=captured().parameters), "filter")


def test_the_command_scores_edges_alone(tmp_path: Path) -> None:
    path, out = write_run(tmp_path / "edges.run", edges_alone(captured(), 2)), tmp_path / "score.json"
    setting = ["--set", "n_p=4", "--set", "omega_m_max=200"]
    done = CliRunner().invoke(command, [str(path), *setting, "--json", str(out)])
    assert done.exit_code == 0, done.output
    data = json.loads(out.read_text())
    assert set(data["observers"]) >= NEED_EDGES
    assert (data["definitions"]["reference"], data["files"][0]["pole_pairs"]) == ("edges", 4)
    assert "not at every PWM period" in done.output
    done = CliRunner().invoke(command, [str(path), *setting, "--set", "n_p=5"])
    assert (done.exit_code, "--set n_p is given 2 times" in done.output) == (2, True)


def test_live_estimates_on_edges_come_at_any_rate(tmp_path: Path) -> None:
    live(WatchedLink(simulated()), rate_hz=2000.0, estimate=("avg",), save=tmp_path / "slow.run")
    slow = bench.read(tmp_path / "slow.run")
    assert slow.rate == 2000
    again = bench.estimate(bench.read(tmp_path / "slow.run", channels=["hall", "status"]), "avg")
    np.testing.assert_array_equal(slow["theta_avg_host"], again["theta_avg_host"])
