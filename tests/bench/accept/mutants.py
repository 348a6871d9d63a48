"""Observers that are wrong in one line, for tests: the simulated drive runs them in place of its own."""

from __future__ import annotations

import hashlib
import importlib.util
import sys
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from types import ModuleType
from unittest.mock import patch

from sim.drive.machine import SOURCES
from sim.observers.entry import Entry


@cache
def _module(name: str, old: str, new: str, directory: Path) -> ModuleType:
    """The observer module `name` with `new` in the place of `old`, which it must have once."""
    original = importlib.util.find_spec(f"sim.observers.{name}")
    assert original.origin is not None
    text = Path(original.origin).read_text()
    assert text.count(old) == 1, f"sim/observers/{name}.py has changed: '{old}' is in it {text.count(old)} times"
    file = directory / f"wrong_{name}_{hashlib.sha256(new.encode()).hexdigest()[:12]}.py"
    file.write_text(text.replace(old, new))
    spec = importlib.util.spec_from_file_location(file.stem, file)
    module = sys.modules[file.stem] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def mutant(
    observer: str, old: str, new: str, directory: Path, module: str = "", **make: bool
) -> AbstractContextManager[object]:
    """While it is entered, simulated drives have `observer` with that change in its module, or in another `module`.

    `make`: what `make_params` of that module takes beside the usual.
    """
    wrong = _module(module or observer, old, new, directory)
    number, entry = next((number, entry) for number, entry in SOURCES.items() if entry.name == observer)
    changed: Entry = replace(
        entry,
        init=wrong.init,
        step=wrong.step,
        make=partial(wrong.make_params, **make) if make else wrong.make_params,
        settings=wrong.Settings,
    )
    return patch.dict(SOURCES, {number: changed})
