"""What an acceptance run finds, as plain data: limits, measurements, tests, and the run that holds them.

A run goes to JSON and back (`to_json`, `run_from_json`). Nothing here measures, draws or talks to a drive.
"""

from __future__ import annotations

import base64
import math
import pickle
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

from bench.files import finite
from bench.rig.outcome import RunOutcome
from bench.rig.quality import ParameterValue, Quality
from bench.signal.limits import Limits
from bench.signal.verdict import Verdict, worst

__all__ = [
    "Figure", "Limits", "Measurement", "ParameterValue", "Quality", "RunResult", "SpecUse", "TestResult", "Verdict",
    "gaps", "run_from_json", "to_json", "worst",
]  # fmt: skip

NOT_TESTED = (Verdict.ABORTED, Verdict.SKIPPED)


@dataclass(frozen=True, slots=True)
class Measurement:
    """One measured value against its limits. `name` is TEST.LIMIT, and so are the names in bench.toml."""

    name: str
    limits: Limits
    verdict: Verdict
    value: float | None = None
    """None: the test did not come to it."""
    why: str = ""
    """Why it is not PASS, where value and limits do not say it."""
    span: tuple[float, float] | None = None
    """Where in the recording it was measured: device time in s."""
    specified: Limits | None = None
    """The band of `--spec`, in which it must be too; None where there is none."""

    @property
    def nearest(self) -> Limits:
        """Of its limits and its band the one with the smaller margin; the band, where there is no value."""
        value, both = self.value, [limits for limits in (self.specified, self.limits) if limits is not None]
        if value is None:
            return both[0]
        return min(both, key=lambda limits: math.inf if (margin := limits.margin(value)) is None else margin)

    @property
    def failed(self) -> str:
        """What a FAIL is one by: "specified" where the value is within its limits, else "limits"; "" if it is none."""
        within = self.value is not None and self.limits.allow(self.value)
        return ("specified" if within else "limits") if self.verdict is Verdict.FAIL else ""

    @property
    def margin(self) -> float | None:
        """See `Limits.margin`, of the nearest; None without a value."""
        return None if self.value is None else self.nearest.margin(self.value)

    @property
    def share(self) -> float | None:
        """Margin as a share of the width between the limits, or of the limit where there is one; None without."""
        if (margin := self.margin) is None:
            return None
        return margin / width if (width := self.nearest.width) else None


@dataclass(frozen=True, slots=True)
class Figure:
    """A picture of a test. `path` is relative to the report."""

    path: str
    caption: str


@dataclass(frozen=True, slots=True)
class TestResult:
    """One acceptance test."""

    __test__ = False  # not for pytest, for all its name

    name: str
    title: str
    """First line of its docstring."""
    about: str
    """The rest of it."""
    node_id: str
    verdict: Verdict
    why: str = ""
    measurements: tuple[Measurement, ...] = ()
    figures: tuple[Figure, ...] = ()
    recording: str = ""
    """Path of the recording, relative to the report; empty: none was kept."""
    quality: Quality = field(default_factory=Quality)
    parameters: Mapping[str, float] = field(default_factory=dict)
    """The drive's parameters that the test set, as it last set them."""
    wall_seconds: float = 0.0
    label: str = ""
    """What it is called for people; empty where only its name is known."""
    log: str = ""
    """Traceback or notes, for whoever looks into a failure."""


@dataclass(frozen=True, slots=True)
class SpecUse:
    """What a spec had to say on a run, beside the verdicts of measurements."""

    name: str
    """Its file, or its name if it is shipped."""
    about: str
    """Of which drive it is, and from how many runs."""
    unlike: tuple[str, ...] = ()
    """Parameters of the drive that are not as specified, a line each: the run is a FAIL."""
    notes: tuple[str, ...] = ()
    """What is not as it was when it was learned, and is no fault."""
    without: tuple[str, ...] = ()
    """Measurements of this run that it does not have."""
    unused: tuple[str, ...] = ()
    """Measurements that it has and that were not made."""
    resolution: tuple[tuple[str, float, str], ...] = ()
    """What matters, and the deviation and its unit below which that cannot be told from what good drives do."""

    @property
    def untold(self) -> str:
        """The resolution, in words."""
        return ", ".join(f"{what} {width:.2g} {unit}".rstrip() for what, width, unit in self.resolution)


@dataclass(frozen=True, slots=True)
class RunResult:
    """An acceptance run."""

    started: str
    """Date and time, ISO 8601 with offset."""
    target: str
    verdict: Verdict
    tests: tuple[TestResult, ...]
    identity: Mapping[str, Any] = field(default_factory=dict)
    """Drive, firmware, boot, protocol: what HELLO says; empty where no drive answered."""
    parameters: tuple[ParameterValue, ...] = ()
    rig: Mapping[str, str] = field(default_factory=dict)
    """What the bench has: load, encoder, fault insertion, link …"""
    versions: Mapping[str, str] = field(default_factory=dict)
    station: str = ""
    """Which bench it was made on."""
    operator: str = ""
    """Who made it."""
    motor: str = ""
    """Which motor it was made on."""
    deselected: Mapping[str, str] = field(default_factory=dict)
    """The tests that there are and that were not chosen: what they are called for people, by name."""
    wall_seconds: float = 0.0
    error: str = ""
    """What kept the run from starting or from going on."""
    unsafe: str = ""
    """Why outputs may still be on, where they were not seen to be off."""
    spec: SpecUse | None = None
    """Of `--spec`."""

    @property
    def measurements(self) -> tuple[Measurement, ...]:
        """Of all tests, in their order."""
        return tuple(measurement for test in self.tests for measurement in test.measurements)

    @property
    def exit_code(self) -> int:
        """0 passed, 1 the drive failed, 2 the bench did, 6 incomplete, 130 aborted; 5 outputs may still be on."""
        return RunOutcome.of(self.verdict, unsafe=self.unsafe).exit_code


def tightest(measurements: Iterable[Measurement]) -> Measurement | None:
    """Of those that were judged, the one with the least share of its room left, or the furthest outside; NaN is that.

    A count or a yes that stands at its limit is as it should be and has no room to speak of; None where all are such.
    """
    judged = []
    for measurement in measurements:
        margin, share = measurement.margin, measurement.share
        if margin and measurement.verdict in (Verdict.PASS, Verdict.FAIL):
            if share is None:  # a limit of 0, or two that are one
                share = math.copysign(math.inf, margin)
            judged.append((-math.inf if math.isnan(margin) else share, measurement))
    return min(judged, key=lambda pair: pair[0], default=(0.0, None))[1]


@dataclass
class Gap:
    """Tests that were not made, or not to their end, for one reason, and how many measurements they lack for that."""

    verdict: Verdict
    why: str
    tests: list[TestResult] = field(default_factory=list)
    measurements: int = 0


def gaps(tests: Iterable[TestResult]) -> list[Gap]:
    """What was not tested, by its reason: the one with the most measurements first."""
    found: dict[tuple[Verdict, str], Gap] = {}
    for test in tests:
        lacking = [(m.verdict, m.why or test.why) for m in test.measurements if m.verdict in NOT_TESTED]
        none_lacks = [(test.verdict, test.why)] if test.verdict in NOT_TESTED else []
        for reason in lacking or none_lacks:
            gap = found.setdefault(reason, Gap(*reason))
            gap.measurements += bool(lacking)
            if test not in gap.tests[-1:]:
                gap.tests.append(test)
    return sorted(found.values(), key=lambda gap: -gap.measurements)


@dataclass(frozen=True, slots=True)
class Setup:
    """What was tested, and on which bench: of the first test that reached the drive."""

    identity: Mapping[str, Any] = field(default_factory=dict)
    parameters: tuple[ParameterValue, ...] = ()
    rig: Mapping[str, str] = field(default_factory=dict)
    deselected: Mapping[str, str] = field(default_factory=dict)


class Carried(NamedTuple):
    """What the report of a test's last phase carries to whoever collects the reports."""

    result: TestResult
    setup: Setup

    def to_text(self) -> str:
        """For another process of this program; its channel carries text, and no subclass of float."""
        return base64.b64encode(pickle.dumps(self)).decode("ascii")

    @staticmethod
    def from_text(text: str) -> Carried:
        """What `to_text` made; of a process of this program only, because it is unpickled."""
        carried = pickle.loads(base64.b64decode(text))
        assert isinstance(carried, Carried)
        return carried


def to_json(run: RunResult) -> dict[str, Any]:
    """Plain data for `json.dumps`, margins spelled out; numbers that are not finite are None."""
    plain: dict[str, Any] = finite(asdict(run))
    for test, source in zip(plain["tests"], run.tests, strict=True):
        for written, measurement in zip(test["measurements"], source.measurements, strict=True):
            written |= {"margin": finite(measurement.margin), "failed": measurement.failed}
    return plain


def run_from_json(data: Mapping[str, Any]) -> RunResult:
    """What `to_json` made of a run; a parameter that was not finite is NaN."""
    from pydantic import TypeAdapter

    known = [{name: math.nan if value is None else value for name, value in one.items()} for one in data["parameters"]]
    return TypeAdapter(RunResult).validate_python({**data, "parameters": known})
