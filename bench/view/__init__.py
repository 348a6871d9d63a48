"""Rerun: the live view and the recording of a run. The only package that imports rerun.

    schema      names, units and storage of everything that is logged; imports no rerun
    blocks      collects what arrives into blocks of about 50 ms
    log         writes blocks as rerun data
    dashboard   the views (blueprint)
    sinks       LiveSink: a thread and a stream of its own
    viewer      starts, watches and ends viewer processes
    salvage     finds the end of what was written whole in a file that was cut short
    recording   reads a recorded run back, exactly

Importing this package costs nothing; `log`, `dashboard` and `recording` import rerun (0.35 s), the others only once
they are used. Rerun's own log on standard error is off unless RUST_LOG asks for it: what matters in it is said by our
errors.
"""

import os

os.environ.setdefault("RUST_LOG", "off")  # read by rerun when it is imported
