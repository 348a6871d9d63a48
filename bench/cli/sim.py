"""`bench sim`: the simulated drive on its own."""

from __future__ import annotations

from pathlib import Path

import click

_FILE = click.Path(dir_okay=False, path_type=Path)


@click.command("sim")
@click.option("--pty", is_flag=True, help="Behind a pseudo terminal, like a serial port (the default).")
@click.option("--tcp", metavar="HOST:PORT", help="Behind TCP, for one client at a time; port 0 takes any free one.")
@click.option("--link", metavar="PATH", type=_FILE, help="Symbolic link to the pty, kept across a replug.")
@click.option("--baud", metavar="N", type=int, help="Act as a UART of this rate (default: as a USB port).")
@click.option("--config", metavar="FILE", type=_FILE, help="TOML file with the figures that differ.")
@click.option("--set", "settings", metavar="SECTION.NAME=VALUE", multiple=True, help="One such figure; repeatable.")
@click.option("--seed", type=int, help="Seed of noise and jitter (default: another one each time).")
@click.option("--store", metavar="FILE", type=_FILE, help="Where PARAM_COMMIT keeps the parameters.")
def command(
    pty: bool,
    tcp: str | None,
    link: Path | None,
    baud: int | None,
    config: Path | None,
    settings: tuple[str, ...],
    seed: int | None,
    store: Path | None,
) -> None:
    """Run the simulated drive and load machine in real time; print the target string to connect with.

    kill -USR1 PID pulls the cable, kill -USR2 PID puts it back, under the same --link or port. Ctrl-C ends it.

    \b
    Examples:
      bench sim --pty
      bench sim --tcp 127.0.0.1:7000 --set inverter.dead_time=2e-6
    """
    if pty and tcp:
        raise click.UsageError("choose --pty or --tcp, not both")
    from sim.drive.server import ServeOptions, parse_override, serve

    overrides = dict(parse_override(text) for text in settings)
    serve(ServeOptions(tcp=tcp, link=link, baud=baud, config=config, overrides=overrides, seed=seed, store=store))
