"""The report says everything that a run found, in one file, as text; figures look the same every time."""

from __future__ import annotations

import base64
import hashlib
import math
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from page import Page

from bench.accept.report import ReportError, words, write_report
from bench.accept.results import Figure, Measurement, RunResult, TestResult, Verdict
from bench.accept.results import tightest as closest
from bench.errors import BenchError
from bench.report import style
from bench.rig.quality import ParameterValue, Quality
from bench.signal.limits import Limits

EVIL = "<script>alert('&\"')</script>"


def measurement(
    name: str, value: float | None, verdict: Verdict, lo: float | None = None, hi: float | None = None, **more
) -> Measurement:
    limits = Limits(name.split(".")[1], "A", lo, hi, more.pop("about", ""), more.pop("overridden", False))
    return Measurement(name, limits, verdict, value, **more)


def a_test(name: str, verdict: Verdict = Verdict.PASS, *found: Measurement, **more) -> TestResult:
    return TestResult(name, f"title of {name}", "", f"tests/x.py::{name}", verdict, measurements=found, **more)


def a_run(*tests: TestResult, verdict: Verdict = Verdict.PASS, **more) -> RunResult:
    return RunResult("2011-01-01T12:00:00+00:00", "sim://", verdict, tests, **more)


def written(run: RunResult, tmp_path: Path) -> Page:
    return Page(write_report(run, tmp_path))


def test_every_measurement_is_there_with_value_limits_margin_and_verdict(tmp_path: Path) -> None:
    grid = [measurement(f"test_map.at_{k}", 0.01 * k, Verdict.PASS, hi=0.9) for k in range(80)]
    grid += [measurement("test_map.too_high", 0.95, Verdict.FAIL, hi=0.9)]
    few = [
        measurement("test_few.nan", math.nan, Verdict.INVALID, -2.5, 2.5, why="a gap"),
        measurement("test_few.none", None, Verdict.ERROR, lo=1.0),
        measurement("test_few.free", -3.25, Verdict.PASS, overridden=True, about="to know it"),
    ]
    run = a_run(a_test("test_map", Verdict.FAIL, *grid), a_test("test_few", Verdict.ERROR, *few), verdict=Verdict.FAIL)
    page = written(run, tmp_path)
    for k in range(80):
        value, margin = 0.01 * k, 0.9 - 0.01 * k
        expected = f"At {k} at_{k} ≤ 0.9 A {value:.3f} A +{margin:.3f} ({100 * margin / 0.9:.0f} %) PASS"
        assert page.row(f"at_{k} ", "PASS") == expected
    assert "Too high too_high ≤ 0.9 A 0.950 A −0.050 (−6 %) FAIL" in page.rows
    assert "Nan nan a gap −2.5 … 2.5 A NaN A – INVALID" in page.rows
    assert "None none ≥ 1 A – – ERROR" in page.rows
    assert page.row("Free free") == "Free free to know it for information from bench.toml −3.25 A – –"
    assert "80 more: all passed" in page.text
    assert "84 measurements: 80 PASS" in page.text
    assert "1 for information" in page.text


def test_what_was_not_tested_comes_first_and_what_failed_leads_to_its_test_and_recording(tmp_path: Path) -> None:
    bad = measurement("test_b.peak", 9.0, Verdict.FAIL, hi=8.0, why="at the step", span=(1.25, 1.5))
    run = a_run(
        a_test("test_a"),
        a_test("test_b", Verdict.FAIL, bad, recording="recordings/test b.run"),
        a_test("test_c", Verdict.ERROR, why="no heartbeat for 1 s"),
        a_test("test_d", Verdict.SKIPPED, why="no encoder"),
        verdict=Verdict.FAIL,
        error="the link was lost",
    )
    page = written(run, tmp_path)
    first = ["What was not tested", "What could not be judged", "Subject", "What failed", "Signatures", "Overview"]
    assert page.headings[:7] == [*first, "Tests"]
    assert page.row("at the step", "1.250 … 1.500 s") == (
        "Test b: Peak test_b.peak at the step in recordings/test b.run at t = 1.250 … 1.500 s "
        "≤ 8 A 9.00 A −1.00 (−12 %) FAIL"
    )
    assert page.rows[:2] == ["Why, and which tests Measurements Verdict", "no encoder Test d SKIPPED"]
    assert page.row("Test c", "no heartbeat for 1 s") == "Test c test_c no heartbeat for 1 s ERROR"
    links = ["#test-4", "#test-3", "#test-2", "recordings/test%20b.run", "#test-1"]  # the overview's last
    assert page.links[:5] == links
    assert {link[1:] for link in page.links if link.startswith("#")} <= page.ids
    assert "the link was lost" in page.text
    assert "no encoder" in page.text


def test_the_overview_has_a_row_for_each_test_with_its_tightest_margin(tmp_path: Path) -> None:
    wide = measurement("test_a.wide", 1.0, Verdict.PASS, 0, 2)
    tight = measurement("test_a.tight", 1.9, Verdict.PASS, 0, 2)
    none = measurement("test_b.none", None, Verdict.ERROR, 0, 2)
    page = written(a_run(a_test("test_a", Verdict.PASS, wide, tight), a_test("test_b", Verdict.ERROR, none)), tmp_path)
    assert page.rows[3:5] == [
        "PASS Test a test_a title of test_a 2 +0.100 (5 %) Tight [A]",
        "ERROR Test b test_b title of test_b 0 of 1",
    ]


PASSED, FAILED = Verdict.PASS, Verdict.FAIL


@pytest.mark.parametrize(("tightest", "others"), [
    (measurement("t.x", 9.0, PASSED, 0, 10), [measurement("t.y", 1.5, PASSED, 0, 2)]),  # 10 % against 25 %
    (measurement("t.x", 0.5, PASSED, hi=1), [measurement("t.y", 1.0, PASSED, 1, 1)]),  # a yes
    (measurement("t.x", 0.0, FAILED, 1, 1), [measurement("t.y", 2.5, FAILED, 0, 2)]),  # not a yes
    (measurement("t.x", math.nan, FAILED, 0, 2), [measurement("t.y", 1.0, PASSED, 0, 2)]),
    (measurement("t.x", 1.0, PASSED, 0, 2), [measurement("t.y", 9.0, Verdict.INVALID, 0, 2)]),
    (None, [measurement("t.y", 0.0, PASSED, hi=0), measurement("t.z", None, Verdict.ERROR, 0, 2)]),
    (None, [measurement("t.y", 3.0, PASSED)]),
])  # fmt: skip
def test_the_tightest_margin(tightest: Measurement | None, others: list[Measurement]) -> None:
    for found in ([tightest, *others], [*others, tightest]):
        assert closest(m for m in found if m) is tightest


def test_a_test_that_made_no_measurement_is_one_row(tmp_path: Path) -> None:
    unmade = [measurement(f"test_a.m{k}", None, Verdict.ABORTED, hi=1.0, why="the run was ended") for k in range(28)]
    some = [
        measurement("test_b.made", 0.5, Verdict.PASS, hi=1.0),
        measurement("test_b.not", None, Verdict.ERROR, hi=1.0),
    ]
    tests = a_test("test_a", Verdict.ABORTED, *unmade, why="the run was ended"), a_test("test_b", Verdict.ERROR, *some)
    page = written(a_run(*tests, verdict=Verdict.ERROR), tmp_path)
    assert page.rows[:4] == [
        "Why, and which tests Measurements Verdict",
        "the run was ended Test a 28 ABORTED",
        "What and why Limits Value Margin Verdict",
        "Test b: Not test_b.not ≤ 1 A – – ERROR",
    ]
    assert page.text.count("28 measurements, none made") == 1
    assert all(f"M{k}: ≤ 1 A" in page.text for k in range(28))
    assert page.tags.count("details") == 1


def test_a_run_that_never_began_has_a_report(tmp_path: Path) -> None:
    page = written(a_run(verdict=Verdict.ERROR, error="nothing answers on /dev/ttyACM0"), tmp_path)
    assert "nothing answers on /dev/ttyACM0" in page.text
    assert "No test was run." in page.text


def test_markup_in_what_others_say_is_text(tmp_path: Path) -> None:
    (tmp_path / "f.png").write_bytes(b"png")
    found = measurement(f"t.{EVIL}", 1.0, Verdict.FAIL, hi=0.5, why=EVIL, about=EVIL)
    test = TestResult(
        EVIL, EVIL, EVIL, EVIL, Verdict.FAIL, EVIL, (found,), (Figure("f.png", EVIL),), EVIL, log=EVIL,
        quality=Quality(1, remarks=(EVIL,)), parameters={EVIL: 1.0},
    )  # fmt: skip
    run = a_run(
        test,
        verdict=Verdict.FAIL,
        identity={EVIL: EVIL, "name": EVIL},
        parameters=(ParameterValue(EVIL, 1.0, 2.0, EVIL, EVIL),),
        rig={EVIL: EVIL},
        versions={EVIL: EVIL},
        error=EVIL,
    )
    page = written(run, tmp_path)
    assert "script" not in page.tags
    assert page.text.count(EVIL) >= 20
    assert not any(link.startswith("javascript:") for link in page.links)


def test_figures_are_in_the_file_and_nothing_is_fetched(tmp_path: Path) -> None:
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "a.png").write_bytes(b"any bytes")
    run = a_run(a_test("test_a", figures=(Figure("figures/a.png", "what it shows"),), recording="a.run"))
    page = written(run, tmp_path)
    (source,) = page.sources
    kind, _, data = source.partition(",")
    assert (kind, base64.b64decode(data)) == ("data:image/png;base64", b"any bytes")
    assert "what it shows" in page.text
    assert {"link", "script", "iframe"}.isdisjoint(page.tags)
    assert not any("//" in link for link in page.links)
    style_sheet = (tmp_path / "report.html").read_text("utf-8").partition("<style>")[2].partition("</style>")[0]
    assert "@media print" in style_sheet
    assert "url(" not in style_sheet
    assert "@import" not in style_sheet


def test_a_figure_or_a_directory_that_is_missing_is_named(tmp_path: Path) -> None:
    run = a_run(a_test("test_a", figures=(Figure("figures/a.png", ""),)))
    with pytest.raises(ReportError, match=r"^figure .*figures/a\.png of test test_a cannot be read: No such file"):
        write_report(run, tmp_path)
    assert not (tmp_path / "report.html").exists()
    with pytest.raises(BenchError, match=r"report .*none/report\.html cannot be written: No such file"):
        write_report(a_run(), tmp_path / "none")


def test_parameters_that_differ_from_their_defaults_come_first(tmp_path: Path) -> None:
    parameters = (
        ParameterValue("R_s", 0.158, 0.158, "ohm"),
        ParameterValue("k_p", 1268.0, 1000.0, "rad/s", "gain"),
    )
    page = written(
        a_run(a_test("test_a", parameters={"k_p": 500.0, "observer": 10.0}), parameters=parameters), tmp_path
    )
    assert "observer = 10 (edge-kalman)" in " ".join(page.text.split())
    assert page.row("gain") == "k_p 1268 rad/s 1000 rad/s changed gain"
    assert page.row("R_s") == "R_s 0.158 ohm 0.158 ohm"
    assert page.text.index("1268") < page.text.index("0.158")
    assert "k_p = 500 rad/s" in page.text
    assert "What it is" in page.text
    assert "What it is" not in written(a_run(parameters=parameters[:1]), tmp_path).text


@pytest.mark.parametrize(("key", "value", "text"), [
    ("pwm_hz", "16000", "PWM 16000 Hz"),
    ("tick_hz", 20_000_000, "tick 20 MHz"),
    ("tick_hz", "84000001", "tick 84.000001 MHz"),
    ("boot_id", "0000ffe5", "boot ID 0000ffe5"),
    ("schema_crc", "4d977534", "schema CRC 4d977534"),
    ("tick_hz", "unknown", "tick hz unknown"),
    ("features", ["edges", "simulated"], "features edges, simulated"),
    ("features", [], "features none"),
    ("vendor", "", "vendor not told"),
])  # fmt: skip
def test_labels_of_plain_data(tmp_path: Path, key: str, value: object, text: str) -> None:
    assert text in written(a_run(identity={key: value}), tmp_path).text


def test_quality_of_the_data_is_shown_and_remarked_on(tmp_path: Path) -> None:
    quality = Quality(63000, 1100, 964, 3, 12, 2, 1, 15750.0, 4.0, ("the link was down for 60 ms",))
    page = written(a_run(a_test("test_a", quality=quality), a_test("test_b")), tmp_path)
    assert page.row("Test a", "964") == "Test a 63000 15750 4.00 1100 964 3 12 2 1"
    assert page.row("the link was down for 60 ms") == "the link was down for 60 ms"


@pytest.mark.parametrize(("value", "lo", "hi", "unit", "text"), [
    (13.4567, None, 10.0, "%", "13.46 %"),
    (3000.4321, 2990.0, 3010.0, "r/min", "3000.43 r/min"),
    (0.0312345, 0.0, 0.05, "s", "0.0312 s"),
    (10.0004, None, 10.0, "%", "10.0004 %"),
    (3.0, None, 0.0, "", "3"),
    (-0.00001, -1.0, 1.0, "A", "0.000 A"),
    (-0.5, -1.0, 1.0, "A", "−0.500 A"),
    (123.456, None, None, "V", "123.5 V"),
    (0.0, None, None, "V", "0 V"),
    (math.inf, None, 1.0, "V", "∞ V"),
])  # fmt: skip
def test_digits(value: float, lo: float | None, hi: float | None, unit: str, text: str) -> None:
    assert words.value_text(Measurement("t.x", Limits("x", unit, lo, hi), Verdict.PASS, value)) == text


@given(
    st.floats(-1e8, 1e8).filter(lambda v: v == 0 or abs(v) > 1e-3),
    st.floats(-1e6, 1e6),
    st.floats(1e-3, 1e6),
    st.sampled_from(["both", "lo", "hi"]),
)
def test_a_bar_shows_on_which_side_of_a_limit_a_value_lies(value: float, lo: float, width: float, ends: str) -> None:
    limits = Limits("x", "A", None if ends == "hi" else lo, None if ends == "lo" else lo + width)
    place = words.place(Measurement("t.x", limits, Verdict.PASS, value))
    zone = words.zone(limits)
    assert place is not None
    assert 0 <= place <= 100
    if limits.allow(value):
        assert zone[0] - 1e-9 <= place <= zone[1] + 1e-9
    else:
        assert place <= zone[0] + 1e-9 or place >= zone[1] - 1e-9


@pytest.mark.parametrize(("value", "place"), [(0.0, 80.0), (1.0, 100.0), (-1.0, 0.0)])
def test_a_limit_of_nothing_has_a_bar_too(value: float, place: float) -> None:
    assert words.place(Measurement("t.x", Limits("x", "", None, 0.0), Verdict.PASS, value)) == place


def test_docstrings_are_filled_but_lists_stay() -> None:
    text = "One sentence\n    that goes on.\n\n    What counts:\n    - one,\n    - two.\n\n    The end.\n"
    assert words.paragraphs(text) == ["One sentence that goes on.", "What counts:\n- one,\n- two.", "The end."]


def test_durations() -> None:
    assert [words.duration(s) for s in (1.25, 61, 3599.7, 7322)] == ["1.2 s", "1 min 1 s", "1 h 0 min", "2 h 2 min"]


def drawn(path: Path) -> bytes:
    figure, (upper, lower) = style.new_figure(2)
    t = np.arange(0, 2, 1 / 16000)
    style.line(upper, t, np.random.default_rng(1).normal(size=len(t)), "i_q")
    style.line(upper, t, 0 * t, "i_q_ref")
    style.line(lower, t, style.wrapped_degrees((40 * t + np.pi) % (2 * np.pi) - np.pi), "theta_vt")
    style.degrees_axis(lower, "position", 180)
    style.limit_lines(upper, None, 2.0)
    style.axis_labels(upper, "", "current", "", "A")
    style.time_axes([upper, lower], 0, 2)
    style.legend_above(upper)
    style.legend_above(lower)
    style.save(figure, path)
    figure.draw_without_rendering()
    labels = [lower.xaxis.label, upper.yaxis.label, *upper.get_yticklabels(), *upper.get_legend().get_texts()]
    assert min(label.get_fontsize() for label in labels) >= 8
    assert [lower.get_xlabel(), upper.get_ylabel(), lower.get_ylabel()] == ["t [s]", "current [A]", "position [el. °]"]
    return path.read_bytes()


def test_a_figure_is_as_wide_as_a_page_and_always_the_same(tmp_path: Path) -> None:
    first, second = drawn(tmp_path / "a.png"), drawn(tmp_path / "b.png")
    assert hashlib.sha256(first).digest() == hashlib.sha256(second).digest()
    width, _ = struct.unpack(">II", first[16:24])  # of the PNG's header
    assert width == round(7.16 * 200)
    assert not any(chunk in first for chunk in (b"tEXt", b"tIME"))


@pytest.mark.parametrize(
    ("names", "rows"),
    [([f"a quantity with a long name {k}" for k in range(9)], None),
     (["vector tracking", "encoder", "reference", "last setpoint", "FAULT"], 1)],
    ids=("long names", "five of unequal length"),
)  # fmt: skip
def test_a_legend_stays_within_the_axes_and_is_as_low_as_it_can_be(names: list[str], rows: int | None) -> None:
    figure, (ax,) = style.new_figure()
    for k, name in enumerate(names):
        style.line(ax, np.arange(2.0), np.arange(2.0) + k, name, label=name)
    style.legend_above(ax)
    figure.draw_without_rendering()
    legend, axes = ax.get_legend().get_window_extent(), ax.get_window_extent()
    assert legend.x1 <= axes.x1
    assert legend.y0 >= axes.y1 - 1  # px: above the data
    lines = {round(text.get_window_extent().y0) for text in ax.get_legend().get_texts()}
    assert rows is None or len(lines) == rows


def test_limits_of_the_ordinate_are_named_once() -> None:
    _, (ax,) = style.new_figure()
    style.limit_lines(ax, -8.0, 8.0, "i_max")
    assert [line.get_ydata()[0] for line in ax.get_lines()] == [-8.0, 8.0]
    assert ax.get_legend_handles_labels()[1] == ["i_max"]


def test_the_title_of_a_column_stands_above_the_legend() -> None:
    figure, axes = style.new_figure(1, 2)
    for ax in axes:
        style.line(ax, np.arange(2.0), np.arange(2.0), "i_q")
    style.legend_above(axes[0])
    for ax, words_above in zip(axes, ("(a) average speed", "(b) proposed"), strict=True):
        style.column_title(ax, words_above)
    figure.draw_without_rendering()
    titles = [text for ax in axes for text in ax.get_children() if getattr(text, "get_text", str)()[:1] == "("]
    assert [title.get_text() for title in titles] == ["(a) average speed", "(b) proposed"]
    assert titles[0].get_window_extent().y0 >= axes[0].get_legend().get_window_extent().y1 - 4  # px: its empty border
    assert titles[1].get_window_extent().y0 >= axes[1].get_window_extent().y1
    assert titles[0].get_window_extent().y1 <= figure.bbox.y1


def test_lines_do_not_cross_the_plot_where_an_angle_wraps() -> None:
    degrees = style.wrapped_degrees(np.array([3.0, 3.1, -3.1, -3.0]))
    np.testing.assert_array_equal(np.isnan(degrees), [False, False, True, False])
    np.testing.assert_allclose(degrees[[0, 1, 3]], [171.887, 177.617, -171.887], atol=1e-3)


def test_a_quantity_has_one_colour() -> None:
    assert style.colour("theta_vt") == style.colour("omega_vt") != style.colour("theta_avg")
    assert style.colour("a name that nobody knows") in style.SERIES
