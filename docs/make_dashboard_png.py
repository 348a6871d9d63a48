"""Records the simulated drive and draws docs/dashboard*.png from the recordings, in rerun's headless viewer.

python docs/make_dashboard_png.py      (needs a Vulkan driver; Mesa's, which draws without a GPU, will do)

`dashboard.png`: the show with a load of 4 A, at 1920x1080. `dashboard-rest.png`: a drive at rest, as a laptop shows it,
at 1366x768. `dashboard-last-second.png`: the second page at 3000 r/min.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from rerun.experimental import ViewerClient

from bench.record.reader import Run
from bench.view.viewer import HOST, binary, free_port
from bench.view.viewing import write_rrd


@dataclass(frozen=True)
class Picture:
    """A page of the dashboard, of what `bench live` records with these options, up to `moment` s after its start."""

    name: str
    options: tuple[str, ...]
    moment: float
    page: int
    size: str


PICTURES = (
    Picture("dashboard.png", (), 14.0, 0, "1920x1080"),
    Picture("dashboard-rest.png", ("sim", "--duration", "4"), 3.5, 0, "1366x768"),
    Picture(
        "dashboard-last-second.png", ("sim", "--speed", "3000", "--load", "2", "--duration", "6"), 5.5, 1, "1366x768"
    ),
)


def main() -> None:
    """Record, draw, save."""
    with tempfile.TemporaryDirectory() as folder:
        for picture in PICTURES:
            recording, rrd = Path(folder, f"{picture.name}.run"), Path(folder, f"{picture.name}.rrd")
            command = [sys.executable, "-m", "bench", "live", *picture.options, "--viewer", "none"]
            subprocess.run([*command, "--save", str(recording)], stdin=subprocess.DEVNULL, check=True)
            run = Run(recording)
            last = run.span[0] + round(picture.moment * run.info.tick_hz)
            write_rrd(run, rrd, last=last, page=picture.page)
            draw(rrd, Path(__file__).with_name(picture.name), picture.size)


def draw(rrd: Path, png: Path, size: str) -> None:
    """Let the viewer draw a file."""
    port = free_port(9990)
    arguments = ["--headless", "--bind", HOST, "--port", str(port), "--hide-welcome-screen", "--window-size", size]
    viewer = subprocess.Popen([str(binary()), *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        client = connected(port)
        client.open(str(rrd))
        while (state := client.get_state()).loading or not (state.recordings and state.recordings[0].timelines):
            time.sleep(0.1)
        time.sleep(4.0)  # for the views to follow, and for what the viewer says of itself to go away
        client.save_screenshot(str(png))
    finally:
        viewer.kill()
        viewer.wait()


def connected(port: int) -> ViewerClient:
    """A client of the viewer that listens there, once it does."""
    while True:
        try:
            return ViewerClient.connect(f"rerun+http://{HOST}:{port}/proxy")
        except ConnectionError:
            time.sleep(0.1)


if __name__ == "__main__":
    main()
