"""`bench import` of each format, made by the format's own library, and what the other commands make of the run.

The oracles are the arrays that the file was made of.
"""

from __future__ import annotations

from contextlib import nullcontext
from fractions import Fraction
from pathlib import Path

import imports_made as made
import numpy as np
import pandas as pd
import pytest

import bench
from bench.cli import main
from bench.importer.source import Table
from bench.importer.survey import ticks_of
from tests.tools import needs

MAP = {"--unit": [f"{name}={unit}" for name, unit in made.UNITS.items() if unit and name != "t"]}


def imported(file: Path, *options: str, status: int = 0) -> Path:
    out = file.with_name("x.run")
    with pytest.raises(SystemExit) if status else nullcontext():
        main(["import", str(file), "-o", str(out), "--yes", *options])
    return out


def told_units(name: str) -> list[str]:
    """Options for formats that have no units."""
    if not name.endswith((".npz", ".mat")):
        return []
    return [word for pair in MAP["--unit"] for word in ("--unit", pair)]


@pytest.fixture(scope="module", params=made.WIDE)
def wide(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("wide") / request.param
    made.WIDE[request.param](file)
    return imported(file, *told_units(file.name), *("--pole-pairs", "6"))


def test_every_value_time_and_edge_is_that_of_the_file(wide: Path) -> None:
    run, table = bench.read(wide), made.columns()
    assert len(run) == len(table["t"])
    assert np.abs(run.t - run.t[0] - table["t"]).max() < 1e-9
    assert (run.samples.raw["hall"] == table["hall"]).all()
    for name, values in made.in_si().items():
        error = run[name] - values
        error = np.angle(np.exp(1j * error)) if name == "theta_enc" else error
        assert np.abs(error).max() <= 2e-9 * np.abs(values).max(), name
    at = np.flatnonzero(np.diff(table["hall"])) + 1
    assert (run.edges.tick == run.samples.tick[at]).all()
    assert (run.edges.hall_old == table["hall"][at - 1]).all()
    assert (run.edges.hall_new == table["hall"][at]).all()
    assert not run.flaws()
    assert run.edge_step == pytest.approx(1 / 16_000, rel=1e-6)


def test_the_other_commands_take_it(wide: Path, tmp_path: Path) -> None:
    direct = bench.capture(made.columns()["t"], {**made.in_si(), "hall": made.columns()["hall"]}, n_p=6)
    health, wanted = bench.hall(wide), bench.hall(direct)
    assert (health.verdict, health.missing) == (wanted.verdict, wanted.missing)
    assert [finding.cause for finding in health.findings] == [finding.cause for finding in wanted.findings]
    assert health.measured.ring == pytest.approx(wanted.measured.ring, abs=1e-6)
    scored, like = (bench.score(run, observers=["average_speed", "sector_centre"]).pooled for run in (wide, direct))
    for name, figures in like.items():
        assert scored[name]["moving"]["rms"] == pytest.approx(figures["moving"]["rms"], abs=1e-4)
    assert bench.compare(wide, direct).rows
    assert bench.plot(wide)["hall_edges"].figure is not None
    bench.export(wide, tmp_path / "back.csv")
    back, table = pd.read_csv(tmp_path / "back.csv"), made.columns()
    assert np.abs(back["i_a [A]"] - table["i_a"] * 1e-3).max() < 2e-9 * np.abs(table["i_a"]).max()
    assert (back["hall"] == table["hall"]).all()


@pytest.mark.parametrize("name", made.LOGIC)
def test_lines_of_a_logic_analyser_keep_the_times_of_their_changes(tmp_path: Path, name: str) -> None:
    make, late = made.LOGIC[name]
    make(tmp_path / name)
    options = ("--hall", "D0,D1,D2") if name != "digital.csv" else ()
    check_edges(imported(tmp_path / name, *options), late)


@needs("sigrok-cli")
def test_a_session_by_sigrok_itself(tmp_path: Path) -> None:
    made.by_sigrok_cli(tmp_path / "halls.sr")
    check_edges(imported(tmp_path / "halls.sr"), 1e-6)


def check_edges(path: Path, late: float) -> None:
    run = bench.read(path)
    ns, codes = made.changes()
    assert (run.edges.hall_new == codes[1:]).all()
    assert (run.edges.hall_old == codes[:-1]).all()
    apart = run.edge_t - run.edge_t[0] - (ns[1:] - ns[1]) * 1e-9
    assert np.abs(apart).max() <= late
    sampled = codes[np.searchsorted(ns, np.rint((run.t - run.edge_t[0]) * 1e9) + ns[1] + 1, "right") - 1]
    assert np.mean(sampled == run.samples.raw["hall"]) > 0.999  # one may lie on an edge
    assert not run.flaws()
    health, wanted = bench.hall(path), bench.hall(bench.capture(10_000.0, {}, edges=(ns * 1e-9, codes)))
    assert (health.verdict, [f.cause for f in health.findings]) == (wanted.verdict, [f.cause for f in wanted.findings])


@pytest.mark.parametrize("name", made.CAN)
def test_a_log_of_a_bus_with_its_dbc(tmp_path: Path, name: str) -> None:
    made.can_log(tmp_path / name)
    run = bench.read(imported(
        tmp_path / name, "--dbc", str(tmp_path / name.replace(name.rpartition(".")[2], "dbc")),
        "--channel", "theta_enc=theta:el deg", "--hall", "hall", "--pole-pairs", "6",
    ))  # fmt: skip
    table = made.columns(16)
    t = run.t - run.t[0]
    at = np.rint(t * 1000).astype(int)
    assert len(run) > 0.98 * len(table["t"])
    assert np.abs(t - at / 1000).max() < 1.1e-4  # a .trc has 0.1 ms
    assert (run.samples.raw["hall"] == table["hall"][at]).all()
    error = np.angle(np.exp(1j * (run["theta_enc"] - np.radians(table["theta"][at]))))
    assert np.abs(error).max() < np.radians(0.006)
    every = run["i_a"][::10]
    assert np.nanmax(np.abs(every - table["i_a"][at][::10] * 1e-3)) < 0.6e-3


@pytest.mark.parametrize(
    ("rate", "rows"), [(47_952.047952, 10**7), (30_000.0, 10**9), (0.001, 10**6), (1e11 / 3, 10**9)]
)
def test_times_by_a_rate_are_exact_however_many_rows_there_are(rate: float, rows: int) -> None:
    exact, tick_hz = Fraction(rate).limit_denominator(1000), 2_000_000_000
    for row in (0, rows):
        ticks, _ = ticks_of(Table("", (), None, rate), {"a": np.zeros(3)}, row, 1.0, tick_hz, 0.0)
        assert [abs(int(tick) - k * tick_hz / exact) <= 0.5 for k, tick in enumerate(ticks, row)] == [True] * 3
