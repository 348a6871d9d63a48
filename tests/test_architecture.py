"""The import rules of pyproject.toml hold, and nothing escapes them."""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

from importlinter.cli import lint_imports

ROOT = Path(__file__).parents[1]
PACKAGES = ("bench", "sim", "protocol")
DRIVERS = {"serial", "can", "asyncio", "time", "socket", "threading"}


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


def test_bench_has_at_most_four_loose_modules() -> None:
    assert len(list((ROOT / "bench").glob("*.py"))) <= 4


def test_only_rerunio_imports_rerun() -> None:
    assert {room for room, name in imported() if name == "rerun"} == {"bench.rerunio"}


def test_the_protocol_outside_its_links_does_no_io_and_reads_no_clock() -> None:
    assert not {(room, name) for room, name in imported() if name in DRIVERS and room.startswith("protocol")} - {
        ("protocol.links", name) for name in DRIVERS
    }


def imported() -> Iterator[tuple[str, str]]:
    """Folder (or loose module) and the first part of what it imports, wherever in it that stands."""
    for package in PACKAGES:
        for file in (ROOT / package).rglob("*.py"):
            room = ".".join(file.relative_to(ROOT).with_suffix("").parts[:2])
            for node in ast.walk(ast.parse(file.read_text())):
                if isinstance(node, ast.Import):
                    yield from ((room, alias.name.partition(".")[0]) for alias in node.names)
                elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                    yield room, node.module.partition(".")[0]
