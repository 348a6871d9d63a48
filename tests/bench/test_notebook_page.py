"""docs/notebook.md: its blocks run as they stand, one after the other, and say what the page says."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any
from unittest.mock import patch

import matplotlib as mpl
import numpy as np
import pytest
from virtual_run import WatchedLink, at_rest, physical

from protocol.messages import DriveState

PAGE = (Path(__file__).parents[2] / "docs" / "notebook.md").read_text()


def test_the_page_as_it_is_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("BENCH_TARGET", raising=False)
    blocks = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    assert len(blocks) == PAGE.count("```") // 2 - 1  # one is for the shell
    cells: dict[str, Any] = {}
    link = WatchedLink(physical())
    with (
        mpl.rc_context({"backend": "agg"}),
        patch("bench.rig.connection.open_link", {"serial:/dev/ttyACM0": link}.__getitem__),
    ):
        for block in blocks:
            exec(block, cells)
        (axes,) = cells["plt"].gcf().axes
        cells["plt"].close("all")
    printed = capsys.readouterr().out

    assert f"shows `{cells['run']!r}`" in PAGE
    omega_e = 6 * 500 * math.tau / 60
    for name in ("run", "mine"):
        assert cells[name]["omega_enc"].mean() == pytest.approx(omega_e, rel=3e-3)
    assert re.search(r"^(499|500)\.\d r/min, i_q = \d\.\d\d A$", printed, re.MULTILINE)
    assert [line.get_ydata().tolist() for line in axes.lines] == [
        cells["turn"][phase].tolist() for phase in ("i_a", "i_b", "i_c")
    ]
    assert abs(sum(np.asarray(line.get_ydata()).mean() for line in axes.lines)) < 0.1
    step = cells["step"]
    assert step["omega_enc"][:1000].mean() == pytest.approx(0.6 * omega_e, rel=0.02)
    assert step["omega_enc"][-1000:].mean() > 1.5 * omega_e
    pooled = cells["board"].pooled
    assert {"drive_vt", "replayed_vt", "vector_tracking"} <= set(pooled)
    assert pooled["replayed_vt"]["moving"]["rms"] > pooled["vector_tracking"]["moving"]["rms"]
    for name, figures in pooled.items():
        assert re.search(rf"^{name} +{figures['moving']['rms']:.3f}° rms$", printed, re.MULTILINE)
    assert DriveState.RUNNING in link.states
    assert at_rest(link.device)
    assert cells["table"].num_rows == len(cells["frame"]) == len(cells["run"])
    assert re.search(r"^dashboard: http://127\.0\.0\.1:\d+/\?url=", printed, re.MULTILINE)
