"""What the simulated bench recorded over some periods: columns in SI units, raw samples made of them when asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.descriptor import Channel, sample_dtype
from protocol.signals import DRIVE_CHANNELS, LOAD_CHANNELS, Flag, RawType, Signal, Status
from protocol.streams import EDGE_RECORD
from sim.drive import tick_record as record
from sim.drive.tick import RECORDS
from sim.native import Cells, address, layout
from sim.observers.entry import Entry
from sim.observers.hall_speed import Edge

LOAD_DTYPE = sample_dtype(LOAD_CHANNELS)
FLAGS = {"on": Status.CORRECTION_ON, "sync": Status.INJECTION_SYNC}
"""What the vector-tracking observer adds to the status: fields of its estimates."""
BY_VECTOR_TRACKING = (*FLAGS, "e_alpha", "e_beta")
_KINDS = {RawType.I16: record.CLIPPED, RawType.U16: record.UNSIGNED, RawType.U8: record.BYTE, RawType.F32: record.FLOAT}
_WORD = 8


class _Table(NamedTuple):
    columns: Cells  # record.Column
    dtype: np.dtype[np.void]  # of a raw sample
    whole: bool  # all of it is made
    channels: tuple[Channel | Signal, ...]


class Sections:
    """How a block is divided: the records of the loop, and the estimates of each of `running`.

    A section holds as many records as there are periods, one section after the other.
    """

    def __init__(self, running: Sequence[Entry]) -> None:
        self.at: dict[str, int] = {}
        """Words of a record of all sections before, by the observer's name."""
        self.words = 0
        """Of a period."""
        self.whole: set[str] = set()
        """Columns of whole numbers."""
        self._found: dict[str, tuple[int, int, int]] = {}
        self._tables: dict[tuple[int, frozenset[str] | None], _Table] = {}
        self.loop: list[tuple[int, int]] = []
        """Bytes of a record of all sections before, and its own, for each of the loop's records."""
        for kind in RECORDS:
            self.loop.append((_WORD * self.words, layout(kind).itemsize))
            self._add(layout(kind), {name: name for name in kind._fields})
        for entry in running:
            more = {name: name for name in BY_VECTOR_TRACKING} if entry.name == "vector_tracking" else {}
            self.at[entry.name] = self.words
            self._add(layout(entry.kinds[2]), {**entry.channels, **more})

    def _add(self, kind: np.dtype[np.void], fields: Mapping[str, str]) -> None:
        assert kind.fields is not None
        for column, field in fields.items():
            place = self.words, kind.fields[field][1] // _WORD, kind.itemsize // _WORD
            self._found.setdefault(column, place)
            if kind.fields[field][0].kind == "i":
                self.whole.add(column)
        self.words += kind.itemsize // _WORD

    def column(self, block: NDArray[np.float64], n: int, name: str) -> NDArray[np.float64]:
        """A column of a block of n periods, shape (n,); KeyError if there is none."""
        section, field, stride = self._found[name]
        here = block[section * n + field :][: n * stride : stride]
        return here.view(np.int64) if name in self.whole else here

    def where(self, name: str) -> tuple[int, int, int]:
        """Section, field and stride of a column, in words; KeyError if there is none."""
        return self._found[name]

    def table(self, channels: tuple[Channel | Signal, ...], only: frozenset[str] | None) -> _Table:
        """How raw samples of these channels are made, of all or of some of them."""
        key = id(channels), only  # the table keeps them, so no others get this id
        if key not in self._tables:
            dtype = sample_dtype(channels)
            assert dtype.fields is not None
            columns = []
            made = [c for c in channels if c.name in self._found and (only is None or c.name in only)]
            for channel in made:
                kind = record.TURNS if channel.flags & Flag.WRAPS else _KINDS[channel.raw]
                at = dtype.fields[channel.name][1]
                columns.append(record.Column(*self.where(channel.name), kind, 1.0 / channel.scale, at))
                if channel.name == "status":
                    columns += [
                        record.Column(*self.where(field), record.FLAG, float(bit), at)
                        for field, bit in FLAGS.items()
                        if field in self._found
                    ]
            cells = Cells(record.Column, len(columns))
            cells.array[:] = columns
            self._tables[key] = _Table(cells, dtype, len(made) == len(channels), channels)
        return self._tables[key]


@dataclass
class Recorded:
    """What n periods recorded, and m edges. `recorded[name]`: a column, see `__getitem__`."""

    index: int
    """PWM period of the first sample."""
    tick: int
    """Of the first sample."""
    n: int
    sections: Sections
    block: NDArray[np.float64]
    captured: NDArray[np.void]
    """Edges as observers see them, records of `Edge`, shape (m,)."""
    edges: NDArray[np.void]
    """The same as on the wire, EDGE_RECORD."""
    load_state: int

    def __len__(self) -> int:
        return self.n

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        """A channel's values, not rounded and angles not wrapped, or another field of `Row`; SI units, shape (n,).

        Channels of whole numbers come as such. KeyError for a channel of an observer that was not running.
        """
        return self.sections.column(self.block, self.n, name)

    @property
    def edge_tick(self) -> NDArray[np.int64]:
        """Ticks of the edges, not cut to 32 bits, shape (m,)."""
        ticks: NDArray[np.int64] = self.captured["tick"]
        return ticks

    def raw(self, channels: tuple[Channel | Signal, ...], only: frozenset[str] | None = None) -> NDArray[np.void]:
        """Raw samples of these channels of the drive, as on the wire, shape (n,).

        Zero where an observer did not run, and, if `only` some are wanted (names), in all others.
        """
        table = self.sections.table(channels, only)
        made = np.empty(self.n, table.dtype) if table.whole else np.zeros(self.n, table.dtype)
        block = address(self.block)
        record.pack(table.columns.at, len(table.columns), block, block, self.n, address(made), table.dtype.itemsize)
        return made

    @cached_property
    def samples(self) -> NDArray[np.void]:
        """Raw samples of all channels that a drive of this package has."""
        return self.raw(DRIVE_CHANNELS)

    @property
    def load_samples(self) -> NDArray[np.void]:
        """Raw samples of the load machine."""
        made = np.empty(self.n, LOAD_DTYPE)
        made["omega_m"], made["tau_load"], made["status"] = self["omega_m"], self["tau_load_true"], self.load_state
        return made


assert layout(Edge).itemsize == 2 * _WORD
assert EDGE_RECORD.itemsize == _WORD
