"""Records the show on the simulated drive and draws docs/dashboard.png from the recording, in rerun's headless viewer.

python docs/make_dashboard_png.py      (needs a Vulkan driver; Mesa's, which draws without a GPU, will do)
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from rerun.experimental import ViewerClient

from bench.rerunio.viewer import binary, free_port

MOMENT = 14.0  # s after the first sample: 500 r/min and 4 A, controlled by the vector-tracking observer


def main() -> None:
    """Record, draw, save."""
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder, "show.rrd")
        subprocess.run(
            [sys.executable, "-m", "bench", "live", "--viewer", "none", "--save", str(recording)],
            stdin=subprocess.DEVNULL,
            check=True,
        )
        port = free_port(9990)
        options = {"hide_welcome_screen": True, "memory_limit": "2GB", "executable_path": str(binary())}
        with ViewerClient.spawn(headless=True, port=port, **options) as viewer:
            viewer.open(str(recording))
            while (state := viewer.get_state()).loading or not (state.recordings and state.recordings[0].timelines):
                time.sleep(0.1)
            first = state.recordings[0].timelines[0].start / 1e9
            viewer.set_time("device_time", duration=first + MOMENT, play_state="paused")
            time.sleep(2.0)  # for the views to follow
            viewer.save_screenshot(str(Path(__file__).with_name("dashboard.png")))


if __name__ == "__main__":
    main()
