"""`rig.capture`: against what the same drive streams meanwhile, at its triggers, at a trip, and where it cannot be."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import bench
from bench.errors import BenchError, DriveFailed
from bench.rig.drive import DriveTripped
from bench.rig.rig import Rig
from protocol.messages import BlobRead, CaptureState, Fault
from protocol.signals import STATUS_STATE_MASK

CHANNELS = ("hall", "status", "theta_enc", "omega_enc", "i_d", "i_q")
MEMORY = 65_536
Bools = NDArray[np.bool_]


@pytest.fixture
def rig() -> Iterator[Rig]:
    with bench.connect("sim", channels=CHANNELS, seed=4, config={"memory": {"capture": MEMORY}}) as rig:
        yield rig


def above(values: NDArray[np.float64], level: float) -> Bools:
    return values > level


def begins(holds: Bools) -> Bools:
    """Where it holds and did not in the period before; the first period has none."""
    return holds & ~np.concatenate([[True], holds[:-1]])


CONDITIONS: dict[str, Callable[[bench.Capture], Bools]] = {
    "omega_enc > 420": lambda run: run["omega_enc"] > 420,
    "theta_enc < -3.0": lambda run: run["theta_enc"] < -3.0,
    "i_q rises 1.5": lambda run: begins(run["i_q"] > 1.5),
    "theta_enc falls -3": lambda run: begins(run["theta_enc"] < -3.0),
    "hall changes": lambda run: np.concatenate([[False], np.diff(run["hall"]) != 0]),
    "status changes": lambda run: np.concatenate([[False], np.diff(run["status"]) != 0]),
}


@pytest.mark.parametrize("trigger", CONDITIONS)
@pytest.mark.parametrize(("pre", "decimation"), [(0.0, 1), (0.4, 1), (0.4, 3)])
def test_it_holds_what_was_streamed_and_is_frozen_where_the_condition_first_held(rig, trigger, pre, decimation) -> None:
    rig.drive.speed(rpm=600)
    rig.wait(0.4)
    seconds = 0.06
    with rig.recording() as stretch:
        before = rig.tick()
        with rig.capture(trigger, seconds, pre, channels=CHANNELS, decimation=decimation) as shot:
            armed = rig.tick()
            rig.drive.speed(rpm=1200)
            rig.wait(0.3)
            if trigger == "status changes":
                rig.drive.observe("average-speed")
                rig.wait(0.1)
    streamed, held = stretch.capture, shot.capture

    assert held.rate == streamed.rate / decimation
    at = np.searchsorted(streamed.samples.tick, held.samples.tick)
    np.testing.assert_array_equal(streamed.samples.tick[at], held.samples.tick)
    np.testing.assert_array_equal(streamed.samples.index[at], held.samples.index)
    for name in CHANNELS:
        np.testing.assert_array_equal(streamed.samples.raw[name][at], held.samples.raw[name])
    assert set(np.diff(held.samples.index)) == {decimation}

    first, last = held.samples.tick[0], held.samples.tick[-1]
    among = (streamed.edges.tick > first) & (streamed.edges.tick <= last)
    np.testing.assert_array_equal(held.edges.tick[held.edges.tick > first], streamed.edges.tick[among])
    np.testing.assert_array_equal(held.edges.index[held.edges.tick > first], streamed.edges.index[among])
    assert not held.flaws()

    ticks = streamed.samples.tick
    holds = ticks[CONDITIONS[trigger](streamed) & (ticks > before)]
    frozen = shot.captured.status.tick
    period = held.samples.config.period_ticks
    earliest = holds[holds > armed][0]  # between the two ticks it was armed
    assert holds[0] <= frozen < earliest + decimation * period
    assert any(0 <= frozen - tick < decimation * period for tick in holds)
    assert shot.t0 == frozen / held.tick_hz
    assert shot.captured.status.first <= pre * seconds * held.rate + 1


def test_a_trip_freezes_it_and_it_is_read_before_the_trip_goes_on(rig) -> None:
    rig.drive.speed(rpm=500)
    device = rig.client.link.device
    shot = rig.capture("i_q > 100", 0.05, 0.8, channels=["status", "i_q"])

    def trip() -> None:
        with shot:
            rig.wait(0.1)
            device.drive.fault(Fault.OVERVOLTAGE)
            rig.wait(1.0)

    with pytest.raises(DriveTripped, match="OVERVOLTAGE"):
        trip()
    status = shot.capture["status"].astype(int) & STATUS_STATE_MASK
    assert len(shot.capture) == 800
    assert shot.captured.status.faults == Fault.OVERVOLTAGE
    assert status[0] != status[-1]
    assert device.drive.capture.state == CaptureState.ARMED


def test_at_a_fault_without_having_been_asked(rig) -> None:
    device = rig.client.link.device
    with pytest.raises(BenchError, match=r"holds no capture: it is ARMED, for a fault; nothing has frozen one since"):
        rig.at_fault()
    rig.drive.speed(rpm=500)
    rig.wait(0.3)
    with rig.drive.may_trip():
        device.drive.fault(Fault.HALL)
        tripped = device.tick
        rig.wait(0.2)
    held = rig.at_fault()
    assert (tripped - held.samples.tick[0]) / held.tick_hz >= 0.05
    assert held.samples.tick[-1] > tripped
    assert device.drive.capture.state == CaptureState.ARMED
    rig.drive.forget_faults()


def test_without_a_trigger_nothing_is_left_armed(rig) -> None:
    device = rig.client.link.device
    shot = rig.capture("i_q > 100", 0.02, channels=["i_q"], timeout=0.2)
    with pytest.raises(BenchError, match=r"no trigger 'i_q > 100' within 0\.2 s; nothing is armed now"), shot:
        pass
    assert device.drive.capture.trigger.name == "FAULT"
    with pytest.raises(BenchError, match="nothing was captured yet"):
        shot.capture  # noqa: B018
    with pytest.raises(ZeroDivisionError), rig.capture("i_q > 100", 0.02, channels=["i_q"]):
        raise ZeroDivisionError
    assert device.drive.capture.trigger.name == "FAULT"


def test_a_signal_while_the_trigger_is_awaited_leaves_nothing_armed(rig) -> None:
    class Interrupting:
        came = False

        def take(self, item: object) -> None:
            if not self.came:
                self.came = True
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), rig.capture("i_q > 100", 0.02, channels=["i_q"]):
        rig.client.sinks.append(Interrupting())
    assert rig.client.link.device.drive.capture.trigger.name == "FAULT"


def test_what_does_not_fit_says_what_does(rig) -> None:
    shot = rig.capture("now", 1.0, channels=CHANNELS)
    with pytest.raises(BenchError, match=rf"memory for captures of {MEMORY} bytes: --for \S+ does, or") as refused:
        shot.__enter__()
    words = str(refused.value).replace(",", "").split()
    seconds, decimation = float(words[words.index("--for") + 1]), int(words[words.index("--decimation") + 1])
    with rig.capture("now", 0.98 * seconds, channels=CHANNELS) as fits:
        pass
    assert fits.capture.span[1] - fits.capture.span[0] == pytest.approx(0.98 * seconds, abs=1e-3)
    with rig.capture("now", 1.0, channels=CHANNELS, decimation=decimation) as slower:
        pass
    assert slower.capture.span[1] - slower.capture.span[0] == pytest.approx(1.0, abs=1e-2)


def test_edges_without_room_are_counted_and_make_it_unfit(rig) -> None:
    rig.drive.speed(rpm=600)
    rig.wait(0.4)
    with rig.capture("now", 0.1, channels=["hall"], edges=5) as shot:
        pass
    held = shot.capture
    made = 6 * 6 * 600 / 60 * 0.1  # six sectors of six pole pairs
    assert len(held.edges) == 5
    assert shot.captured.status.edges_lost + 5 == pytest.approx(made, abs=2)
    assert any("found no room in the drive's memory" in flaw for flaw in held.flaws())
    assert held.samples.tick[-1] - held.edges.tick[-1] < held.tick_hz * 0.1 / made * 2  # the newest are kept


def test_a_run_of_it_is_taken_by_the_other_tools(rig, tmp_path) -> None:
    rig.drive.speed(rpm=600)
    rig.wait(0.4)
    with rig.capture("hall changes", 0.1, 0.2, channels=CHANNELS) as shot:
        pass
    path = tmp_path / "shot.run"
    shot.save(path)
    with pytest.raises(BenchError, match="exists"):
        shot.save(path)
    shot.save(path, overwrite=True)
    assert bench.open(path).marks["name"].tolist() == ["trigger hall changes"]
    mean = {row.channel: row.mean for row in bench.measure(path).rows}
    assert mean["omega_enc"] == pytest.approx(shot.capture["omega_enc"].mean(), rel=1e-6)
    for ending in ("csv", "mat", "npz", "parquet"):
        assert bench.export(path, tmp_path / f"shot.{ending}").rows["samples"] == len(shot.capture)


def test_a_drive_that_lies_about_its_crc_is_not_believed(rig) -> None:
    handlers = rig.client.link.device.drive._handlers
    answer = handlers[BlobRead]

    def wrong(request: BlobRead) -> object:
        reply = answer(request)
        if request.id == 1 and request.offset:
            data = bytes([reply.data[0] ^ 1]) + reply.data[1:]
            return type(reply)(reply.id, reply.length, reply.offset, reply.total, data)
        return reply

    handlers[BlobRead] = wrong
    shot = rig.capture("now", 0.05, channels=CHANNELS)
    with pytest.raises(DriveFailed, match=r"has CRC [0-9a-f]{8}, it told [0-9a-f]{8}"), shot:
        pass
    handlers[BlobRead] = answer
    assert len(rig.at_fault()) == 800  # it is still there


def test_a_drive_without_the_feature_says_so() -> None:
    with bench.connect("sim", channels="i_q", config={"memory": {"capture": 0}}) as rig:
        with pytest.raises(BenchError, match="holds no captures: it lacks the feature CAPTURE"):
            rig.capture("now")
        with pytest.raises(BenchError, match="it lacks the feature CAPTURE"):
            rig.at_fault()


def test_the_code_of_the_page_runs_as_it_is_printed(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("BENCH_TARGET", raising=False)
    page = (Path(__file__).parents[2] / "docs" / "capture.md").read_text()
    (block,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    cells: dict[str, object] = {}
    exec(block, cells)
    printed = capsys.readouterr().out
    run = bench.open(tmp_path / "shot.run")
    omega = run.read(channels=["omega_enc"])
    assert re.match(rf"Capture of {len(omega)} samples .* trigger at \d+\.\d+ s\n", printed)
    at = int(np.searchsorted(omega.samples.tick, run.info.trigger_tick))
    assert omega["omega_enc"][at - 1] <= 250 < omega["omega_enc"][at]
