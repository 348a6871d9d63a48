"""Nothing is lost without being counted: the end of the streams, outages, reboots, pauses, recordings that fail.

In virtual time. What is right is what the simulated drive handed to its streams while they ran.
"""

from __future__ import annotations

import re
import struct
from pathlib import Path

import numpy as np
import pytest
from cobs import cobs
from collect import Bench, Collector
from virtual_run import NETWORKS, RecordingScreen, WatchedLink, at_rest, run, simulated

from bench.device.client import Client, Losses
from bench.device.heard import Heard
from bench.device.losses import LOSS_FIELDS
from bench.device.node import Node
from bench.errors import RecordingError
from bench.live.summary import Lost, Summary, run_rows
from bench.record.reader import Run
from bench.record.sink import RunSink
from bench.rig.outputs import Outputs
from bench.rig.rig import Plan, Rig
from bench.signal.chunks import join
from bench.view.sinks import LiveSink
from protocol.canmap.frame import CAN_RECORD, RECORD_BYTES
from protocol.canmap.host import CanWire
from protocol.errors import LinkError
from protocol.framing import HEADER_BYTES, wrapped
from protocol.messages import DriveState, Fault, MessageType
from protocol.streams import EDGE_RECORD, STREAM_HEADER, SampleChunk
from sim.ports.device import SimulatedDevice
from tests.devices import FULL, serving
from tests.viewers import any_port

pytestmark = pytest.mark.slow

PERIOD = 1250  # ticks


class Streamed:
    """What the drive of `device` made while its streams ran: index and tick of samples, ticks of edges."""

    def __init__(self, device: SimulatedDevice) -> None:
        self.index: list[np.ndarray] = []
        self.ticks: list[np.ndarray] = []
        self.edges: list[np.ndarray] = []
        self.at_stop: list[int] = []  # how many heartbeats had come when the streams were stopped
        self.collector: Collector | None = None
        drive = device.drive
        push_samples, push_edges, stop_streams = drive.push_samples, drive.push_edges, drive.streams.stop

        def samples(index: int, tick: int, raw: np.ndarray) -> None:
            if drive.streams.running:
                self.index.append(index + np.arange(len(raw)))
                self.ticks.append(tick + PERIOD * np.arange(len(raw)))
            push_samples(index, tick, raw)

        def edges(records: np.ndarray) -> None:
            if drive.streams.running:
                self.edges.append(records["tick"].astype(np.int64))  # the bench's clock starts low
            push_edges(records)

        def stop(mask: int) -> None:
            if self.collector is not None:
                self.at_stop.append(len(self.collector.heartbeats))
            stop_streams(mask)

        drive.push_samples, drive.push_edges = samples, edges  # type: ignore[method-assign]
        drive.streams.stop = stop  # type: ignore[method-assign]

    @property
    def told(self) -> int:
        """Tick of the last heartbeat that the host had when it stopped the streams."""
        assert self.collector is not None
        return [h.tick for node, h in self.collector.heartbeats[: self.at_stop[-1]] if node == 1][-1]

    def up_to(self, tick: int, decimation: int = 1, after: int = -1) -> tuple[int, int]:
        """Samples and edges with ticks from `after` (not included) up to `tick`."""
        index, ticks, edges = (
            np.concatenate(a or [np.empty(0, np.int64)]) for a in (self.index, self.ticks, self.edges)
        )
        chosen = (index % decimation == 0) & (ticks <= tick) & (ticks > after)
        return int(chosen.sum()), int(((edges <= tick) & (edges > after)).sum())


class Lossy(WatchedLink):
    """A virtual link that loses stream frames while it `loses` them, and delays others by `delay` s.

    Heartbeats and replies always come, and at once.
    """

    def __init__(self, device: SimulatedDevice) -> None:
        super().__init__(device)
        self.loses = False
        self.delay = 0.0
        self._late: list[tuple[float, bytes]] = []

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        data = super().read(timeout, settle)
        now, out = self.clock(), []
        for frame, stream in split(data, isinstance(self.wire(), CanWire)):
            if not stream:
                out.append(frame)
            elif not self.loses:
                self._late.append((now + self.delay, frame))
        while self._late and self._late[0][0] <= now:
            out.append(self._late.pop(0)[1])
        return b"".join(out)


def split(data: bytes, can: bool) -> list[tuple[bytes, bool]]:
    """Frames as they are on the link, and whether they are a stream's."""
    if can:
        records = [data[at : at + RECORD_BYTES] for at in range(0, len(data), RECORD_BYTES)]
        return [(record, bool(np.frombuffer(record, CAN_RECORD)["id"][0] >> 8 & 7 >= 4)) for record in records]
    bodies = [part for part in data.split(b"\0") if part]
    return [(b"\0" + body + b"\0", cobs.decode(body)[0] in (MessageType.DATA, MessageType.EDGES)) for body in bodies]


def streaming(link: Lossy, seconds: float, decimation: int = 1) -> tuple[Bench, Streamed, int]:
    """A drive that has turned for a while, with all streams; and the decimation that the link carries."""
    bench, streamed = Bench(link), Streamed(link.device)
    streamed.collector = bench.collector
    decimation = bench.stream(NAMES, decimation)
    bench.turn(50.0)
    bench.client.run_for(seconds)
    return bench, streamed, decimation


def block_of(bench: Bench) -> int:
    """Samples that a device on CAN may hold back at STREAM_STOP, because they are no whole frame."""
    chunk = next(c for c in bench.collector.chunks if isinstance(c, SampleChunk))
    return chunk.config.block if isinstance(bench.client.session.wire, CanWire) else 1


def accounted(bench: Bench, streamed: Streamed, tick: int, decimation: int) -> Losses:
    """What was lost; with what came it is all that the drive made up to `tick`."""
    losses = bench.client.losses(1)
    samples, edges = streamed.up_to(tick, decimation)
    assert 0 <= samples - losses.samples.samples - losses.samples.lost_by_index < block_of(bench)
    assert losses.edges.samples + losses.edges.lost_by_index == edges
    return losses


NAMES = ("hall", "theta_enc", "i_a")


# -- the end of the streams -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("decimation", [1, 7])
def test_what_is_lost_at_the_end_of_the_streams_is_counted(network: str, decimation: int) -> None:
    link = Lossy(simulated(1, network))
    bench, streamed, decimation = streaming(link, 0.4, decimation)
    link.loses = True
    bench.client.run_for(0.5)
    before = bench.client.losses(1)
    assert before.edges.lost_by_index == before.samples.lost_by_index == 0  # nobody can tell yet
    bench.drive.stop_streams()
    bench.drive.stop()
    losses = accounted(bench, streamed, streamed.told, decimation)
    assert losses.samples.lost_by_index > 0.4 * 16000 / decimation
    assert losses.edges.lost_by_index > 100
    assert bench.collector.lost == (losses.samples.lost_by_index, losses.edges.lost_by_index)
    assert any(note.startswith("lost at the end of the streams of node 1: ") for note in bench.collector.notes)


def test_what_is_under_way_when_the_streams_are_stopped_is_not_lost(network: str) -> None:
    """Stream frames come 0.4 s after the heartbeats, the replies and the STOP that they precede."""
    link = Lossy(simulated(1, network))
    link.delay = 0.4
    bench, streamed, decimation = streaming(link, 1.0)
    bench.drive.stop_streams()
    losses = bench.client.losses(1)
    assert losses.samples.lost_by_index == losses.edges.lost_by_index == losses.samples.lost_by_seq == 0
    assert bench.collector.lost == (0, 0)
    samples, edges = streamed.up_to(streamed.told, decimation)
    assert losses.samples.samples > samples - block_of(bench)
    assert losses.edges.samples >= edges > 100


def test_streams_of_which_nothing_ever_came_are_lost_whole(network: str) -> None:
    link = Lossy(simulated(1, network))
    link.loses = True
    bench, streamed = Bench(link), Streamed(link.device)
    streamed.collector = bench.collector
    decimation = bench.stream(NAMES)
    bench.client.run_for(0.3)
    known = bench.collector.heartbeats[-1][1].tick
    bench.turn(50.0)
    bench.client.run_for(0.5)
    bench.drive.stop_streams()
    losses = bench.client.losses(1)
    least, edges = streamed.up_to(streamed.told, decimation, known)
    most, _ = streamed.up_to(streamed.told, decimation)
    assert losses.samples.samples == losses.edges.samples == 0
    assert least <= losses.samples.lost_by_index <= most
    assert losses.edges.lost_by_index == edges > 100  # the shaft was at rest before


def test_a_drive_that_is_stopped_twice_is_counted_once(network: str) -> None:
    link = Lossy(simulated(1, network))
    bench, _, _ = streaming(link, 0.3)
    link.loses = True
    bench.client.run_for(0.3)
    bench.drive.stop_streams()
    once = bench.client.losses(1)
    bench.drive.stop_streams()
    assert bench.client.losses(1) == once
    link.loses = False
    bench.stream(NAMES)
    bench.client.run_for(0.3)
    bench.drive.stop_streams()
    assert bench.client.losses(1).samples.lost_by_index == once.samples.lost_by_index


def test_a_link_that_is_lost_for_good_leaves_what_heartbeats_had_told(network: str) -> None:
    link = Lossy(simulated(1, network))
    bench, streamed, decimation = streaming(link, 0.3)
    link.loses = True
    bench.client.run_for(0.35)
    known = bench.collector.heartbeats[-1][1].tick
    link.close()
    with pytest.raises(LinkError):
        bench.drive.stop_streams()
    losses = accounted(bench, streamed, known, decimation)
    assert losses.edges.lost_by_index > 50


def test_an_acceptance_test_counts_what_is_lost_at_its_end_too() -> None:
    link = Lossy(simulated())
    with Rig(Plan(lambda: link, "virtual")).prepare() as rig:
        rig.drive.start("encoder")
        rig.drive.speed(rad_s=50.0)
        rig.wait(0.4)
        link.loses = True
        rig.wait(0.4)
    quality = rig.quality()
    assert quality.lost_samples > 0.3 * 16000
    assert quality.lost_edges > 50
    assert [r for r in quality.remarks if re.fullmatch(rf"{quality.lost_edges} Hall edges after 0\.\d+ s were lost", r)]
    assert [r for r in quality.remarks if re.match(rf"{quality.lost_samples} samples after ", r)]


# -- reboots ----------------------------------------------------------------------------------------------------------


class Rebooting(Lossy):
    """A link whose drive is another one from `reboot` on: the same with another boot_id, its clock at 0."""

    def __init__(self, network: str = "bytes") -> None:
        self._before = 0.0
        super().__init__(simulated(1, network))
        self._network = network

    def clock(self) -> float:
        return self._before + super().clock()

    def reboot(self, seed: int = 2) -> None:
        self._before = self.clock()
        self.device = simulated(seed, self._network)


def test_the_streams_of_a_drive_that_reboots_end_with_its_last_heartbeat(network: str) -> None:
    link = Rebooting(network)
    bench, streamed, decimation = streaming(link, 0.3)
    link.loses = True
    bench.client.run_for(0.35)
    known = bench.client.heartbeats[1].tick
    link.loses = False
    link.reboot()
    assert bench.client.wait(lambda: bench.client.health.reboots == 2, 1.0)  # both nodes
    assert [(node, rebooted) for node, _, rebooted in bench.collector.restarts] == [(1, True), (2, True)]
    losses = accounted(bench, streamed, known, decimation)
    bench.drive.resume_streams()
    bench.client.run_for(0.4)
    bench.drive.stop_streams()
    after = bench.client.losses(1)
    assert after.samples.lost_by_index == losses.samples.lost_by_index
    assert after.samples.samples > losses.samples.samples + 0.3 * 16000 / decimation


class Jumping(Lossy):
    """A virtual link whose drive's clock is `back` ticks behind what it was, without a reboot: indices go on."""

    back = 0

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        frames = split(super().read(timeout, settle), False)
        return b"".join(self._jumped(cobs.decode(frame[1:-1])) for frame, _ in frames)

    def _jumped(self, body: bytes) -> bytes:
        header, payload = body[:HEADER_BYTES], bytearray(body[HEADER_BYTES:-4])
        if header[0] == MessageType.HEARTBEAT and header[2:4] == bytes(2):
            payload[:8] = struct.pack("<Q", struct.unpack_from("<Q", payload)[0] - self.back)
        elif header[0] in (MessageType.DATA, MessageType.EDGES):
            edges = range(STREAM_HEADER.size, len(payload), EDGE_RECORD.itemsize)
            for at in (STREAM_HEADER.size - 4, *(edges if header[0] == MessageType.EDGES else ())):
                tick = struct.unpack_from("<I", payload, at)[0]
                payload[at : at + 4] = struct.pack("<I", (tick - self.back) & 0xFFFFFFFF)
        return wrapped(header + bytes(payload))


def test_a_clock_that_jumps_back_without_a_reboot_loses_nothing(tmp_path: Path) -> None:
    """Neither on the way nor in the recording, in which time goes on; and it is told."""
    link = Jumping(simulated())
    bench, streamed, _ = streaming(link, 0.1)
    bench.client.run_for(3.0)
    live = LiveSink(bench.info(NAMES), any_port())
    file = RunSink(tmp_path / "a.run", live.run, wait=True)
    bench.client.sinks = [bench.collector, file, live]
    bench.client.run_for(0.5)
    before = bench.client.newest(1)
    link.back = 2 * bench.hello.tick_hz
    bench.client.run_for(0.5)
    bench.client.note("after it")
    bench.drive.stop_streams()
    file.close()
    assert live.close()
    losses = bench.client.losses(1)
    assert losses.samples.lost_by_index == losses.edges.lost_by_index == 0
    assert not bench.collector.restarts
    words = re.compile(r"node 1: the clock has jumped: all since then dated ([\d.]+) s behind")
    [by] = [float(found[1]) for wrong in bench.collector.misdated if (found := words.match(wrong.text))]
    assert by == pytest.approx(2.0, abs=0.1)
    chunks = [chunk for chunk in bench.collector.chunks if isinstance(chunk, SampleChunk)]
    assert np.array_equal(join(chunks).index, np.concatenate(streamed.index)[: sum(map(len, chunks))])
    run = Run(tmp_path / "a.run")
    assert run.damage == [wrong.text for wrong in bench.collector.misdated]
    assert run.lost == dict.fromkeys(LOSS_FIELDS, 0)
    assert not run.samples.gaps
    assert (np.diff(run.samples.index) == 1).all()
    assert len(run.samples) > 0.9 * 16000
    assert run.clock_went_back() is None
    assert abs(bench.collector.misdated[0].tick - before) < 0.1 * bench.hello.tick_hz
    assert next(note.tick for note in run.notes if note.text == "after it") > before
    assert (live.error, live.logged_samples + live.dropped_samples) == (None, len(run.samples))


def test_a_drive_that_reboots_and_keeps_its_boot_number_has_a_clock_that_jumps_back(network: str) -> None:
    link = Rebooting(network)
    bench, _, _ = streaming(link, 1.3)
    newest = bench.client.newest(1)
    link.reboot(seed=1)
    bench.client.run_for(0.6)
    assert bench.client.health.reboots == 0  # nobody can know
    assert not bench.collector.restarts
    told = [(wrong.node, wrong.text) for wrong in bench.collector.misdated if "the clock has jumped" in wrong.text]
    assert [node for node, _ in told] == [1]  # nothing is asked of the other, whose clock is not known
    assert all("behind" in text for _, text in told)
    assert bench.client.newest(1) > newest


def test_latency_is_never_taken_with_the_clock_of_another_boot(monkeypatch: pytest.MonkeyPatch) -> None:
    link = Rebooting()
    link.device.advance(7 * 16000)  # it has been on for a while

    ages: list[float] = []

    class Aged:
        """How old the samples were when they came, by the clock that a run gives to its outputs."""

        host_time = latency = None  # outputs set the one and ask for the other

        def take(self, item: Heard) -> None:
            if isinstance(item, SampleChunk) and (taken := self.host_time(float(item.tick[0]))) is not None:
                ages.append(link.clock() - taken)

    aged = Aged()

    class WithAges(Outputs):
        @property
        def sinks(self) -> list:
            return [*super().sinks, aged]

    monkeypatch.setattr("bench.rig.rig.Outputs", WithAges)

    def reboots(call: int) -> None:
        if link.clock() > 8.0 and not link._before:
            link.reboot()

    link._on_call = reboots
    ended = run(link, speed_rpm=None, duration=2.0)
    assert ended.summary.link["reboots"] == 2  # drive and load machine
    assert len(ages) > 20
    assert -0.001 < min(ages) < max(ages) < 0.2


# -- a host that was starved ------------------------------------------------------------------------------------------


def test_a_host_that_stood_still_says_so_though_nothing_tripped() -> None:
    stalls = [round(0.4 * 16000)]

    def stall(call: int) -> None:
        if stalls and link.device.drive.state is DriveState.RUNNING and link.clock() > 0.5:
            link.device.advance(stalls.pop())

    link = WatchedLink(simulated(firmware__watchdog=1.0), stall)
    ended = run(link, duration=1.0)
    assert ended.exit_code == 0
    assert ended.summary.longest_pause_s == pytest.approx(0.4, abs=0.04)
    assert ended.summary.as_json()["longest_pause_s"] == ended.summary.longest_pause_s
    assert dict(map(tuple, run_rows(ended.summary)))["longest pause of this program"].startswith(("0.3", "0.4"))
    fine = run(WatchedLink(simulated()))
    assert fine.summary.longest_pause_s < 0.05
    assert "longest pause of this program" not in dict(map(tuple, run_rows(fine.summary)))


def test_a_watchdog_that_this_host_starved_is_laid_at_its_door(network: str) -> None:
    link = WatchedLink(simulated(1, network))
    bench = Bench(link)
    bench.turn(50.0)
    bench.client.run_for(0.3)
    assert bench.client.starved(1) == ""
    link.device.advance(round(0.43 * 16000))
    bench.client.run_for(0.2)
    assert bench.client.heartbeats[1].faults == Fault.WATCHDOG
    words = r"this host sent no ALIVE for 0\.4\d s \(it was starved of CPU or stopped, or the link is slow\)"
    assert re.fullmatch(words, bench.client.starved(1))
    assert bench.client.starved(1, watchdog=0.6) == ""
    assert bench.client.starved(2) == ""
    bench.drive.clear_faults()
    bench.turn(50.0)  # feeding begins anew
    assert bench.client.starved(1) == ""
    bench.client.run_for(0.1)
    link.device.advance(round(0.43 * 16000))
    bench.client.feed(1, on=False)  # what stops the drive comes first
    assert re.fullmatch(words, bench.client.starved(1))


# -- telemetry that cannot be believed --------------------------------------------------------------------------------


@pytest.mark.parametrize(("fault", "words"), [("past", "past"), ("future", "future")])
def test_samples_that_are_not_of_now_are_implausible(fault: str, words: str) -> None:
    with serving(FULL, [f"samples-of-the-{fault}"], carrier="bytes") as device:
        ended = run(device.link, speed_rpm=None, duration=1.0)
    assert ended.exit_code == 1
    assert re.match(
        rf"implausible: samples are dated 0\.\d+ s in the {words} by the drive's own clock: tick0", ended.summary.result
    )


@pytest.mark.parametrize("faults", [(), ("heartbeats-slow",)])
@pytest.mark.parametrize("link", ["bytes", "CAN"])
def test_samples_of_now_are_not_misdated_however_seldom_heartbeats_come(faults: tuple[str, ...], link: str) -> None:
    with serving(FULL, faults, carrier=link, pwm_hz=250) as device:
        assert run(device.link, speed_rpm=None, duration=1.5).summary.result == "ok"


def test_a_drive_without_a_heartbeat_is_not_ok() -> None:
    class WithoutHeartbeats(WatchedLink):
        def read(self, timeout: float, settle: float = 0.0) -> bytes:
            frames = super().read(timeout, settle).split(b"\0")
            return b"\0".join(raw for raw in frames if not (raw and cobs.decode(raw)[0] == MessageType.HEARTBEAT))

    ended = run(WithoutHeartbeats(simulated()), speed_rpm=None, duration=1.0)
    assert (ended.summary.result, ended.exit_code) == ("no heartbeat came", 1)


def test_a_drive_that_falls_silent_before_the_end_is_not_ok() -> None:
    class FallsSilent(WatchedLink):
        def read(self, timeout: float, settle: float = 0.0) -> bytes:
            data = super().read(timeout, settle)
            return data if self.clock() < 1.0 else b""

    ended = run(FallsSilent(simulated()), speed_rpm=None, duration=4.0)
    assert ended.exit_code == 1
    assert re.fullmatch(r"no samples came in the last [34]\.\d s", ended.summary.result)


# -- recordings that fail ---------------------------------------------------------------------------------------------


def test_a_recording_that_fails_ends_the_run_with_stop_and_a_summary(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bench.record.sink.BACKLOG_LIMIT", -1)  # the disk is too slow from the start
    screen, link, path = RecordingScreen(), WatchedLink(simulated()), tmp_path / "a.run"
    ended = run(link, screen=screen, load_a=1.0, duration=60.0, save=path)
    assert ended.exit_code == 3
    assert ended.summary.result.startswith(f"recording failed: {path}: 0 MiB wait to be written")
    assert ended.summary.samples > 0
    assert [note for note in screen.notes if "wait to be written" in note]
    assert at_rest(link.device)
    assert link.device.drive.machine.faults == Fault(0)  # STOP did it, not the watchdog
    assert link.clock() < 5.0


def test_a_recording_that_fails_at_its_end_is_told_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from bench.record.sink import RunSink

    close = RunSink.close

    def fails(sink: RunSink) -> None:
        close(sink)
        sink.error = RecordingError(f"recording {sink.path}: the disk is full (0 KiB free)")

    monkeypatch.setattr(RunSink, "close", fails)
    ended = run(WatchedLink(simulated()), save=tmp_path / "a.run")
    assert (ended.exit_code, ended.summary.result) == (
        3,
        f"recording failed: {tmp_path / 'a.run'}: the disk is full (0 KiB free)",
    )


# -- the summary ------------------------------------------------------------------------------------------------------


def test_frames_of_a_stream_that_was_not_asked_for_are_counted() -> None:
    link = WatchedLink(simulated())
    first = Bench(link)
    first.stream(NAMES)
    second = Client(link)
    second.connect()
    before = second.unasked
    second.run_for(0.5)
    frames = second.unasked
    assert frames - before == pytest.approx(0.5 * 16000 / 201, abs=2)  # 5 bytes a sample, 1024 a frame
    assert second.losses(1).samples.samples == 0
    Node(second, 1).stop_streams()
    second.run_for(0.2)
    assert second.unasked <= frames + 2


def test_one_is_not_many() -> None:
    summary = Summary(
        target="sim", identity={}, duration_s=1.0, samples=1, edges=1, lost=Lost(1, 1, 1, 1), position_error_deg={},
        cpu_percent=1.0, longest_pause_s=0.31, latency_ms={},
        link=dict.fromkeys(
            ("outages", "reboots", "damaged", "stale", "out_of_order", "late", "malformed", "unknown", "of_no_stream",
             "unexpected_replies", "retries", "damaged_at_drive", "setpoints_rejected"), 1,
        ) | {"downtime_s": 30.0},
        live_view={"blocks_dropped": 1, "error": "the port is gone"},
    )  # fmt: skip
    rows = dict(map(tuple, run_rows(summary)))
    assert rows["lost by index"] == "1 sample, 1 edge"
    assert rows["lost by sequence"] == rows["dropped by the drive"] == "1 frame"
    assert (rows["link, outages"], rows["link, downtime"], rows["link, damaged at drive"]) == ("1", "30.0 s", "1")
    assert rows["longest pause of this program"] == "0.31 s"
    assert (rows["dropped by the live view"], rows["live view"]) == ("1 block", "failed: the port is gone")
