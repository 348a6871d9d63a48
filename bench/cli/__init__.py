"""The `bench` command. Click only: parse, call, print, exit code.

Subcommands are imported when they are called, so that `bench --help` stays quick.
"""

from __future__ import annotations

import importlib
import keyword
import os
import signal
import sys
from typing import Any, NoReturn

import click

from bench.cli.streams import OutputClosed, note, standard_streams
from bench.errors import BenchError, Interrupted
from bench.rig.interrupts import none_dropped
from protocol import __version__
from protocol.text import printable

_COMMANDS = {
    "live": "Stream a drive into rerun: watch it, spin it, record it.",
    "capture": "Capture every PWM period around a trigger or a fault, on any link.",
    "view": "Open a recorded run, or part of it, in rerun.",
    "mark": "Mark a moment in a run while another terminal records it.",
    "plot": "Draw the standard plots of a recorded run, or a motion profile.",
    "measure": "Measure between two cursors: means, extremes, slopes, frequencies.",
    "compare": "Compare two recorded runs: differences beyond noise.",
    "import": "Import recordings of other tools: CSV, VCD, sigrok, MDF 4, MATLAB, CAN",
    "export": "Export a recorded run: CSV, MDF 4, MATLAB, NumPy, rerun, Parquet.",
    "accept": "Run acceptance tests on a drive: limits, verdicts, a report.",
    "conform": "Check whether a device conforms to HBP, the protocol.",
    "commission": "Find out what an unknown motor is, each value with its interval.",
    "response": "Measure the frequency response of a loop: margins, coherence.",
    "hall": "Check the Hall sensors; learn their edge angles; read other tools' tables.",
    "replay": "Run observers on a recording, beside the drive's own.",
    "twin": "Fit the simulated drive to recordings; compare the two.",
    "study": "Run many simulated drives through the same tests: yield, causes.",
    "tune": "Tune parameters of loops and observers on many drives or on recordings.",
    "score": "Rank position observers on recordings by error, lag and cost.",
    "motor": "Describe a motor to the simulated drive: VESC, ODrive, moteus, a data sheet.",
    "sim": "Run the simulated drive on a pty, a TCP port or a CAN bus.",
    "init": "Find a drive, ask about the bench, write bench.toml.",
    "devices": "List available ports and buses, or the nodes on one.",
    "info": "Show a drive's identity, descriptor, parameters and health.",
    "param": "List, set, store, dump, load, compare and watch parameters of a drive.",
    "protocol": "Write a DBC file of the streams on a CAN bus, for other tools.",
    "completion": "Print the shell completion script.",
}


class _LazyGroup(click.Group):
    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in _COMMANDS:
            return None
        module = f"{cmd_name}_" if keyword.iskeyword(cmd_name) else cmd_name
        command = importlib.import_module(f"bench.cli.{module}").command
        assert isinstance(command, click.Command)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl(list(_COMMANDS.items()))


@click.group(cls=_LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="bench")
def cli() -> None:
    """Hardware-in-the-loop bench for PMSM drives with low-resolution Hall sensors.

    \b
    Watch the simulated drive run the paper's manoeuvres; no hardware needed:
      bench live
    Spin your own drive for 20 s and record it:
      bench live serial:/dev/ttyACM0 --speed 500 --duration 20 --save run.run
    """


def fail(message: str, code: int) -> NoReturn:
    """Print one line `error: …` on standard error and exit with `code`."""
    note(f"error: {printable(message)}")
    sys.exit(code)


def main(args: list[str] | None = None) -> Any:
    """Entry point: runs the command; every error becomes one line and an exit code that is not 0.

    Exit codes: 0 done; 1 the drive failed, or its link was lost; 2 a wrong argument, or an error of this program;
    3 the recording failed; 4 no viewer; 5 outputs may still be on; 6 acceptance incomplete; 128 + n a signal; 141
    standard output was closed. With BENCH_TRACEBACK=1 an unexpected error prints its traceback.
    """
    with standard_streams(), none_dropped():
        try:
            return cli.main(args=args, prog_name="bench", standalone_mode=False)
        except click.exceptions.Exit as exit_:
            sys.exit(exit_.exit_code)
        except click.Abort:
            fail("aborted", 130)
        except click.exceptions.NoArgsIsHelpError as error:
            error.show()
            sys.exit(error.exit_code)
        except click.UsageError as error:
            hint = f" (see {error.ctx.command_path} --help)" if error.ctx else ""
            fail(" ".join(error.format_message().split()).rstrip(".") + hint, error.exit_code)
        except click.ClickException as error:
            fail(error.format_message(), 2)
        except Interrupted as interrupt:
            fail(f"interrupted by {signal.Signals(interrupt.signum).name}", 128 + interrupt.signum)
        except OutputClosed as error:
            sys.exit(error.exit_code)
        except Exception as error:
            _explain(error)


def _explain(error: Exception) -> NoReturn:
    from protocol.errors import HbpError

    if isinstance(error, (BenchError, HbpError)):
        fail(str(error), getattr(error, "exit_code", 2))
    if type(error).__module__.startswith("sim.") and type(error).__name__ == "ConfigError":
        fail(str(error), 2)
    if os.environ.get("BENCH_TRACEBACK"):
        import traceback

        traceback.print_exception(error)
    if isinstance(error, OSError) and error.strerror:
        fail(f"{error.filename}: {error.strerror}" if error.filename else error.strerror, 2)
    words = f"{type(error).__name__}: {error}".rstrip(": ")
    fail(f"unexpected {words}; this is a bug in hallbench; set BENCH_TRACEBACK=1 for a traceback", 2)
