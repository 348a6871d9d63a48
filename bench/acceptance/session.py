"""An acceptance run inside pytest: from the collected tests to the result that reports are made of.

With several worker processes each has a session of its own; results come to the one that collects the reports. Nothing
here draws or measures.
"""

from __future__ import annotations

import json
import os
import platform
import re
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, replace
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import click
import pytest

from bench.acceptance import faults, plugin
from bench.acceptance.drive import DriveTripped
from bench.acceptance.loads import SPEED
from bench.acceptance.marks import announced, declared_limits, needed
from bench.acceptance.results import (
    Limits,
    ParameterValue,
    Quality,
    RunResult,
    TestResult,
    Verdict,
    result_from_json,
    to_json,
    worst,
)
from bench.acceptance.rig import Plan, Rig
from bench.acceptance.running import NotPassed, Running, value_text
from bench.acceptance.settings import Settings, read_settings
from bench.acceptance.targets import SIM, alone_on, open_target, require_agreement, target_of
from bench.errors import BenchError
from bench.interrupts import signals_as_exceptions
from protocol.errors import HbpError


class BenchSession:
    """The acceptance tests of one pytest session."""

    def __init__(self, config: pytest.Config) -> None:
        self.config = config
        try:
            self.settings = self._settings()
        except BenchError as error:
            raise pytest.UsageError(str(error)) from None
        self.target = target_of(config.option.target, self.settings)
        self.results: dict[str, TestResult] = {}
        """By node id."""
        self.about: dict[str, Any] = {}
        """Identity, parameters and rig, as plain data, from the first test that reached the drive."""
        self.began = datetime.now().astimezone()
        self.order: list[str] = []
        """Node ids of the tests, where results come from other processes."""
        self.error = ""
        self.run: RunResult | None = None
        self._interrupted = False
        self._known: list[pytest.Item] = []
        self._items: list[pytest.Item] = []
        self._names: dict[str, str] = {}
        self._phases: dict[str, _Phase] = {}
        self._held = ExitStack()
        config.pluginmanager.register(self, "hallbench-session")

    def _settings(self) -> Settings:
        option = self.config.option
        settings = read_settings(Path(option.bench_toml) if option.bench_toml else None)
        return replace(settings, config=Path(option.bench_config)) if option.bench_config else settings

    @property
    def directory(self) -> Path | None:
        """Where the report goes, if one is wanted."""
        given = self.config.option.bench_report
        return Path(given) if given else None

    @property
    def _collects(self) -> bool:
        """Whether results come together here: not in a worker."""
        return not hasattr(self.config, "workerinput")

    # -- before the first test ----------------------------------------------------------------------------------

    def know(self, items: list[pytest.Item]) -> None:
        """All tests that were found, before any is deselected."""
        self._known = items
        self._names = plugin.names_of(items)

    def prepare(self, items: list[pytest.Item]) -> None:
        """Names, limits, figures, places, lock and consent; ends the session with one line if anything is amiss."""
        self._items = items
        try:
            for name, often in Counter(self._names.values()).items():
                if often > 1:
                    raise BenchError(f"{often} tests are called '{name}', and limits go by name: rename all but one")
            self.settings.check_names(name for name, _ in self.declared(self._known))
            self._require_places()
            self._held.enter_context(signals_as_exceptions(KeyboardInterrupt))
            if self.target == SIM:
                open_target(self.target, self.settings, "").close()
            else:
                if self.config.option.bench_config:
                    raise BenchError(f"--config is for the simulated drive, not for {self.target}")
                if not self._collects:
                    raise BenchError(f"{self.target} cannot be tested by several processes at once: leave out -n")
                self._held.enter_context(alone_on(self.target))
                envelope = announced(items[0])
                for item in items[1:]:
                    envelope = envelope.join(announced(item))
                require_agreement(self.target, self.settings, envelope, self.config.option.bench_yes, self._confirm())
        except (BenchError, HbpError) as error:
            self.error = str(error)
            self._held.close()
            if self._collects:
                pytest.exit(self.error, returncode=2)  # a worker says it of each of its tests

    def _require_places(self) -> None:
        file = self.config.option.bench_json
        try:
            if self.directory is not None:
                self.directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise BenchError(f"cannot write the report to {self.directory}: {error.strerror}") from None
        for place in (self.directory, Path(file).parent if file else None):
            if place is not None and not os.access(place, os.W_OK):
                raise BenchError(f"cannot write to {place}: {'no permission' if place.is_dir() else 'no directory'}")

    def _confirm(self) -> Any:
        if not sys.__stdin__ or not sys.__stdin__.isatty():
            return None

        def confirm(question: str) -> bool:
            with self._uncaptured():
                return click.confirm(question, err=True)

        return confirm

    def _ask(self) -> Any:
        if not self.settings.person or not sys.__stdin__ or not sys.__stdin__.isatty():
            return None

        def ask(words: str) -> None:
            with self._uncaptured():
                click.prompt(f"{words}, then press Enter", default="", show_default=False, err=True)

        return ask

    @contextmanager
    def _uncaptured(self) -> Iterator[None]:
        capture = self.config.pluginmanager.getplugin("capturemanager")
        screen = self.config.stash.get(plugin.SCREEN, None)
        with nullcontext() if capture is None else capture.global_and_fixture_disabled():
            if screen is not None:
                screen.pause()
            try:
                yield
            except click.Abort:
                raise KeyboardInterrupt from None
            if screen is not None:
                screen.resume()

    def declared(self, items: list[pytest.Item]) -> Iterator[tuple[str, Limits]]:
        """Full name and limits, as they hold on this bench, of all that these tests measure."""
        for item in items:
            for limits in declared_limits(item):
                full = f"{self._names[item.nodeid]}.{limits.name}"
                yield full, self.settings.apply(full, limits)

    # -- one test -----------------------------------------------------------------------------------------------

    def running(self, item: pytest.Item) -> Running:
        """A test that is about to start. Its limits are the declared ones, or those of bench.toml."""
        name = self._names[item.nodeid]
        declared = [self.settings.apply(f"{name}.{d.name}", d) for d in declared_limits(item)]
        return Running(name, declared, self.directory / "figures" if self.directory else None)

    @contextmanager
    def rig_for(self, item: pytest.Item) -> Iterator[Rig]:
        """The bench, for one test."""
        if self.error:
            raise BenchError(self.error)
        name = self._names[item.nodeid]
        plan = Plan(
            link=lambda: open_target(self.target, self.settings, name),
            target=self.target,
            settings=self.settings,
            envelope=announced(item),
            ask=self._ask(),
            recording=self._recording(name),
            virtual=self.target == SIM,
            title=name,
        )
        if plan.recording is not None:
            plan.recording.parent.mkdir(parents=True, exist_ok=True)
        with Rig(plan) as rig:
            if not self.about:
                self.about = {
                    "identity": rig.identity(),
                    "parameters": [[p.name, p.value, p.default, p.unit] for p in rig.before],
                    "rig": rig.describe(),
                }
            yield rig
            rig.summary(_words(item.stash[plugin.RUNNING], rig.drive.changed))

    def _recording(self, name: str) -> Path | None:
        return self.directory / "recordings" / f"{_file_name(name)}.rrd" if self.directory else None

    def require(self, item: pytest.Item, rig: Rig) -> None:
        """Skip the test if the rig has not what it needs."""
        for what in needed(item):
            if (why := _missing(what, rig)) is not None:
                pytest.skip(why)

    def note_phase(self, item: pytest.Item, call: pytest.CallInfo[None], report: Any) -> None:
        """After setup, call and teardown: the worst of them is the test's verdict, made at the last."""
        phase = _judge(call, report)
        if phase.expected:  # its words say it all, a traceback would bury them
            report.longrepr = phase.why
        phase = self._phases.pop(item.nodeid, _Phase(Verdict.SKIPPED)).then(phase, call.duration)
        if call.when != "teardown":
            self._phases[item.nodeid] = phase
            return
        result = self._result(item, phase)
        setattr(report, plugin.RESULT, {"result": to_json(result), "about": self.about})
        report.user_properties.extend((m.name, value_text(m)) for m in result.measurements)
        if plugin.RIG in item.stash:  # it holds every sample of the test
            del item.stash[plugin.RIG], item.stash[plugin.RUNNING]

    def _result(self, item: pytest.Item, phase: _Phase) -> TestResult:
        running = item.stash.get(plugin.RUNNING, None) or self.running(item)
        rig = item.stash.get(plugin.RIG, None)
        if phase.verdict is not Verdict.PASS:
            running.give_up(phase.verdict, phase.why)
        doc = (getattr(item, "obj", None).__doc__ or "").strip()
        title, _, about = doc.partition("\n")
        recording = self._recording(running.name)
        kept = recording is not None and recording.exists()
        if recording is not None and kept and phase.verdict is Verdict.SKIPPED:
            recording.unlink()
            kept = False
        return TestResult(
            name=running.name,
            title=title.strip(),
            about="\n".join(line.strip() for line in about.strip().splitlines()),
            node_id=item.nodeid,
            verdict=worst((phase.verdict, *(m.verdict for m in running.measurements))),
            why=phase.why,
            measurements=tuple(running.measurements),
            figures=tuple(running.pictures),
            recording=f"recordings/{recording.name}" if kept and recording is not None else "",
            quality=rig.quality() if rig is not None else Quality(),
            parameters=dict(rig.drive.changed) if rig is not None else {},
            wall_seconds=phase.seconds,
            log=phase.log,
        )

    # -- results ------------------------------------------------------------------------------------------------

    def collect(self, report: pytest.TestReport) -> None:
        """Keep the result that a report carries; with workers it has come from another process."""
        if (result := carried_result(report)) is not None:
            self.results[report.nodeid] = result
            self.about = self.about or getattr(report, plugin.RESULT)["about"]

    def pytest_keyboard_interrupt(self) -> None:
        """Remember that somebody ended it, unless it was this session."""
        self._interrupted = not self.error

    def finish(self) -> None:
        """Let go of the target; where results come together, put them together and write what was asked for."""
        self._held.close()
        if not self._collects:
            return
        self.run = self._run()
        file = self.config.option.bench_json
        if file and Path(file).parent.is_dir():  # if not, that is the run's error
            _write(Path(file), json.dumps(to_json(self.run), indent=1) + "\n")
        if self.directory is not None and self.directory.is_dir():
            from bench.acceptance.report import write_report

            write_report(self.run, self.directory)

    def _run(self) -> RunResult:
        for item in self._items if self._interrupted else ():
            if item.nodeid not in self.results:
                self.results[item.nodeid] = self._result(item, _Phase(Verdict.ABORTED, "the run was ended"))
        order = self.order or [item.nodeid for item in self._items]
        tests = [self.results[node_id] for node_id in order if node_id in self.results]
        verdict = worst(test.verdict for test in tests)
        if self.error or not tests:
            verdict = worst((Verdict.ERROR, verdict))
        if self._interrupted:
            verdict = Verdict.ABORTED
        return RunResult(
            started=self.began.isoformat(timespec="seconds"),
            target=self.target,
            verdict=verdict,
            tests=tuple(tests),
            identity=self.about.get("identity", {}),
            parameters=tuple(ParameterValue(*values) for values in self.about.get("parameters", ())),
            rig=self.about.get("rig", {}),
            versions={
                "hallbench": version("hallbench"),
                "python": platform.python_version(),
                "numpy": version("numpy"),
                "pytest": pytest.__version__,
                "platform": platform.platform(),
            },
            wall_seconds=(datetime.now().astimezone() - self.began).total_seconds(),
            error=self.error,
        )


def carried_result(report: pytest.TestReport) -> TestResult | None:
    """The result that a report of a test's last phase carries."""
    carried = getattr(report, plugin.RESULT, None)
    return None if carried is None else result_from_json(carried["result"])


@dataclass(frozen=True, slots=True)
class _Phase:
    """How a test stands after a phase."""

    verdict: Verdict
    why: str = ""
    log: str = ""
    seconds: float = 0.0
    expected: bool = False
    """A foreseen ending, whose words are for people."""

    def then(self, later: _Phase, seconds: float) -> _Phase:
        """How it stands after a later phase, which took `seconds`: the worse of both, with the reasons of both."""
        verdict = worst((self.verdict, later.verdict))
        why = "; then ".join(phase.why.partition("\n")[0] for phase in (self, later) if phase.why)
        log = "\n\n".join(phase.log for phase in (self, later) if phase.log)
        return _Phase(verdict, why, log, self.seconds + seconds)


def _judge(call: pytest.CallInfo[None], report: Any) -> _Phase:
    if report.skipped:
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
        return _Phase(Verdict.SKIPPED, str(reason).removeprefix("Skipped: "))
    if call.excinfo is None:
        return _Phase(Verdict.PASS if call.when == "call" else Verdict.SKIPPED)
    error = call.excinfo.value
    words = str(error).strip() or type(error).__name__
    match error:
        case NotPassed():
            return _Phase(error.verdict, words, expected=True)
        case DriveTripped():
            return _Phase(Verdict.FAIL, words, expected=True)
        case BenchError() | HbpError():
            return _Phase(Verdict.ERROR, words, expected=True)
        case AssertionError() | pytest.fail.Exception():
            return _Phase(Verdict.FAIL, words, report.longreprtext)
    return _Phase(Verdict.ERROR, f"{type(error).__name__}: {words}", report.longreprtext)


def _missing(what: str, rig: Rig) -> str | None:
    """Why the rig has not `what`; None if it has."""
    kind, _, value = what.partition(":")
    node = rig.drive.node
    match kind:
        case "encoder":
            return None if rig.has_encoder else "needs an encoder: the drive streams no reference position"
        case "load":
            return None if rig.load is not None else "needs a load"
        case "load.speed":
            able = rig.load is not None and SPEED in rig.load.abilities
            return None if able else "needs a load that forces a speed"
        case "hall-faults":
            able = faults.can_insert(rig) or rig.plan.ask is not None
            return None if able else "needs a rig that inserts faults of the Hall wiring, or a person who does"
        case "hall-placement":
            return None if faults.can_place(rig) else "needs a rig that moves the Hall sensors"
        case "rate":
            enough = rig.rate >= float(value)
            return None if enough else f"needs {value} samples a second; the link carries {rig.rate:g}"
        case "channel":
            return None if value in {c.name for c in rig.channels} else f"needs the channel {value}"
        case "parameter":
            return None if node.has_parameter(value) else f"needs the drive's parameter {value}"
    known = "encoder, load, load.speed, hall-faults, hall-placement, rate:HZ, channel:NAME, parameter:NAME"
    raise BenchError(f"@needs('{what}'): there are {known}")


def _words(running: Running, changed: dict[str, float]) -> str:
    lines = [f"# {running.name}", ""]
    lines += [f"- {m.name} = {value_text(m)}" for m in running.measurements if m.value is not None]
    lines += [f"- set {name} = {value:g}" for name, value in changed.items()]
    return "\n".join(lines)


def _file_name(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9._-]+", "_", name)


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text)
    except OSError as error:
        raise pytest.UsageError(f"cannot write {path}: {error.strerror}") from None
