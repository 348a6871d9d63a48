"""`import bench` in a notebook: what turns is agreed to, within limits, off whatever ends it; what comes is whole."""

from __future__ import annotations

import builtins
import io
import math
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from processes import ENVIRONMENT, LIMIT
from test_prompt import PhysicalDrive
from virtual_run import WatchedLink, at_rest, never_armed, physical, simulated
from virtual_run import run as live

import bench
from bench.errors import BenchError, NodeError, UnsafeError
from bench.record.reader import Run
from bench.replay.replay import replay
from bench.rig.settings import Settings
from protocol.messages import DriveState, Fault
from protocol.signals import DRIVE_CHANNELS, SOURCE_NAMES
from sim.config.params import load_params
from tests.bench.accept.accepting import SpoiltLink

I_MAX, N_P = 8.0, 6
NAMES = ("vt", "ek", "drive_vt")


@pytest.fixture(autouse=True)
def _somewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no bench.toml is, no target is set, and nobody can be asked."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("BENCH_TARGET", raising=False)
    monkeypatch.setattr(sys, "stdin", io.StringIO())


@contextmanager
def reached(link: WatchedLink) -> Iterator[str]:
    """A target behind which the link is."""
    with patch("bench.rig.connection.open_link", lambda target: link):
        yield f"serial:{Path.cwd()}/tty"


@contextmanager
def connected(link: WatchedLink, **options: Any) -> Iterator[bench.Rig]:
    with reached(link) as target, bench.connect(target, **options) as rig:
        yield rig


class Somebody:
    """At a notebook: answers what is asked."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *answers: str | Exception) -> None:
        self.asked: list[str] = []
        self._answers = list(answers)
        monkeypatch.setitem(sys.modules, "ipykernel", ModuleType("ipykernel"))
        monkeypatch.setattr(builtins, "input", self._input)

    def _input(self, question: str) -> str:
        self.asked.append(question)
        answer = self._answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer


# -- however it ends ------------------------------------------------------------------------------------------------


def test_a_start_that_fails_leaves_it_off() -> None:
    link = WatchedLink(physical())
    link._on_call = lambda number: (
        link.device.drive.fault(Fault.OVERCURRENT) if link.states[-2:] == [DriveState.ARMED] * 2 else None
    )
    with pytest.raises(BenchError, match="OVERCURRENT"), connected(link, yes=True) as rig:
        rig.drive.speed(rpm=500)
    assert DriveState.ARMED in link.states
    assert DriveState.RUNNING not in link.states
    assert at_rest(link.device)


def test_a_closed_rig_turns_nothing() -> None:
    link = WatchedLink(physical())
    with connected(link, yes=True) as rig:
        assert repr(rig).endswith("the drive IDLE, the load machine IDLE, 22 channels at 16000 Hz")
        rig.drive.speed(rpm=100)
        assert repr(rig.drive) == "the drive RUNNING"
    assert repr(rig).endswith("the drive IDLE, the load machine IDLE, streams nothing")
    with pytest.raises(Exception, match="is closed"):
        rig.drive.speed(rpm=100)
    assert at_rest(link.device)


# -- consent and limits ---------------------------------------------------------------------------------------------


def test_nothing_is_energised_where_nobody_can_be_asked() -> None:
    link = WatchedLink(physical())
    with connected(link, limits=bench.Envelope(300, 2.0)) as rig:
        for act in (rig.drive.start, lambda: rig.drive.speed(rad_s=1.0), lambda: rig.drive.current(0.1)):
            with pytest.raises(UnsafeError, match=r"up to 300 r/min, phase current up to 2 A: .*in Python: yes=True"):
                act()
        with pytest.raises(UnsafeError):
            rig.load.torque(0.1)
        assert len(rig.record(0.1)) > 1500  # to look is free
    assert never_armed(link)


@pytest.mark.parametrize("answer", ["", "n", "nein", EOFError(), NotImplementedError("no stdin")])
def test_only_a_yes_is_one(monkeypatch: pytest.MonkeyPatch, answer: str | Exception) -> None:
    link = WatchedLink(physical())
    somebody = Somebody(monkeypatch, answer)
    words = "yes=True" if isinstance(answer, Exception) else "not confirmed"
    with connected(link) as rig, pytest.raises(UnsafeError, match=words):
        rig.drive.speed(rad_s=1.0)
    assert len(somebody.asked) == 1
    assert never_armed(link)


def test_somebody_is_asked_once_for_drive_and_load_and_again_after_a_no(monkeypatch: pytest.MonkeyPatch) -> None:
    link = WatchedLink(physical())
    somebody = Somebody(monkeypatch, "n", " Yes ")
    with connected(link, limits=bench.Envelope(600, 4.0)) as rig:
        assert somebody.asked == []
        with pytest.raises(UnsafeError):
            rig.load.torque(0.1)
        rig.load.torque(0.1)
        rig.drive.speed(rpm=100)
        rig.drive.stop()
        rig.drive.speed(rpm=200)
    assert len(somebody.asked) == 2
    drive = link.device.sessions[0].identity
    assert somebody.asked[0] == (
        f"Spin {drive.name} (boot {drive.boot_id:08x}) on serial:{Path.cwd()}/tty: up to 600 r/min, phase current up "
        "to 4 A. Is the shaft clear? [y/N]: "
    )


@pytest.mark.slow
@pytest.mark.real_time
def test_whoever_takes_time_to_answer_loses_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    drive = PhysicalDrive()
    periods = []

    def take_time(question: str) -> str:
        periods.append(drive.device.periods)
        while drive.device.periods - periods[0] < 3 * drive.device.pwm_hz:
            threading.Event().wait(0.05)
        return "y"

    Somebody(monkeypatch)
    monkeypatch.setattr(builtins, "input", take_time)
    with closing(drive), bench.connect(drive.port.target) as rig:
        before = rig.tick()
        rig.drive.speed(rpm=300)
        run = rig.record(0.2)
        asked = rig.between(before, int(run.samples.tick[-1]))
    assert run.dropped == asked.dropped == ()
    assert len(asked) > 3.2 * 16000
    assert run["omega_enc"][-1] > 50


def test_nothing_beyond_the_limits_is_asked_of_the_drive() -> None:
    link = WatchedLink(physical())
    app = link.device.sessions[0].app
    with connected(link, yes=True, limits=bench.Envelope(rpm=300, current=2.5)) as rig:
        assert app.get_param("i_max") == 2.5
        for act, words in (
            (lambda: rig.drive.speed(rpm=-301), "speed 301 r/min is beyond the announced limit of 300 r/min"),
            (lambda: rig.drive.speed(rad_s=31.6), "speed 301.8 r/min is beyond the announced limit of 300 r/min"),
            (lambda: rig.drive.speed(rad_s=math.nan), "speed nan r/min is beyond the announced limit of 300 r/min"),
            (
                lambda: rig.drive.current(2.0, -1.6),
                r"current 2\.561 A is beyond the announced limit of 2\.5 A.*Envelope\(current=…\)",
            ),
            (lambda: rig.drive.set("i_max", 2.6), r"i_max 2\.6 A is beyond the announced limit of 2\.5 A"),
            (
                lambda: rig.load.speed(rad_s=31.6),
                r"load\.speed 301\.8 r/min is beyond the announced limit of 300 r/min",
            ),  # type: ignore[attr-defined]
        ):
            with pytest.raises(BenchError, match=words):
                act()
        assert bench.Envelope(rad_s=10 * math.pi) == bench.Envelope(rpm=pytest.approx(300))
        both = (lambda: rig.drive.speed(rpm=10, rad_s=1)), lambda: bench.Envelope(rpm=10, rad_s=1)
        for act in (rig.drive.speed, rig.load.speed, *both):
            with pytest.raises(TypeError, match=r"give a speed either as rpm=… or as rad_s=…, mechanical"):
                act()
        assert never_armed(link)
        rig.drive.speed(rpm=300)
    assert app.get_param("i_max") == I_MAX


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        (bench.Envelope(current=9.0), r"current 9 A is beyond the drive's limit of 8 A \(its parameter i_max\)"),
        (bench.Envelope(rpm=4000), r"speed 4000 r/min is beyond the drive's limit of 3151 r/min"),
    ],
)
def test_limits_beyond_the_drives_own_are_refused(limits: bench.Envelope, words: str) -> None:
    link = WatchedLink(physical())
    with pytest.raises(BenchError, match=words), connected(link, yes=True, limits=limits):
        pass
    assert never_armed(link)


# -- what is connected to -------------------------------------------------------------------------------------------


def test_one_target_has_one_rig() -> None:
    link = WatchedLink(physical())
    with reached(link) as target:
        rig = bench.connect(target)
        with pytest.raises(BenchError, match="tty is in use by another run: wait until it ends, or close its rig"):
            bench.connect(target)
        rig.close()
        link.reopen()
        bench.connect(target).close()


def test_without_a_load_it_says_so() -> None:
    with (
        bench.connect("sim", settings=Settings(load="none")) as rig,
        pytest.raises(BenchError, match="there is no load: no node 2 answers on the drive's link, or"),
    ):
        rig.load.torque(0.1)


def test_a_recording_is_not_overwritten_unasked(tmp_path: Path) -> None:
    file = tmp_path / "run.run"
    with bench.connect("sim", save=file) as rig:
        rig.record(0.05)
    kept = (file / "run.jsonl").read_bytes()
    with pytest.raises(BenchError, match=r"run\.run exists: .*\(in Python: overwrite=True\)"):
        bench.connect("sim", save=file)
    assert (file / "run.jsonl").read_bytes() == kept
    with bench.connect("sim", save=str(file), overwrite=True) as rig:
        rig.record(0.2)
    assert len(bench.read(file)) > 3000


def test_names_that_the_drive_does_not_have() -> None:
    with pytest.raises(NodeError, match=r"no channel 'theta_ecn': did you mean theta_enc\?"):
        bench.connect("sim", channels=["theta_ecn"])
    with bench.connect("sim", channels="i_q,hall,i_q") as rig:
        with pytest.raises(NodeError, match=r"no parameter 'k_p_vtt': did you mean k_p_vt\?"):
            rig.drive.set("k_p_vtt", 1.0)
        with pytest.raises(BenchError, match="no angle source 'magic'; available: encoder, average-speed"):
            rig.drive.start("magic")
        assert rig.record(0.05).names == ("hall", "i_q")  # each once, in the order of the drive
        assert rig.latest("i_q") == pytest.approx(0.0, abs=0.2)
        with pytest.raises(BenchError, match=r"channel 'i_d' is not in the stream"):
            rig.latest("i_d")
        rig.drive.start("edge_kalman")
        assert rig.drive.parameters["observer"] == SOURCE_NAMES["edge-kalman"]
    with bench.connect("sim", channels="+theta_ek") as rig:
        assert set(rig.record(0.05).names) >= {"theta_ek", "theta_vt", "i_a"}


# -- captures -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> tuple[bench.Capture, Path]:
    """0.5 s at 500 r/min with 0.1 N·m, and the recording of all of its run."""
    path = tmp_path_factory.mktemp("saved") / "run.run"
    with bench.connect("sim", save=path) as rig:
        rig.drive.speed(rpm=500)
        rig.load.torque(0.1)
        rig.wait(0.5)
        capture = rig.record(0.5)
    return capture, path


@pytest.fixture(scope="module")
def run(saved: tuple[bench.Capture, Path]) -> bench.Capture:
    return saved[0]


def test_columns_are_raw_values_in_si_units(run: bench.Capture) -> None:
    signals = {signal.name: signal for signal in DRIVE_CHANNELS}
    assert len(run.names) == 22
    assert run.names == run.samples.raw.dtype.names
    for name in run.names:
        told = signals[name]
        assert run.units[name] == told.unit.symbol
        expected = [int(raw) * float(np.float32(told.scale)) + told.offset for raw in run.samples.raw[name][:50]]
        assert run[name][:50].tolist() == pytest.approx(expected, rel=1e-6, abs=1e-12), name
        assert run[name].shape == run.t.shape == (len(run),)
    omega_e = N_P * 500 * 2 * math.pi / 60
    assert run["omega_enc"].mean() == pytest.approx(omega_e, rel=2e-3)
    psi_f = load_params(None, {}).motor.psi_f
    assert run["i_q"].mean() == pytest.approx(0.1 / (1.5 * N_P * psi_f), rel=0.25)
    assert (run.units["omega_enc"], run.units["i_q"], run.units["u_dc"]) == ("rad/s", "A", "V")


def test_times_are_device_time_in_seconds(run: bench.Capture) -> None:
    assert np.diff(run.t) == pytest.approx(1 / 16000, rel=1e-9)
    assert run.t[-1] - run.t[0] == pytest.approx(0.5, abs=1 / 8000)
    assert np.diff(run.edge_t).mean() == pytest.approx(60 / 500 / (6 * N_P), rel=0.01)
    assert run.t[0] <= run.edge_t[0] <= run.edge_t[-1] <= run.t[-1]
    part = run.between(run.t[100], run.t[200])
    assert part["i_a"].tolist() == run["i_a"][100:201].tolist()


def test_arrow_and_pandas_hold_the_same_with_units(run: bench.Capture) -> None:
    table, frame = run.to_arrow(), run.to_pandas()
    assert table.schema.names == ["t", *run.names]
    assert list(frame.columns) == list(run.names)
    assert frame.index.name == "t"
    assert frame.index.to_numpy().tolist() == table["t"].to_pylist() == run.t.tolist()
    assert frame.attrs["units"] == run.units
    assert table.schema.field("t").metadata == {b"unit": b"s"}
    for name in run.names:
        assert table[name].to_pylist() == frame[name].tolist() == run[name].tolist()
        assert table.schema.field(name).metadata == {b"unit": run.units[name].encode()}


def test_a_recording_reads_as_what_was_recorded(saved: tuple[bench.Capture, Path]) -> None:
    run, path = saved
    whole = bench.read(path)
    assert whole.dropped == ()
    assert len(whole) > len(run) + 0.5 * 16000
    same = whole.ticks(int(run.samples.tick[0]), int(run.samples.tick[-1]))
    assert same.samples.raw.tobytes() == run.samples.raw.tobytes()
    assert same.names == run.names
    assert same.units == run.units
    for mine, read in ((run.samples, same.samples), (run.edges, same.edges)):
        assert read.tick.tolist() == mine.tick.tolist()
        assert read.index.tolist() == mine.index.tolist()
    assert same.edges.hall_new.tolist() == run.edges.hall_new.tolist()
    assert (same.tick_hz, same.rate) == (20_000_000, 16_000)
    assert same.parameters == run.parameters


def test_what_is_lost_is_told_by_the_capture_and_by_the_recording(tmp_path: Path) -> None:
    link = SpoiltLink(simulated())
    with connected(link, save=tmp_path / "run.run") as rig:
        rig.drive.speed(rpm=300)
        with rig.recording() as stretch:
            rig.wait(0.1)
            link.lose = 2
            rig.wait(0.1)
        run = stretch.capture
    (lost,) = run.samples.gaps
    assert lost.lost_samples == np.diff(run.samples.index).max() - 1 > 0
    assert [words for *_, words in run.dropped] == [
        f"{lost.lost_samples} samples were lost before {run.t[lost.position]:.4f} s"
    ]
    assert run.flaws()[0] == run.dropped[0][2]
    assert bench.read(tmp_path / "run.run").dropped == run.dropped


# -- estimates and scores -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("observer", "short", "settings"),
    [("vector_tracking", "vt", {"k_p": 900.0}), ("ek", "ek", {}), ("average-speed", "avg", {})],
)
def test_estimates_are_those_of_replay(
    drive_run: Path, tmp_path: Path, observer: str, short: str, settings: dict[str, float]
) -> None:
    ours = bench.estimate(bench.read(drive_run), observer, **settings)
    replay(drive_run, (observer,), settings, tmp_path / "out.run")
    theirs = Run(tmp_path / "out.run").samples
    assert ours.samples.raw.dtype == theirs.raw.dtype
    assert ours.samples.raw.tobytes() == theirs.raw.tobytes()
    assert ours.units[f"theta_{short}_host"] == "rad"
    assert ours.units[f"omega_{short}_host"] == "rad/s"


def test_settings_change_the_estimate_by_either_name(run: bench.Capture) -> None:
    own, same, slow, alias = (
        bench.estimate(run, "vt", **settings)["theta_vt_host"]
        for settings in ({}, {"k_p": run.parameters["k_p_vt"]}, {"k_p_vt": 300.0}, {"k_p": 300.0})
    )
    assert own.tolist() == same.tolist()
    assert slow.tolist() == alias.tolist() != own.tolist()
    assert "theta_vt_host" not in run


def test_captures_without_what_an_observer_needs(run: bench.Capture) -> None:
    with pytest.raises(BenchError, match="theta_vt_host is already in this capture: use the original"):
        bench.estimate(bench.estimate(run, "vt"), "vector-tracking")
    with bench.connect("sim", channels="theta_enc,i_a") as rig:
        few = rig.record(0.05)
        rig.client.sinks.clear()
    with pytest.raises(BenchError, match=r"vector_tracking cannot be run on this capture: it has no channel hall, "):
        bench.estimate(few, "vt")


def test_a_decimated_recording_is_not_estimated(tmp_path: Path) -> None:
    live(WatchedLink(simulated()), rate_hz=8000.0, save=tmp_path / "slow.run")
    slow = bench.read(tmp_path / "slow.run")
    assert slow.rate == 8000
    assert np.diff(slow.t) == pytest.approx(1 / 8000, rel=1e-9)
    with pytest.raises(BenchError, match="cannot be run on this capture: the stream is decimated by 2; observers"):
        bench.estimate(slow, "vt")


def test_captures_and_recordings_are_pooled(drive_run: Path, run: bench.Capture) -> None:
    first, last = run.between(run.t[0], run.t[0] + 0.25), run.between(run.t[0] + 0.25, run.t[-1])
    board = bench.score(first, last, drive_run, observers=["drive_vt"])
    assert list(board.by_file) == ["the capture 1", "the capture 2", f"{drive_run} 3"]
    each = [rows["drive_vt"]["moving"] for rows in board.by_file.values()]
    pooled = board.pooled["drive_vt"]["moving"]
    assert pooled["n"] == sum(row["n"] for row in each)
    assert pooled["rms"] ** 2 == pytest.approx(sum(row["n"] * row["rms"] ** 2 for row in each) / pooled["n"])
    error = np.degrees(first.position_error("theta_vt"))
    assert each[0]["rms"] == pytest.approx(math.sqrt(np.mean(error**2)), rel=1e-9)
    with pytest.raises(BenchError, match="nothing to score: pass a recording or a capture"):
        bench.score()


# -- the package ----------------------------------------------------------------------------------------------------


def test_the_package_loads_next_to_nothing_and_has_what_it_names() -> None:
    code = (
        "import sys, bench\n"
        "print(sorted({'numpy', 'rerun', 'numba', 'pyarrow', 'pandas', 'matplotlib', 'can'} & set(sys.modules)))\n"
        "print([name for name in bench.__all__ if getattr(bench, name) is None], dir(bench) == sorted(bench.__all__))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=LIMIT, env=ENVIRONMENT)
    assert done.stdout.splitlines() == ["[]", "[] True"], done.stderr
