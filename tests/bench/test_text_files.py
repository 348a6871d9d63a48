"""Text files and names of files, on every system alike.

An editor on Windows ends lines in CR LF, and may begin a file with a byte-order mark. Nothing is read or written in
whatever encoding a machine happens to have.
"""

from __future__ import annotations

import ast
import codecs
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st
from test_motor_files import ODRIVE_6, VESC, xml

import bench
from bench.accept.spec import read_spec
from bench.cli import cli
from bench.device.simulator import motors
from bench.dumps.read import read as read_dump
from bench.files import file_name
from bench.rig.settings import read_settings, write_rated
from bench.score.expect import read as read_expected
from sim.config.params import load_params

ROOT = Path(__file__).parents[2]
PACKAGES = ("bench", "protocol", "sim")
EDITORS = {
    "CR LF": lambda text: text.replace(b"\n", b"\r\n"),
    "byte-order mark": lambda text: codecs.BOM_UTF8 + text,
    "both": lambda text: codecs.BOM_UTF8 + text.replace(b"\n", b"\r\n"),
}
CSV = "Zeit [s],Strom Ü [A]\n" + "".join(f"{k / 1000},{k % 7}\n" for k in range(2000))
MOTEUS = "motor.poles 14\nmotor.resistance_ohm 0.05 # measured\nmotor.Kv 300\n"


def settings(path: Path) -> Any:
    return read_settings(path).station, read_settings(path).rated


def imported(path: Path) -> Any:
    """Of a scope's file, with a map that came from the same editor."""
    mark = codecs.BOM_UTF8 if path.read_bytes().startswith(codecs.BOM_UTF8) else b""
    end = b"\r\n" if b"\r\n" in path.read_bytes() else b"\n"
    names = path.with_suffix(".toml")
    names.write_bytes(mark + end.join([b"[channels.i_a]", b'column = "Strom \xc3\x9c"', b'unit = "A"', b""]))
    out = path.with_suffix(".run")
    done = CliRunner().invoke(cli, ["import", str(path), "-o", str(out), "--map", str(names), "--yes"])
    assert done.exit_code == 0, done.output
    return bench.read(out)["i_a"].tolist()


def dumped(path: Path) -> Any:
    return read_dump(path).values


MOTOR = next(iter(motors().values())).read_text(encoding="utf-8")
SPEC = (ROOT / "bench/accept/specs/sim.toml").read_text(encoding="utf-8")
KINDS: dict[str, tuple[str, str, Callable[[Path], Any]]] = {
    "bench.toml": ("bench.toml", 'station = "Prüfstand 3"\n[rated]\nspeed_rpm = 3000\n', settings),
    "a motor": ("m.toml", MOTOR, lambda path: str(load_params(path))),
    "a spec": ("s.toml", SPEC, lambda path: str(read_spec(str(path)).measurements)),
    "a scope's file and its map": ("c.csv", CSV, imported),
    "a moteus' configuration": ("d.cfg", MOTEUS, dumped),
    "an ODrive's": ("d.json", json.dumps(ODRIVE_6, indent=1), dumped),
    "a VESC's": ("d.xml", xml(VESC), dumped),
    "limits in TOML": ("e.toml", '"error.std" = [0, 5]\n', read_expected),
    "limits in JSON": ("e.json", '{"error.std":\n [0, 5]}\n', read_expected),
}


@pytest.mark.parametrize("editor", EDITORS)
@pytest.mark.parametrize("kind", KINDS)
def test_a_file_means_the_same_whatever_editor_wrote_it(kind: str, editor: str, tmp_path: Path) -> None:
    name, text, read = KINDS[kind]
    seen = []
    for folder, data in (("a", text.encode()), ("b", EDITORS[editor](text.encode()))):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / name).write_bytes(data)
        seen.append(read(tmp_path / folder / name))
    assert seen[0] == seen[1]
    assert seen[0]


def untold() -> Iterator[str]:
    """Calls that open text and name no encoding."""
    for file in (file for package in PACKAGES for file in (ROOT / package).rglob("*.py")):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        own = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and opens_text(node, own) and not names_encoding(node):
                yield f"{file.relative_to(ROOT)}:{node.lineno}"


def called(call: ast.Call) -> str:
    return getattr(call.func, "attr", getattr(call.func, "id", ""))


def opens_text(call: ast.Call, own: set[str]) -> bool:
    """Of a method `open` only where its mode says so, or nothing: it may be that of a file in an archive."""
    modes = [word.value for word in call.keywords if word.arg == "mode"]
    match call.func:
        case ast.Name(id="open") if "open" not in own:
            modes += call.args[1:2]
        case ast.Attribute(attr="open", value=ast.Name(id="path" | "log") | ast.BinOp()):
            modes += call.args[:1]
        case _:
            return called(call) in ("read_text", "write_text", "TextIOWrapper")
    return not any(isinstance(mode, ast.Constant) and "b" in str(mode.value) for mode in modes)


def names_encoding(call: ast.Call) -> bool:
    by_place = {"read_text": 1, "write_text": 2, "TextIOWrapper": 2}.get(called(call), 9)
    return len(call.args) >= by_place or any(word.arg == "encoding" for word in call.keywords)


@pytest.mark.parametrize(
    ("source", "named"),
    [
        ("open(x)", False), ("open(x, 'w')", False), ("open(x, 'rb')", True), ("open(x, encoding='utf-8')", True),
        ("path.open('a')", False), ("path.open('a', encoding='utf-8')", True), ("path.open(mode='wb')", True),
        ("(a / b).open()", False), ("x.read_text()", False), ("x.read_text('utf-8')", True),
        ("archive.open(name)", True),
        ("x.write_text('y')", False), ("x.write_text('y', encoding='utf-8')", True), ("io.TextIOWrapper(x)", False),
    ],
)  # fmt: skip
def test_what_counts_as_naming_the_encoding(source: str, named: bool) -> None:
    call = ast.parse(source, mode="eval").body
    assert isinstance(call, ast.Call)
    assert (not opens_text(call, set()) or names_encoding(call)) == named


def test_whatever_is_opened_as_text_names_its_encoding() -> None:
    assert list(untold()) == []


@pytest.mark.parametrize("editor", ["LF", *EDITORS])
def test_a_line_that_is_added_leaves_the_rest_of_the_file_as_it_is(editor: str, tmp_path: Path) -> None:
    before = 'station = "Prüfstand 3"\n[rated]\nspeed_rpm = 3000\n[rig]\nperson = false\n'.encode()
    change = EDITORS.get(editor, lambda text: text)
    (tmp_path / "bench.toml").write_bytes(change(before))
    write_rated(tmp_path / "bench.toml", {"current": 4.0})
    after = before.replace(b"[rated]\n", b"[rated]\ncurrent = 4.0\n")
    assert (tmp_path / "bench.toml").read_bytes() == change(after)


REFUSED = r'[<>:"/\\|?*\x00-\x1f]|[. ]$|^(CON|PRN|AUX|NUL|CLOCK\$|COM[0-9¹²³]|LPT[0-9¹²³])( *\.| *$)'
"""What Windows refuses in the name of a file, by Microsoft's page "Naming Files, Paths, and Namespaces"."""
DEVICES = ["CON", "prn", "aux", "Nul", "COM1", "com9", "LPT3"]


@given(
    st.one_of(
        st.text(min_size=1),
        st.sampled_from(DEVICES),
        st.tuples(st.sampled_from(DEVICES), st.sampled_from([".", " ", ".run", "[2]", "/x"])).map("".join),
        st.text(st.characters(codec="ascii", categories=["L", "N", "P", "Zs"]), min_size=90, max_size=400),
    )
)
def test_the_name_of_a_test_makes_a_name_of_a_file_that_every_system_takes(name: str) -> None:
    made = file_name(name)
    for full in (made, f"{made}.run", f"{made}.png"):
        assert not re.search(REFUSED, full, re.IGNORECASE)
        assert 0 < len(full.encode()) <= 110
    assert file_name(made) == made


def test_long_names_that_begin_alike_make_different_files_and_short_ones_stay_as_they_were() -> None:
    assert file_name("x" * 150 + "a") != file_name("x" * 150 + "b")
    assert file_name("trip[over-speed]") == "trip_over-speed_"
    assert file_name("fig09_start_up") == "fig09_start_up"
