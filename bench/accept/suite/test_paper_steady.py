"""The paper's steady-state experiments: Table I, Fig. 2, Fig. 6 and Fig. 8.

Angles are electrical. The map of Fig. 13 is in `test_paper_map`, the transients are in `test_paper_transients`.

Source: Kim et al. 2011, DOI 10.1109/TIE.2010.2098367; equation numbers are the paper's.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.accept import (
    RATED_CURRENT,
    RATED_SPEED,
    Capture,
    Drive,
    Limits,
    Ratings,
    called,
    energises,
    limit,
    limits,
    needs,
    yes,
)
from bench.accept.fixtures import Record
from bench.accept.plots.hall import draw_edge_offsets, draw_misaligned_hall
from bench.accept.plots.response import draw_bode
from bench.accept.plots.steady import draw_steady
from bench.accept.suite.common import (
    AVERAGE,
    PAPER,
    PROPOSED,
    SLOW,
    WORDS,
    Figure,
    Measure,
    held,
    measure_error,
    ratio,
    rpm,
    settle,
    speed_rpm,
    thd_of_current,
    turn_both_ways,
    turns_for_thd,
    whole_turns,
)
from bench.rig.loads import Load, NodeLoad
from bench.signal.capture import F64
from bench.signal.waveforms import FORWARD, REVERSE, hall_offset, sine_response
from bench.signal.waveforms.sectors import NUMERALS
from protocol.signals import Injection, Status

pytestmark = needs(*PAPER)

Complex = NDArray[np.complex128]


# -- Table I --------------------------------------------------------------------------------------------------------

TABLE_I = (-1.2, -3.0, 7.2, -3.3, 0.6, 5.6)  # deg, ideal - measured, of the edges that open the sectors I..VI
TOLERANCE = 1.0  # deg: pole pairs differ
HYSTERESIS = 3.0  # deg at most; the paper gives none
MET = {"forwards": FORWARD, "backwards": REVERSE}
MET_WORDS = {"forwards": "passed forward", "backwards": "passed in reverse"}


def _near(name: str, value: float, tolerance: float, about: str) -> Limits:
    return Limits(name, "deg", round(value - tolerance, 2), round(value + tolerance, 2), about)


@called("Table I: misplaced Hall sensors")
@limits(
    *(
        _near(f"delta_{sector}", delta, TOLERANCE, f"edge that opens sector {sector}")
        for sector, delta in zip(NUMERALS, TABLE_I, strict=True)
    ),
    *(
        _near(
            f"delta_{sector}_{way}",
            delta,
            TOLERANCE + HYSTERESIS / 2,
            f"edge that opens sector {sector}, {MET_WORDS[way]}",
        )
        for way in MET
        for sector, delta in zip(NUMERALS, TABLE_I, strict=True)
    ),
)
@limit("hysteresis", "deg", hi=HYSTERESIS, about="between an edge passed in reverse and forward, mean of the six")
@limit("edges_dropped", "", hi=0, about="edges between sectors that are not neighbours")
@yes("wiring_as_specified", about="Hall codes and encoder agree on the specified wiring")
@needs("observer:encoder", "hall-placement")
@energises(rated_speed=1 / 10, rated_current=1 / 2)
def test_table1_hall_edges(
    drive: Drive, rated: Ratings, load: NodeLoad, record: Record, measure: Measure, figure: Figure
) -> None:
    """Table I: sensors that the rig has placed as the paper's are found there by the encoder, in both directions.

    The drive runs on its encoder, so that misplaced sensors do not disturb the speed. The paper's figure is taken as
    the middle of both directions.
    """
    for s, placed in enumerate(TABLE_I):
        load.set(f"hall_delta_{s + 1}", math.radians(placed))
    turning, offsets = turn_both_ways(drive, rated, record, measure)
    delta = np.degrees(offsets.mean)
    for s, sector in enumerate(NUMERALS):
        measure(f"delta_{sector}", delta[s].mean(), *turning)
        for way, column in MET.items():
            measure(f"delta_{sector}_{way}", delta[s, column], turning[column])
    measure("hysteresis", (delta[:, REVERSE] - delta[:, FORWARD]).mean(), *turning)
    measure("edges_dropped", offsets.dropped, *turning)
    figure(
        "table1",
        "Hall edges by the encoder: on the circle, their offsets in both directions, and the paper's Table I",
        lambda: draw_edge_offsets(offsets, np.radians(TABLE_I), math.radians(TOLERANCE), hall_offset(drive.parameters)),
    )


# -- Fig. 2 ---------------------------------------------------------------------------------------------------------

PHI = {"a": -15.0, "b": 10.0, "c": 10.0}  # deg
PLACED = tuple(PHI[sensor] for sensor in "cbacba")
"""Offsets delta in deg of the edges that open the sectors I..VI: a sensor makes two edges, 180 deg apart, and phi moves
both alike. The codes 1, 3, 2, 6, 4, 5 of the sectors tell whose they are: c has I and IV, b II and V, a III and VI."""


class Expected(NamedTuple):
    """Errors of (1)-(2), actual minus estimated, in deg, of the edges that open the sectors (6,), forwards."""

    before: F64
    after: F64
    largest: float
    """Anywhere."""


def _expected(delta: F64) -> Expected:
    """Errors with edges offset by `delta` (6,) deg, at a steady speed.

    From edge to edge sector s is w_s = 60 + delta_s - delta_s+1 wide, which (1) takes for 60. So the estimate starts in
    sector s at its ideal edge, runs at 60 / w_s-1 times the actual speed, and has come 60 w_s / w_s-1 far, but 60 at
    most, when the edge comes that opens sector s+1. There it jumps to the ideal edge, by

        60 max(0, 1 - w_s / w_s-1).

    Just after an edge the error is -delta; just before, it is larger by the jump. In a sector that is wider than the
    one before, the estimate waits at the ideal edge, from an error of w_s-1 - 60 - delta_s on.
    """
    width = 60.0 + delta - np.roll(delta, -1)
    previous = np.roll(width, 1)
    before = np.roll(60.0 * np.maximum(0.0, 1.0 - width / previous), 1) - delta
    waits = (previous - 60.0 - delta)[width > previous]
    return Expected(before, -delta, float(np.abs(np.concatenate([before, delta, waits])).max()))


EXPECTED = _expected(np.array(PLACED))


@called("Fig. 2: average speed with misplaced Hall sensors")
@limits(
    *(
        _near(f"jump_{sector}", jump, 4.0, f"of the estimate where sector {sector} opens")
        for sector, jump in zip(NUMERALS, EXPECTED.before - EXPECTED.after, strict=True)
    ),
    *(
        _near(f"error_after_{sector}", error, 2.0, "error where the jump ends")
        for sector, error in zip(NUMERALS, EXPECTED.after, strict=True)
    ),
)
@limit("error_max", "deg", hi=EXPECTED.largest + 6, about="average speed, anywhere")
@needs("observer:encoder", "hall-placement")
@energises(rated_speed=1 / 15, rated_current=1 / 2)
def test_fig02_misaligned_hall(
    drive: Drive, rated: Ratings, load: NodeLoad, record: Record, measure: Measure, figure: Figure
) -> None:
    """Fig. 2: the average-speed estimate with Hall sensors misplaced by phi = -15, 10 and 10 deg.

    The drive runs on its encoder. The jumps of the estimate are compared with those that (1)-(2) imply.
    """
    for s, delta in enumerate(PLACED):
        load.set(f"hall_delta_{s + 1}", math.radians(delta))
    speed = rated.speed_rpm / 15
    drive.start("encoder")
    drive.speed(rpm=speed)
    assert settle(record, speed), f"{speed:g} r/min were not reached"
    steady = record(2.0 * 60.0 / speed)
    before, after = _errors_at_edges(steady)
    for s, sector in enumerate(NUMERALS):
        measure(f"jump_{sector}", before[s] - after[s], steady)
        measure(f"error_after_{sector}", after[s], steady)
    measure("error_max", np.degrees(np.abs(steady.position_error("theta_avg")).max()), steady)
    figure(
        "fig02",
        "Outputs of misplaced Hall sensors (phi = -15, 10, 10 deg), actual and average-speed position, and the error",
        lambda: draw_misaligned_hall(steady),
    )


def _errors_at_edges(capture: Capture) -> tuple[F64, F64]:
    """Mean errors (6,) of the average-speed estimate in deg, just before and after the edge that opens each sector.

    Two samples on either side are drawn on in line to the edge. NaN for an edge that was not seen.
    """
    error = np.unwrap(capture.position_error("theta_avg"))
    t, edges = capture.t, capture.edges.tick / capture.tick_hz
    since = capture.theta_at_edges() - hall_offset(capture.parameters)
    sector = np.round(since / (math.pi / 3)).astype(int) % 6
    right = np.searchsorted(t, edges, "left")
    inner = (right >= 2) & (right <= len(t) - 2)
    right, edges, sector = right[inner], edges[inner], sector[inner]
    sides = []
    for first in (right - 2, right):
        slope = (error[first + 1] - error[first]) / (t[first + 1] - t[first])
        at_edge = np.degrees(error[first] + slope * (edges - t[first]))
        sides.append(np.array([at_edge[sector == s].mean() if (sector == s).any() else math.nan for s in range(6)]))
    return sides[0], sides[1]


# -- Fig. 6 ---------------------------------------------------------------------------------------------------------

SHARES = np.array([0.025, 0.045, 0.085, 0.155, 0.28, 0.65, 1.2, 1.8, 2.75, 4.8])  # of k_p, as an angular frequency
HIGHEST = 1000.0  # Hz: (11) is continuous, and the observer is sampled
APART = 0.3  # of the turns a second, from whose multiples an injected sine keeps at least
ANSWER = math.radians(2.0)  # amplitude of the answer that is aimed at
LARGEST = 0.5  # rad, of the injected sine
SETTLING = 0.2  # s, until the observer has forgotten a change
HARMONICS = 12  # of the electrical frequency, fitted along: the Hall sensors disturb at each of them
NEAR = 4  # of the turns a second, fitted along too: so many of the lowest, and to either side of the sine
BEFORE = 0.025  # s from the start of a stretch, in which the sine before may still end
TURNS_SEEN = 6  # mechanical, which tell those from the sine


def _low_pass(f: F64, k_p: float, k_i: float) -> Complex:
    """(11) from theta* to the estimate, at `f` (n,) Hz."""
    s = 2j * math.pi * f
    return np.asarray((k_p * s + k_i) / (s * s + k_p * s + k_i))


def _high_pass(f: F64, k_p: float, k_i: float) -> Complex:
    """(11) from theta_h to the estimate, at `f` (n,) Hz."""
    return 1.0 - _low_pass(f, k_p, k_i)


def _frequencies(k_p: float, f_m: float) -> F64:
    """Where the response is measured, Hz, (n,): away from multiples of `f_m`, at which sensors and motor disturb."""
    f = np.minimum(SHARES * k_p / math.tau, HIGHEST * np.linspace(0.8, 1.0, len(SHARES)))
    k = np.maximum(np.round(f / f_m), 1.0)
    return np.where(np.abs(f - k * f_m) < APART * f_m, (k + np.where(f < k * f_m, -APART, APART)) * f_m, f)


@called("Fig. 6: frequency response")
@limit("low_pass_gain_off", "dB", hi=2.5, about="from theta*: largest deviation of the gain from (11)")
@limit("low_pass_phase_off", "deg", hi=8.0, about="from theta*: largest deviation of the phase from (11)")
@limit("high_pass_gain_off", "dB", hi=2.5, about="from theta_h: largest deviation of the gain from (11)", chance=True)
@limit(
    "high_pass_phase_off", "deg", hi=8.0, about="from theta_h: largest deviation of the phase from (11)", chance=True
)
@limit("k_p", "1/s", about="of (9) by the responses")
@limit("k_i", "1/s²", about="of (9) by the responses")
@limit(
    "k_p_off",
    "%",
    lo=-15,
    hi=15,
    about="from the drive's parameter; sampling alone adds 4 %",
    tells="observer gain k_p",
)
@limit("k_i_off", "%", lo=-40, hi=40, about="from the drive's parameter", tells="observer gain k_i")
@needs("observer:encoder", "rate:16000", "parameter:inject", "parameter:k_p_vt", "parameter:k_i_vt")
@energises(rated_speed=1 / 3, rated_current=1 / 2)
def test_fig06_frequency_response(
    drive: Drive, rated: Ratings, record: Record, measure: Measure, figure: Figure
) -> None:
    """Fig. 6: the observer answers a sine on theta* as a low-pass and one on theta_h as a high-pass, by (11).

    The sine is injected inside the drive while it turns at a third of its speed on its encoder, without load.
    """
    gains = drive.parameters["k_p_vt"], drive.parameters["k_i_vt"]
    speed = rated.speed_rpm / 3
    frequencies = _frequencies(gains[0], speed / 60.0)
    drive.start("encoder")
    drive.speed(rpm=speed)
    assert settle(record, speed), f"{speed:g} r/min were not reached"
    answers = {"low_pass": (Injection.BACK_EMF, _low_pass), "high_pass": (Injection.HALL, _high_pass)}
    expected = {name: law(frequencies, *gains) for name, (_, law) in answers.items()}
    runs = {
        name: [
            _injected(drive, record, where, f, min(ANSWER / abs(gain), LARGEST), speed / 60.0)
            for f, gain in zip(frequencies, expected[name], strict=True)
        ]
        for name, (where, _) in answers.items()
    }
    drive.stop()  # what follows takes longer than the watchdog
    measured = {name: np.array([_answer(capture) for capture in captures]) for name, captures in runs.items()}
    for name, captures in runs.items():
        off = measured[name] / expected[name]
        measure(f"{name}_gain_off", np.abs(20.0 * np.log10(np.abs(off))).max(), *captures)
        measure(f"{name}_phase_off", np.degrees(np.abs(np.angle(off))).max(), *captures)
    captures = [*runs["low_pass"], *runs["high_pass"]]
    k_p, k_i = _fitted_gains(frequencies, measured["low_pass"], measured["high_pass"], gains)
    measure("k_p", k_p, *captures)
    measure("k_i", k_i, *captures)
    measure("k_p_off", 100.0 * (k_p / gains[0] - 1.0), *captures)
    measure("k_i_off", 100.0 * (k_i / gains[1] - 1.0), *captures)
    figure(
        "fig06",
        "Frequency response of the observer, (11) and measured: low-pass from θ*, high-pass from θ_h; "
        f"k_p = {gains[0]:.0f} 1/s, k_i = {gains[1]:.0f} 1/s²",
        lambda: draw_bode(
            frequencies,
            {"low-pass": measured["low_pass"], "high-pass": measured["high_pass"]},
            {"low-pass": lambda f: _low_pass(f, *gains), "high-pass": lambda f: _high_pass(f, *gains)},
        ),
    )


def _injected(drive: Drive, record: Record, where: Injection, f: float, amplitude: float, f_m: float) -> Capture:
    """From before the sine begins until five periods of it, and enough turns, after the observer has settled."""
    drive.set("inject_hz", f)
    drive.set("inject_amplitude", amplitude)
    answer = SETTLING + max(5.0 / f, TURNS_SEEN / f_m)
    with record.stretch(2.0 * BEFORE + answer) as stretch:
        record.wait(2.0 * BEFORE)
        drive.set("inject", where)
        record.wait(answer)
    drive.set("inject", Injection.OFF)
    return stretch.capture


def _answer(capture: Capture) -> complex:
    """Gain from the injected sine to the estimate. NaN if there was none, or if it is undefined."""
    turns = capture.t[np.flatnonzero(capture["status"].astype(int) & Status.INJECTION_SYNC)]
    turns = turns[turns > capture.t[0] + BEFORE]
    if not len(turns):
        return complex(math.nan, math.nan)
    f = capture.parameters["inject_hz"]
    first = turns - np.arange(len(turns)) / f  # phase 0, by each turn: up to a sample late
    start = float(first.min())
    steady = capture.between(start + SETTLING, capture.span[1])
    t, answer = steady.t, np.unwrap(-steady.position_error("theta_vt"))
    n_p = int(capture.parameters["n_p"])
    f_m = float(steady["omega_enc"].mean()) / math.tau / n_p
    lines = {
        *range(n_p, HARMONICS * n_p + 1, n_p),
        *range(1, NEAR),
        *range(max(1, round(f / f_m) - NEAR), round(f / f_m) + NEAR),
    }
    ripple = [k * f_m for k in sorted(lines) if abs(k * f_m - f) * (t[-1] - t[0]) > 1.5]
    try:
        gain = sine_response(t, answer, f, math.tau * f * (t - start), also=ripple)
    except ValueError:
        return complex(math.nan, math.nan)
    return gain / capture.parameters["inject_amplitude"]


def _fitted_gains(f: F64, low: Complex, high: Complex, guess: tuple[float, float]) -> tuple[float, float]:
    """k_p and k_i with which (11) comes nearest to the responses (n,) measured at `f` (n,) Hz. NaN where one is NaN.

    (11) is linear in them once multiplied by its denominator, whose effect on the weights is divided out again with the
    last result, three times over (Sanathanan and Koerner 1963, DOI 10.1109/TAC.1963.1105517).
    """
    s = np.tile(2j * math.pi * f, 2)
    gain = np.concatenate([low, 1.0 - high])  # (11): the two add up to 1
    if not np.isfinite(gain).all():
        return math.nan, math.nan
    k_p, k_i = guess
    for _ in range(3):
        weight = 1.0 / np.abs(s * s + k_p * s + k_i)
        rows = np.stack([(1.0 - gain) * s * weight, (1.0 - gain) * weight], axis=1)
        wanted = gain * s * s * weight
        k_p, k_i = np.linalg.lstsq(
            np.concatenate([rows.real, rows.imag]), np.concatenate([wanted.real, wanted.imag]), rcond=None
        )[0]
    return float(k_p), float(k_i)


# -- Fig. 8 ---------------------------------------------------------------------------------------------------------


LOW, LOAD = 1 / 60, 1 / 2  # of the rated speed and current
GOOD = 8.0  # deg std: where sensors are placed as well as that, dead time can leave the proposed observer as much
ENOUGH = 1.5  # times the speed at which the drive begins to look at the back-EMF


@called("Fig. 8: steady state at low speed")
@limit("error_std_average", "deg", about="position error, average speed in the control loop", chance=True)
@limit("error_max_average", "deg", about="largest position error, average speed in the control loop", chance=True)
@limit("error_std_proposed", "deg", hi=25.0, about="position error, proposed observer in the control loop")
@limit("error_max_proposed", "deg", hi=75.0, about="largest position error, proposed observer in the control loop")
@limit(
    "error_ratio",
    hi=0.96,
    about=f"std, proposed to average speed; below {GOOD:g} deg the latter counts as that",
    chance=True,
)
@limit("thd_average", "%", about="THD of i_a, (20), average speed", chance=True)
@limit("thd_proposed", "%", hi=40.0, about="THD of i_a, (20), proposed observer")
@limit("i_q_average", "A", about="mean q current for half the rated torque and friction, average speed", chance=True)
@limit("i_q_proposed", "A", lo=0.45, hi=0.75, of=RATED_CURRENT, about="mean q current, proposed observer")
@limit("speed_average", "%", about="mean of the speed, of the setpoint, average speed in the control loop", chance=True)
@limits(held("speed_proposed", 20, "mean, proposed observer in the control loop"))
@limit("ripple_average", "r/min", about="standard deviation of the speed, average speed in control", chance=True)
@limit("ripple_proposed", "r/min", hi=0.03, of=RATED_SPEED, about="standard deviation of the speed, proposed observer")
@needs("load", "parameter:psi_f_hat")
@energises(rated_speed=SLOW, rated_current=1)
def test_fig08_steady(
    drive: Drive, rated: Ratings, load: Load, record: Record, measure: Measure, figure: Figure
) -> None:
    """Fig. 8: a 60th of the rated speed and half the load, with the average-speed approach and the proposed one.

    Faster where there is no back-EMF to look at yet, by the drive's parameter `omega_on`. What the dead time leaves
    after compensation can be as large as the back-EMF here, and decides how good an angle is; how badly the average
    speed does is for information. It finds one of two rhythms, and one good drive in thirty the worse.
    """
    speed = speed_rpm(drive, rated, LOW, ENOUGH)
    drive.start(PROPOSED)
    drive.speed(rpm=speed)
    load.torque(drive.torque_constant * LOAD * rated.current)
    steady = {}
    for observer in (PROPOSED, AVERAGE):
        drive.observe(observer)
        settle(record, speed, within=0.1)
        steady[observer] = whole_turns(record(1.5 * turns_for_thd(drive, speed)))
    drive.stop()  # what follows takes longer than the watchdog
    std = {}
    for observer, capture in steady.items():
        words = WORDS[observer]
        std[observer] = measure_error(measure, capture, observer, f"{{}}_{words}", mean=False)
        measure(f"thd_{words}", thd_of_current(capture), capture)
        measure(f"i_q_{words}", capture["i_q"].mean(), capture)
        measure(f"speed_{words}", 100.0 * rpm(capture).mean() / speed, capture)
        measure(f"ripple_{words}", rpm(capture).std(), capture)
    measure("error_ratio", ratio(std[PROPOSED], std[AVERAGE], GOOD), *steady.values())
    figure(
        "fig08",
        f"Phase current and rotor position in steady state at {speed:g} r/min and {LOAD * rated.current:g} A: "
        "(a) average speed, (b) proposed",
        lambda: draw_steady(steady[AVERAGE], steady[PROPOSED], 0.5),
    )
