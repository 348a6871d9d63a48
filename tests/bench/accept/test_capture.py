"""What makes a stretch of data unfit to measure from: real samples of a turning drive, tampered with."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from accepting import SpoiltLink
from virtual_run import simulated

from bench.accept.measuring import Running
from bench.accept.results import Verdict
from bench.errors import BenchError
from bench.rig.rig import Plan, Rig
from bench.signal.capture import Capture
from bench.signal.chunks import between
from bench.signal.limits import Limits
from protocol.signals import Flag
from sim.config.params import load_params

RATE, TICK_HZ, PERIOD = 16_000, 20_000_000, 1250


@pytest.fixture(scope="module")
def clean() -> Capture:
    """0.2 s at 500 r/min."""
    link = SpoiltLink(simulated())
    with Rig(Plan(link.open, "virtual")).prepare() as rig:  # type: ignore[arg-type]
        rig.drive.start("vector-tracking")
        rig.drive.speed(rpm=500)
        rig.wait(0.6)
        return rig.record(0.2)


def tampered(capture: Capture, channel: str, at: int | slice, value: int = np.iinfo(np.int16).max) -> Capture:
    raw = capture.samples.raw.copy()
    raw[channel][at] = value
    return replace(capture, samples=replace(capture.samples, raw=raw))


def judged(capture: Capture) -> tuple[Verdict, str]:
    running = Running("t", [Limits("x", hi=1.0)])
    running.measure("x", 0.5, capture)
    (measurement,) = running.measurements
    assert measurement.value == 0.5
    return measurement.verdict, measurement.why


def test_a_stretch_is_as_long_as_it_was_asked_for_and_whole(clean: Capture) -> None:
    assert len(clean) == pytest.approx(0.2 * RATE, abs=1)
    assert (np.diff(clean.samples.tick) == PERIOD).all()
    assert (clean.measured_rate, clean.span[1] - clean.span[0]) == (
        pytest.approx(RATE),
        pytest.approx(0.2, abs=2 / RATE),
    )
    assert len(clean.edges) == pytest.approx(0.2 * 500 / 60 * 36, abs=2)  # six pole pairs
    ticks = clean.edges.tick
    assert ((ticks >= clean.samples.tick[0] - PERIOD) & (ticks <= clean.samples.tick[-1] + PERIOD)).all()
    assert (clean.flaws(), judged(clean)) == ((), (Verdict.PASS, ""))


def without_edges(capture: Capture, after: int) -> Capture:
    """The edges after a tick are lost, and no later one has told of a gap."""
    return replace(capture, edges=between(capture.edges, 0, after))


@pytest.mark.parametrize("lost", [1, 2, 30])
def test_edges_that_are_lost_at_the_end_are_a_flaw_of_what_contains_the_end(clean: Capture, lost: int) -> None:
    last = int(clean.edges.tick[-lost - 1])
    bad = without_edges(clean, last)
    why = f"Hall edges were lost: the code changed {lost} times after {last / TICK_HZ:.4f} s without one"
    assert judged(bad) == (Verdict.INVALID, why)
    assert judged(bad.only("i_a"))[0] is Verdict.INVALID
    assert judged(bad.ticks(int(bad.samples.tick[0]), last)) == (Verdict.PASS, "")
    assert judged(bad.ticks(last + PERIOD, int(bad.samples.tick[-1])))[0] is Verdict.INVALID
    none = judged(without_edges(clean, 0))[1]
    assert re.match(r"Hall edges were lost: the code changed (59|60|61) times after", none)


def test_wherever_a_capture_begins_and_ends_its_edges_are_whole(clean: Capture) -> None:
    """Cut before, in and after the sample in which an edge shows."""
    for edge in clean.edges.tick[2:-2:7]:
        for first in range(int(edge) - 3 * PERIOD, int(edge) + 4 * PERIOD, PERIOD // 2):
            assert clean.ticks(first, first + 20 * PERIOD).flaws() == ()
            assert clean.ticks(first - 20 * PERIOD, first).flaws() == ()


@pytest.mark.parametrize("value", [np.iinfo(np.int16).max, np.iinfo(np.int16).min])
def test_a_raw_value_at_its_end_is_saturated(clean: Capture, value: int) -> None:
    assert clean.samples.raw["i_b"].dtype == np.int16
    bad = tampered(clean, "i_b", slice(100, 103), value)
    why = f"i_b was at the end of its range in 3 samples, first at {clean.t[100]:.4f} s"
    assert (judged(bad), judged(bad.between(bad.t[103], bad.t[-1]))) == ((Verdict.INVALID, why), (Verdict.PASS, ""))
    assert judged(bad.between(bad.t[0], bad.t[99])) == (Verdict.PASS, "")


def test_a_phase_current_at_the_end_of_its_sensor_is_saturated_and_other_channels_are_not(clean: Capture) -> None:
    most = float(np.abs(clean["i_a"]).max())
    within = replace(clean, parameters={"i_range": 2 * max(np.abs(clean[c]).max() for c in ("i_a", "i_b", "i_c"))})
    assert within.flaws() == ()
    raw = clean.samples.raw["i_a"]
    other_end = tampered(clean, "i_a", 7, -raw[int(np.argmax(np.abs(raw)))])
    at_end = replace(other_end, parameters={"i_range": most})
    (flaw, *others) = (f for f in at_end.flaws() if f.startswith("i_a"))
    assert others == []
    assert f"first at {clean.t[7]:.4f} s" in flaw
    assert not any(f.startswith(("i_d", "i_q", "u_")) for f in at_end.flaws())


def test_who_looks_at_some_channels_does_not_mind_the_others(clean: Capture) -> None:
    bad = tampered(clean, "omega_avg", 100)
    assert judged(bad)[0] is Verdict.INVALID
    assert judged(bad.only("i_a", "hall")) == (Verdict.PASS, "")
    assert judged(bad.only("i_a", "omega_avg"))[0] is Verdict.INVALID
    part = bad.only("i_a").between(bad.t[50], bad.t[150])
    assert judged(part) == (Verdict.PASS, "")
    assert (part["omega_avg"] == bad["omega_avg"][50:151]).all()  # it is there all the same
    lost = (int(clean.samples.tick[10]), int(clean.samples.tick[20]), "9 samples were lost")
    assert judged(replace(bad, dropped=(lost,)).only("i_a")) == (Verdict.INVALID, "9 samples were lost")
    with pytest.raises(BenchError, match=r"channel 'i_aa' is not in the stream"):
        clean.only("i_aa")


def test_angles_that_wrap_and_codes_are_never_saturated(clean: Capture) -> None:
    wrapping = [channel.name for channel in clean.samples.config.channels if channel.flags & Flag.WRAPS]
    assert "theta_enc" in wrapping
    for name in (*wrapping, "hall"):
        assert tampered(clean, name, 5, np.iinfo(clean.samples.raw[name].dtype).max).flaws() == (), name


@pytest.mark.parametrize("jump_ms", [0.05, -0.04, 3600e3])
def test_a_jump_of_the_device_clock_is_a_flaw_where_it_is(clean: Capture, jump_ms: float) -> None:
    tick = clean.samples.tick.copy()
    tick[500:] += round(jump_ms * 1e-3 * TICK_HZ)
    bad = replace(clean, samples=replace(clean.samples, tick=tick))
    why = f"the clock jumped by {jump_ms:+.3f} ms at {clean.t[499]:.4f} s"
    assert judged(bad) == (Verdict.INVALID, why)
    assert judged(bad.ticks(int(tick[0]), int(tick[499]))) == (Verdict.PASS, "")


def test_samples_that_are_missing_are_no_jump_of_the_clock(clean: Capture) -> None:
    keep = np.r_[0:500, 538 : len(clean)]
    samples = clean.samples
    cut = replace(samples, index=samples.index[keep], tick=samples.tick[keep], raw=samples.raw[keep])
    assert replace(clean, samples=cut).flaws() == ()


def test_every_flaw_is_told_once_and_from_all_captures(clean: Capture) -> None:
    lost = (int(clean.samples.tick[10]), int(clean.samples.tick[20]), "9 samples were lost")
    first = replace(clean, dropped=(lost,))
    second = tampered(clean, "i_c", 0)
    running = Running("t", [Limits("x", hi=1.0)])
    assert not running.measure("x", 0.5, first, second, first)
    why = running.measurements[0].why
    assert why == f"9 samples were lost; i_c was at the end of its range in 1 samples, first at {clean.t[0]:.4f} s"


def test_what_is_not_there_is_named(clean: Capture) -> None:
    assert "i_a" in clean
    assert "i_z" not in clean
    with pytest.raises(BenchError, match=r"channel 'i_z' is not in the stream; it has .*i_a"):
        clean["i_z"]
    with pytest.raises(BenchError, match=r"no sample between 0\.0000 s and 0\.1000 s"):
        clean.between(0.0, 0.1)


def test_the_angle_at_edges_is_that_of_the_encoder_latched_with_them(clean: Capture) -> None:
    """Each edge carries the encoder's count of its own moment: an independent word on the angle."""
    edges = clean.edges
    inside = (edges.tick > clean.samples.tick[0]) & (edges.tick < clean.samples.tick[-1])
    turn = 4 * load_params(None, {}).encoder.pulses_per_rev  # counts
    counts = np.diff(edges.encoder[inside].astype(np.int64)) % turn
    steps = np.diff(clean.theta_at_edges()[inside])
    assert np.abs(steps - counts * math.tau * 6 / turn).max() < 2 * math.tau * 6 / turn
