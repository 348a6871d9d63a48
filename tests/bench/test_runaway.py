"""A motor that runs away is stopped, in every command that turns one; a healthy one is not, whatever it does.

Speeds are those of the simulated plant itself.
"""

from __future__ import annotations

import itertools
import math
import os
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from _pytest.mark.structures import ParameterSet
from conforming import run_on
from hall_motor import PWM_HZ, TABLE_I, TICK_HZ, Motor, capture
from virtual_run import NETWORKS, WatchedLink, at_rest, run, simulated

import bench
from bench.conform import run as conforming
from bench.conform.catalogue import checks
from bench.conform.claim import outcome
from bench.conform.levels import MOTION
from bench.motion.read import read_profile
from bench.rig.drive import RanAway
from bench.rig.runaway import Runaway, RunawayGuard
from bench.signal.chunks import narrowed, of_channels, part
from protocol.messages import DriveState
from sim.ports.device import SimulatedDevice
from tests.choice import sampled

SOON = 0.2  # s
INVERTED = {"wiring__hall_invert": 7}
RUNAWAYS = {  # configuration, and the speed asked for
    "all Hall inputs inverted": (INVERTED, 300.0),
    "the same, reverse": (INVERTED, -300.0),
    "the same, without an encoder": (INVERTED | {"encoder__present": 0}, 300.0),
    "the same, at its highest speed": (INVERTED, 3100.0),
    "the same, with a heavy shaft": (INVERTED | {"mechanics__J": 4e-3}, 300.0),
    "encoder turned by 180 degrees": ({"encoder__offset_deg": 180.0, "firmware__observer": 0}, 300.0),
}
WORDS = r"the drive let its motor run away: {:g} r/min asked for, -?\d+ r/min by the (encoder|Hall sensors) at .*"


class Plant(WatchedLink):
    """A link that keeps the plant's time and speed, s and r/min, while the drive is running."""

    def __init__(self, device: SimulatedDevice) -> None:
        super().__init__(device, self._keep)
        self.ran: list[tuple[float, float]] = []

    def _keep(self, call: int) -> None:
        if self.device.drive.state == DriveState.RUNNING:
            self.ran.append((self.clock(), self.device.bench.truth.omega_m * 30 / math.pi))

    def too_far_for(self, asked: float) -> float:
        """For how long it was faster than a healthy motor would be, or turned the wrong way, s."""
        beyond = [t for t, rpm in self.ran if rpm * math.copysign(1.0, asked) < -320.0 or abs(rpm) > abs(asked) + 320.0]
        return self.ran[-1][0] - beyond[0] if beyond else 0.0


def of_networks(*networks: str) -> list[ParameterSet]:
    return [pytest.param(*how, net, id=f"{name}, {net}") for name, how in RUNAWAYS.items() for net in networks]


@pytest.mark.parametrize(
    ("config", "asked", "network"),
    [*of_networks("bytes"), *sampled("runaway on a bus", of_networks("CAN", "CAN FD"), 3, campaign="runaway")],
)
def test_a_motor_that_runs_away_is_stopped_at_once(config: dict[str, float], asked: float, network: str) -> None:
    link = Plant(simulated(network=network, **config))
    few = ("status", "i_q" if "encoder__present" in config else "omega_enc")
    slow = {} if network == "bytes" else {"channels": few, "rate_hz": 1000.0}
    ended = run(link, speed_rpm=asked, duration=5.0, **slow)
    assert re.match(WORDS.format(asked), ended.summary.result)
    assert ended.exit_code == 1
    assert at_rest(link.device)
    assert 0.0 < link.too_far_for(asked) < SOON
    assert link.ran[-1][0] - link.ran[0][0] < 3.0


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize(
    "course",
    [
        {"speed_rpm": {"amplitude": 60.0, "frequency_Hz": 2.0, "offset": 300.0}, "for_s": 4.0},
        {"speed_rpm": 400.0, "ramp_s": 4.0},
    ],
    ids=["sine", "ramp"],
)
def test_a_motor_that_runs_away_from_a_profile_is_stopped_too(course: dict[str, Any], network: str) -> None:
    link = Plant(simulated(network=network, **INVERTED))
    slow = {} if network == "bytes" else {"channels": ("status", "i_q"), "rate_hz": 1000.0}
    ended = run(link, profile=read_profile({"steps": [course]}), speed_rpm=None, duration=None, **slow)
    assert re.match(r"the drive let its motor run away: \d+(\.\d+)? r/min asked for, ", ended.summary.result)
    assert (ended.exit_code, at_rest(link.device)) == (1, True)
    assert link.too_far_for(400.0) < SOON
    assert link.ran[-1][0] - link.ran[0][0] < 3.0


def test_a_notebook_stops_a_motor_that_runs_away_before_it_says_so() -> None:
    link = Plant(simulated(**INVERTED))

    def turn() -> None:
        rig.drive.speed(rpm=300)
        rig.record(2.0)

    with (
        patch("bench.rig.connection.open_link", lambda target: link),
        bench.connect(f"serial:/dev/ttyRUN-{id(link)}", yes=True) as rig,
    ):
        with pytest.raises(RanAway, match=WORDS.format(300)):
            turn()
        assert at_rest(link.device)
        assert link.too_far_for(300.0) < SOON
        rig.wait(0.3)  # and it may be used again


@pytest.mark.parametrize("network", NETWORKS)
def test_conform_stops_a_motor_that_runs_away_and_turns_it_no_more(network: str) -> None:
    device = simulated(network=network, **INVERTED)
    link = Plant(device)
    motion = [check for check in checks() if check.id.startswith("motion.")]
    with patch.object(conforming, "chosen", lambda level, bus: motion):
        results = run_on(link, MOTION, speed_rpm=300.0)
    words = {result.check.id: result.evidence for result in results.results}
    assert re.match(WORDS.format(300) + "STOP was sent", words["motion.stop"])
    assert words["motion.direction"] == words["motion.watchdog"] == "not tried: motion.stop failed"
    assert outcome(results).exit_code == 1
    assert at_rest(device)
    assert 0.0 < link.too_far_for(300.0) < SOON


# -- healthy motors -----------------------------------------------------------------------------------------------

HEALTHY: dict[str, dict[str, float]] = {
    "as it is": {},
    "no encoder": {"encoder__present": 0},
    "by its average speed": {"firmware__observer": 1},
    "false pulses": {"wiring__hall_glitch": 30.0},
    "noise": {"current_sensor__noise_rms": 0.2, "hall__jitter_deg": 2.0},
    "a heavy shaft": {"mechanics__J": 2e-3},
    "an elastic coupling": {"coupling__stiffness": 5.0, "coupling__damping": 1e-3, "coupling__backlash_deg": 1.0},
    "a speed loop that overshoots": {"firmware__speed_loop__k_i_speed": 20.0},
}


def manoeuvres(device: SimulatedDevice) -> None:
    """Steps up and down, through zero, at both ends of the range, with all the load that it bears, and let go."""
    link = WatchedLink(device)
    with (
        patch("bench.rig.connection.open_link", lambda target: link),
        bench.connect(f"serial:/dev/ttyRUN-{os.getpid()}-{id(link)}", yes=True) as rig,
    ):
        drive, most = rig.drive, rig.drive.parameters["omega_m_max"]
        load = 0.8 * rig.drive.parameters["i_max"] * drive.torque_constant
        for share in (0.05, 0.5, 1.0, 0.1, -0.1, -1.0, 0.0, 0.3):
            drive.speed(rad_s=share * most)
            rig.wait(0.5)
        for tau in (load, 0.0, -load, 0.0):
            for share in (0.02, 0.5):
                drive.speed(rad_s=share * most)
                rig.wait(0.3)
                rig.load.torque(tau)
                rig.wait(0.4)
        rig.load.speed(rad_s=0.5 * most)
        rig.wait(0.3)
        rig.load.torque(0.0)
        drive.current(0.1 * drive.parameters["i_max"])
        rig.wait(0.5)
        drive.speed(rpm=0)
        rig.wait(0.3)
        drive.speed(rad_s=0.5 * most)
        rig.wait(0.5)
        drive.stop()
        rig.wait(0.3)


@pytest.mark.parametrize(
    "config",
    sampled("healthy motor", HEALTHY, 3, campaign="runaway"),
)
def test_a_healthy_motor_is_never_stopped(config: dict[str, float]) -> None:
    manoeuvres(simulated(**config))


# -- a shaft by formula: what tells its speed may be wrong --------------------------------------------------------

FULL = 60.0 * math.pi  # electrical rad/s: 300 r/min
STEADY = ((FULL, 1.5),)
BACKWARDS = ((-FULL, 0.1), (-4 * FULL, 0.1), (-8 * FULL, 1.0))
TOO_FAST = ((FULL, 0.3), (3 * FULL, 1.0))


def looked_at(
    turns: tuple[tuple[float, float], ...], encoder: float | None = 1.0, own: float | None = 1.0,
    edges: float | None = 1.0, late: float = 0.0, lost: range = range(0), noise: float = 0.0, asked: float = FULL,
) -> tuple[str, float]:  # fmt: skip
    """What was seen and when, s after it went wrong, of a shaft that was asked for `asked` from the beginning.

    `encoder`, `own`, `edges`: what they tell over what is true, None: not streamed. `late`: s after samples that edges
    come. `lost`: chunks of 20 ms that do not. `noise`: of both speeds, rad/s.
    """
    seen = capture(Motor(turns=turns, delta_deg=TABLE_I, n_p=6))
    raw, rng = seen.samples.raw.copy(), np.random.default_rng(3)
    omega = np.concatenate([np.full(round(seconds * PWM_HZ), speed) for speed, seconds in turns])
    kept = ["status"]
    for name, factor in (("omega_enc", encoder), ("omega_vt", own)):
        if factor is not None:
            spoilt = factor * omega + noise * rng.standard_normal(len(omega))
            raw[name] = np.clip(np.round(spoilt / seen.samples.config.channel(name).scale), -32767, 32767)
            kept.append(name)
    config = narrowed(seen.samples.config, kept)
    guard = RunawayGuard(config, edges is not None, {"n_p": 6.0, "omega_m_max": 330.0, "observer": 2.0})
    guard.ask(asked / 6.0)
    samples = of_channels(replace(seen.samples, raw=raw), config)
    came = seen.edges if edges == 1.0 else part(seen.edges, 0, 0)
    given = 0
    for n, first in enumerate(range(0, len(samples), 320)):
        chunk = part(samples, first, first + 320)
        until = int(np.searchsorted(came.tick, chunk.tick[-1] - late * TICK_HZ))
        if until > given and edges is not None:
            guard.take(part(came, given, until))
            given = until
        if n not in lost:
            guard.take(chunk)
        if guard.verdict:
            return guard.verdict, float(chunk.tick[-1]) / TICK_HZ
    return "", math.nan


SOUND = {
    "as it is": {},
    "the encoder counts the other way": {"encoder": -1.0},
    "the encoder has half the lines": {"encoder": 2.0},
    "the encoder is dead": {"encoder": 0.0},
    "no encoder": {"encoder": None},
    "no Hall edges": {"edges": None},
    "dead Hall sensors": {"edges": 0.0},
    "the estimate is ten times too high": {"own": 10.0},
    "the estimate has the other sign": {"own": -5.0},
    "the estimate is wrong, and there is no encoder": {"own": -5.0, "encoder": None},
    "the estimate is wrong, and there are no edges": {"own": -5.0, "edges": None},
    "the encoder counts the other way, on CAN": {"encoder": -1.0, "late": 0.12},
    "edges come late": {"late": 0.4},
    "noise": {"noise": 3 * FULL},
    "half of it is lost": {"lost": range(0, 100, 2)},
    "nothing comes for a second": {"lost": range(10, 60)},
}


@pytest.mark.parametrize("given", SOUND.values(), ids=SOUND)
def test_a_motor_that_turns_as_it_was_asked_to_is_not_accused(given: dict[str, Any]) -> None:
    for turns in (
        STEADY,
        ((0.0, 0.1), (0.5 * FULL, 0.1), (1.4 * FULL, 0.05), (FULL, 1.0)),
        ((-0.5 * FULL, 0.1), *STEADY),
    ):
        assert looked_at(turns, **given) == ("", pytest.approx(math.nan, nan_ok=True))


@pytest.mark.parametrize("given", [{}, {"encoder": None}, {"edges": None}, {"noise": FULL}], ids=str)
@pytest.mark.parametrize("most", [1.5, 8.0])
@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_motor_that_its_load_slows_or_stalls_is_not_accused(way: float, most: float, given: dict[str, Any]) -> None:
    shares = ((1.0, 0.4), (0.3, 0.3), (0.02, 0.3), (-0.02, 0.2), (0.0, 0.3), (0.7, 0.3), (0.1, 0.3), (1.0, 0.2))
    turns = tuple((way * share * most * FULL, seconds) for share, seconds in shares)
    assert looked_at(turns, asked=way * most * FULL, **given)[0] == ""


@pytest.mark.parametrize("given", [
    {}, {"encoder": None}, {"edges": None}, {"encoder": 0.0}, {"edges": 0.0}, {"encoder": -1.0}, {"own": 0.3},
    {"noise": FULL}, {"lost": range(0, 100, 2)}, {"encoder": None, "edges": None}, {"encoder": None, "own": None},
], ids=str)  # fmt: skip
@pytest.mark.parametrize(("turns", "wrong"), [(BACKWARDS, 0.1), (TOO_FAST, 0.3)], ids=["backwards", "too fast"])
def test_a_runaway_is_seen_by_whatever_is_left_to_see_it(
    turns: tuple[tuple[float, float], ...], wrong: float, given: dict[str, Any]
) -> None:
    words, when = looked_at(turns, **given)
    assert words.startswith("let its motor run away: 300 r/min asked for, ")
    assert wrong < when < wrong + SOON


# -- a speed that moves on, as in a motion profile --------------------------------------------------------------------


def followed(shaft: Callable[[float], float], asked: Callable[[float], float], seconds: float) -> float:
    """When a guard that is told every 20 ms what is asked for saw a runaway, s; inf: never. Speeds in r/min."""
    guard, rpm = Runaway(6, lambda: 330.0), math.tau / 60.0
    guard.ask(asked(0.0) * rpm)
    for k in range(1, round(seconds / 0.01)):
        t = k * 0.01
        if k % 2 == 0:
            guard.follow(asked(t) * rpm)
        gone = 6.0 * rpm * shaft(t) * 0.01
        guard.by_encoder(t, 0.01, gone)
        guard.by_edges(t, 0.01, np.full(round(abs(gone) / (math.pi / 3.0)), np.sign(gone)))
        guard.judge(t)
        if guard.verdict:
            return t
    return math.inf


COURSES: dict[str, Callable[[float], float]] = {
    "a ramp": lambda t: 400.0 * t,
    "a ramp through zero": lambda t: 1000.0 - 500.0 * t,
    "a sine": lambda t: 500.0 + 400.0 * math.sin(6.0 * t),
    "a sine about zero": lambda t: 600.0 * math.sin(3.0 * t),
    "steps": lambda t: 800.0 if int(2.0 * t) % 2 else -800.0,
}


@pytest.mark.parametrize("asked", COURSES.values(), ids=COURSES)
@pytest.mark.parametrize("late", [0.0, 0.05, 0.2])
def test_a_shaft_that_follows_a_course_late_is_not_accused(asked: Callable[[float], float], late: float) -> None:
    assert followed(lambda t: asked(max(0.0, t - late)), asked, 4.0) == math.inf


@pytest.mark.parametrize("asked", COURSES.values(), ids=COURSES)
def test_a_shaft_that_takes_off_while_its_speed_moves_on_is_seen(asked: Callable[[float], float]) -> None:
    """From 1.5 s on it is faster and faster; a guard that began anew with each point would sum up nothing."""

    def shaft(t: float) -> float:
        return asked(t) if t < 1.5 else asked(1.5) + math.copysign(6000.0, asked(1.5)) * (t - 1.5)

    assert 1.5 < followed(shaft, asked, 4.0) < 2.2


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_shaft_that_a_current_turns_may_have_so_much_speed_and_no_more(way: float) -> None:
    for most, seen in ((1000.0, False), (800.0, True)):
        guard, rpm = Runaway(6, lambda: 330.0), way * math.tau / 60.0
        guard.most_free = most * math.tau / 60.0
        guard.follow(None)
        for k in range(1, 200):
            guard.by_encoder(0.01 * k, 0.01, 6.0 * 4.5 * k * rpm * 0.01)  # up to 895 r/min
            guard.judge(0.01 * k)
            if guard.verdict:
                break
        assert bool(guard.verdict) == seen
        assert ("at most 800 r/min asked for" in guard.verdict) == seen


@pytest.mark.parametrize("way", [1.0, -1.0])
@pytest.mark.parametrize(("share", "seen"), [(0.95, False), (1.1, True)])
def test_edges_alone_tell_the_speed_of_a_turn_however_they_lie(way: float, share: float, seen: bool) -> None:
    """Single edges up to a fifth of a sector from their places; what they have told long ago is forgotten."""
    guard, most = Runaway(6), 900.0 * math.tau / 60.0
    guard._there, guard.most_free = (guard._hall,), most
    guard.follow(None)
    sector = math.pi / 3.0 / (6.0 * share * most)
    off = np.array([0.0, 0.2, -0.1, 0.15, -0.15, -0.2])
    times = sector * (np.arange(20_000) + np.tile(off, 4_000)[:20_000])
    for before, after in itertools.pairwise(times.tolist()):
        guard.by_edges(after, after - before, np.array([way]))
        guard.judge(after)
        if guard.verdict:
            break
    assert bool(guard.verdict) == seen
    assert not seen or f"{way * share * 900.0:.0f} r/min by the Hall sensors" in guard.verdict
    assert len(guard._hall._travel) < 10.0 / sector
