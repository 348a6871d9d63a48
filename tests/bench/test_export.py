"""Exports opened again by pandas, asammdf, scipy, numpy, pyarrow and rerun: all values, units and times equal.

The oracle is the stored Parquet, read by pyarrow and multiplied here.
"""

from __future__ import annotations

import json
import math
import os
import resource
import shutil
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import asammdf
import duckdb
import exported
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from damage import flip
from made_runs import make
from processes import ENVIRONMENT, LIMIT
from scipy.io import loadmat

from bench.cli import main
from bench.errors import BenchError
from bench.export import ENDINGS, memory, to_mat
from bench.export.export import export
from bench.record import layout
from bench.record.reader import Run
from bench.record.writer import RunWriter
from tests.bench.view import synthetic
from tests.choice import sampled

KEPT = Path(__file__).parents[1] / "data" / "steady.run"
STREAMS = ("samples", "edges", "node2-stream0")

EXACT: Any = {} if tuple(map(int, pd.__version__.split(".")[:2])) >= (3, 1) else {"float_precision": "round_trip"}
"""What has pandas read numbers to the last bit: newer ones do anyway."""

Read = Callable[[Path, str], dict[str, tuple[np.ndarray, str | None]]]
"""Columns of a stream, and units: of an export, by a reader that knows nothing of ours. None: it tells no units."""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exported.record(tmp_path_factory.mktemp("made") / "a.run")


# -- readers --------------------------------------------------------------------------------------------------------


def table_file(out: Path, stream: str) -> Path:
    return out if stream == "samples" else out.with_name(f"{out.stem}-{stream}{out.suffix}")


def split(header: str) -> tuple[str, str]:
    name, bracket, unit = header.partition(" [")
    return name, unit.removesuffix("]") if bracket else ""


def by_pandas_csv(out: Path, stream: str) -> dict[str, tuple[np.ndarray, str | None]]:
    frame = pd.read_csv(table_file(out, stream), keep_default_na=False, na_values=["nan"], **EXACT)
    assert "bool" not in map(str, frame.dtypes)  # no "true"
    return {split(header)[0]: (frame[header].to_numpy(), split(header)[1]) for header in frame}


def by_pyarrow(out: Path, stream: str) -> dict[str, tuple[np.ndarray, str | None]]:
    table = pq.read_table(table_file(out, stream))
    return {
        field.name: (column.to_numpy(), field.metadata[b"unit"].decode())
        for field, column in zip(table.schema, table.columns, strict=True)
    }


def by_asammdf(out: Path, stream: str) -> dict[str, tuple[np.ndarray, str | None]]:
    with asammdf.MDF(out) as mdf:
        (number,) = (k for k, group in enumerate(mdf.groups) if group.channel_group.acq_name == stream)
        found: dict[str, tuple[np.ndarray, str | None]] = {}
        for k, channel in enumerate(mdf.groups[number].channels):
            signal = mdf.get(group=number, index=k)
            found[channel.name] = signal.samples, signal.unit
            assert (signal.timestamps == found["time"][0]).all()
        return found


def by_scipy(out: Path, stream: str) -> dict[str, tuple[np.ndarray, str | None]]:
    name = stream.replace("-", "_")
    whole = loadmat(out, simplify_cells=True)
    renamed = json.loads(whole["about"])["renamed"]
    units = whole["units"][name]  # an empty text is read as an empty array
    return {
        renamed.get(f"{name}.{field}", field): (np.atleast_1d(values), units[field] if len(units[field]) else "")
        for field, values in whole[name].items()
    }


def by_numpy(out: Path, stream: str) -> dict[str, tuple[np.ndarray, str | None]]:
    with np.load(out, allow_pickle=False) as whole:
        units = json.loads(str(whole["units"]))
        prefix = f"{stream}/"
        return {k.removeprefix(prefix): (whole[k], units[k]) for k in whole.files if k.startswith(prefix)}


READERS: dict[str, Read] = {
    ".csv": by_pandas_csv, ".parquet": by_pyarrow, ".mf4": by_asammdf, ".mat": by_scipy, ".npz": by_numpy,
}  # fmt: skip


@pytest.fixture(scope="module", params=READERS)
def whole(request: pytest.FixtureRequest, made: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run in each format."""
    out = tmp_path_factory.mktemp("whole") / f"x{request.param}"
    export(Run(made), out)
    return out


def same(found: np.ndarray, wanted: np.ndarray) -> bool:
    """To the last bit; nan is nan."""
    return bool(np.array_equal(found.astype(np.float64), wanted.astype(np.float64), equal_nan=True))


def require_equal(run: Path, out: Path, streams: tuple[str, ...]) -> None:
    for stream in streams:
        found, wanted = READERS[out.suffix](out, stream), exported.expected(run, stream)
        assert list(found) == list(wanted)
        for name, (values, unit) in wanted.items():
            assert same(found[name][0], values), (stream, name)
            assert found[name][1] in (unit, None), (stream, name)
        assert np.rint(found["time"][0] * exported.TICK_HZ).astype(np.int64).tolist() == wanted["tick"][0].tolist()


# -- values ---------------------------------------------------------------------------------------------------------


def test_every_value_unit_and_time_is_equal(made: Path, whole: Path, tmp_path: Path) -> None:
    require_equal(made, whole, STREAMS)
    export(Run(KEPT), tmp_path / whole.name)
    require_equal(KEPT, tmp_path / whole.name, STREAMS[:2])


def test_rerun_has_the_samples_and_the_edges(tmp_path: Path) -> None:
    """In a viewer's float32, at the same nanosecond."""
    out = tmp_path / "x.rrd"
    export(Run(KEPT), out)
    for stream, kind, names in (
        ("samples", "value", ("i_a", "i_q", "omega_vt")),
        ("edges", "edge", ("hall_new", "encoder")),
    ):
        wanted = exported.expected(KEPT, stream)
        for name in names:
            times, values = zip(*synthetic.column(out, stream, f"{kind}:{name}"), strict=True)
            assert list(times) == (wanted["tick"][0] * 50).tolist()
            assert np.array(values).ravel().tolist() == wanted[name][0].astype(np.float32).tolist()


# -- what was said --------------------------------------------------------------------------------------------------

AT_END = exported.at(75) - exported.EVERY * exported.TICKS
FIRST = exported.START * exported.TICKS
MARKED: list[tuple[int, int, str, int, str, float, float, str]] = [
    (FIRST - 500, FIRST - 500, "event", 1, "STATE_CHANGED", 3.0, 0.25, ""),
    (FIRST + 5 * exported.TICKS, FIRST + 5 * exported.TICKS, "heartbeat", 1, "", math.nan, math.nan, "…"),
    (AT_END, AT_END, "parameter", 1, "k_p", math.inf, math.nan, ""),
    (AT_END, AT_END, "note", 0, "WARN", math.nan, math.nan, exported.NOTE),
    (exported.at(10), exported.at(20), "mark", 0, "step.rise", math.nan, math.nan, "FAIL"),
    (exported.at(5), exported.at(6), "mark", 0, "by hand", math.nan, math.nan, ""),
    (AT_END, AT_END, "missing", 2, "samples", 4.0, math.nan, ""),
    (AT_END, AT_END, "missing", 2, "edges", 1.0, math.nan, ""),
]
NAMES = ("tick", "until_tick", "kind", "node", "name", "value", "detail", "text")


def texts(values: np.ndarray) -> list[str]:
    """Of any reader: an empty text may be none at all."""
    plain = [value.decode() if isinstance(value, bytes) else value for value in values.tolist()]
    return ["" if value is None or value is np.ma.masked or len(value) == 0 else str(value) for value in plain]


def test_marks_and_all_that_was_said_come_along(whole: Path) -> None:
    found = READERS[whole.suffix](whole, "marks")
    wanted = sorted(MARKED, key=lambda row: row[0]) if whole.suffix == ".mf4" else MARKED
    for name, column in zip(NAMES, zip(*wanted, strict=True), strict=True):
        values = found[name][0]
        if name == "text":
            told = texts(values)
            beat = [row[2] for row in wanted].index("heartbeat")
            assert json.loads(told[beat])["tx_dropped"] == exported.HEARTBEAT.tx_dropped
            assert [text for k, text in enumerate(told) if k != beat] == [
                text for k, text in enumerate(column) if k != beat
            ]
        elif isinstance(column[0], str):
            assert texts(values) == list(column), name
        else:
            assert same(values, np.array(column)), name
    for name, tick in (("time", "tick"), ("until", "until_tick")):
        assert same(found[name][0], np.asarray(found[tick][0]) / exported.TICK_HZ)


def about_of(out: Path) -> dict[str, Any]:
    match out.suffix:
        case ".csv":
            text: Any = out.with_name(f"{out.stem}-run.json").read_text()
        case ".parquet":
            text = pq.read_metadata(table_file(out, "edges")).metadata[b"hallbench"]
        case ".mf4":
            with asammdf.MDF(out) as mdf:
                text = bytes(mdf.extract_attachment(index=0)[0])
        case ".mat":
            text = loadmat(out, simplify_cells=True)["about"]
        case _:
            text = str(np.load(out)["about"])
    told: dict[str, Any] = json.loads(text)
    return told


def test_what_the_run_is_comes_along(made: Path, whole: Path) -> None:
    told, log = about_of(whole), exported.said(made)
    assert told["run"] == "a.run"
    assert {name: told[name] for name in ("identity", "parameters", "tick_hz", "started", "channels", "id")} == {
        name: log[0][name] for name in ("identity", "parameters", "tick_hz", "started", "channels", "id")
    }
    assert told["parameters"]["odd"] == "nan"
    assert [stream["name"] for stream in told["streams"]] == list(STREAMS)
    assert told["lost"]["samples"] == 3 + 100 + 10 + 4  # in a chunk, in the outage of both nodes, at the end
    assert (told["summary"], told["ended"], told["damage"]) == ("# Summary", True, [])


def test_an_mdf_keeps_the_integers_and_begins_when_the_devices_clock_was_0(made: Path, tmp_path: Path) -> None:
    export(Run(made), tmp_path / "x.mf4")
    raw = exported.stored(made, "samples").column("theta_enc").to_numpy()
    with asammdf.MDF(tmp_path / "x.mf4") as mdf:
        signal = mdf.get("theta_enc", raw=True)
        assert signal.samples.dtype == np.int16
        assert (signal.samples == raw).all()
        started = datetime.fromisoformat(exported.said(made)[0]["started"])
        assert (started - mdf.header.start_time).total_seconds() == pytest.approx(1000, abs=1e-3)


# -- MDF by the letter -----------------------------------------------------------------------------------------------


class Mdf:
    """The blocks of an MDF 4 file, read by their layout in the ASAM standard: with nothing but `struct`."""

    def __init__(self, path: Path) -> None:
        self.data = path.read_bytes()
        self.links, self.header = self.block(64, b"##HD")

    def block(self, at: int, kind: bytes) -> tuple[tuple[int, ...], bytes]:
        """The links of the block at an address, and its data."""
        name, length, count = struct.unpack_from("<4s4xQQ", self.data, at)
        assert name == kind
        links = struct.unpack_from(f"<{count}Q", self.data, at + 24)
        return links, self.data[at + 24 + 8 * count : at + length]

    def text(self, at: int) -> str:
        return self.block(at, b"##TX")[1].rstrip(b"\0").decode() if at else ""

    def chain(self, at: int, kind: bytes) -> Iterator[tuple[tuple[int, ...], bytes]]:
        """Blocks whose first link is the next of them."""
        while at:
            links, data = self.block(at, kind)
            yield links, data
            at = links[0]

    def groups(self) -> Iterator[tuple[str, int, list[tuple[tuple[int, ...], bytes]]]]:
        """Name, number of records and channels of each; each alone in its data group, so that the file is sorted."""
        for links, data in self.chain(self.links[0], b"##DG"):
            assert data[0] == 0, "no record ids"
            (group,) = self.chain(links[1], b"##CG")
            yield self.text(group[0][2]), struct.unpack_from("<8xQ", group[1])[0], [*self.chain(group[0][1], b"##CN")]


def test_an_mdf_keeps_the_rules_of_the_standard(made: Path, tmp_path: Path) -> None:
    """The master of each group is its first channel: time in s, as float64, unscaled. Names are unique in a group."""
    export(Run(made), tmp_path / "x.mf4")
    mdf = Mdf(tmp_path / "x.mf4")
    assert mdf.data[:16].rstrip() == b"MDF     4.10"
    assert mdf.links[1], "a file history is mandatory"
    found = list(mdf.groups())
    assert [(name, rows) for name, rows, _ in found] == [
        ("samples", 7397), ("edges", 444), ("node2-stream0", 740), ("marks", len(MARKED))
    ]  # fmt: skip
    fixed, varying, master, linear = 0, 1, 2, 1
    for name, _, channels in found:
        names = [mdf.text(links[2]) for links, _ in channels]
        assert len({*map(str.casefold, names)}) == len(names)
        wanted = exported.expected(made, name) if name != "marks" else {}
        for k, (links, data) in enumerate(channels):
            kind, sync, dtype, _, _, bits = struct.unpack_from("<BBBBII", data)
            assert (kind, sync) == ((master, 1) if k == 0 else (varying if dtype == 7 else fixed, 0)), names[k]
            if k == 0:
                assert (names[0], mdf.text(links[6]), dtype, bits, links[4]) == ("time", "s", 4, 64, 0)
            elif names[k] in wanted:
                assert mdf.text(links[6]) == wanted[names[k]][1]
            if links[4]:
                assert mdf.block(links[4], b"##CC")[1][0] == linear


@pytest.mark.parametrize("hours", [0, 2, -5])
def test_the_start_of_an_mdf_is_in_utc_with_the_zone_beside_it(made: Path, tmp_path: Path, hours: int) -> None:
    run = Run(made)
    local = datetime(2026, 3, 1, 12, 0, 0, tzinfo=timezone(timedelta(hours=hours)))
    run.info = replace(run.info, started=local.isoformat())
    assert not export(run, tmp_path / "x.mf4").notes
    start, zone, summer, flags = struct.unpack_from("<QhhB", Mdf(tmp_path / "x.mf4").header)
    began = local.timestamp() - exported.START / exported.PWM_HZ  # when the device's clock was 0
    assert start / 1e9 == pytest.approx(began, abs=1e-3)
    assert (zone, summer, flags) == (60 * hours, 0, 2)  # minutes, and that they count


@pytest.mark.parametrize("started", ["", "some day", "1970-01-01T00:00:05+00:00"])
def test_an_mdf_of_unknown_date_does_not_begin_now(made: Path, tmp_path: Path, started: str) -> None:
    run = Run(made)
    run.info = replace(run.info, started=started)
    notes = export(run, tmp_path / "x.mf4").notes
    assert "the start time of the file is 1970-01-01" in " ".join(notes)
    assert struct.unpack_from("<Q", Mdf(tmp_path / "x.mf4").header) == (0,)


def test_a_second_reader_of_mdf_finds_the_same(made: Path, tmp_path: Path) -> None:
    """mf4-rs, which shares nothing with asammdf; in a part in which a stream has no rows, too."""
    mf4_rs = pytest.importorskip("mf4_rs")
    export(Run(made), tmp_path / "x.mf4")
    mdf = mf4_rs.Mdf(str(tmp_path / "x.mf4"))
    assert [group.name for group in mdf.groups] == [*STREAMS, "marks"]
    for group in mdf.groups[:3]:
        wanted = exported.expected(made, group.name)
        assert [(channel.name, channel.unit or "") for channel in group.channels] == [
            (name, unit) for name, (_, unit) in wanted.items()
        ]
        for name, (values, _) in wanted.items():
            assert same(np.asarray(mdf.values(name, group=group.name)), values), (group.name, name)
    kinds = list(mdf.read("kind", group="marks"))
    assert kinds == [row[2] for row in sorted(MARKED, key=lambda row: row[0])]
    export(Run(made), tmp_path / "y.mf4", None, 1030.3, 1031.2)
    part = mf4_rs.Mdf(str(tmp_path / "y.mf4"))
    assert [group.record_count for group in part.groups][3] == 0
    assert len(part.values("value", group="marks")) == 0


def test_names_that_differ_by_case_only_are_told_for_every_format(tmp_path: Path) -> None:
    """DuckDB, which ignores case, does give one of them another name."""
    names = ("Speed", "speed", "Time", "torque")
    channels = tuple(
        exported.Channel(k, name, exported.Unit.A, exported.RawType.F32, 1.0, exported.Flag.CHANNEL)
        for k, name in enumerate(names)
    )
    config = replace(exported.SAMPLES, channels=channels)
    writer = RunWriter(tmp_path / "a.run", replace(exported.info(), channels=channels))
    writer.take(exported.samples(config, exported.EVERY * np.arange(50, dtype=np.int64)))
    writer.close()
    for ending in ENDINGS.values():
        notes = " ".join(export(Run(tmp_path / "a.run"), tmp_path / f"x{ending}").notes)
        assert "samples: Speed and speed differ by case only" in notes, ending
        assert "samples: time and Time differ by case only" in notes
        assert "torque" not in notes
    seen = duckdb.sql(f"DESCRIBE SELECT * FROM '{tmp_path}/x.parquet'").fetchall()
    assert not {*names, "time"} <= {column[0] for column in seen}
    alone = export(Run(tmp_path / "a.run"), tmp_path / "y.csv", channels=["speed", "torque"])
    assert "case" not in " ".join(alone.notes)


def test_after_a_reboot_an_mdf_has_a_group_whose_time_begins_again(tmp_path: Path) -> None:
    writer = RunWriter(tmp_path / "a.run", exported.info())
    once = exported.START + np.arange(500, dtype=np.int64) * exported.EVERY
    again = np.arange(300, dtype=np.int64) * exported.EVERY
    for index in (once, again):
        writer.take(exported.samples(exported.SAMPLES, index))
    writer.close()
    done = export(Run(tmp_path / "a.run"), tmp_path / "x.mf4")
    assert any("the device rebooted" in words for words in done.notes)
    with asammdf.MDF(tmp_path / "x.mf4") as mdf:
        assert [group.channel_group.acq_name for group in mdf.groups] == ["samples", "samples", "marks"]
        for number, index in enumerate((once, again)):
            assert (mdf.get("tick", group=number).samples == index * exported.TICKS).all()


# -- a part of it ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", READERS)
def test_a_part_of_the_time_and_of_the_channels(made: Path, ending: str, tmp_path: Path) -> None:
    read = READERS[ending]
    out = tmp_path / f"x{ending}"
    done = export(Run(made), out, None, 1010.5, 1014.25, ["tau", "u_dc"])
    lo, hi = round(1010.5 * exported.TICK_HZ), round(1014.25 * exported.TICK_HZ)
    assert set(done.rows) == {"samples", "edges", "marks"}  # node 2 has none of these channels
    for stream in ("samples", "edges"):
        found, wanted = read(out, stream), exported.expected(made, stream)
        ticks = wanted["tick"][0]
        rows = (ticks >= lo) & (ticks <= hi)
        assert 0 < rows.sum() == done.rows[stream]
        if stream == "samples":
            assert list(found) == ["time", "tick", "index", "u_dc", "tau", "gap", "lost", "lost_frames"]
            assert found["lost"][0].sum() == 3
        for name, (values, _) in found.items():
            assert same(values, wanted[name][0][rows]), (stream, name)
    kinds = texts(read(out, "marks")["kind"][0])
    assert kinds == ["mark"]  # the one from 1010 to 1020 s
    whole = export(Run(made), out, None, 0, 2000, overwrite=True)
    assert whole.rows["marks"] == len(MARKED)  # the event before the first sample, too


def test_a_run_that_was_cut_short_is_exported_up_to_there(made: Path, tmp_path: Path) -> None:
    """What is in no Parquet file yet comes from the journal; a stream that has nothing in a part has no rows."""
    writer = RunWriter(tmp_path / "a.run", exported.info())
    writer.take(exported.edges(np.arange(3, dtype=np.int64)))
    chunk = exported.samples(exported.SAMPLES, exported.START + np.arange(800, dtype=np.int64) * exported.EVERY)
    writer.take(chunk)
    writer.abandon()
    for ending, read in READERS.items():
        out = tmp_path / f"x{ending}"
        done = export(Run(tmp_path / "a.run"), out, begin=1004.0, overwrite=True)
        assert same(read(out, "samples")["tau"][0], chunk.raw["tau"][400:].astype(np.float64) * (1 / 3))
        found = read(out, "edges")
        assert list(found) == list(exported.expected(made, "edges")), ending
        assert not any(len(values) for values, _ in found.values())
        assert any("has no end" in words for words in done.notes)


def test_a_run_of_edges_alone(tmp_path: Path) -> None:
    writer = RunWriter(tmp_path / "a.run", exported.info())
    writer.take(exported.edges(np.arange(10, dtype=np.int64)))
    writer.close()
    assert export(Run(tmp_path / "a.run"), tmp_path / "x.csv").files["edges"] == tmp_path / "x.csv"
    wanted = exported.expected(tmp_path / "a.run", "edges")
    assert same(pd.read_csv(tmp_path / "x.csv")["hall_new"].to_numpy(), wanted["hall_new"][0])


def test_more_than_a_minute_in_rerun_is_told_to_be_minima_and_maxima(made: Path, tmp_path: Path) -> None:
    long = make(tmp_path / "long.run", {"i_q": np.zeros(70_000)}, decimation=16)  # 70 s
    done = export(Run(long), tmp_path / "x.rrd")
    assert any("minima and maxima" in words for words in done.notes)
    assert not export(Run(long), tmp_path / "y.rrd", None, 2, 5).notes
    assert not export(Run(made), tmp_path / "z.rrd").notes  # of some more seconds, but few samples
    assert (tmp_path / "x.rrd").stat().st_size > 10_000


def test_names_that_matlab_does_not_take_stay_apart() -> None:
    assert to_mat.fields(["i.a", "i_a", "2x", "é", "_"]) == {
        "i.a": "i_a",
        "i_a": "i_a_",
        "2x": "x2x",
        "é": "x_",
        "_": "x__",
    }


# -- what goes wrong ------------------------------------------------------------------------------------------------


def failing(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The error of `bench export`, which ends with 2."""
    with pytest.raises(SystemExit) as ended:
        main(["export", *map(str, arguments)])
    assert ended.value.code == 2
    told = capsys.readouterr().err.strip().splitlines()[-1]
    assert told.startswith("error: ")
    return told


def test_damage_is_told_and_the_rest_exported(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copy = tmp_path / "a.run"
    shutil.copytree(made, copy)
    flip(copy / "samples-000001.parquet", 2000)
    main(["export", str(copy), "-o", str(tmp_path / "x.parquet")])
    assert "warning: samples-000001.parquet is damaged: " in capsys.readouterr().err
    found, wanted = by_pyarrow(tmp_path / "x.parquet", "samples"), exported.expected(made, "samples")
    rows = np.isin(wanted["tick"][0], found["tick"][0])
    assert 0 < rows.sum() < len(rows)
    assert same(found["tau"][0], wanted["tau"][0][rows])
    assert about_of(tmp_path / "x.parquet")["damage"]


def test_the_command_says_what_it_wrote(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["export", str(made), "-o", str(tmp_path / "x.csv"), "--channels", "tau, hall", "--json", "-"])
    out, err = capsys.readouterr()
    told = json.loads(out)
    assert told["rows"] == {"samples": 7397, "edges": 444, "marks": len(MARKED)}
    assert sorted(told["files"].values()) == sorted(map(str, tmp_path.glob("x*")))
    assert err == "x.csv has only samples: edges in x-edges.csv, marks in x-marks.csv, run in x-run.json\n"
    main(["export", str(made), "-o", str(tmp_path / "x.dat"), "--format", "npz"])
    out, err = capsys.readouterr()
    assert "samples: 7397 rows, edges: 444 rows, node2-stream0: 740 rows, marks: 8 rows" in out
    assert not err
    assert by_numpy(tmp_path / "x.dat", "edges")


def test_what_cannot_be_exported_is_named(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "x.csv"
    for arguments, what in (
        ((made, "-o", tmp_path / "x.txt"), "use .csv, .mf4, .mat, .npz, .rrd or .parquet, or --format"),
        ((made, "-o", tmp_path / "x.mat", "--format", "csv"), "x.mat has the extension of mat, but --format is csv"),
        ((made, "-o", out, "--from", 2000), "has no data from 2000 to 1074.99 s: it covers 1000.000 to 1074.990 s"),
        ((made, "-o", out, "--from", 1030.1, "--to", 1030.12, "--channels", "tau"), "has no data from 1030.100 s"),
        ((made, "-o", out, "--channels", "tao"), "has no channel 'tao'; did you mean tau?"),
        (
            (made, "-o", out, "--channels", "xyz"),
            "there are: hall, theta_enc, u_dc, temperature, time, tau, i.a, omega_m",
        ),
        ((made, "-o", out, "--channels", ","), "--channels is empty"),
        ((made, "-o", "-", "--format", "csv"), "an export cannot go to standard output"),
        ((made, "-o", tmp_path / "x.rrd", "--channels", "tau"), "omit --channels"),
        ((made, "-o", tmp_path / "none" / "x.csv"), "there is no directory"),
        ((tmp_path / "none.run", "-o", out), "no such file"),
        ((tmp_path, "-o", out), "is not a recorded run"),
    ):
        assert what in failing(capsys, *arguments)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("there", ["x.csv", "x-edges.csv", "x-run.json"])
def test_files_that_exist_are_left_alone(made: Path, tmp_path, capsys, there: str) -> None:
    (tmp_path / there).write_text("precious")
    told = failing(capsys, made, "-o", tmp_path / "x.csv")
    assert f"{there} exists: choose another name, or --overwrite" in told
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(there, "precious")]
    main(["export", str(made), "-o", str(tmp_path / "x.csv"), "--overwrite"])
    assert (tmp_path / there).read_text() != "precious"


@pytest.mark.parametrize("ending", READERS)
def test_a_full_disk_leaves_nothing(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], ending: str
) -> None:
    """As a limit on the size of files does."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, before[1]))
    try:
        told = failing(capsys, made, "-o", tmp_path / f"x{ending}")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert f"error: {tmp_path}/x{ending} cannot be written: " in told
    assert "File too large" in told
    assert not list(tmp_path.iterdir())


def test_without_asammdf_it_says_what_to_install(made: Path, tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "asammdf", None)
    assert "pip install 'hallbench[export]'" in failing(capsys, made, "-o", tmp_path / "x.mf4")
    assert not list(tmp_path.iterdir())


def long_run(path: Path, rows: int) -> Path:
    """A run whose log says that it has so many samples: limits are looked at before anything is read."""
    exported.record(path, 3)
    lines = (path / layout.LOG).read_text().splitlines()
    for k, line in enumerate(lines):
        record = layout.record_of(line)
        if record["kind"] == "segment":
            for file in record["files"]:
                file["groups"][-1][2] = rows
        lines[k] = layout.line_of(record)
    (path / layout.LOG).write_text("".join(lines))
    return path


def test_a_mat_file_has_limits(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = failing(capsys, long_run(tmp_path / "a.run", 22_500_000), "-o", tmp_path / "x.mat")
    assert "samples would take 2.18 GB, and a variable in a .mat file at" in told
    assert "at most 2.15 GB: export less with --from, --to or --channels" in told
    assert not (tmp_path / "x.mat").exists()
    for name in ("x" * 63, "x" * 64):
        channels = (exported.Channel(1, name, exported.Unit.A, exported.RawType.U8, 1.0, exported.Flag.CHANNEL),)
        config = exported.StreamConfig(1, 0, 7, exported.StreamEvent.PWM, 1, channels, 9, tick_hz=1000, pwm_hz=100)
        info = exported.RunInfo(1000, 100, channels)
        writer = RunWriter(tmp_path / f"{len(name)}.run", info)
        index = np.arange(5, dtype=np.int64)
        writer.take(exported.SampleChunk(config, index, index * 10, np.zeros(5, config.dtype), ()))
        writer.close()
    export(Run(tmp_path / "63.run"), tmp_path / "63.mat")
    assert "x" * 63 in loadmat(tmp_path / "63.mat", simplify_cells=True)["samples"]
    with pytest.raises(BenchError, match="at most 63 characters"):
        export(Run(tmp_path / "64.run"), tmp_path / "64.mat")


def test_what_memory_does_not_hold_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = failing(capsys, long_run(tmp_path / "a.run", 10**12), "-o", tmp_path / "x.npz")
    assert "e+05 GB where" in told
    assert "--format mdf4 or parquet" in told
    free = memory.available()
    assert free is not None
    assert 0 < free < os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def fast_run(path: Path, seconds: int) -> Path:
    """Seven channels at 16 kHz."""
    config = replace(exported.SAMPLES, decimation=1)
    writer = RunWriter(path, exported.info())
    chunk = exported.samples(config, np.arange(exported.PWM_HZ, dtype=np.int64))
    for second in range(seconds):
        index = chunk.index + second * exported.PWM_HZ
        writer.take(exported.SampleChunk(config, index, index * exported.TICKS, chunk.raw, ()))
    writer.close()
    return path


@pytest.fixture(scope="module")
def minute(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fast_run(tmp_path_factory.mktemp("minute") / "a.run", 60)


@pytest.mark.parametrize(("number", "ending"), [(signal.SIGINT, ".csv"), (signal.SIGTERM, ".mf4")])
def test_whoever_ends_it_finds_nothing_half_done(minute, tmp_path, start, number, ending) -> None:
    program = start("export", str(minute), "-o", str(tmp_path / f"x{ending}"))
    until = time.monotonic() + LIMIT
    while not any(path.stat().st_size for path in tmp_path.iterdir()):
        assert time.monotonic() < until
        time.sleep(0.01)
    program.process.send_signal(number)
    assert program.process.wait(LIMIT) == 128 + number
    assert not list(tmp_path.iterdir())


@pytest.mark.long("a minute and more of samples")
@pytest.mark.parametrize("ending", sampled("memory", (".csv", ".mf4", ".parquet"), 1, campaign="memory"))
def test_a_long_run_takes_no_more_memory_than_a_short_one(tmp_path: Path, ending: str) -> None:
    peaks = []
    for seconds in (20, 80):
        run = fast_run(tmp_path / f"{seconds}.run", seconds)
        program = (
            "import resource, sys; from bench.cli import main; main(sys.argv[1:]);"
            "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
        )
        told = subprocess.run(
            [sys.executable, "-c", program, "export", str(run), "-o", f"{tmp_path}/{seconds}{ending}"],
            capture_output=True, text=True, check=True, env=ENVIRONMENT, cwd=Path(__file__).parents[2],
        )  # fmt: skip
        peaks.append(int(told.stdout.splitlines()[-1]) * 1024)
    held = 60 * exported.PWM_HZ * 13 * 8  # what the rest would take at once
    assert peaks[1] - peaks[0] < 0.2 * held
