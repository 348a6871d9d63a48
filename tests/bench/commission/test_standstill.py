"""The analysis of the steps at standstill, on windings whose answers are exact, and on what must be refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from windings import T, Winding, phases, seen_by, window

from bench.commission.refusal import Refused
from bench.commission.stand import COOLING
from bench.commission.steps import first_current, inductance, offsets, resistance
from bench.commission.window import Wave, Window, clarke

MOTORS = [(0.158, 0.176e-3, 8.0), (10.3, 4.3e-3, 1.0), (0.03, 20e-6, 30.0), (2.9, 2.2e-3, 1.5), (0.4, 0.2e-3, 15.0)]
"""R in ohm, L in H, the agreed current in A."""
BIASES = inductance.BIASES


# -- windows --------------------------------------------------------------------------------------------------------


def test_the_vector_of_three_phases_is_what_made_them() -> None:
    rng = np.random.default_rng(0)
    vector = rng.normal(0, 1, 50) + 1j * rng.normal(0, 1, 50)
    assert clarke(phases(vector)) == pytest.approx(vector, abs=1e-12)
    turned = window(vector, 2.0 * vector, angle=0.7)
    assert turned.dq == pytest.approx(vector, abs=1e-12)
    assert turned.u_dq == pytest.approx(2.0 * vector, abs=1e-12)


# -- offsets --------------------------------------------------------------------------------------------------------


def quiet(i: np.ndarray, u_dc: float = 24.0) -> Window:
    n = i.shape[1]
    return replace(window(np.zeros(n, complex), np.zeros(n, complex), u_dc=u_dc), i=i)


def test_offsets_and_noise_are_those_that_were_drawn() -> None:
    rng = np.random.default_rng(1)
    truth, sd = np.array([0.05, -0.02, 0.0]), 0.02
    inside = 0
    for _ in range(60):
        found = offsets.analyse(quiet(truth[:, None] + rng.normal(0, sd, (3, 2000))), 8.0)
        inside += sum(found.outcome[f"offset_{n}"].covers(t) for n, t in zip("abc", truth, strict=True))
        assert found.noise == pytest.approx(sd, rel=0.05)
        assert found.u_dc == 24.0
    assert 160 <= inside <= 179  # of 180, 95 %


@pytest.mark.parametrize(
    ("i", "u_dc", "words"),
    [(np.full((3, 100), 2.0), 24.0, "sensor a shows 2 A"),
     (np.random.default_rng(0).normal(0, 2.0, (3, 100)) * [[0], [0], [1]], 24.0, "sensor c scatters by"),
     (np.zeros((3, 100)), 0.0, "switch the supply on")],
)  # fmt: skip
def test_sensors_that_cannot_measure_are_named(i: np.ndarray, u_dc: float, words: str) -> None:
    with pytest.raises(Refused, match=words) as refused:
        offsets.analyse(quiet(i, u_dc), 8.0)
    assert refused.value.step == "offsets"


# -- the first current ----------------------------------------------------------------------------------------------


def level(angle: float, currents: tuple[float, float, float]) -> first_current.Level:
    return first_current.Level(angle, 1.0, np.array(currents))


@pytest.mark.parametrize("angle", [0.0, 2 * math.pi / 3, -2 * math.pi / 3, 0.4])
@pytest.mark.parametrize("amplitude", [0.1, 30.0])
def test_a_current_along_its_voltage_is_as_it_should_be(angle: float, amplitude: float) -> None:
    a, b, c = (amplitude * math.cos(angle - k * 2 * math.pi / 3) for k in range(3))
    first_current.check_level(level(angle, (a, b, c)))
    assert level(angle, (a, b, c)).vector == pytest.approx(amplitude, rel=1e-9)


@pytest.mark.parametrize(
    ("angle", "currents", "words"),
    [(2 * math.pi / 3, (-1.0, -1.0, 2.0), "not in the same order"),  # the sensors of b and c exchanged
     (0.0, (-2.0, 1.0, 1.0), "not in the same order"),  # all three reversed
     (0.0, (2.0, 1.0, -1.0), "sum is not 0"),  # one reversed
     (0.0, (0.0, -1.0, -1.0), "sum is not 0")],  # one dead
)  # fmt: skip
def test_a_current_elsewhere_is_named(angle: float, currents: tuple[float, float, float], words: str) -> None:
    with pytest.raises(Refused, match=words):
        first_current.check_level(level(angle, currents))


@pytest.mark.parametrize("phase", range(3))
def test_an_open_phase_is_named(phase: int) -> None:
    """With one open the current flows through the two others only, wherever the voltage points."""
    levels = []
    for angle in first_current.ANGLES:
        u = np.array([math.cos(angle - k * 2 * math.pi / 3) for k in range(3)])
        one, other = (k for k in range(3) if k != phase)
        i = np.zeros(3)
        i[one], i[other] = 0.5 * (u[one] - u[other]), 0.5 * (u[other] - u[one])
        if abs(i[one]) > 1e-9:
            levels.append(first_current.Level(angle, 1.0, i))
    assert first_current.missing_phase(levels) == "abc"[phase]
    whole = [first_current.Level(a, 1.0, phases(np.exp([1j * a]))[:, 0]) for a in first_current.ANGLES]
    assert first_current.missing_phase(whole) == ""


@pytest.mark.parametrize(("R", "L", "i_max"), MOTORS)
def test_the_swing_under_a_square_wave_is_that_of_its_cycles(R: float, L: float, i_max: float) -> None:
    half = first_current.HALF
    made = squared(R, L, i_max, "u_d", half, 0.3 * i_max, 0.1 * i_max)
    i = Winding(R, L).answer(made.u.real)[1:]
    assert first_current.swing(made, half) == pytest.approx(i[-2 * half :].max() - i[-2 * half :].min(), rel=1e-3)


# -- resistance -----------------------------------------------------------------------------------------------------


def levels(
    R: float, i_max: float, U: float, warming: float, rng: np.random.Generator, cooling: float = math.inf,
    gains: tuple[float, ...] = (1.0, 1.0, 1.0), noise: float = 0.0,
) -> list[resistance.Held]:  # fmt: skip
    """Windows as the step has them: a winding that warms by a share for each A2 s, a dead time that takes U a phase.

    At each phase the volts U tanh(i / i_smooth) are lost, so that the smallest levels see less of them.
    """
    held, heats, n = [], np.zeros(len(COOLING)), 480
    own = list(COOLING).index(cooling)
    for angle in resistance.PASSES:
        for share in resistance.LEVELS[::-1]:
            i_d = share * i_max
            vector = np.full(n, i_d * np.exp(1j * angle))
            lost = U * np.tanh(phases(vector) / (0.01 * i_max))
            heats = heats * np.exp(-0.042 / COOLING)
            heats = heats + 0.5 * i_d**2 * 0.042
            u = R * (1 + warming * heats[own]) * i_d + (clarke(lost) * np.exp(-1j * angle)).real
            heats = heats + 0.5 * i_d**2 * 0.042
            made = window(np.full(n, complex(i_d)), u + rng.normal(0, 2e-4 * R * i_max, n) + 0j, angle)
            held.append(resistance.Held(seen_by(made, rng, noise, gains), heats - 0.5 * i_d**2 * 0.042))
        heats = heats * np.exp(-1.0 / COOLING)  # until the next angle
    return held


@pytest.mark.parametrize(("R", "L", "i_max"), MOTORS)
@pytest.mark.parametrize(("warming", "cooling"), [(0.0, math.inf), (0.02, math.inf), (0.02, 15.0), (0.02, 4.0)])
def test_r_and_the_dead_time_are_those_of_the_winding_when_it_was_cold(
    R: float, L: float, i_max: float, warming: float, cooling: float
) -> None:
    """It warms by 2 % for each second at the agreed current, and cools meanwhile."""
    rng = np.random.default_rng(7)
    U = 0.4 * R * i_max
    found = resistance.analyse(levels(R, i_max, U, warming / i_max**2, rng, cooling), i_max, 0.0)
    assert found.outcome["R_s"].value == pytest.approx(R, rel=1e-3)
    assert found.outcome["R_s"].covers(R)
    assert found.outcome["U_dead"].value == pytest.approx(U, rel=3e-3)
    assert found.outcome["U_dead"].covers(U)
    assert found.dead_time == pytest.approx(U * T / 24.0, rel=3e-3)


def test_the_gains_of_three_sensors_are_told_apart_but_for_their_mean() -> None:
    rng = np.random.default_rng(8)
    for _ in range(10):
        gains = 1 + rng.normal(0, 0.01, 3)
        held = levels(0.158, 8.0, 0.4, 0.0, rng, gains=tuple(gains), noise=0.02)
        found = resistance.analyse(held, 8.0, 0.02)
        assert found.gains == pytest.approx(gains / gains.mean(), abs=5e-4)
        assert found.R * gains.mean() == pytest.approx(0.158, rel=2e-3)  # in the drive's amperes


def test_a_line_through_the_origin_would_have_been_wrong() -> None:
    """What is told apart is no trifle: u over i at half the current is half as much again."""
    rng = np.random.default_rng(9)
    found = resistance.analyse(levels(0.158, 8.0, 0.384, 0.0, rng), 8.0, 0.0)
    assert found.outcome.evidence.figures["naive_R"] > 1.5 * 0.158


def test_levels_that_tell_nothing_are_refused() -> None:
    rng = np.random.default_rng(10)
    held = levels(0.158, 8.0, 0.4, 0.0, rng)
    with pytest.raises(Refused, match="do not tell R"):
        resistance.analyse([each for each in held if each.window.dq.real.mean() < 2.2], 8.0, 0.0)
    reversed_ = [replace(each, window=replace(each.window, u=-each.window.u)) for each in held]
    with pytest.raises(Refused, match="voltage falls where the current grows"):
        resistance.analyse(reversed_, 8.0, 0.0)


# -- inductance -----------------------------------------------------------------------------------------------------


def squared(
    R: float, L: float, i_max: float, axis: str, half: int, bias: float, swing: float, K: float = 0.0,
    link: np.ndarray | None = None, cycles: int = 60,
) -> Window:  # fmt: skip
    """A winding under a square wave beside a d current, exactly. `link`: u_dc at each sample and two before, (n + 2,).

    The drive makes of a reference the share of the link as it was a period before it lies on the winding.
    """
    n = 2 * half * cycles
    amplitude = swing * L / (half * T) + 0.5 * R * swing
    sign = np.where(np.arange(n) % (2 * half) < half, 1.0, -1.0)
    level = R * bias if axis == "u_d" else 0.0
    reference = level + amplitude * sign
    u_dc = np.full(n + 3, 24.0) if link is None else link
    there = reference * 0.5 * (u_dc[1:-2] + u_dc[2:-1]) / u_dc[:-3] if link is not None else reference
    wave = Winding(R, L, K).answer(there, level / R - (0.5 * swing))[1:]
    straight = np.zeros(n)
    i = wave + 1j * straight if axis == "u_d" else bias + 1j * (wave - 0.0)
    u = reference + 1j * straight if axis == "u_d" else R * bias + 1j * reference
    made = window(np.asarray(i), np.asarray(u))
    begins = np.arange(n) % (2 * half) == 0
    used = slice(20 * half, None)  # what was before has died out
    return replace(
        made, i=made.i[:, used], u=made.u[used], u_dc=u_dc[2:-1][used], control=made.control[used],
        index=made.index[used], cycle=begins[used],
    )  # fmt: skip


def waves(R: float, i_max: float, L_of: dict[str, float], a: float = 0.0, K: float = 0.0) -> list[Wave]:
    """All windows of the step: L falls with the d current as 1 / (1 + a (i / i_max)^2)."""
    made = []
    for share in BIASES:
        for axis, part in inductance.SWINGS.items():
            for half in inductance.HALVES:
                L = L_of[axis] / (1.0 + a * share**2)
                swing = part * i_max * min(share, 0.4)
                shown = squared(R, L, i_max, axis, half, share * i_max, swing, K if axis == "u_q" else 0.0)
                made.append(Wave(shown, axis, half, share * i_max))
    return made


@pytest.mark.parametrize(("R", "L", "i_max"), MOTORS)
@pytest.mark.parametrize("K", [0.0, 0.03, 0.3])
def test_l_is_that_of_the_winding_whatever_the_rotor_does(R: float, L: float, i_max: float, K: float) -> None:
    """`K`: by how much the rotor's rocking takes off L_q at the slower rate, as a share, about."""
    slow = (2 * math.pi / (2 * inductance.HALVES[1] * T)) ** 2
    made = waves(R, i_max, {"u_d": 0.9 * L, "u_q": L}, a=0.3, K=K * L * slow)
    outcome = inductance.analyse(made, R, np.ones(3), i_max, 0.0).outcome
    for name, truth in (("L_d", 0.9 * L), ("L_q", L)):
        assert outcome[name].value == pytest.approx(truth, rel=5e-3)
        assert outcome[f"{name}_half"].value == pytest.approx(truth / (1 + 0.3 * 0.25), rel=4e-3)
        assert outcome[name].covers(truth)
        assert outcome[f"{name}_half"].covers(truth / (1 + 0.3 * 0.25))


def test_k_that_is_known_is_taken_as_it_is() -> None:
    R, L, i_max = MOTORS[0]
    n_p, psi, J = 6, 6.55e-3, 2e-4
    K = inductance.rocking_of(n_p, psi, J)
    assert pytest.approx(1.5 * n_p**2 * psi**2 / J) == K
    made = waves(R, i_max, {"u_d": L, "u_q": L}, K=K)
    known = inductance.analyse(made, R, np.ones(3), i_max, 0.0, (K, 0.02 * K))
    guessed = inductance.analyse(made, R, np.ones(3), i_max, 0.0)
    assert guessed.outcome.evidence.figures["rocking"] == pytest.approx(K, rel=0.3)
    assert known.outcome["L_q"].value == pytest.approx(L, rel=2e-3)
    assert known.outcome["L_q"].sd < guessed.outcome["L_q"].sd
    held = inductance.analyse(made, R, np.ones(3), i_max, 0.0, (0.0, 0.0))
    assert held.outcome["L_q"].value < known.outcome["L_q"].value  # a rotor that rocks is not held


@pytest.mark.parametrize(("R", "L", "i_max"), MOTORS)
def test_noise_does_not_make_l_smaller(R: float, L: float, i_max: float) -> None:
    """Its power in di would, by the share that it has in it: 5 % and more here in a single cycle's."""
    rng, values = np.random.default_rng(11), []
    made = squared(R, L, i_max, "u_d", 4, 0.2 * i_max, 0.08 * i_max, cycles=310)
    for _ in range(20):
        noisy = Wave(seen_by(made, rng, 0.01 * i_max), "u_d", 4, 0.2 * i_max)
        values.append(inductance.slope(noisy, R, np.ones(3)).L)
    assert np.mean(values) == pytest.approx(L, rel=4e-3)


def test_a_link_that_gives_way_is_no_inductance() -> None:
    """The link sinks while the square wave takes power; without its correction L is several tenths of a percent off."""
    R, L, i_max = MOTORS[0]
    half, n = 10, 2 * 10 * 60
    sign = np.where(np.arange(n + 3) % (2 * half) < half, -1.0, 1.0)
    link = 24.0 + np.cumsum(sign - sign.mean()) * 0.004
    made = squared(R, L, i_max, "u_d", half, 4.0, 1.28, link=link)
    found = inductance.slope(Wave(made, "u_d", half, 4.0), R, np.ones(3))
    assert pytest.approx(L, rel=1e-4) == found.L
    assert abs(found.link) > 1e-4 * L


def test_cycles_that_are_not_whole_are_refused() -> None:
    R, L, i_max = MOTORS[0]
    made = squared(R, L, i_max, "u_d", 4, 1.6, 0.6)
    torn = replace(made, cycle=np.roll(made.cycle, 1) & (np.arange(len(made)) > 200) | made.cycle)
    for bad in (torn, replace(made, cycle=np.zeros(len(made), bool))):
        with pytest.raises(Refused, match="8 PWM periods long"):
            inductance.slope(Wave(bad, "u_d", 4, 1.6), R, np.ones(3))


def test_a_current_that_does_not_answer_is_refused() -> None:
    rng = np.random.default_rng(12)
    R, L, i_max = MOTORS[0]
    made = squared(R, L, i_max, "u_d", 4, 1.6, 1e-6)
    for _ in range(10):
        noisy = seen_by(made, rng, 0.1)
        with pytest.raises(Refused, match="less than the noise"):
            inductance.slope(Wave(noisy, "u_d", 4, 1.6), R, np.ones(3))
