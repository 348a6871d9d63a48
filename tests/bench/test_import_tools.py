"""Logs of other tools as they write them: presets, units, tables of other rates, and what a person answers.

Headers are those that the tools print: VESC Tool's as in public loggers for it, ODrive's and moteus' by the paths of
their properties, SimpleFOC's monitor without one.
"""

from __future__ import annotations

import json
import math
import os
import pty
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import asammdf
import imports_made as made
import numpy as np
import pandas as pd
import pytest
from processes import ENVIRONMENT

import bench
from bench.cli import main
from bench.importer.mapping import presets, read, to_toml

VESC = (
    "ms_today;input_voltage;temp_mos_max;temp_mos_1;temp_mos_2;temp_mos_3;temp_motor;current_motor;current_in;"
    "d_axis_current;q_axis_current;erpm;duty_cycle;amp_hours_used;amp_hours_charged;watt_hours_used;"
    "watt_hours_charged;tachometer;tachometer_abs;encoder_position;fault_code;vesc_id;d_axis_voltage;q_axis_voltage;"
)
T = np.arange(400) / 200.0
THETA_M = 2.0 * T + np.sin(T)
"""Mechanical rad."""
CODES = np.array([1, 3, 2, 6, 4, 5])


def codes(theta: np.ndarray, ring: float = math.pi / 6) -> np.ndarray:
    """Of ideal sensors 120 deg apart."""
    return CODES[np.floor(((theta - ring) % math.tau) / (math.pi / 3)).astype(int)]


def imported(file: Path, *options: str) -> bench.Capture:
    main(["import", str(file), "-o", str(file.with_suffix(".run")), "--overwrite", *options])
    return bench.read(file.with_suffix(".run"))


def test_a_log_of_vesc_tool(tmp_path: Path) -> None:
    names = VESC.rstrip(";").split(";")
    rng = np.random.default_rng(4)
    at = 43_200_000 + np.cumsum(rng.integers(95, 106, 300))
    rows = pd.DataFrame({name: rng.normal(0, 1, 300).round(3) for name in names})
    rows["ms_today"], rows["erpm"], rows["q_axis_current"] = at, 3000.0, 5.25
    file = tmp_path / "log.csv"
    file.write_text(VESC + "\n" + "".join(";".join(map(str, row)) + ";\n" for row in rows.to_numpy().tolist()))
    run = imported(file)
    assert run.t - run.t[0] == pytest.approx((at - at[0]) * 1e-3, abs=1e-9)
    assert run["i_q"] == pytest.approx(np.full(300, 5.25))
    assert run["u_dc"] == pytest.approx(rows["input_voltage"].to_numpy(), abs=1e-8)
    assert run["erpm"] == pytest.approx(np.full(300, 3000 * math.tau / 60))  # electrical rad/s
    assert run.units["erpm"] == "rad/s"
    assert "omega_enc" not in run.names  # a VESC's speed is no encoder's


def test_properties_of_an_odrive(tmp_path: Path) -> None:
    pd.DataFrame({
        "time": T,
        "axis0.encoder.pos_estimate": THETA_M / math.tau, "axis0.encoder.vel_estimate": np.gradient(THETA_M, T),
        "axis0.motor.current_control.Iq_measured": np.sin(T), "vbus_voltage": 24.0 + 0.1 * np.cos(T),
    }).to_csv(tmp_path / "odrive.csv", index=False)  # fmt: skip
    run = imported(tmp_path / "odrive.csv", "--pole-pairs", "7")
    error = np.angle(np.exp(1j * (run["theta_enc"] - 7 * THETA_M)))
    assert np.abs(error).max() < 1e-6
    assert run["i_q"] == pytest.approx(np.sin(T), abs=1e-8)
    assert run["u_dc"] == pytest.approx(24.0 + 0.1 * np.cos(T), abs=1e-6)
    assert run["omega_enc"] == pytest.approx(7 * math.tau * np.gradient(THETA_M, T), rel=1e-6)


def test_registers_of_a_moteus(tmp_path: Path) -> None:
    rows = zip(T.tolist(), (THETA_M / math.tau).tolist(), np.sin(T).tolist(), strict=True)
    told = [
        {
            "timestamp": t,
            "id": 1,
            "values": {"MODE": 10, "POSITION": p, "VELOCITY": 0.3, "Q_CURRENT": i, "VOLTAGE": 24.5},
        }
        for t, p, i in rows
    ]
    (tmp_path / "moteus.jsonl").write_text("".join(json.dumps(row) + "\n" for row in told))
    run = imported(tmp_path / "moteus.jsonl", "--pole-pairs", "7")
    assert np.abs(np.angle(np.exp(1j * (run["theta_enc"] - 7 * THETA_M)))).max() < 1e-6
    assert run["i_q"] == pytest.approx(np.sin(T), abs=1e-8)
    assert run["u_dc"] == pytest.approx(np.full(400, 24.5))


def test_what_simplefoc_prints(tmp_path: Path) -> None:
    rows = np.column_stack([T * 0, T * 0 + 3, T * 0, 1000 * np.sin(T), T, np.gradient(THETA_M, T), THETA_M])
    np.savetxt(tmp_path / "foc.txt", rows, fmt="%.4f", delimiter="\t")
    run = imported(tmp_path / "foc.txt", "--map", "simplefoc", "--rate", "200", "--pole-pairs", "7")
    assert run["i_q"] == pytest.approx(np.sin(T), abs=1e-6)
    assert np.abs(np.angle(np.exp(1j * (run["theta_enc"] - 7 * THETA_M)))).max() < 7e-4
    assert run.rate == 200


def test_a_recording_in_counts_with_halls_as_elmo_names_them(tmp_path: Path) -> None:
    counts = np.rint(THETA_M / math.tau * 4096)
    pd.DataFrame({
        "Time [ms]": T * 1e3, "Position [cnt]": counts, "Active Current [A]": np.sin(T),
        "Digital Halls": codes(4 * counts * math.tau / 4096),
    }).to_csv(tmp_path / "elmo.csv", index=False)  # fmt: skip
    run = imported(tmp_path / "elmo.csv", "--counts-per-turn", "4096", "--pole-pairs", "4")
    assert np.abs(np.angle(np.exp(1j * (run["theta_enc"] - 4 * counts * math.tau / 4096)))).max() < 1e-6
    assert (run.samples.raw["hall"] == codes(4 * counts * math.tau / 4096)).all()


def test_plotjuggler_leaves_cells_empty(tmp_path: Path) -> None:
    slow = np.where(np.arange(400) % 4 == 0, np.sin(T), np.nan)
    fast = np.where(np.arange(400) % 4 == 0, np.nan, T)
    pd.DataFrame({"__time": 1.7e9 + T, "fast": fast, "slow": slow}).to_csv(tmp_path / "pj.csv", index=False)
    run = imported(tmp_path / "pj.csv")
    known = np.isfinite(run["slow"])
    assert known.mean() > 0.97
    t = run.t[known] - run.t[0]
    assert run["slow"][known] == pytest.approx(np.sin(t), abs=2e-4)  # a line between points 20 ms apart, 50 us off


def test_groups_of_other_rates_go_to_the_fastest_ones_times(tmp_path: Path) -> None:
    fast, slow = np.arange(5000) / 10_000, np.arange(50) / 100 + 0.0001234
    theta = 40.0 * fast
    with asammdf.MDF(version="4.10") as mdf:
        mdf.append([asammdf.Signal(theta % math.tau, fast, unit="el rad", name="theta")])
        mdf.append([asammdf.Signal(np.cos(slow), slow, unit="A", name="i_q")])
        wide = 3.2 + 0.5 * slow
        mdf.append([asammdf.Signal(wide % math.tau, slow, unit="rad", name="other")])
        mdf.save(tmp_path / "x.mf4")
    run = imported(tmp_path / "x.mf4")
    assert len(run) == 5000
    assert np.abs(run.t - run.t[0] - fast).max() < 1e-9
    known = np.isfinite(run["i_q"])
    assert known.sum() == np.count_nonzero((fast >= slow[0]) & (fast <= slow[-1]))
    assert run["i_q"][known] == pytest.approx(np.cos(fast[known]), abs=0.01**2 / 8 + 1e-7)


@pytest.mark.parametrize("n_p", [1, 3, 7, 15])
@pytest.mark.parametrize("unit", ["mech deg", "deg"])
def test_pole_pairs_are_found_by_the_hall_sensors(n_p: int, unit: str) -> None:
    theta = 30.0 * T + 5.0 * np.sin(2 * T)  # of the shaft, both told and not told whose it is
    t = np.arange(0, 2, 1e-4)
    theta = np.interp(t, T, theta)
    told = {"hall": codes(n_p * theta), "theta_enc": np.degrees(theta) % 360}
    run = bench.capture(t, told, units={"theta_enc": unit})
    if n_p > 1 or unit == "mech deg":
        assert run.parameters["n_p"] == n_p
    assert np.abs(np.angle(np.exp(1j * (run["theta_enc"] - n_p * theta)))).max() < 1e-6


def test_an_angle_that_is_electrical_stays_so() -> None:
    t = np.arange(0, 2, 1e-4)
    theta = 100.0 * t
    run = bench.capture(t, {"hall": codes(theta), "theta_enc": theta % math.tau}, n_p=7)
    assert np.abs(np.angle(np.exp(1j * (run["theta_enc"] - theta)))).max() < 1e-6
    assert run.parameters["n_p"] == 7


def test_exchanged_wires_are_named_where_there_is_an_encoder() -> None:
    t = np.arange(0, 4, 1e-4)
    theta = 60.0 * np.sin(math.pi * t / 2) * 2
    right = codes(theta)
    swapped = (right & 4) | (right & 1) << 1 | (right & 2) >> 1
    causes = [f.cause for f in bench.hall(bench.capture(t, {"hall": swapped, "theta_enc": theta}, n_p=4)).findings]
    assert any("Hall wires are exchanged" in cause for cause in causes), causes
    assert not bench.hall(bench.capture(t, {"hall": right, "theta_enc": theta}, n_p=4)).findings


def test_a_sparse_scope_with_a_gap_keeps_it(tmp_path: Path) -> None:
    t = np.r_[np.arange(1000), np.arange(1500, 2500)] / 10_000
    run = bench.capture(t, {"a": np.sin(t)})
    assert len(run) == 2000
    (gap,) = run.samples.gaps
    assert (gap.position, gap.lost_samples) == (1000, 500)


def test_what_was_used_can_be_written_down_and_used_again(tmp_path: Path) -> None:
    made.csv_wide(tmp_path / "a.csv")
    options = (
        "--channel",
        "theta_enc=-theta:el deg",
        "--channel",
        "i_a=i_a:A",
        "--unit",
        "i_b=mA",
        "--pole-pairs",
        "6",
    )
    first = imported(tmp_path / "a.csv", *options, "--save-map", str(tmp_path / "map.toml"))
    made.csv_wide(tmp_path / "b.csv")
    again = imported(tmp_path / "b.csv", "--map", str(tmp_path / "map.toml"))
    assert (first.samples.raw == again.samples.raw).all()
    assert first.parameters == again.parameters == {"n_p": 6}
    theta = made.columns()["theta"]
    assert np.abs(np.angle(np.exp(1j * (again["theta_enc"] + np.radians(theta))))).max() < 1e-6


@pytest.mark.parametrize("name", presets())
def test_a_preset_is_a_mapping(name: str, tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(to_toml(read(name)))
    told = read(name)
    assert read(str(tmp_path / "a.toml")) == told.model_copy(update={"signature": ()})


def at_a_terminal(file: Path, answers: str) -> str:
    """What `bench import` says and asks there; all answers are typed ahead."""
    master, slave = pty.openpty()
    command = [sys.executable, "-m", "bench", "import", str(file), "-o", str(file.with_suffix(".run")), "--overwrite"]
    with subprocess.Popen(command, stdin=slave, stdout=subprocess.DEVNULL, stderr=slave, env=ENVIRONMENT) as program:
        os.close(slave)
        os.write(master, answers.encode())
        said = b""
        with suppress(OSError):  # nobody holds the other end any more
            while data := os.read(master, 4096):
                said += data
        os.close(master)
        assert program.wait(60) == 0, said.decode()
    return said.decode()


@pytest.mark.slow
def test_the_guess_is_asked_about_at_a_terminal(tmp_path: Path) -> None:
    made.csv_wide(tmp_path / "a.csv")
    said = at_a_terminal(tmp_path / "a.csv", "y\n")
    assert "theta_enc: theta, el deg" in said
    assert "Use this? [Y/n]" in said
    assert set(bench.read(tmp_path / "a.run").names) == {"hall", "theta_enc", "i_a", "i_b", "i_c", "u_alpha", "u_beta"}
    said = at_a_terminal(tmp_path / "a.csv", "n\n\n\n-\n-\n\ni_c:mA\n-\n-\n-\n6\n")
    assert "Hall sensors a, b, c" in said
    run = bench.read(tmp_path / "a.run")
    assert run.parameters == {"n_p": 6}
    assert run["i_b"] == pytest.approx(made.columns()["i_c"] * 1e-3, abs=1e-8)
    assert "theta_enc" not in run.names


SCOPES = {
    "PicoScope": "Time,Channel A\n(ms),(V)\n\n0.0,1.0\n0.5,1.5\n1.0,2\n1.5,0\n",
    "Keysight": "x-axis,1\nsecond,Volt\n-1e-3,1.0\n-5e-4,1.5\n0,2\n5e-4,0\n",
    "Tektronix TDS": "Record Length,4,,-0.001,1.0\nTrigger Point,3,,-0.0005,1.5\n,,,0.0,2\n,,,0.0005,0\n",
    "Tektronix MSO": '"Waveform Type","ANALOG"\n"Point Format","Y"\n\nTIME,CH1\n0,1\n5e-4,1.5\n1e-3,2\n15e-4,0\n',
    "Rigol": "X,CH1,Start,Increment,\nSequence,Volt,-6e-3,5e-4\n0,1,\n1,1.5,\n2,2,\n3,0,\n",
    "Rigol, as wide": "X,CH1,Start,Increment,\nCounter,VOLT,-6e-3,5e-4,\n0,1,,,\n1,1.5,,,\n2,2,,,\n3,0,,,\n",
    "Rigol, as narrow": "X,CH1,Start,Increment\nSequence,Volt,-6e-3,5e-4\n0,1\n1,1.5\n2,2\n3,0\n",
    "sigrok": "; CSV generated by libsigrok 0.5.2\n; Channels (1/1): A0\n; Samplerate: 2 kHz\nanalog\n1\n1.5\n2\n0\n",
    "an interval": "Sample Interval,500,us\nCH1\n1\n1.5\n2\n0\n",
    "Siglent": "Record Length,Analog:4\nSource,CH1\nSecond,Value\n-1e-3,1\n-5e-4,1.5\n0,2\n5e-4,0\n",
}
"""As their manuals and users' files show them: four samples of a volt or two, 0.5 ms apart."""


@pytest.mark.parametrize("name", SCOPES)
def test_what_a_scope_saves(name: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(SCOPES[name])
    run = imported(tmp_path / "a.csv")
    assert np.diff(run.t) == pytest.approx([5e-4] * 3)
    (voltage,) = (channel for channel in run.names if channel != "column_2")
    assert run[voltage] == pytest.approx([1.0, 1.5, 2.0, 0.0])


def test_a_scope_that_tells_no_time_is_asked_for_its_rate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.csv").write_text("D0,D1\n1,0\n0,1\n0,0\n")
    with pytest.raises(SystemExit):
        imported(tmp_path / "a.csv")
    assert "no column tells the time" in capsys.readouterr().err
    assert len(imported(tmp_path / "a.csv", "--rate", "50000")) == 3


def test_a_time_that_counts_is_doubted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for unit, doubted in (("", True), (" [s]", False)):
        (tmp_path / "a.csv").write_text(f"t{unit},a\n" + "".join(f"{k},{k * k}\n" for k in range(9)))
        assert len(imported(tmp_path / "a.csv")) == 9
        assert ("if it counts rows, give --time '' and --rate HZ" in capsys.readouterr().err) is doubted


def test_a_rate_counts_more_than_the_one_above_the_table_where_the_times_are_said_to_be_none(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(SCOPES["Rigol"])
    run = imported(tmp_path / "a.csv", "--time", "", "--rate", "4000")
    assert np.diff(run.t) == pytest.approx([2.5e-4] * 3)
    assert run["CH1"] == pytest.approx([1.0, 1.5, 2.0, 0.0])


ABOVE = {
    "Sample Rate (kHz)\n2.5\n\nCH1,CH2": 2500.0, "Sampling rate: 10 MSa/s\nCH1,CH2": 1e7,
    "# sample_rate = 1e4\nCH1,CH2": 1e4, "Sample Interval [ms],20,,\nCH1,CH2": 50.0,
    "Sample Interval,4.0e-10,s\nCH1,CH2": 2.5e9, "CH1,CH2,Start,Increment\nVolt,Volt,-1,1e-5": 1e5,
    "dt,Hall 1": None, "dt,1": None, "dt,1\n\n": None, "increment,CH 2": None,
    "Sample rate,,2024-01-02\nCH1,CH2": None, "Sample rate,12.5 mV\nCH1,CH2": None,
    "Sample Interval,1e-320,ns\nCH1,CH2": None, "Sample Interval,0,s\nCH1,CH2": None,
    "Sample Interval,-1,s\nCH1,CH2": None, "Sample rate,1e999,Hz\nCH1,CH2": None,
}  # fmt: skip
"""Rows a second by what stands above a table of two columns."""


@pytest.mark.parametrize(("above", "rate"), ABOVE.items())
def test_a_rate_above_a_table_is_one_that_is_told(
    above: str, rate: float | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.csv").write_text(f"{above}\n1,0.5\n3,0\n2,0.5\n6,0.5\n")
    if rate:
        assert np.diff(imported(tmp_path / "a.csv").t) == pytest.approx([1 / rate] * 3, rel=1e-6)
        return
    with pytest.raises(SystemExit):
        imported(tmp_path / "a.csv")
    assert "no column tells the time" in capsys.readouterr().err


def test_columns_are_not_taken_for_what_a_scope_writes_beside_them(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time [s],start,stop\n0,1.5,0\n0.1,1,1\n0.2,0,2\n")
    run = imported(tmp_path / "a.csv")
    assert list(run["start"]) == [1.5, 1.0, 0.0]
    assert list(run["stop"]) == [0.0, 1.0, 2.0]


def test_a_line_ends_where_all_readers_end_it(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(
        "a remark\x0cof two\u2028parts\ntime [s],a\n" + "".join(f"{k},{k / 2}\n" for k in range(5))
    )
    assert list(imported(tmp_path / "a.csv")["a"]) == [0.0, 0.5, 1.0, 1.5, 2.0]
