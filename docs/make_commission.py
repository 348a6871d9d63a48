"""Commissions the simulated drive on the unkind bench and makes the pictures of docs/commission.md.

python docs/make_commission.py      (needs Chromium, which draws the report without a screen)

The same version gives the same pictures again, but for date and time in the report.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

PICTURES = Path(__file__).with_name("commission")
STEPS = ("resistance", "spin")
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
WIDTH, HEIGHT = 1200, 1560  # px: as far as the table goes


def main() -> None:
    """Commission, draw, keep."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report"
        options = ("--config", "bench24v", "--operator", "A. Person", "--voltmeter", "24:0.1%")
        command = [sys.executable, "-m", "bench", "commission", "sim", *options, "--report", str(report)]
        subprocess.run(command, stdin=subprocess.DEVNULL, check=True)
        for step in STEPS:
            shutil.copy(report / f"{step}.png", PICTURES)
        screenshot(report / "report.html", PICTURES / "report.png", Path(folder))


def screenshot(page: Path, png: Path, folder: Path) -> None:
    """The top of a page, as a browser draws it."""
    browser = next(name for name in BROWSERS if shutil.which(name))
    options = ("--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", f"--user-data-dir={folder}/profile")
    size = f"--window-size={WIDTH},{HEIGHT}"
    drawn = folder / "drawn.png"
    subprocess.run([browser, *options, size, f"--screenshot={drawn}", page.as_uri()], check=True, capture_output=True)
    few = Image.open(drawn).convert("RGB").quantize(256, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    few.save(png, "PNG")


if __name__ == "__main__":
    main()
