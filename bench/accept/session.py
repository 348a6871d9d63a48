"""An acceptance run inside pytest: from the collected tests to the result that reports are made of.

With several worker processes each has a session of its own; results come to the one that collects the reports. Nothing
here draws or measures.
"""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Iterator
from contextlib import ExitStack, closing, contextmanager, nullcontext
from dataclasses import replace
from datetime import datetime
from functools import reduce
from pathlib import Path
from typing import Any
from zlib import crc32

import click
import pytest

from bench.accept.collected import RESULT, RIG, RUNNING, SCREEN, long_name, names_of
from bench.accept.judging import NOT_BEGUN, Phase, judge
from bench.accept.marks import announced, declared_limits, label_of, needed, rated_by
from bench.accept.measuring import Running, require_apart, value_text
from bench.accept.report_files import claim
from bench.accept.requirements import missing
from bench.accept.results import Carried, RunResult, Setup, TestResult, Verdict, to_json, worst
from bench.accept.spec import KIND, read_spec
from bench.device.client import Client
from bench.device.description import describe
from bench.device.node import Node
from bench.errors import BenchError, OutputsMayBeOn
from bench.files import RUN, STANDARD_OUTPUT, check_directory, check_output, file_name, write
from bench.record.folder import remove
from bench.rig import person
from bench.rig.connection import SIM, find_drive, load_target, open_target, target_of
from bench.rig.consent import require_agreement
from bench.rig.envelope import Envelope
from bench.rig.interrupts import signals_as_exceptions
from bench.rig.loads import OwnLoads
from bench.rig.lock import alone_on
from bench.rig.outputs import Recording
from bench.rig.quality import Quality
from bench.rig.ratings import RATING_PARAMETERS, ratings
from bench.rig.rig import Plan, Rig
from bench.rig.settings import Settings, read_settings
from bench.signal.limits import Limits
from bench.signal.versions import versions
from bench.view.markdown import escaped
from protocol.errors import HbpError

LIMITS_ELSEWHERE = "limits of other tests"
"""In the description of the rig: what bench.toml says of tests that are not in this run."""


class BenchSession:
    """The acceptance tests of one pytest session."""

    def __init__(self, config: pytest.Config) -> None:
        self.config = config
        try:
            self.settings = self._settings()
            self.spec = read_spec(config.option.bench_spec) if config.option.bench_spec else None
        except BenchError as error:
            raise pytest.UsageError(str(error)) from None
        self.target = target_of(config.option.bench_target, self.settings)
        self.results: dict[str, TestResult] = {}
        """By node id."""
        self.setup = Setup()
        self.ratings = ratings({}, self.settings.rated)
        """Of the drive, once it has been asked."""
        self.began = datetime.now().astimezone()
        self.order: list[str] = []
        """Node ids of the tests, where they run in other processes."""
        self.error = ""
        self.unsafe = ""
        self.run: RunResult | None = None
        self._interrupted = False
        self._known: list[pytest.Item] = []
        self._items: list[pytest.Item] = []
        self._names: dict[str, str] = {}
        self._elsewhere: list[str] = []
        self._phases: dict[str, Phase] = {}
        self._own_loads = OwnLoads()
        self._held = ExitStack()
        self._held.callback(self._own_loads.close)
        config.pluginmanager.register(self, "hallbench-session")

    def _settings(self) -> Settings:
        option = self.config.option
        settings = read_settings(Path(option.bench_toml) if option.bench_toml else None)
        config = Path(option.bench_config) if option.bench_config else settings.config
        return replace(
            settings,
            config=config,
            operator=option.bench_operator or settings.operator,
            motor=option.bench_motor or settings.motor,
            seed=option.bench_seed,
        )

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
        self._names = names_of(item.nodeid for item in items)

    def expect(self, node_ids: list[str], others: Collection[str]) -> None:
        """These tests run in other processes; `others` have turned out to be no acceptance tests."""
        if not self.order:
            self._held.enter_context(signals_as_exceptions(KeyboardInterrupt))
        self.order = [node_id for node_id in node_ids if node_id not in others]
        self._names = names_of(node_ids)

    def prepare(self, items: list[pytest.Item]) -> None:
        """Names, limits, figures, places, lock and consent; ends the session with one line if anything is amiss."""
        if not self._names.keys() >= {item.nodeid for item in items}:
            return  # Ctrl-C came before they had names: none of them runs, and pytest ends its collection
        self._items = items
        try:
            self.check_names()
            self._require_places()
            if self.settings.load == "person" and self._ask() is None:
                raise BenchError('load = "person" needs person = true in bench.toml and a terminal')
            self._held.enter_context(signals_as_exceptions(KeyboardInterrupt))
            if self.target == SIM:
                self.look()
            else:
                if self.config.option.bench_config:
                    raise BenchError(f"--config is for the simulated drive, not for {self.target}")
                if self.settings.seed is not None:
                    raise BenchError(f"--seed is for the simulated drive, not for {self.target}")
                if not self._collects:
                    raise BenchError(f"{self.target} cannot be tested by several processes at once: omit -n")
                self._held.enter_context(alone_on(self.target, load_target(self.settings)))
                require_agreement(
                    self.target,
                    self.settings,
                    self._most,
                    self.config.option.bench_yes,
                    self._confirm if person.at_terminal() else None,
                )
        except (BenchError, HbpError) as error:
            self.error = str(error)
            self._held.close()
            if self._collects:
                pytest.exit(self.error, returncode=2)  # a worker says it of each of its tests

    def look(self) -> None:
        """What the simulated drive is rated for. BenchError for figures that it cannot have."""
        with closing(open_target(self.target, self.settings, "")) as link:
            self._know(find_drive(Client(link), self.target))

    def _know(self, drive: Node) -> None:
        told = {name: drive.parameter(name).value for name in RATING_PARAMETERS if drive.has_parameter(name)}
        self.ratings = ratings(told, self.settings.rated)
        list(self.declared(self._known))  # limits that leave no room on this drive
        if self.spec is not None:
            kind = {name: drive.parameter(name).value for name in KIND if drive.has_parameter(name)}
            self.spec.require_kind(kind, self.target, self.ratings.words)

    def _most(self, drive: Node) -> Envelope:
        """The most that the tests ask of this drive."""
        self._know(drive)
        return reduce(Envelope.join, (announced(item, self.ratings) for item in self._items))

    def check_names(self) -> None:
        """Names that tell tests apart, and limits in bench.toml that fit them. BenchError if anything is amiss."""
        require_apart(self._names.values())
        for item in self._known:
            label_of(item)
        units = {name: limits.unit for name, limits in self.declared(self._known)}  # fails where they leave no room
        measured = {
            name: [declared.name for declared in declared_limits(item)]
            for item in self._known
            for name in (self._names[item.nodeid], long_name(item.nodeid))
        }
        self._elsewhere = self.settings.check_names(measured)
        if self.spec is not None:
            self.spec.check_names(measured, units)

    def _require_places(self) -> None:
        if self.directory is not None:
            try:
                self.directory.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise BenchError(f"report {self.directory} cannot be written: {error.strerror}") from None
            check_directory(self.directory, f"report {self.directory}")
        file = self.config.option.bench_json
        if file and Path(file) != STANDARD_OUTPUT:
            check_output(Path(file), f"results {file}", overwrite=True)

    def _confirm(self, question: str) -> bool:
        with self._uncaptured():
            try:
                return click.confirm(question, err=True)
            except click.Abort:
                raise KeyboardInterrupt from None

    def _ask(self) -> person.Ask | None:
        if not self.settings.person or not person.at_terminal():
            return None

        @contextmanager
        def ask(words: str) -> Iterator[person.Answered]:
            with self._uncaptured(), person.asked(words) as answered:
                yield answered

        return ask

    @contextmanager
    def _uncaptured(self) -> Iterator[None]:
        capture = self.config.pluginmanager.getplugin("capturemanager")
        screen = self.config.stash.get(SCREEN, None)
        with nullcontext() if capture is None else capture.global_and_fixture_disabled():
            if screen is not None:
                screen.pause()
            try:
                yield
            except KeyboardInterrupt:
                screen = None  # nothing goes on
                raise
            finally:
                if screen is not None:
                    screen.resume()

    def declared(self, items: list[pytest.Item]) -> Iterator[tuple[str, Limits]]:
        """Full name and limits, as they hold on this bench, of all that these tests measure."""
        for item in items:
            for limits in declared_limits(item):
                full, long = (f"{n}.{limits.name}" for n in (self._names[item.nodeid], long_name(item.nodeid)))
                yield full, self.settings.apply({full, long}, limits.resolved(self.ratings.told))

    # -- one test -----------------------------------------------------------------------------------------------

    def running(self, item: pytest.Item) -> Running:
        """A test that is about to start. Its limits are the declared ones, or those of bench.toml."""
        declared = dict(self.declared([item]))
        figures = self.directory / "figures" if self.directory else None
        bands = {limits.name: self.spec.band(full) for full, limits in declared.items()} if self.spec else {}
        specified = {name: band for name, band in bands.items() if band is not None}
        return Running(self._names[item.nodeid], list(declared.values()), figures, specified)

    @contextmanager
    def rig_for(self, item: pytest.Item) -> Iterator[Rig]:
        """The bench, for one test."""
        if self.error:
            raise BenchError(self.error)
        name = self._names[item.nodeid]
        plan = Plan(
            link=lambda: open_target(self.target, self._seeded(name), name),
            target=self.target,
            settings=self.settings,
            envelope=announced(item, self.ratings),
            ask=self._ask(),
            virtual=self.target == SIM,
            own_loads=self._own_loads,
        )
        channels = frozenset(w.removeprefix("channel:") for w in needed(item) if w.startswith("channel:"))
        running = item.stash[RUNNING]
        path = self.directory / "recordings" / f"{file_name(name)}{RUN}" if self.directory else None
        if path is not None:
            running.recording = path
            path.parent.mkdir(parents=True, exist_ok=True)
            claim(path.parent.parent, f"{path.parent.name}/{path.name}")
            remove(path)  # an earlier run's
        recording = Recording(path, {"test": name})
        with (
            self._unless_unsafe(),
            Rig(plan).prepare(
                recording=recording, needed=channels, held=True, full=any(w.startswith("rate:") for w in needed(item))
            ) as rig,
        ):
            if not self.setup.identity:
                elsewhere = self._elsewhere
                unused = {LIMITS_ELSEWHERE: f"{len(elsewhere)}: {', '.join(elsewhere)}"} if elsewhere else {}
                seed = {} if self.settings.seed is None else {"seed": str(self.settings.seed)}
                described = rig.describe() | self.ratings.words | seed | unused
                self.setup = Setup(describe(rig.drive.node.identity), rig.before, described, self._deselected)
            yield rig
            rig.summary(_words(running, rig.drive.changed))

    def _seeded(self, test: str) -> Settings:
        """With a seed of the test's own, if there is one for the run."""
        seed = self.settings.seed
        return self.settings if seed is None else replace(self.settings, seed=crc32(test.encode(), seed))

    @contextmanager
    def _unless_unsafe(self) -> Iterator[None]:
        """Remember that outputs may still be on; no further test energises anything then."""
        try:
            yield
        except BaseException as error:
            for what in (error, error.__cause__):
                if isinstance(what, OutputsMayBeOn):
                    self.unsafe = self.error = str(what)
            raise

    @property
    def _deselected(self) -> dict[str, str]:
        chosen = {item.nodeid for item in self._items}
        return {self._names[item.nodeid]: label_of(item) for item in self._known if item.nodeid not in chosen}

    def require(self, item: pytest.Item, rig: Rig) -> None:
        """Skip the test if the rig lacks what it needs."""
        lacking = [why for what in needed(item) if (why := missing(what, rig)) is not None]
        lacking += self.ratings.missing(rated_by(item))
        if lacking:
            pytest.skip("; ".join(dict.fromkeys(lacking)))

    def note_phase(self, item: pytest.Item, call: pytest.CallInfo[None], report: Any) -> None:
        """After setup, call and teardown: the worst of them is the test's verdict, made at the last."""
        phase = judge(call, report)
        if phase.expected:  # its words say it all, a traceback would bury them
            report.longrepr = phase.why
        phase = self._phases.pop(item.nodeid, NOT_BEGUN).then(phase, call.duration)
        if call.when != "teardown":
            self._phases[item.nodeid] = phase
            setattr(report, RESULT, None)  # it is one of ours, and its result comes later
            return
        result = self._result(item, phase)
        setattr(report, RESULT, Carried(result, self.setup))
        report.user_properties.extend((m.name, value_text(m)) for m in result.measurements)
        if RIG in item.stash:  # it holds every sample of the test
            del item.stash[RIG], item.stash[RUNNING]

    def _result(self, item: pytest.Item, phase: Phase) -> TestResult:
        running = item.stash.get(RUNNING, None) or self.running(item)
        rig = item.stash.get(RIG, None)
        if phase.verdict is not Verdict.PASS:
            running.give_up(phase.verdict, phase.why)
        doc = (getattr(item, "obj", None).__doc__ or "").strip()
        title, _, about = doc.partition("\n")
        verdict = worst((phase.verdict, *(m.verdict for m in running.measurements)))
        if phase.verdict is Verdict.SKIPPED and verdict is Verdict.PASS:  # what it did not come to was not judged
            verdict = Verdict.SKIPPED
        recording = running.recording
        if recording is not None and verdict is Verdict.SKIPPED:
            remove(recording)
        return TestResult(
            name=running.name,
            title=title.strip(),
            about="\n".join(line.strip() for line in about.strip().splitlines()),
            node_id=item.nodeid,
            verdict=verdict,
            why=phase.why,
            measurements=tuple(running.measurements),
            figures=tuple(running.pictures),
            recording=f"recordings/{recording.name}" if recording is not None and recording.exists() else "",
            quality=rig.quality() if rig is not None else Quality(),
            parameters=dict(rig.drive.changed) if rig is not None else {},
            wall_seconds=phase.seconds,
            label=label_of(item),
            log=phase.log,
        )

    # -- results ------------------------------------------------------------------------------------------------

    def collect(self, report: pytest.TestReport) -> None:
        """Keep the result that a report carries; with workers it has come from another process."""
        carried: Carried | None = getattr(report, RESULT, None)
        if carried is not None:
            self.results[report.nodeid] = carried.result
            self.setup = self.setup if self.setup.identity else carried.setup

    def crashed(self, report: pytest.TestReport) -> None:
        """Give a report a result, of a test whose process has gone."""
        result = self._unknown(report.nodeid, Phase(Verdict.ERROR, str(report.longrepr)))
        setattr(report, RESULT, Carried(result, Setup()))

    def _unknown(self, node_id: str, phase: Phase) -> TestResult:
        """The result of a test that another process knows."""
        return TestResult(self._names[node_id], "", "", node_id, phase.verdict, phase.why)

    def pytest_keyboard_interrupt(self, excinfo: pytest.ExceptionInfo[BaseException]) -> None:
        """Somebody has ended it, unless it was this session."""
        self.interrupted(excinfo.value)

    def interrupted(self, interrupt: BaseException) -> None:
        """Remember that somebody ended it, and what could not be put back meanwhile."""
        self._interrupted = self._interrupted or not self.error
        if isinstance(interrupt.__cause__, BenchError):
            self.error = str(interrupt.__cause__)

    def finish(self) -> None:
        """Let go of the target; where results come together, put them together and write what was asked for."""
        try:
            self._held.close()
        except BenchError as error:
            self.error = self.error or str(error)
        if not self._collects:
            return
        self.run = self._run()
        problems = []
        for write_output in (self._write_results, self._write_report):
            try:
                write_output(self.run)
            except BenchError as error:
                problems.append(str(error))
        if problems and not self.error:
            raise pytest.UsageError("; ".join(problems))

    def _write_results(self, run: RunResult) -> None:
        if file := self.config.option.bench_json:
            write(Path(file), json.dumps(to_json(run), indent=1) + "\n", f"results {file}")

    def _write_report(self, run: RunResult) -> None:
        if self.directory is not None and os.path.isdir(self.directory):
            from bench.accept.report import write_report

            write_report(run, self.directory)

    def _run(self) -> RunResult:
        ended = Phase(Verdict.ABORTED, "the run was ended")
        items = {item.nodeid: item for item in self._items}
        order = self.order or list(items)
        for node_id in order if self._interrupted else ():
            if node_id not in self.results:
                phase = self._phases.get(node_id, NOT_BEGUN).then(ended, 0.0)
                item = items.get(node_id)
                self.results[node_id] = self._result(item, phase) if item else self._unknown(node_id, phase)
        tests = [self.results[node_id] for node_id in order if node_id in self.results]
        verdict = worst(test.verdict for test in tests)
        if self.error or not tests:
            verdict = worst((Verdict.ERROR, verdict))
        if self._incomplete(tests, verdict):
            verdict = Verdict.INCOMPLETE
        if self._interrupted:
            verdict = Verdict.ABORTED
        run = RunResult(
            started=self.began.isoformat(timespec="seconds"),
            target=self.target,
            verdict=verdict,
            tests=tuple(tests),
            versions=versions(),
            **{name: getattr(self.setup, name) for name in ("identity", "parameters", "rig", "deselected")},
            **{name: getattr(self.settings, name) for name in ("station", "operator", "motor")},
            wall_seconds=(datetime.now().astimezone() - self.began).total_seconds(),
            error=self.error,
            unsafe=self.unsafe,
        )
        if self.spec is None:
            return run
        use = self.spec.use(run)
        return replace(run, spec=use, verdict=worst((verdict, Verdict.FAIL)) if use.unlike else verdict)

    def _incomplete(self, tests: list[TestResult], verdict: Verdict) -> bool:
        """Whether nothing went wrong, and not all was tested: what is allowed to be skipped must leave something."""
        if verdict is Verdict.SKIPPED:
            return True
        verdicts = {test.verdict for test in tests} | {m.verdict for test in tests for m in test.measurements}
        return verdict is Verdict.PASS and Verdict.SKIPPED in verdicts and not self.config.option.bench_allow_skipped


def _words(running: Running, changed: dict[str, float]) -> str:
    lines = [f"# {escaped(running.name)}", ""]
    lines += [f"- {escaped(m.name)} = {escaped(value_text(m))}" for m in running.measurements if m.value is not None]
    lines += [f"- set {escaped(name)} = {value:g}" for name, value in changed.items()]
    return "\n".join(lines)
