"""Code and memory of the device side in C stay below what is promised; docs/firmware.md tells them."""

from __future__ import annotations

import re

import pytest
from building import ROOT

from tests.protocol.c import sizes
from tests.tools import needs

CODE, RAM = 12 << 10, 4 << 10  # of a byte link, and of classic CAN
CAPTURE_CODE, CAPTURE_RAM, WAVEFORM_CODE = 3500, 512, 320  # more for these
ALL_ON_A_BYTE_LINK = 14 << 10  # as hbp.h is
INTERRUPT = 400  # instructions of hbp_tick with 8 channels, the first one of a stream included
NOTHING_ARMED = 53  # of hbp_tick without streams and captures
ARMED = 40  # more while a capture waits, but for copying
COPYING = 59  # of the 8 channels in cost.c: two runs at 17, three words and two bytes at 5
ROUND = 7  # more in the period in which the ring of records begins anew
EDGE = 140  # of hbp_edge while a capture waits

pytestmark = [pytest.mark.slow, needs("arm-none-eabi-gcc")]


@pytest.mark.long("compiles it in every shape")
def test_code_and_memory_have_a_ceiling() -> None:
    byte, can, *others = sizes.costs()
    assert max(byte.code, can.code) <= CODE
    assert max(byte.ram, can.ram) <= RAM
    captures, captures_on_can, waveform, waveform_on_can = others
    assert max(captures.code, waveform.code) <= ALL_ON_A_BYTE_LINK
    for cost, without in ((captures, byte), (captures_on_can, can)):
        assert cost.code <= without.code + CAPTURE_CODE, cost.what
        assert cost.ram <= without.ram + CAPTURE_RAM, cost.what
    for cost, without in ((waveform, captures), (waveform_on_can, captures_on_can)):
        assert cost.code <= without.code + WAVEFORM_CODE, cost.what


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
        ("of 8 channels that waits for a fault", COPYING),
        ("of 8 channels that waits for a channel", COPYING),
    ):
        mean, most = (each - without - copying for each in counted[f"hbp_tick, a capture {what}"])
        assert mean <= ARMED, what
        assert most <= ARMED + (ROUND if copying else 0), what
    assert counted["hbp_tick, while the trigger comes and the capture ends"][1] <= INTERRUPT
    assert counted["hbp_edge, a capture waits"][1] <= EDGE
    page = (ROOT / "docs" / "firmware.md").read_text()
    told = page.partition(sizes.BEGIN)[2].partition(sizes.END)[0]
    assert set(counted) <= set(re.findall(r"^\| (.+?) \| \d", told, re.MULTILINE))
