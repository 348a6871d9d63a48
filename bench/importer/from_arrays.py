"""Files with arrays: Parquet, npz, MAT, HDF5, TDMS, MDF 4; each by its own library, a part at a time where it can.

A MAT file before 7.3 has no parts: it has to fit into memory.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.errors import BenchError
from bench.importer.files import reading, told_by
from bench.importer.source import BATCH, Arrays, Batch, Column, Leaf, Leaves, Table, Wanted, time_column
from bench.record.memory import available, in_words
from protocol.text import printable

RECORDS = 1 << 18
"""Of an MDF group that are read at once."""
WIDE = 64
"""Columns of a matrix, at most, that become channels each."""


DEFLATED = 1100
"""Bytes that one may unpack to, at most."""
TRIAL, TRIAL_RATE = 5.0, 20e6
"""s that a file may take to be read on trial, and bytes for one more."""
_HDF5 = (ValueError, KeyError, RuntimeError, TypeError, OverflowError, ZeroDivisionError, AttributeError)


def extra(module: str, package: str, of: str) -> Any:
    """A library that not everybody needs. Raises BenchError where it is not installed."""
    from importlib import import_module

    try:
        return import_module(module)
    except ImportError:
        raise BenchError(f"{of} needs {package}: pip install 'hallbench[import]'") from None


# -- Parquet --------------------------------------------------------------------------------------------------------


class ParquetFile:
    """One table. Raises BenchError."""

    format = "parquet"
    together = True

    def __init__(self, path: Path) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        self._path, self._errors = path, (pa.ArrowException, ValueError, OverflowError)
        with reading(path, "Parquet file", *self._errors):
            self._file = pq.ParquetFile(path)
            schema = self._file.schema_arrow
        usable = [field for field in schema if _numeric(field.type)]
        self.left_out = [f"{printable(f.name)}: {f.type} is no number" for f in schema if f not in usable]
        columns = tuple(Column(field.name, _unit(field)) for field in usable)
        kinds = {
            field.name: "date" for field in usable if str(field.type).startswith(("timestamp", "time64", "time32"))
        }
        self.tables = (Table("", columns, time_column(columns, kinds)),)
        self.about: Mapping[str, Any] = {}

    def batches(self, wanted: Wanted) -> Iterator[Batch]:
        """See `Source`."""
        from bench.importer.from_csv import array_of

        for table, names in wanted.items():
            with reading(self._path, "Parquet file", *self._errors):
                for batch in self._file.iter_batches(BATCH, columns=list(names)):
                    columns = zip(batch.schema.names, batch, strict=True)
                    yield {table: {name: array_of(column) for name, column in columns}}

    def line(self, table: str, row: int) -> str:
        """See `Source`."""
        return f"in row {row + 1}"


def _numeric(kind: Any) -> bool:
    import pyarrow as pa

    types = pa.types
    return bool(
        types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind) or types.is_timestamp(kind)
        or types.is_time(kind) or types.is_duration(kind)
    )  # fmt: skip


def _unit(field: Any) -> str:
    told = (field.metadata or {}).get(b"unit")
    dated = str(field.type).startswith(("timestamp", "time", "duration"))
    return told.decode("utf-8", "replace") if told else str(field.type.unit) if dated else ""


# -- arrays in a tree -----------------------------------------------------------------------------------------------


def leaves_of(parent: str, name: str, values: Any, unit: str = "") -> Iterator[Leaf]:
    """What can be sliced as (n,), or a matrix as its columns; nothing for what has no numbers, or one only."""
    shape, kind = tuple(values.shape), values.dtype.kind
    if values.dtype.names:
        for field in values.dtype.names:
            if len(shape) == 1 and values.dtype[field].kind in "iufbmM" and not values.dtype[field].shape:
                yield Leaf(f"{parent}/{name}".strip("/"), field, shape[0], lambda a, b, f=field: values[a:b][f], unit)  # type: ignore[misc]
        return
    if kind not in "iufbmM" or (kind == "f" and values.dtype.itemsize > 8):
        return
    long = [n for n in shape if n > 1]
    if len(long) == 1:
        axis = shape.index(long[0])
        before, after = (0,) * axis, (0,) * (len(shape) - axis - 1)
        yield Leaf(parent, name, long[0], lambda a, b: np.asarray(values[(*before, slice(a, b), *after)]), unit)
    elif len(shape) == 2 and 1 < min(shape) <= WIDE:
        for k in range(min(shape)):
            if shape[0] >= shape[1]:
                yield Leaf(parent, f"{name}[{k}]", shape[0], lambda a, b, k=k: np.asarray(values[a:b, k]), unit)  # type: ignore[misc]
            else:
                yield Leaf(parent, f"{name}[{k}]", shape[1], lambda a, b, k=k: np.asarray(values[k, a:b]), unit)  # type: ignore[misc]


def _in_tree(path: str) -> tuple[str, str]:
    parent, _, name = path.rpartition("/")
    return parent, name


class _Npy:
    """An array in a zip, read from its beginning to its end."""

    def __init__(self, path: Path, member: str) -> None:
        self._path, self._member = path, member
        with zipfile.ZipFile(path) as file, file.open(member) as stream:
            self.shape, fortran, self.dtype = self._header(stream)
            size = file.getinfo(member).file_size - stream.tell()
        if fortran and len(self.shape) > 1:
            raise ValueError(f"{member}: a matrix in Fortran's order")
        if self.dtype.hasobject:
            raise ValueError(f"{member} holds Python objects, which are not read")
        if int(np.prod(self.shape, dtype=object)) * self.dtype.itemsize > size:
            raise ValueError(f"{member} is shorter than it says")
        self._row = self.dtype.itemsize * int(np.prod(self.shape[1:], dtype=object))
        self._stream: Any = None
        self._at = 0

    @staticmethod
    def _header(stream: Any) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
        version = np.lib.format.read_magic(stream)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        try:
            return read(stream)
        except Exception as error:  # numpy takes it for Python's source: what is damaged raises anything
            raise ValueError(f"the header of an array is damaged: {error}") from None

    def __getitem__(self, rows: Any) -> NDArray[Any]:
        part = rows if isinstance(rows, slice) else rows[0]
        first, last = part.start, part.stop
        if self._stream is None or first < self._at:
            self._stream = zipfile.ZipFile(self._path).open(self._member)  # noqa: SIM115
            self._header(self._stream)
            self._at = 0
        if first > self._at:
            self._stream.read((first - self._at) * self._row)
        data = self._stream.read((last - first) * self._row)
        self._at = last
        found = np.frombuffer(data, self.dtype).reshape(-1, *self.shape[1:])
        return found if isinstance(rows, slice) else found[(slice(None), *rows[1:])]


def npz(path: Path) -> Leaves:
    """Arrays of an npz file; names such as group/speed are in tables."""
    errors = ValueError, zipfile.BadZipFile, KeyError, NotImplementedError, RuntimeError
    with reading(path, "npz file", *errors):
        units: dict[str, str] = {}
        found: list[Leaf] = []
        left_out = []
        with zipfile.ZipFile(path) as file:
            members = [name for name in file.namelist() if name.endswith(".npy")]
        for member in members:
            name = member.removesuffix(".npy")
            values = _Npy(path, member)
            if name == "units" and values.dtype.kind == "U":
                with suppress(ValueError), np.load(path, allow_pickle=False) as whole:
                    units = {str(k): str(v) for k, v in json.loads(str(whole["units"])).items()}
        for member in members:
            name = member.removesuffix(".npy")
            got = list(leaves_of(*_in_tree(name), _Npy(path, member), units.get(name, "")))
            found += got
            left_out += [] if got or name in ("units", "about") else [f"{printable(name)}: no column of numbers"]
    return _Guarded(path, "npz file", errors, "npz", found, left_out)


class _Guarded(Leaves):
    """Leaves whose library may raise these."""

    def __init__(
        self, path: Path, what: str, errors: tuple[type[Exception], ...], format: str, found: list[Leaf],
        left_out: list[str], about: Mapping[str, Any] | None = None,
    ) -> None:  # fmt: skip
        self._path, self._what, self._errors = path, what, errors
        if not found:
            raise BenchError(f"{path} holds no columns of numbers{': ' if left_out else ''}{'; '.join(left_out[:5])}")
        super().__init__(format, found, about or {}, left_out)

    def batches(self, wanted: Wanted) -> Iterator[Batch]:
        """See `Source`."""
        with reading(self._path, self._what, *self._errors):
            yield from super().batches(wanted)


def _try(what: str, path: Path, read: Callable[[Path], Any]) -> None:
    """Let a process of its own read a file first: a library in C may crash or hang over a damaged one. BenchError."""
    context: Any = multiprocessing.get_context("fork" if hasattr(os, "fork") else "spawn")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        trial = context.Process(target=_read, args=(read, path, folder), daemon=True)
        trial.start()
        trial.join(TRIAL + path.stat().st_size / TRIAL_RATE)
        if trial.exitcode is None:
            trial.kill()
            trial.join()
    if trial.exitcode != 0:
        raise BenchError(f"{path} is no {what} that can be read: it is damaged")


def _read(read: Callable[[Path], Any], path: Path, folder: str) -> None:
    """In that process, whose files are in `folder`; what Python can tell of the file is told later."""
    tempfile.tempdir = folder
    with suppress(Exception):
        read(path)
    os._exit(0)  # nothing of this program's ends twice


# -- MAT ------------------------------------------------------------------------------------------------------------


def mat(path: Path) -> Leaves:
    """Variables and the fields of structures; version 7.3 is HDF5."""
    errors: tuple[type[Exception], ...] = (Exception,)  # scipy's reader raises what it meets
    size = path.stat().st_size
    if size > available() // 4:
        raise BenchError(f"{path} takes {in_words(size)}, and {in_words(available())} of memory are free: save it as "
                         "version 7.3 (-v7.3), which is read in parts")  # fmt: skip
    with reading(path, "MAT file"):
        _try("MAT file", path, _loaded)
        try:
            whole = _loaded(path)
        except NotImplementedError:
            return hdf5(path, "mat")
        except OSError:
            raise
        except Exception as error:
            raise BenchError(f"{path} is no MAT file that can be read: {printable(str(error))[:150]}") from None
    found: list[Leaf] = []
    units = whole.pop("units", {})
    _walk("", {name: value for name, value in whole.items() if not name.startswith("__")}, units, found)
    return _Guarded(path, "MAT file", errors, "mat", found, [])


def _loaded(path: Path) -> Any:
    import scipy.io

    return scipy.io.loadmat(path, simplify_cells=True)


def _walk(parent: str, values: Mapping[str, Any], units: Any, found: list[Leaf]) -> None:
    for name, value in values.items():
        unit = units.get(name, "") if isinstance(units, dict) else ""
        if isinstance(value, dict):
            _walk(f"{parent}/{name}".strip("/"), value, unit, found)
        elif isinstance(value, np.ndarray):
            found += leaves_of(parent, name, value, unit if isinstance(unit, str) else "")


# -- HDF5 -----------------------------------------------------------------------------------------------------------


def hdf5(path: Path, format: str = "hdf5") -> Leaves:
    """Datasets of all groups, with the unit that an attribute tells."""
    extra("h5py", "h5py", "an HDF5 file")
    with reading(path, "HDF5 file", *_HDF5):
        _try("HDF5 file", path, _read_hdf5)
        found, left_out = _hdf5_leaves(path)
    return _Guarded(path, "HDF5 file", _HDF5, format, found, left_out)


def _read_hdf5(path: Path) -> None:
    for leaf in _hdf5_leaves(path)[0]:
        for first in range(0, leaf.n, BATCH):
            leaf.read(first, min(first + BATCH, leaf.n))


def _hdf5_leaves(path: Path) -> tuple[list[Leaf], list[str]]:
    import h5py

    found: list[Leaf] = []
    left_out: list[str] = []

    def visit(name: str, item: Any) -> None:
        if not isinstance(item, h5py.Dataset) or name.startswith("#"):
            return
        got = list(leaves_of(*_in_tree(name), item, _attribute(item, "unit", "units", "Unit", "Units")))
        found.extend(got)
        if not got and item.shape not in ((), (1,), None):
            left_out.append(f"{printable(name)}: no column of numbers")

    h5py.File(path, "r").visititems(visit)
    return found, left_out


def _attribute(item: Any, *names: str) -> str:
    for name in names:
        with suppress(Exception):  # an attribute may be of any type
            value = item.attrs.get(name)
            if value is not None:
                return value.decode() if isinstance(value, bytes) else str(value)
    return ""


# -- TDMS -----------------------------------------------------------------------------------------------------------


def tdms(path: Path) -> Leaves:
    """Channels of all groups; wf_increment tells their rate."""
    nptdms = extra("nptdms", "npTDMS", "a TDMS file")
    errors: tuple[type[Exception], ...] = (Exception,)  # its reader raises what it meets
    found: list[Leaf] = []
    left_out: list[str] = []
    with reading(path, "TDMS file", *errors), told_by("nptdms", left_out):
        file = nptdms.TdmsFile.open(path)
        for group in file.groups():
            for channel in group.channels():
                if channel.dtype.kind not in "iufbM" or len(channel) < 2:
                    left_out.append(f"{printable(channel.name)}: no column of numbers")
                    continue
                step = float(channel.properties.get("wf_increment", 0.0) or 0.0)
                unit = str(
                    channel.properties.get("unit_string", "") or channel.properties.get("NI_UnitDescription", "")
                )
                read = partial(_slice, channel)
                found.append(Leaf(group.name, channel.name, len(channel), read, unit, 1.0 / step if step > 0 else 0.0))
    return _Guarded(path, "TDMS file", errors, "tdms", found, left_out)


def _slice(values: Any, first: int, last: int) -> NDArray[Any]:
    return np.asarray(values[first:last])


# -- MDF 4 ----------------------------------------------------------------------------------------------------------


class MdfFile:
    """Channel groups with their master. Raises BenchError."""

    format = "mdf4"
    together = False

    def __init__(self, path: Path, tried: bool = False) -> None:
        asammdf = extra("asammdf", "asammdf", "an MDF file")
        if not tried:
            _try("MDF file", path, _read_mdf)
        self._path = path
        self.left_out: list[str] = []
        with reading(path, "MDF file", Exception), told_by("asammdf", self.left_out):  # it raises what it meets
            self._copies = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)  # of a file that was not finished
            self._mdf = asammdf.MDF(path, temporary_folder=self._copies.name)
            self._where: dict[str, tuple[int, int, dict[str, int]]] = {}
            self.tables = tuple(self._tables())
            start = self._mdf.header.start_time
            self.about: Mapping[str, Any] = (
                {"started": start.isoformat(timespec="seconds")} if start.year > 1980 else {}
            )
        if not self.tables:
            raise BenchError(f"{path} holds no channels with numbers{': ' if self.left_out else ''}"
                             f"{'; '.join(self.left_out[:5])}")  # fmt: skip

    def _tables(self) -> Iterator[Table]:
        for number, group in enumerate(self._mdf.groups):
            n = int(group.channel_group.cycles_nr)
            master = self._mdf.masters_db.get(number)
            if n * int(group.channel_group.samples_byte_nr) > DEFLATED * self._path.stat().st_size:
                raise BenchError(f"{self._path} says that it has {n} records, more than it can hold: it is damaged")
            if n < 2 or master is None:
                self.left_out += [f"{printable(c.name)}: no time" for c in group.channels[:3] if master is None]
                continue
            time = group.channels[master].name or "time"
            columns: dict[str, int] = {}
            units = {time: "s"}
            for k, channel in enumerate(group.channels):
                if k == master:
                    continue
                one = _physical(self._mdf.get(group=number, index=k, raw=True, record_offset=0, record_count=1))
                if one.samples.dtype.kind not in "iufb" or one.samples.ndim != 1:
                    self.left_out.append(f"{printable(channel.name)}: no number")
                    continue
                name = channel.name if channel.name not in (time, *columns) else f"{channel.name} ({k})"
                columns[name], units[name] = k, one.unit or ""
            if not columns:
                continue
            name = group.channel_group.acq_name or f"group {number}"
            if name in self._where:
                name = f"{name} {number}"
            self._where[name] = number, n, columns
            yield Table(name, tuple(Column(column, units[column]) for column in (time, *columns)), time)

    def batches(self, wanted: Wanted) -> Iterator[Batch]:
        """See `Source`."""
        for table in self.tables:
            if table.name not in wanted:
                continue
            number, n, columns = self._where[table.name]
            names = [name for name in wanted[table.name] if name != table.time]
            for first in range(0, n, RECORDS):
                with reading(self._path, "MDF file", Exception), told_by("asammdf", self.left_out):
                    found: Arrays = {}
                    chosen = names or list(columns)[:1]
                    signals = self._mdf.select([(None, number, columns[name]) for name in chosen], raw=True,
                                               record_offset=first, record_count=min(RECORDS, n - first))  # fmt: skip
                    for name, signal in zip(chosen, signals, strict=True):
                        one = _physical(signal)
                        found[table.time or ""] = one.timestamps
                        if name in names:
                            found[name] = _valid(one)
                    if len({len(values) for values in found.values()}) > 1:
                        raise ValueError(f"channels of {printable(table.name)} differ in length")
                yield {table.name: found}
                if len(found[table.time or ""]) < min(RECORDS, n - first):
                    break  # the file ends before it said

    def line(self, table: str, row: int) -> str:
        """See `Source`."""
        return f"in record {row + 1} of {printable(table)}"


def _read_mdf(path: Path) -> None:
    file = MdfFile(path, tried=True)
    for table in file.tables:
        for _ in file.batches({table.name: table.names}):
            pass


def _physical(signal: Any) -> Any:
    """A signal with values in its unit; numbers where the file has words for them."""
    return signal.physical(ignore_value2text_conversions=True)


def _valid(signal: Any) -> NDArray[Any]:
    """Values of a signal, NaN where its invalidation bit is set."""
    bits = signal.invalidation_bits
    if bits is None or not np.any(bits):
        return np.asarray(signal.samples)
    return np.where(np.asarray(bits, bool), np.nan, signal.samples.astype(np.float64))
