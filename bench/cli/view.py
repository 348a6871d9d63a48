"""`bench view`: a recorded run in rerun's viewer."""

from __future__ import annotations

import tempfile
from contextlib import suppress
from pathlib import Path

import click

from bench.cli.files import RUN, check_files
from bench.cli.number import FROM_HELP, TO_HELP, Number
from bench.cli.streams import note


@click.command("view")
@click.argument("run", metavar="RUN", type=RUN)
@click.option("--from", "begin", metavar="S", type=Number(), help=FROM_HELP)
@click.option("--to", "end", metavar="S", type=Number(), help=TO_HELP)
@click.option("--viewer", type=click.Choice(["auto", "native", "web"]), default="auto", show_default=True,
              help="auto: native if there is a display, otherwise web.")  # fmt: skip
@click.option("--web-port", metavar="PORT", type=click.IntRange(1, 65535),
              help="Port of the web viewer [default: first free port from 9090].")  # fmt: skip
def command(run: Path, begin: float | None, end: float | None, viewer: str, web_port: int | None) -> None:
    """Open a recorded run, or part of it, in rerun, with the same dashboard as live.

    Up to one minute is shown sample by sample. A longer part is shown as minima and maxima over 50 ms or more, and
    sample by sample around faults, marks and the end; zoom in with --from and --to. The run may still be recording.

    \b
    Examples:
      bench view a.run
      bench view a.run --from 3600 --to 3620
    """
    check_files({}, False, [run])
    from bench.recording.reader import Run
    from bench.recording.times import ticks_of
    from bench.rerunio.viewer import chosen, serve_file
    from bench.rerunio.viewing import lot_for, write_rrd

    opened = Run(run)
    first, last = ticks_of(opened, begin, end)
    with tempfile.TemporaryDirectory(prefix="hallbench-") as folder:
        file = Path(folder, f"{run.name}.rrd")
        kind = chosen(viewer)
        write_rrd(opened, file, first, last, lot=lot_for(kind))
        for words in opened.damage:
            note(f"warning: {words}")
        process, address = serve_file(file, kind, web_port)
        try:
            if address:
                note(f"dashboard: {address} (Ctrl-C ends it)")
            with suppress(KeyboardInterrupt):
                process.wait()
        finally:
            process.close()
