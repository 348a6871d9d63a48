"""The import rules of pyproject.toml hold, and nothing escapes them; functions are small."""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import grimp
import pytest
from importlinter.cli import lint_imports

ROOT = Path(__file__).parents[1]
PACKAGES = ("bench", "sim", "protocol")
DRIVERS = {"serial", "can", "asyncio", "time", "socket", "threading"}


Nodes = list[tuple[Path, ast.AST]]


@pytest.fixture(scope="module")
def nodes() -> Nodes:
    """Everything that is written, and the file in which it stands."""
    files = (file for package in PACKAGES for file in (ROOT / package).rglob("*.py"))
    return [(file, node) for file in files for node in ast.walk(ast.parse(file.read_text()))]


def test_import_rules_are_kept() -> None:
    assert lint_imports(no_cache=True) == 0


def test_every_folder_has_a_layer() -> None:
    config = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    layers = {name for layer in config["contracts"][0]["layers"] for name in re.split(r"\s*\|\s*", layer)}
    folders = {
        f"{package}.{folder.name}"
        for package in PACKAGES
        for folder in (ROOT / package).iterdir()
        if (folder / "__init__.py").is_file()
    }
    assert folders <= layers
    assert layers <= folders | {"bench.errors", "bench.files", "protocol.host"}


def test_no_module_imports_another_in_a_circle() -> None:
    """Wherever the import stands, and were it for types only."""
    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    imports = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    TopologicalSorter(imports).prepare()  # raises CycleError


def test_bench_has_at_most_four_loose_modules() -> None:
    assert len(list((ROOT / "bench").glob("*.py"))) <= 4


def test_only_rerunio_imports_rerun(nodes: Nodes) -> None:
    assert {room for room, name in imported(nodes) if name == "rerun"} == {"bench.rerunio"}


def test_the_protocol_outside_its_links_does_no_io_and_reads_no_clock(nodes: Nodes) -> None:
    assert not {(room, name) for room, name in imported(nodes) if name in DRIVERS and room.startswith("protocol")} - {
        ("protocol.links", name) for name in DRIVERS
    }


MOST_PARAMETERS = 8
MOST_LINES = 80
COMPILED = {"kernel", "native", "intrinsic", "njit", "_kept"}


def test_functions_are_small(nodes: Nodes) -> None:
    """Compiled kernels excepted: a kernel is one step, and gets each of its figures as an argument."""
    large = [
        f"{file.relative_to(ROOT)}:{function.lineno} {function.name}"
        for file, function in nodes
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef)
        and not COMPILED & {ast.unparse(decorator).partition("(")[0] for decorator in function.decorator_list}
        and (parameters_of(function) > MOST_PARAMETERS or lines_of(function) > MOST_LINES)
    ]
    assert not large


def parameters_of(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """How many it takes by position or by name, without the object or the class itself."""
    found = function.args
    names = [argument.arg for argument in (*found.posonlyargs, *found.args, *found.kwonlyargs)]
    return len(names) - (names[:1] in (["self"], ["cls"]))


def lines_of(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    return (function.end_lineno or 0) - function.lineno + 1


def imported(nodes: Nodes) -> Iterator[tuple[str, str]]:
    """Folder (or loose module) and the first part of what it imports, wherever in it that stands."""
    for file, node in nodes:
        room = ".".join(file.relative_to(ROOT).with_suffix("").parts[:2])
        if isinstance(node, ast.Import):
            yield from ((room, alias.name.partition(".")[0]) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield room, node.module.partition(".")[0]


# -- docs/architecture.md -------------------------------------------------------------------------------------------

MAP = (ROOT / "docs" / "architecture.md").read_text()


def test_the_map_draws_the_layers_as_they_are() -> None:
    (drawing,) = re.findall(r"```text\n(.*?)```", MAP, re.DOTALL)
    drawn = [set(found) for line in drawing.splitlines() if (found := re.findall(r"\w+/[\w.]+", line))]
    contract = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"][0]
    layers = [re.split(r"\s*\|\s*", layer) for layer in contract["layers"]]
    assert drawn == [
        {
            name.replace(".", "/") + ("" if (ROOT / name.replace(".", "/")).is_dir() else ".py")
            for name in layer
        }
        for layer in layers
    ]  # fmt: skip


def test_the_map_names_every_folder_and_nothing_that_is_not_there() -> None:
    named = set(re.findall(r"`((?:bench|docs|protocol|sim|tests)/[\w./-]*)`", MAP))
    folders = {
        f"{init.parent.relative_to(ROOT)}/"
        for package in PACKAGES
        for init in (ROOT / package).rglob("__init__.py")
        if init.parent != ROOT / package
    }
    assert folders <= named
    assert not [name for name in named if not (ROOT / name).exists()]
    assert all(name.endswith("/") == (ROOT / name).is_dir() for name in named)
