"""Level 1, third part: the blobs of features, meanings and the waveform. Chapters 5 and 20 of SPEC."""

from __future__ import annotations

import struct
import unicodedata
from collections.abc import Iterator

from bench.conform.checks import Group
from bench.conform.device import Device
from bench.conform.levels import IDENTITY
from bench.conform.probe import Answer, accepted, refusal
from bench.conform.verdicts import Failed
from protocol.codes import ErrorCode, Feature, MessageType
from protocol.messages import BlobRead, BlobReply, BlobWrite

check = Group("blob", IDENTITY)

MEANINGS, WAVEFORM = 3, 4
LEAST_WAVEFORM = 512  # bytes
MEANING_BYTES = 200
ODD = 97  # bytes that are asked for at once, to compare with longer parts
LONG = 40  # bytes that are written at once
NO_BLOB = 2


@check("meanings", "5.45 5.20 5.23")
def meanings(device: Device) -> str:
    """Blob 3 has a line for each name that it explains: the name, a space, and the meaning."""
    device.require(Feature.MEANINGS)
    blob = device.read_blob(MEANINGS)
    if device.read_blob(MEANINGS, ODD) != blob:
        raise Failed(f"blob 3 has other bytes when it is read {ODD} bytes at a time")
    try:
        text = blob.decode()
    except UnicodeDecodeError as error:
        raise Failed(f"blob 3 is not UTF-8: {error}") from None
    *lines, rest = text.split("\n")
    if rest:
        raise Failed(f"blob 3 ends with {rest[-40:]!r}, without a line feed")
    names = {each.name for each in (*device.descriptor.channels, *device.descriptor.parameters)}
    seen: set[str] = set()
    for line in lines:
        name, space, meaning = line.partition(" ")
        reasons = {
            "has no meaning": not space or not meaning,
            "begins with no name of the descriptor": name not in names,
            "has a name that came before": name in seen,
            "has control characters": any(unicodedata.category(letter) == "Cc" for letter in line),
            f"has a meaning of {len(meaning.encode())} bytes": len(meaning.encode()) > MEANING_BYTES,
        }
        for words, wrong in reasons.items():
            if wrong:
                raise Failed(f"the line {line[:60]!r} {words}")
        seen.add(name)
    return f"{len(seen)} of {len(names)} names are explained, in {len(blob)} bytes"


def write(device: Device, blob: int, offset: int, data: bytes) -> Answer:
    """Send a BLOB_WRITE."""
    return device.probe.ask(MessageType.BLOB_WRITE, BlobWrite(blob, len(data), offset, data).pack())


@check("waveform", "20.13 5.20 5.21 5.23")
def waveform(device: Device) -> str:
    """Blob 4 takes what is written, there and nowhere else, and keeps its length; it is left as it was."""
    device.require(Feature.WAVEFORM)
    before = device.read_blob(WAVEFORM)
    if len(before) < LEAST_WAVEFORM or len(before) % 2:
        raise Failed(f"blob 4 has {len(before)} bytes")
    due, places = bytearray(before), (0, 101, len(before) - LONG)
    try:
        for place in places:
            data = bytes(byte ^ 0x5A for byte in due[place : place + LONG])
            due[place : place + LONG] = data
            answer = write(device, WAVEFORM, place, data)
            words = accepted(answer, f"BLOB_WRITE of {LONG} bytes at {place}")
            if answer.frame.payload:
                raise Failed(f"{words} with {len(answer.frame.payload)} bytes")
        accepted(write(device, WAVEFORM, len(before), b""), "BLOB_WRITE of none")
        now = device.read_blob(WAVEFORM)
    finally:
        for place in places:
            write(device, WAVEFORM, place, before[place : place + LONG])
    wrong = [at for at, (one, other) in enumerate(zip(now, due, strict=False)) if one != other]
    if len(now) != len(due) or wrong:
        where = (
            f"byte {wrong[0]} is {now[wrong[0]]:02x}, not {due[wrong[0]]:02x}" if wrong else f"it has {len(now)} bytes"
        )
        raise Failed(f"blob 4 was written at {places}: {where}")
    return f"{len(before)} bytes; written at {', '.join(map(str, places))}, and nowhere else"


@check("write-refusals", "5.47 5.48 5.49 5.50")
def write_refusals(device: Device) -> Iterator[str]:
    """Each error in BLOB_WRITE is refused with its code and detail, the first of several, and nothing is written."""
    device.require(Feature.WAVEFORM)
    before = device.read_blob(WAVEFORM)
    total = len(before)
    other = bytes(byte ^ 0xFF for byte in before[-8:])
    rows = [
        (NO_BLOB, 0, other, ErrorCode.UNKNOWN_ID, NO_BLOB), (255, 0xFFFFFFFF, other, ErrorCode.UNKNOWN_ID, 255),
        (0, 0, other, ErrorCode.READ_ONLY, 0), (0, 0xFFFFFFFF, b"", ErrorCode.READ_ONLY, 0),
        (WAVEFORM, total - 4, other, ErrorCode.OUT_OF_RANGE, total),
        (WAVEFORM, total, other[:1], ErrorCode.OUT_OF_RANGE, total),
        (WAVEFORM, 0xFFFFFFFC, other, ErrorCode.OUT_OF_RANGE, total),
        (WAVEFORM, total + 1, b"", ErrorCode.OUT_OF_RANGE, total),
    ]  # fmt: skip
    if device.offers(Feature.MEANINGS):
        rows.append((MEANINGS, 0, other, ErrorCode.READ_ONLY, MEANINGS))
    for blob, offset, data, code, detail in rows:
        words = f"BLOB_WRITE of {len(data)} bytes at {offset} of blob {blob}"
        yield refusal(write(device, blob, offset, data), code, detail, words)
    if device.read_blob(WAVEFORM) != before:
        raise Failed("BLOB_WRITE was refused, but blob 4 has changed")


@check("write-once", "3.13 3.28")
def write_once(device: Device) -> str:
    """A repeated BLOB_WRITE is not executed again."""
    device.require(Feature.WAVEFORM)
    probe, before = device.probe, device.read_blob(WAVEFORM)[:2]
    (value,) = struct.unpack("<H", before)
    other = BlobWrite(WAVEFORM, 2, 0, struct.pack("<H", value ^ 0xFFFF))
    first = probe.frame(MessageType.BLOB_WRITE, other.pack())
    try:
        accepted(probe.ask_frame(first), "BLOB_WRITE")
        accepted(write(device, WAVEFORM, 0, before), "BLOB_WRITE")
        accepted(probe.ask_frame(first), "BLOB_WRITE, repeated")
        if probe.get(BlobRead(WAVEFORM, 2, 0), BlobReply).data != before:
            raise Failed("a repeated BLOB_WRITE was executed again, over one that came between")
    finally:
        write(device, WAVEFORM, 0, before)
    return "a repeated BLOB_WRITE was answered, and not executed again"
