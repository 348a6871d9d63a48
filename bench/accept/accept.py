"""`bench accept` without the command line: the shipped suite, or tests of the user's own, run by pytest.

pytest does the running, the selecting (`-k`) and the JUnit file; this module gives it the words to say meanwhile. It
knows no drive and no measurement.
"""

from __future__ import annotations

import gc
import os
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from bench.accept import plugin
from bench.accept.collected import RESULT, SCREEN, Screen, is_acceptance_test
from bench.accept.measuring import value_text
from bench.accept.results import Measurement, RunResult, SpecUse, Verdict, gaps, tightest
from bench.accept.session import LIMITS_ELSEWHERE
from bench.errors import BenchError
from bench.rig.connection import SIM, target_of
from bench.rig.ratings import TOLD_BY
from bench.rig.settings import read_settings, write_rated
from bench.signal.limits import RATED_CURRENT, RATED_SPEED, UNITS
from bench.signal.verdict import WORDS
from protocol.text import counted

SUITE = Path(__file__).with_name("suite")
FOREIGN = ("PYTEST_ADDOPTS", "PYTEST_DISABLE_PLUGIN_AUTOLOAD")  # what a user's environment asks of another pytest
WITHOUT = ("terminal", "cacheprovider", "unraisableexception")
"""Plug-ins of pytest: the teller speaks, nothing is kept, and what Python drops may be a Ctrl-C (`none_dropped`)."""
SAME_NAME = ("target", "report", "json", "config", "operator", "motor", "spec", "seed")
"""Fields of AcceptOptions that are options of the plug-in, with `--bench-` before them."""
RATED = {"speed_rpm": ("rated-speed", "RPM"), "current": ("rated-current", "A")}
"""Options that say what the motor is rated for, by keys of [rated]."""
WHICH = {RATED_SPEED: "mechanical", RATED_CURRENT: "peak"}
MOST_NAMES = 4  # of measurements, in the lines at the end
MOST_BAD = 8  # measurements of a test that are told one by one


@dataclass(frozen=True)
class AcceptOptions:
    """What `bench accept` was asked for."""

    target: str | None = None
    tests: tuple[Path, ...] = ()
    """Files or directories of the user's own; empty: the shipped suite."""
    keyword: str | None = None
    report: Path | None = None
    junit: Path | None = None
    json: Path | None = None
    bench_toml: Path | None = None
    config: Path | None = None
    operator: str | None = None
    motor: str | None = None
    spec: str | None = None
    """A file, or the name of a shipped one."""
    seed: int | None = None
    """Of the simulated drive's noise; None: the same for each test in every run."""
    jobs: int = 1
    yes: bool = False
    allow_skipped: bool = False
    list_only: bool = False
    rated_speed: float | None = None
    rated_current: float | None = None
    """What the motor is rated for, r/min and A: written to bench.toml."""


class _Teller:
    """Listens to pytest and tells the screen, one line a test and one for each measurement that did not pass."""

    def __init__(self, screen: Screen, list_only: bool) -> None:
        self.screen = screen
        self.run: RunResult | None = None
        self.problems: list[str] = []
        """What kept pytest from running tests, in one line each."""
        self.listed = False
        self._list_only = list_only
        self._total = 0
        self._done = 0

    def pytest_configure(self, config: pytest.Config) -> None:
        """Who asks something needs the screen."""
        config.stash[SCREEN] = self.screen

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        """A file that cannot be read as tests."""
        if report.failed:
            lines = [line for line in report.longreprtext.splitlines() if line.strip()]
            self.problems.append(
                f"{report.nodeid}: {lines[-1].removeprefix('E ').strip() if lines else 'no reason given'}"
            )

    def pytest_collection_finish(self, session: pytest.Session) -> None:
        """Show what there is, where only that was asked for."""
        gc.freeze()  # modules and tests, which each full collection would go through again
        items = [item for item in session.items if is_acceptance_test(item)]
        self._total = len(items)
        if self._list_only and items:
            try:
                if plugin.session_of(session.config).target == SIM:
                    plugin.session_of(session.config).look()
                spec = plugin.session_of(session.config).spec
                for name, limits in plugin.session_of(session.config).declared(items):
                    self.screen.listed(name, limits, spec.band(name) if spec else None)
                    self.listed = True
                plugin.session_of(session.config).check_names()
            except BenchError as error:
                self.problems.append(str(error))

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """Say which test runs."""
        self.screen.progress(f"{self._done + 1} of {self._total or '?'}: {nodeid.rpartition('::')[2]}")

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Say how it ended."""
        carried = getattr(report, RESULT, None)
        if carried is None:
            if report.failed and not hasattr(report, RESULT):
                self.screen.note(f"ERROR   {report.nodeid}: not an acceptance test, but it failed")
            return
        self._done += 1
        result = carried.result
        text = f"{result.verdict:7} {result.name}"
        if result.verdict is Verdict.PASS:
            text += _tightest(result.measurements)
        elif result.why:
            text += f": {result.why}"
        self.screen.note(text)
        bad = [
            m for m in result.measurements if m.verdict not in (Verdict.PASS, Verdict.SKIPPED) and m.value is not None
        ]
        for measurement in bad[:MOST_BAD]:
            self.screen.note(f"        {measurement.name} = {value_text(measurement)}")
        if len(bad) > MOST_BAD:
            self.screen.note(f"        … and {len(bad) - MOST_BAD} more")

    def pytest_internalerror(self, excrepr: Any) -> None:
        """A defect of ours, or of a plug-in."""
        self.problems.append(str(excrepr).strip().splitlines()[-1])

    @pytest.hookimpl(trylast=True)
    def pytest_unconfigure(self, config: pytest.Config) -> None:
        """Take the result out of the session."""
        if plugin.SESSION in config.stash:
            self.run = config.stash[plugin.SESSION].run


def accept(options: AcceptOptions, screen: Screen) -> tuple[RunResult | None, int]:
    """Run; returns the result (None where only names were asked for) and the exit code.

    Raises BenchError when no test could be run.
    """
    for path in options.tests:
        if not path.exists():
            raise BenchError(f"no tests at {path}")
    write_rated(options.bench_toml, {"speed_rpm": options.rated_speed, "current": options.rated_current})
    target = target_of(options.target, read_settings(options.bench_toml))
    if options.jobs > 1 and target != SIM:
        raise BenchError(f"{target} cannot be tested by {options.jobs} processes at once: leave out --jobs")
    if options.jobs > 1 and find_spec("xdist") is None:
        raise BenchError("--jobs needs pytest-xdist: pip install pytest-xdist")
    teller = _Teller(screen, options.list_only)
    try:
        with _no_foreign_settings():
            code = pytest.main(_arguments(options), plugins=[teller])
    finally:
        gc.unfreeze()
    gc.collect()  # who runs it often holds the samples of all runs otherwise: they are in circles
    if teller.problems:
        raise BenchError("; ".join(teller.problems))
    if options.list_only and teller.listed:
        return None, 0
    if teller.run is None or not teller.run.tests:
        if teller.run is not None and teller.run.error:
            raise BenchError(teller.run.error)
        if code == pytest.ExitCode.INTERRUPTED:
            raise KeyboardInterrupt
        if code in (pytest.ExitCode.NO_TESTS_COLLECTED, pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
            chosen = f" matches -k '{options.keyword}'" if options.keyword else " uses the bench's fixtures"
            raise BenchError(f"no test{chosen}; bench accept --list shows all")
        raise BenchError(f"pytest could not start (exit code {int(code)}): see above")
    # pytest may have failed where no acceptance test did: in another test, or in writing a file
    return teller.run, teller.run.exit_code or (0 if code == pytest.ExitCode.OK else 2)


@contextmanager
def _no_foreign_settings() -> Iterator[None]:
    """Without what the environment asks of the user's own pytest: some of it stops this one."""
    taken = {name: os.environ.pop(name) for name in FOREIGN if name in os.environ}
    try:
        yield
    finally:
        os.environ.update(taken)


def _arguments(options: AcceptOptions) -> list[str]:
    paths = [path.absolute() for path in options.tests or (SUITE,)]
    inside = all(path.is_relative_to(Path.cwd()) for path in paths)
    root = "." if inside else os.path.commonpath([path if path.is_dir() else path.parent for path in paths])
    absolute = Path(root).absolute()
    top = [absolute, *(folder for folder in absolute.parents if (folder / "conftest.py").exists())][-1]
    places = ["--rootdir", root, "--confcutdir", str(top)]  # else pytest lists every folder above
    # no capture: a person may be asked; no settings of another project
    arguments = [word for name in WITHOUT for word in ("-p", f"no:{name}")]
    arguments += ["-s", "-c", os.devnull, *places, *map(str, paths)]
    named = {f"--bench-{name}": getattr(options, name) for name in SAME_NAME}
    named |= {"--bench-toml": options.bench_toml, "-k": options.keyword, "--junitxml": options.junit}
    named |= {"-n": options.jobs if options.jobs > 1 else None}
    flags = {
        "--bench-yes": options.yes,
        "--bench-allow-skipped": options.allow_skipped,
        "--collect-only": options.list_only,
    }
    arguments += [word for name, value in named.items() if value is not None for word in (name, str(value))]
    return arguments + [name for name, wanted in flags.items() if wanted]


def _tightest(measurements: tuple[Measurement, ...]) -> str:
    text = f"  {counted(len(measurements), 'measurement')}"
    if (closest := tightest(measurements)) is None:
        return text
    return f"{text}, tightest {closest.limits.name} = {closest.value:.4g} [{closest.nearest}]"


def closing_lines(run: RunResult) -> list[str]:
    """How the run ended, in a few lines; what was not tested, and unsafe outputs, come before all else."""
    tests = _counted([test.verdict for test in run.tests], "test")
    if all(test.verdict is Verdict.PASS for test in run.tests):
        tests += " passed"
    measured = _counted([m.verdict for m in run.measurements], "measurement")
    lines = [run.unsafe] if run.unsafe else []
    for gap in gaps(run.tests):
        if gap.verdict is Verdict.SKIPPED:
            names = ", ".join(test.name for test in gap.tests)
            lines.append(f"not tested: {counted(gap.measurements, 'measurement')}: {gap.why} ({names})")
    lines.append(f"{run.verdict}: {tests}, {measured}, {run.wall_seconds:.0f} s on {run.target}")
    if run.verdict is Verdict.INCOMPLETE:
        nothing = all(test.verdict is Verdict.SKIPPED for test in run.tests)
        passed = "all that was tested passed; --allow-skipped makes that a PASS"
        lines.append("nothing was tested" if nothing else passed)
    lines += _rated_lines(run)
    if LIMITS_ELSEWHERE in run.rig:
        lines.append(f"bench.toml has limits for tests that are not in this run, {run.rig[LIMITS_ELSEWHERE]}")
    if run.spec is not None:
        lines += _spec_lines(run.spec, [m.failed for m in run.measurements].count("specified"))
    if run.error and run.error != run.unsafe:
        lines.append(f"error: {run.error}")
    return lines


def _rated_lines(run: RunResult) -> list[str]:
    """What bench.toml lacks of what the motor is rated for, ready to be filled in and pasted."""
    skipped = " ".join(gap.why for gap in gaps(run.tests))
    lacking = [key for _, key in TOLD_BY.values() if f"[rated] {key} in bench.toml" in skipped]
    if not lacking:
        return []
    options = " ".join(f"--{name} {form}" for key, (name, form) in RATED.items() if key in lacking)
    return [
        f"what the motor is rated for is not told: {options} says it, and writes it to bench.toml; or write there",
        "    [rated]",
        *(
            f"    {key} =    # {UNITS[what]}, {WHICH[what]}, by the motor's data sheet"
            for what, (_, key) in TOLD_BY.items()
            if key in lacking
        ),
    ]


def _spec_lines(use: SpecUse, failed: int) -> list[str]:
    """What a spec had to say; the parameters and names that are too many are in JSON and report."""
    text = f"as specified by {use.name} ({use.about}): "
    text += f"{counted(failed, 'measurement')} within limits and not as specified" if failed else "all measurements"
    lines = [f"not as specified: {line}" for line in use.unlike] + [text, *use.notes]
    for names, what in ((use.without, "measured and not in it"), (use.unused, "in it and not measured")):
        if names:
            more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
            lines.append(f"{len(names)} {what}: {', '.join(names[:MOST_NAMES])}{more}")
    return lines + ([f"cannot be told here, if it is off by less: {use.untold}"] if use.resolution else [])


def _counted(verdicts: list[Verdict], what: str) -> str:
    """How many, and unless all passed how many of each verdict, the worst first."""
    text = counted(len(verdicts), what)
    if all(verdict is Verdict.PASS for verdict in verdicts):
        return text
    counts = Counter(verdicts)
    return f"{text} ({', '.join(f'{counts[v]} {WORDS[v]}' for v in WORDS if v in counts)})"
