"""What the workers of the engine's tests do: `plan` is JSON."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Sequence
from pathlib import Path

LIMIT = 60.0  # s


def tripled(plan: bytes, rows: Sequence[int]) -> bytes:
    """Three times each number, after `ms` of CPU time."""
    wanted = json.loads(plan)
    end = time.process_time() + wanted.get("ms", 0) * 1e-3 * len(rows)
    while time.process_time() < end:
        pass
    return json.dumps([3 * row for row in rows]).encode()


def held(plan: bytes, rows: Sequence[int]) -> bytes:
    """As `tripled`; the row `hold` writes this process's number into a file, and waits for another file, once."""
    wanted = json.loads(plan)
    folder = Path(wanted["folder"])
    if wanted["hold"] in rows and not (folder / "go").exists():
        (folder / "part").write_text(f"{os.getpid()}")
        (folder / "part").rename(folder / "held")
        end = time.monotonic() + LIMIT
        while not (folder / "go").exists() and time.monotonic() < end:
            time.sleep(0.01)
    return tripled(plan, rows)


def deadly(plan: bytes, rows: Sequence[int]) -> bytes:
    """As `tripled`; some rows end the process."""
    if set(json.loads(plan)["deadly"]) & set(rows):
        os._exit(9)
    return tripled(plan, rows)


def failing(plan: bytes, rows: Sequence[int]) -> bytes:
    """As `tripled`; a row raises."""
    if json.loads(plan)["failing"] in rows:
        raise ZeroDivisionError("no flux\nwhatever")
    return tripled(plan, rows)
