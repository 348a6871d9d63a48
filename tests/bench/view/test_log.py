"""What people read in the log, the lanes of the drive and the documents: visible, in order, whatever the text holds."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import synthetic
from synthetic import column

from bench.device.heard import Note
from bench.record.info import SummaryText
from bench.record.reader import Run
from bench.record.sink import RunSink
from bench.view import schema
from bench.view.log import identity_text
from protocol.descriptor import Channel
from protocol.host import HeartbeatReceived
from protocol.signals import Flag, RawType, Unit


def test_errors_stand_out_in_the_log_and_what_follows_does_not(tmp_path: Path) -> None:
    levels = ["INFO", "CRITICAL", "INFO", "ERROR", "DEBUG", "WARN", "INFO"]
    sink = RunSink(tmp_path / "a.run", synthetic.run_info(), wait=True)
    for tick, level in enumerate(levels):
        sink.take(Note(tick * synthetic.TICK_HZ, "OUTPUTS MAY STILL BE ON", level))
    sink.close()
    colours = [f"{row[0]:08x}" for _, row in column(tmp_path / "a.run", schema.NOTES, "TextLog:color")]
    assert len(colours) == len(levels)  # rerun keeps the last colour for a line that has none
    for level, colour in zip(levels, colours, strict=True):
        red, green, blue = (int(colour[k : k + 2], 16) for k in (0, 2, 4))
        assert (red > 200 and blue < 100) == (level in ("CRITICAL", "ERROR", "WARN"))
        assert (green < 100) == (level in ("CRITICAL", "ERROR"))
    assert [note.level for note in Run(tmp_path / "a.run").notes] == list(levels)


def test_text_that_is_no_unicode_ends_no_recording(tmp_path: Path) -> None:
    sink = RunSink(tmp_path / "a.run", synthetic.run_info(identity={"target": "/dev/\udcff"}), wait=True)
    sink.take(Note(0, "no /dev/\udcff\x1b[2J"))
    sink.take(SummaryText("of /dev/\udcff"))
    sink.close()
    run = Run(tmp_path / "a.run")
    assert (run.notes[0].text, run.summary) == ("no /dev/\udcff\x1b[2J", "of /dev/\udcff")
    (shown,) = column(tmp_path / "a.run", schema.NOTES, "TextLog:text")
    assert shown[1] == ["no /dev/\\udcff\\x1b[2J"]


def test_the_drives_lanes_are_those_that_it_can_fill(tmp_path: Path) -> None:
    for name, entity in (("status", "state-faults-angle-telemetry"), ("i_a", "state-faults-telemetry")):
        made = synthetic.SyntheticRun(0.3, config=synthetic.config(synthetic.named(name, "u_dc")))
        sink = RunSink(tmp_path / f"{name}.run", synthetic.run_info(channels=made.config.channels), wait=True)
        made.feed(sink)
        sink.close()
        words = [row for _, row in column(tmp_path / f"{name}.run", entity, "StateChange:state")]
        assert {len(row) for row in words} == {entity.count("-") + 1}
        assert "unknown" not in words[-1]


def test_a_heartbeat_from_before_the_first_sample_tears_no_lane(tmp_path: Path) -> None:
    made = synthetic.SyntheticRun(0.3)
    sink = RunSink(tmp_path / "a.run", synthetic.run_info(), wait=True)
    sink.take(HeartbeatReceived(1, synthetic.heartbeat(int(made.tick[0]) - synthetic.TICK_HZ)))
    for chunk in made.sample_chunks():
        sink.take(chunk)
    sink.close()
    rows = column(tmp_path / "a.run", schema.DRIVE, "StateChange:state")
    first_sample = int(made.tick[0]) * 1_000_000_000 // synthetic.TICK_HZ
    assert rows[0][0] == first_sample - 1_000_000_000
    assert all("unknown" not in words for t, words in rows if t > first_sample)


def test_values_that_are_not_finite_are_recorded_without_a_word(tmp_path: Path) -> None:
    flags = Flag.CHANNEL
    channels = (
        Channel(1, "theta", Unit.RAD, RawType.F32, 1.0, flags | Flag.REFERENCE),
        Channel(2, "estimate", Unit.RAD, RawType.F32, 1e30, flags | Flag.ESTIMATE),
        Channel(3, "w", Unit.RAD_PER_S, RawType.F32, 1.0, flags | Flag.ESTIMATE),
        Channel(4, "status", Unit.NONE, RawType.F32, 1.0, flags),
    )
    made = synthetic.SyntheticRun(0.2, config=synthetic.config(channels))
    for k, channel in enumerate(channels):
        made.raw[channel.name] = np.roll(np.resize([1.0, np.inf, -np.inf, np.nan, 3e38], len(made.index)), k)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        path = synthetic.recorded(tmp_path / "a.run", *made.sample_chunks(), channels=channels)
    shown = column(path, schema.FAST, schema.value_component("theta"))
    np.testing.assert_array_equal([row[0] for _, row in shown], made.raw["theta"])


def test_what_runs_is_told_in_cells_that_hold_plain_text() -> None:
    identity = {"name": "a|b\n`c`", "features": ["edges", "commit"], "build": ""}
    document = identity_text(synthetic.run_info(identity=identity))
    assert r"| name | a\|b\\n\`c\` |" in document
    assert "| features | edges, commit |\n| build | not told |" in document
