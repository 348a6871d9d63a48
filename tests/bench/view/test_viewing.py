"""What rerun is given of a run that is too long for samples: its extremes, and samples where something happened."""

from __future__ import annotations

import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import numpy as np
import pytest
import synthetic
from made_runs import make
from rerun.chunk import RrdReader

from bench.errors import BenchError
from bench.record import layout
from bench.record.reader import Run
from bench.record.times import ticks_of
from bench.record.writer import RunWriter
from bench.view import schema
from bench.view.viewing import LOT_BROWSER, close_time, write_rrd
from protocol.host import DeviceEventReceived
from protocol.messages import DeviceEvent, EventCode
from protocol.streams import Gap, SampleChunk
from tests.viewers import any_port

SECONDS, FAULT = 90, 70.25  # of device time; the fault lies within one chunk
CONFIG = synthetic.config(synthetic.named("i_a", "theta_enc", "theta_vt"))


@pytest.fixture(scope="module")
def long(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """A run of 90 s with a fault, and the current of each of its samples in counts; 160 samples are lost."""
    path = tmp_path_factory.mktemp("long") / "a.run"
    index = np.arange(SECONDS * synthetic.PWM_HZ, dtype=np.int64)
    raw = np.zeros(len(index), CONFIG.dtype)
    raw["i_a"] = np.random.default_rng(4).integers(-3000, 3000, len(index))
    raw["theta_enc"] = 1000
    raw["theta_vt"] = 900
    writer = RunWriter(path, synthetic.run_info(channels=CONFIG.channels))
    for k in range(0, len(index), 1600):
        part = slice(k + (160 if k == 16_000 else 0), k + 1600)
        gaps = (Gap(0, 160, 2, False),) if k == 16_000 else ()
        writer.take(SampleChunk(CONFIG, index[part], index[part] * synthetic.TICKS, raw[part], gaps))
    writer.take(DeviceEventReceived(1, DeviceEvent(round(FAULT * synthetic.TICK_HZ), EventCode.FAULT, 1, 1.0)))
    writer.close()
    return path, raw["i_a"].astype(np.int64)


def shown(path: Path, component: str) -> tuple[np.ndarray, np.ndarray]:
    """Times in s, and values."""
    rows = synthetic.column(path, schema.FAST, component)
    return np.array([at for at, _ in rows]) / 1e9, np.array([row[0] for _, row in rows])


def test_a_long_run_keeps_its_extremes_and_is_whole_around_a_fault(long: tuple[Path, np.ndarray]) -> None:
    path, counts = long
    t, current = shown(path, schema.value_component("i_a"))
    near = np.abs(t - FAULT) <= 0.5
    first, last = (round((FAULT + side) * synthetic.PWM_HZ) for side in (-0.5, 0.5))
    scale = CONFIG.channel("i_a").scale
    np.testing.assert_allclose(current[near][: last - first], counts[first:last] * scale, atol=1e-6)
    end = round(0.5 * synthetic.PWM_HZ)  # where a viewer opens
    assert len(t) < 2 * SECONDS / 0.05 + (last - first) + end + 10
    for begin in (3, 40, 85):  # bins of 50 ms, by the samples themselves
        of = slice(begin * synthetic.PWM_HZ, begin * synthetic.PWM_HZ + 800)
        pair = current[(t >= begin - 1e-9) & (t < begin + 0.05 - 1e-9)]
        np.testing.assert_allclose(pair, np.array([counts[of].min(), counts[of].max()]) * scale, atol=1e-6)
    _, error = shown(path, schema.error_component("theta_vt"))
    np.testing.assert_allclose(error, np.degrees(100 * CONFIG.channel("theta_enc").scale), rtol=1e-4)


def test_what_was_lost_is_counted_although_samples_are_left_out(long: tuple[Path, np.ndarray]) -> None:
    counts = [row[0] for _, row in synthetic.column(long[0], schema.HEALTH, "lost:samples")]
    assert counts[-1] == 160


def test_close_ups_say_where_samples_are_left_out(long: tuple[Path, np.ndarray]) -> None:
    told = synthetic.column(long[0], f"{schema.SCOPE}/0", "Points2D:labels")
    words = {at / 1e9: texts[0].split("\n") for at, texts in told}
    (left,) = (at for at, lines in words.items() if lines[1] == "from here on samples are left out")
    assert left == pytest.approx(FAULT + 0.5, abs=1e-3)
    assert {lines[0] for lines in words.values()} == {"the last 0.2 s over time"}
    near = [at for at in words if abs(at - FAULT) < 0.5]
    assert len(near) >= 3
    assert all(words[at][1] == "no whole revolution yet: at rest" for at in near)


def test_a_part_is_shown_sample_by_sample(long: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    path, counts = long
    run = Run(path)
    write_rrd(run, tmp_path / "part.rrd", *ticks_of(run, 59.5, 60.5))  # over the seam of two segments
    _, current = shown(tmp_path / "part.rrd", schema.value_component("i_a"))
    of = slice(round(59.5 * synthetic.PWM_HZ), round(60.5 * synthetic.PWM_HZ) + 1)
    np.testing.assert_allclose(current, counts[of] * CONFIG.channel("i_a").scale, atol=1e-6)


def test_a_slow_recording_is_shown_sample_by_sample_over_so_long_that_there_is_something_to_see(tmp_path: Path) -> None:
    u_dc = np.linspace(20.0, 30.0, 6_000)
    slow = Run(make(tmp_path / "slow.run", {"u_dc": u_dc}, decimation=1_600))  # 10 min, 10 Hz
    assert close_time(slow) == pytest.approx(20.0)
    write_rrd(slow, tmp_path / "slow.rrd")
    at, values = shown(tmp_path / "slow.rrd", schema.value_component("u_dc"))
    assert np.allclose(np.diff(at), 0.1)
    assert np.allclose(values, u_dc)


def test_a_part_that_there_is_not_is_refused_with_what_there_is(long: tuple[Path, np.ndarray]) -> None:
    run = Run(long[0])
    for begin, end in ((200.0, None), (None, -1.0), (50.0, 40.0)):
        with pytest.raises(BenchError, match=r"has no data from .* s: it covers 0\.000 to 90\.000 s"):
            ticks_of(run, begin, end)


def test_an_overview_is_made_where_none_is_stored(long: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    """As of a run that is being recorded: the same pictures, from samples."""
    path, _ = long
    run = Run(path)
    for segment in run.segments:
        assert segment.files
        segment._files = {name: files for name, files in segment.files.items() if name != layout.OVERVIEW}
    write_rrd(run, tmp_path / "made.rrd")
    component = schema.value_component("i_a")
    for mine, theirs in zip(shown(tmp_path / "made.rrd", component), shown(path, component), strict=True):
        assert (mine == theirs).all()


@pytest.mark.slow
def test_a_browser_gets_the_same_samples_in_few_messages(tmp_path: Path) -> None:
    """Without a GPU it reads few messages a frame, and draws a frame in seconds."""
    made = synthetic.SyntheticRun(2.5, 1000.0)
    path = synthetic.recorded(tmp_path / "a.run", *made.chunks(), channels=made.config.channels)
    write_rrd(Run(path), tmp_path / "browser.rrd", lot=LOT_BROWSER)
    for name in ("i_a", "theta_enc"):
        component = schema.value_component(name)
        for mine, theirs in zip(shown(tmp_path / "browser.rrd", component), shown(path, component), strict=True):
            np.testing.assert_array_equal(mine, theirs)
            assert len(mine) == len(made.index)
    for entity in (schema.FAST, schema.HALL, schema.HALL_LANES):
        messages = RrdReader(tmp_path / "browser.rrd").stream().filter(content=f"/{entity}").to_chunks()
        assert len(messages) <= 2.5 / LOT_BROWSER + 3  # one of them static


@pytest.mark.slow
def test_the_command_serves_the_dashboard_until_ctrl_c(long: tuple[Path, np.ndarray]) -> None:
    command = [sys.executable, "-m", "bench", "view", str(long[0]), "--from", "10", "--to", "11"]
    command += ["--viewer", "web", "--web-port", str(any_port())]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as view:
        try:
            assert view.stderr is not None
            address = next(line for line in view.stderr if "dashboard" in line).split()[1]
            with urllib.request.urlopen(address, timeout=10) as page:
                assert b"re_viewer" in page.read()
            view.send_signal(signal.SIGINT)
            assert view.wait(30) == 0
            assert "Traceback" not in view.stderr.read()
        finally:
            view.kill()
