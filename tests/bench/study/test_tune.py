"""`bench tune`: it finds what is known to be best, no trip wins, and an interruption changes no trial."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result
from scipy import stats

import bench
from bench.cli import cli
from bench.errors import BenchError
from bench.study.objectives import LOST, Objective, Parameter
from bench.study.search import Search, Trial, front, middle
from bench.study.tune_file import Found, read_tune
from sim.ports.direct import Course, Driven, nominal, with_values

DATA, DOCS = (Path(__file__).parents[k] / name for k, name in ((2, "data"), (3, "docs")))
K_P, I_TRIP = "firmware.vector_tracking.k_p_vt", "firmware.protection.i_trip"
KEYS = Parameter("a", "log", (1.0, 10_000.0), False, 10.0), Parameter("b", "range", (-1.0, 1.0), False, 0.9)
BEST = MappingProxyType({"a": 300.0, "b": -0.2})
ONE = (Objective("cost", "cost", "mean", "minimise", ""),)
TWO = (*ONE, Objective("other", "other", "mean", "maximise", ""))


def bowl(trials: Sequence[Mapping[str, float]]) -> list[Found]:
    """Least at `BEST`; with a > 5000 nothing can be measured."""
    found = []
    for one in trials:
        cost = math.log10(one["a"] / BEST["a"]) ** 2 + (one["b"] - BEST["b"]) ** 2
        found.append(Found((math.nan,), 4, "no such drive") if one["a"] > 5000.0 else Found((cost,), 0))
    return found


def along(trials: Sequence[Mapping[str, float]]) -> list[Found]:
    """cost = x^2 + b^2, other = -(x - 1)^2 - b^2 with x = log10 a / 4: the front is b = 0, from x = 0 to 1."""
    at = [(math.log10(one["a"]) / 4.0, one["b"]) for one in trials]
    return [Found((x * x + b * b, -((x - 1.0) ** 2) - b * b), 0) for x, b in at]


def search(file: Path, objectives: Sequence[Objective] = ONE, batch: int = 4) -> Search:
    return Search(file, KEYS, objectives, 1, batch)


def test_one_objective_is_brought_near_its_least(tmp_path: Path) -> None:
    looking = search(tmp_path / "log")
    assert len(list(looking.run(80, bowl, 0))) == 80
    (best,) = front(looking.trials, ONE)
    assert best.objectives[0] < 0.01  # of random trials the best of 80 is 0.02 on average
    assert best.values["a"] == pytest.approx(BEST["a"], rel=0.3)
    assert all(trial.why == "no such drive" for trial in looking.trials if trial.values["a"] > 5000.0)


def test_several_objectives_spread_over_the_front(tmp_path: Path) -> None:
    looking = search(tmp_path / "log", TWO, 20)
    list(looking.run(200, along, 0))
    points = front(looking.trials, TWO)
    x = np.array([math.log10(one.values["a"]) / 4.0 for one in points])
    assert len(points) > 8
    assert x.min() < 0.2
    assert x.max() > 0.8
    assert np.mean([abs(one.values["b"]) for one in points]) < 0.15  # random ones: 0.5
    costs = np.array([one.objectives for one in points])
    assert (np.diff(costs[:, 0]) > 0.0).all()
    assert (np.diff(costs[:, 1]) > 0.0).all()  # more of both: one is paid for by the other


@pytest.mark.parametrize(("objectives", "measure", "batch"), [(ONE, bowl, 4), (TWO, along, 8)])
@pytest.mark.parametrize("at", [0, 7, 16, 29])
def test_an_interruption_changes_no_trial(
    tmp_path: Path, objectives: Sequence[Objective], measure: Any, batch: int, at: int
) -> None:
    whole, part = (search(tmp_path / name, objectives, batch) for name in ("whole", "part"))
    list(whole.run(40, measure, 0))
    left = at

    def stopped(trials: Sequence[Mapping[str, float]]) -> list[Found]:
        nonlocal left
        left -= len(trials)
        if left < 0:
            raise KeyboardInterrupt
        found: list[Found] = measure(trials)
        return found

    with pytest.raises(KeyboardInterrupt):
        list(part.run(40, stopped, 0))
    with (tmp_path / "part").open("ab") as file:  # the power went while a line was written
        file.write(b'{"op_code": 4, "study_id"')
    again = search(tmp_path / "part", objectives, batch)
    assert len(again.trials) == at - at % batch
    list(again.run(40, measure, 0))
    assert repr(again.trials) == repr(whole.trials)  # NaN is not equal to itself


def test_more_trials_go_on_where_there_were_fewer(tmp_path: Path) -> None:
    list(search(tmp_path / "log").run(10, bowl, 0))
    looking = search(tmp_path / "log")
    list(looking.run(21, bowl, 0))
    assert [one.number for one in looking.trials] == list(range(21))


def test_what_trips_more_often_than_before_is_out(tmp_path: Path) -> None:
    """However good its figure is."""
    looking = search(tmp_path / "log")
    list(looking.run(12, lambda trials: [Found((one["b"],), 3 if one["b"] < 0.0 else 2) for one in trials], 2))
    (best,) = front(looking.trials, ONE)
    assert best.objectives[0] >= 0.0
    assert {one.why for one in looking.trials} == {"", "3 rows tripped or could not be, 2 as it was"}


def test_of_a_front_the_middle_is_nearest_to_the_best_of_all() -> None:
    trials = [Trial(k, {}, of, 0, "") for k, of in enumerate([(0.0, 0.0), (10.0, 9.0), (100.0, 10.0), (50.0, 2.0)])]
    points = front([*trials, Trial(4, {}, (-5.0, 99.0), 1, "tripped")], TWO)
    assert [one.number for one in points] == [0, 1, 2]
    assert middle(points, TWO).number == 1


# -- objectives -----------------------------------------------------------------------------------------------------

VALUES = np.random.default_rng(3).normal(-1.0, 2.0, (40, 2))


@pytest.mark.parametrize(
    ("over", "sense", "wanted"),
    [
        ("mean", "minimise", VALUES.mean()),
        ("rms", "minimise", math.sqrt((VALUES**2).mean())),
        ("max", "minimise", np.abs(VALUES).max()),
        ("max", "maximise", VALUES.min()),
        ("p95", "minimise", np.percentile(np.abs(VALUES), 95)),
        ("p95", "maximise", np.percentile(VALUES, 5)),
    ],
)
def test_drives_are_summed_up(over: str, sense: str, wanted: float) -> None:
    assert Objective("x", "x", over, sense, "deg").of_drives(VALUES) == pytest.approx(wanted, rel=1e-12)


def test_a_drive_that_tripped_counts_as_lost_and_never_as_good() -> None:
    lacking = VALUES.copy()
    lacking[3] = np.nan
    worse = np.where(np.isnan(lacking), LOST, lacking)
    for over in ("mean", "rms", "max", "p95", "p99"):
        one = Objective("x", "x", over, "minimise", "deg")
        assert one.of_drives(lacking) == one.of_drives(worse) > one.of_drives(VALUES)
        assert math.isnan(Objective("x", "x", over, "minimise", "r/min").of_drives(lacking))
    passed = np.array([[1.0, 1.0], [1.0, 0.0], [1.0, np.nan], [1.0, 1.0]])
    assert Objective("x", "x", "yield", "maximise", "").of_drives(passed) == 0.5


def test_a_difference_has_the_interval_of_paired_drives() -> None:
    before = VALUES[:, :1]
    after = before + np.random.default_rng(4).normal(-0.5, 0.3, before.shape)
    wanted = stats.ttest_1samp((after - before)[:, 0], 0.0).confidence_interval(0.95)
    found = Objective("x", "x", "mean", "minimise", "deg").difference(before, after)
    assert found.value == pytest.approx((after - before).mean())
    assert (found.lo, found.hi) == pytest.approx((wanted.low, wanted.high), abs=0.01)
    largest = Objective("x", "x", "max", "minimise", "deg").difference(before, after)
    assert math.isnan(largest.lo)
    assert math.isnan(Objective("x", "x", "p95", "minimise", "deg").difference(before, after).lo)  # 2 drives beyond
    assert Objective("x", "x", "rms", "minimise", "deg").difference(before, before) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(("over", "true", "n"), [("rms", 0.5, 20), ("p50", 0.6744898 / 2, 20), ("mean", 0.0, 20)])
def test_intervals_hold_what_is_true(over: str, true: float, n: int) -> None:
    """Errors of half the size, before: normal, sd 1."""
    rng, held = np.random.default_rng(5), 0
    for _ in range(100):
        after = rng.normal(0.0, 1.0, (n, 1))
        found = Objective("x", "x", over, "minimise", "deg").difference(
            after, after / 2.0 + rng.normal(0, 1e-3, (n, 1))
        )
        held += found.lo <= -true <= found.hi
    assert held >= 87  # of 95: 3 standard deviations fewer, and what resampling lacks


def test_a_parameter_at_an_end_of_its_range_is_told() -> None:
    log, linear = KEYS
    assert [log.at_end(x) for x in (1.0, 1.1, 1.3, 100.0, 9000.0)] == [True, True, False, False, True]
    assert [linear.at_end(x) for x in (-1.0, -0.9, 0.97)] == [True, False, True]


# -- the file -------------------------------------------------------------------------------------------------------

TOML = f"""
samples = 4
[vary]
"motor.psi_f" = {{ normal = [1.0, 0.05], relative = true }}
[experiments.turn]
speed = 900
load = 0.1
seconds = 0.2
settle = 0.1
observers = ["vector_tracking"]
limits = {{ "vector_tracking.rms" = {{ hi = 20.0 }} }}
[tune]
trials = 6
batch = 3
check = 8
[tune.parameters]
"{K_P}" = {{ log = [300, 5000] }}
"firmware.protection.i_trip" = {{ choice = [0.5, 12.0] }}
[tune.objectives]
noise = {{ of = "turn.vector_tracking.rms", over = "rms" }}
"""


def written(folder: Path, *changes: tuple[str, str]) -> Path:
    text = TOML
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    file = folder / "gains.toml"
    file.write_text(text)
    return file


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (K_P, "motor.psi_f", "motor.psi_f in .* is varied from drive to drive: it cannot be tuned as well"),
        ("trials = 6", "trails = 6", r"unknown key tune.trails in .*: did you mean trials\?"),
        ("trials = 6", "trials = 0", "tune.trials in .* must be at least 1, got 0"),
        ("trials = 6", "trials = 'many'", "tune.trials in .* cannot be 'many'"),
        ("[tune", "[designs", r"has no \[tune\]: it is a study"),
        ("samples = 4", "samples = 4\n[designs.a]", "designs cannot be tuned"),
        ("k_p_vt\"", "k_p\"", "the configuration has no firmware.vector_tracking.k_p: did you mean"),
        (f'"{K_P}"', '"hall.delta_deg"', "is a list: name one number of it, hall.delta_deg_1 to hall.delta_deg_6"),
        ("log = [300, 5000]", "log = [5000, 300]", r"log must be \[lowest, highest\], got \[5000, 300\]"),
        ("log = [300, 5000]", "log = [0, 5000]", "log needs numbers above 0"),
        ("log = [300, 5000]", "log = [300]", r"log must be \[lowest, highest\]"),
        ("log = [300, 5000]", "lgo = [300, 5000]", r"must be one of \{ range = \[lowest, highest\] \}"),
        ("log = [300, 5000]", "range = ['a', 1]", "range must be"),
        ("i_trip\" = { choice = [0.5, 12.0]", "i_trip\" = { choice = []", "choice must be a list of values"),
        ("protection.i_trip\" = { choice = [0.5, 12.0]", "n_p\" = { range = [4.5, 6]", "n_p is a whole number"),
        ("turn.vector_tracking.rms\"", "turn.vector_tracking.rsm\"", "nothing measures turn.vector_tracking.rsm: did"),
        ("over = \"rms\"", "over = \"p96\"", "over is 'p96': did you mean p9"),
        ("over = \"rms\"", "sense = \"less\"", "sense is 'less': there are minimise, maximise"),
        ("over = \"rms\"", "how = 1", "has an unknown 'how'"),
        ("over = \"rms\"", "over = \"yield\"", "nothing measures turn.vector_tracking.rms: .*turn"),
        ("[tune.objectives]\nnoise", "[tune.parameters.x]\nnoise", "x|has no objective"),
        ("batch = 3", "recordings = ['a.run']", "with tune.recordings there is no experiments"),
    ],
)  # fmt: skip
def test_what_cannot_be_tuned_is_refused_by_name(tmp_path: Path, old: str, new: str, words: str) -> None:
    with pytest.raises(BenchError, match=words):
        read_tune(written(tmp_path, (old, new)))


def test_the_page_and_the_shipped_example_can_be_read(tmp_path: Path) -> None:
    page = (DOCS / "tune.md").read_text()
    (tmp_path / "gains.toml").write_text(page.partition("```toml\n")[2].partition("```")[0])
    for file in (tmp_path / "gains.toml", DOCS / "studies" / "vector-tracking.toml"):
        plan = read_tune(file)
        assert plan.parameters
        assert plan.study is not None


def tuned(*arguments: object) -> Result:
    return CliRunner().invoke(cli, ["tune", *map(str, arguments)])


def trials_in(folder: Path) -> list[dict[str, str]]:
    with (folder / "trials.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tuned")
    result = tuned(written(folder), "--workers", 1)
    assert result.exit_code == 0, result.output
    return folder


def test_a_trial_is_what_its_drives_do(done: Path) -> None:
    """Each drive by itself, with the trial's parameters, and the figure of all by numpy."""
    plan = read_tune(done / "gains.toml")
    trial = next(one for one in trials_in(done / "gains.tune") if not one["why"])
    rms = []
    for row in range(4):
        study = plan.study
        assert study
        figures = nominal(None, {key: float(trial[key]) for key in (K_P, I_TRIP)})
        params = with_values(figures, {"motor.psi_f": float(study.inputs([row])[0][0])})
        driven = Driven(params, study.noise(row), Course((900.0,), 0.1, 0.2, 0.1, "", ("vector_tracking",)))
        rms.append(driven.measure()["vector_tracking.rms"])
    assert float(trial["noise"]) == pytest.approx(math.sqrt(np.mean(np.square(rms))), rel=1e-12)


def test_what_trips_does_not_win(done: Path) -> None:
    trials = trials_in(done / "gains.tune")
    tripped = [one for one in trials if one[I_TRIP] == "0.5"]
    assert tripped
    assert all(one["why"] and int(one["lacking"]) == 4 for one in tripped)
    found = json.loads((done / "gains.tune" / "tune.json").read_text())
    assert found["points"][0]["parameters"][I_TRIP] == 12.0
    assert found["out"] == len(tripped)


def test_what_was_found_is_checked_on_other_drives_and_loads_as_a_configuration(done: Path) -> None:
    folder = done / "gains.tune"
    found = json.loads((folder / "tune.json").read_text())
    (point,) = found["points"]
    checked = point["on_other_drives"]["noise"]
    assert checked["as_it_was"] not in (found["objectives"]["noise"]["as_it_was"], None)
    assert checked["from"] <= checked["difference"] <= checked["to"]
    for file in ("best.toml", "best-drive.toml"):
        gains = nominal(folder / file, {})["firmware"]["vector_tracking"]
        assert gains["k_p_vt"] == point["parameters"][K_P]
    assert (folder / "tune.png").read_bytes().startswith(b"\x89PNG")


def test_the_same_command_goes_on_and_another_tune_is_refused(done: Path, tmp_path: Path) -> None:
    first = trials_in(done / "gains.tune")
    result = tuned(written(tmp_path), "--workers", 1, "--out", done / "gains.tune", "--trials", 7)
    assert result.exit_code == 0, result.output
    assert "6 trials of 7 there already" in result.stderr
    assert trials_in(done / "gains.tune")[:6] == first
    other = tuned(written(tmp_path, ("5000", "6000")), "--workers", 1, "--out", done / "gains.tune")
    assert "holds trials of another tune (parameters differ): choose another name" in str(other.exception)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").write_text("")
    assert "is there and holds no tune" in str(tuned(written(tmp_path), "--out", tmp_path / "full").exception)


def test_without_optuna_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "optuna", None)
    result = tuned(written(tmp_path), "--workers", 1)
    assert str(result.exception) == "bench tune needs Optuna: pip install 'hallbench[study]'"
    assert not (tmp_path / "gains.tune").exists()


def test_recordings_are_tuned_by_what_the_scoreboard_says(tmp_path: Path) -> None:
    file = tmp_path / "recorded.toml"
    file.write_text(f"""
[tune]
trials = 3
recordings = ["{DATA / "steady.run"}"]
check = ["{DATA / "reversal.run"}"]
[tune.parameters]
"{K_P}" = {{ log = [300, 5000] }}
[tune.objectives]
"vector_tracking.rms" = "minimise"
""")
    result = tuned(file)
    assert result.exit_code == 0, result.output
    best = min(trials_in(tmp_path / "recorded.tune"), key=lambda one: float(one["vector_tracking.rms"]))
    board = bench.score(DATA / "steady.run", observers=["vector_tracking"], k_p_vt=float(best[K_P]))
    assert float(best["vector_tracking.rms"]) == board.pooled["vector_tracking"]["moving"]["rms"]
    assert nominal(tmp_path / "recorded.tune" / "best.toml", {})["firmware"]["vector_tracking"]["k_p_vt"] == float(
        best[K_P]
    )
    file.write_text(file.read_text().replace("k_p_vt", "k_p_speed").replace("vector_tracking.k_p", "speed_loop.k_p"))
    assert "no observer that is looked at takes k_p_speed" in str(tuned(file, "--overwrite").exception)
