"""What a run says of a healthy drive behind a link that loses frames: figures are the drive's, and nobody is accused.

What is true is what the simulated drive was asked for, which it does, and what the link has let through.
"""

from __future__ import annotations

import random
from typing import NamedTuple
from unittest.mock import patch

import pytest
from lossy import LosingLink, Losses
from virtual_run import TARGET, run, simulated

from bench.cli import main
from bench.errors import DriveFailed, NodeError
from tests.choice import sampled

NO_ENCODER = {"encoder__present": 0}


class Case(NamedTuple):
    """A run on a link that loses."""

    network: str
    config: dict[str, float]
    losses: Losses
    rpm: float
    seconds: float
    seed: int


def case(number: int) -> Case:
    """Drawn by its number."""
    dice = random.Random(number)
    kind = dice.choice(("samples", "edges", "both", "bits", "outage", "bursts"))
    begin, every = dice.uniform(1.0, 2.0), dice.uniform(0.2, 0.5)
    outages = {
        "outage": ((begin, begin + dice.uniform(0.1, 5.0)),),
        "bursts": tuple((begin + k * every, begin + (k + dice.uniform(0.1, 0.7)) * every) for k in range(30)),
    }
    losses = Losses(
        samples=dice.uniform(0.02, 0.8) if kind in ("samples", "both") else 0.0,
        edges=dice.uniform(0.02, 0.8) if kind in ("edges", "both") else 0.0,
        bits=10.0 ** dice.uniform(-5.0, -3.5) if kind == "bits" else 0.0,
        outages=outages.get(kind, ()),
    )
    rpm = dice.choice((0.0, *(sign * dice.uniform(*span) for sign in (1, -1) for span in ((30, 200), (200, 2500)))))
    config = dice.choice(({}, NO_ENCODER))
    return Case(dice.choice(("bytes", "bytes", "CAN FD")), config, losses, rpm, dice.uniform(1.2, 6.0), number)


REPORTED = [
    Case("bytes", NO_ENCODER, losses, rpm, 3.5, 1)
    for rpm in (100.0, 20.0)
    for losses in (Losses(samples=0.25), Losses(samples=0.45), Losses(bits=5e-4))
]


ALL_LOST = [Case(network, config, Losses(edges=1.0), 300.0, 3.0, 1)
            for network in ("bytes", "CAN FD") for config in ({}, NO_ENCODER)]  # fmt: skip


def _accuses_nobody(of: Case) -> None:
    link = LosingLink(simulated(of.seed, of.network, **of.config), of.losses, of.seed)
    ended = run(link, duration=of.seconds, speed_rpm=of.rpm, fit=True)
    summary = ended.summary
    assert "implausible" not in summary.result, of
    assert "ran away" not in summary.result, of
    assert not summary.faults, of
    [came] = summary.asked
    if came.speed_came_rpm == came.speed_came_rpm and of.seconds > 2.0:
        few = of.config and of.losses != Losses(samples=of.losses.samples)  # sectors that are 10 % too wide or narrow
        assert came.speed_came_rpm == pytest.approx(of.rpm, rel=0.25 if few else 0.05, abs=6.0), of


@pytest.mark.parametrize("of", REPORTED)
def test_speed_by_edges_is_by_the_drives_clock(of: Case) -> None:
    _accuses_nobody(of)


@pytest.mark.slow
@pytest.mark.parametrize("of", [*ALL_LOST, *sampled("lossy runs", map(case, range(400)), 8, campaign="lossy")])
def test_losses_accuse_nobody(of: Case) -> None:
    _accuses_nobody(of)


@pytest.mark.parametrize("network", ["bytes", "CAN FD"])
def test_a_drive_whose_heartbeats_are_lost_is_not_said_to_contradict_itself(network: str) -> None:
    said = []
    for seed in range(6):
        link = LosingLink(simulated(network=network), Losses(heartbeats=0.7), seed)
        try:
            few = ("hall", "status")
            said.append(run(link, duration=0.3, speed_rpm=100.0, channels=few).summary.result)
        except (DriveFailed, NodeError) as refused:
            said.append(str(refused))
    assert not any("heartbeat says" in words or "only at attempt" in words for words in said), said
    silent = ("no heartbeat", "whether 100 r/min are held (too short a time)", "the drive was silent for")
    assert all(any(way in words for way in silent) for words in said), said


@pytest.mark.slow
@pytest.mark.parametrize("of", [*ALL_LOST[:1], *sampled("lossy checks", map(case, range(200)), 3, campaign="lossy")])
def test_a_check_accuses_no_sensor_for_what_was_lost(of: Case, capsys: pytest.CaptureFixture[str]) -> None:
    link = LosingLink(simulated(of.seed, of.network, **of.config), of.losses, of.seed)
    with patch("bench.rig.connection.open_link", lambda target: link), pytest.raises(SystemExit) as ended:
        main(["hall", "check", TARGET, "--yes"])
    printed = capsys.readouterr().out
    assert ended.value.code in (0, 2), printed
    assert "FAULT" not in printed
    if not of.config:
        assert "no encoder was recorded" not in printed


def test_a_check_asks_of_the_shaft_only_what_it_saw(capsys: pytest.CaptureFixture[str]) -> None:
    """Of every 0.4 s a quarter of a second is lost: what turned meanwhile nobody saw, and no motor that lags."""
    losses = Losses(outages=tuple((1.0 + 0.4 * k, 1.25 + 0.4 * k) for k in range(60)))
    link = LosingLink(simulated(), losses)
    with patch("bench.rig.connection.open_link", lambda target: link), pytest.raises(SystemExit) as ended:
        main(["hall", "check", TARGET, "--yes"])
    printed = capsys.readouterr().out
    assert ended.value.code == 0
    assert "commanded to turn" not in printed
    assert "turned round" not in printed
    assert "net unknown: " in printed
