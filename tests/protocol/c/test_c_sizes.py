"""Code and memory of the device side in C stay below what is promised; docs/firmware.md tells them."""

from __future__ import annotations

import re

import pytest
from building import ROOT

from tests.protocol.c import sizes
from tests.tools import needs

CODE, RAM = 11 << 10, 4 << 10  # of a byte link, and of classic CAN, without captures
EVERYTHING = 14 << 10  # code with captures and a waveform, as hbp.h is, on either link
CAPTURE_RAM = 512  # more for captures, beside their memory
INTERRUPT = 400  # instructions of hbp_tick with 8 channels, the first one of a stream included
NOTHING_ARMED = 47  # of hbp_tick without streams and captures
ARMED = 40  # more while a capture waits, but for copying
COPYING = (
    59  # of the 8 channels in cost.c: two runs at 17, three words and two bytes at 5; of the first 4 two words less
)
ROUND = 7  # more in the period in which the ring of records begins anew
EDGE = 120  # of hbp_edge while a capture waits
MEANS = 500  # of hbp_tick with means of 8 channels of whole numbers,
RECORD_OF_MEANS = 2000  # and in the period of a record

pytestmark = [pytest.mark.slow, needs("arm-none-eabi-gcc")]


@pytest.mark.long("compiles it in every shape")
def test_code_and_memory_have_a_ceiling() -> None:
    byte, can, *others, _with_means = sizes.costs()
    assert max(byte.code, can.code) <= CODE
    assert max(byte.ram, can.ram) <= RAM
    for cost in others:
        assert cost.code <= EVERYTHING, cost.what
    for cost, without in zip(others, (byte, can) * 2, strict=True):
        assert cost.ram <= without.ram + CAPTURE_RAM, cost.what


@needs("qemu-system-arm")
def test_what_the_interrupts_take_has_a_ceiling_and_is_told() -> None:
    counted = {what: (mean, most) for what, mean, most in sizes.instructions()}
    assert counted["hbp_tick, the first one of a stream"][1] <= INTERRUPT
    assert counted["hbp_tick, 8 channels"][1] <= INTERRUPT
    assert max(counted[f"hbp_{name}"][1] for name in ("edge", "raise", "may_run, outputs on")) < 60
    assert counted["hbp_tick, no stream"][1] <= NOTHING_ARMED
    without = counted["hbp_tick, no stream"][1]
    for what, copying in (
        ("that waits for a channel, without a record", 0),
        ("of 4 channels that waits for a fault", COPYING - 10),
        ("of 8 channels that waits for a channel", COPYING),
    ):
        mean, most = (each - without - copying for each in counted[f"hbp_tick, a capture {what}"])
        assert mean <= ARMED, what
        assert most <= ARMED + (ROUND if copying else 0), what
    assert counted["hbp_tick, while the trigger comes and the capture ends"][1] <= INTERRUPT
    assert counted["hbp_edge, a capture waits"][1] <= EDGE
    assert counted["hbp_tick, means of 8 channels"][1] <= MEANS
    assert counted["hbp_tick, means of 8 channels, with a record"][1] <= RECORD_OF_MEANS
    page = (ROOT / "docs" / "firmware.md").read_text()
    told = page.partition(sizes.BEGIN)[2].partition(sizes.END)[0]
    assert set(counted) <= set(re.findall(r"^\| (.+?) \| \d", told, re.MULTILINE))
