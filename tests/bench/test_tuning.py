"""Tuning while the motor turns: keys and lines of `bench live --tune`, `rig.drive.tuning`; all marked, all put back."""

from __future__ import annotations

import os
import pty
import termios
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from processes import LIMIT
from virtual_run import RecordingScreen, WatchedLink, run, simulated

import bench
from bench.errors import BenchError, NodeError
from bench.live.tuner import Tuner
from bench.record.reader import Run
from bench.system import Keys
from protocol.messages import DriveState

UP, DOWN, RIGHT, LEFT = "\x1b[A", "\x1b[B", "\x1b[C", "\x1b[D"


class Typed:
    """What is done at moments in s since the drive was first RUNNING, in turn; `on_call` is for the link."""

    def __init__(self, moments: dict[float, Callable[[], object]]) -> None:
        self.device = simulated(seed=2)
        self.link = WatchedLink(self.device, self.on_call)
        self._moments = list(moments.items())
        self._began: int | None = None

    def on_call(self, _number: int) -> None:
        tick = self.device.bench.tick
        if self._began is None and self.device.drive.state == DriveState.RUNNING:
            self._began = tick
        while self._moments and self._began is not None and tick - self._began >= self._moments[0][0] * 20e6:
            self._moments.pop(0)[1]()


@contextmanager
def at_a_terminal(master: int, slave: int, keys: dict[float, str]) -> Iterator[WatchedLink]:
    """Standard input is `slave`; these keys are typed at `master`."""
    typed = Typed({at: partial(os.write, master, text.encode()) for at, text in keys.items()})
    with os.fdopen(slave, closefd=False) as stdin, patch("bench.live.run.sys.__stdin__", stdin):
        yield typed.link


@pytest.fixture
def terminal() -> Iterator[tuple[int, int]]:
    master, slave = pty.openpty()
    yield master, slave
    os.close(master)
    os.close(slave)


def marks(path: Path) -> list[str]:
    return [mark.name for mark in Run(path).marks if " -> " in mark.name]


def test_keys_choose_step_and_set_and_the_end_puts_back(terminal, tmp_path: Path) -> None:
    """The drive is asked what it had, and when: what is recorded are its own events."""
    keys = {
        0.2: f"{RIGHT}{RIGHT}", 0.3: f"{DOWN}4000", 0.4: "0\x7f5\n", 0.5: f"{UP}{LEFT}", 0.6: "nonsense\n", 0.7: "1e9\n"
    }  # fmt: skip
    modes = termios.tcgetattr(terminal[1])
    screen = RecordingScreen()
    with at_a_terminal(*terminal, keys) as link:
        app = link.device.drive.app
        before = dict(link.device.bench.parameters)
        ended = run(
            link, screen=screen, tune=("k_p_vt", "k_i_vt"), save=tmp_path / "a.run", duration=1.5, yes=True,
        )  # fmt: skip
    assert ended.exit_code == 0, ended.words
    k_p = [np.float32(1268.0)]
    for factor in (1.05, 1.05, 1 / 1.05):
        k_p.append(np.float32(float(k_p[-1]) * factor))
    assert marks(tmp_path / "a.run") == [
        f"k_p_vt {k_p[0]:.6g} -> {k_p[1]:.6g} 1/s", f"k_p_vt {k_p[1]:.6g} -> {k_p[2]:.6g} 1/s",
        "k_i_vt 54289 -> 40005", f"k_p_vt {k_p[2]:.6g} -> {k_p[3]:.6g} 1/s",
    ]  # fmt: skip
    recorded = Run(tmp_path / "a.run")
    changes = [c for c in recorded.changes if c.name in ("k_p_vt", "k_i_vt")]
    assert all(change.exact for change in changes)
    assert [m.first_tick for m in recorded.marks if " -> " in m.name] == [c.tick for c in changes[:4]]
    assert [np.float32(c.value) for c in changes if c.name == "k_p_vt"][:3] == k_p[1:]
    assert link.device.bench.parameters == before
    assert any("k_p_vt must be 0..100000, got 1e+09" in note for note in screen.notes)
    assert any("'eee' is not a finite number" in note or "is not a finite number" in note for note in screen.notes)
    told = next(note for note in screen.notes if note.startswith("tuned: "))
    assert "k_i_vt 54289 -> 40005" in told
    assert "bench param set " in told
    assert termios.tcgetattr(terminal[1]) == modes
    assert app.outputs_on is False


def test_lines_tune_where_there_is_no_terminal(tmp_path: Path) -> None:
    """And what is none, or not to be tuned, is told and changes nothing else."""
    reader, writer = os.pipe()
    made: list[Tuner] = []

    def tuner(*arguments: object) -> Tuner:
        made.append(Tuner(*arguments))  # type: ignore[arg-type]
        return made[0]

    def write() -> None:
        os.write(writer, b"k_p_vt=900\nn_p=3\nk_p_vt\n\nk_p_vt = 1e-3x\nk_p_vt = 850")
        os.close(writer)
        end = time.monotonic() + LIMIT
        while made[0]._lines.qsize() < 6:  # the lines are read by a thread
            assert time.monotonic() < end

    screen = RecordingScreen()
    link = Typed({0.2: write}).link
    with (
        os.fdopen(reader) as stdin,
        patch("bench.live.run.sys.__stdin__", stdin),
        patch("bench.live.run.Tuner", tuner),
    ):
        ended = run(link, screen=screen, tune=("k_p_vt",), save=tmp_path / "a.run", duration=0.6, yes=True)
    assert ended.exit_code == 0
    assert marks(tmp_path / "a.run") == ["k_p_vt 1268 -> 900 1/s", "k_p_vt 900 -> 850 1/s"]
    for words in ("n_p is not tuned", "'k_p_vt' is not name=value", "'1e-3x' is not a finite number"):
        assert any(words in note for note in screen.notes), words
    assert link.device.bench.parameters["k_p_vt"] == 1268.0


@pytest.mark.parametrize(("names", "words"), [
    (("k_p_tv",), "did you mean k_p_vt"),
    (("i_max",), "i_max is set with the outputs off only: it cannot be tuned"),
    (("k_p_vt", "i_range"), "i_range can only be read: it cannot be tuned"),
])  # fmt: skip
def test_what_cannot_be_tuned_is_said_before_anything_turns(names: tuple[str, ...], words: str) -> None:
    link = WatchedLink(simulated())
    with pytest.raises(NodeError, match=words):
        run(link, tune=names, yes=True)
    assert not {DriveState.ARMED, DriveState.RUNNING} & set(link.states)


def test_without_standard_input_it_says_so() -> None:
    link = WatchedLink(simulated())
    with patch("bench.live.run.sys.__stdin__", None), pytest.raises(BenchError, match="--tune needs standard input"):
        run(link, tune=("k_p_vt",), yes=True)
    assert not {DriveState.ARMED, DriveState.RUNNING} & set(link.states)


def test_a_drive_that_trips_meanwhile_ends_the_run_and_has_its_old_values(terminal, tmp_path: Path) -> None:
    with at_a_terminal(*terminal, {0.3: "20\n"}) as link:
        ended = run(link, tune=("u_dc_max", "k_p_vt"), duration=1.5, yes=True)
    assert ended.exit_code == 1
    assert "OVERVOLTAGE" in ended.words
    assert link.device.bench.parameters["u_dc_max"] == 32.0
    assert not link.device.drive.app.outputs_on


def test_arrows_that_come_in_pieces_are_arrows(terminal) -> None:
    master, slave = terminal
    keys = Keys(slave)
    keys.begin()
    seen = []
    for piece in ("a\x1b", "[", "Ab", "\x1b[1;5", "C", "\n\x1b[D"):
        os.write(master, piece.encode())
        seen.append(keys.typed())
    keys.end()
    assert seen == [["a"], [], [UP, "b"], [], ["\x1b[1;5C"], ["\n", LEFT]]


# -- from Python ----------------------------------------------------------------------------------------------------


def test_tuning_from_python_puts_back_whatever_happens() -> None:
    with bench.connect("sim", seed=3) as rig:
        rig.drive.speed(rpm=300)
        before = dict(rig.drive.parameters)
        with pytest.raises(ZeroDivisionError), rig.drive.tuning("k_i_vt", k_p_vt=900.0) as tuning:  # noqa: PT012
            assert dict(tuning) == {"k_i_vt": before["k_i_vt"], "k_p_vt": 900.0}
            assert tuning.before == {"k_i_vt": before["k_i_vt"], "k_p_vt": 1268.0}
            tuning["k_i_vt"] = 40000.0
            assert rig.drive.node.parameter("k_i_vt").value == 40000.0
            tuning.step("k_p_vt", -2)
            assert tuning["k_p_vt"] == pytest.approx(900.0 / 1.05**2, rel=1e-6)
            1 / 0  # noqa: B018
        for name in ("k_i_vt", "k_p_vt"):
            assert rig.drive.node.parameter(name).value == before[name]
        assert rig.drive.parameters == before
        with pytest.raises(BenchError, match="n_p is set with the outputs off only"), rig.drive.tuning("n_p"):
            pass


def test_steps_stay_in_range_and_leave_zero() -> None:
    steps_of = (
        ("edge_up_1", 1, 0.506e-3), ("edge_up_1", -100, 0.506e-3 / 1.05**100), ("k_pc", -1, -0.01),
        ("k_pc", -1, -0.0105), ("observer", 1, 3.0), ("observer", 100, 10.0), ("dead_time_comp", 200, 1.5),
    )  # fmt: skip
    with bench.connect("sim", seed=3) as rig, rig.drive.tuning(*(name for name, _, _ in steps_of)) as tuning:
        for name, steps, expected in steps_of:
            tuning.step(name, steps)
            assert tuning[name] == pytest.approx(expected, rel=1e-6), name


def test_a_capture_knows_what_was_changed_in_it() -> None:
    with bench.connect("sim", seed=3) as rig:
        rig.drive.speed(rpm=300)
        with rig.recording() as stretch:
            rig.wait(0.1)
            with rig.drive.tuning(k_p_vt=900.0):
                rig.wait(0.1)
            rig.wait(0.1)
        parameters = stretch.capture.parameters
        assert parameters["k_p_vt"] == 1268.0
        assert [(change.name, change.value) for change in parameters.changes] == [("k_p_vt", 900.0), ("k_p_vt", 1268.0)]
        a, b = (change.tick / 20e6 for change in parameters.changes)
        assert b - a == pytest.approx(0.1, abs=0.03)
