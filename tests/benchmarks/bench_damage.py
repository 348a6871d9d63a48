"""Recordings whose writer was killed, and recordings that were damaged: python -m tests.benchmarks damage"""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

from bench.record.reader import Run
from bench.record.sink import RunSink
from sim.config.params import load_params
from sim.ports.virtual import VirtualLink
from tests.bench.collect import Bench
from tests.bench.damage import Whole, unfinished
from tests.benchmarks.bench_kills import LATEST, SHORT, drive, kill
from tests.benchmarks.bench_sim import run_against
from tests.benchmarks.table import Row

RECORD = """
import sys, time
sys.path[:0] = [{tests!r}]
import synthetic
from bench.record import sink, writer
writer.ROW_GROUP, writer.SEGMENT, writer.PIECE = 0.2, 0.5, 0.05
made = synthetic.SyntheticRun(20.0)
file = sink.RunSink(sys.argv[1], synthetic.run_info())
started = time.monotonic()
for chunk in made.chunks(160):
    file.take(chunk)
    if hasattr(chunk, "raw"):
        print(int(chunk.tick[-1]), flush=True)
        time.sleep(max(0.0, (chunk.tick[-1] - made.tick[0]) / 2e7 - (time.monotonic() - started)))
"""


def killed(times: int, folder: Path) -> Iterator[Row]:
    """kill -9 of `bench live`, and of a recorder whose files end twice a second, so that it comes in their midst."""
    dice = random.Random(11)
    lacks, unopened = [], 0
    with drive() as (sim, proxy):
        for n in range(times):
            each = kill(signal.SIGKILL, dice.uniform(0.0, LATEST), sim, proxy, folder / f"live{n}.run")
            lacks.append(each.short)
    yield Row(f"kill -9 of bench live, {times} times: most that a recording lacks", max(lacks), "s", SHORT, True)
    lacks.clear()
    code = RECORD.format(tests=str(Path(__file__).parents[1] / "bench" / "view"))
    for n in range(times):
        file = folder / f"short{n}.run"
        recorder = subprocess.Popen([sys.executable, "-c", code, str(file)], stdout=subprocess.PIPE, text=True)
        assert recorder.stdout is not None
        recorder.stdout.readline()
        timer = threading.Timer(dice.uniform(0.0, LATEST), recorder.kill)
        timer.start()
        ticks = [int(line) for line in recorder.stdout if line.strip().isdigit()]
        recorder.wait()
        run = Run(file)
        samples = run.samples
        unopened += bool(run.damage) or run.ended
        lacks.append(((ticks or [int(samples.tick[-1])])[-1] - int(samples.tick[-1])) / run.info.tick_hz)
    yield Row("kill -9 of a recorder with files of half a second: most that is missing", max(lacks), "s", SHORT, True)
    yield Row("runs of it that are damaged, or say that they came to their end", unopened, "", 0, at_most=True)


def damaged(times: int, folder: Path) -> Iterator[Row]:
    """Bits flipped and files cut, of a run that has ended and of one that was killed, both with a minute in files."""
    seconds = 2.0 if times < 100 else 75.0
    rig = Bench(VirtualLink.of(load_params()))
    file = folder / "ended.run"
    sink = RunSink(file, rig.info(), wait=True)
    rig.client.sinks = [sink]
    run_against(rig, 0.1, None)
    rig.drive.speed(100.0)
    rig.client.run_for(seconds)
    rig.rest()
    sink.close()
    for whole, kind in ((Whole(file), "ended"), (Whole(unfinished(Run(file), folder / "killed.run")), "was killed")):
        dice = random.Random(17)
        trials = [whole.trial(dice, folder) for _ in range(times)]
        for trial in trials:
            if not (trial.told and trial.same):
                print(f"  {trial}")
        missed = sum(not trial.told for trial in trials)
        yield Row(f"bit flips and cuts of a run that {kind}, of {times}: not told", missed, "", 0, at_most=True)
        silent = sum(not trial.same for trial in trials)
        yield Row(f"bit flips and cuts of a run that {kind}, of {times}: read differently", silent, "", 0, at_most=True)


def rows(short: bool) -> Sequence[Row]:
    """A hundred of each."""
    with tempfile.TemporaryDirectory() as name:
        folder, times = Path(name), 2 if short else 100
        return [*damaged(times, folder), *killed(times, folder)]
