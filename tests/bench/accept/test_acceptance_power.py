"""Deliberate faults: they do what they say, and what the page says is caught is caught; mutants are other code."""

from __future__ import annotations

import ast
import importlib.util
import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from tests.bench.accept import mutations, power
from tests.bench.accept.sabotages import CHANGES, FAULTS, KINDS, healthy, number_of
from tests.bench.accept.switched import ROOT, Change, Place, Tree, expressions, place_of, switched


def generator() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_acceptance_power", ROOT / "docs" / "make_acceptance_power.py")
    assert spec is not None
    assert spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


NUMBERS: dict[str, Any] = json.loads((ROOT / "docs" / "acceptance-power" / "numbers.json").read_text())
CAUGHT = [name for name, entry in NUMBERS["faults"].items() if entry["limits"] or entry["specified"]]


@pytest.fixture(scope="module")
def copy() -> Tree:
    return power.tree()


@pytest.mark.campaign("sabotage")
@pytest.mark.parametrize("name", NUMBERS["faults"])
def test_a_fault_has_its_effect(name: str, copy: Tree) -> None:
    fault = FAULTS[name]
    assert fault.shown(*power.effect(copy, fault))


def run_of(copy: Tree, name: str, tests: list[str], folder: Path) -> dict[str, str]:
    """Verdicts by test of `bench accept --spec sim` on a drive with the fault, none for ""."""
    fault = FAULTS.get(name)
    keyword = " or ".join(sorted({test.replace("[", " and ").rstrip("]") for test in tests}))
    number, size, config = (number_of(fault.kind), fault.size, fault.config) if fault else (0, 0.0, healthy())
    power.accepted(copy, number, size, config, folder / "a.json", "-k", keyword, "--spec", "sim")
    return {test["name"]: test["verdict"] for test in json.loads((folder / "a.json").read_text())["tests"]}


@pytest.mark.campaign("sabotage")
@pytest.mark.long("runs tests of the suite, and compiles the copy first")
@pytest.mark.parametrize("name", CAUGHT)
def test_a_fault_that_the_page_says_is_caught_is_caught_by_a_test_that_it_names(
    name: str, copy: Tree, tmp_path
) -> None:
    entry = NUMBERS["faults"][name]
    named = [*entry["limits"], *entry["specified"]]
    verdicts = run_of(copy, name, named, tmp_path)
    assert {verdicts[test] for test in named} & {"FAIL", "ERROR"}


@pytest.mark.campaign("sabotage")
@pytest.mark.long("runs four tests of the suite twice")
def test_the_copy_without_a_fault_measures_what_the_drive_does(copy: Tree, tmp_path: Path, accepting) -> None:
    tests = ["torque_constant", "observer[edge-kalman]", "trip_over_current", "fig12_load_angle"]
    verdicts = run_of(copy, "", tests, tmp_path)
    assert verdicts == dict.fromkeys(tests, "PASS")
    own = accepting(keyword="torque_constant or observer and edge-kalman or trip_over_current or fig12_load_angle")
    measured = json.loads((tmp_path / "a.json").read_text())["tests"]
    assert {m["name"]: m["value"] for test in measured for m in test["measurements"]} == {
        name: m.value for name, m in own.measured.items()
    }


# -- the table and the page -----------------------------------------------------------------------------------------


def test_the_page_is_what_its_generator_makes_and_has_every_fault() -> None:
    made = generator()
    assert (ROOT / "docs" / "acceptance-power.md").read_text() == made.page(NUMBERS)  # else: python docs/make_…
    assert NUMBERS["faults"].keys() == FAULTS.keys()
    assert len(FAULTS) >= 80
    for name, entry in NUMBERS["faults"].items():
        assert FAULTS[name].shown(entry["healthy"], entry["found"]), name


def test_every_change_finds_its_expression_and_sizes_rise() -> None:
    for change in CHANGES:
        place_of(change, (ROOT / "sim" / f"{change.module}.py").read_text())
    for kind in KINDS.values():
        assert list(kind.sizes) == sorted(set(kind.sizes))
        assert (kind.config is None) != (kind.change is None)


def test_a_fault_without_its_effect_is_told() -> None:
    fault = next(iter(FAULTS.values()))
    healthy, wanted = 1.0, fault.kind.expected(fault.size)
    assert fault.shown(healthy, healthy + wanted)
    assert not fault.shown(healthy, healthy)
    assert not fault.shown(healthy, healthy - wanted)


# -- sources in which faults are chosen -----------------------------------------------------------------------------

TEXT = '''"""Words."""
from __future__ import annotations
def f(x: float, y: float) -> float:
    size = x - y
    return size * size + max(x, y)
def g(x: float) -> float:
    return x * 2.0
'''


def chosen(text: str, number: int, size: float) -> dict[str, Callable[..., float]]:
    found: dict[str, Any] = {"fault_number": lambda: number, "fault_size": lambda: size}
    exec(text.replace("from sim.switch import fault_number, fault_size", ""), found)
    return found


def test_each_change_is_chosen_by_its_number_those_in_one_another_too_and_none_is_the_original() -> None:
    changes = [
        Change("m", "x - y", "x + y"),
        Change("m", "size * size + max(x, y)", "SIZE"),
        Change("m", "max(x, y)", "max(y, x) + 90.0 * DEG"),
        Change("m", "x * 2.0", "x * SIZE", "g"),
    ]
    made = switched(TEXT, [(k, place_of(c, TEXT), c.new) for k, c in enumerate(changes, 1)])
    results = [(chosen(made, k, 7.0)["f"](5.0, 2.0), chosen(made, k, 7.0)["g"](3.0)) for k in range(5)]
    original = chosen(TEXT, 0, 0.0)
    assert results[0] == (original["f"](5.0, 2.0), original["g"](3.0)) == (14.0, 6.0)
    assert results[1:] == [(54.0, 6.0), (7.0, 6.0), (pytest.approx(14.0 + 1.5707963), 6.0), (14.0, 21.0)]


def test_an_expression_that_is_not_there_once_is_refused() -> None:
    for old, times in (("x", 3), ("x / y", 0)):
        with pytest.raises(ValueError, match=f"sim/m.py has changed: '{old}' is in it {times} times"):
            place_of(Change("m", old, "0.0"), TEXT)


# -- mutants --------------------------------------------------------------------------------------------------------


def test_every_mutant_of_the_drive_is_other_code_of_the_same_place_and_a_seed_draws_the_same() -> None:
    for module in mutations.modules():
        text = (ROOT / "sim" / f"{module}.py").read_text()
        places = {Place.of(node): ast.dump(node) for node in expressions(ast.parse(text))}
        for mutant in mutations.mutants_of(module):
            assert ast.dump(ast.parse(mutant.new, mode="eval").body) != ast.dump(
                ast.parse(mutant.old, mode="eval").body
            )
            assert mutant.place in places
    assert mutations.drawn(3, 30) == mutations.drawn(3, 30) != mutations.drawn(4, 30)


def test_a_mutant_of_each_sort_is_drawn() -> None:
    kinds = {mutant.kind for module in mutations.modules() for mutant in mutations.mutants_of(module)}
    assert kinds == {"sign", "operator", "comparison", "constant", "off by one", "term dropped", "arguments exchanged"}
