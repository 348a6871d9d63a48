"""A drive that says one thing in two ways that contradict each other is told so; what was not seen is not called ok.

The motor does as it should: a lie is in what is sent, and known from how it was made.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from lossy import LosingLink, Losses
from lying import of_edges, of_flags, of_heartbeats, of_samples
from virtual_run import WatchedLink, run, simulated

import bench
from protocol.messages import DriveState
from protocol.signals import Flag
from sim.ports.device import SimulatedDevice

CODES = "hall"


def _random_codes(device: SimulatedDevice) -> SimulatedDevice:
    dice = np.random.default_rng(1)

    def lie(raw: np.ndarray) -> np.ndarray:
        raw[CODES] = dice.integers(0, 8, len(raw))
        return raw

    return of_samples(device, lie)


def _random_edges(device: SimulatedDevice, which: int) -> SimulatedDevice:
    """`which`: bits of the codes that are random."""
    dice = np.random.default_rng(1)

    def lie(records: np.ndarray) -> np.ndarray:
        records["codes"] ^= (dice.integers(0, 64, len(records)) & which).astype(np.uint8)
        return records

    return of_edges(device, lie)


def _exchanged(device: SimulatedDevice) -> SimulatedDevice:
    def lie(records: np.ndarray) -> np.ndarray:
        codes = records["codes"]
        records["codes"] = codes & 0x40 | (codes & 7) << 3 | codes >> 3 & 7
        return records

    return of_edges(device, lie)


def _other_state(device: SimulatedDevice) -> SimulatedDevice:
    def lie(raw: np.ndarray) -> np.ndarray:
        raw["status"] = raw["status"] & ~np.uint8(7) | np.where(raw["status"] & 7 == 3, 1, 3)
        return raw

    return of_samples(device, lie)


def _falling(name: str, after: int) -> Callable[[SimulatedDevice], SimulatedDevice]:
    """A count that is once lower than before."""

    def lying(device: SimulatedDevice) -> SimulatedDevice:
        beats = count()
        return of_heartbeats(device, lambda _: {name: 1000 - 500 * (next(beats) > after)})

    return lying


LIES: dict[str, tuple[Callable[[SimulatedDevice], SimulatedDevice], str]] = {
    "random codes in the channel": (_random_codes, "the channel hall changes more often than there are Hall edges"),
    "random codes in EDGES": (lambda device: _random_edges(device, 0x3F), "wrong EDGES records"),
    "random codes after edges": (lambda device: _random_edges(device, 0x38), "wrong EDGES records"),
    "random codes before edges": (lambda device: _random_edges(device, 0x07), "wrong EDGES records"),
    "codes of edges exchanged": (_exchanged, "wrong EDGES records: the codes before and after the edge are exchanged"),
    "another state in status": (_other_state, "its state is IDLE by the channel status, RUNNING by its heartbeat"),
    "edges that fall": (_falling("edges", 20), "its count edges fell from 1000 to 500"),
    "drops that fall": (_falling("tx_dropped", 20), "its count tx_dropped fell from 1000 to 500"),
    "damage that falls": (_falling("rx_bad", 20), "its count rx_bad fell from 1000 to 500"),
    "edges that never were": (
        lambda device: of_heartbeats(device, lambda beat: {"edges": beat.edges + 7 * (beat.tick // 2_000_000)}),
        "Hall edges where edge number",
    ),
    "edges faster than possible": (
        lambda device: of_heartbeats(device, lambda beat: {"edges": beat.tick // 4}), "it counts 5",
    ),
}  # fmt: skip
NOT_ON_CAN = ("edges that fall", "edges that never were", "edges faster than possible")  # edges are numbered by them


@pytest.mark.parametrize("config", [{}, {"encoder__present": 0}], ids=["encoder", "no encoder"])
@pytest.mark.parametrize(("lie", "words"), LIES.values(), ids=LIES)
def test_contradictions_are_told(lie: Callable[..., SimulatedDevice], words: str, config: dict[str, int]) -> None:
    ended = run(WatchedLink(lie(simulated(**config))), speed_rpm=300.0, duration=4.0)
    assert ended.summary.result.startswith("implausible: ")
    assert words in ended.summary.result
    assert ended.exit_code == 1


@pytest.mark.parametrize("name", [name for name in LIES if name not in NOT_ON_CAN])
def test_they_are_told_on_can(name: str) -> None:
    lie, words = LIES[name]
    ended = run(WatchedLink(lie(simulated(network="CAN FD"))), speed_rpm=300.0, duration=4.0, fit=True)
    assert words in ended.summary.result
    assert ended.exit_code == 1


@pytest.mark.parametrize("name", ["another state in status", "damage that falls", "random codes in the channel"])
def test_they_are_told_of_a_drive_that_is_only_watched(name: str) -> None:
    lie, words = LIES[name]
    device = lie(simulated())
    ended = run(WatchedLink(device), speed_rpm=None, duration=4.0)
    words = words.replace("IDLE by the channel status, RUNNING", "RUNNING by the channel status, IDLE")
    words = words.replace("changes more often than there are Hall edges", "changed")
    assert words in ended.summary.result
    assert ended.exit_code == 1


@pytest.mark.parametrize("lost", [0.25, 0.6])
@pytest.mark.parametrize("speed", [None, 300.0], ids=["watched", "turned"])
def test_what_was_lost_is_said_in_the_result(lost: float, speed: float | None, network: str) -> None:
    link = LosingLink(simulated(network=network), Losses(samples=lost))
    result = run(link, speed_rpm=speed, duration=4.0, channels=("hall", "theta_enc", "status"), fit=True).summary.result
    assert result.startswith("ok as far as was seen; unverified: ")
    assert f"{round(100 * lost, -1):.0f}"[0] in result.partition("what ")[2]
    assert "of the samples would have shown" in result


def test_little_that_is_lost_leaves_a_run_ok() -> None:
    assert run(LosingLink(simulated(), Losses(samples=0.01)), duration=4.0).summary.result == "ok"


def test_a_reference_that_is_an_estimate_too_is_compared_with_nothing() -> None:
    ended = run(WatchedLink(of_flags(simulated(), "theta_enc", Flag.ESTIMATE)), duration=2.0)
    assert "position error of theta_enc (it has the flags ESTIMATE and REFERENCE" in ended.summary.result
    assert all("theta_enc" not in row for row in ended.summary.position_error_deg.values())


@pytest.mark.parametrize("seconds", [3.1, 4.0])
def test_a_few_seconds_at_speed_are_enough_whatever_was_lost(seconds: float) -> None:
    link = LosingLink(simulated(), Losses(samples=0.75))
    assert "held" not in run(link, speed_rpm=300.0, duration=seconds).summary.result


def test_what_is_seen_ends_with_stop_where_no_channel_tells_the_state() -> None:
    """A shaft that is let go runs down: for a second nobody sees that STOP has come."""
    device = simulated()
    states: list[DriveState] = []
    tell = device.drive.heartbeat

    def late() -> object:  # heartbeats tell of 1.2 s before
        states.append(device.drive.state)
        heartbeat = tell()
        on = DriveState.RUNNING in states[-12:]
        return replace(heartbeat, state=DriveState.RUNNING, outputs_on=True) if on else heartbeat

    device.drive.heartbeat = late  # type: ignore[method-assign, assignment]
    ended = run(WatchedLink(device), speed_rpm=2000.0, duration=3.0, channels=("theta_enc", "omega_enc", "theta_vt"))
    [came] = ended.summary.asked
    assert came.speed_came_rpm == pytest.approx(2000.0, rel=0.01)


@pytest.mark.parametrize("config", [{}, {"encoder__present": 0}], ids=["encoder", "no encoder"])
@pytest.mark.parametrize("rpm", [120.0, -1500.0])
def test_a_check_names_exchanged_codes(tmp_path: Path, config: dict[str, int], rpm: float) -> None:
    run(WatchedLink(_exchanged(simulated(**config))), save=tmp_path / "a.run", speed_rpm=rpm, duration=3.0)
    health = bench.hall(tmp_path / "a.run")
    assert [finding.code for finding in health.findings] == ["edge_records"]
    assert "exchanged" in health.findings[0].cause
    assert health.exit_code == 1


def test_a_check_of_sound_records_names_none(tmp_path: Path) -> None:
    run(WatchedLink(simulated()), save=tmp_path / "a.run", speed_rpm=300.0, duration=3.0)
    assert bench.hall(tmp_path / "a.run").findings == ()
