"""A kept recording of the simulated drive as other tools would have recorded it, each file by its format's library.

What is written is told by `columns`, with times that are right to a nanosecond; `codes` are those of the samples.
"""

from __future__ import annotations

import csv
import gzip
import json
import subprocess
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import asammdf
import can
import cantools
import h5py
import nptdms
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import scipy.io
import vcd

import bench

KEPT = Path(__file__).parents[1] / "data" / "reversal.run"
UNITS = {"t": "s", "theta": "el deg", "i_a": "mA", "i_b": "A", "i_c": "A", "u_alpha": "V", "u_beta": "V", "hall": ""}
TO_SI = {"theta": np.pi / 180, "i_a": 1e-3}
NAMES = {"theta": "theta_enc"}
DBC = """VERSION ""
NS_ :
BS_:
BU_: drive
BO_ 256 fast: 8 drive
 SG_ hall : 0|3@1+ (1,0) [0|7] "" drive
 SG_ theta : 16|16@1- (0.01,0) [-327|327] "deg" drive
BO_ 257 slow: 4 drive
 SG_ i_a : 0|16@1- (1,0) [-32768|32767] "mA" drive
 SG_ speed : 16|16@1- (0.1,0) [-3276|3276] "mech rad/s" drive
"""


@cache
def columns(every: int = 1, n: int = 19_200) -> dict[str, Any]:
    """What the files hold, in their units: time from 0."""
    run = bench.read(KEPT)
    t = (run.samples.tick - run.samples.tick[0]) / run.tick_hz
    found = {"t": t, "hall": run.samples.raw["hall"].astype(np.int64)}
    for name in ("theta", "i_a", "i_b", "i_c", "u_alpha", "u_beta"):
        found[name] = run[NAMES.get(name, name)] / TO_SI.get(name, 1.0)
    return {name: values[:n:every] for name, values in found.items()}


def in_si() -> dict[str, Any]:
    """The same but time and codes, by the channels' names, in SI."""
    return {
        NAMES.get(name, name): values * TO_SI.get(name, 1.0)
        for name, values in columns().items()
        if name not in ("t", "hall")
    }


def headed() -> pd.DataFrame:
    """A table with units in its header."""
    return pd.DataFrame({f"{name} [{UNITS[name]}]" if UNITS[name] else name: c for name, c in columns().items()})


def csv_wide(path: Path) -> None:
    headed().to_csv(path, index=False)


def csv_comma(path: Path) -> None:
    """As a German spreadsheet writes it, with a title above."""
    path.write_text("Messung 7;;;;;;;\n", "latin-1")
    headed().to_csv(path, index=False, sep=";", decimal=",", mode="a", encoding="latin-1")


def csv_units_below(path: Path) -> None:
    table = pd.DataFrame(columns())
    with path.open("w", newline="") as file:
        writer = csv.writer(file, delimiter="\t")
        writer.writerow(table.columns)
        writer.writerow([UNITS[name] for name in table.columns])
        table.to_csv(file, index=False, header=False, sep="\t")


def csv_long(path: Path) -> None:
    table = headed().melt("t [s]", var_name="name").sort_values("t [s]", kind="stable")
    table.to_csv(path, index=False)


def csv_gz(path: Path) -> None:
    with gzip.open(path, "wt") as file:
        headed().to_csv(file, index=False)


def jsonl(path: Path) -> None:
    table, names = columns(), list(headed())
    with path.open("w") as file:
        for row in zip(*(table[name].tolist() for name in table), strict=True):
            told = dict(zip(names, row, strict=True))
            file.write(json.dumps({"t [s]": told.pop("t [s]"), "servo": told}) + "\n")


def parquet(path: Path) -> None:
    table = columns()
    fields = [pa.field(n, pa.from_numpy_dtype(c.dtype), metadata={"unit": UNITS[n]}) for n, c in table.items()]
    pq.write_table(pa.table(list(table.values()), schema=pa.schema(fields)), path, row_group_size=4000)


def npz(path: Path) -> None:
    np.savez_compressed(path, **columns())


def mat(path: Path) -> None:
    scipy.io.savemat(path, {"log": {name: c.astype(float) for name, c in columns().items()}}, do_compression=True)


def hdf5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        for name, c in columns().items():
            made = file.create_dataset(f"run1/{name}", data=c, compression="gzip")
            made.attrs["unit"] = UNITS[name]


def tdms(path: Path) -> None:
    """By the increment of a waveform, as LabVIEW writes it."""
    with nptdms.TdmsWriter(path) as file:
        file.write_segment([
            nptdms.ChannelObject("log", name, c, {"wf_increment": 1 / 16_000, "unit_string": UNITS[name]})
            for name, c in columns().items() if name != "t"
        ])  # fmt: skip


def mdf4(path: Path) -> None:
    with asammdf.MDF(version="4.10") as mdf:
        t = columns()["t"]
        mdf.append([
            asammdf.Signal(c, t, unit=UNITS[name], name=name) for name, c in columns().items() if name != "t"
        ], common_timebase=True)  # fmt: skip
        mdf.save(path, overwrite=True)


WIDE: dict[str, Callable[[Path], None]] = {
    "wide.csv": csv_wide, "comma.csv": csv_comma, "below.txt": csv_units_below, "long.csv": csv_long,
    "packed.csv.gz": csv_gz, "log.jsonl": jsonl, "log.parquet": parquet, "log.npz": npz, "log.mat": mat,
    "log.h5": hdf5, "log.tdms": tdms, "log.mf4": mdf4,
}  # fmt: skip
"""All of them have all columns."""


# -- logic ----------------------------------------------------------------------------------------------------------


@cache
def changes() -> tuple[np.ndarray, np.ndarray]:
    """Times in ns and codes of the drive's own edges, timed to a tick; the first one is the code before them."""
    edges = bench.read(KEPT).edges
    first = bench.read(KEPT).samples.tick[0]
    ns = np.r_[0, np.rint((edges.tick - first) * (1e9 / edges.config.tick_hz)).astype(np.int64)]
    return ns, np.r_[edges.hall_old[:1], edges.hall_new]


def vcd_file(path: Path) -> None:
    ns, codes = changes()
    with path.open("w") as file, vcd.VCDWriter(file, timescale="1 ns") as writer:
        lines = [writer.register_var("logic", f"D{k}", "wire", size=1, init=int(codes[0]) >> k & 1) for k in range(3)]
        clock = writer.register_var("logic", "button", "wire", size=1, init=0)
        for at, code in zip(ns[1:].tolist(), codes[1:].tolist(), strict=True):
            for k, line in enumerate(lines):
                writer.change(line, at, code >> k & 1)
        writer.change(clock, int(ns[-1]) + 5_000_000, 1)


def saleae(path: Path) -> None:
    """A digital export of Logic 2: a row for each change."""
    ns, codes = changes()
    levels = {f"Channel {k}": codes >> k & 1 for k in range(3)}
    pd.DataFrame({"Time [s]": ns * 1e-9, **levels}).to_csv(path, index=False, float_format="%.9f")


def session(path: Path, rate: int = 1_000_000) -> None:
    """A session as libsigrok documents the format: metadata, and the samples as words."""
    words = sampled(rate)
    told = (
        "[global]\nsigrok version=0.5.2\n[device 1]\ncapturefile=logic-1\ntotal probes=8\n"
        f"samplerate={rate // 1000} kHz\ntotal analog=0\n"
        + "".join(f"probe{k + 1}=D{k}\n" for k in range(8))
        + "unitsize=1\n"
    )
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("version", "2")
        file.writestr("metadata", told)
        for number, first in enumerate(range(0, len(words), 1 << 19), 1):
            file.writestr(f"logic-1-{number}", words[first : first + (1 << 19)].tobytes())


def sampled(rate: int) -> np.ndarray:
    """What a logic analyser sees at this rate: codes, uint8."""
    ns, codes = changes()
    at = np.arange(int(ns[-1] * 1e-9 * rate) + 1000) * (1e9 / rate)
    return codes[np.searchsorted(ns, at, "right") - 1].astype(np.uint8)


def by_sigrok_cli(path: Path, rate: int = 1_000_000) -> None:
    """The same, written by sigrok's own program."""
    raw = path.with_suffix(".bin")
    raw.write_bytes(sampled(rate).tobytes())
    form = f"binary:numchannels=3:samplerate={rate}"
    subprocess.run(["sigrok-cli", "-i", raw, "-I", form, "-o", path], check=True, capture_output=True, timeout=60)


LOGIC: dict[str, tuple[Callable[[Path], None], float]] = {
    "halls.vcd": (vcd_file, 1e-9), "digital.csv": (saleae, 1e-9), "halls.sr": (session, 1e-6),
}  # fmt: skip
"""With s by which an edge may be later than it was."""


# -- CAN ------------------------------------------------------------------------------------------------------------


def frames() -> list[can.Message]:
    """hall and theta each ms, current and speed every 10 ms, of the recording's samples."""
    db: Any = cantools.database.load_string(DBC)
    table = columns(16)
    found = []
    theta = np.unwrap(np.radians(table["theta"]))
    speed = np.gradient(theta, table["t"]) / 6
    for k, at in enumerate(table["t"].tolist()):
        data = db.encode_message("fast", {"hall": int(table["hall"][k]), "theta": float(table["theta"][k])})
        found.append(can.Message(1000.0 + at, 256, data=data, is_extended_id=False))
        if k % 10 == 0:
            data = db.encode_message("slow", {"i_a": float(round(table["i_a"][k])), "speed": float(speed[k])})
            found.append(can.Message(1000.0 + at, 257, data=data, is_extended_id=False))
    return found


CAN: dict[str, Callable[[Path], Any]] = {
    "bus.log": can.CanutilsLogWriter, "bus.asc": can.ASCWriter, "bus.blf": can.BLFWriter, "bus.trc": can.TRCWriter,
}  # fmt: skip


def can_log(path: Path) -> None:
    """By python-can's writer of that format, and the DBC beside it."""
    path.with_suffix(".dbc").write_text(DBC)
    with CAN[path.name](path) as writer:
        for frame in frames():
            writer(frame)
