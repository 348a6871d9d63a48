"""Lets several workers share the suite (`pytest -n 3`), and tells at the end what was skipped and what took long.

A drive in real time, a watchdog or a viewer needs a core when its time has come, and a worker beside it that computes
takes it away, whatever its priority. So every test holds a lock of its kind while it runs, which others of that kind
share. Those in real time come last, two beside one another. Tests that share what takes long to make go to one worker.
"""

from __future__ import annotations

import fcntl
import functools
import json
import os
import signal
import tempfile
from collections import Counter
from collections.abc import Generator, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from uuid import uuid4

import pytest

from tests import campaign, choice, tools

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's job in the background begins without Ctrl-C

KINDS = ("computing", "real-time")
LONGEST = 5.0  # s that a test may take without a mark `long` that says why


@contextmanager
def _locked(path: Path, how: int) -> Iterator[None]:
    with path.open("w") as file:
        fcntl.flock(file, how)
        yield


def _place(run: str, name: str) -> Path:
    """A file that the workers of a run share."""
    return Path(tempfile.gettempdir()) / f"hallbench-tests-{run}.{name}"


def _kind(item: pytest.Item) -> str:
    if item.get_closest_marker("alone"):
        return "alone"
    return "real-time" if item.get_closest_marker("real_time") or item.get_closest_marker("real_links") else "computing"


def _group(item: pytest.Item) -> str:
    """Which tests go to the same worker: long ones in real time, others, those that share a fixture of their module."""
    if _kind(item) == "real-time":
        return "real-time, long" if item.get_closest_marker("long") else "real-time"
    fixtures = getattr(item, "_fixtureinfo").name2fixturedefs  # noqa: B009
    if "suite_run" in fixtures:
        return "suite_run"
    return item.path.stem if any(found[-1].scope == "module" for found in fixtures.values()) else ""


@contextmanager
def _turn(kind: str) -> Iterator[None]:
    """Hold the machine for a test of this kind; who waits for it lets nobody else in meanwhile."""
    run = os.environ.get("PYTEST_XDIST_TESTRUNUID")
    if run is None:
        yield
        return
    door, *rooms = (_place(run, name) for name in ("door", *KINDS))
    with ExitStack() as stack:
        with _locked(door, fcntl.LOCK_EX), ExitStack() as waiting:
            for room, others in zip(rooms, KINDS, strict=True):
                if others == kind:
                    stack.enter_context(_locked(room, fcntl.LOCK_SH))
                else:  # until they are done
                    (stack if kind == "alone" else waiting).enter_context(_locked(room, fcntl.LOCK_EX))
        yield


def pytest_addoption(parser: pytest.Parser) -> None:
    """What takes long and need not run each time."""
    parser.addoption("--real-links", action="store_true", help="the test device over pty, TCP and CAN too")
    parser.addoption("--campaign", action="store_true", help="tests of campaigns only, all seeds, motors and faults")


def pytest_configure(config: pytest.Config) -> None:
    """Register what needs a plug-in of its own."""
    if getattr(config.option, "numprocesses", None) and not os.environ.get("PYTEST_XDIST_WORKER"):
        config.option.testrunuid = config.option.testrunuid or uuid4().hex
        config.option.loadscopereorder = False
        config.pluginmanager.register(Together(config.option.testrunuid))
    if config.getoption("--campaign"):
        os.environ[choice.CAMPAIGN] = "1"
    config.pluginmanager.register(Order())


@pytest.hookimpl(tryfirst=True)  # before -m selects
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what was not asked for; what may take long is slow, too."""
    for item in items:
        if item.get_closest_marker("long"):
            item.add_marker(pytest.mark.slow)
    if config.getoption("--campaign"):
        kept = campaign.wanted([item for item in items if item.get_closest_marker("campaign")])
    else:
        kept = [item for item in items if not item.get_closest_marker("campaign")]
    if not config.getoption("--real-links"):
        kept = [item for item in kept if not item.get_closest_marker("real_links")]
    config.hook.pytest_deselected(items=[item for item in items if item not in set(kept)])
    items[:] = kept
    if run := os.environ.get("PYTEST_XDIST_TESTRUNUID"):
        groups = {item.nodeid: group for item in kept if (group := _group(item))}
        _place(run, f"groups-{os.getpid()}").write_text(json.dumps(groups))


class Together:
    """Hands the tests out one by one, so that the workers end together, and those of a group to one worker.

    pytest-xdist 3.8 has `--dist loadgroup` for that, which pytest 9.2 leaves without a name that it could change.
    """

    def __init__(self, run: str) -> None:
        self._run = run

    @pytest.hookimpl(optionalhook=True, tryfirst=True)
    def pytest_xdist_make_scheduler(self, config: pytest.Config, log: object) -> object:
        """By scopes, which are the groups."""
        from xdist.scheduler import LoadScopeScheduling

        run = self._run

        class Scheduling(LoadScopeScheduling):
            @functools.cached_property
            def groups(self) -> dict[str, str]:
                found = sorted(Path(tempfile.gettempdir()).glob(f"hallbench-tests-{run}.groups-*"))
                return dict(json.loads(found[0].read_text()))

            def _split_scope(self, nodeid: str) -> str:
                return self.groups.get(nodeid, nodeid)

        return Scheduling(config, log)

    def pytest_unconfigure(self) -> None:
        """Remove what the workers have shared."""
        for file in Path(tempfile.gettempdir()).glob(f"hallbench-tests-{self._run}.*"):
            file.unlink(missing_ok=True)


class Order:
    """Its own plugin, since what pytest itself puts together by fixtures must be done by then."""

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Long tests first, those in real time last."""
        slow = {item for item in items if item.get_closest_marker("slow")}
        items.sort(key=lambda item: ((*KINDS, "alone").index(_kind(item)), item not in slow))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Run a test in its turn."""
    with _turn(_kind(item)):
        return (yield)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip a test whose tool is missing."""
    for mark in item.iter_markers("needs"):
        for name in mark.args:
            tools.require(name)


def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> None:
    """Tell the reports whether a test may take long, and of which campaigns it is."""
    if call.when == "setup":
        item.user_properties.append(("long", item.get_closest_marker("long") is not None))
        item.user_properties.append(("campaigns", campaign.names_of(item)))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """What was skipped, why, and what brings it; what took long and does not say why; what chose the seeds."""
    reports = terminalreporter.stats
    skipped = Counter(
        str(report.longrepr[2]).removeprefix("Skipped: ")
        for report in reports.get("skipped", ())
        if isinstance(report.longrepr, tuple)
    )
    if skipped:
        terminalreporter.section("skipped")
        for line in tools.skipped_table(skipped):
            terminalreporter.write_line(line)
    took = Counter[str]()
    excused = set()
    for report in (report for found in reports.values() for report in found if isinstance(report, pytest.TestReport)):
        took[report.nodeid] += report.duration
        excused |= {report.nodeid} if ("long", True) in report.user_properties else set()
    for nodeid, seconds in took.most_common():
        if seconds > LONGEST and nodeid not in excused:
            terminalreporter.write_line(f"over {LONGEST:g} s without a mark that says why: {seconds:.1f} s {nodeid}")
    terminalreporter.write_line(f"seeds, motors and faults chosen by {choice.commit()} ({choice.GIVEN})")
