"""Rerun: the live view of a run, and a recorded one in it. The only package that imports rerun.

    schema      names, units and storage of everything that is logged; imports no rerun
    blocks      collects what arrives into blocks of about 50 ms
    log         writes blocks as rerun data
    dashboard   the views (blueprint)
    sinks       LiveSink: a thread and a stream of its own
    viewer      starts, watches and ends viewer processes
    viewing     shows a recorded run, or a part of it

Importing this package costs nothing; `log`, `dashboard` and `viewing` import rerun (0.35 s), the others only once they
are used. Rerun's own log on standard error is off unless RUST_LOG asks for it: what matters in it is said by our
errors.
"""

import os

from bench.errors import ViewerError

os.environ.setdefault("RUST_LOG", "off")  # read by rerun when it is imported

_OFF = ("0", "false", "off")  # what rerun takes for it, in letters of any size


def require_rerun(instead: str = "") -> None:
    """Raise ViewerError where the environment switches rerun off; `instead`: what can be done without it."""
    if (value := os.environ.get("RERUN", "")).lower() in _OFF:
        raise switched_off(f"RERUN={value}", instead)


def switched_off(why: str, instead: str = "") -> ViewerError:
    """That rerun is, and what to do."""
    return ViewerError(f"rerun is switched off by {why} in the environment: unset RERUN{instead and f', or {instead}'}")
