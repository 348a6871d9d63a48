"""`bench measure`: numbers of formulas, of numpy and scipy on whole arrays, and uncertainties that hold."""

from __future__ import annotations

import json
import math
import tracemalloc
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import exported
import numpy as np
import pytest
from click.testing import CliRunner, Result
from hypothesis import given, settings
from hypothesis import strategies as st
from made_runs import N_P, PWM_HZ, TICK_HZ, channel, make, tick
from scipy.signal import chirp, lfilter
from scipy.stats import binom, circmean, circstd, linregress

import bench
from bench.cli import cli
from bench.errors import BenchError
from bench.measure import measure as measuring
from bench.measure.channel import Line, Row, Span
from bench.measure.frequency import Tone, Tones, tone_of
from bench.record.info import Mark, RunInfo
from bench.record.reader import Run
from bench.record.writer import RunWriter
from bench.signal.chunks import part
from protocol.descriptor import Channel
from protocol.messages import StreamEvent
from protocol.signals import Flag, RawType, Unit
from protocol.streams import Gap, SampleChunk, StreamConfig

DATA = Path(__file__).parents[1] / "data"
STEADY, REVERSAL = DATA / "steady.run", DATA / "reversal.run"
N = PWM_HZ  # samples of a second
T = np.arange(N) / PWM_HZ


def row(found: measuring.Statistics, name: str) -> Row:
    (its,) = [each for each in found.rows if each.channel == name]
    return its


def run_measure(*arguments: object) -> Result:
    return CliRunner().invoke(cli, ["measure", *map(str, arguments)])


def autoregressive(rng: np.random.Generator, n: int, phi: float) -> np.ndarray:
    """Stationary, with unit steps."""
    e = rng.normal(size=n)
    e[0] /= math.sqrt(1 - phi**2)
    return lfilter([1.0], [1.0, -phi], e)


def at_least(share: float, n: int) -> int:
    """How many of n there are at least, but once in 10 000 times."""
    return int(binom.ppf(1e-4, n, share))


# -- levels ---------------------------------------------------------------------------------------------------------


def test_a_sine_has_the_statistics_of_the_formula(tmp_path: Path) -> None:
    size, offset, f = 2.5, 0.75, 50.0
    make(tmp_path / "a.run", {"i_a": offset + size * np.sin(2 * np.pi * f * T + 1.0), "i_b": np.full(N, 3.0)})
    found = bench.measure(tmp_path / "a.run")
    sine, flat = row(found, "i_a"), row(found, "i_b")
    assert sine.unit == "A"
    assert sine.mean == pytest.approx(offset, abs=1e-6)
    assert sine.rms == pytest.approx(math.sqrt(offset**2 + size**2 / 2), rel=1e-6)
    assert sine.std == pytest.approx(size / math.sqrt(2), rel=1e-6)
    assert (sine.min, sine.max) == pytest.approx((offset - size, offset + size), rel=1e-3)
    assert sine.peak_to_peak == sine.max - sine.min
    assert abs(sine.frequency - f) <= sine.frequency_half_width < 0.05
    assert (flat.mean, flat.rms, flat.std, flat.peak_to_peak, flat.slope) == (3.0, 3.0, 0.0, 0.0, 0.0)
    assert math.isnan(flat.frequency)
    assert flat.why["frequency"] == "constant"


def noisy(n: int, seed: int) -> dict[str, np.ndarray]:
    """A ramp in noise, and one whose samples lack here and there."""
    rng = np.random.default_rng(seed)
    ramp = (1000.0 + np.arange(n) / PWM_HZ * 7.0 + rng.normal(0, 2.0, n)).astype(np.float32).astype(np.float64)
    holes = ramp.copy()
    holes[rng.random(n) < 0.2] = rng.choice([np.nan, np.inf, -np.inf])
    return {"i_a": ramp, "i_b": holes}


@pytest.fixture(scope="module")
def ramps(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, np.ndarray]]:
    columns = noisy(2 * N, 5)
    return make(tmp_path_factory.mktemp("ramps") / "a.run", columns), columns


def require_numpys(its: Row, t: np.ndarray, values: np.ndarray) -> None:
    known = np.isfinite(values)
    y = values[known]
    assert (its.n, its.not_finite) == (known.sum(), (~known).sum())
    found = [its.mean, its.rms, its.std, its.min, its.max, its.peak_to_peak]
    wanted = [y.mean(), np.sqrt((y * y).mean()), y.std(), y.min(), y.max(), np.ptp(y)]
    assert found == pytest.approx(wanted, rel=1e-9, abs=1e-9)
    assert its.slope == pytest.approx(linregress(t[known], y).slope, rel=1e-6, abs=1e-9)
    ends = [value if math.isfinite(value) else None for value in (values[0], values[-1])]
    assert [None if math.isnan(value) else value for value in (its.at_begin, its.at_end)] == ends


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2 * N - 40), st.integers(30, 2 * N), st.sampled_from([1 << 16, 4096, 333]))
def test_it_is_numpys_on_the_whole_array_between_any_cursors_in_any_windows(ramps, first, n, window) -> None:
    path, columns = ramps
    last = min(first + n, 2 * N) - 1
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measuring, "WINDOW", window)
        found = bench.measure(path, begin=first / PWM_HZ, end=last / PWM_HZ)
    assert found.between.samples == last - first + 1
    assert found.seconds == pytest.approx((last - first) / PWM_HZ, abs=1e-12)
    for name, values in columns.items():
        require_numpys(row(found, name), np.arange(first, last + 1) / PWM_HZ, values[first : last + 1])


@pytest.mark.parametrize("kept", [STEADY, REVERSAL])
def test_a_recording_piece_by_piece_is_what_its_capture_is_whole(kept: Path) -> None:
    by_path, whole = bench.measure(kept).as_json(), bench.measure(bench.read(kept)).as_json()
    assert json.dumps(by_path | {"run": ""}) == json.dumps(whole | {"run": ""})
    told = json.loads(run_measure(kept, "--json").stdout)
    assert told == json.loads(json.dumps(by_path))
    part = bench.measure(bench.open(kept), ["hall", "i_q"], 0.3, 0.5)
    assert [each.channel for each in part.rows] == ["hall", "i_q"]
    assert (part.begin, part.end) == (0.3, 0.5)
    table = part.to_pandas()
    assert table.loc["i_q", "mean"] == bench.read(kept, 0.3, 0.5)["i_q"].mean()


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 200), st.lists(st.integers(1, 60), max_size=8), st.integers(1, 90), st.integers(0, 2**32))
def test_windows_are_cut_at_the_same_ticks_however_samples_come(n, cuts, length, seed) -> None:
    config = StreamConfig(1, 0, 1, StreamEvent.PWM, 1, (channel("i_a"),), 25, tick_hz=TICK_HZ, pwm_hz=PWM_HZ)
    index = np.sort(np.random.default_rng(seed).choice(3 * n, n, replace=False))
    whole = SampleChunk(config, index, 10 * index, np.zeros(n, config.dtype), ())
    bounds = [0, *(at for at in np.cumsum(cuts).tolist() if at < n), n]
    pieces = [part(whole, a, b) for a, b in pairwise(bounds)]
    found = list(measuring._windows(pieces, int(whole.tick[0]), length))
    assert np.concatenate([window.index for window in found]).tolist() == index.tolist()
    numbers = [set(((window.tick - whole.tick[0]) // length).tolist()) for window in found]
    assert all(len(number) == 1 for number in numbers)
    assert len(set.union(*numbers)) == len(found)


# -- uncertainties that hold ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("phi", [0.0, 0.9, 0.99])
def test_two_standard_errors_hold_the_slope_of_noise_that_is_known(phi: float) -> None:
    """Of AR(1) noise about a line, forgotten within a batch: in 95 % of the cases, and it is not far wider."""
    n, seeds, slope = 24_000, 300, 3.0
    span = Span(0, (n - 1) * 10, 10 * n, n)
    off, errors = [], []
    for seed in range(seeds):
        y = slope * np.arange(n) / n + autoregressive(np.random.default_rng([seed, round(100 * phi)]), n, phi)
        line, its = Line(span), Row("a", "", "quantity")
        line.add(np.arange(n) * 10, y)
        line.into(its, 0.0)
        if math.isfinite(its.slope_error):
            off.append(its.slope - slope)
            errors.append(its.slope_error)
    assert len(off) > 0.95 * seeds
    held = sum(abs(a) <= 2 * b for a, b in zip(off, errors, strict=True))
    assert held >= at_least(0.945, len(off))
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(np.std(off), rel=0.3)


def test_a_slope_below_a_step_of_the_integers_is_within_its_error() -> None:
    """All samples are one integer, and the line may still have risen by nearly a step."""
    n = 4000
    for seed in range(200):
        rng = np.random.default_rng(seed)
        rise, begin = rng.uniform(-1, 1), rng.uniform(0, 50)
        y = np.round(begin + rise * np.arange(n) / n)
        line, its = Line(Span(0, n - 1, n, n)), Row("a", "", "quantity")
        line.add(np.arange(n), y)
        line.into(its, 1.0)
        assert math.isnan(its.slope_error) or abs(its.slope - rise) <= 3 * its.slope_error


def test_what_is_no_line_has_a_slope_without_an_error(tmp_path: Path) -> None:
    make(tmp_path / "a.run", {"i_a": np.where(T < 0.4, 0.0, 1.0), "i_b": T**2, "i_c": 5.0 * T})
    found = bench.measure(tmp_path / "a.run")
    for name in ("i_a", "i_b"):
        its = row(found, name)
        assert math.isnan(its.slope_error), name
        assert its.why["slope_error"] == "no straight line"
    assert row(found, "i_b").slope == pytest.approx(1.0, rel=1e-3)
    assert row(found, "i_c").slope == pytest.approx(5.0, rel=1e-6)
    assert row(found, "i_c").slope_error < 1e-5
    short = row(bench.measure(tmp_path / "a.run", end=0.005), "i_c")
    assert short.slope == pytest.approx(5.0, rel=1e-4)
    assert short.why["slope_error"] == "too few samples"


NOISES = {
    "none": lambda rng, n: np.zeros(n),
    "white": lambda rng, n: rng.normal(0, 0.7, n),
    "red": lambda rng, n: 0.1 * autoregressive(rng, n, 0.9),
    "redder": lambda rng, n: 0.03 * autoregressive(rng, n, 0.99),
}


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("shape", ["sine", "harmonics", "square", "counts"])
def test_the_frequency_lies_within_its_confidence_interval(noise: str, shape: str) -> None:
    """Of any number of periods from 5.5 on, in noise that is white or not, of waveforms that are sines or not."""
    inside = n_tones = 0
    for seed in range(60):
        rng = np.random.default_rng([seed, len(noise), len(shape)])
        n = int(rng.integers(500, 4000))
        periods = math.exp(rng.uniform(math.log(5.5), math.log(n / 5)))
        phase = 2 * np.pi * periods / n * np.arange(n) + rng.uniform(0, 2 * np.pi)
        y = 1.3 * np.sin(phase)
        if shape == "harmonics":
            y += 0.4 * np.sin(3 * phase + 1) + 0.2 * np.sin(2 * phase + 2)
        elif shape == "square":
            y = np.sign(y)
        y = y + NOISES[noise](rng, n) + rng.uniform(-5, 5) + rng.uniform(-2, 2) * np.arange(n) / n
        tone = tone_of(np.round(8 * y) if shape == "counts" else y, PWM_HZ)
        if isinstance(tone, Tone):
            n_tones += 1
            inside += abs(tone.f - periods / n * PWM_HZ) <= tone.half_width
            assert tone.half_width < 0.5 * PWM_HZ / n, "half a line of the spectrum"
    assert n_tones >= 50
    assert inside >= at_least(0.95, n_tones)


@pytest.mark.parametrize("phi", [0.0, 0.9, 0.99, 1.0])
def test_noise_has_no_frequency(phi: float) -> None:
    """Not once in a hundred times, whatever its colour; a random walk is one."""
    rng = np.random.default_rng(round(100 * phi) + 1)
    found = 0
    for _ in range(400):
        n = int(rng.integers(32, 4000))
        y = np.cumsum(rng.normal(size=n)) if phi == 1.0 else autoregressive(rng, n, phi)
        found += isinstance(tone_of(y, 1.0), Tone)
    assert found <= binom.ppf(1 - 1e-4, 400, 0.005)


def test_the_fundamental_is_found_where_a_harmonic_is_stronger() -> None:
    """A current without load is mostly its third harmonic; with less than a tenth of the power it is the harmonic."""
    rng = np.random.default_rng(8)
    for share in (0.3, 0.15, 0.05, 0.0):
        for order in (2, 3, 5, 7):
            f = 50.0 if share >= 0.1 else 50.0 * order
            phase = 2 * np.pi * 50.0 * T + 1.0
            y = math.sqrt(2 * share) * np.sin(phase) + math.sqrt(2 * (1 - share)) * np.sin(order * phase + 2.0)
            tone = tone_of(y + rng.normal(0, 0.05, N), PWM_HZ)
            assert isinstance(tone, Tone)
            assert abs(tone.f - f) <= tone.half_width, (share, order)


def test_a_frequency_that_changes_is_not_one() -> None:
    n = 60_000
    t = np.arange(n) / PWM_HZ
    for f0, f1 in ((20.0, 25.0), (50.0, 10.0), (300.0, 320.0)):
        assert tone_of(chirp(t, f0, t[-1], f1), PWM_HZ) in ("not steady", "no periodic part")
    for fs in ((50.0, 52.0), (50.0, None), (None, 50.0)):  # from window to window
        tones = Tones()
        for f in fs:
            tones.add(np.random.default_rng(1).normal(size=n) if f is None else np.sin(2 * np.pi * f * t), PWM_HZ, True)
        assert tones.result() == "not steady"


def test_the_frequency_of_many_windows_is_their_mean_and_as_sure_as_they_agree() -> None:
    inside = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        tones, wander = Tones(), 50.0 + 0.05 * rng.normal(size=6)  # Hz
        t = np.arange(4000) / PWM_HZ
        for f in wander:
            tones.add(np.sin(2 * np.pi * f * t) + 0.1 * rng.normal(size=len(t)), PWM_HZ, True)
        tone = tones.result()
        assert isinstance(tone, Tone)
        assert tone.f == pytest.approx(wander.mean(), abs=0.02)
        inside += abs(tone.f - 50.0) <= tone.half_width
    assert inside >= at_least(0.95, 60)


# -- angles and codes -----------------------------------------------------------------------------------------------


def test_an_angle_that_wobbles_has_a_circular_mean_and_one_that_turns_a_speed(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    wobble = 3.0 + 0.5 * np.sin(2 * np.pi * 7 * T) + rng.normal(0, 0.02, N)
    omega = -2 * np.pi * 41.5
    make(tmp_path / "a.run", {"theta_enc": omega * T + 1.0 + rng.normal(0, 0.01, N), "theta_vt": wobble})
    found = bench.measure(tmp_path / "a.run")
    still, turning_ = row(found, "theta_vt"), row(found, "theta_enc")
    wrapped = np.mod(wobble + np.pi, 2 * np.pi) - np.pi
    assert still.kind == "angle"
    assert still.mean == pytest.approx(circmean(wrapped, np.pi, -np.pi), abs=1e-6)
    assert still.std == pytest.approx(circstd(wrapped, np.pi, -np.pi), rel=1e-5)
    assert still.difference == pytest.approx(wobble[-1] - wobble[0], abs=1e-5)
    assert abs(turning_.slope - omega) <= 3 * turning_.slope_error < 0.1
    assert abs(turning_.frequency - 41.5) <= turning_.frequency_half_width < 0.01
    assert turning_.difference == pytest.approx(omega * T[-1], abs=0.1)
    assert found.between.revolutions == pytest.approx(-41.5 * T[-1], abs=0.01)
    assert math.isnan(turning_.mean)
    assert turning_.why["mean"] == "it turns through a revolution or more"
    for its in (still, turning_):
        assert math.isnan(its.rms)
        assert math.isnan(its.max)
        assert its.why["rms"] == its.why["peak_to_peak"] == "it wraps"


def turned_at(path: Path, speed: np.ndarray) -> Row:
    """What is measured of the encoder of a shaft with these electrical speeds (N,), rad/s."""
    make(path, {"theta_enc": np.cumsum(speed) / PWM_HZ})
    return row(bench.measure(path), "theta_enc")


def test_an_angle_that_starts_or_speeds_up_has_no_frequency(tmp_path: Path) -> None:
    full = np.full(N, 2 * np.pi * 50)
    for k, speed in enumerate((full * np.minimum(T / 0.15, 1.0), full * (0.5 + T), np.where(T < 0.7, full, -full))):
        its = turned_at(tmp_path / f"{k}.run", speed)
        assert its.why["frequency"] == "not steady", k
        assert its.difference == pytest.approx(float(speed[1:].sum()) / PWM_HZ, abs=1e-3)
    assert turned_at(tmp_path / "slow.run", full * 0.08).why["frequency"] == "no periodic part"  # four revolutions
    ripple = full * (1 + 0.03 * np.sin(2 * np.pi * 100 * T))
    its = turned_at(tmp_path / "ripple.run", ripple)
    assert abs(its.frequency - 50.0) <= its.frequency_half_width < 0.05


@pytest.mark.long("memory is traced")
def test_what_it_holds_in_memory_does_not_grow_with_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measuring, "WINDOW", 4096)
    peaks = []
    for n in (70_000, 140_000):  # at 1 kHz
        run = Run(make(tmp_path / f"{n}.run", {name: np.sin(np.arange(n)) for name in ("i_a", "i_b")}, decimation=16))
        tracemalloc.start()
        measuring.measure(run)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] - peaks[0] < 0.1 * 70_000 * (8 + 8 + 4 + 4), "index, tick and two channels of the rest"


def gappy(path: Path, columns: dict[str, np.ndarray], kept: np.ndarray) -> Path:
    """A run of the samples that are `kept` (n,) alone."""
    channels = tuple(channel(name) for name in columns)
    config = StreamConfig(1, 0, 1, StreamEvent.PWM, 1, channels, 25, tick_hz=TICK_HZ, pwm_hz=PWM_HZ)
    index = np.flatnonzero(kept).astype(np.int64)
    raw = np.zeros(len(index), config.dtype)
    for name, values in columns.items():
        raw[name] = values[kept]
    ends = np.flatnonzero(np.diff(index) != 1) + 1
    gaps = tuple(Gap(int(at), int(index[at] - index[at - 1] - 1), 1, False) for at in ends)
    writer = RunWriter(path, RunInfo(TICK_HZ, PWM_HZ, channels, {"n_p": float(N_P)}))
    writer.take(SampleChunk(config, index, index * (TICK_HZ // PWM_HZ), raw, gaps))
    writer.close()
    return path


def test_gaps_are_counted_and_an_angle_is_followed_over_short_ones_only(tmp_path: Path) -> None:
    kept = np.ones(N, bool)
    kept[3000:3003] = kept[9000:9001] = False
    turned = 2 * np.pi * 50 * T
    columns = {"theta_enc": np.mod(turned + np.pi, 2 * np.pi) - np.pi, "i_a": np.sin(turned)}
    found = bench.measure(gappy(tmp_path / "short.run", columns, kept))
    assert (found.between.samples, found.between.gaps, found.between.missing) == (N - 4, 2, 4)
    assert found.between.edges is None
    assert found.between.revolutions == pytest.approx(50 * T[-1], abs=1e-6)
    assert abs(row(found, "i_a").frequency - 50) <= row(found, "i_a").frequency_half_width
    kept[4000:4400] = False  # more than a revolution
    long = bench.measure(gappy(tmp_path / "long.run", columns, kept))
    assert math.isnan(long.between.revolutions)
    its = row(long, "theta_enc")
    assert math.isnan(its.slope)
    assert math.isnan(its.difference)
    assert "to be followed" in its.why["slope"]
    assert its.why["frequency"] == its.why["slope"] == its.why["difference"]
    told = run_measure(tmp_path / "long.run").stdout
    assert "15596, 404 samples missing in 3 gaps" in told
    assert "unknown by the encoder: it cannot be followed" in told


def test_a_cursor_in_a_gap_has_no_value(tmp_path: Path) -> None:
    kept = np.ones(N, bool)
    kept[3000:3200] = False
    path = gappy(tmp_path / "a.run", {"i_a": T}, kept)
    its = row(bench.measure(path, begin=3100 / PWM_HZ, end=0.5), "i_a")
    assert math.isnan(its.at_begin)
    assert math.isnan(its.difference)
    assert its.at_end == pytest.approx(0.5)
    assert row(bench.measure(path, begin=2999.6 / PWM_HZ), "i_a").at_begin != its.at_begin
    with pytest.raises(BenchError, match=r"has no samples from 0\.190 s to 0\.191 s"):
        bench.measure(path, begin=0.19, end=0.191)


def test_a_code_has_values_and_changes(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    codes = rng.integers(1, 7, N)
    make(tmp_path / "a.run", {"hall": codes, "status": np.full(N, 3)})
    found = bench.measure(tmp_path / "a.run")
    its = row(found, "hall")
    assert its.changes == np.count_nonzero(np.diff(codes))
    assert its.values == dict(zip(*map(np.ndarray.tolist, np.unique(codes, return_counts=True)), strict=True))
    assert (its.at_begin, its.at_end) == (codes[0], codes[-1])
    assert math.isnan(its.mean)
    assert (row(found, "status").changes, row(found, "status").values) == (0, {3: N})


# -- what lies between ----------------------------------------------------------------------------------------------


def test_hall_edges_and_revolutions_are_counted_by_direction() -> None:
    for path in (STEADY, REVERSAL):
        for begin, end in ((None, None), (0.3, 0.9)):
            whole = bench.read(path, begin, end)
            between = bench.measure(path, ["i_q"], begin, end).between
            sectors = [[-1, 0, 2, 1, 4, 5, 3, -1][code] for code in range(8)]
            gone = [
                (sectors[b] - sectors[a]) % 6 for a, b in zip(whole.edges.hall_old, whole.edges.hall_new, strict=True)
            ]
            assert (between.edges, between.forward, between.reverse) == (len(gone), gone.count(1), gone.count(5))
            turned = np.unwrap(whole["theta_enc"])
            assert between.revolutions == pytest.approx((turned[-1] - turned[0]) / (2 * np.pi), abs=1e-9)
            assert between.revolutions_by_hall == pytest.approx(between.revolutions, abs=0.2)
            assert between.n_p == 6


def test_losses_of_all_kinds_are_counted(tmp_path: Path) -> None:
    """A gap within a chunk and an outage; illegal edges leave the revolutions unknown."""
    found = bench.measure(exported.record(tmp_path / "a.run"))
    samples, edges = (exported.expected(tmp_path / "a.run", stream) for stream in ("samples", "edges"))
    between = found.between
    assert (between.samples, between.gaps, between.missing) == (len(samples["tick"][0]), 2, 3 + 100)
    assert (between.edges, between.edge_gaps) == (len(edges["tick"][0]), 1)
    assert math.isnan(between.revolutions_by_hall)
    for name in ("tau", "u_dc", "temperature", "i.a"):
        require_numpys(row(found, name), samples["time"][0], samples[name][0])
    assert {its.channel: its.kind for its in found.rows} == {
        "hall": "code", "theta_enc": "angle", "u_dc": "quantity", "temperature": "quantity", "time": "quantity",
        "tau": "quantity", "i.a": "quantity",
    }  # fmt: skip
    assert row(found, "hall").values is None
    assert "more than are listed" in run_measure(tmp_path / "a.run").stdout


# -- the command ----------------------------------------------------------------------------------------------------


def test_cursors_may_be_marks_and_events(tmp_path: Path) -> None:
    path = make(tmp_path / "a.run", {"i_a": T}, marks=[Mark("load step", tick(0.25), tick(0.5))])
    found = bench.measure(path, begin="load step", end="load step")
    assert (found.begin, found.end) == (0.25, 0.5)
    its = row(found, "i_a")
    assert (its.at_begin, its.at_end, its.difference) == pytest.approx((0.25, 0.5, 0.25), abs=1e-7)
    told = run_measure(path, "--from", "load step", "--to", "load step")
    assert told.exit_code == 0
    assert "from 0.250000 to 0.500000 s: dt = 0.250000 s, 1/dt = 4 Hz" in told.stdout
    assert run_measure(STEADY, "--from", "running", "--to", "IDLE").exit_code == 0


def test_the_tables_say_what_an_engineer_reads() -> None:
    told = run_measure(STEADY, "--from", 0.55, "--to", 1.1, "--channels", "i_a,theta_enc,hall").stdout
    lines = {line.split()[0]: line.split() for line in told.splitlines()[5:]}
    whole = bench.read(STEADY, 0.55, 1.1)
    levels = next(line.split() for line in told.splitlines() if line.startswith("i_a"))
    assert [float(cell) for cell in levels[2:]] == pytest.approx(
        [f(whole["i_a"]) for f in (np.mean, lambda y: np.sqrt((y * y).mean()), np.std, np.min, np.max, np.ptp)],
        rel=1e-4,
    )
    assert lines["hall"][3] == "165"
    assert float(lines["theta_enc"][-2]) == pytest.approx(50.0, abs=0.2)  # 500 r/min, six pole pairs
    assert "Hall edges              165: 165 forward, 0 in reverse" in told
    assert "theta_enc: an angle that wraps has no rms, minimum and maximum" in told


@pytest.mark.parametrize(("arguments", "words"), [
    (("--channels", "i_x"), "channel 'i_x' is not in the stream; it has hall, status, theta_enc"),
    (("--from", "1", "--to", "0.5"), "has no data from 1 to 0.5 s: it covers 0.120 to 1.420 s"),
    (("--from", "9"), "has no data from 9"),
    (("--from", "0.80001", "--to", "0.80002"), "has no samples from 0.800 s to 0.800 s"),
    (("--from", "nan"), "'nan' is not a finite number"),
    (("--to", "inf"), "'inf' is not a finite number"),
    (("--from", "STRT"), "has no mark and no event 'STRT'; it has begin, ARMED, RUNNING, IDLE"),
    (("--json=/nowhere/a.json",), "there is no directory"),
])  # fmt: skip
def test_what_cannot_be_measured_is_named(arguments: Sequence[str], words: str) -> None:
    told = run_measure(STEADY, *arguments)
    assert told.exit_code != 0
    assert words in (told.output if told.exception is None else f"{told.output} {told.exception}")


def test_in_python_it_is_a_bench_error(tmp_path: Path) -> None:
    for at in (math.nan, math.inf):
        with pytest.raises(BenchError, match="is no time"):
            bench.measure(STEADY, begin=at)
    with pytest.raises(BenchError, match="no channel named"):
        bench.measure(STEADY, [])
    with pytest.raises(BenchError, match="no such run"):
        bench.measure(tmp_path / "none.run")
    writer = RunWriter(tmp_path / "edges.run", exported.info())
    writer.take(exported.edges(np.arange(3, dtype=np.int64)))
    writer.close()
    with pytest.raises(BenchError, match="holds no samples of the drive"):
        bench.measure(tmp_path / "edges.run")


@pytest.mark.parametrize("value", [0.0, 1.0, -1e30, 3e38, math.nan, math.inf])
@pytest.mark.parametrize("n", [1, 2, 3, 40])
def test_few_samples_and_odd_values_give_no_numbers_rather_than_wrong_ones(tmp_path, n, value) -> None:
    wild = Channel(1, "theta_x", Unit.RAD, RawType.F32, 1.0, Flag.CHANNEL | Flag.WRAPS)
    other = Channel(2, "x", Unit.NONE, RawType.F32, 1.0, Flag.CHANNEL)
    values = np.full(n, value)
    with np.errstate(all="ignore"):
        path = make(tmp_path / "a.run", {"theta_x": values, "x": values}, channels=[wild, other])
    found = bench.measure(path)
    its = row(found, "x")
    known = math.isfinite(value)
    assert (its.n, its.not_finite) == ((n, 0) if known else (0, n))
    assert (its.mean == pytest.approx(value, rel=1e-6)) if known else math.isnan(its.mean)
    assert math.isnan(its.frequency)
    assert its.slope == 0.0 if known and n > 1 else math.isnan(its.slope)
    told = run_measure(path)
    assert told.exit_code == 0
    assert ("are NaN or infinite and left out" in told.stdout) is not known
    json.loads(run_measure(path, "--json").stdout)
