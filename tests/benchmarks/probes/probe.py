"""What the probes have in common. A probe measures one part of any commit: it is run as a script with that tree first
on the path, prints one JSON object of costs, and takes names of today or, where a tree has not got them, of then.

`python PROBE TREE FOLDER [--short]`: FOLDER is the tree's own, and kept between rounds.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import math
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType

TREE, FOLDER = (Path(name).resolve() for name in sys.argv[1:3])
SHORT = "--short" in sys.argv[3:]
RUN = "x.run" if any((TREE / "bench" / name).is_dir() for name in ("record", "recording")) else "x.rrd"
"""What a recording may be called."""


def newest(*names: str) -> ModuleType:
    """The first of these modules that there is. Raises ImportError where there is none."""
    for name in names:
        try:
            return importlib.import_module(name)
        except ModuleNotFoundError as missing:
            if missing.name is None or not (name == missing.name or name.startswith(f"{missing.name}.")):
                raise
    raise ImportError(f"none of {', '.join(names)} in {TREE}")


def there(*names: str) -> bool:
    """Whether this tree has one of these modules."""
    try:
        newest(*names)
    except ModuleNotFoundError:
        raise
    except ImportError:
        return False
    return True


def cpu() -> float:
    """CPU time until now, s: of this process with all threads, and of the children that have ended."""
    return time.process_time() + children_cpu()


def children_cpu() -> float:
    """CPU time of children that have ended, s."""
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    return spent.ru_utime + spent.ru_stime


def best(repeat: int, action: Callable[[], object]) -> float:
    """The least CPU time of so many runs, s."""
    least = math.inf
    for _ in range(repeat):
        begun = cpu()
        action()
        least = min(least, cpu() - begun)
    return least


def other(option: str) -> dict[str, float]:
    """What this probe tells in a process of its own, with one option more."""
    done = subprocess.run([sys.executable, *sys.argv, option], stdout=subprocess.PIPE, text=True, check=True)
    found: dict[str, float] = json.loads(done.stdout)
    return found


def tell(costs: Mapping[str, float]) -> None:
    """Print them, if the product was that of the tree."""
    for name in ("bench", "protocol", "sim"):
        module = sys.modules.get(name)
        if module is not None and not Path(str(module.__file__)).resolve().is_relative_to(TREE):
            raise SystemExit(f"{name} is {module.__file__}, not of {TREE}")
    print(json.dumps(dict(costs)))
    sys.stdout.flush()
    os._exit(0)  # nothing that a tree does at its end is measured
