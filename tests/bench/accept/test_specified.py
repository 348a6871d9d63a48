"""`--spec` and `--learn-limits`: bands by published factors, what a band may be, and what a spec says of a run."""

from __future__ import annotations

import json
import math
import statistics
import tomllib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from accepting import Accepting
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st
from page import Page

from bench.accept.accept import AcceptOptions, closing_lines
from bench.accept.learning import RESOLUTION, learn, learned, summary, tolerance_factor
from bench.accept.results import Measurement, RunResult, TestResult, Verdict, run_from_json, to_json
from bench.accept.spec import Band, Spec, read_spec, write_spec
from bench.cli import cli
from bench.errors import BenchError
from bench.rig.quality import ParameterValue
from bench.signal.limits import RATED_CURRENT, YES_NO, Limits
from docs.make_spec import run_of

KIND = {"n_p": 6.0, "R_s_hat": 0.158, "psi_f_hat": 6.55e-3, "k_p": 2.0}
RATED = {RATED_CURRENT: "8 A"}
TORQUE = Limits("torque", "%", -12.0, 12.0, tells="torque per ampere")
TESTS = """
@limit("inside", "deg", lo=0, hi=10)
@limit("strange", "deg", lo=0, hi=10, tells="the angle")
@limit("bad", "deg", lo=0, hi=1)
@limit("free", "A")
@limit("new", "A")
@yes("answer")
def test_it(drive, measure):
    for name, value in {"inside": 5.0, "strange": 8.0, "bad": 8.0, "free": 2.0, "new": 1.0, "answer": 1}.items():
        measure(name, value)
"""
BANDS = """
drive = "simulated drive"
runs = ["one", "two"]
rated = ["rated speed of 3000 r/min", "rated current of 8 A"]
[parameters]
n_p = 6
k_p_vt = 1268.0
[measurements]
"it.inside" = { unit = "deg", lo = 4.0, hi = 6.0 }
"it.strange" = { unit = "deg", lo = 4.0, hi = 6.0 }
"it.bad" = { unit = "deg", lo = 0.4, hi = 0.6 }
"it.free" = { unit = "A", lo = 0.0, hi = 1.0 }
"it.answer" = { unit = "yes/no", n = 2, mean = 1, sd = 0, min = 1, max = 1 }
"other.one" = { unit = "A", hi = 1.0 }
"""


def a_run(values: dict[str, float], number: int = 1, limits: Limits = TORQUE, **more) -> RunResult:
    found = tuple(Measurement(f"t.{name}", replace(limits, name=name), Verdict.PASS, v) for name, v in values.items())
    parameters = tuple(ParameterValue(name, value, value, "") for name, value in more.pop("kind", KIND).items())
    verdict = more.pop("verdict", Verdict.PASS)
    test = TestResult("t", "", "", "t", verdict, measurements=found)
    identity = {"name": "BLDC-24", "serial": "17", "firmware": "foc 1"} | more.pop("identity", {})
    more = {"rig": RATED} | more
    return RunResult(f"2026-03-01T10:{number:06}", "sim", verdict, (test,), identity, parameters, **more)


def of(values: Sequence[float], limits: Limits = TORQUE, spec: Spec | None = None, first: int = 1) -> Spec:
    runs = [(a_run({"torque": v}, n, limits), str(n)) for n, v in enumerate(values, first)]
    return learned(runs, spec or Spec(Path("kind.toml")))


# -- the statistics -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("n", "inside", "confidence", "factor"), [
    (43, 0.90, 0.99, 2.217),  # NIST/SEMATECH e-Handbook, 7.2.6.3
    # M. Natrella, Experimental Statistics, NBS Handbook 91 (1963), table A-6: exact
    (5, 0.95, 0.95, 5.079), (10, 0.95, 0.95, 3.379), (20, 0.95, 0.95, 2.752), (50, 0.95, 0.95, 2.379),
    (10, 0.99, 0.95, 4.433), (20, 0.99, 0.95, 3.615),
])  # fmt: skip
def test_tolerance_factors_are_the_published_ones(n: int, inside: float, confidence: float, factor: float) -> None:
    assert tolerance_factor(n, 1.0 - inside, confidence) == pytest.approx(factor, rel=0.006)


@pytest.mark.parametrize("n", [3, 5, 20])
def test_so_many_of_a_normal_population_are_inside_as_was_asked_for(n: int) -> None:
    draws = np.random.default_rng(n).normal(size=(20_000, n))
    half = tolerance_factor(n, 0.01) * draws.std(axis=1, ddof=1)
    mean = draws.mean(axis=1)
    erf = np.vectorize(math.erf)
    inside = (erf((mean + half) / math.sqrt(2)) - erf((mean - half) / math.sqrt(2))) / 2
    assert np.mean(inside >= 0.99) == pytest.approx(0.95, abs=0.01)


VALUES = st.lists(st.floats(-11.9, 11.9), min_size=2, max_size=12)


@given(VALUES, st.integers(1, 11))
def test_a_band_holds_what_good_drives_measured_within_the_limits_however_the_runs_came(values, cut) -> None:
    band = of(values).measurements["t.torque"]
    assert (band.n, band.unit) == (len(values), "%")
    scale = max(statistics.stdev(values), 1e-9 * max(map(abs, values)), 1e-9)
    assert band.mean == pytest.approx(statistics.fmean(values), abs=2e-3 * scale + 1e-9)
    assert band.sd == pytest.approx(statistics.stdev(values), rel=1e-4, abs=1e-8)
    floor = max(RESOLUTION["%"], 1e-3 * max(map(abs, values)))
    least, most = min(values) - floor, max(values) + floor
    assert -12.0 <= band.lo <= max(least, -12.0) + 1e-9
    assert min(most, 12.0) - 1e-9 <= band.hi <= 12.0
    two = of(values[cut:], spec=of(values[:cut]), first=cut + 1) if cut < len(values) else of(values)
    again = two.measurements["t.torque"]
    assert (again.n, again.lo, again.hi) == (
        band.n,
        *(pytest.approx(v, rel=1e-2, abs=1e-2) for v in (band.lo, band.hi)),
    )


def test_more_runs_of_the_same_make_it_narrower_and_a_drive_that_is_off_makes_it_wider() -> None:
    few = of([0.1, -0.2, 0.3, 0.0])
    more = of([0.1, -0.2, 0.3, 0.0] * 4, spec=few, first=5)
    wider = of([2.0], spec=more, first=50)
    widths = [spec.measurements["t.torque"].resolution for spec in (few, more, wider)]
    assert widths[0] > 2 * widths[1] < widths[2]
    assert "from 4 runs, 1 of 1 measurements have a band: mean ± 10.7" in summary(few, a_run({"torque": 0.0}))[0]
    assert "torque per ampere" in summary(few, a_run({"torque": 0.0}))[1]


def test_what_has_no_band_an_answer_one_run_and_what_is_a_matter_of_chance() -> None:
    for limits, values in (
        (Limits("", YES_NO), [1.0] * 9),
        (TORQUE, [1.0]),
        (replace(TORQUE, chance=True), [1.0, 2.0]),
    ):
        band = of(values, limits).measurements["t.torque"]
        assert (band.n, band.lo, band.hi) == (len(values), None, None)
    assert "one run tells no scatter" in summary(of([1.0]), a_run({"torque": 1.0}))[0]


@pytest.mark.parametrize(("limits", "value", "floor"), [
    (Limits("", "A"), 0.0, 0.02), (Limits("", "%"), 0.0, 0.05), (Limits("", "%"), 200.0, 0.2),
    (Limits("", "1/s"), 1e3, 1.0),
])  # fmt: skip
def test_no_scatter_makes_no_band_narrower_than_the_bench_can_read(limits: Limits, value: float, floor: float) -> None:
    runs = [(a_run({"torque": value}, n, limits, kind=KIND | {"i_range": 20.0}), "") for n in range(5)]
    assert learned(runs, Spec(Path("x"))).measurements["t.torque"].resolution == pytest.approx(floor, rel=1e-3)


# -- the file -------------------------------------------------------------------------------------------------------


def test_a_file_says_what_was_written_and_a_band_by_hand_stays(tmp_path: Path) -> None:
    spec = replace(of([0.1, 0.2, 0.4]), path=tmp_path / "kind.toml")
    odd = {'a"b[1].x': Band("mV·s", lo=-1.0, hi=1.0), "t.torque": spec.measurements["t.torque"]}
    spec = replace(spec, measurements=odd)
    write_spec(spec)
    back = read_spec(str(spec.path))
    assert back == spec
    by_hand = replace(back, measurements={"t.torque": Band("%", lo=-1.0, hi=1.0)})
    assert of([0.3], spec=by_hand, first=9).measurements == by_hand.measurements
    head = tomllib.loads(spec.path.read_text())
    assert (head["drive"], len(head["runs"]), head["firmware"]) == ("BLDC-24", 3, ["foc 1"])


WRONG = [
    ("drive = 3", "drive in .* must be text, got 3"),
    ("runs = [3]", "runs in .* must be a list of texts"),
    ("motr = ''", "unknown key motr in .*: did you mean motor"),
    ("", r"has no \[measurements\]: it is no spec"),
    ("[measurements]\n'a.b' = 3", "a.b in .* must look like"),
    ("[measurements]\n'a.b' = { lo = 1 }", "a.b in .* must look like"),
    ("[measurements]\n'a.b' = { unit = '' }", "a.b in .* has neither lo nor hi"),
    ("[measurements]\n'a.b' = { unit = '', n = 3, lo = 1 }", "lacks mean, sd, min, max"),
    ("[measurements]\n'a.b' = { unit = '', lo = nan }", "lo of a.b in .* must be a finite number, got nan"),
    ("[measurements]\n'a.b' = { unit = '', lo = true }", "lo of a.b in .* must be a finite number"),
    ("[measurements]\n'a.b' = { unit = '', lo = 2, hi = 1 }", "the lower limit 2 is above the upper one, 1"),
    ("[measurements]\n'a.b' = { unit = '', low = 2 }", "unknown key low: did you mean lo"),
    ("[measurements]\n'a.b' = { unit = '', n = 1.5, mean = 0, sd = 0, min = 0, max = 0 }", "n must be a count"),
    ("[parameters]\nn_p = 'six'\n[measurements]\n'a.b' = { unit = '', lo = 2 }", "n_p in .* must be a finite number"),
    ("x = [", "cannot read .*kind.toml: Invalid value"),
    (f"x = {'[' * 100_000}", "nested too deeply"),
]


@pytest.mark.parametrize(("text", "says"), WRONG, ids=lambda text: text[-60:])
def test_what_is_wrong_in_a_file_is_one_line(text: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "kind.toml").write_text(text)
    with pytest.raises(BenchError, match=says) as refused:
        read_spec(str(tmp_path / "kind.toml"))
    assert ("\n" in str(refused.value), refused.value.exit_code) == (False, 2)


VALUE = st.one_of(st.floats(), st.integers(), st.just(10**400), st.booleans(), st.text(max_size=3), st.none())


@given(st.dictionaries(st.sampled_from(["unit", "n", "mean", "sd", "min", "max", "lo", "hi", "x"]), VALUE), VALUE)
def test_a_band_by_hand_is_refused_or_can_be_used(tmp_path_factory, keys: dict, k_p) -> None:
    def words(value: object) -> str:
        return json.dumps(value) if not isinstance(value, float) else repr(value)  # as TOML: nan, inf, "text", true

    file = tmp_path_factory.getbasetemp() / "drawn.toml"
    pairs = ", ".join(f"{key} = {words(value)}" for key, value in keys.items())
    file.write_text(f"[parameters]\nk_p = {words(k_p)}\n[measurements]\n'a.b' = {{ {pairs} }}\n")
    try:
        spec = read_spec(str(file))
    except BenchError:
        return
    band = spec.band("a.b")
    more = {"t.torque": replace(spec.measurements["a.b"], unit="%")}
    write_spec(of([0.1, 1e300], spec=replace(spec, measurements=more, parameters={})))
    assert read_spec(str(file)).measurements["t.torque"].n == (more["t.torque"].n + 1 if more["t.torque"].n else 0)
    assert band is None or all(side is None or math.isfinite(side) for side in (band.lo, band.hi))


def test_runs_that_teach_nothing_are_refused(tmp_path: Path) -> None:
    spec, good = of([0.1, 0.2]), a_run({"torque": 0.1}, 7)
    refused = {
        "ended with FAIL, and limits are learned from good runs only$": replace(good, verdict=Verdict.FAIL),
        "INCOMPLETE.*--allow-skipped": replace(good, verdict=Verdict.INCOMPLETE),
        "the run of 2026-03-01T10:000001 17 is in kind.toml already": a_run({"torque": 0.1}),
        "of another motor: its n_p is 6, and that of later 7": a_run({}, 7, kind=KIND | {"n_p": 7.0}),
        "its psi_f_hat is 0.00655, and that of later 0.01": a_run({}, 7, kind=KIND | {"psi_f_hat": 0.01}),
        "is for a rated current of 8 A, and later has a rated current of 5 A: give": a_run(
            {}, 7, rig=RATED | {RATED_CURRENT: "5 A"}
        ),
        "of a drive 'VESC', and kind.toml is of 'BLDC-24'": a_run({}, 7, identity={"name": "VESC"}),
        "t.torque is in 'A', and kind.toml has it in '%'": a_run({"torque": 1.0}, 7, Limits("", "A")),
    }
    for says, run in refused.items():
        with pytest.raises(BenchError, match=says):
            learned([(run, "later")], spec)
    file = tmp_path / "kind.toml"
    for text, says in (
        ("{", "has no results of"),
        ('{"tests": 3}', "has no results of"),
        (None, "cannot read results"),
    ):
        result = tmp_path / "result.json"
        result.unlink(missing_ok=True)
        if text is not None:
            result.write_text(text)
        with pytest.raises(BenchError, match=says):
            learn(AcceptOptions(), None, file, 1, [result], False)  # type: ignore[arg-type]
    assert not file.exists()


def test_a_parameter_that_is_not_the_same_in_all_runs_is_not_specified() -> None:
    runs = [(a_run({"torque": 0.1}, n, kind=KIND | {"offset": float(n)}), "") for n in (1, 2)]
    spec = learned(runs, Spec(Path("x")))
    assert spec.parameters == KIND
    assert spec.unlike({"k_p": 1.8, "R_s_hat": 0.158000007, "offset": 3.0}) == ["parameter k_p is 1.8, specified 2"]


# -- a run that is judged by one ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_what_is_within_limits_and_not_as_specified_fails_and_says_so_everywhere(accepting: Accepting) -> None:
    Path("kind.toml").write_text(BANDS)
    options = {"json": Path("a.json"), "report": Path("out"), "junit": Path("j.xml")}
    run = accepting(TESTS.replace("hi=1)", "hi=9)"), spec="kind.toml", **options)
    assert (run.code, run.result.verdict) == (1, Verdict.FAIL)
    failed = {name: (m.failed, m.why) for name, m in run.measured.items() if m.verdict is Verdict.FAIL}
    assert failed == {f"it.{name}": ("specified", "not as specified") for name in ("strange", "bad", "free")}
    written = {m["name"]: m for test in json.loads(Path("a.json").read_text())["tests"] for m in test["measurements"]}
    assert (written["it.strange"]["failed"], written["it.inside"]["failed"]) == ("specified", "")
    assert (written["it.strange"]["specified"]["hi"], written["it.strange"]["margin"]) == (6.0, -2.0)
    assert written["it.new"]["specified"] is None
    assert run_from_json(to_json(run.result)) == run.result
    text = "8 deg [0 … 10 deg; specified 4 … 6 deg] FAIL (not as specified)"
    assert any(f"it.strange = {text}" in note for note in run.screen.notes)
    assert text in Path("j.xml").read_text()
    lines = closing_lines(run.result)[1:]
    assert lines == [
        "as specified by kind.toml (simulated drive, from 2 runs): 3 measurements within limits and not as specified",
        "1 measured and not in it: it.new",
        "1 in it and not measured: other.one",
        "cannot be told here, if it is off by less: the angle 1 deg",
    ]
    page = Page(Path("out/report.html"))
    assert "The drive is within its limits, but not as specified by kind.toml." in page.text
    assert "0 … 10 deg specified 4 … 6 deg" in page.row("strange", "Strange strange")
    assert page.subject["the angle"] == "1 deg"


@pytest.mark.slow
def test_limits_count_before_the_spec_a_persons_limits_and_the_spec_both_and_without_it_nothing_changes(accepting):
    Path("kind.toml").write_text(BANDS)
    with_it, without = (accepting(TESTS, **more) for more in ({"spec": "kind.toml"}, {}))
    assert (with_it.measured["it.bad"].failed, with_it.measured["it.bad"].why) == ("limits", "")
    assert {n: m.verdict for n, m in without.measured.items() if m.verdict is not Verdict.PASS} == {"it.bad": "FAIL"}
    assert (without.result.spec, without.measured["it.strange"].margin) == (None, 2.0)
    Path("bench.toml").write_text("[limits]\n'it.inside' = { hi = 4.5 }\n'it.strange' = { hi = 99 }")
    own = accepting(TESTS, spec="kind.toml").measured
    assert [own[f"it.{name}"].failed for name in ("inside", "strange")] == ["limits", "specified"]


@pytest.mark.slow
@pytest.mark.parametrize(("old", "new", "says"), [
    ("n_p = 6", "n_p = 7", r"^kind.toml is of another motor: its n_p is 7, and that of sim 6$"),
    ("it.strange", "it.strnge", r"spec kind.toml names 'it.strnge', which no test measures: did you mean it.strange\?"),
    ('"it.free" = { unit = "A"', '"it.free" = { unit = "mA"', r"it.free is in 'A', and the file has it in 'mA'"),
])  # fmt: skip
def test_a_spec_that_does_not_fit_is_refused_before_anything_runs(old, new, says, accepting: Accepting) -> None:
    Path("kind.toml").write_text(BANDS.replace(old, new))
    with pytest.raises(BenchError, match=says):
        accepting(TESTS, spec="kind.toml")
    assert not any("it." in note for note in accepting.screen.notes)
    Path("kind.toml").write_text(BANDS)
    Path("bench.toml").write_text("[rated]\ncurrent = 5.0\n")
    with pytest.raises(
        BenchError, match="rated current of 8 A, and sim has a rated speed of 3000 r/min and a rated current of 5 A"
    ):
        accepting(TESTS, spec="kind.toml")
    with pytest.raises(BenchError, match=r"no spec 'smi': did you mean sim\?"):
        read_spec("smi")


@pytest.mark.slow
def test_a_parameter_that_is_not_as_specified_fails_a_run_in_which_all_else_is(accepting: Accepting) -> None:
    Path("kind.toml").write_text(BANDS)
    Path("other.toml").write_text("[firmware.vector_tracking]\nk_p_vt = 1141.2\n")
    text = '@limit("inside", "deg", hi=9)\ndef test_it(drive, measure): measure("inside", 5)\n'
    bands = "\n".join(line for line in BANDS.splitlines() if "it." not in line or "inside" in line)
    Path("kind.toml").write_text(bands)
    assert accepting(text, spec="kind.toml").code == 0
    run = accepting(text, spec="kind.toml", config=Path("other.toml"))
    assert (run.tests, run.code) == ({"it": "PASS"}, 1)
    assert "not as specified: parameter k_p_vt is 1141.2, specified 1268" in closing_lines(run.result)


@pytest.mark.long("five runs of a test")
def test_runs_of_the_simulated_drive_have_seeds_of_their_own_and_results_that_were_kept_teach_the_same(
    tmp_path,
) -> None:
    def bench(*words: str) -> str:
        ran = CliRunner().invoke(cli, ["accept", "sim", "-k", "current_offsets", *words], catch_exceptions=False)
        assert ran.exit_code == 0, ran.output
        return ran.output

    with pytest.MonkeyPatch.context() as patched:
        patched.chdir(tmp_path)
        assert "live.toml: from 2 runs" in bench("--learn-limits", "live.toml", "--runs", "2")
        live = read_spec("live.toml")
        assert live.measurements["current_offsets.noise"].sd > 0.0
        for seed in (1, 2):
            bench("--seed", str(seed), "--json", f"{seed}.json")
        kept = [word for seed in (1, 2) for word in ("--results", f"{seed}.json")]
        ran = CliRunner().invoke(cli, ["accept", "--learn-limits", "kept.toml", *kept], catch_exceptions=False)
        assert ran.output.startswith("kept.toml: from 2 runs, 6 of 6 measurements have a band: mean ± "), ran.output
        for name, band in read_spec("kept.toml").measurements.items():
            assert [band.lo, band.hi] == pytest.approx(
                [live.measurements[name].lo, live.measurements[name].hi], rel=5e-3
            )
        assert "as specified by kept.toml (simulated drive, from 2 runs): all measurements" in bench(
            "--spec", "kept.toml"
        )


@pytest.mark.parametrize(("words", "says"), [
    (["--runs", "2"], "are for --learn-limits"),
    (["--learn-limits", "a", "--spec", "sim"], "neither --spec nor --list"),
    (["--learn-limits", "a", "--results", "x", "--runs", "2"], "--results runs nothing"),
    (["--learn-limits", "a", "--runs", "2", "--json", "x"], "each run would replace"),
    (["--learn-limits", __file__, "--results", __file__], "is also an input"),
])  # fmt: skip
def test_options_that_exclude_one_another_are_refused(words: list[str], says: str) -> None:
    ran = CliRunner().invoke(cli, ["accept", *words])
    assert says in str(ran.output) + str(ran.exception)
    assert ran.exit_code


# -- the shipped one ------------------------------------------------------------------------------------------------


@pytest.mark.long("the whole suite")
def test_the_simulated_drive_is_as_its_spec_says_and_every_measurement_is_in_it(suite_run: Path) -> None:
    run, spec = run_from_json(json.loads((suite_run / "a.json").read_text())), read_spec("sim")
    assert [m.name for m in run.measurements if not spec.allows(m)] == []
    use = spec.use(run)
    again = "make it anew: python docs/make_spec.py"
    assert (use.without, use.unused, use.unlike) == ((), (), ()), again
    for m in run.measurements:
        band = spec.measurements[m.name]
        assert m.limits.chance or m.limits.unit == YES_NO or band.resolution is not None, m.name
        assert all(side is None or m.limits.allow(side) for side in (band.lo, band.hi)), m.name
    told = {what for what, _, _ in use.resolution}
    assert told >= {
        "torque per ampere",
        "flux linkage",
        "current gain",
        "offset of a current",
        "Hall edge against encoder",
    }


@pytest.mark.campaign("spec")
@pytest.mark.parametrize("number", range(1001, 1201))
def test_no_good_drive_of_the_kind_is_refused(number: int, tmp_path: Path) -> None:
    run, spec = run_of(number, tmp_path), read_spec("sim")
    assert ([m.name for m in run.measurements if not spec.allows(m)], run.verdict) == ([], Verdict.PASS)
