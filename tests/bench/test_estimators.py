"""Host and drive run the same observers: bit for bit, over chunk boundaries, faults, recordings and gaps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from collect import Bench, feed
from virtual_run import WatchedLink, simulated

from bench.errors import BenchError
from bench.record.reader import Run
from bench.replay.estimators import CHECKED, Estimators, HostObservers, all_for
from bench.signal.chunks import part
from protocol.signals import DRIVE_CHANNELS, AngleSource, Injection, Status
from protocol.streams import EdgeChunk, Gap, SampleChunk
from sim.observers.catalogue import CATALOGUE
from sim.observers.entry import DEFAULTS

pytestmark = pytest.mark.slow

ALL = tuple(f"+{name}" for name in CHECKED)
"""Also what is streamed on request only."""


NO_CUTS = np.array([], int)


def turned(bench: Bench) -> tuple[SampleChunk, EdgeChunk]:
    """What it streams while the drive turns."""
    bench.stream(ALL)
    bench.turn(50.0)
    bench.client.run_for(0.5)
    return bench.collector.all_samples(), bench.collector.all_edges()


def host_observers(bench: Bench, **parameters: float) -> HostObservers:
    """For what `bench` has streamed."""
    return HostObservers(bench.drive.parameters() | parameters, bench.collector.all_samples().config)


@pytest.mark.parametrize("where", [Injection.BACK_EMF, Injection.HALL])
def test_a_test_sine_and_false_pulses_are_recomputed_too(where: Injection) -> None:
    bench = Bench(WatchedLink(simulated(seed=3)))
    for name, value in (("inject", where), ("inject_amplitude", 0.1), ("inject_hz", 123.4)):
        bench.drive.set(name, value)
    bench.load.set("hall_glitch", 50.0)
    samples, edges = turned(bench)
    assert np.any(samples.raw["status"] & Status.INJECTION_SYNC)
    compared, differ = feed(host_observers(bench), samples, edges, NO_CUTS)
    assert compared > 5000
    assert differ == 0
    assert feed(host_observers(bench, inject=0.0), samples, edges, NO_CUTS)[1] > 1000


def test_a_turned_ring_with_rotated_and_inverted_wires_is_recomputed_too() -> None:
    ring = {"hall__offset_deg": 30.0, "wiring__hall_swap": 4, "wiring__hall_invert": 2}
    told = {"firmware__hall_swap_hat": 4, "firmware__hall_invert_hat": 2}
    bench = Bench(WatchedLink(simulated(seed=3, **ring, **told)))
    samples, edges = turned(bench)
    compared, differ = feed(host_observers(bench), samples, edges, NO_CUTS)
    assert compared > 5000
    assert differ == 0
    assert feed(host_observers(bench, hall_offset=0.0), samples, edges, NO_CUTS)[1] > 5000


def test_chunks_of_any_size_and_the_whole_recording_give_the_same_bits(drive_run: Path) -> None:
    recorded = Run(drive_run)
    info, samples, edges = recorded.info, recorded.samples, recorded.edges
    every = tuple(channel for channel in DRIVE_CHANNELS if channel.name in CHECKED)
    whole = HostObservers(info.parameters, replace(samples.config, channels=every))
    whole.edges(edges)
    expected, valid = whole.samples(samples)
    estimators = Estimators(tuple(CATALOGUE), info.parameters, samples.config)
    cuts = np.sort(np.random.default_rng(4).choice(len(samples), 200, replace=False))
    pieces, sent = [], 0
    for first, last in zip([0, *cuts], [*cuts, len(samples)], strict=True):
        piece = part(samples, first, last)
        due = int(np.searchsorted(edges.tick, piece.tick[-1], side="right")) if len(piece) else sent
        estimators.edges(part(edges, sent, due))
        sent = due
        if len(piece):
            pieces.append(estimators.samples(piece))
    assert valid.sum() > 30_000
    assert estimators.kernels.steps == len(samples)
    for name, entry in CATALOGUE.items():
        for what in ("theta", "omega"):
            bits = expected[f"{what}_{entry.short}"]
            found = np.concatenate([getattr(piece[name], what) for piece in pieces])
            assert np.array_equal(found[valid].view(np.int64), bits[valid].view(np.int64)), (name, what)


def test_the_catalogue_is_consistent() -> None:
    assert [name.upper() for name in CATALOGUE] == [source.name for source in AngleSource if source]
    assert [entry.short for entry in CATALOGUE.values()] == [source.short for source in AngleSource if source]
    assert len({entry.short for entry in CATALOGUE.values()}) == len(CATALOGUE)
    for name, entry in CATALOGUE.items():
        assert entry.name == name
        assert len(f"theta_{entry.short}_host") <= 16
        assert entry.source


def test_defaults_are_those_of_the_simulated_drive() -> None:
    parameters = Bench(WatchedLink(simulated())).drive.parameters()
    for name, value in DEFAULTS.items():
        assert value == pytest.approx(parameters[name], rel=1e-6), name
    motor = {name: parameters[name] for name in ("n_p", "omega_m_max", "R_s_hat", "L_s_hat", "psi_f_hat", "J_hat")}
    parameters |= {"inject_amplitude": 0.0, "inject_hz": 0.0}  # nothing is injected, whatever they are
    for entry in CATALOGUE.values():
        assert entry.make_params(16_000.0, motor) == entry.make_params(16_000.0, parameters), entry.name


def test_an_observer_that_lacks_a_parameter_names_it(drive_run: Path) -> None:
    with pytest.raises(BenchError, match="vector_tracking needs L_s_hat, psi_f_hat, which the drive does not have"):
        Estimators(["vt"], {"n_p": 6.0, "omega_m_max": 300.0, "R_s_hat": 0.1}, Run(drive_run).samples.config)


def test_observers_that_lack_a_parameter_are_left_out(drive_run: Path) -> None:
    motor = {"n_p": 6.0, "omega_m_max": 300.0, "R_s_hat": 0.1, "psi_f_hat": 0.01}
    whole = Run(drive_run).samples.config
    names, left_out, unfed = all_for(motor, whole)
    assert unfed == ()
    assert "average_speed" in names
    assert {"vector_tracking", "load_angle"}.isdisjoint(names)
    assert "load_angle: it needs L_s_hat" in left_out
    assert len(names) + len(left_out) == len(CATALOGUE)
    assert all_for(motor | {"L_s_hat": 1e-4, "J_hat": 1e-4}, whole) == (tuple(CATALOGUE), (), ())
    names, left_out, _ = all_for({}, whole)
    assert names == ()
    assert "average_speed: it needs n_p, omega_m_max" in left_out


def test_another_parameter_shows_as_a_difference() -> None:
    bench = Bench(WatchedLink(simulated()))
    parameters = bench.drive.parameters()
    samples, edges = turned(bench)
    for name in ("k_p_vt", "k_i_vt", "L_s_hat", "bw_omega_lpf"):
        compared, differ = feed(host_observers(bench, **{name: parameters[name] * 2}), samples, edges, NO_CUTS)
        assert compared > differ > 1000, name


def test_each_checked_channel_is_checked() -> None:
    bench = Bench(WatchedLink(simulated()))
    samples, edges = turned(bench)
    for name in CHECKED:
        raw = samples.raw.copy()
        raw[name][-7] += 1
        assert feed(host_observers(bench), replace(samples, raw=raw), edges, NO_CUTS)[1] == 1, name
    assert feed(host_observers(bench), samples, edges, NO_CUTS)[1] == 0


@pytest.mark.parametrize("kind", ["samples", "edges"])
def test_a_gap_makes_the_estimates_invalid_until_the_next_reset(kind: str) -> None:
    bench = Bench(WatchedLink(simulated()))
    bench.stream(ALL)
    for _ in range(2):
        bench.turn(50.0)
        bench.client.run_for(0.4)
        bench.drive.stop()
        bench.client.run_for(0.3)
    samples, edges = bench.collector.all_samples(), bench.collector.all_edges()
    resets = np.flatnonzero(samples.raw["status"] & Status.OBSERVERS_RESET)
    assert len(resets) == 2
    gap = int(resets[0]) + 3000
    assert gap + 1000 < resets[1]
    observers = host_observers(bench)
    before = part(samples, 0, gap)
    covered = int(np.searchsorted(edges.tick, before.tick[-1], side="right"))
    observers.edges(part(edges, 0, covered))
    assert observers.compare(before) == (gap - resets[0], 0)
    if kind == "samples":
        observers.edges(part(edges, covered, len(edges)))
        after = replace(part(samples, gap + 100, len(samples)), gaps=(Gap(0, 100, 5, False),))
    else:
        observers.edges(replace(part(edges, covered + 2, len(edges)), gaps=(Gap(0, 2, 1, False),)))
        after = part(samples, gap, len(samples))
    compared, differ = observers.compare(after)
    assert (compared, differ) == (len(samples) - resets[1], 0)


def test_a_gap_within_a_chunk_counts_from_its_position() -> None:
    bench = Bench(WatchedLink(simulated()))
    samples, edges = turned(bench)
    reset = int(np.flatnonzero(samples.raw["status"] & Status.OBSERVERS_RESET)[0])
    gap = reset + 2000
    keep = np.r_[0:gap, gap + 50 : len(samples)]
    parts = {name: getattr(samples, name)[keep] for name in ("index", "tick", "raw")}
    holed = replace(samples, gaps=(Gap(gap, 50, 3, False),), **parts)
    observers = host_observers(bench)
    observers.edges(edges)
    assert observers.compare(holed) == (gap - reset, 0)
    assert observers.compare(part(samples, len(samples) - 10, len(samples))) == (0, 0)


def test_a_loss_before_the_clock_starts_anew_is_forgotten(drive_run: Path) -> None:
    recorded = Run(drive_run)
    info, samples, edges = recorded.info, recorded.samples, recorded.edges
    assert len(edges) > 200
    last = int(np.searchsorted(samples.tick, edges.tick[100], side="right"))
    estimators = Estimators(["avg"], info.parameters, samples.config)
    estimators.edges(part(edges, 0, 50))
    estimators.edges(part(edges, 60, 101))
    estimators.edges(part(edges, 190, 200))  # lost before it, and not covered by any sample before the reboot
    estimators.samples(part(samples, 0, last))
    assert estimators.restarts["lost_edges"] == 1
    start = samples.tick[0]
    estimators.edges(replace(part(edges, 0, 101), tick=edges.tick[:101] - start))
    found = estimators.samples(replace(part(samples, 0, last), tick=samples.tick[:last] - start))
    assert len(found["average_speed"].theta) == last
    assert estimators.restarts["lost_edges"] == 2  # the second is the new clock's first edge, whose number goes back
