"""`bench compare`: what is noise and what is none, aligned to a sample, in a table and in rerun."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from made_runs import N_P, PWM_HZ, RPM, TICK_HZ, make, tick, turning
from rerun.chunk import RrdReader
from scipy.signal import lfilter

from bench.cli import cli
from bench.compare.alignment import aligned, zero_of
from bench.compare.batches import VERDICT_WORDS, Batches, of_means, of_rms, of_std
from bench.compare.compare import Comparison, compare
from bench.errors import BenchError
from bench.record.info import Mark
from bench.record.reader import Run
from bench.signal.batches import BATCHES, standard_error
from bench.signal.verdict import Verdict
from bench.view import schema
from protocol.codes import DriveState, EventCode, Fault
from protocol.messages import DeviceEvent
from protocol.signals import Unit
from tests.bench.view.synthetic import column

DATA = Path(__file__).parents[1] / "data"
N = PWM_HZ  # samples of a second
SEEDS = 200


def run_compare(*arguments: object) -> Result:
    return CliRunner().invoke(cli, ["compare", *map(str, arguments)])


def compared(a: Path, b: Path, to: str = "begin", begin: float | None = None, end: float | None = None) -> Comparison:
    return compare(*aligned(Run(a), Run(b), to, begin, end))


def verdicts(found: Comparison) -> dict[str, str]:
    return {row.name: VERDICT_WORDS[row.difference.verdict] for row in found.rows}


def changed(state: DriveState, seconds: float, node: int = 1) -> DeviceEvent:
    return DeviceEvent(tick(seconds), EventCode.STATE_CHANGED, node, float(state))


# -- noise ----------------------------------------------------------------------------------------------------------


def autoregressive(rng: np.random.Generator, n: int, phi: float) -> np.ndarray:
    """x_k = phi x_k-1 + e_k with unit e, stationary from its begin."""
    e = rng.normal(size=n)
    e[0] /= math.sqrt(1 - phi**2)
    return lfilter([1.0], [1.0, -phi], e)


@pytest.mark.parametrize("phi", [0.0, 0.9, 0.99])
def test_the_standard_error_is_that_of_noise_that_is_known(phi: float) -> None:
    """The variance of the mean of n samples of an AR(1) process is 1 / (n (1 - phi)^2), for n far above 1 / (1 - phi).

    The naive s / sqrt(n) would be too small by sqrt((1 + phi) / (1 - phi)), 14 times for 0.99.
    """
    n = 24_000
    exact = math.sqrt(2) / ((1 - phi) * math.sqrt(n))  # of a difference of two
    rng = np.random.default_rng(round(100 * phi))
    errors, beyond, differs = [], 0, 0
    for _ in range(SEEDS):
        sums = Batches(0, n - 1)
        for name in "ab":
            sums.add(name, sums.of(np.arange(n)), autoregressive(rng, n, phi))
        found = of_means(sums.sums("a"), sums.sums("b"))
        errors.append(found.error)
        beyond += abs(found.value) > 2 * found.error
        differs += found.verdict is Verdict.FAIL
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(exact, rel=0.25)
    assert np.median(errors) > 0.9 * exact
    assert beyond / SEEDS < 0.08  # Student's t with 23 degrees: 5.7 %
    assert differs / SEEDS < 0.02  # 0.6 %


def test_a_difference_that_swings_slowly_is_not_called_noise() -> None:
    slow = np.sin(np.linspace(0, 2 * np.pi, BATCHES))
    error, alike = standard_error(slow)
    assert alike > 0.8
    assert error > 2 * slow.std() / math.sqrt(BATCHES)
    sums = Batches(0, BATCHES * 100 - 1)
    batch = sums.of(np.arange(BATCHES * 100))
    sums.add("a", batch, np.zeros(BATCHES * 100))
    sums.add("b", batch, np.repeat(slow, 100))
    found = of_means(sums.sums("a"), sums.sums("b"))
    assert (found.verdict, found.why) == (Verdict.INVALID, "drifts")


def test_rms_and_std_of_noise_and_their_errors() -> None:
    """The standard error of the rms of n samples of white noise of 1 is 1 / sqrt(2 n)."""
    n, errors, differs = 9600, [], 0
    rng = np.random.default_rng(7)
    for _ in range(SEEDS):
        sums = Batches(0, n - 1)
        batch = sums.of(np.arange(n))
        a, b, wide = 0.5 + rng.normal(size=n), 0.5 + rng.normal(size=n), 0.5 + 1.1 * rng.normal(size=n)
        for name, values in (("a", a), ("b", b), ("wide", wide)):
            sums.add(name, batch, values)
        found = of_std(sums.sums("a"), sums.sums("b"))
        assert (found.a, found.b) == pytest.approx((a.std(), b.std()), rel=1e-6)
        errors.append(found.error)
        differs += found.verdict is Verdict.FAIL
        assert of_std(sums.sums("a"), sums.sums("wide")).verdict is Verdict.FAIL
        rms = of_rms(sums.sums("a"), sums.sums("b"))
        assert (rms.a, rms.b) == pytest.approx((np.sqrt(np.mean(a**2)), np.sqrt(np.mean(b**2))), rel=1e-9)
    assert np.median(errors) == pytest.approx(math.sqrt(2 / (2 * n)), rel=0.2)
    assert differs / SEEDS < 0.02


def test_too_few_samples_tell_nothing(tmp_path: Path) -> None:
    for name, value in (("a", 1.0), ("b", 5.0)):
        make(tmp_path / f"{name}.run", {"u_dc": np.full(BATCHES * 9, value)})
    (row,) = compared(tmp_path / "a.run", tmp_path / "b.run").rows
    assert (row.difference.verdict, row.difference.why) == (Verdict.INVALID, "too few samples")
    assert (row.difference.a, row.difference.b) == (1.0, 5.0)


def noisy(path: Path, offset: float, noise: float, seed: int) -> Path:
    """Two seconds with a step of the current, which both runs have, and `offset` in i_q; the angle errs as ever."""
    rng = np.random.default_rng(seed)
    n = 2 * N
    step = np.where(np.arange(n) < N, 1.0, 4.0)
    theta = turning(np.full(n, 500.0))
    return make(path, {
        "i_q": step + offset + autoregressive(rng, n, 0.95) * noise * math.sqrt(1 - 0.95**2),
        "i_d": rng.normal(0, noise, n),
        "omega_enc": np.full(n, 500 * RPM * N_P),
        "theta_enc": theta,
        "theta_vt": theta - np.radians(1.0 + rng.normal(0, 2.0, n) + 0.3 * (offset > 0)),
    })  # fmt: skip


def test_a_tenth_of_an_ampere_is_seen_in_noise_of_a_fifth_and_is_not_in_noise_of_twenty(tmp_path: Path) -> None:
    a, b = noisy(tmp_path / "a.run", 0.0, 0.2, 1), noisy(tmp_path / "b.run", 0.1, 0.2, 2)
    found = compared(a, b)
    i_q = next(row.difference for row in found.rows if row.name == "i_q")
    exact = 0.2 * math.sqrt((1 + 0.95) / (1 - 0.95) * 2 / (2 * N))  # of the difference of both means
    assert 0.6 < i_q.error / exact < 1.6
    assert i_q.value == pytest.approx(0.1, abs=3 * exact)
    told = verdicts(found)
    assert told["i_q"] == "differs"
    assert told["i_d"] == told["omega_enc"] == "same within noise"
    assert (told["theta_vt error, mean"], told["theta_vt error, std"]) == ("differs", "same within noise")
    loud = [noisy(tmp_path / f"loud{k}.run", k * 0.1, 20.0, k) for k in (0, 1)]
    assert verdicts(compared(*loud))["i_q"] == "same within noise"


# -- alignment ------------------------------------------------------------------------------------------------------

SHIFT = 4321  # samples by which B began later


@pytest.fixture(scope="module")
def shifted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same second and a half, in B at another device time, with more before it; it starts 0.5 s into A."""
    folder = tmp_path_factory.mktemp("shifted")
    signal = np.random.default_rng(5).normal(size=2 * N)
    late = SHIFT / PWM_HZ
    fault = DeviceEvent(tick(0.9), EventCode.FAULT, 1, float(Fault.HALL))
    states = zip((DriveState.ARMED, DriveState.RUNNING, DriveState.FAULT), (0.3, 0.5, 0.9), strict=True)
    armed, running, tripped = (changed(*state) for state in states)
    events = {
        "a": [armed, running, fault, tripped],
        "b": [changed(DriveState.RUNNING, 0.1, node=2), changed(DriveState.RUNNING, 0.5 + late),
              changed(DriveState.IDLE, 1.0), changed(DriveState.IDLE, 1.2)],
    }  # fmt: skip
    columns = {"a": {"i_q": signal[SHIFT:], "u_dc": np.ones(2 * N - SHIFT)},
               "b": {"i_q": signal, "u_alpha": np.ones(2 * N)}}  # fmt: skip
    marks = {"a": (tick(0.6), tick(0.7)), "b": (tick(0.6 + late), tick(1.7))}
    a, b = (
        make(folder / f"{name}.run", columns[name], start=1000, parameters={"n_p": 6, "k": k}, events=events[name],
             marks=[Mark("load step", *marks[name], Verdict.PASS)])
        for k, name in enumerate("ab", 1)
    )  # fmt: skip
    return a, b


@pytest.mark.parametrize("to", ["START", "running", "load step", "RUNNING#1"])
def test_runs_are_aligned_to_a_sample(shifted: tuple[Path, Path], to: str) -> None:
    a, b = aligned(Run(shifted[0]), Run(shifted[1]), to, None, None)
    period = TICK_HZ // PWM_HZ
    assert b.zero - a.zero == SHIFT * period
    assert (b.first - a.first, b.last - a.last) == (SHIFT * period, SHIFT * period)
    assert a.first == Run(shifted[0]).span[0]
    found = compare(a, b)
    (row,) = (row for row in found.rows if row.name == "i_q")
    assert (row.difference.value, row.difference.error) == (0.0, 0.0)  # the very same samples
    assert row.difference.verdict is Verdict.PASS
    a, b = aligned(Run(shifted[0]), Run(shifted[1]), to, 0.1, 0.2)
    assert (a.seconds(a.first), a.seconds(a.last)) == (0.1, 0.2)
    assert (b.first - b.zero, b.last - b.zero) == (tick(0.1), tick(0.2))


def test_aligned_at_their_begin_they_are_not_alike(shifted: tuple[Path, Path]) -> None:
    a, b = aligned(Run(shifted[0]), Run(shifted[1]), "begin", None, None)
    assert a.zero == b.zero == 1000 * TICK_HZ // PWM_HZ
    assert compare(a, b).rows[0].difference.error > 0


def test_a_name_that_is_not_there_or_there_twice_is_refused_with_what_there_is(shifted: tuple[Path, Path]) -> None:
    a, b = map(Run, shifted)
    with pytest.raises(
        BenchError, match=r"no mark and no event 'STALL'; it has begin, load step, ARMED, RUNNING, FAULT"
    ):
        zero_of(a, "STALL")
    with pytest.raises(BenchError, match=r"'IDLE' occurs 2 times in .*, at 1\.000 s, 1\.200 s: choose one, such as ID"):
        zero_of(b, "IDLE")
    assert zero_of(b, "IDLE#2") == tick(1.2)
    with pytest.raises(BenchError, match=r"there is no IDLE#3"):
        zero_of(b, "IDLE#3")
    assert zero_of(a, "fault") == tick(0.9)  # the event, not the state that follows
    with pytest.raises(BenchError, match=r"no time in common within --from 5"):
        aligned(a, b, "START", 5.0, None)


def test_events_and_parameters_that_differ(shifted: tuple[Path, Path]) -> None:
    found = compare(*aligned(Run(shifted[0]), Run(shifted[1]), "START", None, None))
    told = {pair.words: (pair.a, pair.b) for pair in found.events}
    assert (told["FAULT HALL"], told["ARMED"]) == ((pytest.approx(0.4), None), (pytest.approx(-0.2), None))
    assert "RUNNING" not in told
    assert [(pair.name, pair.a, pair.b) for pair in found.parameters] == [("k", 1.0, 2.0)]
    assert found.left_out == ("u_dc (only in A)", "u_alpha (only in B)")


def test_other_units_are_not_compared_and_other_rates_are(tmp_path: Path) -> None:
    n = 2 * N
    t = np.arange(n) / N
    a = make(tmp_path / "a.run", {"i_q": 2 + np.sin(7 * t), "u_dc": np.ones(n)})
    slow = t[::4]
    b = make(tmp_path / "b.run", {"i_q": 2 + np.sin(7 * slow), "u_dc": np.ones(n // 4)}, decimation=4,
             units={"u_dc": Unit.A})  # fmt: skip
    found = compared(a, b)
    assert found.left_out == ("u_dc (V in A, A in B)",)
    (row,) = found.rows
    assert row.difference.value == pytest.approx(0.0, abs=1e-3)


# -- rerun, and the command -----------------------------------------------------------------------------------------


def shown(rrd: Path, run: str) -> tuple[np.ndarray, np.ndarray]:
    """Times in ns and values of a run's i_q."""
    times, values = zip(*column(rrd, f"{run}/samples", schema.value_component("i_q")), strict=True)
    return np.array(times), np.array(values).ravel()


def test_both_runs_are_in_the_viewers_file_on_one_time(shifted: tuple[Path, Path], tmp_path: Path) -> None:
    rrd = tmp_path / "both.rrd"
    result = run_compare(*shifted, "--align", "START", "--save", rrd, "--from", "-0.05", "--to", "0.2")
    assert result.exit_code == 0, result.output
    (t_a, a), (t_b, b) = (shown(rrd, run) for run in "ab")
    assert len(t_a) == 4001
    assert (t_a == t_b).all()
    assert (t_a[0], t_a[-1]) == (-50_000_000, 200_000_000)
    assert (a == b).all()
    raw = Run(shifted[0]).samples
    first = int(np.flatnonzero(raw.tick == tick(0.45))[0])
    np.testing.assert_array_equal(a, raw.physical("i_q")[first : first + 4001].astype(np.float32))
    entities = {chunk.entity_path for chunk in RrdReader(rrd).stream().to_chunks()}
    assert {"/a/trend", "/b/trend", "/a/log/drive"} <= entities


def test_long_runs_are_shown_as_extremes(tmp_path: Path) -> None:
    n, decimation = 70_000, 16  # 70 s
    values = np.random.default_rng(6).normal(size=n)
    for name in "ab":
        make(tmp_path / f"{name}.run", {"i_q": values}, decimation=decimation, start=16 * (name == "b"))
    rrd = tmp_path / "both.rrd"
    assert run_compare(tmp_path / "a.run", tmp_path / "b.run", "--save", rrd).exit_code == 0
    t_a, a = shown(rrd, "a")
    assert (len(a), a[:2]) == (2 * 70 / 0.05, pytest.approx([values[:50].min(), values[:50].max()], rel=1e-6))
    t_b, b = shown(rrd, "b")
    assert abs(len(b) - len(a)) <= 20  # a bin that is in two row groups is shown twice
    assert (t_b[0], t_a[0]) == (0, 0)


def test_the_command_prints_and_writes_the_same(tmp_path: Path) -> None:
    a, b = noisy(tmp_path / "a.run", 0.0, 0.2, 1), noisy(tmp_path / "b.run", 0.1, 0.2, 2)
    result = run_compare(a, b, "--json", tmp_path / "a.json")
    assert result.exit_code == 0, result.output
    told = json.loads((tmp_path / "a.json").read_text())
    rows = {row["quantity"]: row for row in told["rows"]}
    line = next(line for line in result.stdout.splitlines() if line.startswith("i_q "))
    numbers = [float(word) for word in re.findall(r" (-?[\d.]+(?:e-?\d+)?)(?= )", line)]
    wanted = [rows["i_q"][key] for key in ("a", "b", "difference", "standard_error")]
    assert numbers == pytest.approx(wanted, rel=1e-3)
    assert line.endswith("differs")
    assert "not compared: theta_enc (a wrapping angle has no mean)" in result.stdout
    assert "events and parameters: the same" in result.stdout
    few = run_compare(a, b, "--channels", "i_d, theta_vt", "--json=-")
    assert [row["quantity"] for row in json.loads(few.stdout)["rows"]][:2] == ["i_d", "theta_vt error, mean"]
    wrong = run_compare(a, b, "--channels", "i_x")
    assert isinstance(wrong.exception, BenchError)
    assert "i_q, i_d, omega_enc, theta_vt" in str(wrong.exception)


def test_kept_runs_by_plain_numpy() -> None:
    found = compared(DATA / "steady.run", DATA / "reversal.run", "START", 0.1, 0.3)
    i_q = next(row.difference for row in found.rows if row.name == "i_q")
    for name, value in (("steady", i_q.a), ("reversal", i_q.b)):
        samples = Run(DATA / f"{name}.run").samples
        zero = zero_of(Run(DATA / f"{name}.run"), "START")
        where = (samples.tick >= zero + tick(0.1)) & (samples.tick <= zero + tick(0.3))
        assert value == pytest.approx(samples.physical("i_q")[where].mean(), abs=2e-3)
