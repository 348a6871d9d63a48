"""The import rules of pyproject.toml hold, and nothing escapes them; functions are small."""

from __future__ import annotations

import ast
import re
import tomllib
from graphlib import TopologicalSorter
from pathlib import Path

import grimp
import pytest
from importlinter.cli import lint_imports

from tests import code_lines

ROOT = Path(__file__).parents[1]
PACKAGES = ("bench", "sim", "protocol")
DRIVERS = {"serial", "can", "asyncio", "time", "socket", "threading"}

MOST_PARAMETERS = 8
MOST_LINES = 80
COMPILED = {"kernel", "native", "intrinsic", "overload"}
MOST_CODE_LINES = {"bench": 42700, "sim": 9650, "protocol": 6400, "tests": 49350}
"""Whoever raises one says so in the commit."""
Functions = ast.FunctionDef | ast.AsyncFunctionDef


class Sources:
    """All files in one pass: what each folder (or loose module) imports, wherever that stands, and large functions."""

    def __init__(self) -> None:
        self.imported: set[tuple[str, str]] = set()
        self.large: list[str] = []
        for file in (file for package in PACKAGES for file in (ROOT / package).rglob("*.py")):
            room = ".".join(file.relative_to(ROOT).with_suffix("").parts[:2])
            for node in ast.walk(ast.parse(file.read_text())):
                if isinstance(node, ast.Import):
                    self.imported |= {(room, alias.name.partition(".")[0]) for alias in node.names}
                elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                    self.imported.add((room, node.module.partition(".")[0]))
                elif isinstance(node, Functions) and is_large(node):
                    self.large.append(f"{file.relative_to(ROOT)}:{node.lineno} {node.name}")


@pytest.fixture(scope="module")
def sources() -> Sources:
    return Sources()


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
    assert layers <= folders | {"bench.errors", "bench.files", "bench.system", "protocol.host"}


def test_no_module_imports_another_in_a_circle() -> None:
    """Wherever the import stands, and were it for types only."""
    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    imports = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    TopologicalSorter(imports).prepare()  # raises CycleError


def test_bench_has_at_most_five_loose_modules() -> None:
    assert len(list((ROOT / "bench").glob("*.py"))) <= 5


def test_only_the_view_imports_rerun(sources: Sources) -> None:
    assert {room for room, name in sources.imported if name == "rerun"} == {"bench.view"}


def test_the_protocol_outside_its_links_does_no_io_and_reads_no_clock(sources: Sources) -> None:
    used = {(room, name) for room, name in sources.imported if name in DRIVERS and room.startswith("protocol")}
    assert not used - {("protocol.links", name) for name in DRIVERS}


def test_functions_are_small(sources: Sources) -> None:
    assert not sources.large


def is_large(function: Functions) -> bool:
    """Compiled kernels are not: a kernel is one step, and gets each of its figures as an argument."""
    if COMPILED & {ast.unparse(decorator).partition("(")[0] for decorator in function.decorator_list}:
        return False
    found = function.args
    names = [argument.arg for argument in (*found.posonlyargs, *found.args, *found.kwonlyargs)]
    lines = (function.end_lineno or 0) - function.lineno + 1
    return len(names) - (names[:1] in (["self"], ["cls"])) > MOST_PARAMETERS or lines > MOST_LINES


@pytest.mark.parametrize("package", MOST_CODE_LINES)
def test_code_lines_are_within_their_budget(package: str) -> None:
    assert code_lines.counted(package) <= MOST_CODE_LINES[package]


def test_nothing_is_used_that_ctrl_c_may_leave_locked() -> None:
    """A Condition and all that `threading` and `queue` make of one; but where no signal takes effect."""
    made = re.compile(
        r"\b(threading\.(Condition|Event|Semaphore|BoundedSemaphore|Barrier)|queue\.(\w+)?(?<!Simple)Queue)\("
    )
    sources = (file for package in PACKAGES for file in (ROOT / package).rglob("*.py"))
    assert {file.name for file in sources if made.search(file.read_text())} == {"notebook.py"}


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


def test_what_counts_as_a_line_of_code(tmp_path: Path) -> None:
    file = tmp_path / "x.py"
    file.write_text('"""Doc\n\nmore."""\n\nimport os  # x\nfrom a import (\n    b,\n)\n\n\n# no\nx = """\n\n"""\n'
                    "def f():\n    'one' 'string'\n    return (1,\n\n            2)\n")  # fmt: skip
    assert code_lines.code_lines(file) == 6
