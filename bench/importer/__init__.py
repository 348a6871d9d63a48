"""Data that other tools recorded, made a run: read, mapped to the names that everything else here knows, told apart."""

FORMATS = {
    "asc": (".asc",), "blf": (".blf",), "candump": (".log",), "csv": (".csv", ".txt", ".tsv"),
    "hdf5": (".h5", ".hdf5", ".hdf"), "json": (".jsonl", ".ndjson"), "mat": (".mat",), "mdf4": (".mf4", ".mdf"),
    "moteus": (".dat", ".dat.gz"), "npz": (".npz",), "parquet": (".parquet",), "sigrok": (".sr",), "tdms": (".tdms",),
    "trc": (".trc",), "vcd": (".vcd",),
}  # fmt: skip
"""Formats that can be read, and how their files' names end."""
