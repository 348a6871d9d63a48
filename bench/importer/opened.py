"""Opens a file as what it is: by --format, by how its name ends, or by its first bytes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from bench.errors import BenchError
from bench.importer import FORMATS
from bench.importer.mapping import Mapping
from bench.importer.source import Source
from protocol.text import either


def format_of(path: Path, named: str = "") -> str:
    """The format that is named, or that the file's name tells. Raises BenchError."""
    if named:
        return named
    name = path.name.lower().removesuffix(".gz") if path.name.lower().endswith(".gz") else path.name.lower()
    for form, endings in FORMATS.items():
        if name.endswith(endings):
            return form
    raise BenchError(f"{path}: nothing tells its format: give --format {either(FORMATS)}")


def opened(path: Path, mapping: Mapping, dbc: Path | None = None) -> Source:
    """Open a file. Raises BenchError for one that cannot be read."""
    form = format_of(path, mapping.format)
    if not path.is_file():
        raise BenchError(f"{path}: no such file" if not path.exists() else f"{path} is not a file")
    match form:
        case "csv":
            from bench.importer.from_csv import CsvFile

            return CsvFile(path, mapping.text)
        case "json":
            from bench.importer.from_json import JsonLines

            return JsonLines(path)
        case "vcd" | "sigrok" | "moteus":
            from bench.importer import from_logic

            logic: dict[str, Callable[[Path], Source]] = {
                "vcd": from_logic.vcd, "sigrok": from_logic.sigrok, "moteus": from_logic.MoteusFile,
            }  # fmt: skip
            return logic[form](path)
        case "asc" | "blf" | "candump" | "trc":
            from bench.importer.from_can import log

            return log(path, form, dbc)
    from bench.importer import from_arrays

    arrays: dict[str, Callable[[Path], Source]] = {
        "parquet": from_arrays.ParquetFile, "npz": from_arrays.npz, "mat": from_arrays.mat,
        "hdf5": from_arrays.hdf5, "tdms": from_arrays.tdms, "mdf4": from_arrays.MdfFile,
    }  # fmt: skip
    return arrays[form](path)
