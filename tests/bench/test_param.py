"""`bench param`: it tells what the device has, writes all or nothing, and keeps why."""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from param_devices import bench as run_bench
from param_devices import device, reached, refusing, rounding, settable

from bench.device.client import Client
from bench.device.node import Node
from bench.param import dump, history, sources
from bench.param.differences import compare
from bench.param.table import ParameterEntry, Parameters, same, shortest
from bench.param.watching import Watched, watch
from protocol.messages import ErrorCode, EventCode
from protocol.signals import DRIVE_PARAMETERS, Flag
from sim.ports.device import SimulatedDevice
from sim.ports.virtual import VirtualLink

FINITE = st.floats(width=32, allow_nan=False, allow_infinity=False)


@pytest.fixture(autouse=True)
def _kept_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reasons are kept in a folder of the test."""
    monkeypatch.setattr("bench.param.history.user_data_path", lambda name: tmp_path / "kept" / name)


@pytest.fixture
def bench(capsys):
    return partial(run_bench, capsys)


# -- numbers --------------------------------------------------------------------------------------------------------


@given(FINITE)
def test_the_shortest_decimal_is_this_float32_and_no_shorter_one_is(value: float) -> None:
    text = shortest(value)
    assert np.float32(tomllib.loads(f"x = {text}")["x"]) == np.float32(value)
    digits = len(text.partition("e")[0].replace(".", "").strip("-0"))
    for fewer in range(1, digits):  # no decimal with fewer digits is this number
        with np.errstate(over="ignore"):
            assert np.float32(f"{value:.{fewer - 1}e}") != np.float32(value)


@given(FINITE, FINITE)
def test_values_are_one_only_where_no_float32_lies_between_them(a: float, b: float) -> None:
    lo, hi = sorted([np.float32(a), np.float32(b)])
    between = np.nextafter(lo, np.float32(math.inf))
    assert same(a, b) == bool(lo == hi or between >= hi)
    assert same(a, b) == same(b, a)


@settings(max_examples=60, deadline=None)
@given(
    st.dictionaries(st.text(min_size=1, max_size=16), FINITE, max_size=4),
    st.text(max_size=40),
    st.sampled_from([Flag(0), Flag.TUNING, Flag.CALIBRATION, Flag.READ_ONLY, Flag.VOLATILE, Flag.LIMITS]),
)
def test_any_parameters_survive_a_dump(tmp_path_factory, values, words, flags) -> None:
    """Whatever names and meanings a device has: keys, comments and texts of TOML are quoted."""
    entries = {
        name: ParameterEntry(name, float(np.float32(value)), words, 0.0, -1e30, 1e30, flags, words)
        for name, value in values.items()
    }
    made = Parameters("a device", entries, {"name": words, "serial": words, "node": 3, "role": "other"})
    reasons = {name: dump.Reason(0.0, value, words, words, words) for name, value in values.items()}
    file = tmp_path_factory.getbasetemp() / "any.toml"
    file.write_text(dump.text(made, "now", words, words, reasons), encoding="utf-8")
    again = dump.read(file)
    lasting = {} if flags & Flag.VOLATILE else {name: float(np.float32(value)) for name, value in values.items()}
    assert {name: np.float32(v) for name, v in again.parameters.items()} == lasting
    assert again.parameters.serial == words
    assert all(e.flags & Flag.READ_ONLY == flags & Flag.READ_ONLY for e in again.parameters.entries.values())


# -- told -----------------------------------------------------------------------------------------------------------


def test_list_tells_what_the_device_has(bench) -> None:
    made = device()
    made.drive.app.set_param("k_p_vt", 900.0)
    with reached(a=made) as target:
        code, out, _ = bench("param", "list", target["a"], "--json")
        told = {row["name"]: row for row in json.loads(out)}
        changed = json.loads(bench("param", "list", target["a"], "--changed", "--json")[1])
        tuning = json.loads(bench("param", "list", target["a"], "--group", "tuning", "--json")[1])
        code_table, table, _ = bench("param", "list", target["a"])
    app = made.drive.app
    assert (code, code_table) == (0, 0)
    assert list(told) == [p.name for p in app.parameters]
    for parameter in app.parameters:
        row = told[parameter.name]
        assert row["value"] == app.get_param(parameter.name)
        assert row["default"] == app.default_param(parameter.name)
        assert (row["lo"], row["hi"]) == (np.float32(parameter.lo), np.float32(parameter.hi))
        assert (row["unit"], row["meaning"]) == (parameter.unit.symbol, parameter.about)
    assert [row["name"] for row in changed] == ["k_p_vt"]
    groups = {p.name: p.flags & (Flag.IDENTITY | Flag.CALIBRATION | Flag.TUNING | Flag.LIMITS) for p in app.parameters}
    assert {row["name"] for row in tuning} == {name for name, flag in groups.items() if flag == Flag.TUNING}
    assert f"{len(told)} parameters of {len(told)}" in table


def test_the_load_machine_is_another_node_with_its_own_meanings(bench) -> None:
    with reached(a=device()) as target:
        told = json.loads(bench("param", "list", target["a"], "--node", 2, "--json")[1])
        code, _, err = bench("param", "list", target["a"], "--node", 9)
    assert {row["name"]: row["meaning"] for row in told}["hall_open"].startswith("Hall wires broken")
    assert code == 2
    assert "there is no node 9 on " in err


def test_get_prints_values_and_names_what_is_near(bench) -> None:
    with reached(a=device()) as target:
        assert bench("param", "get", target["a"], "n_p", "k_p_vt")[1] == "n_p = 6\nk_p_vt = 1268 1/s\n"
        code, _, err = bench("param", "get", target["a"], "k_p_tv")
    assert code == 2
    assert "has no parameter 'k_p_tv': did you mean k_p_vt?" in err


# -- set ------------------------------------------------------------------------------------------------------------


def test_set_writes_all_and_keeps_why(bench) -> None:
    made = device()
    with reached(a=made) as target:
        code, out, err = bench("param", "set", target["a"], "k_p_vt=900", "i_max=6.5", "--reason", "rings")
    assert (code, err) == (0, "")
    assert out == "k_p_vt: 1268 -> 900 1/s\ni_max: 8 -> 6.5 A\n"
    assert [made.drive.app.get_param(name) for name in ("k_p_vt", "i_max")] == [900.0, 6.5]
    kept = history.read(Parameters("", {}, {"serial": "SIM-0001"})).changes
    assert [(c.name, c.before, c.value, c.reason, c.by) for c in kept] == [
        ("i_max", 8.0, 6.5, "rings", "set"),  # in the drive's order
        ("k_p_vt", 1268.0, 900.0, "rings", "set"),
    ]


@pytest.mark.parametrize(("wrong", "words"), [
    (("k_p_vt=900", "i_max=999"), "i_max must be 0 to 200 A, got 999; nothing was set"),
    (("k_p_vt=900", "i_range=5"), "i_range can only be read"),
    (("k_p_vt=900", "n_p=2.5"), "n_p must be a whole number, got 2.5"),
    (("k_p_vt=900", "k_i=3"), "has no parameter 'k_i'"),
    (("k_p_vt=900", "k_p_vt=800"), "k_p_vt is given 2 times: give it once"),
    (("k_p_vt=nan",), "'nan' is not a finite number"),
    (("k_p_vt",), "is not NAME=VALUE"),
])  # fmt: skip
def test_what_cannot_be_set_is_said_before_anything_is(bench, wrong, words) -> None:
    made = device()
    before = settable(made)
    with reached(a=made) as target:
        code, _, err = bench("param", "set", target["a"], *wrong)
    assert code == 2
    assert words in err
    assert settable(made) == before


@pytest.mark.parametrize("code", [ErrorCode.OUT_OF_RANGE, ErrorCode.WRONG_STATE, ErrorCode.NOT_SUPPORTED])
@pytest.mark.parametrize("refused", ["k_p_vt", "k_i_vt", "bw_current"])
def test_where_the_drive_refuses_one_all_have_their_old_values(bench, refused: str, code: ErrorCode) -> None:
    made = device()
    refusing(made, refused, code)
    before = settable(made)
    with reached(a=made) as target:
        exit_code, _, err = bench("param", "set", target["a"], "k_p_vt=900", "k_i_vt=40000", "bw_current=500")
    assert exit_code == 2
    assert refused in err
    assert "2 parameters set before it have the old value again" in err
    assert settable(made) == before
    assert not history.read(Parameters("", {}, {"serial": "SIM-0001"})).changes


def test_limits_that_depend_on_each_other_are_set_in_whatever_order_it_takes(bench) -> None:
    made = device()
    set_param, get = made.drive.app.set_param, made.drive.app.get_param

    def ordered(name: str, value: float) -> None:
        from protocol.errors import Refused

        if name == "omega_off" and value > get("omega_on"):
            raise Refused("omega_off above omega_on", ErrorCode.OUT_OF_RANGE, get("omega_on"))
        set_param(name, value)

    made.drive.app.set_param = ordered  # type: ignore[method-assign]
    with reached(a=made) as target:
        assert bench("param", "set", target["a"], "omega_off=80", "omega_on=100")[0] == 0
    assert [get("omega_off"), get("omega_on")] == [80.0, 100.0]


def test_a_running_drive_takes_no_idle_only_parameter_and_keeps_the_others(bench) -> None:
    made = device(firmware__watchdog=1.0)
    node = Node(Client(VirtualLink(made)), 1)
    node.arm()
    node.start()
    before = settable(made)
    with reached(a=made) as target:
        code, _, err = bench("param", "set", target["a"], "k_p_vt=900", "i_max=5")
        assert code == 2
        assert "node 1 is RUNNING and takes i_max only with its outputs off: stop it first; nothing was set" in err
        assert settable(made) == before
        assert bench("param", "set", target["a"], "k_p_vt=900")[0] == 0
    assert made.drive.app.outputs_on


def test_a_drive_that_rounds_is_told_and_is_no_difference_afterwards(bench, tmp_path: Path) -> None:
    made, file = device(), tmp_path / "a.toml"
    rounding(made, "k_p_vt", 8.0)
    with reached(a=made) as target:
        bench("param", "dump", target["a"], "-o", file)
        file.write_text(file.read_text().replace("k_p_vt = 1268.0", "k_p_vt = 901.0"))
        code, out, _ = bench("param", "load", file, target["a"], "--yes")
        assert code == 0
        assert made.drive.app.get_param("k_p_vt") == 904.0
        assert bench("param", "load", file, target["a"], "--check")[0] == 0
        assert bench("param", "diff", file, target["a"])[0] == 0
        made.drive.app.set_param("k_p_vt", 912.0)
        assert bench("param", "load", file, target["a"], "--check")[0] == 1
    out = out.splitlines()
    assert any("k_p_vt" in line and "901" in line and "1268" in line for line in out)


def test_save_needs_a_drive_that_stores(bench) -> None:
    made = device()
    with reached(a=made) as target:
        before = settable(made)
        code, _, err = bench("param", "set", target["a"], "k_p_vt=900", "--save")
        assert (code, settable(made)) == (2, before)
        assert "cannot store parameters (feature COMMIT)" in err
        assert bench("param", "save", target["a"])[0] == 2
    made = device(stores=True)
    calls: list[float] = []
    made.drive.app.commit = lambda: calls.append(made.drive.app.get_param("k_p_vt"))  # type: ignore[method-assign]
    with reached(a=made) as target:
        code, out, _ = bench("param", "set", target["a"], "k_p_vt=900", "--save")
        assert bench("param", "save", target["a"])[0] == 0
    assert (code, calls) == (0, [900.0, 900.0])
    assert out.endswith("node 1 stored its parameters\n")


def test_what_is_not_stored_is_put_back(bench) -> None:
    from protocol.errors import Refused

    def fails() -> None:
        raise Refused("flash is worn", ErrorCode.STORE_FAILED)

    made = device(stores=True)
    made.drive.app.commit = fails  # type: ignore[method-assign]
    before = settable(made)
    with reached(a=made) as target:
        code, _, err = bench("param", "set", target["a"], "k_p_vt=900", "i_max=6", "--save")
    assert (code, settable(made)) == (2, before)
    assert "did not store its parameters" in err


def test_the_simulated_drive_of_a_command_is_not_written_to(bench) -> None:
    for arguments in (("set", "sim", "n_p=4"), ("save", "sim")):
        code, _, err = bench("param", *arguments)
        assert code == 2
        assert "exists only during this command" in err


# -- dump, load, diff -----------------------------------------------------------------------------------------------


def test_dump_load_on_a_second_drive_diff_nothing(bench, tmp_path: Path) -> None:
    """With every parameter that can be written at another value, drawn within its range."""
    random = np.random.default_rng(3)
    first, second, file = device("A-1"), device("A-2"), tmp_path / "a.toml"
    for p in first.drive.app.parameters:
        if p.flags & (Flag.READ_ONLY | Flag.VOLATILE) or p.name in ("n_p", "watchdog", "observer"):
            continue
        value = (
            random.uniform(p.lo, p.hi) if p.hi < 1e3 else random.uniform(0.5, 2.0) * first.drive.app.get_param(p.name)
        )
        first.drive.app.set_param(p.name, float(np.float32(round(value) if p.flags & Flag.WHOLE else value)))
    with reached(a=first, b=second) as target:
        assert bench("param", "dump", target["a"], "-o", file, "--reason", "as delivered")[0] == 0
        code, _, err = bench("param", "load", file, target["b"], "--yes")
        assert code == 2
        assert "is of device A-1, this is A-2: dead_time_hat, edge_up_1" in err or "A-2: edge_up_1" in err
        assert "--other-drive" in err
        assert settable(second) == settable(device())
        code, out, _ = bench("param", "load", file, target["b"], "--yes", "--other-drive")
        assert code == 0
        assert settable(second) == settable(first)
        code, out, _ = bench("param", "diff", file, target["b"])
        assert (code, "0 differences" in out) == (0, True)
        assert bench("param", "diff", target["a"], target["b"])[0] == 0
        assert bench("param", "load", file, target["b"], "--check")[0] == 0
        assert bench("param", "diff", file, "defaults")[0] == 2
        assert bench("param", "diff", target["b"], "defaults")[0] == 1
    told = {c.name: c.reason for c in history.read(Parameters("", {}, {"serial": "A-2"})).changes}
    assert set(told.values()) == {"as delivered"}


def test_tuning_of_another_drive_needs_no_consent(bench, tmp_path: Path) -> None:
    first, second, file = device("A-1"), device("A-2"), tmp_path / "a.toml"
    first.drive.app.set_param("k_p_vt", 900.0)
    first.drive.app.set_param("edge_up_1", 0.01)
    with reached(a=first, b=second) as target:
        bench("param", "dump", target["a"], "-o", file)
        assert bench("param", "load", file, target["b"], "--yes", "--group", "tuning")[0] == 0
    assert second.drive.app.get_param("k_p_vt") == 900.0
    assert second.drive.app.get_param("edge_up_1") == 0.0


def test_check_writes_nothing_and_exits_with_1_for_a_difference(bench, tmp_path: Path) -> None:
    made, file = device(), tmp_path / "a.toml"
    with reached(a=made) as target:
        bench("param", "dump", target["a"], "-o", file)
        assert bench("param", "load", file, target["a"], "--check")[0] == 0
        made.drive.app.set_param("k_p_vt", 900.0)
        before = settable(made)
        code, out, _ = bench("param", "load", file, target["a"], "--check")
        assert (code, settable(made)) == (1, before)
        assert "k_p_vt" in out
        made.drive.app.set_param("k_p_vt", float(np.nextafter(np.float32(1268.0), np.float32(2000.0))))
        assert bench("param", "load", file, target["a"], "--check")[0] == 0


def test_load_asks_and_without_a_terminal_needs_yes(bench, tmp_path: Path) -> None:
    made, file = device(), tmp_path / "a.toml"
    with reached(a=made) as target:
        bench("param", "dump", target["a"], "-o", file)
        made.drive.app.set_param("k_p_vt", 900.0)
        code, _, err = bench("param", "load", file, target["a"])
    assert code == 2
    assert "no terminal to confirm 'Write 1 parameter to" in err
    assert made.drive.app.get_param("k_p_vt") == 900.0


def test_unknown_and_missing_parameters_are_told(bench, tmp_path: Path) -> None:
    made, file = device(), tmp_path / "a.toml"
    with reached(a=made) as target:
        bench("param", "dump", target["a"], "-o", file)
        lines = [line for line in file.read_text().splitlines() if not line.startswith("k_i_vt")]
        file.write_text("\n".join(lines).replace("\n[parameters]", "\n[parameters]\nk_new = 3.0"))
        code, out, _ = bench("param", "load", file, target["a"], "--check")
        assert code == 1
        assert "does not have k_new: left out" in out
        assert "does not have k_i_vt: left as they are" in out
        assert bench("param", "load", file, target["a"], "--yes")[0] == 0
        code, out, _ = bench("param", "diff", file, target["a"], "--json")
    found = json.loads(out)
    assert (code, found["only_a"], found["only_b"], found["differences"]) == (1, ["k_new"], ["k_i_vt"], [])


def test_a_load_that_is_refused_half_way_leaves_the_drive_as_it_was(bench, tmp_path: Path) -> None:
    first, second, file = device("A"), device("A"), tmp_path / "a.toml"
    for name, value in (("k_p_vt", 900.0), ("edge_up_2", 0.02), ("i_max", 6.0), ("u_dc_max", 40.0)):
        first.drive.app.set_param(name, value)
    refusing(second, "edge_up_2")
    before = settable(second)
    with reached(a=first, b=second) as target:
        bench("param", "dump", target["a"], "-o", file)
        code, _, err = bench("param", "load", file, target["b"], "--yes")
    assert (code, settable(second)) == (2, before)
    assert "edge_up_2" in err


def test_a_dump_tells_why_and_only_of_what_is_so(bench, tmp_path: Path) -> None:
    made, file = device(), tmp_path / "a.toml"
    with reached(a=made) as target:
        for value, reason in ((950, "first"), (900, 'rings at "300" r/min\n')):
            bench("param", "set", target["a"], f"k_p_vt={value}", "--reason", reason)
        bench("param", "set", target["a"], "k_i_vt=40000", "--reason", "with it")
        bench("param", "set", target["a"], "omega_on=30", "--reason", "tried")
        bench("param", "set", target["a"], "omega_on=20", "--reason", "was no good")
        made.drive.app.set_param("k_i_vt", 41000.0)  # by another host
        bench("param", "dump", target["a"], "-o", file)
    told = tomllib.loads(file.read_text())["reasons"]
    assert list(told) == ["k_p_vt"]  # omega_on is at its default, k_i_vt was changed since by somebody else
    assert {key: told["k_p_vt"][key] for key in ("before", "value", "reason")} == {
        "before": 950.0, "value": 900.0, "reason": 'rings at "300" r/min\n'
    }  # fmt: skip


def test_a_damaged_history_loses_its_damaged_lines_alone(bench, tmp_path: Path) -> None:
    made = device()
    with reached(a=made) as target:
        bench("param", "set", target["a"], "k_p_vt=900", "--reason", "one")
        kept = history.place("SIM-0001")
        kept.write_bytes(b'{"when": 3}\nnonsense \xff\n[1]\n' + kept.read_bytes() + b'{"when": "2026')
        code, out, err = bench("param", "dump", target["a"])
    assert code == 0
    assert tomllib.loads(out)["reasons"]["k_p_vt"]["reason"] == "one"
    assert "4 lines of " in err


def test_a_drive_without_a_serial_number_keeps_no_reason_and_says_so(bench) -> None:
    with reached(a=device("")) as target:
        code, _, err = bench("param", "set", target["a"], "k_p_vt=900", "--reason", "one")
    assert code == 0
    assert "no serial number: the reason is not kept" in err


def test_a_reason_that_cannot_be_kept_is_an_error_that_says_that_the_drive_has_the_values(
    bench, tmp_path: Path
) -> None:
    (tmp_path / "kept").write_text("a file, where the folder should be")
    made = device()
    with reached(a=made) as target:
        code, _, err = bench("param", "set", target["a"], "k_p_vt=900")
    assert code == 2
    assert "error: the drive has the new values; why cannot be kept in " in err
    assert made.drive.app.get_param("k_p_vt") == 900.0


@pytest.mark.parametrize(("text", "words"), [
    ("", "it has no table [parameters]"),
    ("[parameters", "cannot read"),
    ("[parameters]\nk_p_vt = true", "k_p_vt must be a finite number, got True"),
    ("[parameters]\nk_p_vt = nan", "k_p_vt must be a finite number, got nan"),
    ("[parameters]\nk_p_vt = '3'", "k_p_vt must be a finite number, got '3'"),
    ("format = 2\n[parameters]", "has format 2, this version reads 1"),
    ("[parameters]\n[motor]", "'motor' does not belong into a dump"),
    ("[parameters]\na = 1\n[read_only]\na = 2", "a stands in [parameters] and in [read_only]"),
    ("[parameters]\nk_p_vt = 1e9", "k_p_vt must be 0 to 100000 1/s, got 1e+09"),
])  # fmt: skip
def test_a_file_that_is_no_dump_is_refused(bench, tmp_path: Path, text: str, words: str) -> None:
    made, file = device(), tmp_path / "a.toml"
    file.write_text(text)
    before = settable(made)
    with reached(a=made) as target:
        code, _, err = bench("param", "load", file, target["a"], "--yes")
    assert (code, settable(made)) == (2, before)
    assert words in err


def test_runs_are_compared_with_each_other_and_with_a_drive(bench, drive_run: Path) -> None:
    recorded = sources.of_run(drive_run)
    assert bench("param", "diff", drive_run, drive_run)[0] == 0
    made = device()
    for name, value in recorded.items():
        made.drive.app.set_param(name, value)
    with reached(a=made) as target:
        assert bench("param", "diff", drive_run, target["a"])[0] == 0
        made.drive.app.set_param("k_p_vt", 900.0)
        code, out, _ = bench("param", "diff", target["a"], drive_run)
    assert code == 1
    assert [line.split()[:3] for line in out.splitlines() if line.startswith("k_p_vt")] == [
        ["k_p_vt", "900", shortest(recorded["k_p_vt"])]
    ]


@given(st.dictionaries(st.sampled_from([p.name for p in DRIVE_PARAMETERS[:12]]), FINITE),
       st.dictionaries(st.sampled_from([p.name for p in DRIVE_PARAMETERS[:12]]), FINITE))  # fmt: skip
def test_a_comparison_is_complete_and_symmetric(a: dict[str, float], b: dict[str, float]) -> None:
    def table(values: dict[str, float]) -> Parameters:
        return Parameters("x", {name: ParameterEntry(name, value) for name, value in values.items()})

    found, back = compare(table(a), table(b)), compare(table(b), table(a))
    both = a.keys() & b.keys()
    assert {d.name for d in found.values} == {n for n in both if abs(int(_ordered(a[n])) - int(_ordered(b[n]))) > 1}
    assert {(d.name, d.a, d.b) for d in found.values} == {(d.name, d.b, d.a) for d in back.values}
    assert (set(found.only_a), set(found.only_b)) == (a.keys() - both, b.keys() - both)
    assert found.none == (not found.values and a.keys() == b.keys())


def _ordered(value: float) -> int:
    """The number of a float32 in the order of all of them; both zeros are one."""
    bits = int(np.float32(value).view(np.int32))
    return bits if bits >= 0 else -(bits & 0x7FFFFFFF)


# -- watch ----------------------------------------------------------------------------------------------------------


def watched(made: SimulatedDevice, minor: int) -> tuple[Node, Iterator[Watched]]:
    """The drive, of HBP 1.`minor`, and what is seen to change in it."""
    node = Node(Client(VirtualLink(made)), 1)
    node._identity = replace(node.identity, minor=minor)
    return node, watch(node, sources.of_node(node, "a"), 100.0)


def test_watch_tells_what_the_drive_tells_with_its_time() -> None:
    made = device()
    node, changes = watched(made, 1)
    parameters = {p.name: p.id for p in made.drive.app.parameters}
    before = 1268.0
    for value in (900.0, 901.0, 1268.0):
        node.client.run_for(0.3)
        made.drive.app.set_param("k_p_vt", value)
        made.drive.event(EventCode.PARAM_CHANGED, parameters["k_p_vt"], value)
        at = made.bench.tick / 20e6
        seen = next(changes)
        assert seen[1:] == ("k_p_vt", before, value, True)
        assert seen.seconds == pytest.approx(at, abs=0.02)
        before = value


@pytest.mark.parametrize(("minor", "within"), [(0, 2.0), (1, 15.0)])
def test_watch_finds_what_nobody_tells_by_asking(minor: int, within: float) -> None:
    """A drive of HBP 1.0 tells nothing; of one that does an event may be lost."""
    made = device()
    node, changes = watched(made, minor)
    made.drive.app.set_param("u_dc_max", 40.0)
    began = node.client.now()
    assert next(changes)[1:] == ("u_dc_max", 32.0, 40.0, False)
    assert node.client.now() - began < within
    made.drive.app.set_param("n_p", 4.0)
    assert next(changes)[1:] == ("n_p", 6.0, 4.0, False)


def test_watch_as_a_command(bench) -> None:
    made = device()
    with reached(a=made) as target:
        code, out, _ = bench("param", "watch", target["a"], "--duration", "0.5")
    assert (code, out.count("\n")) == (0, 1)
    assert out.startswith(f"watching {len(made.drive.app.parameters)} parameters of simulated drive (serial SIM-0001)")


def test_the_python_of_the_page_runs_as_it_stands(capsys) -> None:
    page = (Path(__file__).parents[2] / "docs" / "parameters.md").read_text()
    (block,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    cells: dict[str, Any] = {}
    exec(block, cells)
    changes = cells["run"].parameters.changes
    assert [(change.name, change.value) for change in changes] == [
        ("k_p_vt", 900.0), ("k_i_vt", 40000.0), ("k_p_vt", 1268.0), ("k_i_vt", 54289.0)
    ]  # fmt: skip
    assert capsys.readouterr().out == "1268.0 1/s 1268.0\nTrue\n"
