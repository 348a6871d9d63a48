"""The dashboard in rerun's headless viewer: every view is there, healthy, and shows something."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import synthetic
from synthetic import components

from bench.record.reader import Run
from bench.record.sink import RunSink
from bench.view import schema
from bench.view.plots import plots, returns
from bench.view.scope import scopes
from protocol.host import HeartbeatReceived
from tests.tools import needs
from tests.viewers import headless

pytestmark = pytest.mark.slow

VIEWS = {
    "TimeSeries": len(plots(synthetic.run_info())) + 2,  # of the Hall sensors
    "StateTimeline": 2,
    "2D": 2 + len(scopes(synthetic.run_info())),
    "BarChart": 3,
    "TextDocument": 2,
    "TextLog": 1,
}


HOSTILE = ("a/b c|:#", "`*x*` [y](z)", "\x1b[2J\u202e\n")


def test_every_line_of_every_plot_has_data(recording: Path, made: synthetic.SyntheticRun) -> None:
    shown = plots(synthetic.run_info())
    known = {key for key, plot in shown.items() if not plot.by_unit}
    assert known == {"error_trend", "speed", "dq", "bus", "position", "error", "phases", "bus_wave"}
    found = components(recording)
    for plot in shown.values():
        for line in plot.lines:
            n = found[f"/{plot.entity}"][line.component]
            assert n == (len(made.index) if plot.entity == schema.FAST else 600), line
    assert found[f"/{schema.DRIVE}"]["StateChange:state"] >= 4
    assert found["/stator/vectors"]["Arrows2D:vectors"] == 30  # one in 0.1 s
    assert found["/run"]["TextDocument:text"] == 5  # once a second, and the summary
    assert found["/numbers"]["TextDocument:text"] == 3  # once a second
    assert all(found[f"/{bar}/{of}"] for bar, of in (("by_angle", "vector-tracking"), ("harmonics", "i_a")))
    assert found["/late/forward"]
    assert found["/log/drive"]["TextLog:text"] == found["/log/host"]["TextLog:text"] == 1
    assert found["/stator/plane/lines"]


def test_a_quantity_keeps_its_colour_from_plot_to_plot() -> None:
    colours: dict[str, set[tuple[int, int, int]]] = {}
    for plot in plots(synthetic.run_info()).values():
        for line in plot.lines:
            colours.setdefault(line.name.split(" [")[0], set()).add(line.colour)
    assert {name for name, found in colours.items() if len(found) > 1} == set()


@needs("Vulkan driver")
@pytest.mark.long("rerun's viewer draws in software")
def test_a_saved_run_opens_with_every_view_healthy(recording: Path, tmp_path: Path) -> None:
    with headless("--window-size", "1600x900") as viewer:
        viewer.client.open(str(synthetic.viewed(recording)))
        state = viewer.await_recording()
        picture = tmp_path / "dashboard.png"
        viewer.client.save_screenshot(str(picture))
        state = viewer.client.get_state()
    counts = {kind: sum(view.view_class == kind for view in state.views) for kind in VIEWS}
    assert (counts, len(state.views)) == (VIEWS, sum(VIEWS.values()))
    assert [(view.name, view.reports) for view in state.views if view.reports] == []
    assert all(view.visible for view in state.views)
    (timeline,) = state.recordings[0].timelines
    assert ((timeline.name, timeline.time_type), timeline.start) == ((schema.TIMELINE, "duration"), 100_000_000_000)
    assert picture.stat().st_size > 50_000


@needs("Vulkan driver")
@pytest.mark.parametrize("names", [
    ("i_a", "i_b", "i_c"),
    ("theta_enc", "theta_vt"),
    ("hall",),
    ("u_dc", "status", "omega_ref"),
    ("u_dc", "i_d", "tau_e_true"),  # under names of their own
])  # fmt: skip
def test_a_run_of_few_channels_has_no_empty_or_failing_view(names: tuple[str, ...], tmp_path: Path) -> None:
    channels = synthetic.named(*names)
    foreign = "tau_e_true" in names
    if foreign:
        channels = tuple(replace(channel, name=name) for channel, name in zip(channels, HOSTILE, strict=True))
    features = [] if "hall" not in names else ["edges"]
    run = synthetic.run_info(channels=channels, parameters={}, identity={"features": features})
    path = tmp_path / "few.run"
    sink = RunSink(path, run, wait=True)
    made = synthetic.SyntheticRun(0.5, config=synthetic.config(channels))
    made.raw[:] = np.arange(len(made.index)) if foreign else made.raw
    for chunk in made.sample_chunks():
        sink.take(chunk)
    sink.take(HeartbeatReceived(1, synthetic.heartbeat(int(made.tick[-1]))))
    sink.close()
    assert Run(path).samples.raw.tobytes() == made.raw.tobytes()
    found = components(path)
    for plot in plots(run).values():
        assert plot.lines
        assert all(found[f"/{plot.entity}"][line.component] > 0 for line in plot.lines)
    with headless() as viewer:
        viewer.client.open(str(synthetic.viewed(path)))
        state = viewer.await_recording()
        assert [(view.name, view.reports) for view in state.views if view.reports] == []
    kinds = [view.view_class for view in state.views]
    assert kinds.count("TimeSeries") == len(plots(run)) + len(returns(run))
    assert kinds.count("StateTimeline") == (2 if "hall" in names else 1)
    assert kinds.count("2D") == any(name in ("i_a", "theta_enc") for name in names) + len(scopes(run))


def test_positions_are_compared_with_the_reference_and_wrapped(recording: Path, made: synthetic.SyntheticRun) -> None:
    shown = [row[0] for _, row in synthetic.column(recording, schema.FAST, schema.error_component("theta_vt"))]
    scale = made.config.channel("theta_enc").scale
    error = (made.raw["theta_enc"].astype(float) - made.raw["theta_vt"]) * scale
    error -= 2 * np.pi * np.round(error / (2 * np.pi))
    np.testing.assert_allclose(shown, np.degrees(error), atol=1e-4)
