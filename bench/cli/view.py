"""`bench view`: a recorded run in rerun's viewer."""

from __future__ import annotations

import tempfile
from contextlib import suppress
from pathlib import Path

import click

from bench.cli.files import RUN, check_files
from bench.cli.options import part_options, viewer_option
from bench.cli.streams import note


def show_until_closed(file: Path, viewer: str, web_port: int | None, what: str) -> None:
    """Show a file in a viewer, `native` or `web`, until it is closed, or Ctrl-C."""
    from bench.view.viewer import serve_file

    process, address = serve_file(file, viewer, web_port)
    try:
        if address:
            note(f"{what}: {address} (Ctrl-C ends it)")
        with suppress(KeyboardInterrupt):
            process.wait()
    finally:
        process.close()


@click.command("view")
@click.argument("run", metavar="RUN", type=RUN)
@part_options()
@viewer_option("", "auto", "native", "web")
def command(run: Path, begin: float | None, end: float | None, viewer: str, web_port: int | None) -> None:
    """Open a recorded run, or part of it, in rerun, with the same dashboard as live.

    Up to one minute, or 60,000 samples, is shown sample by sample. A longer part is shown as minima and maxima over
    50 ms or more, and sample by sample around faults, marks and the end; zoom in with --from and --to. The run may
    still be recording.

    \b
    Examples:
      bench view a.run
      bench view a.run --from 3600 --to 3620
    """
    check_files({}, False, [run])
    from bench.record.reader import Run
    from bench.record.times import ticks_of
    from bench.view.viewer import chosen
    from bench.view.viewing import lot_for, write_rrd

    opened = Run(run)
    first, last = ticks_of(opened, begin, end)
    with tempfile.TemporaryDirectory(prefix="hallbench-", ignore_cleanup_errors=True) as folder:
        file = Path(folder, f"{run.name}.rrd")
        kind = chosen(viewer)
        write_rrd(opened, file, first, last, lot=lot_for(kind))
        for words in opened.damage:
            note(f"warning: {words}")
        show_until_closed(file, kind, web_port, "dashboard")
