"""Draws the pictures of docs/figures.md from recordings that are kept.

python docs/make_figures.py
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

DOCS = Path(__file__).parent
RUNS = DOCS.parent / "tests" / "data"
SHOWN = {"spectrum": "steady", "error_by_angle": "reversal"}
"""Figures, and the recordings that they are of."""
COLOURS = 64  # of a figure on the page


def main() -> None:
    """Draw, shrink, write."""
    for name, run in SHOWN.items():
        with tempfile.TemporaryDirectory() as folder:
            command = ["bench", "plot", str(RUNS / f"{run}.run"), "--out", folder]
            subprocess.run([sys.executable, "-m", *command], check=True)
            picture = Image.open(Path(folder, f"{name}.png")).convert("RGB")
        target = DOCS / "figures" / f"{name}.png"
        target.parent.mkdir(exist_ok=True)
        picture.quantize(COLOURS, dither=Image.Dither.NONE).save(target, optimize=True)


if __name__ == "__main__":
    main()
