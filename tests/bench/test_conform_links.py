"""`bench conform` on a link that loses, damages or falls silent: the link's doing is never called the device's."""

from __future__ import annotations

import random

import pytest
from conforming import RICH, ended, options
from lossy_link import LossyLink, Trouble
from virtual_run import RecordingScreen

from bench.conform.claim import claim, outcome
from bench.conform.run import Run, conform
from bench.rig.outcome import Verdict
from tests.choice import sampled
from tests.devices import serving

pytestmark = pytest.mark.long("conform as a whole, and the requests that are lost")

TROUBLES = {
    "1 % lost": Trouble(lost_up=0.01, lost_down=0.01),
    "a third lost": Trouble(lost_up=0.3),
    "answers lost": Trouble(lost_up=0.05),
    "requests lost": Trouble(lost_down=0.05),
    "damaged": Trouble(damaged=3e-4),
    "an outage": Trouble(outages=((1.0, 1.6),)),
    "outages": Trouble(outages=((0.5, 0.9), (2.0, 2.3), (5.0, 6.0))),
}
CASES = [
    (link, name)
    for link in ("bytes", "CAN")
    for name in TROUBLES
    if link == "bytes" or name not in ("damaged", "a third lost")
]


def on_link(link: str, trouble: Trouble, level: int, faults: tuple[str, ...] = ()) -> Run:
    """The run of a device behind such a link."""
    with serving(RICH, faults, link) as device:
        lossy = LossyLink(device.link, trouble, random.Random(f"{link} {trouble}"))
        given = options(level, target=device.carrier.target, idle=lossy.idle)
        return conform(lambda: lossy, given, RecordingScreen(), None, lambda result: None)


@pytest.mark.parametrize(("link", "name"), sampled("lossy conform", CASES, 5, campaign="conform"))
def test_a_sound_device_is_never_blamed(link: str, name: str) -> None:
    run = on_link(link, TROUBLES[name], 3)
    assert not ended(run, Verdict.FAIL), [(r.check.id, r.evidence) for r in run.results if r.verdict is Verdict.FAIL]
    assert claim(run).conforms is not False
    if run.loses:
        assert claim(run).conforms is None
        assert outcome(run).exit_code in (2, 6)


@pytest.mark.parametrize("link", ["bytes", "CAN"])
def test_a_device_that_breaks_spec_is_found_though_the_link_fell_silent_for_a_moment(link: str) -> None:
    run = on_link(link, Trouble(outages=((0.5, 0.7),)), 1, ("last-tid-of-refused",))
    assert ended(run, Verdict.FAIL) == ["identity.last-tid"]
    assert not run.loses
