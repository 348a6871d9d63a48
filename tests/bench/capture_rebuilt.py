"""The bytes of a drive's buffer, made again from what became of them, by SPEC's tables and `struct` alone."""

from __future__ import annotations

import struct

import numpy as np

from protocol.streams import EdgeChunk, SampleChunk

FORMATS = {"uint8": "B", "int8": "b", "uint16": "H", "int16": "h", "uint32": "I", "int32": "i", "float32": "f"}


def buffer_of(samples: SampleChunk, edges: EdgeChunk | None) -> bytes:
    """Blob 1 as chapter 19 has it: the records, packed, then 8 bytes for each edge (chapter 11)."""
    names = samples.raw.dtype.names
    assert names is not None
    form = struct.Struct("<" + "".join(FORMATS[np.dtype(samples.raw.dtype[name]).name] for name in names))
    rows = b"".join(form.pack(*(samples.raw[name][k].item() for name in names)) for k in range(len(samples)))
    if edges is None:
        return rows
    columns = zip(edges.tick, edges.hall_old, edges.hall_new, edges.illegal, edges.encoder, strict=True)
    return rows + b"".join(
        struct.pack("<IBBH", int(tick) & 0xFFFFFFFF, int(old) | int(new) << 3 | bool(bad) << 6, 0, int(count))
        for tick, old, new, bad, count in columns
    )
