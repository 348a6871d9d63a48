"""What cannot be imported: one line says what, where and what to do, and nothing is left half written."""

from __future__ import annotations

import io
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import imports_made as made
import numpy as np
import pandas as pd
import pytest
from processes import ENVIRONMENT

import bench
from bench.cli import main
from bench.errors import BenchError
from bench.importer.guess import complete
from bench.importer.importer import prepare, write
from bench.importer.mapping import Mapping
from bench.importer.opened import opened

T = np.arange(200) / 1000.0


def refused(capsys: pytest.CaptureFixture[str], file: Path, *options: str) -> str:
    """What is said of it; nothing is left."""
    before = sorted(file.parent.iterdir())
    with pytest.raises(SystemExit) as ended:
        main(["import", str(file), "-o", str(file.parent / "x.run"), *options])
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error:")]
    assert ended.value.code == 2
    assert len(said) == 1
    assert file.name in said[0]
    assert sorted(file.parent.iterdir()) == before
    return said[0]


def text(path: Path, **columns: Any) -> Path:
    pd.DataFrame(columns).to_csv(path, index=False)
    return path


CODES = (b"1,0,0", b"1,1,0", b"0,1,0", b"0,1,1", b"0,0,1", b"1,0,1")
TEXTS = {
    "empty": (b"", "is empty"),
    "blank": (b"\n\n  \n", "is empty"),
    "words": (b"Dear customer,\nthe motor is fine.\n", "no line has numbers"),
    "binary": (bytes(range(256)) * 20, "is no text"),
    "a stray word": (b"time,a\n0,1\n1,two\n2,3\n3,4\n", "line 3, column a: 'two' is no number"),
    "far down": (
        b"time,a\n" + b"".join(b"%d,1\n" % k for k in range(90_000)) + b"90000,1;2\n",
        "line 90002, column a: '1;2'",
    ),
    "ragged": (b"time,a,b\n" + b"".join(b"%d,2,3\n" % k for k in range(99)) + b"99,2\n" * 20,
               "lines do not have 3 columns, such as '99,2'"),
    "no time": (b"a,b\n1,2\n2,3\n", "no column tells the time; there are a, b: give --time COLUMN, or --rate HZ"),
    "one row": (b"time,a\n0,1\n", "1 row with a time"),
    "on its side": (b"time," + b",".join(b"%d" % k for k in range(20_000)) + b"\na," + b"1," * 19_999 + b"1\n",
                    "is a row a sample?"),
    "a line without an end": (b"time,a " * 60_000, "a line is longer than"),
    "blank for Python alone": (b"\x1c\x0b", "is empty"),
    "back, after lines left out": (b"time,a\n" + b"".join(b"%d,1\n" % k for k in range(40)) + b"\n40\n\n41,1\n3,1\n",
                                   "time goes back in line 46: from 41 to 3 s"),
    "a leap": (b"time,A,B,C\n" + b"".join(b"%d,%s\n" % (k, CODES[k % 6]) for k in range(60)) + b"9e6,1,0,0\n",
               "the longest step of time, 8.99994e+06 s, ends in line 62: cut the file there, or give --rate"),
    "units within": (b"time,u\n0,12 mV\n1,0.3 V\n", "u: '12 mV' is no number"),
    "a unit of time": (b"time [parsec],a\n0,1\n1,2\n", "unit"),
}  # fmt: skip


@pytest.mark.parametrize("name", TEXTS)
def test_text(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    data, wanted = TEXTS[name]
    file = tmp_path / "a.csv"
    file.write_bytes(data)
    if name in ("units within", "a unit of time"):
        options = ("--channel", "u_dc=u") if name == "units within" else ()
        assert wanted in (said := refused(capsys, file, *options)) or "no column 'u'" in said or "give --time" in said
        return
    assert wanted in refused(capsys, file)


def test_a_time_that_goes_back_or_stands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = text(tmp_path / "a.csv", time=np.r_[T, T], a=np.arange(400))
    said = refused(capsys, file)
    assert "time goes back in line 202: from 0.199 to 0 s" in said
    file = text(tmp_path / "a.csv", time=np.round(T, 2), a=np.arange(200))
    same = np.diff(np.round(T, 2)) == 0
    wanted = f"{same.sum()} of 200 rows have the time of the row before, first in line {np.argmax(same) + 3}"
    assert wanted in refused(capsys, file)
    twice = np.r_[T[:150], T[149:]]
    main(["import", str(text(file, time=twice, a=np.arange(201))), "-o", str(tmp_path / "x.run")])
    assert len(bench.read(tmp_path / "x.run")) == 200
    assert "1 rows with the time of the row before" in capsys.readouterr().out


def test_columns_that_are_named_and_are_not_right(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = text(tmp_path / "a.csv", time=T, speed=T, ha=T > 0.1, hb=T > 0.05, hc=T > 2)
    assert "no column 'sped'; did you mean speed?" in refused(capsys, file, "--channel", "omega_enc=sped:rpm")
    assert "channel 'omega_en' is unknown; did you mean omega_enc?" in _at(capsys, file, "--channel", "omega_en=speed")
    assert "unit 'A' is not rad/s" in refused(capsys, file, "--channel", "omega_enc=speed:A")
    assert "how many a turn? --counts-per-turn" in refused(capsys, file, "--channel", "theta_enc=speed:counts")
    assert "give --pole-pairs" in refused(capsys, file, "--channel", "omega_enc=speed:mech rpm")
    assert "mech rad/s" in refused(capsys, file, "--channel", "omega_enc=speed:rpm")
    assert "no column 'hx'" in refused(capsys, file, "--hall", "ha,hb,hx")
    assert "name one line twice" in _at(capsys, file, "--hall", "ha,ha,hb")


def _at(capsys: pytest.CaptureFixture[str], file: Path, *options: str) -> str:
    with pytest.raises(SystemExit):
        main(["import", str(file), "-o", str(file.parent / "x.run"), *options])
    return capsys.readouterr().err


def test_values_that_are_missing_stay_missing(tmp_path: Path) -> None:
    i_a = np.sin(T)
    i_a[50:60] = np.nan
    hall = np.array([1, 3, 2, 6, 4, 5])[(np.arange(200) // 5) % 6].astype(float)
    hall[100:104] = np.nan
    hall[104:110] = 0.5, 2.5, 1e300, np.inf, -1e300, 3.999
    run = bench.capture(T, {"i_a": i_a, "hall": hall})
    assert len(run) == 190
    assert np.isnan(run["i_a"]).sum() == 10
    assert sum(gap.lost_samples for gap in run.samples.gaps) == 10
    assert any("0.1100" in words for words in run.flaws())
    around = (run.edge_t > 0.0995) & (run.edge_t < 0.1105)
    assert not around.any()  # when the code changed meanwhile is not known


def test_two_lines_that_are_no_hall_sensors_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(3)
    lines = {f"D{k}": rng.integers(0, 2, 200) for k in range(3)}
    file = text(tmp_path / "a.csv", time=T, **lines)
    main(["import", str(file), "-o", str(tmp_path / "x.run"), "--hall", "D0,D1,D2"])
    assert (
        "do not go to a neighbouring sector: are D0, D1, D2 the inputs of sensors a, b, c?" in capsys.readouterr().err
    )


ARRAYS: dict[str, str] = {
    "a.npz": "npz file", "a.mat": "MAT file", "a.h5": "HDF5 file", "a.tdms": "TDMS file", "a.mf4": "MDF file",
    "a.parquet": "Parquet file", "a.sr": "sigrok session", "a.vcd": "", "a.dat": "capture of moteus",
    "a.blf": "blf log",
}  # fmt: skip


@pytest.mark.parametrize("name", ARRAYS)
def test_what_is_not_of_the_format(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    file = tmp_path / name
    file.write_bytes(b"PK\3\4 this is something else \0\1\2" * 9)
    (tmp_path / "a.dbc").write_text(made.DBC)
    assert ARRAYS[name] in refused(capsys, file, *(("--dbc", str(tmp_path / "a.dbc")) if name == "a.blf" else ()))


def test_a_zip_that_unpacks_to_too_much_or_holds_programs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.savez(tmp_path / "a.npz", t=T, a=np.array([{}] * 200, object))
    assert "holds Python objects, which are not read" in refused(capsys, tmp_path / "a.npz")
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (1 << 50,)})
    with zipfile.ZipFile(tmp_path / "b.npz", "w") as file:
        file.writestr("t.npy", header.getvalue() + bytes(80))
    assert "t.npy is shorter than it says" in refused(capsys, tmp_path / "b.npz")
    made.session(tmp_path / "a.sr", 100_000)
    data = bytearray((tmp_path / "a.sr").read_bytes())
    data[800:820] = bytes(20)
    (tmp_path / "a.sr").write_bytes(data)
    refused(capsys, tmp_path / "a.sr")


METADATA = """[device 1]
capturefile=logic-1
samplerate=24 MHz
probe1=a
probe2=b
probe3=c
unitsize=1
"""


@pytest.mark.slow
@pytest.mark.long("unpacks 300 MiB")
def test_what_unpacks_to_much_is_read_in_bounded_memory(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.sr", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("metadata", METADATA)
        with file.open("logic-1-1", "w", force_zip64=True) as data:
            for k in range(300):
                data.write(bytes([1 + k % 2]) * (1 << 20))
    assert (tmp_path / "a.sr").stat().st_size < 500_000
    assert peak(tmp_path / "a.sr", "--hall", "a,b,c") < 350 << 20


@pytest.mark.slow
@pytest.mark.long("writes and reads 75 MB")
def test_memory_does_not_grow_with_the_file(tmp_path: Path) -> None:
    rows = "".join(f"{{t}}{k:05d},{k % 7 / 3:.6f},{k % 11},{k % 13 / 7:.7f}\n" for k in range(100_000))
    with (tmp_path / "a.csv").open("w") as file:
        file.write("time [us],a,b,c\n")
        for k in range(30):
            file.write(rows.replace("{t}", str(k + 1)))
    with (tmp_path / "b.csv").open("w") as file:
        file.write("time [us],a,b,c\n")
        for k in range(10):
            file.write(rows.replace("{t}", str(k + 1)))
    assert (tmp_path / "a.csv").stat().st_size > 75e6
    assert peak(tmp_path / "a.csv") < peak(tmp_path / "b.csv") + (50 << 20)


PEAK = """
import resource, sys
from bench.cli import main
main(sys.argv[1:])
try:
    told = dict(line.split(":", 1) for line in open("/proc/self/status"))
    print(int(told["VmHWM"].split()[0]) << 10)
except OSError:  # not Linux; it has that of the program which started this one, too
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def peak(file: Path, *options: str) -> int:
    """Bytes of memory that a process of its own takes to import it."""
    command = [sys.executable, "-c", PEAK, "import", str(file), "-o", str(file.with_suffix(".run")), *options]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return int(done.stdout.split()[-1])


@pytest.mark.parametrize(("kept", "more"), [(201, "1,2\n"), (200, "0.1,2\n")], ids=["grows", "goes back"])
def test_a_file_that_is_written_to_while_it_is_read_is_refused(kept: int, more: str, tmp_path: Path) -> None:
    file = text(tmp_path / "a.csv", time=T, a=T)
    source = opened(file, Mapping(), None)
    prepared = prepare(source, complete(source, Mapping()).mapping)
    file.write_text("".join(file.read_text().splitlines(keepends=True)[:kept]) + more)
    with pytest.raises(BenchError, match="it is not what it was when it was looked at"):
        write(prepared, file, tmp_path / "a.run")
    assert [path.name for path in tmp_path.iterdir()] == ["a.csv"]


def test_arrays_that_do_not_fit_together() -> None:
    with pytest.raises(BenchError, match="columns differ in length: a: 3, time: 200"):
        bench.capture(T, {"a": [1, 2, 3]})
    with pytest.raises(BenchError, match="a: one number a sample is needed"):
        bench.capture(T, {"a": np.zeros((200, 2))})
    with pytest.raises(BenchError, match="time goes back in row 100"):
        bench.capture(np.r_[T[:100], T[:100]], {"a": T})
    with pytest.raises(BenchError, match="is no rate"):
        bench.capture(-1.0, {"a": T})
