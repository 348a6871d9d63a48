"""`bench live --fit` on a byte link of a known rate: samples, edges and heartbeats of a turning drive fit on it."""

from __future__ import annotations

import pytest
from virtual_run import RecordingScreen, run

from protocol.device.session import DeviceLink
from protocol.device.tx import TxQueue
from sim.config.params import load_params
from sim.ports.device import SimulatedDevice
from sim.ports.networks import ByteNetwork
from sim.ports.virtual import VirtualLink


class CountedLink(VirtualLink):
    """Keeps how many bytes came."""

    came = 0

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        data = super().read(timeout, settle)
        self.came += len(data)
        return data


def carried(baud: int, **options: object) -> tuple[float, float]:
    """Share of a UART that a run takes, and samples a second."""
    network = ByteNetwork(DeviceLink(TxQueue(capacity=baud / 10)))
    link, screen = CountedLink(SimulatedDevice(load_params(None, {}), 1, network=network)), RecordingScreen()
    ended = run(link, screen=screen, fit=True, duration=4.0, **options)
    assert ended.exit_code == 0, ended.summary.result
    assert any(note.startswith("--fit: ") for note in screen.notes)
    return link.came * 10 / (ended.summary.duration_s * baud), ended.summary.samples / ended.summary.duration_s


@pytest.mark.parametrize(
    ("baud", "speed_rpm", "least"), [(115_200, 500.0, 0.6), (115_200, 1000.0, 0.6), (460_800, 3000.0, 0.7)]
)
def test_samples_edges_and_heartbeats_fit(baud: int, speed_rpm: float, least: float) -> None:
    share, _ = carried(baud, speed_rpm=speed_rpm)
    assert least < share < 1.0


def test_a_drive_that_is_only_watched_leaves_no_room_for_edges() -> None:
    _, watched = carried(115_200, speed_rpm=None)
    _, turning = carried(115_200, speed_rpm=500.0)
    assert watched > 2.0 * turning
