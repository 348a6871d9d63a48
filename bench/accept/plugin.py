"""The pytest plug-in: fixtures for acceptance tests, options, verdicts.

It is loaded by every pytest of an environment in which this package is installed, so it imports nothing heavy before a
test asks for one of its fixtures, and changes nothing for tests that ask for none.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from datetime import datetime
from typing import TYPE_CHECKING, Any

import pytest

from bench.accept.collected import RESULT, RIG, RUNNING, SCREEN, is_acceptance_test
from bench.accept.marks import MARKS

if TYPE_CHECKING:
    from bench.accept.faults import HallFaults
    from bench.accept.fixtures import Record
    from bench.accept.session import BenchSession
    from bench.rig.drive import Drive
    from bench.rig.loads import Load
    from bench.rig.ratings import Ratings
    from bench.rig.rig import Rig

SESSION: pytest.StashKey[BenchSession] = pytest.StashKey()
SHORT = "--target"


def pytest_addoption(parser: pytest.Parser) -> None:
    """The options of an acceptance run."""
    group = parser.getgroup("hallbench", "acceptance tests of a drive")
    group.addoption(
        "--bench-target",
        metavar="TARGET",
        help="drive: serial:…, tcp:…, can:…, or sim (default); --target for short, if nothing else has that option",
    )
    group.addoption("--bench-config", metavar="FILE", help="figures of the simulated drive (TOML)")
    group.addoption(
        "--bench-toml",
        metavar="FILE",
        help="the bench: target, load, limits (default: bench.toml here, or in a folder above)",
    )
    group.addoption("--bench-seed", type=int, metavar="N", help="of the simulated drive's noise")
    group.addoption("--bench-spec", metavar="FILE", help="what good drives of this kind measure: bands beside limits")
    group.addoption("--bench-operator", metavar="NAME", help="who runs this, for the report")
    group.addoption("--bench-motor", metavar="TEXT", help="which motor this is, for the report")
    group.addoption("--bench-yes", action="store_true", help="the shaft is clear: energise a physical drive")
    group.addoption("--bench-allow-skipped", action="store_true", help="PASS, not INCOMPLETE, where tests were skipped")
    group.addoption("--bench-report", metavar="DIR", help="write report.html, figures and recordings there")
    group.addoption("--bench-json", metavar="FILE", help="write every result as JSON")


@pytest.hookimpl(wrapper=True)
def pytest_load_initial_conftests(parser: pytest.Parser, args: list[str]) -> Generator[None]:
    """Take `--target` too, if it is given and neither a plug-in nor a conftest has such an option."""
    yield
    if any(arg.partition("=")[0] == SHORT for arg in args) and _unknown(parser, SHORT):
        group = parser.getgroup("hallbench")
        group.addoption(SHORT, dest="bench_target", metavar="TARGET", help="short for --bench-target")


def _unknown(parser: pytest.Parser, option: str) -> bool:
    try:
        return option in parser.parse_known_and_unknown_args([option])[1]
    except pytest.UsageError:  # it wants a value: somebody's
        return False


def pytest_configure(config: pytest.Config) -> None:
    """Register the marks; listen for results, unless this process only makes them for another."""
    for name, about in MARKS.items():
        config.addinivalue_line("markers", f"{name}: {about}")
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(_Collector(config), "hallbench-collector")


class _Collector:
    """Takes results out of reports. With worker processes it is where they come together."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config
        self._began = datetime.now().astimezone()
        self._order: list[str] = []
        self._others: set[str] = set()  # tests that are none of ours

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_node_collection_finished(self, node: Any, ids: list[str]) -> None:
        """Keep the order of the tests, in which the results will not come."""
        self._order = ids
        if SCREEN in self._config.stash:  # `bench accept`: these are the tests
            self._session()

    @pytest.hookimpl(optionalhook=True)
    def pytest_handlecrashitem(self, report: pytest.TestReport) -> None:
        """A process has crashed: no other than this one can tell how its test ended."""
        if SESSION in self._config.stash:
            self._session().crashed(report)

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Hand on the result of an acceptance test."""
        if hasattr(report, RESULT):
            self._session().collect(report)
        elif report.when == "teardown":
            self._others.add(report.nodeid)

    def _session(self) -> BenchSession:
        session = session_of(self._config)
        session.began = self._began
        if self._order:
            session.expect(self._order, self._others)
        return session


def session_of(config: pytest.Config) -> BenchSession:
    """The acceptance session of this process, made at first use."""
    if SESSION not in config.stash:
        from bench.accept.session import BenchSession
        from sim.interrupts import Held

        with Held():  # it registers itself: a second one could not
            config.stash[SESSION] = BenchSession(config)
    return config.stash[SESSION]


# -- collection -----------------------------------------------------------------------------------------------------


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Name all tests before some are deselected: what a test is called does not depend on what else is run."""
    found = [item for item in items if is_acceptance_test(item)]
    if found:
        session_of(config).know(found)


@pytest.hookimpl(trylast=True)
def pytest_collection_finish(session: pytest.Session) -> None:
    """Check limits and names before anything moves; ask once whether the drive may be spun."""
    items = [item for item in session.items if is_acceptance_test(item)]
    if items and not session.config.option.collectonly:
        session_of(session.config).prepare(items)


# -- fixtures -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def bench_target(pytestconfig: pytest.Config) -> str:
    """The target string that the tests run against."""
    return session_of(pytestconfig).target


@pytest.fixture
def _hallbench_rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    item = request.node
    if RUNNING not in item.stash:
        pytest.fail(
            f"{item.nodeid} gets a fixture of the bench by getfixturevalue: ask for it by argument, so that it is "
            "known beforehand what will turn",
            pytrace=False,
        )
    session = session_of(request.config)
    running = item.stash[RUNNING]
    with session.rig_for(item) as rig:
        item.stash[RIG] = rig
        running.mark = rig.mark
        session.require(item, rig)
        yield rig
    running.draw()


@pytest.fixture
def drive(_hallbench_rig: Rig) -> Drive:
    """The drive, idle; it is idle again after the test, with the parameters that it had before."""
    return _hallbench_rig.drive


@pytest.fixture
def load(_hallbench_rig: Rig) -> Load:
    """What brakes or turns the shaft; the test is skipped where there is nothing."""
    if not _hallbench_rig.load.abilities:
        pytest.skip("needs a load")
    return _hallbench_rig.load


@pytest.fixture
def record(_hallbench_rig: Rig) -> Record:
    """`record(seconds)` gives the next stretch of samples as a `Capture`."""
    from bench.accept.fixtures import Record

    return Record(_hallbench_rig)


@pytest.fixture
def rated(_hallbench_rig: Rig, pytestconfig: pytest.Config) -> Ratings:
    """What the drive is rated for: `rated.speed_rpm` in mechanical r/min, `rated.current` in A."""
    return session_of(pytestconfig).ratings


@pytest.fixture
def measure(_hallbench_rig: Rig, request: pytest.FixtureRequest) -> Any:
    """`measure(name, value, capture…)` compares a value with the limit that the test declared."""
    return request.node.stash[RUNNING].measure


@pytest.fixture
def figure(_hallbench_rig: Rig, request: pytest.FixtureRequest) -> Any:
    """`figure(name, caption, draw)` puts the picture that `draw()` makes into the report."""
    return request.node.stash[RUNNING].figure


@pytest.fixture
def hall_faults(_hallbench_rig: Rig) -> HallFaults:
    """Breaks, exchanges and disturbs the Hall wires, where the rig or a person can."""
    from bench.accept.faults import HallFaults

    return HallFaults(_hallbench_rig)


# -- one test -------------------------------------------------------------------------------------------------------


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> Generator[None]:
    """Know what the test declares before its fixtures are made."""
    if is_acceptance_test(item):
        item.stash[RUNNING] = session_of(item.config).running(item)
    yield


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None]:
    """Fail a test at its end for a trip that it did not come to see, and for what it measured."""
    try:
        yield
    finally:
        if is_acceptance_test(item):
            item.stash[RIG].rest()  # a traceback takes longer to make than a watchdog waits
    if is_acceptance_test(item):
        item.stash[RIG].drive.look()
        item.stash[RUNNING].end()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Generator[None, Any, Any]:
    """Hand the result to whoever collects the reports, in this process or another."""
    report = yield
    if is_acceptance_test(item):
        session_of(item.config).note_phase(item, call, report)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_report_to_serializable() -> Generator[None, Any, Any]:
    """Make the result text, where the report goes to another process."""
    data = yield
    if data is not None and data.get(RESULT) is not None:
        data[RESULT] = data[RESULT].to_text()
    return data


@pytest.hookimpl(wrapper=True)
def pytest_report_from_serializable() -> Generator[None, Any, Any]:
    """Make a result of the text again."""
    report = yield
    if isinstance(text := getattr(report, RESULT, None), str):
        from bench.accept.results import Carried

        setattr(report, RESULT, Carried.from_text(text))
    return report


# -- the end --------------------------------------------------------------------------------------------------------


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_sessionfinish(session: pytest.Session) -> Generator[None]:
    """Write what was asked for, once every fixture is gone, also if one would not go."""
    try:
        yield
    except KeyboardInterrupt as interrupt:  # one more, while what the first one ended was put back
        if SESSION in session.config.stash:
            session.config.stash[SESSION].interrupted(interrupt)
    finally:
        if SESSION in session.config.stash and not session.config.option.collectonly:
            session.config.stash[SESSION].finish()
