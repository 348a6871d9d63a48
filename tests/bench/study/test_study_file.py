"""A study's TOML: what it says is what is done, to the drives that it says; what it cannot say is refused by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import csv, parquet

from bench.errors import BenchError
from bench.study.run import check
from bench.study.study import Study, read_study
from sim.config.params import BenchParams, load_params

TEN_LINES = """
samples = 8
[vary]
"motor.R_s" = { normal = [1.0, 0.05], relative = true }
"hall.delta_deg" = { uniform = [-4, 4] }
[experiments.fast]
speed = 1000
observers = ["vector_tracking", "edge_kalman"]
limits = { "edge_kalman.rms" = { hi = 1.0 } }
"""


def written(folder: Path, text: str = TEN_LINES, name: str = "study.toml") -> Path:
    file = folder / name
    file.write_text(text, encoding="utf-8")
    return file


def drive_of(study: Study, row: int) -> BenchParams:
    return study.drive(row, study.inputs([row])[0].tolist())


def test_its_text_is_all_that_it_is(tmp_path: Path) -> None:
    study = read_study(written(tmp_path))
    again = Study.of(study.text)
    assert again.text == study.text
    assert np.array_equal(again.inputs(range(8)), study.inputs(range(8)))
    assert drive_of(again, 3) == drive_of(study, 3)


def test_rows_are_numbered_by_drive_repetition_and_design(tmp_path: Path) -> None:
    designs = '[designs.a]\n"firmware.observer" = 1\n[designs.b]\n"firmware.observer" = 2\n'
    study = read_study(written(tmp_path, "repetitions = 3\n" + TEN_LINES + designs))
    assert len(study) == 8 * 3 * 2
    assert [study.place(row) for row in (0, 1, 2, 6, 47)] == [(0, 0, 0), (0, 0, 1), (0, 1, 0), (1, 0, 0), (7, 2, 1)]
    assert np.array_equal(study.inputs([12]), study.inputs([17]))  # one drive
    assert study.noise(12) == study.noise(13) != study.noise(14)
    assert [drive_of(study, row).firmware.observer for row in (0, 1)] == [1, 2]


def test_the_firmware_still_takes_the_motor_for_the_nominal_one(tmp_path: Path) -> None:
    study, nominal = read_study(written(tmp_path)), load_params()
    for row in range(8):
        drive = drive_of(study, row)
        assert drive.motor.R_s != nominal.motor.R_s
        assert drive.firmware == nominal.firmware
        assert drive.mechanics == nominal.mechanics
        assert drive.replace(motor=nominal.motor, hall=nominal.hall) == nominal


def test_a_design_may_vary_a_figure_otherwise(tmp_path: Path) -> None:
    """As each firmware is told it; the drive is the same."""
    text = TEN_LINES.replace("[vary]", '[vary]\n"firmware.R_s_hat" = { follows = "motor.R_s", sd = 0.05 }')
    text += '[designs.rough]\n[designs.exact.vary]\n"firmware.R_s_hat" = { follows = "motor.R_s" }\n'
    study = read_study(written(tmp_path, text))
    assert "firmware.R_s_hat@exact" in study.variation.inputs
    rough, exact = ([drive_of(study, 2 * k + design) for k in range(8)] for design in (0, 1))
    assert [one.motor for one in rough] == [one.motor for one in exact]
    assert all(one.firmware.R_s_hat == one.motor.R_s for one in exact)
    assert all(one.firmware.R_s_hat != one.motor.R_s for one in rough)


def test_a_figure_that_is_varied_is_not_another_in_a_design(tmp_path: Path) -> None:
    """The design's own value would be lost, and a relative one be relative to another's."""
    text = TEN_LINES + '[designs.a]\n[designs.b]\n"motor.R_s" = 0.3\n'
    with pytest.raises(BenchError, match=r"motor.R_s is another in design 'b': write \[designs.b.vary\]"):
        read_study(written(tmp_path, text))
    text += '[designs.b.vary]\n"motor.R_s" = { normal = [1.0, 0.05], relative = true }\n'
    study = read_study(written(tmp_path, text))
    a, b = (np.mean([drive_of(study, row).motor.R_s for row in range(k, 16, 2)]) for k in (0, 1))
    assert [a, b] == pytest.approx([0.158, 0.3], rel=0.05)


def test_another_motor_is_the_nominal_one(tmp_path: Path) -> None:
    study = read_study(written(tmp_path, 'drive = "linix-45zwn24-40"\n' + TEN_LINES))
    assert drive_of(study, 0).motor.n_p == load_params(Path("sim/motors/linix-45zwn24-40.toml")).motor.n_p


@pytest.mark.parametrize("kind", ["parquet", "csv"])
def test_measured_drives_come_from_a_table(tmp_path: Path, kind: str) -> None:
    table = pa.table({"a": [1.0, 2.0, 3.0], "b": [0.1, 0.2, 0.3], "who": ["x", "y", "z"]})
    if kind == "parquet":
        parquet.write_table(table, tmp_path / "halls.parquet")
    else:
        csv.write_csv(table, tmp_path / "halls.csv")
    text = TEN_LINES.replace('"hall.delta_deg" =', '"motor.L_d" =').replace("[-4, 4]", "[1e-4, 2e-4]")
    text += (
        f'[tables.halls]\nfile = "halls.{kind}"\ncolumns = {{ "hall.delta_deg_2" = "a", "hall.offset_deg" = "b" }}\n'
    )
    study = read_study(written(tmp_path, text))
    seen = {(drive_of(study, row).hall.delta_deg[1], drive_of(study, row).hall.offset_deg) for row in range(8)}
    assert seen == {(1.0, 0.1), (2.0, 0.2), (3.0, 0.3)}
    with pytest.raises(BenchError, match="no column 'c'"):
        read_study(written(tmp_path, text.replace('"a"', '"c"')))
    with pytest.raises(BenchError, match="must have a number in each row"):
        read_study(written(tmp_path, text.replace('"a"', '"who"')))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("samples = 8", "sample = 8", r"unknown key sample in .*study.toml: did you mean samples"),
        ("samples = 8", "samples = 0", r"samples in .* must be at least 1, got 0"),
        ("samples = 8", 'samples = "8"', r"samples in .* must be a whole number, got '8'"),
        ("samples = 8", 'sampling = "sobel"', r"sampling in .* is 'sobel': did you mean sobol"),
        ("samples = 8", 'drive = "no_such"', r"drive in .* is 'no_such': no file and no motor"),
        ("samples = 8", 'set = { "motor.R_s" = -1 }', r"set in .*R_s must be > 0 ohm, got -1"),
        ("samples = 8", "repetitions = 1000000000", r"has 100000000000 rows, more than"),
        ("[vary]", '[vary]\n"motor.n_p" = { uniform = [4, 8] }', r"motor.n_p is a whole number: give the ones"),
        ("speed = 1000", "speed = [1, nan]", r"must be finite numbers"),
        ("speed = 1000", "sped = 1000", r"must have one of speed, accept, function"),
        ("speed = 1000", "speed = 1000\nseconds = 1\nsettle = 1", r"settle must be from 0 to less than seconds"),
        ("speed = 1000", 'speed = 1000\ncontrol = "vt"', r"no observer 'vt'"),
        ("speed = 1000", "speed = 1000\nload_a = 1", r"unknown 'load_a': did you mean load"),
        ('"edge_kalman"]', '"edge_kalmann"]', r"no observer 'edge_kalmann': did you mean edge_kalman"),
        ("{ hi = 1.0 }", "{ max = 1.0 }", r"must look like \{ lo = 0.0, hi = 1.0 \}"),
        ("{ hi = 1.0 }", "{ lo = 2, hi = 1 }", r"the lower limit 2 is above the upper one, 1"),
        ("[experiments.fast]", '[vary."motor.R_s_"]', r"R_s_"),
        ("[vary]", '[[correlated]]\nkeys = ["motor.R_s"]\nr = 0.5\n[vary]', r"correlated in .* must look like"),
    ],
)  # fmt: skip
def test_what_it_cannot_be_is_refused_by_name(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert old in TEN_LINES
    with pytest.raises(BenchError, match=words):
        read_study(written(tmp_path, TEN_LINES.replace(old, new)))


def test_no_experiment_no_file_and_no_toml(tmp_path: Path) -> None:
    with pytest.raises(BenchError, match=r"no experiment: write \[experiments.NAME\]"):
        read_study(written(tmp_path, "samples = 3"))
    with pytest.raises(BenchError, match="no study"):
        read_study(tmp_path / "none.toml")
    with pytest.raises(BenchError, match="cannot read"):
        read_study(written(tmp_path, "samples ="))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"edge_kalman.rms"', '"edge_kalman.sd"', r"measures no edge_kalman.sd; it measures .*edge_kalman.std"),
        ("speed = 1000", "speed = 9000", r"speed 9000 r/min is above the 31\d\d r/min of firmware.omega_m_max"),
        ("speed = 1000", "speed = 1000\nseconds = 1e-6", r"nothing is left to measure of 1e-06 s"),
        ("speed = 1000", "speed = 1000\nload = 50", r"load 50 N m is above load.tau_max"),
    ],
)
def test_what_the_nominal_drive_cannot_do_is_told_before_it_begins(
    tmp_path: Path, old: str, new: str, words: str
) -> None:
    with pytest.raises(BenchError, match=words):
        check(read_study(written(tmp_path, TEN_LINES.replace(old, new))))


def test_a_test_in_two_experiments_is_refused(tmp_path: Path) -> None:
    two = '[experiments.a]\naccept = "fig09"\n[experiments.b]\naccept = "fig09 or current_loop"\n'
    with pytest.raises(BenchError, match=r"two experiments have a test fig09_start_up"):
        check(read_study(written(tmp_path, two)))


def test_an_encoder_that_is_not_there_controls_nothing(tmp_path: Path) -> None:
    text = '[experiments.a]\nspeed = 500\ncontrol = "encoder"\n[set]\n"encoder.present" = 0\n"firmware.observer" = 2\n'
    with pytest.raises(BenchError, match=r"experiments.a: .*encoder.present = 0"):
        check(read_study(written(tmp_path, text)))


def test_a_function_is_named_by_file_and_name(tmp_path: Path) -> None:
    for given, words in (
        ("a.py", r'function must look like "FILE.py:NAME", got \'a.py\''),
        ("none.py:measure", r"cannot read .*none.py: No such file"),
        ("bad.py:measure", r"bad.py is no Python"),
    ):
        (tmp_path / "bad.py").write_text("def (")
        with pytest.raises(BenchError, match=words):
            read_study(written(tmp_path, f'[experiments.a]\nfunction = "{given}"\n'))
