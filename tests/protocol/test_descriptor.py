"""The descriptor: what goes out comes back, as 32-byte records of the documented layout."""

from __future__ import annotations

import hbp_reference as reference
import numpy as np
import pytest

from protocol.descriptor import RECORD_BYTES, Channel, Descriptor, sample_dtype
from protocol.errors import LocalProtocolError
from protocol.messages import PayloadError
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


def test_the_scale_is_what_float32_holds() -> None:
    channel = Descriptor.of(DRIVE_CHANNELS, []).channel("theta_enc")
    assert channel.scale == float(np.float32(np.pi / 32768))
    assert Descriptor.of(DRIVE_CHANNELS, []).channel("i_a").scale == 1 / 1024  # exact in float32: no rounding


def test_dtype_is_packed_in_order() -> None:
    dtype = sample_dtype(DRIVE_CHANNELS)
    assert dtype.itemsize == sum(np.dtype(c.raw.dtype).itemsize for c in DRIVE_CHANNELS) == 83
    assert dtype.names == tuple(c.name for c in DRIVE_CHANNELS)


def test_unknown_names_are_named() -> None:
    descriptor = Descriptor.of(LOAD_CHANNELS, LOAD_PARAMETERS)
    with pytest.raises(KeyError, match="no channel 'speed'; there are: omega_m, tau_load, status"):
        descriptor.channel("speed")
    assert descriptor.parameter("watchdog").unit is Unit.S


def test_a_unit_of_a_later_version_is_a_pure_number_and_unknown_flags_stay() -> None:
    blob = bytearray(Descriptor.of(LOAD_CHANNELS, []).pack())
    blob[3] = 200
    blob[5] = 0x80
    channel = Descriptor.unpack(bytes(blob)).channels[0]
    assert channel.unit is Unit.NONE
    assert channel.flags == Flag.CHANNEL | 0x8000


def test_bad_blobs_are_refused() -> None:
    blob = Descriptor.of(LOAD_CHANNELS, LOAD_PARAMETERS).pack()
    with pytest.raises(PayloadError, match="not in 32-byte records"):
        Descriptor.unpack(blob[:-1])
    with pytest.raises(PayloadError, match="'omega_m' has the unknown type 99"):
        Descriptor.unpack(blob[:2] + bytes([99]) + blob[3:])
    with pytest.raises(PayloadError, match="channel 1 comes twice"):
        Descriptor.unpack(blob[:32] + blob)
    with pytest.raises(LocalProtocolError, match="18 bytes, at most 16 fit"):
        Descriptor((Channel(1, "x" * 18, Unit.NONE, RawType.U8, 1.0, Flag.CHANNEL),), ()).pack()
    with pytest.raises(LocalProtocolError, match="'x' does not fit"):
        Descriptor((Channel(70000, "x", Unit.NONE, RawType.U8, 1.0, Flag.CHANNEL),), ()).pack()
