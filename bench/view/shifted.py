"""A rerun stream in whose place another time begins: for runs that are laid over each other, or begin at a trigger."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr


class Shifted:
    """Stands for a stream: what is logged goes below an entity, or in place if that is empty, `shift` ns earlier."""

    def __init__(self, stream: rr.RecordingStream, below: str, shift: int) -> None:
        self._stream, self._below, self._shift = stream, f"{below}/" if below else "", np.timedelta64(shift, "ns")

    def log(self, entity: str, *parts: Any, static: bool = False) -> None:
        """See rerun."""
        self._stream.log(f"{self._below}{entity}", *parts, static=static)

    def set_time(self, timeline: str, duration: np.timedelta64) -> None:
        """See rerun."""
        self._stream.set_time(timeline, duration=duration - self._shift)

    def send_record_batch(self, batch: pa.RecordBatch, index: str, entity_path: str) -> None:
        """See rerun."""
        at = batch.schema.get_field_index(index)
        shifted = pa.array(batch.column(at).to_numpy() - self._shift)
        batch = batch.set_column(at, batch.schema.field(at), shifted)
        self._stream.send_record_batch(batch, index=index, entity_path=f"{self._below}{entity_path}")
