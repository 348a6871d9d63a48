"""A motion profile that is played in virtual time: what is sent and when, what the plant does, and how it may end."""

from __future__ import annotations

import math
import os
import signal
import struct
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from profiles import DRIVE, LOAD, flat, pieces_of, profiles
from virtual_run import RecordingScreen, WatchedLink, at_rest, never_armed, physical, raising, run, simulated

import bench
from bench.compare.alignment import seconds_of
from bench.errors import BenchError, UnsafeError
from bench.motion.read import profile_of, read_profile
from bench.record.reader import Run
from bench.rig.drive import DriveTripped
from bench.rig.profile import check_profile
from bench.rig.rig import Rig
from protocol.framing import Deframer, parse_frame
from protocol.messages import DriveState, Fault, MessageType, SetpointMode
from sim.config.params import load_params
from sim.ports.device import SimulatedDevice

RPM = 2.0 * math.pi / 60.0
EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "motion.toml"
PARAMS = load_params(None, {})
PER_AMPERE = 1.5 * PARAMS.motor.n_p * PARAMS.motor.psi_f  # N·m
TRUTH = ["omega_true", "tau_load_true", "omega_ref", "i_q", "status"]
LATE = 0.0002  # s by which what a step begins with may be late in virtual time: some PWM periods
PERIOD = 0.02  # s between points of a course


class Wire(WatchedLink):
    """A virtual link that keeps each SETPOINT: time, node, mode and value; and may lose those that `lost` chooses."""

    def __init__(
        self,
        device: SimulatedDevice,
        on_call: Callable[[int], None] = lambda number: None,
        lost: Callable[[int], bool] = lambda number: False,
    ) -> None:
        super().__init__(device, on_call)
        self.sent: list[tuple[float, int, SetpointMode, float]] = []
        self._lost = lost

    def write(self, data: bytes) -> None:
        kept = []
        for raw in data.split(b"\0"):
            frames = [parse_frame(frame) for frame in Deframer().feed(b"\0" + raw + b"\0")]
            setpoints = [frame for frame in frames if frame.type == MessageType.SETPOINT]
            for frame in setpoints:
                mode, _, value, _ = struct.unpack("<BxHff", frame.payload)
                self.sent.append((self.clock(), frame.node, SetpointMode(mode), value))
            if not (setpoints and self._lost(len(self.sent))):
                kept.append(raw)
        super().write(b"\0".join(kept))


@contextmanager
def rig_on(link: WatchedLink, **options: Any) -> Iterator[Rig]:
    with (
        patch("bench.rig.connection.open_link", lambda target: link),
        bench.connect(f"serial:/dev/ttyMOTION-{os.getpid()}-{id(link)}", **{"yes": True, **options}) as rig,
    ):
        yield rig


def live(link: WatchedLink, data: dict[str, Any], screen: RecordingScreen | None = None, **options: Any) -> Any:
    asked = profile_of(data, "motion.toml")
    return run(link, screen=screen, **({"profile": asked, "speed_rpm": None, "duration": None} | options))


# -- what is sent, and when -----------------------------------------------------------------------------------------


def asked_at(data: dict[str, Any], quantities: tuple[str, ...], t: float) -> list[float]:
    """What is asked for at a time; two values at a joint."""
    near = [piece for piece in pieces_of(data, quantities) if piece.begin - LATE <= t <= piece.end + LATE]
    return [float(piece.at(min(max(t, piece.begin), piece.end))) for piece in near]


def steepest(data: dict[str, Any], quantities: tuple[str, ...]) -> float:
    """The most that it changes in a second, but for jumps."""
    slopes = [0.0]
    for piece in pieces_of(data, quantities):
        t = np.linspace(piece.begin, piece.end, 4001)
        slopes.append(float(np.abs(np.diff(piece.at(t)) / np.diff(t)).max()))
    return max(slopes)


@settings(max_examples=4, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(profiles("speed_rpm", "load_torque_Nm"))
def test_each_setpoint_is_what_the_profile_asks_for_at_that_time(data: dict[str, Any]) -> None:
    """As it goes over the link; while something changes, a point comes every 20 ms, and each step's end is met."""
    for step in flat(data["steps"]):  # the example's motor keeps up with a fifth of that
        for key in {"speed_rpm", "load_torque_Nm"} & step.keys():
            step[key] = _shrunk(step[key])
        for key in {"for_s", "ramp_s"} & step.keys():
            step[key] = 0.2 * step[key] + 0.008
    link = Wire(simulated())
    with rig_on(link, channels=TRUTH) as rig:
        rig.play(data)
    for node, quantities, unit in ((1, DRIVE, RPM), (2, LOAD, 1.0)):
        sent = [(t, value / unit) for t, to, _, value in link.sent if to == node]
        if not sent:
            assert node == 2
            assert all("load_torque_Nm" not in step for step in flat(data["steps"]))
            continue
        begin = link.sent[0][0]
        slope = steepest(data, quantities)
        for t, value in sent:
            assert min(abs(value - each) for each in asked_at(data, quantities, t - begin)) <= 1e-3 + slope * LATE
        for piece in pieces_of(data, quantities):
            changes = piece.first != piece.last or piece.sine is not None
            inside = [t - begin for t, _ in sent if piece.begin + 1e-9 < t - begin <= piece.end]
            if changes and piece.end - piece.begin > 2 * PERIOD:
                assert max(np.diff([piece.begin, *inside, piece.end])) < PERIOD + 2 * LATE
            elif not changes:
                assert len(inside) <= 1


def _shrunk(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: 0.2 * of if key in ("amplitude", "offset") else of for key, of in value.items()}
    return 0.2 * value


KINDS = {
    "steps": [
        {"speed_rpm": 500.0, "ramp_s": 0.2, "for_s": 0.5},
        {"load_torque_Nm": 0.15, "for_s": 0.2, "mark": "load step"},
        {"load_torque_Nm": -0.1, "ramp_s": 0.2, "for_s": 0.3},
        {"repeat": 2, "steps": [
            {"load_torque_Nm": 0.1, "for_s": 0.15, "mark": "on"}, {"load_torque_Nm": 0.0, "for_s": 0.1},
        ]},
        {"load_torque_Nm": {"amplitude": 0.1, "frequency_Hz": 4.0, "offset": 0.05}, "for_s": 0.5},
        {"load_current_A": 2.0, "for_s": 0.2},
    ]
}  # fmt: skip


def test_the_load_on_the_shaft_is_that_of_the_profile_at_its_marks() -> None:
    """By the plant's own torque at each PWM period, with device time from the recording's marks."""
    link = Wire(simulated())
    with rig_on(link, channels=TRUTH) as rig:
        played = rig.play(KINDS)
    steps = list(flat(KINDS["steps"]))
    assert [span.name for span in played.spans] == ["step 1", "load step", "step 3", "on", "step 4.2", "on", "step 4.2",
                                                    "step 5", "step 6"]  # fmt: skip
    hz = played.capture.tick_hz
    begin = played.spans[0].first / hz
    slope = steepest(KINDS, LOAD)
    for span, step in zip(played.spans, steps, strict=True):
        assert (span.last - span.first) / hz == pytest.approx(step["for_s"], abs=LATE)
    torque, t = played.capture["tau_load_true"], played.capture.t - begin
    last = sum(step["for_s"] for step in steps)
    checked = 0
    for time, value in zip(t[::7], torque[::7], strict=True):
        if 0.0 < time < last:
            near = asked_at(KINDS, LOAD, time - PERIOD), asked_at(KINDS, LOAD, time)
            wanted = [
                each * (PER_AMPERE if time > last - 0.2 and each == 2.0 else 1.0) for each in (*near[0], *near[1])
            ]
            assert min(abs(value - each) for each in wanted) <= slope * 2 * PERIOD + 1e-3
            checked += 1
    assert checked > 4000
    assert played["load step"]["tau_load_true"][100:].mean() == pytest.approx(0.15, abs=1e-3)
    assert played["on#2"]["tau_load_true"][100:].mean() == pytest.approx(0.1, abs=1e-3)
    assert played["step 6"]["tau_load_true"][100:].mean() == pytest.approx(2.0 * PER_AMPERE, rel=0.01)
    for name, words in (("on", "'on' was played 2 times: choose one, such as on#1"), ("on#3", "there is no on#3"),
                        ("off", "no step 'off' was played")):  # fmt: skip
        with pytest.raises(BenchError, match=words):
            played[name]


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> tuple[WatchedLink, Any, Run]:
    """The example of the docs by `bench live`: the link, the outcome, the recording."""
    path, link = tmp_path_factory.mktemp("example") / "a.run", WatchedLink(simulated())
    ended = live(link, tomllib.loads(EXAMPLE.read_text()), save=path, channels=("+omega_true", "+tau_load_true"))
    return link, ended, Run(path)


def loop_gain(hz: float, k_p: float = 0.1) -> float:
    """How large the shaft's speed swings over its reference: a PI on the speed, an inertia, nothing between."""
    s, k_i = 2j * math.pi * hz, PARAMS.firmware.speed_loop.k_i_speed
    forward = PER_AMPERE * (k_p * s + k_i)
    return abs(forward / (PARAMS.mechanics.J * s * s + forward))


def test_the_shaft_follows_the_example(example: tuple[WatchedLink, Any, Run]) -> None:
    link, ended, recorded = example
    assert (ended.exit_code, at_rest(link.device)) == (0, True), ended.words
    hz, samples = recorded.info.tick_hz, recorded.samples
    t = samples.tick / hz - recorded.marks[0].first_tick / hz
    rpm = samples.physical("omega_true") / PARAMS.motor.n_p / RPM
    data, steady = tomllib.loads(EXAMPLE.read_text()), 0
    for piece in pieces_of(data, DRIVE):
        if piece.sine is not None:
            inside = (t > piece.end - 1.0) & (t < piece.end)  # two whole periods
            assert rpm[inside].mean() == pytest.approx(600.0, abs=10.0)
            assert np.ptp(rpm[inside]) == pytest.approx(200.0 * loop_gain(piece.sine["frequency_Hz"]), rel=0.04)
        elif piece.first == piece.last and piece.end - piece.begin >= 0.4:
            inside = (t > piece.end - 0.05) & (t < piece.end)
            assert rpm[inside].mean() == pytest.approx(piece.last, abs=15.0), piece
            steady += 1
    assert steady >= 7
    gains = [(change.name, change.value) for change in recorded.changes if change.name == "k_p_speed"]
    assert gains == [("k_p_speed", pytest.approx(0.1)), ("k_p_speed", pytest.approx(0.2))]
    assert recorded.info.identity["profile"] == "motion.toml"


def test_marks_of_the_example_can_be_named_for_comparing_and_measuring(example: tuple[WatchedLink, Any, Run]) -> None:
    _, ended, recorded = example
    acts = read_profile(EXAMPLE).acts
    assert [mark.name for mark in recorded.marks] == [act.name for act in acts]
    begins = [mark.first_tick / recorded.info.tick_hz for mark in recorded.marks]
    planned = [at for at, _ in read_profile(EXAMPLE).begins()]
    assert np.array(begins) - begins[0] == pytest.approx(planned, abs=LATE)
    sine = seconds_of(recorded, "sine"), seconds_of(recorded, "sine", last=True)
    assert sine[1] - sine[0] == pytest.approx(1.5, abs=LATE)  # type: ignore[operator]
    assert seconds_of(recorded, "reversal#2") == pytest.approx(begins[6])
    asked = {came.title: came for came in ended.summary.asked}
    assert asked["step 2 (load step): load torque 0.12 N·m"].load_asked_a == pytest.approx(0.12 / PER_AMPERE, rel=1e-3)
    assert math.isnan(next(came.speed_asked_rpm for title, came in asked.items() if "(sine)" in title))


def test_duration_cuts_a_profile_or_repeats_it() -> None:
    data = {"steps": [{"speed_rpm": 300, "ramp_s": 0.1, "for_s": 0.4}, {"speed_rpm": 100, "for_s": 0.3}]}
    for seconds, titles in ((0.5, 2), (1.2, 4)):
        ended = live(WatchedLink(simulated()), data, duration=seconds)
        assert len(ended.summary.asked) == titles
        assert ended.summary.duration_s == pytest.approx(seconds, abs=0.35)  # and start and stop


def test_a_ramp_to_where_it_is_takes_its_time_and_asks_for_nothing_new() -> None:
    link = Wire(simulated())
    with rig_on(link, channels=TRUTH) as rig:
        played = rig.play({"steps": [{"speed_rpm": 0, "ramp_s": 0.3}, {"for_s": 0.1}]})
    assert len(link.sent) == 1
    assert played.capture.t[-1] - played.capture.t[0] == pytest.approx(0.4, abs=0.05)


# -- what it may not ask for ----------------------------------------------------------------------------------------

REFUSED = [
    ({"speed_rpm": 3200, "for_s": 1}, "step [12.]+: speed_rpm comes to 3200 r/min, beyond 3151 r/min, the drive"),
    ({"speed_rpm": {"amplitude": 2000, "frequency_Hz": 1, "offset": 1500}, "for_s": 1}, "comes to 3500 r/min"),
    ({"load_torque_Nm": 0.48, "for_s": 1}, "load_torque_Nm comes to 0.48 N·m, beyond 0.4716 N·m, the torque"),
    ({"load_current_A": 9, "for_s": 1}, "load_current_A comes to 9 A, beyond 8 A, the"),
    ({"load_speed_rpm": 3400, "for_s": 1}, "load_speed_rpm comes to 3400 r/min, beyond 33.. r/min, the load"),
    ({"set": {"k_p_vtt": 1}, "for_s": 1}, "step [12.]+ sets k_p_vtt, and the drive has no such parameter: did"),
    ({"set": {"i_max": 5}, "for_s": 1}, "step [12.]+ sets i_max, which can be set only while the outputs are off"),
    ({"set": {"i_range": 5}, "for_s": 1}, "step [12.]+ sets i_range, which the drive only tells .READ_ONLY"),
    ({"set": {"observer": 1.5}, "for_s": 1}, "step [12.]+ sets observer = 1.5, and it takes whole numbers only"),
    ({"set": {"bw_current": 0.5}, "for_s": 1}, "step [12.]+ sets bw_current = 0.5 Hz, and it must be 1 to 4000 Hz"),
]  # fmt: skip


@pytest.mark.parametrize(("step", "words"), REFUSED)
def test_what_the_bench_does_not_allow_is_refused_before_anything_is_energised(
    step: dict[str, Any], words: str
) -> None:
    link = WatchedLink(simulated())
    before = dict(link.device.bench.parameters)
    with pytest.raises(BenchError, match=words):
        live(link, {"steps": [step]})
    link.reopen()
    with pytest.raises(BenchError, match=words), rig_on(link) as rig:
        rig.play({"steps": [{"for_s": 1}, {"repeat": 1, "steps": [step]}]})
    assert never_armed(link)
    assert link.device.bench.parameters == before


@pytest.fixture(scope="module")
def idle() -> Iterator[Rig]:
    with rig_on(WatchedLink(simulated()), limits=bench.Envelope(rpm=2000.0, current=5.0)) as rig:
        yield rig


@settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=profiles())
def test_exactly_what_is_beyond_a_limit_is_refused(idle: Rig, data: dict[str, Any]) -> None:
    """Limits that were announced and the machines' own, against the largest value of a walk of its own."""
    data["max_speed_rpm"] = 1500.0
    if not any("current_A" in step for step in flat(data["steps"])):
        del data["max_speed_rpm"]
    limits = {"speed_rpm": 2000.0, "current_A": 5.0, "load_current_A": 5.0, "load_torque_Nm": 5.0 * PER_AMPERE}
    shares = [
        float(np.abs(piece.at(np.linspace(piece.begin, piece.end, 2001))).max()) / limits[piece.quantity]
        for quantities in (DRIVE, LOAD)
        for piece in pieces_of(data, quantities)
        if piece.quantity in limits and any(key in quantities for step in flat(data["steps"]) for key in step)
    ]
    largest = max(shares, default=0.0)
    if largest > 1.001:
        with pytest.raises(BenchError, match=r"beyond (2000 r/min|5 A|0\.\d+ N·m), "):
            check_profile(profile_of(data, "a.toml"), idle.drive, idle.load)
    elif largest < 0.999:
        check_profile(profile_of(data, "a.toml"), idle.drive, idle.load)


def test_what_is_steeper_than_the_drive_follows_is_told() -> None:
    screen = RecordingScreen()
    slope = PARAMS.drive_parameters()["alpha_m_max"] / RPM  # r/min in a second
    data = {"steps": [{"speed_rpm": 300, "ramp_s": 0.9 * 300 / slope, "for_s": 0.2}, {"speed_rpm": 0, "ramp_s": 0.2}]}
    assert live(WatchedLink(simulated()), data, screen).exit_code == 0
    (told,) = [words for words in screen.notes if "alpha_m_max" in words]
    assert told.startswith(
        f"motion.toml, step 1 changes the speed by {slope / 0.9:.4g} r/min in a second, and the drive "
    )
    assert f"follows by {slope:.4g} at most" in told


def test_a_person_agrees_to_its_peaks() -> None:
    asked: list[str] = []
    link = WatchedLink(physical())
    data = {
        "max_current_A": 4,
        "steps": [{"speed_rpm": {"amplitude": 100, "frequency_Hz": 1, "offset": -700}, "for_s": 1}],
    }
    with pytest.raises(UnsafeError, match="not confirmed"):
        live(link, data, confirm=lambda words: bool(asked.append(words)))
    assert "up to 800 r/min, phase current up to 4 A" in asked[0]
    link.reopen()
    data = {"max_speed_rpm": 900, "steps": [{"current_A": 2, "for_s": 1}]}
    with pytest.raises(UnsafeError, match="not confirmed"):
        live(link, data, confirm=lambda words: bool(asked.append(words)))
    assert "up to 900 r/min, phase current up to 2 A" in asked[1]
    assert never_armed(link)


def test_the_most_current_that_it_names_is_the_drives_limit_meanwhile() -> None:
    limits: list[float] = []
    link = WatchedLink(simulated(), lambda call: limits.append(link.device.bench.parameters["i_max"]))
    data = {"max_current_A": 3, "steps": [{"speed_rpm": 300, "for_s": 0.2}]}
    with rig_on(link) as rig:
        rig.play(data)
        assert rig.drive.on
        with pytest.raises(BenchError, match="max_current_A = 2 comes too late, the drive is on with 3 A"):
            rig.play({**data, "max_current_A": 2})
    assert {limit for limit, state in zip(limits, link.states, strict=True) if state == DriveState.RUNNING} == {3.0}
    assert link.device.bench.parameters["i_max"] == 8.0


# -- however it ends ------------------------------------------------------------------------------------------------

TURNING = {"steps": [
    {"speed_rpm": 400, "ramp_s": 0.2, "for_s": 0.4, "set": {"k_p_speed": 0.1}, "mark": "up"},
    {"load_torque_Nm": 0.05, "for_s": 0.2},
    {"speed_rpm": -400, "ramp_s": 0.3, "for_s": 0.4, "set": {"k_p_vt": 500}},
]}  # fmt: skip


@pytest.fixture(scope="module")
def running() -> range:
    """Calls of the link while it is played."""
    link = WatchedLink(simulated())
    assert live(link, TURNING).exit_code == 0
    first = link.states.index(DriveState.RUNNING)
    return range(first, first + link.states[first:].index(DriveState.IDLE))


@pytest.mark.parametrize("share", [0.0, 0.1, 0.3, 0.5, 0.7, 0.99])
@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_at_any_moment_ends_it_with_the_outputs_off(
    running: range, share: float, kind: signal.Signals
) -> None:
    link = WatchedLink(simulated(), raising(kind, running[int(share * len(running))] + 1))
    before = dict(link.device.bench.parameters)
    ended = live(link, TURNING)
    assert DriveState.RUNNING in link.states
    assert ended.exit_code == 128 + kind
    assert at_rest(link.device)
    assert link.device.bench.parameters == before


def tripping(at: float) -> Wire:
    """A link whose drive trips when the shaft has been asked for something for so many s."""

    def on_call(call: int) -> None:
        if link.sent and link.clock() > link.sent[0][0] + at and link.device.drive.state == DriveState.RUNNING:
            link.device.drive.fault(Fault.OVERCURRENT)

    link = Wire(simulated(), on_call)
    return link


def test_after_a_trip_nothing_more_is_asked_for(tmp_path: Path) -> None:
    link = tripping(0.5)
    before = dict(link.device.bench.parameters)
    ended = live(link, TURNING, save=tmp_path / "a.run")
    assert (ended.exit_code, ended.words) == (1, "the drive tripped: OVERCURRENT")
    assert 0.4 < link.sent[-1][0] - link.sent[0][0] < 0.7
    assert ended.summary.duration_s > 1.0  # it is watched to the end
    assert at_rest(link.device)
    assert link.device.bench.parameters == before
    assert len(Run(tmp_path / "a.run").marks) < 3
    with pytest.raises(DriveTripped, match="OVERCURRENT"), rig_on(tripping(0.5)) as rig:
        rig.play(TURNING)


def test_parameters_are_those_of_the_step_and_as_before_at_the_end() -> None:
    seen: list[tuple[float, float]] = []
    parameters = lambda: link.device.bench.parameters  # noqa: E731
    link = WatchedLink(simulated(), lambda call: seen.append((parameters()["k_p_speed"], parameters()["k_p_vt"])))
    before = dict(parameters())
    with rig_on(link) as rig:
        rig.play(TURNING)
        assert rig.drive.on
        assert parameters() == before
    assert list(dict.fromkeys(seen)) == [
        (before["k_p_speed"], before["k_p_vt"]), (pytest.approx(0.1), before["k_p_vt"]), (pytest.approx(0.1), 500.0),
        (before["k_p_speed"], 500.0),
    ]  # fmt: skip


def test_the_angle_source_of_the_command_line_is_there_from_the_beginning() -> None:
    sources: list[float] = []
    link = WatchedLink(simulated(), lambda call: sources.append(link.device.bench.parameters["observer"]))
    first = {"speed_rpm": 300, "for_s": 0.2, "observer": "sector-centre"}  # the command line goes before it
    data = {"steps": [first, {"for_s": 0.2, "observer": "encoder"}]}
    assert live(link, data, observer="average-speed").exit_code == 0
    assert list(dict.fromkeys(sources)) == [2.0, 1.0, 0.0]
    assert sources[-1] == 2.0


def test_without_an_encoder_no_step_may_go_by_it() -> None:
    """Bench.toml says that none is mounted; the drive would start by it, and the first step takes another source."""
    settings = bench.Settings(encoder=False)
    first = {"speed_rpm": 200, "for_s": 0.3, "observer": "average-speed"}
    link = WatchedLink(simulated(firmware__observer=0))
    for step in ({"observer": "encoder", "for_s": 0.1}, {"set": {"observer": 0}, "for_s": 0.1}):
        with pytest.raises(BenchError, match=r"motion.toml, step 2 sets the angle source encoder, which the drive"):
            live(link, {"steps": [first, step]}, settings=settings)
        link.reopen()
    assert never_armed(link)
    assert live(link, {"steps": [first]}, settings=settings).exit_code == 0
    link.reopen()
    with rig_on(link, settings=settings) as rig:
        rig.play({"steps": [first]})
    assert link.device.bench.parameters["observer"] == 0.0


def test_setpoints_that_are_lost_are_sent_again() -> None:
    link = Wire(simulated(), lost=lambda number: number % 3 != 0)
    speeds = []
    with rig_on(link, channels=TRUTH) as rig:
        played = rig.play({"steps": [
            {"speed_rpm": 300, "ramp_s": 0.3}, {"for_s": 1.3}, {"speed_rpm": -300, "for_s": 1.3}, {"for_s": 0.3},
        ]})  # fmt: skip
        speeds = [played[name]["omega_ref"][-1] / PARAMS.motor.n_p / RPM for name in ("step 2", "step 3")]
    assert speeds == pytest.approx([300.0, -300.0], abs=1.0)


def test_a_drive_that_hears_no_setpoint_is_stopped() -> None:
    link = Wire(simulated(), lost=lambda number: number > 10)
    ended = live(link, {"steps": [{"speed_rpm": 300, "ramp_s": 0.5}, {"for_s": 1.5}]})
    assert (ended.exit_code, at_rest(link.device)) == (1, True)
    assert "confirmed no setpoint in 3 tries" in ended.words
    assert DriveState.RUNNING in link.states


def test_a_setpoint_that_is_rejected_is_told_and_ends_it() -> None:
    def lower(call: int) -> None:
        if call == 90:
            link.device.bench.parameters["omega_m_max"] = 200.0 * RPM

    link = Wire(simulated(), lower)
    ended = live(link, {"steps": [{"speed_rpm": 400, "ramp_s": 1.0}]})
    assert ended.exit_code == 1
    assert "rejected the setpoint SPEED" in ended.words
    assert "OUT_OF_RANGE (20.9" in ended.words
    assert at_rest(link.device)


@pytest.mark.parametrize("encoder", [1, 0])
def test_a_motor_that_a_current_turns_too_fast_is_switched_off(encoder: int) -> None:
    rpm: list[float] = []
    link = WatchedLink(
        simulated(encoder__present=encoder, firmware__observer=2),
        lambda call: rpm.append(link.device.bench.truth.omega_m / RPM),
    )
    data = {"max_speed_rpm": 800, "steps": [{"current_A": 1.0, "ramp_s": 0.2, "for_s": 3.0}]}
    ended = live(link, data)
    assert (ended.exit_code, at_rest(link.device)) == (1, True)
    assert "at most 800 r/min asked for" in ended.words
    assert 780.0 < max(rpm) < 1400.0


# -- what was announced --------------------------------------------------------------------------------------------


def test_energising_needs_consent_and_keeps_to_what_was_announced() -> None:
    link = WatchedLink(physical())
    with pytest.raises(BenchError, match="speed_rpm comes to 500 r/min, beyond 300 r/min, what was announced"), \
         rig_on(link, limits=bench.Envelope(rpm=300.0)) as rig:  # fmt: skip
        rig.play({"steps": [{"speed_rpm": 500, "for_s": 1}]})
    link.reopen()
    with pytest.raises(UnsafeError), rig_on(link, yes=False) as rig:
        rig.play({"steps": [{"speed_rpm": 500, "for_s": 1}]})
    assert never_armed(link)


def test_a_load_machine_that_is_not_there_is_missed_before_it_starts() -> None:
    link = WatchedLink(simulated())
    with pytest.raises(BenchError, match="load_torque_Nm needs a load machine, and this bench has none"), \
         rig_on(link, settings=replace(bench.Settings(), load="none")) as rig:  # fmt: skip
        rig.play(TURNING)
    assert never_armed(link)
