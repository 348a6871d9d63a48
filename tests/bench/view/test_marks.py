"""Marks of an acceptance run: read back as they were set, one lane shows the worst of them, the log has them all."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
import synthetic
from rerun.chunk import RrdReader

from bench.accept.results import Verdict
from bench.record.info import Mark
from bench.record.reader import Run
from bench.record.sink import RunSink
from bench.view import schema
from bench.view.plots import plots
from bench.view.scope import scopes
from tests.tools import needs
from tests.viewers import headless

VIEW = "Marks"
MARKED = (  # seconds after the run's start
    ("start.settling", 0.25, 0.75, Verdict.PASS),
    ("step.overshoot", 1.0, 2.0, Verdict.FAIL),
    ("step.rise", 1.0, 1.5, Verdict.PASS),
    ("step.thd", 1.75, 2.25, Verdict.FAIL),
    ("step.mean", 1.75, 2.0, Verdict.FAIL),
    ("hold.ripple", 2.0, 2.5, Verdict.INVALID),
)
LANE = [
    (0.25, "PASS start.settling"),
    (0.75, "unmarked"),
    (1.0, "FAIL step.overshoot"),
    (1.5, "FAIL step.overshoot"),
    (1.75, "FAIL step.overshoot, step.thd and 1 more"),
    (2.0, "FAIL step.thd"),
    (2.25, "INVALID hold.ripple"),
    (2.5, "unmarked"),
]


def tick(seconds: float) -> int:
    return round((100 + seconds) * synthetic.TICK_HZ)


@pytest.fixture(scope="module")
def marked(made: synthetic.SyntheticRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("marks") / "run.run"
    sink = RunSink(path, synthetic.run_info(), wait=True)
    made.feed(sink)
    for name, first, last, verdict in MARKED:
        sink.take(Mark(name, tick(first), tick(last), verdict))
    sink.close()
    return path


def test_a_run_without_marks_has_none_and_no_lane(recording: Path) -> None:
    assert Run(recording).marks == ()
    assert RrdReader(synthetic.viewed(recording)).stream().filter(content=f"/{schema.ACCEPTANCE}").to_chunks() == []


def test_the_log_tells_every_mark_where_it_begins(marked: Path) -> None:
    notes = {text: at for at, (text,) in synthetic.column(marked, schema.NOTES, "TextLog:text")}
    assert notes["FAIL step.overshoot, 101.000 … 102.000 s"] == 101_000_000_000
    assert (notes["INVALID hold.ripple, 102.000 … 102.500 s"], len(notes)) == (102_000_000_000, len(MARKED) + 1)


def test_the_lane_shows_the_worst_of_marks_that_overlap(marked: Path) -> None:
    lane = synthetic.column(marked, schema.ACCEPTANCE, "StateChange:state")
    assert [(at / 1e9 - 100, words[0]) for at, words in lane if words] == LANE
    coloured: dict[str, int] = {}
    for chunk in RrdReader(synthetic.viewed(marked)).stream().filter(content=f"/{schema.ACCEPTANCE}").to_chunks():
        batch = chunk.to_record_batch()
        if "StateConfiguration:colors" in batch.schema.names:
            values, colours = (
                batch.column(f"StateConfiguration:{name}").flatten().to_pylist() for name in ("values", "colors")
            )
            coloured |= dict(zip(values, colours, strict=True))
    assert set(coloured) == {words for _, words in LANE}
    reds = {words for words, colour in coloured.items() if colour >> 24 > 200 and colour >> 16 & 0xFF < 100}
    assert reds == {words for words in coloured if words.startswith("FAIL")}


def test_marks_may_be_set_from_several_threads_while_samples_come(tmp_path: Path, made: synthetic.SyntheticRun) -> None:
    sink = RunSink(tmp_path / "a.run", synthetic.run_info(), wait=True)

    def mark(n: int) -> None:
        for k in range(50):
            sink.take(Mark(f"{n}.{k}", tick(0), tick(1), Verdict.PASS))

    setters = [threading.Thread(target=mark, args=(n,)) for n in range(4)]
    for setter in setters:
        setter.start()
    made.feed(sink)
    for setter in setters:
        setter.join()
    sink.close()
    run = Run(tmp_path / "a.run")
    assert {mark.name for mark in run.marks} == {f"{n}.{k}" for n in range(4) for k in range(50)}
    assert (len(run.marks), run.samples.raw.tobytes()) == (200, made.raw.tobytes())


def test_a_mark_that_ends_before_it_begins_is_refused(tmp_path: Path) -> None:
    sink = RunSink(tmp_path / "a.run", synthetic.run_info(), wait=True)
    with pytest.raises(ValueError, match="mark x: it ends at tick 3, before its first, 4"):
        sink.take(Mark("x", 4, 3, Verdict.FAIL))
    sink.close()
    assert Run(tmp_path / "a.run").marks == ()


@pytest.mark.slow
@needs("Vulkan driver")
def test_the_dashboard_has_the_lane_where_there_are_marks(marked: Path) -> None:
    with headless("--window-size", "1600x900") as viewer:
        viewer.client.open(str(synthetic.viewed(marked)))
        state = viewer.await_recording()
    assert [view.visible for view in state.views if view.name == VIEW] == [True]
    assert [(view.name, view.reports) for view in state.views if view.reports] == []
    assert len(state.views) == len(plots(synthetic.run_info())) + len(scopes(synthetic.run_info())) + 13
