"""The descriptor: what goes out comes back, as 32-byte records of the documented layout."""

from __future__ import annotations

import hbp_reference as reference
import pytest

from protocol.descriptor import Channel, Descriptor
from protocol.errors import DeviceDefect, LocalProtocolError
from protocol.signals import (
    DRIVE_CHANNELS,
    DRIVE_PARAMETERS,
    LOAD_CHANNELS,
    LOAD_PARAMETERS,
    Flag,
    Parameter,
    RawType,
    Signal,
    Unit,
)
from protocol.validity import RECORD_BYTES


@pytest.mark.parametrize(
    ("channels", "parameters"), [(DRIVE_CHANNELS, DRIVE_PARAMETERS), (LOAD_CHANNELS, LOAD_PARAMETERS)]
)
def test_round_trip(channels: tuple[Signal, ...], parameters: tuple[Parameter, ...]) -> None:
    descriptor = Descriptor.of(channels, parameters)
    blob = descriptor.pack()
    assert len(blob) == RECORD_BYTES * (len(channels) + len(parameters))
    assert Descriptor.unpack(blob) == descriptor
    assert Descriptor.unpack(blob).crc == reference.crc32(blob)
    assert [c.name for c in descriptor.channels] == [c.name for c in channels]


def test_record_layout() -> None:
    signal = Signal(0x0102, "θ", Unit.RAD, RawType.I16, 0.5, Flag.CHANNEL | Flag.WRAPS, "an angle", offset=-2.0)
    expected = reference.fields(
        ("u16", 0x0102), ("u8", 4), ("u8", 1), ("u16", 33), ("u16", 0),
        ("f32", 0.5), ("f32", -2.0), ("text16", "θ"),
    )  # fmt: skip
    assert Descriptor.of([signal], []).pack() == expected


def test_unknown_names_are_named() -> None:
    descriptor = Descriptor.of(LOAD_CHANNELS, LOAD_PARAMETERS)
    with pytest.raises(KeyError, match="no channel 'speed'; there are: omega_m, tau_load, status"):
        descriptor.channel("speed")
    assert descriptor.parameter("watchdog").unit is Unit.S


def test_what_a_later_version_may_add_is_kept() -> None:
    blob = bytearray(Descriptor.of(LOAD_CHANNELS, []).pack())
    blob[3] = 200
    blob[5] = 0x80
    blob[36:38] = bytes(2)  # the second is neither a channel nor a parameter
    channels = Descriptor.unpack(bytes(blob)).channels
    assert (channels[0].unit, channels[0].unit.symbol) == (200, "unit 200")
    assert channels[0].flags == Flag.CHANNEL | 0x8000
    assert [channel.name for channel in channels] == ["omega_m", "status"]


def test_a_parameter_is_a_float32_whatever_its_record_says() -> None:
    blob = bytearray(Descriptor.of([], LOAD_PARAMETERS[:1]).pack())
    blob[2], blob[8:16] = 99, b"\xff" * 8
    (parameter,) = Descriptor.unpack(bytes(blob)).parameters
    assert (parameter.raw, parameter.scale, parameter.offset) == (RawType.F32, 1.0, 0.0)


BLOB = Descriptor.of(LOAD_CHANNELS, LOAD_PARAMETERS).pack()


def changed(at: int, values: bytes) -> bytes:
    return BLOB[:at] + values + BLOB[at + len(values) :]


@pytest.mark.parametrize(
    ("blob", "words"),
    [
        (BLOB[:-1], f"has {len(BLOB) - 1} bytes, must be at most 4096 records of 32"),
        (bytes(4097 * 32), "has 131104 bytes"),
        (changed(2, b"\x63"), "channel 'omega_m' has the unknown type 99"),
        (changed(8, bytes(4)), "channel 'omega_m' has scale 0 and offset 0"),
        (changed(8, b"\0\0\xc0\x7f"), "channel 'omega_m' has scale nan"),
        (changed(12, b"\0\0\x80\xff"), "channel 'omega_m' has scale 1 and offset -inf"),
        (changed(16, bytes(16)), "channel 1 has an empty name"),
        (changed(96 + 16, bytes(16)), "parameter 101 has an empty name"),
        (BLOB[:32] + BLOB, "channel 1 comes twice"),
        (changed(32, b"\x09\0") [:48] + BLOB[16:32] + BLOB[64:], "channel 'omega_m' comes twice"),
        (BLOB + BLOB[-32:], "parameter 115 comes twice"),
        (changed(16, b"\xff\xfe" + bytes(14))[:48] + b"\xfd\xfc" + bytes(14) + BLOB[64:], "'\ufffd\ufffd' comes twice"),
    ],
)  # fmt: skip
def test_what_a_host_cannot_work_with_is_refused(blob: bytes, words: str) -> None:
    with pytest.raises(DeviceDefect) as caught:
        Descriptor.unpack(blob, "node 3")
    text = str(caught.value)
    assert words in text
    assert text.startswith("the descriptor of node 3")
    assert text.endswith(": fix the firmware")
    assert "\n" not in text


def test_a_descriptor_that_cannot_be_sent() -> None:
    with pytest.raises(LocalProtocolError, match="18 bytes, 1 to 16 fit"):
        Descriptor((Channel(1, "x" * 18, Unit.NONE, RawType.U8, 1.0, Flag.CHANNEL),), ()).pack()
    with pytest.raises(LocalProtocolError, match="0 bytes, 1 to 16 fit"):
        Descriptor((Channel(1, "", Unit.NONE, RawType.U8, 1.0, Flag.CHANNEL),), ()).pack()
    with pytest.raises(LocalProtocolError, match="'x' does not fit"):
        Descriptor((Channel(70000, "x", Unit.NONE, RawType.U8, 1.0, Flag.CHANNEL),), ()).pack()
