"""README and docs name only commands, options and files that exist, and the README's CI commands are there."""

from __future__ import annotations

import importlib.util
import json
import re
import shlex
from pathlib import Path
from types import ModuleType

import click
import pytest

from bench.cli import cli
from bench.device.simulator import motors
from sim.config.params import load_params
from sim.config.unkind import effects
from sim.observers.catalogue import CATALOGUE

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
IN_LINE = re.compile(r"`(bench [^`\n]*)`")
AT_START = re.compile(r"^(?:\S+/)?(bench [^#\n]*)", re.MULTILINE)


def commands(page: Path) -> list[str]:
    """Every `bench …` of a page: in code blocks and in running text."""
    text = page.read_text()
    blocks = re.findall(r"```(?:sh)?\n(.*?)```", text, re.DOTALL)
    lines = [part.strip() for block in blocks for line in block.splitlines() for part in line.split("&&")]
    found = [match.group(1) for line in lines if (match := AT_START.match(line))]
    return found + IN_LINE.findall(re.sub(r"```.*?```", "", text, flags=re.DOTALL))


def known_options(command: click.Command) -> set[str]:
    """Of a command, and of those in it."""
    found = {"--help", "-h"} | {name for one in command.params for name in (*one.opts, *one.secondary_opts)}
    within = command.commands.values() if isinstance(command, click.Group) else ()
    return found.union(*map(known_options, within))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_bench_commands_exist_with_their_options(page: Path) -> None:
    for text in commands(page):
        words = [word for word in shlex.split(text) if word not in ("…", "...")]
        if len(words) == 1 or words[1].startswith("-"):
            assert set(words[1:]) <= {"--help", "--version"}, text
            continue
        command = cli.get_command(click.Context(cli), words[1])
        assert command is not None, text
        arguments = words[2:]
        if isinstance(command, click.Group) and arguments:
            command = command.get_command(click.Context(command), arguments.pop(0))
            assert command is not None, text
        options = {word.partition("=")[0] for word in arguments if word.startswith("-")}
        assert options <= known_options(command), f"{page.name}: {text}"
        if not any(word in text for word in ("…", "TARGET", "FILE")):
            context = click.Context(command, help_option_names=["-h", "--help"])  # click keeps the first ones
            command.make_parser(context).parse_args(arguments)


def test_the_readme_has_commands_at_all() -> None:
    found = commands(ROOT / "README.md")
    assert "bench live" in found
    assert len(found) >= 8


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_options_named_in_running_text_exist(page: Path) -> None:
    plugin = (ROOT / "bench" / "accept" / "plugin.py").read_text()
    every = {"--version", *re.findall(r'"(--[a-z-]+)"', plugin)}
    for name in cli.list_commands(click.Context(cli)):
        command = cli.get_command(click.Context(cli), name)
        assert command is not None
        every |= known_options(command)
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    assert set(re.findall(r"`(--[a-z][a-z-]*)", text)) <= every


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_pictures_are_there(page: Path) -> None:
    for link in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text()):
        if "://" not in link:
            assert (page.parent / link).exists(), link


def test_both_ci_commands_stand_in_the_readme() -> None:
    text = (ROOT / "README.md").read_text()
    for name, ends in (("show", "bench live"), ("test", "pytest -n 3")):
        match = re.search(rf"<!-- ci: {name} -->\n```sh\n(.+)\n```", text)
        assert match, name
        assert match.group(1).endswith(ends)
        assert "pip install" in match.group(1)


def generator_of(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    generator = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(generator)
    return generator


def test_the_page_of_the_effects_is_what_its_generator_makes_and_has_all_effects_and_observers() -> None:
    generator = generator_of("make_effects")
    numbers = json.loads(generator.NUMBERS.read_text())
    assert (ROOT / "docs" / "effects.md").read_text() == generator.page(numbers)  # else: python docs/make_effects.py
    assert len(numbers["effects"]) >= 3
    for of in numbers["effects"].values():
        assert of["kind"].keys() == CATALOGUE.keys()
        assert of["costs"].keys() == effects(load_params()).keys() | {"all of it"}
    assert numbers["motors"].keys() == {"", *motors()}
    for benches in numbers["motors"].values():
        assert benches["kind"].keys() == benches["unkind"].keys() == CATALOGUE.keys()


def test_the_pages_of_the_kalman_filter_have_the_figures_of_the_last_benchmark_and_of_the_drawn_cases() -> None:
    generator = generator_of("make_edge_kalman")  # else: python docs/make_edge_kalman.py
    assert generator.PAGE.read_text() == generator.page()
    assert generator.MISSES.read_text() == generator.misses()


def test_a_run_of_the_effects_gives_the_page_its_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "docs")
    generator = generator_of("make_effects")
    numbers = json.loads(generator.NUMBERS.read_text())
    found = generator.errors(None, {})
    assert found.rms == pytest.approx(numbers["effects"][""]["kind"], abs=0.02)
    assert found.largest == pytest.approx({k: of[1] for k, of in numbers["motors"][""]["kind"].items()}, abs=0.1)


def test_the_page_of_the_observers_is_what_its_generator_makes_of_words_and_numbers() -> None:
    generator = generator_of("make_observers")
    text = (ROOT / "docs" / "observers.md").read_text()
    assert text == generator.page()  # else: python docs/make_observers.py --page
    for name in CATALOGUE:  # a section for each, and no other figures than the page shows
        assert f"\n## {name}\n" in text
    shown = set(re.findall(r"\]\(observers/(\w+\.png)\)", text))
    assert shown == {path.name for path in (ROOT / "docs" / "observers").glob("*.png")}
    assert shown >= {f"{name}.png" for name in CATALOGUE}


@pytest.mark.parametrize(("name", "speeds", "lo", "hi"), [
    ("average_speed", (50, 100, 200, 500, 1000, 2000, 3000), 0.98, 1.02),
    ("sector_centre", (50, 100, 200, 500, 1000, 2000, 3000), 0.99, 1.01),
    ("lookup_table", (50, 100, 200, 500, 1000, 2000, 3000), 0.8, 1.2),
    ("hall_vector", (50, 100, 200, 500, 1000), 0.95, 1.06),
    ("programmable_filter", (50, 100, 200, 500, 1000, 2000, 3000), 0.95, 1.08),
    ("vector_tracking", (200, 500, 1000, 2000, 3000), 0.9, 1.03),
])  # fmt: skip
def test_the_measured_errors_of_the_observers_are_those_that_the_page_computes(name, speeds, lo, hi) -> None:
    numbers = json.loads((ROOT / "docs" / "observers" / "numbers.json").read_text())
    for rpm in map(str, speeds):
        theory = numbers["theory"].get(name) or numbers["theory"]["by_speed"][rpm].get(name)
        if name == "vector_tracking":
            measured, computed = numbers["by_load"][name][rpm]["4"]["std"], theory["4"]
        else:
            measured = numbers["by_speed"][name][rpm]["std"]
            computed = theory if name == "lookup_table" else theory["std"]
        assert lo < measured / computed < hi, (rpm, measured, computed)


def test_the_order_of_the_observers_is_the_one_that_the_page_speaks_of() -> None:
    numbers = json.loads((ROOT / "docs" / "observers" / "numbers.json").read_text())
    std = {name: {int(rpm): row["std"] for rpm, row in rows.items()} for name, rows in numbers["by_speed"].items()}
    without_edges = set(std) - {"lookup_table", "edge_kalman", "vector_tracking_q15", "load_angle"}
    for rpm in std["vector_tracking"]:
        assert min(std, key=lambda name: std[name][rpm]) in {"lookup_table", "edge_kalman"}, rpm
        leads = min(without_edges, key=lambda name: std[name][rpm]) == "vector_tracking"
        assert leads == (rpm <= 200), rpm
    swinging = {name for name, row in numbers["in_loop"].items() if "swings" in str(row["words"])}
    assert swinging == {"average_speed", "sector_centre", "lookup_table", "programmable_filter"}
    assert "trips" not in str(numbers["in_loop"])


def test_the_page_of_conformance_has_all_checks() -> None:
    assert (ROOT / "docs" / "conform.md").read_text() == generator_of("make_conform").page()
    # else: python docs/make_conform.py
