"""The bytes of a capture as samples and edges, and as a run: against the tables of SPEC, packed by `struct`."""

from __future__ import annotations

import struct
import tempfile
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from capture_rebuilt import FORMATS, buffer_of
from hypothesis import given, settings
from hypothesis import strategies as st

import bench
from bench.capture.decode import Captured, streams_of
from bench.capture.store import about, store
from bench.errors import NodeError
from bench.record.info import RunInfo
from protocol.messages import CaptureReply, CaptureState, CaptureTrigger, Fault
from protocol.signals import DRIVE_CHANNELS

TICK_HZ, PWM_HZ = 20_000_000, 16_000
PERIOD = TICK_HZ // PWM_HZ
WRAP = 1 << 32


def node(offers_edges: bool = True) -> SimpleNamespace:
    return SimpleNamespace(
        number=1, offers_edges=offers_edges, identity=SimpleNamespace(tick_hz=TICK_HZ, pwm_hz=PWM_HZ)
    )


@st.composite
def captures(draw: st.DrawFn) -> tuple[Captured, list[tuple], list[tuple[int, int, int, bool, int]]]:
    """A capture, its records as they were packed, and its edges with their whole ticks."""
    channels = tuple(draw(st.lists(st.sampled_from(DRIVE_CHANNELS), min_size=1, max_size=6, unique=True)))
    n, decimation = draw(st.integers(1, 40)), draw(st.sampled_from([1, 2, 7, 1000]))
    first = draw(st.integers(0, n - 1))
    period = draw(st.integers(n * decimation, 1 << 36))  # the trigger's, since boot
    late = draw(st.integers(0, PERIOD - 1))  # of tick 0 before period 0
    form = struct.Struct("<" + "".join(FORMATS[np.dtype(c.raw.dtype).name] for c in channels))
    random = np.random.default_rng(draw(st.integers(0, 1 << 30)))
    rows = [form.unpack(random.bytes(form.size)) for _ in range(n)]
    tick = period * PERIOD + late
    begin, end = tick - first * decimation * PERIOD, tick + (n - 1 - first) * decimation * PERIOD
    ticks = sorted(draw(st.lists(st.integers(begin, min(end, begin + WRAP - 1)), max_size=8)))
    edges = [(t, draw(st.integers(0, 7)), draw(st.integers(0, 7)), draw(st.booleans()), draw(st.integers(0, 65535)))
             for t in ticks]  # fmt: skip
    data = b"".join(form.pack(*row) for row in rows) + b"".join(
        struct.pack("<IBBH", t % WRAP, old | new << 3 | bad << 6, 0, count) for t, old, new, bad, count in edges
    )
    lost = draw(st.sampled_from([0, 0, 3]))
    status = CaptureReply(
        CaptureState.FROZEN, CaptureTrigger.RISES, 7, decimation, form.size, first, n - first, first, n, len(edges),
        lost, 90, len(data), 0, 4096, tick, period % WRAP, Fault(0), tuple(c.id for c in channels),
    )  # fmt: skip
    return Captured(status, 5, *streams_of(node(), status, channels), data), rows, edges


@given(captures())
def test_records_and_edges_have_their_values_times_and_numbers(made) -> None:
    captured, rows, edges = made
    status, samples, found = captured.status, captured.samples, captured.edges
    got = [tuple(samples.raw[name][k].tobytes() for name in samples.raw.dtype.names) for k in range(len(samples))]
    wanted = [tuple(np.array(v, samples.raw.dtype[i]).tobytes() for i, v in enumerate(row)) for row in rows]
    assert got == wanted
    period = (status.tick - status.tick % PERIOD) // PERIOD
    steps = [(k - status.first) * status.decimation for k in range(len(rows))]
    assert samples.index.tolist() == [period + step for step in steps]
    assert samples.tick.tolist() == [status.tick + step * PERIOD for step in steps]
    columns = found.tick, found.hall_old, found.hall_new, found.illegal, found.encoder
    assert list(zip(*(column.tolist() for column in columns), strict=True)) == edges
    assert found.index.tolist() == [status.first_edge + k for k in range(len(edges))]
    lost = captured.capture({}).dropped
    assert bool(lost) == bool(status.edges_lost) == bool(captured.capture({}).flaws() and lost)
    assert not found.gaps or found.gaps[0].lost_samples == status.edges_lost


@given(captures())
@settings(max_examples=8, deadline=None)
def test_a_run_holds_the_buffer_byte_for_byte_and_says_what_it_is(made) -> None:
    captured, _, edges = made
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "shot.run"
        info = RunInfo(TICK_HZ, PWM_HZ, (), {"n_p": 4.0}, {"name": "made"})
        store(captured, path, info, about(captured, "i_q rises 4", 0.25))
        run = bench.open(path)
        whole = run.read()
        assert buffer_of(whole.samples, whole.edges if edges else None) == captured.data
        assert whole.samples.tick.tolist() == captured.samples.tick.tolist()
        (mark,) = run.run.marks
        assert (mark.name, mark.first_tick) == ("trigger i_q rises 4", captured.status.tick)
        told = run.info.identity["capture"]
        assert (told["pre"], told["number"], told["edges_lost"]) == (0.25, 7, captured.status.edges_lost)
        assert [c.name for c in run.info.channels] == [c.name for c in captured.stream.channels]
        if captured.status.edges_lost and edges:
            assert any(f"{captured.status.edges_lost} Hall edges" in why for _, _, why in whole.dropped)


@given(captures(), st.integers(1, 3))
def test_a_drive_that_contradicts_itself_is_refused(made, more) -> None:
    captured = made[0]
    told = captured.status
    for wrong in ({"sample_bytes": told.sample_bytes + more}, {"size": told.size + more}):
        status = replace(told, **wrong)
        with pytest.raises(NodeError, match="make"):
            streams_of(node(), status, captured.stream.channels)
    empty = {"first": 0, "records": 0, "size": 8 * told.edges}
    for wrong in (empty, {"first": told.records}, {"decimation": 0}, {"after": 0}):
        with pytest.raises(NodeError, match="it has none of a trigger"):
            streams_of(node(), replace(told, **wrong), captured.stream.channels)


def test_a_drive_without_edges_makes_a_run_without_them(tmp_path) -> None:
    channels = (DRIVE_CHANNELS[0],)
    width = np.dtype(channels[0].raw.dtype).itemsize
    status = CaptureReply(
        CaptureState.FROZEN, CaptureTrigger.NOW, 1, 1, width, 0, 3, 0, 3, 0, 0, 0, 3 * width, 0, 64, 5 * PERIOD, 5,
        Fault(0), (channels[0].id,),
    )  # fmt: skip
    captured = Captured(status, 1, *streams_of(node(offers_edges=False), status, channels), bytes(3 * width))
    assert not len(captured.edges)
    store(captured, tmp_path / "a.run", RunInfo(TICK_HZ, PWM_HZ, ()), about(captured))
    assert len(bench.read(tmp_path / "a.run").samples) == 3
