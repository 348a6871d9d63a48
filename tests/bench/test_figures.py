"""The standard figures say what formulas say of made up runs."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import made_runs
import matplotlib.image
import numpy as np
import pytest
from click.testing import CliRunner, Result
from damage import flip
from made_runs import CODES, N_P, PWM_HZ, RPM, TICK_HZ, make, turning

from bench.cli import cli
from bench.errors import BenchError
from bench.plot.current_plane import CurrentPlane
from bench.plot.hall_edges import edges_of
from bench.plot.looks import looks
from bench.plot.motion import Motion
from bench.plot.plot import NAMES, Plot, draw_all
from bench.record.reader import Run, captures
from bench.record.times import ticks_of
from bench.record.writer import RunWriter
from bench.signal import windows
from bench.signal.chunks import part
from bench.signal.colours import OBSERVERS
from bench.signal.error_bins import ANGLES, BINS, MOST, ErrorByAngle, ErrorBySpeed, angle_bins
from tests.choice import sampled

DATA = Path(__file__).parents[1] / "data"
N = PWM_HZ  # samples of a second
FIFTH, SEVENTH = 0.05, 0.03


def drawn(path: Path, begin: float | None = None, end: float | None = None) -> dict[str, Plot]:
    run = Run(path)
    return {each.name: each for each in draw_all(run, *ticks_of(run, begin, end))}


def plot(*arguments: object) -> Result:
    return CliRunner().invoke(cli, ["plot", *map(str, arguments)])


def currents(theta: np.ndarray) -> dict[str, np.ndarray]:
    """Phases with a 5th and a 7th harmonic."""
    found = {}
    for k, name in enumerate(("i_a", "i_b", "i_c")):
        angle = theta + math.pi / 2 - k * 2 * math.pi / 3
        found[name] = 3.0 * (np.cos(angle) + FIFTH * np.cos(5 * angle + 1) + SEVENTH * np.sin(7 * angle))
    return found


# -- spectrum -------------------------------------------------------------------------------------------------------


@pytest.mark.long("plots of a long recording")
@pytest.mark.parametrize("encoder", sampled("encoder", (True, False), 1, campaign="examples"))
def test_the_distortion_is_that_of_the_harmonics(encoder: bool, tmp_path: Path) -> None:
    """At rest, then two steady stretches, of which the longer one counts, with a ramp between them."""
    rpm = np.concatenate([np.zeros(N // 2), np.full(N, 300.0), np.linspace(300, 507, N // 10), np.full(2 * N, 507.0)])
    theta = turning(rpm)
    angle = {"theta_enc": theta} if encoder else {"omega_vt": rpm * RPM * N_P}
    found = drawn(make(tmp_path / "a.run", {**angle, **currents(theta)}))["spectrum"]
    numbers = found.numbers
    assert numbers["fundamental_hz"] == pytest.approx(507 / 60 * N_P, rel=1e-4)
    assert numbers["rpm"] == pytest.approx(507, abs=0.1)
    assert 1.69 < numbers["from_s"] < 1.76  # 0.1 s after the ramp, to a block of 0.05 s
    assert numbers["to_s"] == pytest.approx(3.6, abs=0.01)
    for phase in numbers["phases"].values():
        assert phase["thd_percent"] == pytest.approx(100 * math.hypot(FIFTH, SEVENTH), rel=2e-3)
        wanted = np.zeros(20)
        wanted[[0, 4, 6]] = 3.0, 3.0 * FIFTH, 3.0 * SEVENTH
        assert phase["harmonics_a"] == pytest.approx(wanted, abs=2e-3)
    assert "507 r/min" in found.words


def test_a_spectrum_without_a_fundamental_is_drawn_without_a_distortion(tmp_path: Path) -> None:
    theta = turning(np.full(N, 500.0))
    noise = np.random.default_rng(1).normal(size=N)
    found = drawn(make(tmp_path / "a.run", {"theta_enc": theta, "i_a": noise}))["spectrum"]
    assert found.figure is not None
    assert found.numbers["phases"] == {}
    assert "no fundamental" in found.numbers["without_thd"]["i_a"]


# -- position errors ------------------------------------------------------------------------------------------------


def test_an_error_of_the_sixth_harmonic_is_found_in_each_bin(tmp_path: Path) -> None:
    rpm = np.full(4 * N, 443.0)
    rpm[2 * N :] = -443.0
    theta = turning(rpm)
    size = np.where(rpm > 0, 3.0, 5.0)  # degrees; one direction errs more
    estimate = theta - np.radians(size * np.cos(6 * theta) + 1.0)
    found = drawn(make(tmp_path / "a.run", {"theta_enc": theta, "theta_vt": estimate}))["error_by_angle"]
    numbers = found.numbers["estimates"]["theta_vt"]
    width = 2 * math.pi / BINS
    share = math.sin(3 * width) / (3 * width)  # of the amplitude, in the mean over a bin
    shape = share * np.cos(6 * np.radians(ANGLES))
    assert numbers["forwards"]["mean"] == pytest.approx(3.0 * shape + 1.0, abs=0.06)
    assert numbers["backwards"]["mean"] == pytest.approx(5.0 * shape + 1.0, abs=0.1)
    within = np.sqrt(0.5 - share**2 / 2)  # scatter that the slope within a bin makes, in the rms over the bins
    assert np.sqrt(np.mean(np.square(numbers["forwards"]["std"]))) == pytest.approx(3.0 * within, rel=0.05)
    assert numbers["mean"] == pytest.approx(1.0, abs=0.02)


def test_what_is_no_number_counts_for_nothing() -> None:
    sums = ErrorByAngle()
    error = np.ones(100)
    error[[3, 50]] = np.nan, np.inf
    sums.add(angle_bins(np.linspace(0, 1, 100)), error, np.zeros(100, bool))
    assert sums.n.sum() == 98
    assert sums.overall == {"mean": 1.0, "std": 0.0, "rms": 1.0}


def test_a_bias_that_goes_with_the_speed_is_found_at_each_speed(tmp_path: Path) -> None:
    speeds = (-600.0, 200.0, 400.0, 800.0)
    rpm = np.repeat(speeds, N)
    theta = turning(rpm)
    noise = np.random.default_rng(2).normal(0, 1.5, len(rpm))
    error = rpm / 200.0 + noise
    path = make(tmp_path / "a.run", {"theta_enc": theta, "theta_vt": theta - np.radians(error)})
    found = drawn(path)["error_by_speed"].numbers["estimates"]["theta_vt"]
    assert found["rpm"] == list(speeds)
    for k, speed in enumerate(speeds):
        there = error[rpm == speed]
        assert found["mean"][k] == pytest.approx(speed / 200, abs=0.05)
        assert found["rms"][k] == pytest.approx(math.hypot(speed / 200, 1.5), abs=0.05)
        assert found["p95"][k] == pytest.approx(np.percentile(np.abs(there), 95), abs=0.1)


def test_bins_of_the_speed_stay_few_and_lose_nothing() -> None:
    sums = ErrorBySpeed(1000.0, 1)
    rng = np.random.default_rng(3)
    rpm = rng.uniform(-6000, 6000, 50_000)
    for some in np.split(rpm, 50):
        sums.add("theta_vt", some, some / 1000.0)
    found = sums.result()["theta_vt"]
    assert len(found.rpm) <= MOST
    assert found.n.sum() == np.count_nonzero(np.abs(np.floor(rpm / sums.width + 0.5)) > 0)  # without the one about 0
    inner = slice(1, -1)  # those at the ends are not full
    assert found.mean[inner] == pytest.approx(found.rpm[inner] / 1000.0, abs=sums.width / 1000.0 / 8)


def test_phases_do_not_depend_on_how_a_run_is_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rpm = np.concatenate([np.zeros(N // 2), np.full(N, 300.0), np.linspace(300, 900, N // 4), np.full(N, 900.0)])
    run = Run(make(tmp_path / "a.run", {"theta_enc": turning(rpm)}))
    (once,) = Motion(run).pieces(captures(run))
    monkeypatch.setattr(windows, "PIECE", 8100)
    pieces = list(Motion(run).pieces(captures(run)))
    assert len(pieces) > 4
    assert once.phases is not None
    steady = np.concatenate([piece.phases.steady for piece in pieces if piece.phases is not None])
    assert once.phases.steady.sum() > N
    assert np.array_equal(steady, once.phases.steady)


# -- currents and edges ---------------------------------------------------------------------------------------------


def test_currents_are_counted_where_they_are(tmp_path: Path) -> None:
    i_d, i_q = np.repeat([0.0, -3.0, 0.0], 100), np.repeat([2.0, 4.0, 8.5], 100)
    columns = {"i_d": i_d, "i_q": i_q, "i_d_ref": i_d, "i_q_ref": i_q + 1}
    run = Run(make(tmp_path / "a.run", columns))
    sums = CurrentPlane(8.0, True)
    sums.add_samples(run.samples, np.arange(300) >= 50)
    found = sums.result()
    assert found is not None
    side = found.cell
    assert found.counts == {(0, round(2 / side)): 50, (round(-3 / side), round(4 / side)): 100,
                            (0, round(8.5 / side)): 100}  # fmt: skip
    assert {m for _, m in found.references} == {round(i / side) for i in (3.0, 5.0, 9.5)}
    assert found.beyond == 100
    assert found.largest == 8.5
    assert found.mean == pytest.approx((i_d[50:].mean(), i_q[50:].mean()))
    assert found.std == pytest.approx((i_d[50:].std(), i_q[50:].std()))
    for span, n in (((None, None), 300), ((100 / N, 199 / N), 100)):
        assert drawn(tmp_path / "a.run", *span)["current_plane"].numbers["n"] == n


LATE = np.array([1.2, 3.0, -7.2, 3.3, -0.6, -5.6])  # degrees by which each edge comes, turning forwards
HYSTERESIS = 0.8  # degrees that it comes earlier, turning backwards


def hall(theta: np.ndarray, tick: np.ndarray) -> tuple[np.ndarray, made_runs.Edges]:
    """Codes (n,) and edges of a shaft at `theta` (n,), which turns forwards and then backwards."""
    top = int(np.argmax(theta))
    edges, codes = [], np.empty(len(theta), np.uint8)
    for rows, late in ((slice(0, top + 1), LATE), (slice(top, None), LATE - HYSTERESIS)):
        its, at = theta[rows], tick[rows]
        k = np.arange(int(theta.max() / (math.pi / 3)) + 2)
        places = k * math.pi / 3 + np.radians(late[k % 6])
        codes[rows] = CODES[(np.searchsorted(places, its, side="right") - 1) % 6]
        met = k[(places > its.min()) & (places < its.max())]
        forwards = its[-1] > its[0]
        order = 1 if forwards else -1
        when = np.interp(places[met], its[::order], at[::order])
        for sector, moment in zip(met, when, strict=True):
            before, after = CODES[(sector - 1) % 6], CODES[sector % 6]
            edges.append((moment, before, after) if forwards else (moment, after, before))
    edges.sort()
    when, old, new = zip(*edges, strict=True)
    return codes, (np.rint(when).astype(np.int64), np.array(old, np.uint8), np.array(new, np.uint8))


def test_edges_are_as_late_as_they_were_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rpm = np.concatenate([np.full(N, 300.0), np.full(N, -300.0)])
    theta = turning(rpm) + 0.5
    codes, edges = hall(theta, np.arange(len(rpm)) * (TICK_HZ // PWM_HZ))
    path = make(tmp_path / "a.run", {"hall": codes, "theta_enc": theta}, edges)
    found = drawn(path)["hall_edges"].numbers["edges"]
    assert [edge["ideal"] for edge in found] == pytest.approx([0, 60, 120, 180, 240, 300])
    assert [edge["forwards"]["late"] for edge in found] == pytest.approx(LATE, abs=0.02)
    assert [edge["backwards"]["late"] for edge in found] == pytest.approx(LATE - HYSTERESIS, abs=0.02)
    assert sum(edge[way]["n"] for edge in found for way in ("forwards", "backwards")) >= len(edges[0]) - 12
    half = drawn(path, None, 0.5)["hall_edges"].numbers["edges"]
    assert 80 < sum(edge["forwards"]["n"] for edge in half) <= np.count_nonzero(edges[0] <= 0.5 * TICK_HZ)
    monkeypatch.setattr("bench.signal.trace.MOST_EDGES", 100)  # of more some are measured, evenly spread
    some = edges_of(Run(path), *Run(path).span)
    assert some is not None
    assert 25 < sum(passages.n for edge in some.edges for passages in (edge.up, edge.down)) <= 150
    assert [-math.degrees(edge.delta(edge.up)) for edge in some.edges] == pytest.approx(LATE, abs=0.05)


def test_a_gap_is_in_no_stretch_and_between_no_edge_and_its_angle(tmp_path: Path) -> None:
    """A second of steady turning, of which a tenth is lost at 0.7 s: the longest stretch ends there."""
    rpm = np.full(N, 500.0)
    theta = turning(rpm)
    codes, edges = hall(theta, np.arange(N) * (TICK_HZ // PWM_HZ))
    columns = {"hall": codes, "theta_enc": theta, "theta_vt": theta - 0.1, **currents(theta)}
    whole = Run(make(tmp_path / "whole.run", columns, edges))
    path = tmp_path / "lossy.run"
    writer = RunWriter(path, whole.info)
    samples, first, last = whole.samples, round(0.7 * N), round(0.8 * N)
    writer.take(whole.edges)
    writer.take(part(samples, 0, first))
    writer.take(part(samples, last, N))
    writer.close()
    found = drawn(path)
    spectrum = found["spectrum"].numbers
    assert spectrum["to_s"] == pytest.approx(0.7, abs=0.001)
    assert spectrum["phases"]["i_a"]["thd_percent"] == pytest.approx(100 * math.hypot(FIFTH, SEVENTH), rel=2e-3)
    assert found["error_by_angle"].numbers["estimates"]["theta_vt"]["mean"] == pytest.approx(
        math.degrees(0.1), abs=1e-4
    )
    met = sum(edge["forwards"]["n"] for edge in found["hall_edges"].numbers["edges"])
    lost = np.count_nonzero((edges[0] > samples.tick[first - 1]) & (edges[0] < samples.tick[last]))
    assert lost > 10
    assert met == len(edges[0]) - lost


def test_a_hosts_estimate_has_its_observers_colour_unless_the_drives_own_is_beside_it() -> None:
    own = looks(["theta_ek_host", "theta_vt_host", "theta_vt"])
    assert (own["theta_ek_host"], own["theta_vt"]) == (OBSERVERS["ek"], OBSERVERS["vt"])
    assert len({look.paper for look in own.values()}) == 3


# -- what cannot be drawn, and files --------------------------------------------------------------------------------


def test_each_figure_that_is_not_drawn_says_why(tmp_path: Path) -> None:
    rest = {"theta_enc": np.zeros(N), "theta_vt": np.zeros(N), "i_a": np.zeros(N), "hall": np.ones(N)}
    codes = np.array([1], np.uint8)
    still = drawn(make(tmp_path / "rest.run", rest, (np.array([5]), codes, codes + 2)))
    assert all(each.figure is None for each in still.values())
    for name in ("spectrum", "error_by_angle", "error_by_speed"):
        assert "never turns" in still[name].why
    assert still["current_plane"].why.startswith("no i_d, i_q in A")
    assert "at rest" in still["hall_edges"].why
    plain = drawn(make(tmp_path / "plain.run", {"i_d": np.ones(N), "i_q": np.ones(N)}))
    assert plain["current_plane"].figure is not None
    assert "encoder" in plain["error_by_angle"].why
    assert "needs an encoder's angle, or a speed" in plain["spectrum"].why
    encoder = drawn(make(tmp_path / "encoder.run", {"theta_enc": turning(np.full(N, 500.0))}))
    assert "ESTIMATE" in encoder["error_by_speed"].why
    assert "no Hall edges" in encoder["hall_edges"].why


def test_an_angle_that_turns_too_far_between_samples_is_not_believed(tmp_path: Path) -> None:
    rpm = np.full(N, 4000.0)
    columns = {"theta_enc": turning(rpm), "omega_enc": rpm * RPM * N_P * 100, "theta_vt": turning(rpm)}
    found = drawn(make(tmp_path / "a.run", columns))
    assert "ambiguous" in found["error_by_angle"].why


@pytest.mark.long("all plots of a recording")
def test_files_json_and_the_table(tmp_path: Path) -> None:
    result = plot(DATA / "steady.run", "-o", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert "current_plane   –" in result.output
    assert "no i_d in A" in result.output
    names = set(NAMES) - {"current_plane"}
    assert {file.name for file in (tmp_path / "out").iterdir()} == {f"{name}.png" for name in names}
    for name in names:
        height, width, _ = matplotlib.image.imread(tmp_path / "out" / f"{name}.png").shape
        assert width == 1432
        assert height > 500
    again = plot(DATA / "steady.run", "-o", tmp_path / "out")
    assert isinstance(again.exception, BenchError)
    assert "--overwrite" in str(again.exception)
    result = plot(DATA / "steady.run", "-o", tmp_path / "out", "--overwrite", "--svg", "--json=-")
    said = json.loads(result.stdout)
    assert (said["from_s"], said["to_s"]) == (0.12, 1.4199375)
    told = {each["figure"]: each for each in said["figures"]}
    assert told["current_plane"]["file"] is None
    assert "i_d" in told["current_plane"]["why_not"]
    assert told["spectrum"]["numbers"]["phases"]["i_a"]["thd_percent"] < 1
    assert "<svg" in (tmp_path / "out" / "spectrum.svg").read_text()


def test_none_that_can_be_drawn_is_an_error(tmp_path: Path) -> None:
    path = make(tmp_path / "a.run", {"u_dc": np.ones(N)})
    result = plot(path, "-o", tmp_path / "out")
    assert isinstance(result.exception, BenchError)
    assert "no plot of" in str(result.exception)
    assert "spectrum: no phase current" in str(result.exception)
    assert not (tmp_path / "out").exists()


@pytest.mark.long("all plots of a recording")
def test_damage_is_told_and_the_rest_is_drawn_and_compared(tmp_path: Path) -> None:
    path, kept = tmp_path / "a.run", DATA / "steady.run"
    shutil.copytree(kept, path)
    flip(path / "edges-000001.parquet", 100)
    for command in (["plot", path, "-o", tmp_path / "out"], ["compare", path, kept, "--save", tmp_path / "a.rrd"]):
        result = CliRunner().invoke(cli, list(map(str, command)))
        assert result.exit_code == 0, result.output
        assert "edges-000001.parquet is damaged" in result.stderr
    assert (tmp_path / "out" / "spectrum.png").exists()
    assert not (tmp_path / "out" / "hall_edges.png").exists()
