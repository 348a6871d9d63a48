"""`bench score` on recordings: made up ones whose errors are known, and one of the simulated drive."""

from __future__ import annotations

import csv
import json
import math
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from recorded import N_P, PWM_HZ, record_made_up

from bench.cli import cli
from bench.errors import BenchError
from bench.files import leaves
from bench.record.reader import Run
from bench.record.sink import RunSink
from bench.score import expect
from bench.score.board import Scoreboard, flat, score
from bench.score.plots import draw_error_by_angle, draw_error_by_speed, draw_error_over_time
from bench.score.report import as_html
from bench.score.table import HEADERS, as_text, legend
from bench.signal.chunks import part
from protocol.streams import Gap
from sim.observers.catalogue import CATALOGUE

pytestmark = pytest.mark.slow

TO_RPM = 60 / (2 * math.pi) / N_P
DELAY = 50e-6


def bench_command(*arguments: object) -> Result:
    return CliRunner().invoke(cli, ["score", *map(str, arguments)])


def motion(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Electrical angle and speed: half a second at 300 r/min, at 600, at 300 again, by ramps of 0.1 s."""
    knots = np.array([0.0, 0.5, 0.6, 1.1, 1.2, 1.7])
    omega = np.interp(t, knots, np.array([300, 300, 600, 600, 300, 300]) / TO_RPM)
    fine = np.arange(-0.1, 1.8, 1e-5)
    steps = np.interp(fine, knots, np.array([300, 300, 600, 600, 300, 300]) / TO_RPM) * 1e-5
    return np.interp(t, fine, np.cumsum(steps) - 0.5 * steps), omega


@pytest.fixture(scope="module")
def made_up(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Estimates that are exact, 2 deg behind, 50 us late, and a sawtooth of 60 deg."""
    path = tmp_path_factory.mktemp("made_up") / "made_up.run"
    t = np.arange(round(1.7 * PWM_HZ)) / PWM_HZ
    theta, omega = motion(t)
    late, late_speed = motion(t - DELAY)
    sector = np.floor(theta / (math.pi / 3)) * math.pi / 3 + math.pi / 6
    estimates = {
        "exact": (theta, omega),
        "biased": (theta - math.radians(2.0), omega - 3.0 / TO_RPM),
        "late": (late, late_speed),
        "sector": (sector, omega),
    }
    record_made_up(path, theta, estimates)
    return path


def another(path: Path, ahead: dict[str, float]) -> None:
    """Record a second of the motion, with estimates that are ahead by constant angles in rad."""
    theta, omega = motion(np.arange(PWM_HZ) / PWM_HZ)
    record_made_up(path, theta, {name: (theta + by, omega) for name, by in ahead.items()})


@pytest.fixture(scope="module")
def made_up_board(made_up: Path) -> Scoreboard:
    return score([made_up])


@pytest.fixture(scope="module")
def drive_board(drive_run: Path) -> Scoreboard:
    return score([drive_run])


def test_the_best_stands_first(made_up_board: Scoreboard) -> None:
    assert list(made_up_board.pooled) == ["drive_exact", "drive_late", "drive_biased", "drive_sector"]
    assert [figures["rank"] for figures in made_up_board.pooled.values()] == [1, 2, 3, 4]
    assert made_up_board.notes == [f"{made_up_board.tracks[0].path}: no observer can run on it: it has no channel hall"]
    words = legend(made_up_board)
    assert as_text(made_up_board)[-len(words) - 1 :] == [f"note: {made_up_board.notes[-1]}", *words]


def test_known_errors_are_told(made_up_board: Scoreboard) -> None:
    exact, late, biased, sector = made_up_board.pooled.values()
    for phase in ("moving", "error", "transient"):
        assert exact[phase]["max"] < 1e-3
        assert biased[phase]["bias"] == pytest.approx(2.0, abs=1e-3)
        assert biased[phase]["std"] < 1e-3
        assert sector[phase]["std"] == pytest.approx(30 / math.sqrt(3), rel=0.02)
        assert sector[phase]["max"] == pytest.approx(30, abs=1.5)
        assert sector[phase]["p99"] == pytest.approx(29.7, abs=0.6)
        assert abs(sector[phase]["bias"]) < 0.6
    assert biased["speed"]["bias"] == pytest.approx(3.0, abs=0.1)
    assert biased["speed"]["std"] < 0.2
    for figures in (exact, late, biased, sector):
        assert (figures["start_up"]["events"], figures["start_up"]["n"]) == (0, 0)
        assert (figures["reversal"]["events"], figures["reversal"]["std"]) == (0, None)
    slow, fast = (late["by_speed"][bin]["bias"] for bin in ("150_to_350", "350_to_750"))
    assert slow == pytest.approx(math.degrees(300 / TO_RPM * DELAY), abs=2e-3)
    assert fast == pytest.approx(math.degrees(600 / TO_RPM * DELAY), abs=2e-3)
    lags = [figures["lag"]["angle_us"] for figures in (late, exact, biased)]
    assert (lags, exact["lag"]["speed_us"]) == (pytest.approx([50.0, 0.0, 0.0], abs=0.5), pytest.approx(0.0, abs=1.0))


@pytest.mark.parametrize("ring", [0.0, math.radians(30.0), -3.0])
def test_errors_by_sector_stand_in_their_sector(tmp_path: Path, ring: float) -> None:
    t = np.arange(PWM_HZ) / PWM_HZ
    theta = 200.0 * t
    third = (np.mod(theta - ring, 2 * np.pi) // (np.pi / 3)) == 2
    estimates = {"x": (theta + np.radians(5.0) * third, np.full(len(t), 200.0))}
    record_made_up(tmp_path / "a.run", theta, estimates, **({"hall_offset": ring} if ring else {}))
    by_sector = score([tmp_path / "a.run"]).pooled["drive_x"]["by_sector"]
    biases = [by_sector[str(k)]["bias"] for k in range(1, 7)]
    assert biases == pytest.approx([0, 0, -5, 0, 0, 0], abs=0.05)
    assert sum(figures["n"] for figures in by_sector.values()) == len(t)


def test_observers_run_again_score_as_the_drives_own(drive_board: Scoreboard) -> None:
    assert set(drive_board.pooled) == set(CATALOGUE) | {f"drive_{short}" for short in ("avg", "vt")}
    for name, short in (("average_speed", "avg"), ("vector_tracking", "vt")):
        host, drive = drive_board.pooled[name], drive_board.pooled[f"drive_{short}"]
        assert host["start_up"]["events"] == 1
        assert host["reversal"]["events"] >= 1
        for group in ("moving", "error", "transient", "start_up", "reversal"):
            for key in ("std", "max"):
                assert host[group][key] == pytest.approx(drive[group][key], abs=0.006), (name, group)  # a raw count
        assert drive["step_ns"] is None
    assert drive_board.pooled["vector_tracking"]["step_ns"] > 1.0


def test_a_recording_and_its_copy_have_the_same_figures_of_twice_as_many_samples(
    made_up: Path, made_up_board: Scoreboard, tmp_path: Path
) -> None:
    shutil.copytree(made_up, tmp_path / "copy.run")
    twice = dict(leaves(score([made_up, tmp_path / "copy.run"]).pooled))
    for name, value in leaves(made_up_board.pooled):
        same = pytest.approx(value, rel=1e-3, abs=1e-6) if isinstance(value, float) else value
        assert twice[name] == (2 * value if name.endswith((".n", ".recordings")) else same), name


def test_recordings_are_pooled_by_samples(made_up: Path, tmp_path: Path) -> None:
    another(tmp_path / "b.run", {"exact": math.radians(1.0)})
    board = score([made_up, tmp_path / "b.run"], ["drive_exact"])
    first, second = (board.by_file[str(path)]["drive_exact"]["moving"] for path in (made_up, tmp_path / "b.run"))
    pooled = board.pooled["drive_exact"]["moving"]
    assert (second["bias"], pooled["n"]) == (pytest.approx(-1.0, abs=1e-3), first["n"] + second["n"])
    assert pooled["bias"] == pytest.approx(-second["n"] / pooled["n"], abs=1e-3)
    text = "\n".join(as_text(board))
    assert text.startswith("2 recordings pooled\n")
    assert str(made_up) in text


def test_who_is_in_some_recordings_only_stands_last(made_up: Path, tmp_path: Path) -> None:
    another(tmp_path / "b.run", {"late": 0.1, "other": 0.2})
    board = score([made_up, tmp_path / "b.run"])
    assert list(board.pooled) == ["drive_late", "drive_exact", "drive_biased", "drive_other", "drive_sector"]
    assert [figures["rank"] for figures in board.pooled.values()] == [1, 2, 3, 4, 5]
    assert [figures["recordings"] for figures in board.as_json()["observers"].values()] == [2, 1, 1, 1, 1]
    assert "drive_exact is only in 1 of 2 recordings: ranked after those that are in all" in board.notes
    assert not any(note.startswith("drive_late") for note in board.notes)
    lines = as_text(board)
    assert [line.split("  ")[0] for line in lines[2:4]] == ["drive_late", "drive_exact (1 of 2)"]
    assert max(map(len, lines[:7])) <= 100


def test_mixed_rates_are_noted(made_up: Path, tmp_path: Path) -> None:
    run = Run(made_up)
    few = part(run.samples, 0, len(run.samples))
    every = slice(0, None, 2)
    config = replace(few.config, decimation=2)
    sink = RunSink(tmp_path / "half.run", run.info, wait=True)
    sink.take(replace(few, config=config, index=few.index[every], tick=few.tick[every], raw=few.raw[every]))
    sink.close()
    board = score([made_up, tmp_path / "half.run"], ["drive_biased"])
    assert board.notes[0].startswith("recorded at 8000, 16000 samples/s: pooled by sample")
    assert board.pooled["drive_biased"]["moving"]["bias"] == pytest.approx(2.0, abs=1e-3)
    assert not any("samples/s" in note for note in score([made_up], ["drive_biased"]).notes)


@pytest.mark.parametrize(
    ("speed", "omega_told", "refused"),
    [(1800.0, True, True), (1500.0, True, False), (1800.0, False, True), (1500.0, False, False)],
)
def test_an_angle_that_turns_too_far_between_samples_is_refused(speed, omega_told, refused, tmp_path) -> None:
    path = tmp_path / "a.run"
    t = np.arange(0.0, 4.0, 1 / 500)  # half a turn is 500 pi = 1571 rad/s
    theta = speed * t
    record_made_up(path, theta, {"x": (theta, np.full(len(t), speed))}, decimation=32, omega_told=omega_told)
    if refused:
        with pytest.raises(
            BenchError, match=r"at 500 samples/s, an electrical speed of 1800 rad/s is half a revolution"
        ):
            score([path])
    else:
        assert score([path]).pooled["drive_x"]["moving"]["n"] > 1900


def test_nothing_to_score_is_an_error_with_the_reasons(made_up: Path, tmp_path: Path) -> None:
    with pytest.raises(BenchError, match=r"nothing to score: .*made_up\.run: no observer can run on it: it has no"):
        score([made_up], ["vector_tracking"])
    t = np.arange(PWM_HZ // 2) / PWM_HZ
    for name, seconds, words in (
        ("still", 0.5, "than 10 r/min"),
        ("short", 0.05, "800 samples in stretches too short to score"),
    ):
        theta = 0.1 * t[: round(seconds * PWM_HZ)]
        record_made_up(tmp_path / f"{name}.run", theta, {"x": (theta, theta)})
        with pytest.raises(BenchError, match=f"nothing to score: .*{words}"):
            score([tmp_path / f"{name}.run"])


def test_a_recording_that_ends_early_is_told(made_up: Path, tmp_path: Path) -> None:
    shutil.copytree(made_up, tmp_path / "cut.run")
    log = tmp_path / "cut.run" / "run.jsonl"
    log.write_bytes(log.read_bytes()[:-20])
    board = score([made_up, tmp_path / "cut.run"], ["drive_exact"])
    assert [("the recording ends early" in " ".join(track.notes)) for track in board.tracks] == [False, True]


def test_a_gap_parts_the_recording_and_what_is_too_short_is_counted(made_up: Path, tmp_path: Path) -> None:
    run = Run(made_up)
    sink = RunSink(tmp_path / "gaps.run", run.info, wait=True)
    n, held = len(run.samples), [(0, 6000), (6100, 6600), (6640, len(run.samples))]  # 500 samples are 31 ms
    for (first, last), lost in zip(held, (0, 100, 40), strict=True):
        gaps = (Gap(0, lost, 4, False),) if lost else ()
        sink.take(replace(part(run.samples, first, last), gaps=gaps))
    sink.close()
    board = score([tmp_path / "gaps.run"])
    (track,) = board.tracks
    assert ((track.lost, track.dropped), [stretch.n for stretch in track.stretches]) == ((140, 500), [6000, n - 6640])
    assert any("140 samples lost" in note for note in board.notes)
    assert any("500 samples in stretches too short to score" in note for note in board.notes)
    late = board.pooled["drive_late"]
    assert (late["moving"]["n"], late["lag"]["angle_us"]) == (6000 + n - 6640, pytest.approx(50.0, abs=0.5))
    assert late["lag"]["speed_us"] == pytest.approx(50.0, abs=1.0)


def test_without_an_encoder_it_says_so(tmp_path: Path) -> None:
    t = np.arange(2000) / PWM_HZ
    record_made_up(tmp_path / "a.run", 100 * t, {"x": (100 * t, t)}, reference=False)
    with pytest.raises(BenchError, match="it needs an encoder"):
        score([tmp_path / "a.run"])


def test_names_that_are_nowhere_are_errors(made_up: Path) -> None:
    with pytest.raises(
        BenchError, match=r"no observer 'nobody'; available: average_speed \(avg\), .* drive_… .* short name"
    ):
        score([made_up], ["nobody"])
    with pytest.raises(BenchError, match=r"no recording has the estimate 'drive_vt'.*; there are drive_exact"):
        score([made_up], ["drive_vt"])
    with pytest.raises(BenchError, match=r"estimate 'drive_exac' \(did you mean drive_exact\?\)"):
        score([made_up], ["drive-exac"])
    assert list(score([made_up], ["drive-exact"]).pooled) == ["drive_exact"]


def test_the_table_fits_100_columns(drive_board: Scoreboard) -> None:
    lines = as_text(drive_board)
    assert max(map(len, lines)) <= 100
    table = lines[: 1 + len(drive_board.pooled)]
    assert (len({len(line) for line in table}), table[0].split()) == (1, list(HEADERS))
    longest = {"hall_vector_decoupled": next(iter(drive_board.pooled.values()))}
    assert max(map(len, as_text(Scoreboard(drive_board.tracks, longest, {"": longest})))) <= 100


def test_the_command_writes_all_its_files(drive_run: Path, tmp_path: Path) -> None:
    files = {kind: tmp_path / f"score.{kind}" for kind in ("html", "json", "csv")}
    done = bench_command(
        drive_run, "--observer", "vt", *(x for kind, path in files.items() for x in (f"--{kind}", path))
    )
    assert done.exit_code == 0, done.output
    data = json.loads(files["json"].read_text())
    figures = data["observers"]["vector_tracking"]
    assert data["files"][0]["observers"]["vector_tracking"] == figures
    with files["csv"].open() as file:
        found = {(r["file"], r["observer"], r["figure"]): r["value"] for r in csv.DictReader(file)}
    numbers = {name: value for name, value in flat(figures) if value is not None}
    assert len(numbers) > 60
    for name, value in numbers.items():
        assert float(found["", "vector_tracking", name]) == value
    page = files["html"].read_text()
    assert page.count("data:image/png;base64,") == 3
    assert not re.search(r"(?:src|href)=[\"'](?!data:|#)", page)
    assert f"{figures['moving']['rms']:.3f}" in page


def test_bounds_that_were_written_hold_and_others_do_not(drive_run: Path, tmp_path: Path) -> None:
    bounds = tmp_path / "bounds.toml"
    done = bench_command(drive_run, "--observer", "drive_vt", "--write-expect", bounds, "--margin", "10%")
    assert done.exit_code == 0, done.output
    read = expect.read(bounds)
    std = score([drive_run], ["drive_vt"]).pooled["drive_vt"]["error"]["std"]
    assert read["drive_vt.error.std"] == pytest.approx((0.9 * std, 1.1 * std), rel=1e-4)
    lo, hi = read["drive_vt.error.bias"]
    assert hi - lo >= 0.2 * std * 0.999
    assert not any(name.endswith((".n", ".events", "step_ns")) for name in read)
    held = bench_command(drive_run, "--observer", "drive_vt", "--expect", bounds)
    assert held.exit_code == 0, held.output
    assert f"{len(read)} of {len(read)} statistics within" in held.output
    for side in ([0, 0.99 * std], [1.01 * std, 9]):  # a known error that vanishes is news too
        bounds.write_text(f"drive_vt.error.std = {side}\ndrive_vt.moving.max = [0, inf]\n")
        outside = bench_command(drive_run, "--observer", "drive_vt", "--expect", bounds)
        assert outside.exit_code == 1
        assert f"OUTSIDE  drive_vt.error.std is {std:.6g}, expected {side[0]:.6g} … {side[1]:.6g}" in outside.output
        assert "1 of 2 statistics within" in outside.output


@pytest.mark.parametrize(("name", "text", "words"), [
    ("a.toml", "x.y = 3", "x.y must be [lo, hi] with lo <= hi, got 3"),
    ("a.toml", "x.y = [2, 1]", "got [2, 1]"),
    ("a.toml", "x.y = [true, 1]", "got [True, 1]"),
    ("a.toml", "x.y = [nan, 1]", "got [nan, 1]"),
    ("a.toml", "x.y = [1, 2", "a.toml: "),
    ("a.toml", "", "has no limits"),
    ("a.json", "[1, 2]", "must be a table"),
    ("a.json", '{"x": {"y": ["1", 2]}}', "x.y must be [lo, hi]"),
])  # fmt: skip
def test_bad_bounds_are_errors(name: str, text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(BenchError) as raised:
        expect.read(path)
    assert words in str(raised.value)
    assert "\n" not in str(raised.value)


def test_no_output_takes_the_place_of_what_is_kept(made_up: Path, tmp_path: Path) -> None:
    bounds, old = tmp_path / "bounds.toml", "drive_exact.moving.rms = [0, 1]\n"
    bounds.write_text(old)
    recording = (made_up / "run.jsonl").read_bytes()
    for arguments, words in (
        (("--json", made_up), f"--json would write to a file named {made_up}"),
        (("--expect", bounds, "--write-expect", bounds, "--overwrite"), f"--write-expect {bounds} is also an input"),
        (("--expect", bounds, "--csv", bounds), f"--csv {bounds} is also an input"),
        (("--json", tmp_path / "a", "--csv", tmp_path / "a"), "--json and --csv name the same file"),
        (("--write-expect", bounds), f"--write-expect {bounds} exists: choose another name, or --overwrite"),
    ):
        done = bench_command(made_up, *arguments)
        assert done.exit_code == 2 or isinstance(done.exception, BenchError), arguments
        assert words in " ".join(f"{done.output} {done.exception}".split()), arguments
        assert ((made_up / "run.jsonl").read_bytes() == recording, bounds.read_text()) == (True, old)
    done = bench_command(made_up, "--write-expect", bounds, "--overwrite")
    assert done.exit_code == 0, done.output
    assert "drive_sector" in bounds.read_text()


@pytest.mark.parametrize(
    ("margin", "good"), [("100%", False), ("1", False), ("20", False), ("0", False), ("99%", True)]
)
def test_a_margin_is_less_than_the_figure(margin: str, good: bool, made_up: Path, tmp_path: Path) -> None:
    done = bench_command(made_up, "--write-expect", tmp_path / "b.toml", "--margin", margin)
    assert (done.exit_code, (tmp_path / "b.toml").exists()) == ((0, True) if good else (2, False))


def test_bounds_on_what_is_not_scored_name_it(made_up: Path) -> None:
    board = score([made_up], ["drive_exact", "drive_late"])
    with pytest.raises(BenchError, match=r"limits for drive_biased, which is not scored; scored: "):
        expect.check(board, {"drive_biased.error.std": (0.0, 1.0)})
    with pytest.raises(BenchError, match=r"no statistic 'drive_late\.errr\.std' in .*\(did you mean drive_late\.error"):
        expect.check(board, {"drive_late.errr.std": (0.0, 1.0)})


@pytest.mark.long("draws five figures")
def test_the_page_has_a_trace_of_each_recording_and_leaves_out_what_is_not_known(made_up: Path, tmp_path: Path) -> None:
    another(tmp_path / "b.run", {"late": 0.1})
    text = as_html(score([made_up, tmp_path / "b.run"], ["drive_late", "drive_exact"]))
    sections = dict(re.findall(r'<section class="test" id="(\w+)">(.*?)</section>', text, re.DOTALL))
    assert {name: section.count("data:image") for name, section in sections.items()} == {
        "drive_late": 3, "drive_exact": 2,
    }  # fmt: skip
    assert [name in sections["drive_exact"] for name in ("made_up.run", "b.run")] == [True, False]
    assert "in 1 of 2 recordings" in sections["drive_exact"]
    assert set(re.findall(r'<a href="#(\w+)">', text)) == set(sections)
    assert re.search(r"b\.run: .*20\S+ \S+ UTC\+00:00; 16000 samples, 1\.0 s at 16000 Hz; 0 lost, 0 not scored", text)
    assert "a step takes" not in text
    one = as_html(score([made_up], ["drive_late"]))
    assert re.search(r"The angle lags by (49\.\d|50(\.\d)?) µs; the speed lags by (49|50)(\.\d)? µs\.<", one)


def test_the_axis_covers_motion_and_the_peak_is_told(tmp_path: Path) -> None:
    t = np.arange(PWM_HZ) / PWM_HZ
    theta = 200.0 * t
    error = np.radians(np.where((t > 0.5) & (t < 0.5004), 70.0, 2.0))
    record_made_up(tmp_path / "a.run", theta, {"x": (theta - error, np.full(len(t), 200.0))})
    (track,) = score([tmp_path / "a.run"]).tracks
    axes = draw_error_over_time(track, "drive_x").axes[1]
    assert axes.get_ylim() == pytest.approx((-2.3, 2.3), abs=0.01)
    assert [text.get_text() for text in axes.texts] == ["peak 70.0° at 0.50 s"]


def test_errors_at_one_speed_are_bars_and_at_more_are_lines(made_up_board: Scoreboard) -> None:
    lines = draw_error_by_speed(made_up_board.pooled).axes[0].lines
    assert len({(line.get_color(), line.get_marker()) for line in lines}) == len(lines) == 4
    bin = "350_to_750"
    one = {name: {"by_speed": {bin: figures["by_speed"][bin]}} for name, figures in made_up_board.pooled.items()}
    std, _ = draw_error_by_speed(one).axes
    assert [bar.get_width() for bar in std.patches] == [f["by_speed"][bin]["std"] for f in one.values()]
    assert [label.get_text() for label in std.get_yticklabels()] == list(one)


def test_figures_show_what_was_scored(made_up_board: Scoreboard) -> None:
    (track,) = made_up_board.tracks
    speed, error = draw_error_over_time(track, "drive_biased").axes
    assert [line.get_ydata().max() for line in speed.lines] == pytest.approx([600] * len(speed.lines), abs=5)
    assert np.ptp(error.lines[0].get_ydata()) < 0.01
    (ax,) = draw_error_by_angle(made_up_board.tracks, "drive_sector").axes
    mean = next(line for line in ax.lines if line.get_label() == "mean")
    x, y = mean.get_xdata(), mean.get_ydata()
    assert y == pytest.approx(np.mod(x, 60.0) - 30.0, abs=1.6)
