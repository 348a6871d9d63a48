"""A capture in rerun: its trigger is at time 0, every sample is there, and every channel has a plot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import synthetic
from made_runs import make

from bench.record.info import CAPTURE
from bench.record.reader import Run
from bench.view import schema
from bench.view.plots import waves_by_unit
from bench.view.viewing import write_rrd

N, TRIGGER = 800, 200


def test_a_capture_is_shown_whole_with_its_trigger_at_time_0(tmp_path: Path) -> None:
    values = {"i_q": np.linspace(0.0, 3.0, N), "omega_enc": np.linspace(5.0, 90.0, N), "u_dc": np.full(N, 24.0)}
    run = Run(make(tmp_path / "shot.run", values))
    ticks = run.chunk("samples").tick
    run.info.identity[CAPTURE] = {"trigger_tick": int(ticks[TRIGGER])}  # type: ignore[index]
    assert run.info.trigger_tick == ticks[TRIGGER]
    write_rrd(run, tmp_path / "shot.rrd")
    wanted = (ticks - ticks[TRIGGER]) / run.info.tick_hz
    for name, expected in values.items():
        rows = synthetic.column(tmp_path / "shot.rrd", schema.FAST, schema.value_component(name))
        np.testing.assert_allclose([at / 1e9 for at, _ in rows], wanted, atol=1e-9)
        np.testing.assert_allclose([row[0] for _, row in rows], expected, atol=2e-3)
    shown = [line.channel for plot in waves_by_unit(run.info) for line in plot.lines]
    assert sorted(shown) == sorted(values)
    assert len({plot.name for plot in waves_by_unit(run.info)}) == 3  # A, rad/s, V


def test_any_other_run_keeps_its_time(tmp_path: Path) -> None:
    run = Run(make(tmp_path / "a.run", {"i_q": np.zeros(N)}))
    assert run.info.trigger_tick is None
    write_rrd(run, tmp_path / "a.rrd")
    (at, _), *_ = synthetic.column(tmp_path / "a.rrd", schema.FAST, schema.value_component("i_q"))
    assert at == run.chunk("samples").tick[0] * 1_000_000_000 // run.info.tick_hz
