"""How fast other open simulators run a comparable drive, see `peer_simulators.py`.

`python -m tests.benchmarks peers`. They need the extra `benchmark`; with `$PEER_PYTHON` they run under another
interpreter, should they not go with the rest. Where one of them is missing the part is left out.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

from tests.benchmarks.commands import output
from tests.benchmarks.table import LeftOut, Row, speed


def rows(short: bool) -> list[Row]:
    """Their figures, as multiples of real time."""
    script = Path(__file__).with_name("peer_simulators.py")
    printed = output([os.environ.get("PEER_PYTHON", sys.executable), str(script), "0.02" if short else "0.5"])
    results = json.loads(printed.splitlines()[-1])
    if missing := [f"{name}: {result['error']}" for name, result in results.items() if "error" in result]:
        raise LeftOut("; ".join(missing))
    return [
        speed(f"{name} {result['version']}: {result['note']}", result["x_real_time"], "x real time")
        for name, result in results.items()
    ]
