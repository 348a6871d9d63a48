"""docs/notebook.md: its blocks run as they stand, one after the other, and say what the page says."""

from __future__ import annotations

import ast
import inspect
import math
import re
import textwrap
from functools import cached_property
from pathlib import Path
from typing import Any
from unittest.mock import patch

import matplotlib as mpl
import numpy as np
import pytest
from scipy.io import loadmat
from virtual_run import WatchedLink, at_rest, physical

import bench
from bench.compare.compare import Comparison
from bench.export.export import Exported
from bench.findings.health import Health
from bench.measure.measure import Statistics
from bench.param.table import Parameters
from bench.plot.plot import Plot
from bench.rig.drive import Drive
from bench.rig.loads import Load
from bench.rig.notebook import Simulated
from bench.rig.played import Played
from bench.score.board import Scoreboard
from bench.signal import waveforms
from bench.signal.verdict import Verdict
from protocol.messages import DriveState

pytestmark = pytest.mark.slow

PAGE = (Path(__file__).parents[2] / "docs" / "notebook.md").read_text()


def test_the_page_as_it_is_printed(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("BENCH_TARGET", raising=False)
    blocks = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    fences = re.findall(r"^```(\w+)$", PAGE, re.MULTILINE)
    assert (set(fences), len(blocks)) == ({"sh", "python", "pyi"}, fences.count("python"))
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
    assert set(cells["recording"].events["name"]) == {"STATE_CHANGED"}
    assert cells["longest"] == len(cells["recording"].samples) == len(cells["whole"])
    assert cells["health"].verdict is Verdict.INVALID
    assert printed.count("INVALID [] ('only ") == 1
    assert cells["differences"].loc["i_q", "verdict"] == "differs"
    assert set(cells["plots"]) == {"spectrum", "error_by_angle", "error_by_speed", "current_plane", "hall_edges"}
    assert Path("spectrum.png").stat().st_size > 10_000
    assert loadmat("run.mat")["samples"]["i_q"][0, 0].ravel() == pytest.approx(cells["run"]["i_q"])
    assert cells["table"].num_rows == len(cells["frame"]) == len(cells["run"])
    assert re.search(r"^dashboard: http://127\.0\.0\.1:\d+/\?url=", printed, re.MULTILINE)


SIGNATURES = [node for block in re.findall(r"```pyi\n(.*?)```", PAGE, re.DOTALL) for node in ast.parse(block).body]
CLASSES = (Comparison, Drive, Exported, Health, Load, Parameters, Played, Plot, Scoreboard, Simulated, Statistics)
HOMES = {cls.__name__: cls for cls in CLASSES}


def home(name: str) -> Any:
    """What the page calls so."""
    if name in HOMES:
        return HOMES[name]
    return getattr(bench, name) if name in bench.__all__ else getattr(waveforms, name)


def tree_of(thing: Any) -> Any:
    """The source of a function or class; defaults that name a constant of its module have the constant's value."""
    tree: Any = ast.parse(textwrap.dedent(inspect.getsource(thing))).body[0]
    if isinstance(tree, ast.FunctionDef):
        tree.args.defaults = [
            ast.Constant(eval(ast.unparse(default), thing.__globals__))
            if any(isinstance(part, ast.Name) for part in ast.walk(default))
            else default
            for default in tree.args.defaults
        ]
    return tree


def signature(function: ast.FunctionDef) -> str:
    assert function.returns is not None
    return f"{function.name}({ast.unparse(function.args)}) -> {ast.unparse(function.returns)}"


def members(cls: type) -> dict[str, str]:
    """Fields, properties and methods of a class and of what it inherits from, as the page writes them."""
    found: dict[str, str] = {}
    for base in reversed([base for base in cls.__mro__ if base.__module__.startswith("bench.")]):
        for node in tree_of(base).body:
            if isinstance(node, ast.AnnAssign):
                found[ast.unparse(node.target)] = ast.unparse(node)
            elif isinstance(node, ast.FunctionDef):
                is_value = isinstance(inspect.getattr_static(cls, node.name), property | cached_property)
                returned = node.returns and ast.unparse(node.returns)
                found[node.name] = f"{node.name}: {returned}" if is_value else signature(node)
    return found


@pytest.mark.parametrize("node", SIGNATURES, ids=lambda node: node.name)
def test_a_signature_of_the_page_is_that_of_the_code(node: ast.FunctionDef | ast.ClassDef) -> None:
    if isinstance(node, ast.FunctionDef):
        assert signature(node) == signature(tree_of(home(node.name)))
        return
    known = members(home(node.name))
    for part in node.body:
        if isinstance(part, ast.FunctionDef):
            assert signature(part) == known[part.name]
        else:
            assert isinstance(part, ast.AnnAssign)
            text, name = ast.unparse(part), ast.unparse(part.target)
            assert text == known[name] or (text == known[name].partition(" = ")[0] and node.name == "Capture")


def test_the_page_has_the_signatures_of_everything_that_is_public() -> None:
    named = {node.name: node for node in SIGNATURES}
    elsewhere = {"BenchError", "DriveTripped", "Settings", "__version__", "REVERSE", "FORWARD"}
    assert {*bench.__all__, *waveforms.__all__} - elsewhere <= named.keys()
    for name, node in named.items():
        if not isinstance(node, ast.ClassDef) or not (name == "Capture" or name in waveforms.__all__):
            continue
        public = {key for key in members(home(name)) if not key.startswith("_")}
        parts = {
            part.name if isinstance(part, ast.FunctionDef) else ast.unparse(part.target)  # type: ignore[attr-defined]
            for part in node.body
        }
        assert public <= parts, name
