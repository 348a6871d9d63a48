"""Code and memory of the device side in C stay below what is promised; docs/firmware.md tells them."""

from __future__ import annotations

import re

import pytest
from building import ROOT

from tests.protocol.c import sizes
from tests.tools import needs

CODE, RAM = 12 << 10, 4 << 10  # of a byte link, and of classic CAN
INTERRUPT = 400  # instructions of hbp_tick with 8 channels, the first one of a stream included

pytestmark = [pytest.mark.slow, needs("arm-none-eabi-gcc")]


@pytest.mark.long("compiles it in every shape")
def test_code_and_memory_have_a_ceiling() -> None:
    for cost in sizes.costs():
        assert cost.code <= CODE, cost.what
        assert cost.ram <= RAM, cost.what


@needs("qemu-system-arm")
def test_what_the_interrupts_take_has_a_ceiling_and_is_told() -> None:
    counted = {what: (mean, most) for what, mean, most in sizes.instructions()}
    assert counted["hbp_tick, the first one of a stream"][1] <= INTERRUPT
    assert counted["hbp_tick, 8 channels"][1] <= INTERRUPT
    assert max(counted[f"hbp_{name}"][1] for name in ("edge", "raise", "may_run, outputs on")) < 60
    page = (ROOT / "docs" / "firmware.md").read_text()
    told = page.partition(sizes.BEGIN)[2].partition(sizes.END)[0]
    assert set(counted) <= set(re.findall(r"^\| (.+?) \| \d", told, re.MULTILINE))
