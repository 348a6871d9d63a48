"""Names of angle sources, channels by what they are, and plain data in words, against what stands in SPEC and here."""

from __future__ import annotations

import math

import numpy as np
import pytest

from bench.report.words import date, labelled, plain
from bench.signal.channels import flagged, reference_angle, role, speed_channel
from bench.signal.sources import source_name, source_names, source_number, source_short
from bench.signal.versions import versions
from protocol.descriptor import Channel
from protocol.signals import Flag, RawType, Unit


def channel(name: str, unit: Unit, flag: Flag = Flag.CHANNEL) -> Channel:
    return Channel(1, name, unit, RawType.F32, 1.0, Flag.CHANNEL | flag)


ANGLES = [channel("i_a", Unit.A), channel("theta_x", Unit.RAD, Flag.ESTIMATE), channel("enc", Unit.RAD, Flag.REFERENCE)]
SPEEDS = [channel("omega_avg", Unit.RAD_PER_S, Flag.ESTIMATE), channel("omega_vt", Unit.RAD_PER_S, Flag.ESTIMATE)]
ENCODER = channel("omega_enc", Unit.RAD_PER_S, Flag.REFERENCE)


def test_channels_are_found_by_what_they_are() -> None:
    assert (reference_angle(ANGLES), reference_angle(ANGLES[:2]), flagged(ANGLES, Unit.A, Flag.ESTIMATE)) == (
        "enc",
        "",
        "",
    )
    assert flagged(ANGLES, Unit.RAD, Flag.TRUTH, Flag.ESTIMATE, Flag.REFERENCE) == "theta_x"
    assert [role(each) for each in ANGLES] == ["", "estimate", "reference"]
    # the encoder's, else that of the angle in use (2 is vector tracking), else the first
    assert speed_channel([*SPEEDS, ENCODER], {}) == "omega_enc"
    assert [speed_channel(SPEEDS, {"observer": n}) for n in (2.0, 1.0, 9.0)] == ["omega_vt", "omega_avg", "omega_avg"]
    assert (speed_channel(SPEEDS, {}), speed_channel(ANGLES, {"observer": 2.0})) == ("omega_avg", "")


def test_every_source_has_a_name_a_number_and_a_short_name() -> None:
    assert source_names()[:3] == ["encoder", "average-speed", "vector-tracking"]
    for name in source_names():
        number = source_number(name.replace("-", "_"))
        assert (source_name(number), bool(source_short(number))) == (name, True)
    assert [source_short(n) for n in (1.0, 2.0, 2.5, -1.0, 1e6, math.nan)] == ["avg", "vt", "", "", "", ""]
    assert (source_number("nobody"), source_name(99.0)) == (None, "")


@pytest.mark.parametrize(("found", "words"), [
    (date("2026-03-01T14:05:06+01:30"), "2026-03-01 14:05:06 UTC+01:30"),
    (date("2026-03-01T14:05:06"), "2026-03-01 14:05:06"),
    (date("yesterday"), "yesterday"),
    (labelled("pwm_hz", 16_000), ("PWM", "16000 Hz")),
    (labelled("tick_hz", 20_000_000), ("tick", "20 MHz")),
    (labelled("tick_hz", 999_999), ("tick", "999999 Hz")),
    (labelled("boot_id", "0a"), ("boot ID", "0a")),
    (labelled("tick_hz", "84000001"), ("tick", "84.000001 MHz")),
    (labelled("tick_hz", "unknown"), ("tick hz", "unknown")),
    (labelled("schema_crc", "4d977534"), ("schema CRC", "4d977534")),
    (labelled("features", ["a", "b"]), ("features", "a, b")),
    (labelled("features", []), ("features", "none")),
    (labelled("vendor", ""), ("vendor", "not told")),
    (labelled("serial", "X"), ("serial number", "X")),
    ([plain(value) for value in (-0.5, 0.25, 1e9, 3)], ["−0.5", "0.25", "1e+09", "3"]),
])  # fmt: skip
def test_plain_data_in_words(found: object, words: object) -> None:
    assert found == words


def test_versions_are_those_of_what_is_installed() -> None:
    assert versions()["numpy"] == np.__version__
    assert list(versions())[:2] == ["hallbench", "python"]
