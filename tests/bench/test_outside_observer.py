"""An observer from another package is seen wherever one of ours is: docs/examples/own_observer, installed."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from processes import ENVIRONMENT, LIMIT

from bench.record.reader import Run
from bench.signal.position import states
from bench.view import plots
from protocol.codes import DriveState
from protocol.signals import OTHER_SOURCE, STATUS_SOURCE_SHIFT, Status

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "docs" / "examples" / "own_observer"
NAME, SHORT = "smoothed_average", "sm"
PAGE = f"""
import json, sys
sys.path.insert(0, {str(ROOT / "docs")!r})
import make_observers
from observers import figures
numbers = json.loads(make_observers.NUMBERS.read_text())
for table in ("board", "by_speed"):
    numbers[table][{NAME!r}] = numbers[table]["average_speed"]
print(make_observers.page(numbers))
figures.by_speed(numbers)
"""


SPIN = "live sim --speed 500 --viewer none"
COMMANDS = f"""
from bench.cli import main
for line in (
    "{SPIN} --observer {NAME.replace("_", "-")} --estimate {SHORT} --duration 3 --save a.run",
    "{SPIN} --duration 2 --save b.run",
    "replay --list --json list.json",
    "replay b.run --observer {NAME} -o c.run",
    "score b.run --json score.json",
):
    try:
        main(line.split())
    except SystemExit as ended:
        assert not ended.code, (line, ended.code)
"""


@dataclass
class Site:
    """A folder of installed packages in which the example is one, and another that is broken."""

    folder: Path

    def python(self, program: str) -> str:
        env = ENVIRONMENT | {"PYTHONPATH": os.pathsep.join([str(self.folder), str(ROOT)])}
        command = [sys.executable, "-c", program]
        ran = subprocess.run(command, cwd=self.folder, capture_output=True, text=True, timeout=3 * LIMIT, env=env)
        assert ran.returncode == 0, ran.stdout + ran.stderr
        return ran.stdout

    @property
    def run(self) -> Run:
        return Run(self.folder / "a.run")


pytestmark = [pytest.mark.long("five seconds of a drive in real time")]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Site:
    """With a recording a.run of the simulated drive, controlled by the observer, which runs on the host as well."""
    folder = tmp_path_factory.mktemp("site")
    points = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]["entry-points"]["hallbench.observers"]
    metadata = folder / "smoothed_average-0.1.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: smoothed-average\nVersion: 0.1\n")
    lines = [f"{name} = {value}\n" for name, value in {**points, "gone": "no_such_module:OBSERVER"}.items()]
    (metadata / "entry_points.txt").write_text("[hallbench.observers]\n" + "".join(lines))
    shutil.copy(EXAMPLE / "smoothed_average.py", folder)
    made = Site(folder)
    made.python(COMMANDS)
    return made


def test_it_takes_60_lines() -> None:
    assert len((EXAMPLE / "smoothed_average.py").read_text().splitlines()) <= 60


def test_it_controls_the_simulated_drive(site: Site) -> None:
    samples = site.run.samples
    late = np.flatnonzero(states(samples) == DriveState.RUNNING)[-8000:]  # the drive's own observer comes back after
    assert (samples.raw["status"][late] >> STATUS_SOURCE_SHIFT == OTHER_SOURCE).all()
    assert samples.physical("omega_enc")[late].mean() == pytest.approx(500 * 2 * np.pi / 60 * 6, rel=0.05)
    error = samples.physical("theta_enc") - samples.physical(f"theta_{SHORT}")
    smoothed, plain = (
        np.degrees(np.angle(np.exp(1j * e))).std()
        for e in (error[late], (samples.physical("theta_enc") - samples.physical("theta_avg"))[late])
    )
    assert 0.1 < smoothed < plain


def test_live_on_the_host_it_gives_the_drives_bits(site: Site) -> None:
    raw = site.run.samples.raw
    started = int(np.flatnonzero(raw["status"] & Status.OBSERVERS_RESET)[-1])
    for what in ("theta", "omega"):
        own, host = raw[f"{what}_{SHORT}"][started:], raw[f"{what}_{SHORT}_host"][started:]
        assert np.array_equal(own, host)
        assert len(np.unique(own)) > 100


def test_replay_and_score_know_it_and_say_which_cannot_be_used(site: Site) -> None:
    listed = {row["observer"]: row for row in json.loads((site.folder / "list.json").read_text())}
    assert listed[NAME]["short"] == SHORT
    assert "No module named 'no_such_module'" in listed["gone"]["source"]
    assert f"theta_{SHORT}_host" in Run(site.folder / "c.run").samples.raw.dtype.names
    scored = json.loads((site.folder / "score.json").read_text())["observers"]
    assert scored[NAME]["kind"] == "host"
    assert 0.0 < scored[NAME]["moving"]["rms"] < scored["average_speed"]["moving"]["rms"]


def test_the_dashboard_draws_it_in_a_colour_of_its_own(site: Site) -> None:
    info = site.run.info
    lines = {line.channel: line for line in plots.plots(info)["error"].lines}
    colours = [line.colour for line in lines.values()]
    assert lines[f"theta_{SHORT}"].error
    assert len(set(colours)) == len(colours)


def test_the_docs_table_has_a_row_of_it(site: Site) -> None:
    page = site.python(PAGE)
    (row,) = (line for line in page.splitlines() if line.startswith(f"| {NAME} |"))
    assert row.count("|") > 10
