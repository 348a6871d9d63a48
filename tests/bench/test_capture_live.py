"""After a trip in `bench live` the last 50 ms are kept beside the recording, at the PWM rate, on every link."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from capture_rebuilt import buffer_of
from uart import Uart
from virtual_run import RecordingScreen, WatchedLink, run

import bench
from protocol.canmap.frame import BusRates
from protocol.messages import BlobRead, CaptureArm, CaptureState, CaptureTrigger, DriveState, Fault
from sim.config.params import load_params
from sim.ports.device import SimulatedDevice
from sim.ports.networks import CanNetwork, Network

MEMORY = 131_072  # bytes: the drive holds 0.2 s
STEP = 0.005  # s of virtual time between looks for bytes: with long ones a request takes longer than its link does
TRIP = 0.4  # s of the run
LINKS: dict[str, tuple[Callable[[], Network | None], dict[str, object]]] = {
    "bytes": (lambda: None, {}),
    "UART 115200": (lambda: Uart(115_200), {"fit": True}),
    "CAN 500 kbit/s": (lambda: CanNetwork(BusRates(500_000)), {"fit": True}),
    "CAN FD": (lambda: CanNetwork(BusRates(1_000_000, 5_000_000)), {"fit": True}),
}


class TrippingLink(WatchedLink):
    """The drive trips once it has run for `TRIP`; what it held then is kept when it is given up."""

    def __init__(self, network: Network | None, memory: int = MEMORY, fault: Fault = Fault.OVERVOLTAGE) -> None:
        config = {"memory.capture": memory, "firmware.watchdog": 1.0}
        super().__init__(SimulatedDevice(load_params(None, config), 2, network=network))
        self._step = round(STEP * self.device.pwm_hz)
        self.fault, self.tripped, self.buffer = fault, 0, b""
        self._ran: float | None = None

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        drive = self.device.drive
        if drive.state == DriveState.RUNNING and self._ran is None:
            self._ran = self.clock()
        if self._ran is not None and self.clock() - self._ran > TRIP and not self.tripped:
            self.tripped = self.device.tick
            drive.fault(self.fault)
        if drive.capture and drive.capture.blob:
            self.buffer = drive.capture.blob
        return super().read(timeout, settle)


@pytest.mark.long("a hundred kilobytes over slow links, frame by frame")
@pytest.mark.parametrize("kind", LINKS)
def test_what_the_drive_held_at_a_trip_is_kept_on_every_link(kind: str, tmp_path: Path) -> None:
    network, options = LINKS[kind]
    link, screen = TrippingLink(network()), RecordingScreen()
    ended = run(link, screen=screen, save=tmp_path / "a.run", duration=1.0, **options)

    assert ended.exit_code == 1
    assert "OVERVOLTAGE" in ended.words
    kept = tmp_path / "a-fault.run"
    held = bench.read(kept)
    assert buffer_of(held.samples, held.edges) == link.buffer
    assert held.rate == link.device.pwm_hz
    trip, first, last = link.tripped, held.samples.tick[0], held.samples.tick[-1]
    assert (trip - first) / held.tick_hz >= 0.05
    assert first < trip < last
    told = bench.open(kept).info.identity["capture"]
    assert abs(told["trigger_tick"] - trip) <= 2 * held.samples.config.period_ticks
    assert told["faults"] == ["OVERVOLTAGE"]
    assert ended.summary.at_fault["path"] == str(kept)
    assert json.dumps(ended.summary.as_json()["at_fault"])
    recording = bench.open(tmp_path / "a.run")
    assert "a-fault.run" in recording.run.summary
    assert recording.at_fault is not None
    assert recording.at_fault.info.trigger_tick == told["trigger_tick"]
    assert recording.at_fault.at_fault is None
    assert link.device.drive.capture.state == CaptureState.ARMED  # for the next fault


def test_a_run_without_a_trip_or_a_drive_without_captures_keeps_nothing(tmp_path: Path) -> None:
    for name, memory, code in (("b", 0, 1), ("c", MEMORY, 0)):
        link = TrippingLink(None, memory)
        if code == 0:
            link.tripped = 1
        ended = run(link, save=tmp_path / f"{name}.run", duration=0.8)
        assert ended.exit_code == code, ended.words
        assert not ended.summary.at_fault
        assert not (tmp_path / f"{name}-fault.run").exists()


def test_what_an_earlier_run_of_that_name_kept_goes_with_it(tmp_path: Path) -> None:
    save = tmp_path / "d.run"
    run(TrippingLink(None), save=save, duration=0.8)
    assert (tmp_path / "d-fault.run").exists()
    quiet = TrippingLink(None)
    quiet.tripped = 1
    with pytest.raises(bench.BenchError, match="exists"):
        run(quiet, save=save, duration=0.3)
    assert run(quiet, save=save, duration=0.3, overwrite=True).exit_code == 0
    assert not (tmp_path / "d-fault.run").exists()


def test_without_a_recording_it_stays_in_the_drive_and_the_next_run_says_so(tmp_path: Path) -> None:
    link, screen = TrippingLink(None), RecordingScreen()
    run(link, screen=screen, duration=0.8)
    assert link.device.drive.capture.state == CaptureState.FROZEN
    assert any("(fault: OVERVOLTAGE at " in note and "--at-fault -o RUN` fetches it" in note for note in screen.notes)
    again = RecordingScreen()
    link.reopen()
    ended = run(link, screen=again, duration=0.2, speed_rpm=None, save=tmp_path / "e.run")
    assert any("takes no other one until then" in note for note in again.notes)
    assert not ended.summary.at_fault
    assert link.device.drive.capture.state == CaptureState.FROZEN


class Rival(TrippingLink):
    """Another host gives up what the drive holds, once this one has begun to read it."""

    def write(self, data: bytes) -> None:
        super().write(data)
        if self.tripped and len(self.read_parts) == 3:
            self.device.drive.capture.arm(CaptureArm(CaptureTrigger.OFF), 512)

    @property
    def read_parts(self) -> list[int]:
        return self._parts

    def __init__(self) -> None:
        super().__init__(None)
        self._parts: list[int] = []
        handlers = self.device.drive._handlers
        answer = handlers[BlobRead]

        def counted(request: BlobRead) -> object:
            if request.id == 1:
                self._parts.append(request.offset)
            return answer(request)

        handlers[BlobRead] = counted  # type: ignore[assignment]


def test_what_cannot_be_read_to_its_end_is_told_and_no_run_is_left_half(tmp_path: Path) -> None:
    screen = RecordingScreen()
    ended = run(Rival(), screen=screen, save=tmp_path / "f.run", duration=0.8)
    assert ended.exit_code == 1
    assert "OVERVOLTAGE" in ended.words
    assert any(note.startswith("what the drive held at the fault was not kept: ") for note in screen.notes)
    assert not ended.summary.at_fault
    assert not (tmp_path / "f-fault.run").exists()


def test_a_link_so_slow_that_the_end_of_a_run_would_wait_for_it_leaves_it_in_the_drive(tmp_path: Path) -> None:
    link, screen = TrippingLink(Uart(38_400)), RecordingScreen()
    ended = run(link, screen=screen, save=tmp_path / "g.run", duration=1.0, fit=True, channels=("i_q",))
    assert not ended.summary.at_fault
    (note,) = [note for note in screen.notes if note.startswith("what the drive held at the fault was not kept: ")]
    assert re.search(r"reading it takes \d\d s on this link: `bench capture \S+ --at-fault -o RUN` fetches it$", note)
    assert link.device.drive.capture.state == CaptureState.FROZEN
    assert not (tmp_path / "g-fault.run").exists()
