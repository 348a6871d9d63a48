"""The device's blobs: its descriptor, the capture that is held, what names mean, the waveform of the test signal."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping

import numpy as np
from numpy.typing import NDArray

from protocol.device.capture import Capture
from protocol.errors import Refused
from protocol.messages import BlobRead, BlobReply, BlobWrite, ErrorCode

DESCRIPTOR, CAPTURE, MEANINGS, WAVEFORM = 0, 1, 3, 4
MEANING_BYTES = 200  # of one meaning at most
CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")
"""Characters that no text has on the wire."""


def meanings_blob(meanings: Mapping[str, str], names: Collection[str]) -> bytes:
    """Return blob 3; ValueError for a name that is not among the descriptor's `names`, and a text that cannot be."""
    for name, text in meanings.items():
        if name not in names:
            raise ValueError(f"the meaning of {name!r}, which is neither channel nor parameter")
        if CONTROL.search(text) or len(text.encode()) > MEANING_BYTES:
            raise ValueError(f"the meaning of {name!r} has control characters, or more than {MEANING_BYTES} bytes")
    return "".join(f"{name} {text}\n" for name, text in meanings.items()).encode()


class Blobs:
    """The blobs of one device; what it has not is None.

    `testing` returns whether the test signal is on, while which the waveform must not change.
    """

    def __init__(
        self,
        descriptor: bytes,
        capture: Capture | None,
        meanings: bytes | None,
        waveform: NDArray[np.int16] | None,
        testing: Callable[[], bool],
    ) -> None:
        self._fixed = {DESCRIPTOR: descriptor} | ({} if meanings is None else {MEANINGS: meanings})
        self._capture = capture
        self._waveform = None if waveform is None else waveform.view(np.uint8)
        self._testing = testing

    def read(self, request: BlobRead, tx_max: int) -> BlobReply:
        """Carry out BLOB_READ, with as many bytes as fit; Refused if there is no such blob or place in it."""
        blob = self._blob(request.id)
        total = len(blob)
        if request.offset > total:
            raise Refused(f"offset {request.offset}", ErrorCode.OUT_OF_RANGE, total)
        room = tx_max - BlobReply.FIXED_BYTES
        data = bytes(blob[request.offset : request.offset + min(request.length, room)])
        return BlobReply(request.id, len(data), request.offset, total, data)

    def write(self, request: BlobWrite) -> None:
        """Carry out BLOB_WRITE; Refused, nothing written, if it cannot be done."""
        blob = self._blob(request.id)
        if request.id != WAVEFORM:
            raise Refused(f"blob {request.id} is read-only", ErrorCode.READ_ONLY, request.id)
        end = request.offset + len(request.data)
        if end > len(blob):
            raise Refused(f"bytes up to {end}", ErrorCode.OUT_OF_RANGE, len(blob))
        if self._testing():
            raise Refused("the test signal is on", ErrorCode.BUSY, request.id)
        assert self._waveform is not None
        self._waveform[request.offset : end] = np.frombuffer(request.data, np.uint8)

    def _blob(self, number: int) -> bytes | NDArray[np.uint8]:
        blob: bytes | NDArray[np.uint8] | None = self._fixed.get(number)
        if number == WAVEFORM:
            blob = self._waveform
        elif number == CAPTURE and self._capture is not None:
            blob = self._capture.blob
        if blob is None:
            raise Refused(f"no blob {number}", ErrorCode.UNKNOWN_ID, number)
        return blob
