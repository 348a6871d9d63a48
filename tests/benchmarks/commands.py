"""Commands that parts of the benchmark run as processes of their own."""

from __future__ import annotations

import os
import shlex
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path


def output(command: Sequence[str], folder: Path | None = None, environment: Mapping[str, str] | None = None) -> str:
    """What a command prints, run in `folder`, with `environment` on top of ours.

    Raises RuntimeError, with all that it said, if it fails.
    """
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=folder, env={**os.environ, **(environment or {})}, check=False
    )
    if done.returncode:
        raise RuntimeError(f"{shlex.join(command)}: exit code {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout
