"""The dashboard of real recordings, drawn: every view that should have data shows it, and no other does.

Recorded on the simulated drive, cut off while it still turns, drawn by rerun's viewer. What is looked for in the
pictures is the colours of lines, bars and arrows, beside the legends.
"""

from __future__ import annotations

import io
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from virtual_run import WatchedLink, run, simulated

from bench.record.info import RunInfo
from bench.record.reader import Run
from bench.signal.colours import BAD, GOOD, QUIET, RGB
from bench.view.dashboard import SECOND_NAMES
from bench.view.last_second import WAYS
from bench.view.plots import BUS, plots
from bench.view.viewing import write_rrd
from tests.choice import sampled
from tests.tools import needs
from tests.viewers import TIMEOUT, HeadlessViewer, headless

pytestmark = [pytest.mark.long("rerun's viewer draws in software")]

CLOSE_UP = "Last electrical revolution"
SPEEDS = (0, 100, 1000, 3000)  # r/min
SECONDS = {100: 3.0}
BESIDE_LEGENDS = 0.38  # of a view's width, from where on it is looked at
NEAR = 40  # by which each part of a colour may be off: lines are drawn with soft edges
ENOUGH = 60  # pixels
TEXT = (200, 200, 200)
FIRST_PAGE = ("error_trend", "speed", "dq")  # plots that no tab hides
CLOSE_UPS = ("position", "error", "phases", "bus_wave")


@pytest.fixture(scope="module", params=sampled("speed", SPEEDS, 1, campaign="viewer"))
def turning(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[int, Path]:
    """A recording at this speed."""
    speed: int = request.param
    path = tmp_path_factory.mktemp("turning") / f"{speed}.run"
    ended = run(WatchedLink(simulated()), speed_rpm=speed or None, duration=SECONDS.get(speed, 1.5), save=path)
    assert ended.exit_code == 0, ended.summary.result
    return speed, path


@dataclass
class Page:
    """A page of the dashboard as it is drawn."""

    viewer: HeadlessViewer

    def picture(self, title: str) -> np.ndarray:
        """The view that has this title, up to a comma, and is not behind a tab: (height, width, 3)."""
        for view in self.viewer.client.get_state().views:
            if view.name.split(",")[0] == title.split(",")[0]:
                with suppress(ConnectionError):  # behind a tab, or of a layout that has been replaced
                    png = self.viewer.client.take_screenshot(view.view_id)
                    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)
        return np.zeros((1, 1, 3), int)

    def shows(self, title: str, colours: Iterable[RGB], beside: float = 0.0, n: int = ENOUGH) -> bool:
        """Whether the view comes to show one of these colours, right of a share of its width."""
        end = time.monotonic() + TIMEOUT
        while time.monotonic() < end:
            picture = self.picture(title)
            if any(seen(picture, colour, beside) >= n for colour in colours):
                return True
        return False


@contextmanager
def page(recording: Path, number: int, folder: Path) -> Iterator[Page]:
    """A page of the dashboard of a recording, before the motor is stopped."""
    whole = Run(recording)
    rrd = folder / f"{number}.rrd"
    write_rrd(whole, rrd, last=whole.span[0] + round(0.85 * (whole.span[1] - whole.span[0])), page=number)
    with headless("--window-size", "1366x768") as viewer:
        viewer.client.open(str(rrd))
        viewer.await_recording()
        yield Page(viewer)


def seen(picture: np.ndarray, colour: RGB, beside: float) -> int:
    """How many pixels right of this share of the width have about this colour."""
    looked_at = picture[:, round(beside * picture.shape[1]) :]
    return int((np.abs(looked_at - np.array(colour)).max(axis=2) <= NEAR).sum())


def all_drawn(drawn: Page, info: RunInfo, keys: Iterable[str], view: str = "") -> None:
    """The lines of these plots are seen, each in its own view, or all in this one."""
    for plot in (plots(info)[key] for key in keys):
        assert drawn.shows(view or plot.name, [line.colour for line in plot.lines], BESIDE_LEGENDS), plot.name


@needs("Vulkan driver")
def test_every_plot_of_the_first_page_shows_data(turning: tuple[int, Path], tmp_path: Path) -> None:
    speed, recording = turning
    info = Run(recording).info
    with page(recording, 0, tmp_path) as drawn:
        all_drawn(drawn, info, FIRST_PAGE)
        assert drawn.shows("Drive", [GOOD if speed else QUIET])
        assert drawn.shows("Stator plane", [info.colours["theta_enc"]], 0.5)
        all_drawn(drawn, info, CLOSE_UPS, CLOSE_UP)
        assert drawn.shows(CLOSE_UP, [(150, 150, 150)], BESIDE_LEGENDS)
        assert drawn.shows("Losses; summary at the end", [TEXT])
        assert seen(drawn.picture("Drive"), BAD, 0.0) == 0


@needs("Vulkan driver")
def test_the_second_page_shows_what_is_defined_and_nothing_else(turning: tuple[int, Path], tmp_path: Path) -> None:
    speed, recording = turning
    colours = Run(recording).info.colours
    bars = {"by_angle": colours["theta_avg"], "harmonics": colours["i_a"], "late": WAYS["forward"]}
    with page(recording, 1, tmp_path) as drawn:
        assert drawn.shows("In numbers", [TEXT])
        assert drawn.shows("Current vector", [colours["i_q"]], n=10)
        assert drawn.shows(BUS, [colours["u_dc"]], BESIDE_LEGENDS)
        for view, colour in bars.items():
            if speed:
                assert drawn.shows(SECOND_NAMES[view], [darker(colour)], 0.08), view
            else:
                assert seen(drawn.picture(SECOND_NAMES[view]), darker(colour), 0.08) < ENOUGH / 2, view


@needs("Vulkan driver")
def test_the_third_page_shows_every_sample_of_the_last_moments(turning: tuple[int, Path], tmp_path: Path) -> None:
    _, recording = turning
    with page(recording, 2, tmp_path) as drawn:
        all_drawn(drawn, Run(recording).info, CLOSE_UPS)
        assert drawn.shows("Hall sensors and sector", [(150, 150, 150)])


def darker(colour: RGB) -> RGB:
    """As rerun fills a bar."""
    red, green, blue = (8 * part // 10 for part in colour)
    return red, green, blue
